"""The contract suite on valid devices, directly and inside wrappers that inject no fault."""

from __future__ import annotations

import pytest

from escape_hw.api.flips import flip_order
from escape_hw.api.mirror import DeformableMirror
from escape_hw.safety.limits import MirrorLimits
from escape_hw.testing import (
    Check,
    Factory,
    FaultyCamera,
    FaultyMirror,
    checks_for,
    parametrize_device_checks,
    run_checks,
)
from escape_hw.testing.reference_devices import (
    IdealPhaseScreen,
    IdealSecondary,
    QuantisedModulator,
    RecordingMirror,
    SyntheticCamera,
)

TIGHT = MirrorLimits(max_stroke=0.8, max_slew=0.05, max_neighbour=0.4, max_mean=0.1, disabled=(3, 20))


def biased_mirror() -> RecordingMirror:
    """Make a mirror whose flat is not zero and which moves slowly."""
    mirror = RecordingMirror("biased", MirrorLimits(max_slew=0.02))
    with mirror:
        mirror.set_flat([0.3] * mirror.info.n_act)
    return mirror


def rewired(mirror: DeformableMirror) -> DeformableMirror:
    """Give a mirror of 21 actuators a hardware that counts column by column and pulls."""
    mirror.order, mirror.polarity = flip_order(RecordingMirror().info.positions_m / 1.5e-3, "transpose"), -1
    return mirror


def turned_camera() -> SyntheticCamera:
    """Make a camera that is mounted upside down."""
    camera = SyntheticCamera()
    camera.flip = "turn-180"
    return camera


FACTORIES: dict[str, Factory] = {
    "mirror": RecordingMirror,
    "mirror-all-limits": lambda: RecordingMirror("tight", TIGHT),
    "mirror-biased": biased_mirror,
    "mirror-wrapped": lambda: FaultyMirror(RecordingMirror("tight", TIGHT)),
    "mirror-biased-wrapped": lambda: FaultyMirror(biased_mirror()),
    "mirror-rewired": lambda: rewired(RecordingMirror("tight", TIGHT)),
    "secondary": IdealSecondary,
    "secondary-rewired": lambda: rewired(IdealSecondary()),
    "camera": SyntheticCamera,
    "camera-turned": turned_camera,
    "camera-wrapped": lambda: FaultyCamera(SyntheticCamera()),
    "modulator": QuantisedModulator,
    "screen": IdealPhaseScreen,
}


@parametrize_device_checks(FACTORIES)
def test_contract(factory: Factory, check: Check) -> None:
    check(factory)


@pytest.mark.parametrize("name", FACTORIES)
def test_suite_runs_without_pytest(name: str) -> None:
    results = run_checks(FACTORIES[name])
    assert len(results) == len(checks_for(FACTORIES[name]())) >= 10
    assert {result.outcome for result in results} == {"passed"}, results


def test_checks_can_be_limited_to_what_moves_little() -> None:
    everything = checks_for(RecordingMirror())
    assert {check.level for check in everything} == {0, 1, 3}
    for level in range(4):
        chosen = checks_for(RecordingMirror(), max_level=level)
        assert chosen == [check for check in everything if check.level <= level]


def test_checks_that_only_read_send_nothing_but_flat() -> None:
    made: list[RecordingMirror] = []

    def factory() -> RecordingMirror:
        made.append(RecordingMirror())
        return made[-1]

    run_checks(factory, max_level=0)
    commands = [command for mirror in made for command in mirror.history]
    assert commands
    assert not any(command.any() for command in commands)


def test_tiny_checks_stay_within_a_percent() -> None:
    made: list[RecordingMirror] = []

    def factory() -> RecordingMirror:
        made.append(RecordingMirror())
        return made[-1]

    run_checks(factory, max_level=1)
    largest = max(abs(command).max() for mirror in made for command in mirror.history)
    assert 0 < largest <= 0.01


def test_mirror_without_a_free_actuator_is_skipped_where_it_must_move() -> None:
    results = run_checks(lambda: RecordingMirror("dead", MirrorLimits(disabled=tuple(range(21)))))
    assert {result.outcome for result in results} == {"passed", "skipped"}, results
    assert all("disabled" in result.message for result in results if result.outcome == "skipped")
