"""The registration is recovered with every modal basis and every solver."""

from __future__ import annotations

import numpy as np
import pytest

from escape_hw.api.results import CalibrationResult
from escape_hw.runtime.session.system import open_system

#: A small bench: 12 x 12 lenslets, 37 actuators, moderate turbulence.
SMALL = (
    "sensor.n_sub=12", "sensor.beam_radius_m=inf", "devices.wfs.region=[220,156,200,200]",
    'devices.dm.layout="circle-7"', "devices.dm.pitches_across_pupil=5.0", "devices.dm.pitch_m=2.7e-3",
    "devices.screen.screen=2", "basis.n_modes=25", "calibration.sprint_modes=25", "loop.dropped_modes=4",
    "twin.wfs.photons_per_frame=2.5e6", "twin.mirror.gain_scatter=0.02",
)  # fmt: skip
INJECTED = np.array([-16.0, -71.0, -0.77, 2.9, 0.0])
#: What counts as found, in the units of the parameters, on sub-apertures twice as wide as the bench's.
NEAR = np.array([1.0, 1.0, 0.1, 0.3, 0.3])


def calibrated(*more: str, frames: int = 400, estimator: str = "auto") -> CalibrationResult:
    with open_system("razor-shwfs", set=[*SMALL, *more], seed=3) as bench:
        result = bench.calibrate(frames=frames, estimator=estimator)
    assert result.registration is not None
    assert result.registration.converged, result.registration.warnings
    errors = result.registration.registration.to_array() - INJECTED
    assert (np.abs(errors) < np.maximum(NEAR, 4 * result.registration.sigma)).all(), errors
    assert (result.registration.sigma < 3 * NEAR).all()
    return result


@pytest.mark.parametrize(
    "kind", ["zonal", *(pytest.param(kind, marks=pytest.mark.slow) for kind in ("kl", "zernike", "fourier"))]
)
def test_every_basis_gives_the_registration(kind):
    result = calibrated(f"basis.kind={kind}")
    assert result.measured is not None
    assert result.matrix.m2c.shape == (37, 25)


@pytest.mark.slow
def test_a_basis_from_a_file_is_the_basis(tmp_path):
    from escape_hw.io.fits.matrix import save_matrix
    from escape_hw.runtime.session.record import BenchRecord

    with open_system("razor-shwfs", set=[*SMALL, "basis.kind=zernike"], seed=3) as bench:
        first = bench.calibrate(frames=400)
        save_matrix(tmp_path / "modes.fits", first, BenchRecord.from_bench(bench).origin())
    again = calibrated("basis.kind=file", f"basis.file={tmp_path / 'modes.fits'}")
    np.testing.assert_allclose(again.matrix.m2c, first.matrix.m2c, rtol=1e-9)


@pytest.mark.parametrize("kind", ["zernike", "fourier"])
@pytest.mark.slow
def test_few_frames_do_with_any_basis(kind):
    result = calibrated(f"basis.kind={kind}", frames=40)
    assert result.measured is None


@pytest.mark.parametrize(
    "solver",
    [
        "registration-only",
        "batches",
        pytest.param("frozen-derivatives", marks=pytest.mark.slow),
        pytest.param("diagonal", marks=pytest.mark.slow),
    ],
)
def test_every_solver_gives_the_registration(solver):
    # These know no unequal actuators and no other shape, so the mirror is like its model here.
    ideal = ("twin.mirror.shape=nominal", "twin.mirror.gain_scatter=0")
    result = calibrated(
        f"calibration.solver={solver}", "calibration.learning_rate=0.3", *ideal, estimator="matrix"
    )
    assert result.measured is not None


@pytest.mark.parametrize("pokes", ["anticorrelated", "equal-snr"])
@pytest.mark.slow
def test_every_kind_of_poke_gives_the_registration(pokes):
    calibrated(f"calibration.pokes={pokes}", frames=60)
