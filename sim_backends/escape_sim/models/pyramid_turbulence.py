"""Turbulence and random pokes in front of a pyramid, in open and in closed loop.

Their statistics, the turbulence strength estimated from the motion of the slopes, and the registration
scatter that a finite number of turbulence states leaves.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.pyramid import PyramidPupils
from escape_hw.pipeline.slopes.pyramid import slopes_of_image
from escape_sim.atmosphere.von_karman import structure_function
from escape_sim.optics.pyramid import PyramidOptics

#: Trial strengths in pupil diameters over r0; beyond the last the slopes no longer distinguish them.
_TRIAL_STRENGTHS = 2.0 ** np.arange(-1, 5, 0.5)
#: Pairs of phase screens per trial strength.
_N_PAIRS = 6
#: Side of the screens in pupils; must contain the outer scale.
_SCREEN_PUPILS = 8
#: Rms tilt in radians whose response tells how much tilt a loop leaves; small enough to be linear.
_TILT_RAD = 0.1


@dataclass(frozen=True, slots=True, eq=False)
class PokePhase:
    """Random pokes of many modes at once, new in every frame."""

    #: Phase ``(n_modes, n, n)`` in radians of each mode at its rms amplitude.
    modes_rad: NDArray[np.float64]
    #: Lit samples of the pupil ``(n, n)``.
    lit: NDArray[np.bool_]

    @classmethod
    def from_rms(
        cls,
        rms: float,
        max_amplitude: NDArray[np.float64],
        modes_rad: NDArray[np.float64],
        lit: NDArray[np.bool_],
    ) -> PokePhase:
        """Pokes of a given rms over all modes, of equal amplitude except for modes at their maximum.

        ``rms`` is the root of the sum of the modes' squared amplitudes, ``max_amplitude (n_modes,)`` the
        largest amplitude of every mode, ``modes_rad`` the modes at unit amplitude.
        """
        lower, upper = 0.0, float(max_amplitude.max())
        for _ in range(40):
            level = (lower + upper) / 2
            below = np.square(np.minimum(level, max_amplitude)).sum() < rms**2
            lower, upper = (level, upper) if below else (lower, level)
        amplitude = np.minimum(upper, max_amplitude)
        amplitude *= rms / np.sqrt(np.square(amplitude).sum())
        return cls(amplitude[:, None, None] * modes_rad, lit)

    def pair_structure(self) -> NDArray[np.float32]:
        """Structure function of all pairs of lit samples ``(k, k)`` in rad^2."""
        inside = self.modes_rad[:, self.lit].astype(np.float32)
        return _structure_of(inside.T @ inside)

    def phases(self, count: int) -> NDArray[np.float64]:
        """Random phases ``(count, n, n)`` in radians, from a fixed seed."""
        draws = np.random.default_rng(1).standard_normal((count, len(self.modes_rad)))
        return np.asarray(np.tensordot(draws, self.modes_rad, 1))


def _structure_of(covariance: NDArray[np.float32]) -> NDArray[np.float32]:
    """Structure function of all pairs ``(k, k)`` of phases with a covariance."""
    variance = np.diag(covariance)
    return np.asarray(variance[:, None] + variance - 2 * covariance)


def sample_distances(n: int, pixel_m: float) -> NDArray[np.float64]:
    """Distances in metres of all pairs of samples ``(2 n - 1, 2 n - 1)``, by their separation."""
    steps = np.arange(1 - n, n) * pixel_m
    return np.asarray(np.hypot(steps[:, None], steps))


class Turbulence:
    """Turbulence over the pupil; a closed loop leaves a fraction of what its modes correct.

    Parameters
    ----------
    outer_scale
        In pupil diameters.
    distances
        Distances of two samples in pupil diameters ``(2 n - 1, 2 n - 1)``, by their separation.
    lit
        Lit samples of the pupil ``(n, n)``.
    modes
        Shapes of the corrected modes ``(n_modes, n, n)``, in any unit.
    """

    def __init__(
        self,
        outer_scale: float,
        distances: NDArray[np.float64],
        lit: NDArray[np.bool_],
        modes: NDArray[np.float64] | None = None,
    ) -> None:
        self._outer_scale, self._distances, self._lit = outer_scale, distances, lit
        self._uncorrected = self._corrected = unit_screens(lit.shape[0], outer_scale)
        self._basis: NDArray[np.float64] | None = None
        if modes is not None:
            columns = np.vstack([modes[:, lit], np.ones(np.count_nonzero(lit))]).T
            # Orthonormal modes and piston over the lit samples ``(k, n_modes + 1)``.
            self._basis = np.linalg.qr(columns)[0]
            self._corrected = _remove(self._basis, self._uncorrected, lit)
        #: Fraction of the amplitude of the corrected modes that is left; 1 in open loop.
        self.left = 1.0 if modes is None else 0.0

    @property
    def stationary(self) -> bool:
        """Whether the phase differs alike between all pairs of samples at equal distance: in open loop."""
        return self._basis is None

    def phases(self, strength: float) -> NDArray[np.float64]:
        """Random phases ``(count, n, n)`` in radians, for a number of pupil diameters over r0."""
        change = self._uncorrected - self._corrected
        return np.asarray(strength ** (5 / 6) * (self._corrected + self.left * change))

    def opposite_phases(self, strength: float, shapes: NDArray[np.float64]) -> NDArray[np.float64]:
        """The random phases, each with one of opposite shapes ``(count, 2, n, n)`` in radians.

        The mean of a wavefront whose coefficients of some shapes ``(k, n, n)`` are known is linear in them.
        It is reversed, and the rest is the same, so that both wavefronts are equally probable.
        """
        phases, lit = self.phases(strength), self._lit
        piston = np.ones((1, np.count_nonzero(lit)))
        coefficients = np.linalg.pinv(np.vstack([shapes[:, lit], piston]).T)[:-1]
        covariance = -0.5 * coefficients @ self.pair_structure(strength)
        mean = np.linalg.solve(covariance @ coefficients.T, covariance)
        opposite = phases.copy()
        opposite[:, lit] -= 2 * (phases[:, lit] @ coefficients.T) @ mean
        return np.stack([phases, opposite], axis=1)

    def structure(self, strength: float) -> NDArray[np.float64]:
        """Structure function in rad^2 in open loop ``(2 n - 1, 2 n - 1)``, by the separation of samples."""
        return structure_function(self._distances, 1 / strength, self._outer_scale)

    def pair_structure(self, strength: float) -> NDArray[np.float32]:
        """Structure function of all pairs of lit samples ``(k, k)`` in rad^2."""
        rows, columns = np.nonzero(self._lit)
        last = len(self._lit) - 1
        structure = self.structure(strength).astype(np.float32)
        apart = rows[:, None] - rows + last, columns[:, None] - columns + last
        between: NDArray[np.float32] = structure[apart]
        if self._basis is None:
            return between
        # Up to piston, which the loop removes or which does not matter.
        covariance, basis = between * np.float32(-0.5), self._basis.astype(np.float32)
        removed = np.float32(1 - self.left)
        covariance -= removed * (basis @ (basis.T @ covariance))
        covariance -= removed * ((covariance @ basis) @ basis.T)
        return _structure_of(covariance)

    def estimate_left(
        self, optics: PyramidOptics, pupils: PyramidPupils, strength: float, pokes: PokePhase | None
    ) -> None:
        """Set :attr:`left` from the tilt of the slopes.

        A loop corrects the tilt with the other modes. The slopes' mean over the pupil gives the tilt that is
        left, by the response to a small tilt on the corrected turbulence; pokes are part of it. The tilt
        without a loop is that of the structure function.
        """
        whole = structure_function(self._distances, 1 / strength, self._outer_scale)
        states = self._corrected * strength ** (5 / 6)
        ratios = []
        for axis, tilt in enumerate(_unit_tilts(self._lit)):
            step = _TILT_RAD * tilt
            up, down = (
                np.array([_mean_slopes(optics, pupils, state + change)[axis] for state in states])
                for change in (step, -step)
            )
            response = (up - down).mean() / (2 * _TILT_RAD)
            # Other modes have a mean slope as well.
            others = ((up + down) / 2).var(ddof=1)
            variance = (pupils.residual_tilt**2 - others) / response**2
            if pokes is not None:
                variance -= np.square((pokes.modes_rad * tilt)[:, self._lit].mean(axis=1)).sum()
            ratios.append(max(variance, 0.0) / _projected_variance(tilt / np.count_nonzero(self._lit), whole))
        self.left = min(float(np.sqrt(np.mean(ratios))), 1.0)


def _unit_tilts(lit: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Tilts along x and y ``(2, n, n)`` of rms 1 and mean 0 over the lit samples, 0 elsewhere."""
    tilts = np.where(lit, np.indices(lit.shape)[::-1].astype(float), 0.0)
    tilts[:, lit] -= tilts[:, lit].mean(axis=1, keepdims=True)
    return np.asarray(tilts / np.sqrt(np.square(tilts[:, lit]).mean(axis=1))[:, None, None])


