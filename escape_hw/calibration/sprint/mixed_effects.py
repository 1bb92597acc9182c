"""The mixed-effects problem of SPRINT: model, derivatives and residual at a state, trends of the slope gains, and empirical-Bayes estimates of single actuators."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.registration import Registration
from escape_hw.api.results import PEDESTAL, ActuatorCorrections
from escape_hw.api.synthetic_model import HasGainTrend, SyntheticModel
from escape_hw.calibration.modes.derivatives import modal_matrix, pedestal_jacobian, zonal_jacobian
from escape_hw.calibration.sprint.extra_parameters import ExtraParameterModel, FittedExtraParameter
from escape_hw.calibration.sprint.normal_equations import NormalEquations, Priors, normal_equations
from escape_hw.calibration.sprint.weighted_matrix import WeightedMatrix


def slope_trends(model: SyntheticModel, valid: NDArray[np.bool_]) -> NDArray[np.float64]:
    """What gains of slopes change by over the pupil, for one prior scatter of each trend.

    Thousands of slopes would each have to depart from an independent prior to follow a trend, and some
    actuators and a scaling follow it at less cost. So trends have unknowns of their own: the squares of
    the places along x and y, apart in the x and the y slopes. Linear ones, tried too, pass for shifts.

    Parameters
    ----------
    model
        Says how much its slopes may trend (:class:`~escape_hw.api.synthetic_model.HasGainTrend`); one that does not
        say so is even.
    valid
        Valid sub-apertures ``(n_rows, n_columns)``.

    Returns
    -------
    ndarray, ``(n_slopes, 4)``
        Relative, of zero mean; ``(n_slopes, 0)`` for a model that is even.
    """
    count = int(valid.sum())
    scatter = model.gain_trend if isinstance(model, HasGainTrend) else 0.0
    if not scatter:
        return np.zeros((2 * count, 0))
    positions = np.argwhere(valid)[:, ::-1]
    half = np.array(valid.shape[::-1]) / 2
    squares = np.square((positions + 0.5) / half - 1)
    return scatter * np.kron(np.eye(2), squares - squares.mean(axis=0))


#: Rounds of the fixed point; later ones change the scatter by less than a percent.
_ITERATIONS = 20
#: Effects of exactly zero that are taken to have been seen beside: a scatter that a handful of effects
#: suggests may be chance, and what is left out then costs less than what is made up.
_PSEUDO_COUNT = 2.0


def empirical_bayes(
    information: NDArray[np.float64],
    value: NDArray[np.float64],
    precision: NDArray[np.float64],
    groups: Sequence[slice],
    bounds: Sequence[tuple[float, float]],
    noise: float = 1.0,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Effects with the priors that make the data likeliest, from a solution with other priors.

    The scatter of each kind of effects goes to ``sum x^2 / sum(1 - var / scatter^2)`` (MacKay 1992, eq.
    4.9 and 4.10), the fixed point of the evidence, with a few effects of zero added to the count. Unlike a
    prior that was chosen, it goes to nothing where the data say nothing, and then so do the effects.

    Parameters
    ----------
    information
        Normal matrix of the unknowns with their present priors in it ``(n, n)``.
    value
        The solution, from the priors' means ``(n,)``.
    precision
        Present priors ``(n,)``.
    kinds
        Which unknowns share a scatter.
    bounds
        Least and largest scatter of each kind.
    noise
        Noise of the data in the units of ``information``.

    Returns
    -------
    value, sigma : ndarray, ``(n,)``
        Posterior mean, and standard error.
    """
    data = (information - np.diag(precision)) / noise**2
    # At the solution data and priors are in balance.
    right_hand_side = information @ value / noise**2
    prior = precision.copy()
    for _ in range(_ITERATIONS):
        covariance = np.linalg.inv(data + np.diag(prior))
        posterior_mean = covariance @ right_hand_side
        for group, (least, largest) in zip(groups, bounds, strict=True):
            n_determined = np.sum(1 - np.diag(covariance)[group] * prior[group])
            square = np.square(posterior_mean[group]).sum() / (float(n_determined) + _PSEUDO_COUNT)
            prior[group] = 1 / np.clip(square, least**2, largest**2)
    return posterior_mean, np.sqrt(np.maximum(np.diag(covariance), 0.0))


#: Places of the common parameters among the unknowns; the registration has places 1 to 5.
GAIN, WIDTH, SHAPE = 0, 6, 7


