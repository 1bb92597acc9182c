"""Pokes limited by the mirror are used as sent: the matrix stays unbiased."""

from __future__ import annotations

import numpy as np
import pytest
from small_bench import INJECTED, assert_flat, faulty, small

from escape_hw.calibration.docrime.open_loop import docrime_run
from escape_hw.calibration.modes.bases import build_modal_basis
from escape_hw.calibration.push_pull.procedure import push_pull
from escape_hw.calibration.sprint.fit import sprint
from escape_hw.errors import CalibrationError, ConfigError, ProductError
from escape_hw.runtime.procedures.calibration import calibrate_with_method

LIMITS = {
    "stroke": "devices.dm.limits.max_stroke=0.05",
    "tiny stroke": "devices.dm.limits.max_stroke=0.02",
    "slew": "devices.dm.limits.max_slew=0.05",
    "neighbours": "devices.dm.limits.max_neighbour=0.05",
    "mean": "devices.dm.limits.max_mean=0.001",
}
#: Two of them tell nothing that the others do not, most of the time.
SOME = [
    pytest.param(name, marks=pytest.mark.slow if name in ("tiny stroke", "neighbours") else ())
    for name in LIMITS
]


@pytest.mark.parametrize("name", SOME)
def test_docrime_with_shortened_pokes(good, name):
    with faulty("twin.loss_probability=0", LIMITS[name], dm={}) as bench:
        run = bench.run(docrime_run(bench, frames=600, grid=good.grid))
        reached = np.array(bench.dm.reached)
        limits = bench.dm.limits
        m2c = run.result.matrix.m2c
        assert_flat(bench)
    assert run.result.matrix.metrics["clipped_pokes"] > 300
    assert np.abs(reached).max() <= limits.max_stroke
    assert np.abs(np.diff(reached, axis=0)).max() <= (limits.max_slew or 2) + 1e-9
    # What reached the mirror lies in the span of the modes: nothing else can pass for their response.
    assert np.abs(reached - reached @ np.linalg.pinv(m2c).T @ m2c.T).max() < 1e-9
    matrix = run.result.matrix
    errors = (matrix.data - good.matrix.data) / np.hypot(matrix.sigma, good.matrix.sigma)
    assert np.mean(np.square(errors)) == pytest.approx(1, abs=0.5)
    gain = np.vdot(matrix.data, good.matrix.data) / np.vdot(good.matrix.data, good.matrix.data)
    assert gain == pytest.approx(1, abs=0.03)
    estimate = sprint(matrix, good.model, modes=20, covariance=run.solution.covariance)
    assert estimate.converged, estimate.warnings
    assert np.abs((estimate.registration.to_array() - INJECTED) / estimate.sigma).max() < 4


@pytest.mark.parametrize(
    ("method", "frames", "closed_loop"),
    [
        ("docrime", 130, False), ("docrime", 130, True), ("push-pull", 1, False), ("modulated", 100, False),
        pytest.param("escape", 40, False, marks=pytest.mark.slow),
        pytest.param("escape", 40, True, marks=pytest.mark.slow),
    ],
)  # fmt: skip
def test_the_poke_in_the_result_is_the_largest_that_was_applied(good, method, frames, closed_loop):
    with small("twin.loss_probability=0", "calibration.poke_command=0.02") as bench:
        largest = 0.02 / np.abs(build_modal_basis(bench)).max(axis=0).min()
        bench.screen.set(inserted=method != "push-pull")
        options = {"closed_loop": good.run.result} if closed_loop else {"grid": good.grid}
        result = bench.run(calibrate_with_method(bench, method, frames=frames, poke=0.9, **options))
    assert result.matrix.metrics["poke"] == pytest.approx(largest)
    assert f"no mode was poked with 0.9, {largest:.3g} at most: calibration.poke_command, 0.02," in " ".join(
        result.notes
    )


def pushed(good, *limits):
    with small("twin.loss_probability=0", *limits) as bench:
        bench.screen.set(inserted=False)
        matrix = bench.run(push_pull(bench, frames=15, grid=good.grid)).matrix
        assert_flat(bench)
    return matrix


