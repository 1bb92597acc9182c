"""Optical gains in closed loop on the small pyramid twin, against the true response around the residuals."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import fake_results as fake
import numpy as np
import pytest
from small_pyramid import SMALL, small

from escape_hw.api.optical_gains import OpticalGains
from escape_hw.api.results import CalibrationResult
from escape_hw.calibration.optical_gain.bootstrap import GainsRun, bootstrap_gains
from escape_hw.calibration.optical_gain.estimator import GainMeasurementLoop, LoopSegment
from escape_hw.calibration.optical_gain.matrix_comparison import projector, slope_weights
from escape_hw.calibration.push_pull.procedure import push_pull
from escape_hw.calibration.sprint.synthetic_matrix import static_light_matrix
from escape_hw.errors import CalibrationError, ConfigError, IncompatibleProduct
from escape_hw.io.fits.matrix import load_matrix, save_matrix
from escape_hw.runtime.session.record import without_turbulence
from escape_hw.runtime.session.system import System, open_system
from escape_sim.devices.true_optical_gains import WavefrontRecorder, get_simulated_bench, true_optical_gains

#: The small twin's light saturates pixels occasionally; the true values are computed without a detector.
DIM = "twin.wfs.photons_per_frame=1.5e6"
POKE = 0.002


@pytest.fixture(scope="module")
def bench() -> Iterator[System]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("escape_sim.optics.detector.Detector.POOL", 1 << 19)
        with small(DIM) as opened:
            yield opened


@pytest.fixture(scope="module")
def baseline(bench: System) -> CalibrationResult:
    with without_turbulence(bench):
        return bench.run(push_pull(bench, frames=10))


@pytest.fixture(scope="module")
def opened(bench: System, baseline: CalibrationResult) -> CalibrationResult:
    """DO-CRIME in open loop, on the baseline's geometry."""
    return bench.calibrate("docrime", frames=2000, grid=baseline.grid)


def scaled(result: CalibrationResult, factor: float) -> CalibrationResult:
    matrix, f = result.matrix, np.float32(factor)
    return replace(result, matrix=replace(matrix, data=matrix.data * f, sigma=matrix.sigma * abs(f)))