#: Shares of a variant below which its derivatives are taken for the model's own.
_SMALL_SHARE = 0.25
#: Share of the pedestal below which the whole is taken to move as the influence functions do without it.
_SMALL_PEDESTAL = 0.05
#: Share of the gain down to which a step may take it for shares to follow its product with them.
_MIN_GAIN_RATIO = 0.05
#: Random effects of which there are many of a kind, in the order of the unknowns ...
_EFFECTS = ("sampling", "actuator_gain", "actuator_width", "slope_gain")
#: ... and the shares of their usual scatter below and above which none is taken to be.
_MIN_PRIOR_RATIO, _MAX_PRIOR_RATIO = 0.05, 1.0


@dataclass(frozen=True, slots=True)
class PriorEstimate:
    """Scatter of the random effects as the data have it, and how many unknowns the data decided."""

    priors: Priors
    n_effective_parameters: float


@dataclass(slots=True, eq=False)
class MixedEffectsState:
    """Present values: common parameters and random effects."""

    gain: float
    alpha: NDArray[np.float64]
    width: float
    shape: float
    variant: NDArray[np.float64]
    sampling: NDArray[np.float64]
    trend: NDArray[np.float64]
    actuator_gain: NDArray[np.float64]
    actuator_width: NDArray[np.float64]
    slope_gain: NDArray[np.float64]

    def offset(self, mean_width: float, mean_variant: NDArray[np.float64]) -> NDArray[np.float64]:
        """Distance from the priors' means, in the order of the unknowns."""
        head = np.concatenate([[0.0], np.zeros(5), [self.width - mean_width, self.shape]])
        many = self.sampling, self.trend, self.actuator_gain, self.actuator_width, self.slope_gain
        return np.concatenate([head, self.variant - mean_variant, *many])


@dataclass(slots=True, eq=False)
class _ZonalMatrices:
    """Zonal matrices at a state, in standard errors: derivatives, variants, and the whole."""

    jacobian: NDArray[np.float64]
    by_width: NDArray[np.float64]
    by_shape: NDArray[np.float64]
    variants: list[NDArray[np.float64]]
    total: NDArray[np.float64]


