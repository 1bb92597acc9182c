"""A tenth of a second in open loop on a faulty bench: correct within the errors, or refused."""

from __future__ import annotations

import numpy as np
import pytest
from small_bench import INJECTED, assert_flat, dead, small

from escape_hw.api.registration import PARAMETERS
from escape_hw.calibration.escape.method import escape
from escape_hw.calibration.sprint import fit
from escape_hw.calibration.sprint.orientation import find_better_orientation
from escape_hw.errors import CalibrationError
from escape_hw.runtime.session.system import open_system

FRAMES = 50
SEEDS = [(1,), pytest.param((1, 2, 3), marks=pytest.mark.slow)]
#: Faults of the quick suite; pokes that are clipped and actuators that are disabled are in test_limits.
SOME = ("lost frames", "dead actuators that nobody knows")
FAULTS = {
    "lost frames": ["twin.loss_probability=0.1"],
    "vibration": ["twin.vibration.amplitude_rad=[6e-5]", "twin.vibration.frequency_hz=[31.0]"],
    "clipped pokes": ["devices.dm.limits.max_stroke=0.05"],
    "dead actuators that nobody knows": [],
    "disabled actuators": ["devices.dm.limits.disabled=[3,18]"],
}


def measured(*more: str, seed: int, broken: tuple[int, ...] = (), frames: int = FRAMES):
    with small(*more) as bench:
        bench.rng = np.random.default_rng(seed)
        dead(bench, *broken)
        try:
            return bench.run(escape(bench, frames=frames))
        finally:
            assert_flat(bench)


@pytest.mark.parametrize("seeds", SEEDS, ids=["one", "three"])
@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=() if name in SOME else pytest.mark.slow) for name in FAULTS]
)
def test_right_within_its_errors(name, seeds):
    pulls = []
    for seed in seeds:
        found = measured(*FAULTS[name], seed=seed, broken=(18, 25) if "dead" in name else ())
        assert found.registration.converged, found.registration.warnings
        if name == "clipped pokes":
            assert found.matrix.metrics["clipped_pokes"] > FRAMES / 2
        pulls.append((found.registration.registration.to_array() - INJECTED) / found.registration.sigma)
    assert np.abs(pulls).max() < 5
    # Under this vibration, four times the usual, the scalings come out 0.2 % too small, 2.5 errors.
    assert np.mean(np.square(pulls)) < 6


@pytest.mark.parametrize("frames", [30, 50])
def test_a_mirror_of_another_shape_is_not_vouched_for(frames):
    """A plate on springs, described as a rounded exponential; of 30 frames the residual is all noise."""
    found = measured("twin.mirror.shape=thin-plate", seed=1, frames=frames).registration
    pulls = (found.registration.to_array() - INJECTED) / found.sigma
    assert np.abs(pulls).max() < 4
    assert found.model_fits is (None if frames < 44 else False)
    noted = any("whether the model fits to within the noise is not judged" in note for note in found.notes)
    assert noted == (frames < 44)


#: Frames, seed and imperfections for which the scalings were once wrong by five to nine stated errors, with
#: the outcome "converged" and nothing said.
OTHER_SHAPES = {
    "fifty frames": (50, 6, ()),
    "a hundred frames": (100, 7, ()),
    "two hundred frames": (200, 6, ()),
    "clocked, and coupling 0.3": (150, 13, ("twin.mirror.coupling=0.3", "twin.wfs.clocking_deg=0.3")),
    "beam off centre": (100, 12, ("twin.beam.centre_m=[0.7e-3,0.5e-3]",)),
    "distorted": (100, 14, ("twin.wfs.distortion=0.01",)),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", OTHER_SHAPES)
def test_a_mirror_of_another_shape_on_the_full_bench(name):
    frames, seed, more = OTHER_SHAPES[name]
    with open_system("razor-shwfs", set=["twin.mirror.shape=thin-plate", *more], seed=seed) as bench:
        found = bench.calibrate("escape", frames=frames).registration
        injected = bench.config.twin.registration
    true = [getattr(injected, parameter) for parameter in PARAMETERS]
    assert np.abs((found.registration.to_array() - true) / found.sigma).max() < 4
    assert not found.model_fits
    if frames >= 100:
        assert found.outcome == "converged, but the model does not fit"


@pytest.mark.parametrize("more", [(), ("twin.mirror.shape=thin-plate",)], ids=["healthy", "another shape"])
def test_no_orientation_is_named_where_it_is_right(more, monkeypatch):
    """Other orientations are tried for the final result only; every result has a warning here."""
    searches = []

    def search(*arguments):
        searches.append(find_better_orientation(*arguments))
        return searches[-1]

    monkeypatch.setattr(fit, "check_fit", lambda *_: ["a warning"])
    monkeypatch.setattr(fit, "find_better_orientation", search)
    found = measured(*more, seed=1, frames=20).registration
    assert searches == [None]
    assert found.warnings[0] == "a warning"


@pytest.mark.parametrize("flip", ["left-right", pytest.param("turn-90", marks=pytest.mark.slow)])
def test_a_turned_camera_is_named(flip):
    found = measured(f"twin.wfs.flip={flip}", seed=2, frames=30).registration
    assert not found.converged
    assert f"devices.wfs.flip = '{flip}'" in found.warnings[0]


def refused_or_not_converged(*more: str, seed: int) -> bool:
    try:
        registration = measured(*more, seed=seed).registration
    except CalibrationError as error:
        return "noise" in str(error)
    return not registration.converged and bool(registration.warnings)


@pytest.mark.parametrize("seeds", SEEDS, ids=["one", "three"])
@pytest.mark.parametrize(
    "more",
    [
        pytest.param(
            ("twin.latency_s=0.006", "calibration.lags=3"),
            id="answers after all lags",
            marks=pytest.mark.slow,
        ),
        pytest.param(("twin.latency_s=0.006",), id="answers with the last lag", marks=pytest.mark.slow),
        pytest.param(("devices.dm.stroke_m=1e-12",), id="does not answer", marks=pytest.mark.slow),
    ],
)
def test_no_calibration_comes_of_it(more, seeds):
    for seed in seeds[:2]:
        assert refused_or_not_converged(*more, seed=seed)