def measured(
    bench: System, result: CalibrationResult, frames: int, wavefronts: int, every: int = 1
) -> tuple[LoopSegment, np.ndarray]:
    """Gains at the usual loop gain, and the true values of some modes and wavefronts meanwhile."""
    loop, matrix = GainMeasurementLoop(bench, result, {}), result.matrix
    loop.control.set_gain(bench.config.loop.gain)
    watching = WavefrontRecorder(get_simulated_bench(bench), frames // wavefronts)
    with loop.closed(), closing(watching):
        watching.recording = False
        bench.run(loop.measure(300, np.full(matrix.n_modes, POKE), "settling"))
        watching.recording = True
        segment = bench.run(loop.measure(frames, np.full(matrix.n_modes, POKE), "gains"))
    rows = projector(matrix, slope_weights(matrix))
    modes = list(range(0, matrix.n_modes, every))
    return segment, true_optical_gains(
        get_simulated_bench(bench), result.grid, matrix.m2c, rows, watching.wavefronts, modes
    )[:, modes]


def assert_true(segment: LoopSegment, truth: np.ndarray, every: int = 1) -> None:
    """Bias at most 1 % plus the stated error of the common scale, and correct errors of single modes."""
    assert segment.gains is not None
    value, sigma = segment.gains.value[0][::every], segment.gains.sigma[0][::every]
    mean, error = truth.mean(axis=0), truth.std(axis=0, ddof=1) / np.sqrt(len(truth))
    # Weaker than on the calm beam, and not by the same for every mode.
    assert (mean < 0.98).mean() > 0.8
    bias = float(np.average(value / mean - 1, weights=sigma**-2))
    assert segment.gains.common_sigma < 0.008
    assert abs(bias) < 0.01 + 2 * segment.gains.common_sigma
    pulls = (value / mean / (1 + bias) - 1) / np.hypot(sigma / value, error / mean)
    assert 0.1 < np.mean(pulls**2) < 2.0


@pytest.mark.slow
def test_gains_are_those_of_the_frozen_residuals(bench: System, baseline: CalibrationResult) -> None:
    segment, truth = measured(bench, baseline, 6000, 100)
    assert_true(segment, truth)
    assert segment.gains is not None
    assert np.median(segment.gains.sigma) < 0.01


@pytest.mark.campaign
@pytest.mark.timeout(1800)
def test_gains_of_the_bench_are_those_of_the_frozen_residuals() -> None:
    with open_system("razor-pywfs") as bench:
        grid = bench.calibrate("escape", frames=300).grid
        result = bench.calibrate("push-pull", frames=4, grid=grid)
        assert_true(*measured(bench, result, 6000, 40, every=6), every=6)


@pytest.mark.slow
def test_small_pokes_use_the_response_measured_with_larger_ones(
    bench: System, baseline: CalibrationResult
) -> None:
    loop = GainMeasurementLoop(bench, baseline, {})
    loop.control.set_gain(bench.config.loop.gain)
    modes = baseline.matrix.n_modes
    with loop.closed():
        large, small = (
            bench.run(loop.measure(600, np.full(modes, poke), "gains")).gains for poke in (POKE, POKE / 6)
        )
    assert large is not None
    assert small is not None
    # By themselves they tell the common scale to 5.6 %.
    assert small.common_sigma <= large.common_sigma < 0.04
    values, sigmas = zip(large.mean(), small.mean(), strict=True)
    assert abs(values[1] - values[0]) < 4 * np.hypot(*sigmas)


def gains_of(run: GainsRun) -> OpticalGains:
    assert run.result.gains is not None
    return run.result.gains


@pytest.mark.slow
def test_bootstrap_converges_from_any_scale_to_the_same_matrix(
    bench: System, baseline: CalibrationResult, opened: CalibrationResult
) -> None:
    levels = {}
    for factor in (0.3, 3.0):
        run = bench.run(
            bootstrap_gains(
                bench,
                scaled(opened, factor),
                accuracy=0.03,
                frames=5000,
                comparisons={"baseline": baseline.matrix},
            )
        )
        result = run.result
        assert result.converged, result.notes
        assert not bench.dm.shape.any()
        pokes = [one.poke for one in result.rounds]
        assert pokes == sorted(pokes, reverse=True)
        assert pokes[-1] <= POKE
        assert result.rounds[-1].strehl_loss <= 0.01 * (1 + 1e-9)
        # Nor do the larger pokes before dominate the residual.
        assert max(one.strehl_loss for one in result.rounds) <= 0.2 * (1 + 1e-9)
        # The loop was closed from below: nothing tried was unstable.
        assert all(step.stable for step in result.closure)
        gains, beside = gains_of(run), result.comparisons["baseline"]
        assert np.median(gains.best) * factor > 1
        assert 0.5 < np.median(beside.best) < 1
        levels[factor] = np.abs(run.rescaled_calibration.matrix.data).mean(axis=0)
    np.testing.assert_allclose(levels[0.3], levels[3.0], rtol=0.25)
    assert np.median(levels[0.3] / levels[3.0]) == pytest.approx(1, abs=0.05)


def test_a_matrix_of_the_wrong_sign_is_reported(bench: System, baseline: CalibrationResult) -> None:
    with pytest.raises(CalibrationError, match=r"a sign is wrong"):
        bench.run(bootstrap_gains(bench, scaled(baseline, -1.0)))
    assert not bench.dm.shape.any()


def test_a_mirror_out_of_the_beam_is_reported(bench: System, baseline: CalibrationResult) -> None:
    shuffled = np.random.default_rng(0).permutation(baseline.matrix.n_slopes)
    other = replace(baseline, matrix=replace(baseline.matrix, data=baseline.matrix.data[shuffled]))
    with pytest.raises(CalibrationError, match=r"cannot be closed"):
        bench.run(bootstrap_gains(bench, other))
    assert not bench.dm.shape.any()


@pytest.mark.slow
def test_turbulence_beyond_the_sensor_is_reported(baseline: CalibrationResult) -> None:
    # The strongest screen, whose r0 is a seventh of an actuator's pitch.
    with small(DIM, "devices.screen.screen=0", "sensor.modulation=3.0") as bench:
        with pytest.raises(CalibrationError, match=r"does not close|cannot be closed|stay closed"):
            bench.run(bootstrap_gains(bench, baseline, frames=2000, gain=0.9))
        assert not bench.dm.shape.any()


def test_numbers_that_mean_nothing_and_strangers_are_refused(
    bench: System, baseline: CalibrationResult
) -> None:
    for wrong in ({"poke": 0.0}, {"accuracy": -1.0}, {"allowed_strehl_loss": 1.0}, {"gain": 0.0}):
        with pytest.raises(ConfigError, match="must lie between 0 and 1"):
            bench.run(bootstrap_gains(bench, baseline, **wrong))
    valid = baseline.matrix.valid.copy()
    valid[np.nonzero(valid)[0][0], np.nonzero(valid)[1][0]] = False
    keep = np.delete(np.arange(baseline.matrix.n_slopes), [0, baseline.matrix.n_slopes // 2])
    stranger = replace(
        baseline.matrix, data=baseline.matrix.data[keep], sigma=baseline.matrix.sigma[keep], valid=valid
    )
    with pytest.raises(IncompatibleProduct, match="pp was measured on other"):
        bench.run(bootstrap_gains(bench, baseline, comparisons={"pp": stranger}))


@pytest.mark.slow
def test_the_command_keeps_gains_and_matrix(
    bench: System, baseline: CalibrationResult, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from escape_hw.cli.app import run
    from escape_hw.report.content import read_run
    from escape_hw.runtime.session.record import BenchRecord

    im = save_matrix(tmp_path / "pp.fits", baseline, BenchRecord.from_bench(bench).origin())
    words = [word for one in (*SMALL, DIM) for word in ("--set", one)]
    out = tmp_path / "run"
    options = ["--frames", "900", "--accuracy", "0.2", "--no-strehl", "--out", out]
    options += ["--other-matrices", im, "--json"]
    with pytest.raises(SystemExit) as ended:
        run([str(word) for word in ("gains", "razor-pywfs", "--im", im, *options, *words)])
    document = json.loads(capsys.readouterr().out)
    assert ended.value.code == 0, document
    assert document["converged"] is True
    assert len(document["optical_gain"]) == len(document["sigma"]) == 20
    assert document["rounds"][-1]["poke"] <= POKE
    # The same matrix beside itself has the same gains.
    assert document["beside"]["pp"]["optical_gain"] == pytest.approx(document["optical_gain"])
    found = load_matrix(out / "im.fits").matrix.data / baseline.matrix.data
    assert np.median(found, axis=0) == pytest.approx(document["optical_gain"], rel=1e-3)
    content = read_run(out)
    assert content.gains["push-pull"].converged
    page = (out / "report.html").read_text(encoding="utf-8")
    assert "Optical gains" in page


@pytest.mark.slow
def test_another_matrix_lends_its_shape(
    bench: System, baseline: CalibrationResult, opened: CalibrationResult
) -> None:
    """The result's gains are those of the matrix that closed the loop; the other one has its own."""
    shape = scaled(baseline, 2.0).matrix
    run = bench.run(
        bootstrap_gains(
            bench,
            opened,
            accuracy=0.2,
            frames=900,
            closed_loop_matrix=shape,
            comparisons={"baseline": baseline.matrix},
        )
    )
    assert list(run.result.comparisons) == ["baseline"]
    share = run.rescaled_calibration.matrix.data / baseline.matrix.data
    # Half the gain of the same matrix at half the size.
    np.testing.assert_allclose(
        np.median(share, axis=0), np.maximum(run.result.comparisons["baseline"].best, 0.15), rtol=1e-3
    )
    assert np.median(gains_of(run).best) > 1


@pytest.mark.slow
def test_only_a_matrix_of_the_model_has_a_shape_for_a_flat_wavefront(
    bench: System, baseline: CalibrationResult
) -> None:
    assert static_light_matrix(bench, baseline) is None
    # Lenslets answer alike at rest.
    assert static_light_matrix(bench, fake.calibration()) is None
    made = bench.calibrate("escape", frames=900)
    calm = static_light_matrix(bench, made)
    assert calm is not None
    np.testing.assert_array_equal(calm.m2c, made.matrix.m2c)
    # At rest a pyramid answers more strongly than under turbulence.
    assert np.median(calm.data.std(axis=0) / made.matrix.data.std(axis=0)) > 1.1
