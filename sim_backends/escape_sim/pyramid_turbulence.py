"""What moves before a pyramid while it is calibrated: turbulence of unknown strength, and known pokes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import j1

from escape_hw.api.pyramid import PyramidPupils
from escape_hw.pipeline.pyramid_slopes import slopes_of_image
from escape_sim.pyramid import PyramidOptics

#: Strengths tried, as pupil diameters over r0; beyond the last the slopes tell them apart no more.
_STRENGTHS = 2.0 ** np.arange(-1, 5, 0.5)
#: Pairs of phase screens tried with each.
_PAIRS = 6
#: Side of the screens in pupils: the outer scale must fit in.
_SIDE = 8


@dataclass(frozen=True, slots=True)
class Pokes:
    """Random pokes of many modes at once, as a phase that is white up to a highest frequency.

    Parameters
    ----------
    rms_rad
        Rms phase over the pupil in radians.
    cutoff
        Highest frequency in radians per pupil diameter.
    """

    rms_rad: float
    cutoff: float

    @classmethod
    def of(cls, rms_rad: float, n_modes: int, pitches: float) -> Pokes:
        """Pokes on ``n_modes`` modes of a mirror with so many actuator pitches across the pupil.

        ``n`` modes fill the frequencies up to ``4 sqrt(n)`` radians per diameter (area of the pupil
        times area in frequency), but actuators make none beyond ``pi`` per pitch.
        """
        return cls(rms_rad, min(4 * float(np.sqrt(n_modes)), np.pi * pitches))

    def structure(self, distance: NDArray[np.float64]) -> NDArray[np.float64]:
        """Structure function in square radians at distances in pupil diameters.

        ``2 sigma^2 (1 - 2 J1(k r) / (k r))``: a disk of frequencies, transformed.
        """
        x = np.maximum(self.cutoff * np.abs(distance), 1e-9)
        return np.asarray(2 * self.rms_rad**2 * (1 - 2 * j1(x) / x))

    def phases(self, count: int, n: int) -> NDArray[np.float64]:
        """Random phases ``(count, n, n)`` in radians over a pupil of ``n`` samples; always the same."""
        f = 2 * np.pi * np.fft.fftfreq(2 * n) * n
        passed = np.hypot(f[:, None], f) <= self.cutoff
        noise = np.random.default_rng(1).standard_normal((count, 2 * n, 2 * n))
        smooth = np.fft.ifft2(np.fft.fft2(noise) * passed).real[:, :n, :n]
        return np.asarray(smooth * (self.rms_rad / np.sqrt(passed.mean())))


def distances(n: int, pixel_m: float) -> NDArray[np.float64]:
    """Distances in metres of all pairs of samples ``(2 n - 1, 2 n - 1)``, by their separation."""
    steps = np.arange(1 - n, n) * pixel_m
    return np.asarray(np.hypot(steps[:, None], steps))


#: A mirror that is still.
STILL = Pokes(0.0, 1.0)


def strength(optics: PyramidOptics, pupils: PyramidPupils, outer_scale: float, pokes: Pokes = STILL) -> float:
    """Pupil diameters over r0 at the sensor's wavelength, from how the slopes moved.

    There is no formula: frames under a few random phases of each strength are made and their slopes
    compared; always the same phases, so that equal motions give equal strengths. Beside random pokes,
    which are new in every frame, the share of the slopes' variance that lasts tells the strength. Without
    them the slopes' rms does; but the slopes of a pyramid saturate and finally move less again, so that
    from about 20 r0 across the pupil it hardly tells any more.

    Parameters
    ----------
    optics
        The nominal sensor.
    pupils
        Geometry, with the motion measured.
    outer_scale
        Outer scale of the turbulence in pupil diameters.
    pokes
        What the mirror did meanwhile.

    Returns
    -------
    float
        Between 0 (no motion, or none that lasts) and the strongest that was tried.
    """
    n = optics.amplitude.shape[0]
    beside = bool(pokes.rms_rad and pupils.steady)
    target = pupils.steady if beside else pupils.motion
    if not target:
        return 0.0
    screens, poked = unit_screens(n, outer_scale), pokes.phases(4 * _PAIRS, n)
    told: list[float] = []
    for ratio in _STRENGTHS:
        air = screens * ratio ** (5 / 6)
        if beside:
            first, second = (_slopes(optics, pupils, air + half) for half in np.split(poked, 2))
            told.append(float(np.mean(first * second) / np.sqrt(np.mean(first**2) * np.mean(second**2))))
        else:
            told.append(float(np.sqrt(np.square(_slopes(optics, pupils, air)).mean())))
        if len(told) > 1 and told[-1] <= told[-2]:
            told.pop()
            break
        if told[-1] > target:
            break
    if target <= told[0]:
        # Weak turbulence moves slopes in proportion to the phase; a share goes by their squares.
        return float(_STRENGTHS[0] * (target / told[0]) ** (3 / 5 if beside else 6 / 5))
    return float(2 ** np.interp(target, told, np.log2(_STRENGTHS[: len(told)])))


def _slopes(optics: PyramidOptics, pupils: PyramidPupils, phases: NDArray[np.float64]) -> NDArray[np.float64]:
    """Slopes ``(count, n_slopes)`` about their mean under random phases ``(count, n, n)`` in radians."""
    paths = (phases * (optics.wavelength_m / (2 * np.pi))).astype(np.float32)
    slopes = np.array([slopes_of_image(optics.frame(path), pupils) for path in paths])
    return np.asarray((slopes - slopes.mean(axis=0)) * np.sqrt(len(slopes) / (len(slopes) - 1)))


def unit_screens(n: int, outer_scale: float) -> NDArray[np.float64]:
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