@pytest.fixture(scope="module")
def free(good):
    """The matrix of a mirror without such limits."""
    return pushed(good)


@pytest.mark.parametrize(
    "name", ["stroke", *(pytest.param(name, marks=pytest.mark.slow) for name in LIMITS if name != "stroke")]
)
def test_push_pull_with_shortened_pokes(good, free, name):
    limited = pushed(good, LIMITS[name])
    gain = np.vdot(limited.data, free.data) / np.vdot(free.data, free.data)
    # The spots answer smaller pokes with up to 4 % more: few of their pixels cross the threshold.
    assert gain == pytest.approx(1, abs=0.05)
    errors = (limited.data - free.data) / np.hypot(limited.sigma, free.sigma)
    # Vibration is common to the frames of a push, so the scatter within it understates a little.
    assert np.mean(np.square(errors)) < 4


@pytest.mark.parametrize("disabled", [(0, 5, 6, 7, 20, 30)])
def test_disabled_actuators(disabled):
    numbers = list(disabled)
    with faulty(f"devices.dm.limits.disabled={numbers}", dm={}) as bench:
        run = bench.run(docrime_run(bench, frames=800))
        reached = np.array(bench.dm.reached)
        model = bench.model(run.result.grid)
        m2c = build_modal_basis(bench)
        assert_flat(bench)
    assert not reached[:, numbers].any()
    assert not m2c[numbers].any()
    assert np.linalg.matrix_rank(m2c) == 30
    assert run.result.matrix.snr().min() > 5
    estimate = sprint(run.result.matrix, model, modes=20, covariance=run.solution.covariance)
    assert estimate.converged, estimate.warnings
    assert np.abs((estimate.registration.to_array() - INJECTED) / estimate.sigma).max() < 5


def test_more_modes_than_working_actuators_make():
    disabled = list(range(7))
    with small(f"devices.dm.limits.disabled={disabled}") as bench:
        with pytest.raises(CalibrationError, match="30 modes requested; this mirror of 30 actuators"):
            bench.run(docrime_run(bench, frames=400))
        assert bench.dm.sent_count == 0


def test_a_stored_basis_that_moves_a_disabled_actuator(good, tmp_path):
    from escape_hw.io.fits.matrix import save_matrix

    path = save_matrix(tmp_path / "basis.fits", good.run.result)
    basis = ("basis.kind=file", f"basis.file={path}")
    with small(*basis) as bench:
        np.testing.assert_allclose(build_modal_basis(bench), good.matrix.m2c, rtol=1e-9)
    with (
        small(*basis, "devices.dm.limits.disabled=[3]") as bench,
        pytest.raises(ConfigError, match="disabled"),
    ):
        build_modal_basis(bench)


def test_a_basis_in_a_plain_fits_file(good, tmp_path):
    from astropy.io import fits

    # Any scale will do: columns are brought to unit rms surface.
    fits.writeto(tmp_path / "plain.fits", 3.0 * good.matrix.m2c)
    with small("basis.kind=file", f"basis.file={tmp_path / 'plain.fits'}") as bench:
        np.testing.assert_allclose(build_modal_basis(bench), good.matrix.m2c, rtol=1e-9)


@pytest.mark.parametrize(
    ("data", "message"),
    [(np.zeros(7), "no image with two axes"), (np.full((37, 30), np.nan), "not finite"), (None, "no image")],
)
def test_a_fits_file_that_is_no_basis(tmp_path, data, message):
    from astropy.io import fits

    fits.PrimaryHDU(data).writeto(tmp_path / "odd.fits")
    with (
        small("basis.kind=file", f"basis.file={tmp_path / 'odd.fits'}") as bench,
        pytest.raises(ProductError, match=message),
    ):
        build_modal_basis(bench)


def test_a_basis_file_that_is_not_there(tmp_path):
    with (
        small("basis.kind=file", f"basis.file={tmp_path / 'none.fits'}") as bench,
        pytest.raises(ProductError, match=r"none\.fits"),
    ):
        build_modal_basis(bench)
