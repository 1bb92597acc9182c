"""Files written by version 0.1.0 stay readable: products, run folders, interrupted runs."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from escape_hw.calibration.acquisition import checkpoint
from escape_hw.calibration.modes import bases
from escape_hw.io.fits.gains import load_gains
from escape_hw.io.fits.loop import load_loop
from escape_hw.io.fits.matrix import load_matrix
from escape_hw.io.fits.run_state import load_state
from escape_hw.io.run_folder import read_result
from escape_hw.streams.recording.block_file import read_recording

OLD = Path(__file__).parents[1] / "data" / "0.1.0"
RUNS = ("escape", "gains", "loop", "push-pull", "sprint", "track")
MATRICES = (
    "escape/im.fits",
    "escape/docrime.fits",
    "push-pull/im.fits",
    "sprint/escape.fits",
    "track/im.fits",
)


def reported(run: str) -> dict[str, Any]:
    result: dict[str, Any] = json.loads((OLD / run / "result.json").read_text())
    return result


def test_a_matrix_has_the_registration_that_its_run_reported():
    result, run = load_matrix(OLD / "escape" / "im.fits").result, reported("escape")
    assert result.registration is not None
    for name, estimate in result.registration.parameters().items():
        expected = run["registration"][name]
        assert (estimate.value, estimate.sigma) == pytest.approx((expected["value"], expected["sigma"]))
    assert result.registration.converged
    assert result.registration.gain.value == pytest.approx(run["gain"])
    assert list(result.response.weights) == pytest.approx(run["response"]["weights"], rel=1e-4)
    assert result.measured.snr().min() == pytest.approx(run["snr"]["min"], rel=1e-5)


@pytest.mark.parametrize("name", MATRICES)
def test_a_matrix_is_read(name):
    matrix = load_matrix(OLD / name).matrix
    assert matrix.data.shape == (240, 12)
    assert np.isfinite(matrix.data).all()
    assert (matrix.sigma > 0).all()


def test_optical_gains_are_those_that_their_run_reported():
    result, run = load_gains(OLD / "gains" / "gains.fits").result, reported("gains")
    assert list(result.gains.best) == pytest.approx(run["optical_gain"])
    assert [one.poke for one in result.rounds] == pytest.approx([one["poke"] for one in run["rounds"]])
    assert result.converged


def test_a_loop_has_the_strehl_ratio_that_its_run_reported():
    strehl = load_loop(OLD / "loop" / "loop.fits").result.strehl
    assert strehl is not None
    assert strehl.peak.value == pytest.approx(reported("loop")["strehl"]["peak"]["value"])


def test_recorded_frames_are_read():
    (recording,) = read_recording(OLD / "telemetry" / "psf.blocks")
    assert recording.data.shape[1:] == (128, 128)


@pytest.mark.usefixtures("undrawn")
@pytest.mark.parametrize("run", RUNS)
def test_a_run_is_shown_and_its_report_built_again(run, escape, document, tmp_path):
    folder = tmp_path / run
    shutil.copytree(OLD / run, folder)
    code, found, _ = document("show", folder)
    assert (code, found["command"]) == (0, reported(run)["command"])
    code, _, err = escape("report", folder)
    assert code == 0, err
    page = (folder / "report.html").read_text()
    assert run != "escape" or "−0.77" in page  # the true rotation of the simulation


@pytest.mark.parametrize("name", [*MATRICES, "gains/gains.fits", "loop/loop.fits"])
def test_a_product_is_shown(name, document):
    code, found, _ = document("show", OLD / name)
    assert (code, found["header"]["SOFTVER"]) == (0, "0.1.0")


def test_matrices_are_compared(document):
    code, found, _ = document("compare", OLD / "escape" / "docrime.fits", OLD / "escape" / "im.fits")
    assert code == 0
    assert min(found["correlation"]) > 0.9


def test_an_interrupted_calibration_in_another_basis_is_refused(document, tmp_path):
    """The modes of this system, 12 of 37, contain tip, tilt and focus better than those of 0.1.0."""
    run = tmp_path / "interrupted"
    shutil.copytree(OLD / "interrupted", run)
    code, _, err = document("calibrate", "--resume", run, "--frames", 40800, "--out", tmp_path / "resumed")
    assert code == 2
    assert "its modal basis is not this system's" in err
    assert "finish a run of 0.1.0 with that version" in err
    assert (run / "run.state").read_bytes() == (OLD / "interrupted" / "run.state").read_bytes()


@pytest.mark.slow
@pytest.mark.usefixtures("undrawn")
def test_an_interrupted_calibration_is_resumed(document, tmp_path, monkeypatch):
    """As one of a system whose modes are those of 0.1.0: here the response that a mode needs is the best.

    They are equal but for the last digits, which depend on the processor, and with them the hash of 0.1.0.
    """
    run = tmp_path / "interrupted"
    shutil.copytree(OLD / "interrupted", run)
    monkeypatch.setattr(bases, "_LEAST_RESPONSE", 1.0)
    basis = load_state(run / "run.state").identity["basis"]
    monkeypatch.setattr(checkpoint, "fingerprint", lambda _: basis)
    code, found, err = document(
        "calibrate", "--resume", run, "--frames", 40800, "--out", tmp_path / "resumed"
    )
    assert code == 0, err
    assert found["frames"] >= 40800
    assert found["converged"]


def test_a_tracked_run_has_its_time_series(document):
    code, found, _ = document("show", OLD / "track")
    assert code == 0
    assert found["track"]["seconds"] == reported("track")["track"]["seconds"]


def test_a_result_is_read_with_the_present_names_of_its_keys():
    found, stored = read_result(OLD / "escape"), reported("escape")
    assert found["injected"] == stored["planted"]
    assert "planted" not in found
    assert read_result(OLD / "track")["injected_end"] == reported("track")["planted_end"]
