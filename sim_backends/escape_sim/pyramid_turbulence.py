"""How strong the turbulence is that makes a pyramid's slopes move so much."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.pyramid import PyramidPupils
from escape_hw.pipeline.pyramid_slopes import slopes_of_image
from escape_sim.pyramid import PyramidOptics

#: Strengths tried, as pupil diameters over r0.
_STRENGTHS = 2.0 ** np.arange(-1, 5.5, 0.5)
#: Pairs of phase screens tried with each.
_PAIRS = 6
#: Side of the screens in pupils: the outer scale must fit in.
_SIDE = 8


def distances(n: int, pixel_m: float) -> NDArray[np.float64]:
    """Distances in metres of all pairs of samples ``(2 n - 1, 2 n - 1)``, by their separation."""
    steps = np.arange(1 - n, n) * pixel_m
    return np.asarray(np.hypot(steps[:, None], steps))


def strength(optics: PyramidOptics, pupils: PyramidPupils, outer_scale: float) -> float:
    """Pupil diameters over r0 at the sensor's wavelength, from ``pupils.motion``.

    There is no formula: frames under a few random phases of each strength are made and their slopes'
    rms over time compared. Always the same phases, so that equal motions give equal strengths. The
    slopes of a pyramid saturate and finally move less again, so that from about 20 r0 across the
    pupil the motion hardly tells the strength any more.

    Parameters
    ----------
    optics
        The nominal sensor.
    pupils
        Geometry, with the motion measured.
    outer_scale
        Outer scale of the turbulence in pupil diameters.

    Returns
    -------
    float
        Between 0 (no motion) and the strength that moves the slopes most.
    """
    if not pupils.motion:
        return 0.0
    n = optics.amplitude.shape[0]
    paths = _unit_screens(n, outer_scale) * (optics.wavelength_m / (2 * np.pi))
    moved = []
    for ratio in _STRENGTHS:
        slopes = [
            slopes_of_image(optics.frame((path * ratio ** (5 / 6)).astype(np.float32)), pupils)
            for path in paths
        ]
        moved.append(float(np.sqrt(np.var(slopes, axis=0, ddof=1).mean())))
        if len(moved) > 1 and moved[-1] <= moved[-2]:
            moved.pop()
            break
    if pupils.motion <= moved[0]:
        # Weak turbulence moves slopes in proportion to the phase.
        return float(_STRENGTHS[0] * (pupils.motion / moved[0]) ** (6 / 5))
    return float(2 ** np.interp(pupils.motion, moved, np.log2(_STRENGTHS[: len(moved)])))


def _unit_screens(n: int, outer_scale: float) -> NDArray[np.float64]:
    """Von Kármán phases ``(2 * _PAIRS, n, n)`` in radians with a pupil of one r0."""
    size = _SIDE * n
    f = np.hypot(*np.meshgrid(np.fft.fftfreq(size), np.fft.fftfreq(size))) * n
    # 0.0229 r0^(-5/3) (f^2 + L0^-2)^(-11/6), in pupil diameters.
    amplitude = np.sqrt(0.0229) * (f**2 + outer_scale**-2) ** (-11 / 12) / _SIDE
    rng = np.random.default_rng(0)
    screens = []
    for _ in range(_PAIRS):
        noise = rng.standard_normal((size, size)) + 1j * rng.standard_normal((size, size))
        both = np.fft.fft2(noise * amplitude)[:n, :n]
        screens += [both.real, both.imag]
    return np.stack(screens)
