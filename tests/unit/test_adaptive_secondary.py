"""An adaptive secondary follows commands while it runs, and a fault is latched until it is cleared."""

from __future__ import annotations

import numpy as np
import pytest
from small_system import configuration

from escape_hw.api.adaptive_secondary import STATE_ORDER, AdaptiveSecondary, ShellState
from escape_hw.config.registry import DeviceContext
from escape_hw.errors import DeviceError, NotOpen
from escape_sim.devices.twins import SimAdaptiveSecondary, make_secondary
from escape_sim.mirror.shell import FLOATING_GAP_M

QUICK = [
    "devices.dm.layout=maps-336",
    "twin.mirror.settling_s=1e-4",
    "basis.n_modes=20",
    "loop.dropped_modes=0",
]


def twin(*overrides: str) -> SimAdaptiveSecondary:
    return make_secondary(None, DeviceContext("asm", configuration(*QUICK, *overrides)))


def wait(mirror: SimAdaptiveSecondary, seconds: float = 0.05) -> None:
    mirror.twin.advance_to(mirror.twin.now_s + seconds)


def test_opening_leads_to_running_and_closing_to_rest() -> None:
    mirror = twin()
    with mirror:
        assert mirror.state is ShellState.RUNNING
        assert mirror.info.n_act == 336
        assert mirror.info.layout is None
        mirror.send(np.full(336, 0.1))
    with pytest.raises(NotOpen):
        _ = mirror.state
    assert mirror._shell.state is ShellState.RESTED
    assert mirror.sent_count > 0


def test_without_lift_it_stays_where_it_is_and_refuses_commands() -> None:
    with twin("devices.dm.options.lift=false") as mirror:
        assert mirror.state is ShellState.OFF
        with pytest.raises(DeviceError, match=r"is off and follows no commands; call go"):
            mirror.send(np.zeros(336))
        mirror.flatten()  # legal, and nothing to do
        assert mirror.sent_count == 0


@pytest.mark.parametrize("state", STATE_ORDER)
def test_it_goes_to_every_state_and_back(state: ShellState) -> None:
    with twin() as mirror:
        mirror.go_to(state)
        assert mirror.state is mirror.health.state is state
        mirror.go_to(ShellState.RUNNING)
        assert mirror.send(np.full(336, 0.05)).guard.is_unchanged


def test_positions_follow_commands() -> None:
    with twin() as mirror:
        shape = np.linspace(-0.3, 0.3, 336)
        mirror.send(shape)
        wait(mirror)
        measured = mirror.measured_positions()
        stroke = mirror.info.stroke_m
        assert measured == pytest.approx(shape, abs=0.02)
        again = mirror.measured_positions()
        assert 0 < np.std(again - measured) * stroke < 20e-9


def test_measuring_does_not_make_time_pass() -> None:
    watched, alone = twin(), twin()
    with watched, alone:
        for mirror in (watched, alone):
            mirror.send(np.full(336, 0.2))
        wait(watched, 0.001)
        watched.measured_positions()
        start = watched._bench.now_s - 0.001
        means = [m._bench.dynamics.mean(start, start + 0.002) for m in (watched, alone)]
        assert np.allclose(*means, atol=1e-12)


def test_health_shows_the_gap() -> None:
    with twin() as mirror:
        assert mirror.health.gap_m == pytest.approx(FLOATING_GAP_M, rel=0.01)
        mirror.send(np.full(336, 0.3))
        wait(mirror)
        lifted = mirror.health
        assert lifted.gap_m == pytest.approx(FLOATING_GAP_M + 0.3 * mirror.info.stroke_m, rel=0.01)
        assert lifted.current_a > 0.1
        mirror.go_to(ShellState.RESTED)
        assert mirror.health.gap_m < 0.1 * FLOATING_GAP_M
        assert mirror.health.current_a == 0


def test_resting_flattens_first_and_the_guard_starts_from_flat() -> None:
    with twin("devices.dm.limits.max_slew=0.2") as mirror:
        mirror.send(np.full(336, 0.2))
        mirror.go_to(ShellState.RESTED)
        assert not mirror.shape.any()
        mirror.go_to(ShellState.RUNNING)
        assert mirror.send(np.full(336, 0.4)).sent == pytest.approx(0.2)


def test_a_fault_is_latched() -> None:
    mirror = twin()
    mirror.open()
    mirror.send(np.full(336, 0.3))
    mirror.trip("coil 17 over current")
    wait(mirror)
    assert mirror.measured_positions() == pytest.approx(0, abs=0.02)
    assert mirror.health.fault == "coil 17 over current"
    for attempt in (lambda: mirror.send(np.zeros(336)), lambda: mirror.go_to(ShellState.RUNNING)):
        with pytest.raises(DeviceError, match=r"asm: fault latched: coil 17 over current; .* recover\(\)"):
            attempt()
    mirror.flatten()
    mirror.close()
    with pytest.raises(DeviceError, match="fault latched"):
        mirror.open()
    assert not mirror.is_open


def test_recovery_leads_to_rest_and_nothing_rises_by_itself() -> None:
    with twin("devices.dm.options.lift=false") as mirror:
        mirror.go_to(ShellState.RUNNING)
        mirror.trip("dust")
        mirror.recover()
        assert mirror.state is ShellState.RESTED
        assert mirror.health.fault == ""
        mirror.recover()
        mirror.go_to(ShellState.RUNNING)
        assert mirror.send(np.full(336, 0.1)).guard.is_unchanged


def test_a_fault_that_persists_is_reported() -> None:
    class Stubborn(SimAdaptiveSecondary):
        def _recover(self) -> None:
            pass

    with Stubborn("asm", twin()._bench) as mirror:
        mirror.trip("dust")
        with pytest.raises(DeviceError, match="the fault persists: dust"):
            mirror.recover()


def test_a_step_that_fails_is_reported() -> None:
    class Stuck(SimAdaptiveSecondary):
        def _step(self, state: ShellState) -> None:
            if state is not ShellState.SET:
                super()._step(state)

    mirror = Stuck("asm", twin()._bench)
    with pytest.raises(DeviceError, match="is rested, not set, after a step from rested"):
        mirror.open()


def test_no_request_leads_to_a_fault() -> None:
    with twin() as mirror, pytest.raises(ValueError, match="choose off"):
        mirror.go_to(ShellState.FAULT)


def test_positions_of_the_wrong_number_are_refused() -> None:
    class Short(SimAdaptiveSecondary):
        def _measure_positions(self) -> np.ndarray:
            return np.zeros(3)

    with Short("asm", twin()._bench) as mirror, pytest.raises(DeviceError, match=r"shape \(3,\) for 336"):
        mirror.measured_positions()


def test_everything_needs_an_open_mirror() -> None:
    mirror = twin()
    assert isinstance(mirror, AdaptiveSecondary)
    for use in (
        lambda: mirror.health,
        mirror.measured_positions,
        mirror.recover,
        lambda: mirror.go_to(ShellState.SET),
    ):
        with pytest.raises(NotOpen):
            use()
