"""The numbering of the lenslets follows the pupil's edge, and what the light does not decide is stated."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from sensor_frames import N_PIX, SPOT, WAVELENGTH, flat
from small_matrices import CONFIG, GRID, MODEL, TRUTH, measured

from escape_hw.api.sensor import SubApertureGrid
from escape_hw.calibration.sprint.fit import sprint
from escape_hw.io.documents import registration_document
from escape_hw.pipeline.geometry.lenslet_grid import find_lenslet_grid
from escape_hw.report.verdict import Quality, assess
from escape_sim.models.factory import make_fast_model
from escape_sim.optics.shack_hartmann import ShackHartmannOptics

N_SUB, PITCH = 24, 15.55
CERTAIN = ((0, 0), (0, 0))
_line = (np.arange(N_SUB * N_PIX) - (N_SUB * N_PIX - 1) / 2) / N_PIX
X, Y = np.meshgrid(_line, _line)
PUPIL = np.hypot(X, Y) <= N_SUB / 2


def beam(radius: float, x: float = 0.0, y: float = 0.0) -> NDArray[np.float64]:
    """Amplitude of a Gaussian beam; 1/e^2 radius of the intensity and centre in lenslets."""
    return np.exp(-((X - x) ** 2 + (Y - y) ** 2) / radius**2)


def find(amplitude: NDArray[np.floating], columns: int = 400) -> tuple[SubApertureGrid, tuple[int, int]]:
    """Grid in noisy light of this amplitude, and how far its numbering is off."""
    half = PITCH * (N_SUB - 1) / 2
    origin = (199.5 - half + 3.3, 199.5 - half - 2.1)
    optics = ShackHartmannOptics(
        N_SUB, N_PIX, WAVELENGTH, PITCH, SPOT, origin, (400, 400), np.asarray(amplitude, np.float32)
    )
    frame = (flat(optics) + np.random.default_rng(0).normal(0, 0.1, (400, 400)))[:, :columns]
    grid = find_lenslet_grid(
        frame.astype(np.float32), n_sub=N_SUB, nominal_pitch_px=15.54, threshold=4.0, min_flux=0.25
    )
    x, y = (round((a - b) / PITCH) for a, b in zip(grid.origin_px, origin, strict=True))
    return grid, (x, y)


@pytest.mark.parametrize(
    ("radius", "x", "y"),
    [(17.8, 0, 0), (12.4, 2.1, 0), (12.4, 5.3, -5.3), (10.7, 2.1, 0), (10.7, 5.3, -3.6), (14.2, 0, 5.3)],
)
def test_a_beam_beside_the_pupil_does_not_change_the_numbering(radius: float, x: float, y: float) -> None:
    grid, off = find(PUPIL * beam(radius, x, y))
    assert off == (0, 0)
    assert grid.numbering_offsets == CERTAIN


@pytest.mark.parametrize(
    "amplitude",
    [
        PUPIL * (np.hypot(X, Y) > 4.2),
        PUPIL * (np.minimum(np.abs(X), np.abs(Y)) > 0.3),
        np.hypot(X, Y) <= 11.75,
        PUPIL * np.where((X > 10) & (np.abs(Y) < 4), 0.6, 1.0),
    ],
    ids=["obscured", "spiders", "smaller by half a lenslet", "contaminated rim"],
)
def test_the_edge_decides_whatever_is_inside(amplitude: NDArray[np.floating]) -> None:
    grid, off = find(amplitude)
    assert off == (0, 0)
    assert grid.numbering_offsets == CERTAIN


def test_a_region_that_cuts_the_pupil_leaves_the_numbering() -> None:
    grid, off = find(PUPIL * beam(17.8), columns=310)
    assert off == (0, 0)
    assert grid.numbering_offsets == CERTAIN


@pytest.mark.parametrize(
    "amplitude",
    [
        pytest.param(PUPIL * (np.hypot(X - 1.5, Y) <= 12), id="second aperture"),
        pytest.param(
            PUPIL * (np.hypot(X - 3, Y) <= 12), id="second aperture far off", marks=pytest.mark.slow
        ),
        pytest.param(PUPIL * (X > -9), id="straight edge"),
        pytest.param(
            PUPIL * ~((np.hypot(X, Y) > 9.6) & (np.abs(np.arctan2(Y, X)) < 0.9)),
            id="opaque dirt",
            marks=pytest.mark.slow,
        ),
        pytest.param(PUPIL * beam(5), id="dim rim", marks=pytest.mark.slow),
        pytest.param(PUPIL * beam(3), id="dark rim", marks=pytest.mark.slow),
        pytest.param(np.ones_like(X), id="no rim"),
    ],
)
def test_an_ambiguous_outline_is_stated(amplitude: NDArray[np.floating]) -> None:
    grid, off = find(amplitude)
    assert grid.numbering_offsets != CERTAIN
    for wrong_by, (low, high) in zip(off, grid.numbering_offsets, strict=True):
        assert low <= -wrong_by <= high


def test_errors_of_the_registration_include_whole_sub_apertures() -> None:
    certain = sprint(measured(0), MODEL)
    model = make_fast_model(CONFIG, replace(GRID, numbering_offsets=((0, 1), (0, 0))))
    estimate = sprint(measured(0), model)
    assert estimate.converged
    assert estimate.registration == certain.registration
    assert estimate.sigma[0] == pytest.approx(100, rel=0.01)
    assert estimate.sigma[1:] == pytest.approx(certain.sigma[1:])
    assert estimate.repeatability_sigma is not None
    assert estimate.repeatability_sigma[0] == pytest.approx(100, rel=0.01)
    assert "along x is uncertain" in estimate.notes[0]
    assert f"+1 (shift_x {estimate.registration.shift_x - 100:.1f} %)" in estimate.notes[0]
    assert not any("numbering of the lenslets" in note for note in certain.notes)
    verdict = assess(registration_document(estimate))
    assert verdict is not None
    assert verdict.quality is Quality.USABLE
    assert "shift_x is uncertain by 100 %" in verdict.reason
    assert np.abs(certain.registration.shift_x - TRUTH.shift_x) < 5 * certain.sigma[0]


def renumbered_grid(grid: SubApertureGrid, valid: NDArray[np.bool_], offset: int) -> SubApertureGrid:
    """The same lenslets, those of column ``offset`` being the first ones."""
    moved, (x, y) = np.roll(valid, -offset, axis=1), grid.origin_px
    flux = np.roll(grid.flux, -offset, axis=1)
    return replace(
        grid, valid=moved, references_px=np.zeros((int(valid.sum()), 2), np.float32), flux=flux,
        origin_px=(x + offset * grid.pitch_px, y), numbering_offsets=((-offset, 0), (0, 0)),
    )  # fmt: skip


def test_the_next_lenslet_as_the_first_one_has_the_shift_of_the_note() -> None:
    inner = GRID.valid.copy()
    inner[:, [0, -1]] = False
    used = np.tile(inner[GRID.valid], 2)
    matrix = measured(0)
    matrix = replace(matrix, data=matrix.data[used], sigma=matrix.sigma[used], valid=inner)
    here = sprint(matrix, make_fast_model(CONFIG, renumbered_grid(GRID, inner, 0)))
    grid = renumbered_grid(GRID, inner, 1)
    there = sprint(replace(matrix, valid=grid.valid), make_fast_model(CONFIG, grid))
    # The lenslets at the rim of the design's pupil are others.
    assert there.registration.shift_x == pytest.approx(here.registration.shift_x - 100, abs=10)
    assert abs(there.registration.shift_x + 100 - TRUTH.shift_x) < there.sigma[0]
    assert "the shift is smallest with -1" in there.notes[0]
