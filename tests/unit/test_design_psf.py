"""The design PSF is that of the telescope, with the flux of its pupil."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import special

from escape_hw.pipeline.psf.strehl import diffraction_psf, strehl_ratios
from escape_sim.optics.focal_plane import FocalPlane


def disk(n: int, hole: float = 0.0) -> np.ndarray:
    line = np.arange(n) - (n - 1) / 2
    r = np.hypot(line[:, None], line)
    return (r <= n / 2) & (r >= hole * n / 2)


@pytest.mark.parametrize("hole", [0.0, 0.3])
def test_it_is_the_airy_pattern(hole: float) -> None:
    image = diffraction_psf(disk(200, hole), 200.0, 3.0, (64, 96))
    x = math.pi * (np.arange(96) - 48) / 3.0
    x[48] = 1e-9

    def jinc(v: np.ndarray) -> np.ndarray:
        return 2 * special.j1(v) / v

    airy = ((jinc(x) - hole**2 * jinc(hole * x if hole else x)) / (1 - hole**2)) ** 2
    assert image[32] / image.max() == pytest.approx(airy, abs=4e-3)
    assert np.unravel_index(image.argmax(), image.shape) == (32, 48)


def test_its_light_sums_to_one() -> None:
    assert diffraction_psf(disk(60), 60.0, 2.5, (150, 150)).sum() == pytest.approx(1, abs=1e-5)


def test_a_flat_wavefront_has_a_strehl_ratio_of_one() -> None:
    pupil = disk(60, 0.11)
    seen = FocalPlane(pupil.astype(np.float32), 60.0, 1.4e-6, 2.5, (128, 128)).image(
        np.zeros((60, 60), np.float32)
    )
    assert strehl_ratios(seen, diffraction_psf(pupil, 60.0, 2.5, (128, 128))) == pytest.approx(1.0, abs=1e-4)
