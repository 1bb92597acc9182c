"""Limits of the watchdog, on sequences of states."""

from __future__ import annotations

import pytest

from escape_hw.config.system import ServerSection
from escape_hw.remote.state import ActiveRun, FaultState, FrameCounters, LoopState, MirrorState, State
from escape_hw.server.safety.watchdog import LimitViolation, Watchdog


class Engine:
    """Tells a state every so many seconds."""

    def __init__(self, every: float = 0.25) -> None:
        self.now, self.frames, self.published, self.every = 0.0, 0, 0, every
        self.dog = Watchdog(ServerSection(), lambda: self.now)

    def tell(
        self, seconds: float, *, closed: bool = True, frames: int = 100, residual: float = 50.0,
        clipped: float = 0.0, fault: FaultState | None = None, fresh: bool = True, run: int | None = None,
        flattened: int = 1,
    ) -> LimitViolation | None:  # fmt: skip
        """So many seconds alike; the first verdict."""
        for _ in range(round(seconds / self.every)):
            self.now += self.every
            self.frames += frames
            self.published += fresh
            state = State(
                rates=FrameCounters(frames=self.frames), fault=fault,
                mirror=MirrorState(saturated_share=clipped, flatten_count=flattened),
                active_run=None if run is None else ActiveRun(id=run, name="gains", arguments={}),
                # No two residuals are quite the same.
                loop=LoopState(closed=closed, residual_nm=residual * (1 + 1e-6 * self.published)),
            )  # fmt: skip
            if (violation := self.dog.check(state)) is not None:
                return violation
        return None


@pytest.fixture
def engine() -> Engine:
    return Engine()


def test_a_good_loop_is_not_opened_for_an_hour(engine: Engine) -> None:
    for _ in range(60):
        assert engine.tell(50, residual=40) is None
        # A gust, and some actuators at their limits for a moment.
        assert engine.tell(9, residual=110, clipped=0.1) is None
        assert engine.tell(0.8, clipped=0.9) is None


def test_a_run_that_closes_a_loop_of_its_own_is_not_compared_with_the_one_before(engine: Engine) -> None:
    assert engine.tell(20, residual=60) is None
    # No state came between the two loops.
    assert engine.tell(20, residual=250, run=5) is None
    # Nor is the loop that comes back after it.
    assert engine.tell(20, residual=60) is None
    violation = engine.tell(5, residual=250)
    assert violation is not None
    assert "the residual grew" in violation.reason


def test_a_loop_that_a_run_closes_again_is_not_compared_with_its_round_before(engine: Engine) -> None:
    assert engine.tell(20, residual=60, run=5) is None
    # Opened, the mirror flat, and closed at a lower gain: no state came in between.
    assert engine.tell(20, residual=250, run=5, flattened=2) is None
    violation = engine.tell(5, residual=1100, run=5, flattened=2)
    assert violation is not None
    assert "the residual grew to 1100 nm" in violation.reason


def test_no_frames_in_closed_loop(engine: Engine) -> None:
    assert engine.tell(5) is None
    assert engine.tell(2, frames=0) is None
    violation = engine.tell(0.5, frames=0)
    assert violation is not None
    assert violation.reason.startswith("no frame for 2.2 s in closed loop (limit 2 s)")
    assert "camera" in violation.remedy


def test_a_loop_may_compile_its_code_at_the_first_frames(engine: Engine) -> None:
    assert engine.tell(1, closed=False) is None
    assert engine.tell(20, frames=0, run=3) is None
    assert engine.tell(1, frames=20, run=3) is None
    assert engine.tell(20, frames=0, run=3) is None
    violation = engine.tell(60, frames=0, run=3)
    assert violation is not None
    assert "no frame for 60" in violation.reason


def test_no_frames_while_nothing_is_closed_is_no_fault(engine: Engine) -> None:
    assert engine.tell(600, closed=False, frames=0) is None
    assert engine.tell(1.0) is None


def test_saturated_actuators(engine: Engine) -> None:
    assert engine.tell(5) is None
    violation = engine.tell(2, clipped=0.35)
    assert violation is not None
    assert violation.reason.startswith("35 % of the actuators at their limits for 1.2 s")


def test_a_residual_that_grows(engine: Engine) -> None:
    assert engine.tell(10, residual=50) is None
    violation = engine.tell(3, residual=300)
    assert violation is not None
    assert "grew to 300 nm, 6.0 times its median of 50 nm" in violation.reason


@pytest.mark.parametrize("every", [0.02, 0.2, 1.5])
def test_a_residual_that_grows_is_detected_at_any_publishing_rate(every: float) -> None:
    engine = Engine(every)
    assert engine.tell(12, residual=50) is None
    violation = None
    for residual in (90, 130, 170, 250, 330, 400, 400):
        violation = violation or engine.tell(1.5, residual=residual)
    assert violation is not None
    assert "times its median of 50 nm" in violation.reason


def test_states_published_out_of_turn_have_no_more_weight(engine: Engine) -> None:
    assert engine.tell(10, residual=50) is None
    # As when many requests publish states while the residual is high.
    engine.every = 0.001
    assert engine.tell(0.2, residual=300) is None
    engine.every = 0.25
    assert engine.tell(10, residual=50) is None


def test_gaps_between_states_do_not_count_towards_the_limits(engine: Engine) -> None:
    """States wait for it meanwhile, each a fifth of a second after the one before."""
    assert engine.tell(10) is None
    engine.now += 5
    engine.every = 0.001
    assert engine.tell(0.005, frames=0, clipped=0.5) is None
    engine.every = 0.25
    assert engine.tell(10) is None


def test_a_residual_before_the_loop_was_closed_does_not_count(engine: Engine) -> None:
    assert engine.tell(10, residual=5) is None
    assert engine.tell(1, closed=False, residual=0) is None
    assert engine.tell(10, residual=300) is None


def test_a_repeated_residual_is_not_used(engine: Engine) -> None:
    # As before a procedure closes its own loop, which begins with the whole turbulence.
    engine.published += 1
    assert engine.tell(60, residual=60, fresh=False) is None
    assert engine.tell(10, residual=600) is None


def test_what_is_latched_is_not_judged_again(engine: Engine) -> None:
    assert engine.tell(5) is None
    assert engine.tell(60, frames=0, clipped=1.0, fault=FaultState(reason="x", at_utc="")) is None
