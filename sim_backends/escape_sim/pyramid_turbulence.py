"""What moves before a pyramid while it is calibrated: turbulence of unknown strength, and known pokes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.pyramid import PyramidPupils
from escape_hw.pipeline.pyramid_slopes import slopes_of_image
from escape_sim.pyramid import PyramidOptics

#: Strengths tried, as pupil diameters over r0; beyond the last the slopes tell them apart no more.
_STRENGTHS = 2.0 ** np.arange(-1, 5, 0.5)
#: What the slopes' rms, relatively, and the share that lasts may be off by in a run of seconds.
_RMS_ERROR, _SHARE_ERROR = 0.05, 0.05
#: Pairs of phase screens tried with each.
_PAIRS = 6
#: Side of the screens in pupils: the outer scale must fit in.
_SIDE = 8


@dataclass(frozen=True, slots=True, eq=False)
class Pokes:
    """Random pokes of many modes at once, new in every frame.

    Parameters
    ----------
    modes_rad
        Phase of every mode's usual poke ``(n_modes, n, n)`` in radians.
    lit
        Samples of the pupil that carry light ``(n, n)``.
    """

    modes_rad: NDArray[np.float64]
    lit: NDArray[np.bool_]

    @classmethod
    def of(
        cls, rms: float, most: NDArray[np.float64], modes_rad: NDArray[np.float64], lit: NDArray[np.bool_]
    ) -> Pokes:
        """Pokes of a given rms over all modes, each as strong as the others unless its actuators forbid.

        Parameters
        ----------
        rms
            Root of the sum of the modes' squared amplitudes.
        most
            Largest amplitude of every mode ``(n_modes,)``.
        modes_rad
            Phase ``(n_modes, n, n)`` of every mode at unit amplitude, in radians.
        lit
            As above.
        """
        low, high = 0.0, float(most.max())
        for _ in range(40):
            level = (low + high) / 2
            below = np.square(np.minimum(level, most)).sum() < rms**2
            low, high = (level, high) if below else (low, level)
        amplitude = np.minimum(high, most)
        amplitude *= rms / np.sqrt(np.square(amplitude).sum())
        return cls(amplitude[:, None, None] * modes_rad, lit)

    @property
    def rms_rad(self) -> float:
        """Rms phase over the pupil in radians, without piston."""
        return float(np.sqrt(self.modes_rad[:, self.lit].var(axis=1).sum()))

    def structure(self) -> NDArray[np.float64]:
        """Structure function in square radians ``(2 n - 1, 2 n - 1)``, by the separation of two samples.

        The mean over all pairs of lit samples so far apart; 0 where the pupil has none.
        """
        n = self.lit.shape[0]
        size = (2 * n, 2 * n)
        lit = np.fft.rfft2(self.lit.astype(float), size)
        squares = np.fft.rfft2(np.square(self.modes_rad).sum(axis=0) * self.lit, size)
        both = sum(np.square(np.abs(np.fft.rfft2(mode * self.lit, size))) for mode in self.modes_rad)
        total = np.fft.irfft2(2 * (np.conj(squares) * lit).real - 2 * both, size)
        pairs = np.fft.irfft2(np.square(np.abs(lit)), size)
        mean = np.where(pairs > 0.5, np.maximum(total, 0) / np.maximum(pairs, 1), 0.0)
        steps = np.arange(1 - n, n)
        return np.asarray(mean[np.ix_(steps, steps)])

    def phases(self, count: int) -> NDArray[np.float64]:
        """Random phases ``(count, n, n)`` in radians; always the same."""
        draws = np.random.default_rng(1).standard_normal((count, len(self.modes_rad)))
        return np.asarray(np.tensordot(draws, self.modes_rad, 1))


def distances(n: int, pixel_m: float) -> NDArray[np.float64]:
    """Distances in metres of all pairs of samples ``(2 n - 1, 2 n - 1)``, by their separation."""
    steps = np.arange(1 - n, n) * pixel_m
    return np.asarray(np.hypot(steps[:, None], steps))


def strength(
    optics: PyramidOptics, pupils: PyramidPupils, outer_scale: float, pokes: Pokes | None = None
) -> float:
    """Pupil diameters over r0 at the sensor's wavelength, from how the slopes moved.

    There is no formula: frames under a few random phases of each strength are made and their slopes
    compared; always the same phases, so that equal motions give equal strengths.

    The slopes of a pyramid saturate: their rms rises with the turbulence at first, and falls again beyond
    some ten r0 across the pupil. Beside random pokes, which are new in every frame, the share of the slopes'
    variance that lasts rises where the rms hardly changes, and the rms falls where the share hardly
    rises; both together tell the strength. Without pokes the rising rms does, up to where it turns.

    Parameters
    ----------
    optics
        The nominal sensor.
    pupils
        Geometry, with the motion measured.
    outer_scale
        Outer scale of the turbulence in pupil diameters.
    pokes
        What the mirror did meanwhile; ``None`` if it was still.

    Returns
    -------
    float
        Between 0 (no motion, or none that lasts) and the strongest that was tried.
    """
    if not pupils.motion:
        return 0.0
    screens = unit_screens(optics.amplitude.shape[0], outer_scale)
    if pokes is None:
        return _by_motion(optics, pupils, screens)
    return _beside(optics, pupils, screens, pokes) if pupils.steady else 0.0


def _by_motion(optics: PyramidOptics, pupils: PyramidPupils, screens: NDArray[np.float64]) -> float:
    """Strength by the slopes' rms, while it rises."""
    told: list[float] = []
    for ratio in _STRENGTHS:
        told.append(float(np.sqrt(np.square(_slopes(optics, pupils, screens * ratio ** (5 / 6))).mean())))
        if len(told) > 1 and told[-1] <= told[-2]:
            told.pop()
            break
        if told[-1] > pupils.motion:
            break
    if pupils.motion <= told[0]:
        # Weak turbulence moves slopes in proportion to the phase.
        return float(_STRENGTHS[0] * (pupils.motion / told[0]) ** (6 / 5))
    return float(2 ** np.interp(pupils.motion, told, np.log2(_STRENGTHS[: len(told)])))


