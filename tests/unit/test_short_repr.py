"""What a prompt prints of a result: a few lines that tell what it is, and no arrays."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import fake_results as fake
import numpy as np
import pytest
from synthetic_sweep import SWEPT, synthetic_run

import escape_hw
from escape_hw.api.camera import CameraSettings, Frame, Region
from escape_hw.api.representation import describe_value, short_repr
from escape_hw.api.tracking import TrackResult
from escape_hw.calibration.acquisition.sensor_setup import SensorSetup
from escape_hw.calibration.optical_gain.bootstrap import GainsRun
from escape_hw.io.fits.frames import RecordedFrames
from escape_hw.io.fits.loop import load_loop, save_loop
from escape_hw.io.fits.matrix import load_matrix, save_matrix
from escape_hw.io.fits.telemetry import LoopTelemetry
from escape_hw.paper.experiments import CalibrationComparison
from escape_hw.runtime.sweep.result import analyse_sweep


def track() -> TrackResult:
    result = TrackResult(optical_gain=np.ones(94), optical_gain_sigma=np.ones(94), frames=30_000)
    for second in range(60):
        result.add(seconds=second + 1.0, shift_x=0.1)
    return result


def telemetry() -> LoopTelemetry:
    return LoopTelemetry(np.arange(500), np.zeros(500), np.zeros((500, 912), np.float32), np.zeros((500, 97)))


def frames() -> RecordedFrames:
    counters = [np.arange(3)] * 4
    settings = CameraSettings(Region(0, 0, 400, 400), 0.002, 500.0)
    return RecordedFrames(np.zeros((3, 400, 400), np.uint16), *counters, "camera", "S1", settings)


#: A result, the lines that it may have, and what they must tell.
RESULTS = {
    "InteractionMatrix": (fake.matrix, 1, ("push-pull of razor-shwfs (SIMULATED)", "94 modes", "at worst")),
    "CalibrationResult": (
        fake.calibration, 3, ("10000 frames, 7 lost, 20.0 s", "escape of razor", "shift_x -15."),
    ),
    "partial": (lambda: fake.calibration("docrime", partial=True), 2, ("PARTIAL",)),
    "RegistrationEstimate": (fake.registration, 1, ("deg", "gain 0.98", "converged in 18 iterations")),
    "LoopResult": (fake.loop, 1, ("escape at gain 0.4", "stable", "71.5 nm rms", "0.620 ± 0.012")),
    "TrackResult": (track, 1, ("60 s, 30000 frames", "0 alarms")),
    "nothing tracked": (TrackResult, 1, ("0 s, 0 frames",)),
    "GainsResult": (fake.gains_result, 1, ("of escape: 2 rounds", "converged")),
    "GainsRun": (lambda: GainsRun(fake.gains_result(), fake.calibration()), 2, ("rescaled",)),
    "SweepResult": (
        lambda: analyse_sweep(SWEPT, synthetic_run(0.05), 0.01), 6,
        ("128 loops", "ESCAPE better", "at its best"),
    ),
    "SensorSetup": (lambda: SensorSetup(fake.grid(), np.zeros((400, 400), np.float32)), 1, ("400",)),
    "SubApertureGrid": (fake.grid, 1, ("pitch_px=15.55", "bool[24, 24]")),
    "LoopTelemetry": (telemetry, 1, ("float32[500, 912]",)),
    "RecordedFrames": (frames, 1, ("uint16[3, 400, 400]", "'S1'")),
    "Frame": (lambda: Frame(np.zeros((400, 400), np.uint16), 7, 1, 2), 1, ("index=7",)),
    "Comparison": (
        lambda: CalibrationComparison({f"matrix {n}": fake.calibration() for n in range(3)}), 1,
        ("dict of 3",),
    ),
    "TemporalResponse": (lambda: fake.calibration().response, 1, ("float64[4]",)),
    "MirrorDepartures": (lambda: fake.registration().actuator_corrections, 1, ("float64[97]",)),
}  # fmt: skip


@pytest.mark.parametrize("name", RESULTS)
def test_a_result_is_a_few_lines(name: str) -> None:
    make, lines, told = RESULTS[name]
    text = repr(make())
    assert len(text.splitlines()) <= lines, text
    assert max(map(len, text.splitlines())) < 420, text
    assert "array(" not in text
    assert "..." not in text.replace("(...)", "")
    for words in told:
        assert words in text


def test_products_name_their_file_and_not_their_configuration(tmp_path: Path) -> None:
    path = save_matrix(tmp_path / "im.fits", fake.calibration(), fake.ORIGIN)
    text = repr(load_matrix(path))
    assert text.startswith(f"<MatrixProduct {path}: <CalibrationResult of 10000 frames")
    assert len(text.splitlines()) <= 3
    loop = save_loop(tmp_path / "loop.fits", fake.loop(), "razor-shwfs", True, fake.ORIGIN)
    assert repr(load_loop(loop)).startswith(f"<LoopProduct {loop}: <LoopResult escape")


def has_arrays(name: str) -> bool:
    """Whether a public name is a dataclass with arrays."""
    kind = getattr(escape_hw, name)
    return dataclasses.is_dataclass(kind) and any(
        "NDArray" in str(one.type) for one in dataclasses.fields(kind)
    )


@pytest.mark.parametrize("name", [*filter(has_arrays, escape_hw.__all__)])
def test_no_public_class_prints_its_arrays(name: str) -> None:
    written = getattr(escape_hw, name).__dict__["__repr__"]
    # The generated one leads through functools or reprlib; one of our own is a plain function.
    assert written.__code__.co_filename.endswith(".py")
    assert "escape_hw" in written.__code__.co_filename


def test_values_in_a_few_words() -> None:
    assert describe_value(np.zeros((3, 4), np.float32)) == "float32[3, 4]"
    assert describe_value(1 / 3) == "0.333333"
    assert describe_value("x" * 500) == "500 characters"
    assert describe_value("short") == "'short'"
    assert describe_value([1, 2]) == "[1, 2]"
    assert describe_value(list(range(50))) == "list of 50"
    assert describe_value({"a": np.zeros(1000)}) == "dict of 1"
    assert describe_value(None) == "None"
    assert describe_value(Region(1, 2, 3, 4)) == "Region(x=1, y=2, width=3, height=4)"
    assert short_repr(Region(1, 2, 3, 4)) == repr(Region(1, 2, 3, 4))