def _remove(
    basis: NDArray[np.float64], screens: NDArray[np.float64], lit: NDArray[np.bool_]
) -> NDArray[np.float64]:
    """Screens ``(count, n, n)`` without orthonormal modes ``(k, n_modes)`` of lit samples; 0 elsewhere."""
    inside, rest = screens[:, lit], np.zeros_like(screens)
    rest[:, lit] = inside - (inside @ basis) @ basis.T
    return rest


def _projected_variance(weights: NDArray[np.float64], structure: NDArray[np.float64]) -> float:
    """Variance of a sum over the phase with weights ``(n, n)`` whose own sum is 0."""
    n = len(weights)
    spectrum = np.square(np.abs(np.fft.rfft2(weights, (2 * n, 2 * n))))
    steps = np.arange(1 - n, n)
    products = np.fft.irfft2(spectrum, (2 * n, 2 * n))[np.ix_(steps, steps)]
    return float(-0.5 * (products * structure).sum())


def _mean_slopes(
    optics: PyramidOptics, pupils: PyramidPupils, phase: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Mean slopes ``(2,)`` over the pupil for a phase ``(n, n)`` in radians."""
    path = (phase * (optics.wavelength_m / (2 * np.pi))).astype(np.float32)
    return np.asarray(slopes_of_image(optics.frame(path), pupils).reshape(2, -1).mean(axis=1))


def estimate_strength(
    optics: PyramidOptics,
    pupils: PyramidPupils,
    screens: NDArray[np.float64],
    pokes: PokePhase | None = None,
) -> float:
    """Estimate the pupil diameters over r0 at the sensor's wavelength from the motion of the slopes.

    Slopes are simulated under random phases of each trial strength, always the same ones, so that the
    result depends on the measured motion only.

    The slopes of a pyramid saturate: their rms rises with the turbulence and falls again beyond about
    ten r0 across the pupil. With random pokes, new in every frame, the persistent fraction of the
    variance rises where the rms hardly changes, and the rms falls where the fraction hardly rises; both
    together determine the strength. Without pokes, and in closed loop, the rising branch of the rms is used.

    ``optics`` is the nominal sensor, ``screens (count, n, n)`` are phases for a pupil of one r0. The result
    is between 0 (no motion, or none that persists) and the strongest trial.
    """
    if not pupils.motion:
        return 0.0
    if pokes is None or pupils.residual_tilt:
        return _strength_from_rms(optics, pupils, screens, pokes)
    return _strength_with_pokes(optics, pupils, screens, pokes) if pupils.persistent_fraction else 0.0


def _strength_from_rms(
    optics: PyramidOptics, pupils: PyramidPupils, screens: NDArray[np.float64], pokes: PokePhase | None
) -> float:
    """Strength from the slopes' rms on its rising branch."""
    beside = np.zeros_like(screens) if pokes is None else pokes.phases(len(screens))
    alone, *values = [float(np.sqrt(np.square(_slopes(optics, pupils, beside)).mean()))]
    if pupils.motion <= alone:
        return 0.0
    for ratio in _TRIAL_STRENGTHS:
        slopes = _slopes(optics, pupils, screens * ratio ** (5 / 6) + beside)
        values.append(float(np.sqrt(np.square(slopes).mean())))
        if len(values) > 1 and values[-1] <= values[-2]:
            values.pop()
            break
        if values[-1] > pupils.motion:
            break
    if pupils.motion <= values[0]:
        # Weak turbulence moves the slopes in proportion to the phase.
        share = (pupils.motion**2 - alone**2) / (values[0] ** 2 - alone**2)
        return float(_TRIAL_STRENGTHS[0] * share ** (3 / 5))
    return float(2 ** np.interp(pupils.motion, values, np.log2(_TRIAL_STRENGTHS[: len(values)])))


def _strength_with_pokes(
    optics: PyramidOptics, pupils: PyramidPupils, screens: NDArray[np.float64], pokes: PokePhase
) -> float:
    """Strength from the slopes' rms and the persistent fraction of their variance, with pokes."""
    halves = np.split(pokes.phases(2 * len(screens)), 2)
    rms, persistence = [], []
    for ratio in (0.0, *_TRIAL_STRENGTHS):
        first, second = (_slopes(optics, pupils, screens * ratio ** (5 / 6) + half) for half in halves)
        squares = np.mean(np.square([first, second]), axis=(1, 2))
        rms.append(float(np.sqrt(squares.mean())))
        persistence.append(float(np.mean(first * second) / np.sqrt(squares.prod())))
    # A finite number of pokes correlates by chance, as the trial without turbulence shows.
    persistence = [share - persistence[0] * (1 - share) for share in persistence]
    if pupils.persistent_fraction <= persistence[1]:
        # A fraction of the variance scales as the square of the phase.
        return float(_TRIAL_STRENGTHS[0] * (pupils.persistent_fraction / persistence[1]) ** (3 / 5))
    rms, persistence = rms[1:], persistence[1:]
    at = np.linspace(np.log2(_TRIAL_STRENGTHS[0]), np.log2(_TRIAL_STRENGTHS[-1]), 200)
    by_rms, by_share = (
        np.interp(at, np.log2(_TRIAL_STRENGTHS), values) for values in (np.log(rms), persistence)
    )
    # The relative error of the rms and the error of the fraction count alike: in both is that of the power of
    # the same realisations of the turbulence.
    distance = np.hypot(by_rms - np.log(pupils.motion), by_share - pupils.persistent_fraction)
    return float(2 ** at[np.argmin(distance)])


def _slopes(optics: PyramidOptics, pupils: PyramidPupils, phases: NDArray[np.float64]) -> NDArray[np.float64]:
    """Slopes ``(count, n_slopes)`` about their mean under random phases ``(count, n, n)`` in radians."""
    paths = (phases * (optics.wavelength_m / (2 * np.pi))).astype(np.float32)
    slopes = np.array([slopes_of_image(optics.frame(path), pupils) for path in paths])
    return np.asarray((slopes - slopes.mean(axis=0)) * np.sqrt(len(slopes) / (len(slopes) - 1)))


@functools.cache
def unit_screens(n: int, outer_scale: float) -> NDArray[np.float64]:
    """Von Kármán phases ``(2 * _N_PAIRS, n, n)`` in radians with a pupil of one r0."""
    size = _SCREEN_PUPILS * n
    f = np.hypot(*np.meshgrid(np.fft.fftfreq(size), np.fft.fftfreq(size))) * n
    # 0.0229 r0^(-5/3) (f^2 + L0^-2)^(-11/6), in pupil diameters.
    amplitude = np.sqrt(0.0229) * (f**2 + outer_scale**-2) ** (-11 / 12) / _SCREEN_PUPILS
    rng = np.random.default_rng(0)
    screens = []
    for _ in range(_N_PAIRS):
        noise = rng.standard_normal((size, size)) + 1j * rng.standard_normal((size, size))
        pair = np.fft.fft2(noise * amplitude)[:n, :n]
        screens += [pair.real, pair.imag]
    out = np.stack(screens)
    out.setflags(write=False)
    return out


#: Rms path of a mirror shape in waves, in the linear range.
_STEP_WAVES = 0.01
#: Groups of shapes that are fitted by themselves.
_N_GROUPS = 6
#: Smallest ratio of the turbulence's variance to the total: few states estimate it poorly.
_MIN_SHARE = 0.1


def turbulence_registration_scatter(
    optics: PyramidOptics,
    pupils: PyramidPupils,
    screens: NDArray[np.float64],
    pokes: NDArray[np.float64],
    paths_m: NDArray[np.float64],
    matrix: NDArray[np.float64],
    derivatives: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Standard deviation ``(5,)`` over turbulence states of the best-fitting registration.

    The response of a pyramid depends on the wavefront: pixels saturate where it is steep. A model
    describes the mean, so its registration errs by this scatter over the root of the number of states
    that a measurement averaged. A state may consist of several wavefronts, whose mean response counts: what
    the model takes into account of the wavefront is no error. The scatter is computed from differences of
    frames with a mirror shape up and down. Pokes are new in every frame and average as noise, which the
    fit's standard errors include.
    Shapes and pokes are the same in every state, so that their own effect is none of the scatter. Groups of
    shapes, with their pokes, are fitted by themselves; what they do not have in common in one state is not
    due to the turbulence (analysis of variance).

    Parameters
    ----------
    optics
        The nominal sensor.
    screens
        Random states of the turbulence ``(count, m, n, n)`` in radians, m wavefronts each.
    pokes
        Random pokes beside each shape ``(k, n, n)`` in radians, or ``(1, n, n)`` for all of them.
    paths_m
        Optical path of the shapes ``(k, n, n)`` in metres, of all modes of a calibration, since fine shapes
        constrain the registration better than coarse ones.
    matrix, derivatives
        The model's response to the shapes ``(n_slopes, k)``, and its derivatives by registration and width.
    """
    fits = []
    terms = np.concatenate([matrix[None], derivatives[:5]])
    half_step_m = _STEP_WAVES * optics.wavelength_m / float(paths_m.std())
    pokes_m, screens_m = (phases * (optics.wavelength_m / (2 * np.pi)) for phases in (pokes, screens))
    around = np.broadcast_to(pokes_m, paths_m.shape)
    for state in screens_m:
        slopes = [
            sign * slopes_of_image(optics.frame((screen + poke + step).astype(np.float32)), pupils)
            for poke, path in zip(around, paths_m, strict=True)
            for screen in state
            for sign, step in ((1, half_step_m * path), (-1, -half_step_m * path))
        ]
        measured = np.reshape(slopes, (len(paths_m), 2 * len(state), -1)).mean(axis=1).T
        fits.append(
            [
                fit_registration_change(terms[:, :, g::_N_GROUPS], measured[:, g::_N_GROUPS])
                for g in range(_N_GROUPS)
            ]
        )
    deviations = np.array(fits) - np.mean(fits, axis=0)
    means, freedom = deviations.mean(axis=1), len(deviations) - 1
    total_variance = np.square(means).sum(axis=0) / freedom
    by_groups = np.square(deviations - means[:, None]).sum(axis=(0, 1)) / (freedom * (_N_GROUPS - 1))
    common_variance = total_variance - by_groups / _N_GROUPS
    # Turbulence and pupil have no preferred direction; averaging x and y improves the estimate.
    for variance in (common_variance, total_variance):
        variance[:2] = variance[:2].mean()
    return np.asarray(np.sqrt(np.maximum(common_variance, _MIN_SHARE * total_variance)))


def fit_registration_change(terms: NDArray[np.float64], slopes: NDArray[np.float64]) -> NDArray[np.float64]:
    """Change of the registration ``(5,)`` that fits slopes ``(n_slopes, k)`` best, with a gain.

    ``terms (6, n_slopes, k)`` are a matrix and its derivatives by the registration.
    """
    design = terms.reshape(6, -1)
    gain, *shifts = np.linalg.lstsq(design @ design.T, design @ slopes.ravel())[0]
    return np.asarray(np.array(shifts) / gain)