def _beside(
    optics: PyramidOptics, pupils: PyramidPupils, screens: NDArray[np.float64], pokes: Pokes
) -> float:
    """Strength by the slopes' rms and by the share of their variance that lasts, beside pokes."""
    halves = np.split(pokes.phases(2 * len(screens)), 2)
    rms, lasting = [], []
    for ratio in (0.0, *_STRENGTHS):
        first, second = (_slopes(optics, pupils, screens * ratio ** (5 / 6) + half) for half in halves)
        squares = np.mean(np.square([first, second]), axis=(1, 2))
        rms.append(float(np.sqrt(squares.mean())))
        lasting.append(float(np.mean(first * second) / np.sqrt(squares.prod())))
    # Few pokes seem to last by chance; how much, those without turbulence tell.
    lasting = [share - lasting[0] * (1 - share) for share in lasting]
    if pupils.steady <= lasting[1]:
        # A share of the variance goes by the squares.
        return float(_STRENGTHS[0] * (pupils.steady / lasting[1]) ** (3 / 5))
    rms, lasting = rms[1:], lasting[1:]
    at = np.linspace(np.log2(_STRENGTHS[0]), np.log2(_STRENGTHS[-1]), 200)
    by_rms, by_share = (np.interp(at, np.log2(_STRENGTHS), told) for told in (np.log(rms), lasting))
    miss = np.square((by_rms - np.log(pupils.motion)) / _RMS_ERROR)
    miss += np.square((by_share - pupils.steady) / _SHARE_ERROR)
    return float(2 ** at[np.argmin(miss)])


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