class MixedEffectsProblem:
    """One matrix, one model, and the weights between them.

    Parameters
    ----------
    weighted
        The measured matrix.
    model
        The synthetic model.
    priors
        Scatter of what it does not know.
    bends
        What commands may be multiplied with by one standard deviation ``(n_act, n_act)`` each, such as
        optical gains that differ between modes; fitted beside the model's own variants.
    extras
        What else is asked for; fitted after the model's own variants, before the bends.
    """

    def __init__(
        self,
        weighted: WeightedMatrix,
        model: SyntheticModel,
        priors: Priors,
        command_curves: Sequence[NDArray[np.float64]] = (),
        extras: Sequence[ExtraParameterModel] = (),
    ) -> None:
        self.weighted, self.command_curves, self.priors = weighted, tuple(command_curves), priors
        self.extras = tuple(extras)
        self.model, self.modes = model, self.weighted.modes
        self.variants = tuple(model.variants())
        rows, cols = np.nonzero(weighted.valid)
        means, scatters = self._prior_moments()
        self._means = priors.mean_width, means
        # x slopes share what their column does to them, y slopes what their row does.
        self.lines = np.unique(np.concatenate([cols, weighted.valid.shape[1] + rows]), return_inverse=True)[1]
        self.n_lines = int(self.lines.max()) + 1
        self.trends = slope_trends(model, weighted.valid)
        self.precision = np.concatenate(
            [
                np.zeros(6),
                [priors.width**-2, priors.shape**-2],
                scatters**-2,
                np.full(self.n_lines, priors.sampling**-2),
                np.ones(self.trends.shape[1]),
                np.full(model.n_act, priors.noise_inflation * priors.actuator_gain**-2),
                np.full(model.n_act, priors.actuator_width**-2),
                np.full(weighted.data.shape[0], priors.slope_gain**-2),
            ]
        )

    def start(self, registration: Registration) -> MixedEffectsState:
        """State to start from: a registration, and the gain that fits it."""
        n_act, n_slopes = self.model.n_act, self.weighted.data.shape[0]
        zeros = np.zeros(n_act)
        model = self.weighted.weigh(modal_matrix(self.model, registration, self.modes))
        gain = float(np.vdot(model, self.weighted.data) / np.vdot(model, model))
        return MixedEffectsState(
            gain,
            registration.to_array(),
            self.priors.mean_width,
            0.0,
            self._means[1].copy(),
            np.zeros(self.n_lines),
            np.zeros(self.trends.shape[1]),
            zeros,
            zeros.copy(),
            np.zeros(n_slopes),
        )

    def _prior_moments(self) -> NDArray[np.float64]:
        """Prior means and scatters of variants, extra unknowns and bends in shares ``(2, n_variants)``."""
        shares = np.array([np.zeros(self.n_variants), np.ones(self.n_variants)])
        if self.priors.extras:
            first = len(self.variants)
            shares[:, first : first + len(self.extras)] = np.transpose(self.priors.extras)
        return shares

    def offset(self, state: MixedEffectsState) -> NDArray[np.float64]:
        """Distance of a state from the priors' means, in the order of the unknowns."""
        return state.offset(*self._means)

    @property
    def n_variants(self) -> int:
        """Shares of variants, extra unknowns and bends among the unknowns."""
        return len(self.variants) + len(self.extras) + len(self.command_curves)

    def extra_parameter_values(self, state: MixedEffectsState) -> tuple[FittedExtraParameter, ...]:
        """The extra unknowns at a state."""
        first = len(self.variants)
        return tuple(
            FittedExtraParameter(one, SHAPE + 1 + first + k, float(state.variant[first + k]))
            for k, one in enumerate(self.extras)
        )

    def _extra_parameter_changes(self, state: MixedEffectsState) -> list[NDArray[np.float64]]:
        """What one share of each extra unknown does to the zonal matrix, not weighted."""
        registration, w, first = Registration.from_array(state.alpha), 1.0 + state.width, len(self.variants)
        return [
            one.matrix_change(registration, w, float(state.variant[first + k]))
            for k, one in enumerate(self.extras)
        ]

    def _zonal_matrices(self, state: MixedEffectsState) -> _ZonalMatrices:
        """The zonal matrix of a state and what it is made of, weighted."""
        registration, w, weigh = Registration.from_array(state.alpha), 1.0 + state.width, self.weighted.weigh
        zonal_matrix, jacobian = (weigh(part) for part in zonal_jacobian(self.model, registration, w))
        base = jacobian
        variants = []
        for variant, share in zip(self.variants, state.variant, strict=False):
            if abs(share) < _SMALL_SHARE:
                variants.append(weigh(variant.zonal_matrix(registration, w)) - zonal_matrix)
                continue
            # What a large share brings with it moves with the mirror in a way of its own.
            changed, changes = (weigh(part) for part in zonal_jacobian(variant, registration, w))
            variants.append(changed - zonal_matrix)
            jacobian = jacobian + share * (changes - base)
        if abs(state.shape) < _SMALL_PEDESTAL:
            broad = weigh(self.model.zonal_matrix(registration, w * PEDESTAL))
        else:
            broad, changes = (weigh(part) for part in pedestal_jacobian(self.model, registration, w))
            jacobian = jacobian + state.shape * (changes - base)
        by_width, by_shape = jacobian[5] * w, broad - zonal_matrix
        variants += [weigh(change) for change in self._extra_parameter_changes(state)]
        variants += [zonal_matrix @ command_curve for command_curve in self.command_curves]
        total = zonal_matrix + state.shape * by_shape + state.actuator_width * by_width
        for share, difference in zip(state.variant, variants, strict=True):
            total = total + share * difference
        return _ZonalMatrices(jacobian, by_width, by_shape, variants, total)

    def matrix(self, state: MixedEffectsState, m2c: NDArray[np.float64]) -> NDArray[np.float64]:
        """Slopes per unit of any modes ``(n_slopes, n)`` at a state, random effects included.

        Parameters
        ----------
        state
            Where.
        m2c
            Modes ``(n_act, n)``.
        """
        return self.zonal_matrix(state) @ m2c

    def linearise(self, state: MixedEffectsState) -> NormalEquations:
        """Model and derivatives about a state."""
        z = self._zonal_matrices(state)
        jacobian, by_width, by_shape, variants, total = (
            z.jacobian,
            z.by_width,
            z.by_shape,
            z.variants,
            z.total,
        )
        rows, actuator_factor = self._slope_gains(state)[:, None], 1 + state.actuator_gain
        scaled_modes = actuator_factor[:, None] * self.modes

        def modal(z: NDArray[np.float64]) -> NDArray[np.float64]:
            return np.asarray(rows * (z @ scaled_modes))

        unit = modal(total)
        common = np.stack([unit, *(state.gain * modal(z) for z in (*jacobian, by_shape, *variants))])
        # Where a slope samples the wavefront: a shift shared by the lenslets of a column (x) or row (y).
        half = unit.shape[0] // 2
        sampling_derivative = np.concatenate([common[1, :half], common[2, half:]])
        model = state.gain * unit + state.sampling[self.lines, None] * sampling_derivative
        return normal_equations(
            common,
            state.gain * rows * total,
            state.gain * rows * by_width * actuator_factor,
            self.modes,
            state.gain * (total @ scaled_modes),
            self.weighted.data - model,
            self.precision,
            self.offset(state),
            sampling_derivative,
            self.lines,
            self.trends,
        )

    def _slope_gains(self, state: MixedEffectsState) -> NDArray[np.float64]:
        """Gain of every slope beside the common one ``(n_slopes,)``."""
        return np.asarray(1 + state.slope_gain + self.trends @ state.trend)

    def zonal_matrix(self, state: MixedEffectsState) -> NDArray[np.float64]:
        """Slopes per unit command ``(n_slopes, n_act)`` at a state, random effects included."""
        z = self._zonal_matrices(state)
        half = len(z.total) // 2
        sampling_derivative = np.concatenate([z.jacobian[0, :half], z.jacobian[1, half:]])
        schur_complement = z.total + state.sampling[self.lines, None] * sampling_derivative
        scale = state.gain * self._slope_gains(state) * self.weighted.by_slope
        return np.asarray(scale[:, None] * schur_complement * (1 + state.actuator_gain))

    def estimate_priors(self, state: MixedEffectsState, system: NormalEquations) -> PriorEstimate:
        """What a solution says about the scatter of the random effects.

        One step of expectation and maximisation (Dempster, Laird & Rubin 1977): the scatter that makes an
        effect's values most likely is that of their estimates and of what is left uncertain of them. Where
        the data say nothing, that is the prior; an effect that is not there fades from step to step.

        Parameters
        ----------
        state, system
            Solution, and the problem about it.
        """
        variance = system.posterior_variance()
        head, n_act = SHAPE + 1 + self.n_variants, self.model.n_act
        counts = (self.n_lines, self.trends.shape[1], n_act, n_act, self.weighted.data.shape[0])
        lines, _, gains, widths, slopes = np.split(variance[head:], np.cumsum(counts)[:-1])
        scatter, usual = {}, Priors()
        parts = lines, self.priors.noise_inflation * gains, widths, slopes
        for name, part in zip(_EFFECTS, parts, strict=True):
            least = _MIN_PRIOR_RATIO * getattr(usual, name)
            mean_square = float(np.mean(np.square(getattr(state, name)) + part))
            scatter[name] = max(float(np.sqrt(mean_square)), least)
        if self.trends.shape[1]:
            scatter["shared"] = system.estimate_noise_inflation()
        n_effective_parameters = float(np.sum(1 - variance * self.precision))
        return PriorEstimate(replace(self.priors, **scatter), n_effective_parameters)

    def actuator_corrections(self, state: MixedEffectsState, system: NormalEquations) -> ActuatorCorrections:
        """How the mirror of a solution differs from the model's.

        Parameters
        ----------
        state, system
            Solution, and the problem about it.
        """
        # Slopes' gains, eliminated first, come last.
        inner = len(system.schur_complement)
        n_act = self.model.n_act
        kinds = slice(inner - 2 * n_act, inner - n_act), slice(inner - n_act, inner)
        usual = Priors()
        bounds = [
            (_MIN_PRIOR_RATIO * each, _MAX_PRIOR_RATIO * each)
            for each in (usual.actuator_gain, usual.actuator_width)
        ]
        # Where the model does not fit, single actuators are to be believed less.
        rms = float(np.sqrt(np.mean(np.square(system.residual))))
        value, sigma = empirical_bayes(
            system.schur_complement, self.offset(state)[:inner], self.precision[:inner], kinds, bounds,
            max(rms, self.weighted.noise(system.residual)),
        )  # fmt: skip
        gains, widths = kinds
        return ActuatorCorrections(value[gains], sigma[gains], value[widths], state.shape)

    def move(self, state: MixedEffectsState, step: NDArray[np.floating]) -> MixedEffectsState:
        """The state after a step, in the order of the unknowns."""
        n_act = self.model.n_act
        counts = self.n_variants, self.n_lines, self.trends.shape[1], n_act, n_act
        variant, sampling, trend, gains, widths, slopes = np.split(step[8:], np.cumsum(counts))
        # What gain and shares make together is linear in their product: there the step is exact.
        gain = state.gain + step[GAIN]
        gain_ratio = state.gain / gain if gain > _MIN_GAIN_RATIO * state.gain else 1.0
        return MixedEffectsState(
            gain,
            state.alpha + step[1:6],
            float(np.clip(state.width + step[WIDTH], -0.5, 1.0)),
            float(np.clip(state.shape + gain_ratio * step[SHAPE], -0.5, 0.5)),
            state.variant + gain_ratio * variant,
            state.sampling + sampling,
            state.trend + trend,
            state.actuator_gain + gains,
            state.actuator_width + widths,
            state.slope_gain + slopes,
        )
