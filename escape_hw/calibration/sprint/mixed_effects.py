"""The mixed-effects problem of SPRINT.

:class:`MixedEffectsProblem` computes model, derivatives and residual at a state; below it are the trends of
the slope gains and the empirical-Bayes estimate of single actuators.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.registration import Registration
from escape_hw.api.results import PROFILE_WIDTHS, ActuatorCorrections
from escape_hw.api.synthetic_model import HasGainTrend, SyntheticModel
from escape_hw.calibration.modes.derivatives import component_jacobian, modal_matrix, zonal_jacobian
from escape_hw.calibration.sprint.extra_parameters import ExtraParameterModel, FittedExtraParameter
from escape_hw.calibration.sprint.normal_equations import NormalEquations, Priors, normal_equations
from escape_hw.calibration.sprint.weighted_matrix import WeightedMatrix

#: Indices of the common parameters among the unknowns; those of the registration are 1 to 5.
GAIN, WIDTH, PROFILE = 0, 6, 7
#: Number of components of the radial profile beside the nominal one, and index of the first variant.
N_PROFILE = len(PROFILE_WIDTHS)
#: Edge actuators: common relative gain and width beyond those of the others, components of their radial profile,
#: and of its outward asymmetry.
EDGE = PROFILE + N_PROFILE
N_EDGE = 2 + N_PROFILE + 1 + N_PROFILE
#: Four-fold terms of the influence functions: distances of their lobes in pitches, and widths.
FOURFOLD_LOBES = ((0.7, 0.6), (1.4, 1.0))
FOURFOLD = EDGE + N_EDGE
N_FOURFOLD = len(FOURFOLD_LOBES)
VARIANTS = FOURFOLD + N_FOURFOLD
#: Share of a variant below which its derivatives by the registration are taken to be the model's own.
_SMALL_SHARE = 0.25
#: Share of a component of the profile below which its derivatives by the registration are neglected.
_SMALL_COMPONENT = 0.02
#: Relative gain after a step above which the step of the shares is scaled to keep gain times share linear.
_MIN_GAIN_RATIO = 0.05
#: Effects of single actuators, in the order of the unknowns, and the priors of their scatter.
_ACTUATOR_PRIORS = ("actuator_gain", "actuator_width", "actuator_position", "actuator_position")
N_ACTUATOR_EFFECTS = len(_ACTUATOR_PRIORS)
#: Limits of the estimated scatter relative to the default priors.
_MIN_PRIOR_RATIO, _MAX_PRIOR_RATIO = 0.05, 1.0
#: Iterations of the empirical-Bayes fixed point; later ones change the scatter by less than a percent.
_ITERATIONS = 20
#: Zero effects that are added to the count of each group: the scatter of a few effects may be chance, and
#: omitting a real effect costs less than inventing one.
_PSEUDO_COUNT = 2.0


@dataclass(frozen=True, slots=True)
class PriorEstimate:
    """Scatter of the random effects estimated from the data, and effective number of parameters."""

    priors: Priors
    n_effective_parameters: float


@dataclass(slots=True, eq=False)
class MixedEffectsState:
    """Values of the common parameters and the random effects at one iteration."""

    gain: float
    alpha: NDArray[np.float64]
    width: float
    profile: NDArray[np.float64]
    edge: NDArray[np.float64]
    fourfold: NDArray[np.float64]
    variant: NDArray[np.float64]
    sampling: NDArray[np.float64]
    trend: NDArray[np.float64]
    actuator: NDArray[np.float64]
    slope_gain: NDArray[np.float64]

    @property
    def actuator_gain(self) -> NDArray[np.float64]:
        """Relative gain of every actuator beyond the common one ``(n_act,)``."""
        return np.asarray(self.actuator[0])


@dataclass(slots=True, eq=False)
class _ZonalMatrices:
    """Zonal matrices at a state, in standard errors: derivatives, variants, and their sum."""

    jacobian: NDArray[np.float64]
    by_width: NDArray[np.float64]
    by_profile: list[NDArray[np.float64]]
    by_edge: list[NDArray[np.float64]]
    by_fourfold: list[NDArray[np.float64]]
    variants: list[NDArray[np.float64]]
    total: NDArray[np.float64]


class MixedEffectsProblem:
    """Fit of registration, common parameters and random effects to a weighted matrix.

    Parameters
    ----------
    weighted, model, priors
        The measured matrix, the synthetic model, and the prior scatter of the random effects.
    command_curves
        Matrices ``(n_act, n_act)`` that commands may be multiplied with, one prior standard deviation each,
        such as optical gains that depend on the mode; fitted after the model's own variants and ``extras``.
    extras
        Extra parameters, fitted after the model's own variants.
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
        self._mean_variant, scatters = self._prior_moments()
        # The x slopes of a column of sub-apertures share a sampling position, and the y slopes of a row.
        self.lines = np.unique(np.concatenate([cols, weighted.valid.shape[1] + rows]), return_inverse=True)[1]
        self.n_lines = int(self.lines.max()) + 1
        self.edge, self.outward, self.pitch = edge_actuators(model)
        self.trends = slope_trends(model, weighted.valid)
        self.precision = np.concatenate([
            np.zeros(6), [priors.width**-2], np.full(N_PROFILE, priors.profile**-2),
            np.repeat([priors.edge_gain, priors.edge_width, priors.edge_profile, priors.edge_asymmetry], [1, 1, N_PROFILE, 1 + N_PROFILE]) ** -2.0,
            np.full(N_FOURFOLD, priors.fourfold**-2), scatters**-2,
            np.full(self.n_lines, priors.sampling**-2), np.ones(self.trends.shape[1]),
            *(np.full(model.n_act, self._actuator_precision(name)) for name in _ACTUATOR_PRIORS),
            np.full(weighted.data.shape[0], priors.slope_gain**-2),
        ])  # fmt: skip

    def _actuator_precision(self, name: str) -> float:
        """Prior precision of an effect of the actuators."""
        return float(self.priors.noise_inflation * getattr(self.priors, name) ** -2)

    def initial_state(self, registration: Registration) -> MixedEffectsState:
        """A registration, the gain that fits best there, and the prior means."""
        n_act, n_slopes = self.model.n_act, self.weighted.data.shape[0]
        model = self.weighted.weigh(modal_matrix(self.model, registration, self.modes))
        gain = float(np.vdot(model, self.weighted.data) / np.vdot(model, model))
        return MixedEffectsState(
            gain, registration.to_array(), self.priors.mean_width, np.zeros(N_PROFILE), np.zeros(N_EDGE), np.zeros(N_FOURFOLD),
            self._mean_variant.copy(),
            np.zeros(self.n_lines), np.zeros(self.trends.shape[1]), np.zeros((N_ACTUATOR_EFFECTS, n_act)),
            np.zeros(n_slopes),
        )  # fmt: skip

    def _prior_moments(self) -> NDArray[np.float64]:
        """Prior means and scatters of the shares of variants, extras and curves ``(2, n_variants)``."""
        shares = np.array([np.zeros(self.n_variants), np.ones(self.n_variants)])
        if self.priors.extras:
            first = len(self.variants)
            shares[:, first : first + len(self.extras)] = np.transpose(self.priors.extras)
        return shares

    def offset(self, state: MixedEffectsState) -> NDArray[np.float64]:
        """Distance of a state from the prior means, in the order of the unknowns."""
        common = [*np.zeros(6), state.width - self.priors.mean_width, *state.profile, *state.edge, *state.fourfold]
        effects = state.sampling, state.trend, state.actuator.ravel(), state.slope_gain
        return np.concatenate([common, state.variant - self._mean_variant, *effects])

    @property
    def n_variants(self) -> int:
        """Number of shares: of variants, extra parameters and command curves."""
        return len(self.variants) + len(self.extras) + len(self.command_curves)

    def extra_parameter_values(self, state: MixedEffectsState) -> tuple[FittedExtraParameter, ...]:
        """The extra parameters at a state."""
        first = len(self.variants)
        return tuple(
            FittedExtraParameter(one, VARIANTS + first + k, float(state.variant[first + k]))
            for k, one in enumerate(self.extras)
        )

    def _zonal_matrices(self, state: MixedEffectsState) -> _ZonalMatrices:
        """The weighted zonal matrix of a state and its parts."""
        registration, w, weigh = Registration.from_array(state.alpha), 1.0 + state.width, self.weighted.weigh
        zonal_matrix, jacobian = (weigh(part) for part in zonal_jacobian(self.model, registration, w))
        base = jacobian
        variants = []
        for variant, share in zip(self.variants, state.variant, strict=False):
            if abs(share) < _SMALL_SHARE:
                variants.append(weigh(variant.zonal_matrix(registration, w)) - zonal_matrix)
                continue
            # A large share changes the derivatives by the registration.
            changed, changes = (weigh(part) for part in zonal_jacobian(variant, registration, w))
            variants.append(changed - zonal_matrix)
            jacobian = jacobian + share * (changes - base)
        by_profile = []
        dipoles = [self._outward_derivative(base)]
        for relative_width, share in zip(PROFILE_WIDTHS, state.profile, strict=True):
            component, changes = (
                weigh(part) for part in component_jacobian(self.model, registration, w, relative_width)
            )
            jacobian = jacobian + share * (changes - base)
            dipoles.append(relative_width**2 * self._outward_derivative(changes))
            by_profile.append(component - zonal_matrix)
        by_width = jacobian[5] * w
        first = len(self.variants)
        for extra, share in zip(self.extras, state.variant[first:], strict=False):
            variants.append(weigh(extra.matrix_change(registration, w, float(share))))
        variants += [zonal_matrix @ command_curve for command_curve in self.command_curves]
        _, width, along_x, along_y = state.actuator
        total = zonal_matrix + width * by_width + along_x * jacobian[0] + along_y * jacobian[1]
        for share, difference in zip(state.profile, by_profile, strict=True):
            total = total + share * difference
        by_edge = [self.edge * part for part in (total, by_width, *by_profile, *dipoles)]
        by_fourfold = [weigh(part) for part in self._fourfold(registration, w)]
        for share, difference in zip(state.fourfold, by_fourfold, strict=True):
            total = total + share * difference
        for share, difference in zip(state.edge, by_edge, strict=True):
            total = total + share * difference
        for share, difference in zip(state.variant, variants, strict=True):
            total = total + share * difference
        return _ZonalMatrices(jacobian, by_width, by_profile, by_edge, by_fourfold, variants, total)

    def matrix(self, state: MixedEffectsState, m2c: NDArray[np.float64]) -> NDArray[np.float64]:
        """Slopes per unit of modes ``m2c (n_act, n)`` at a state, random effects included."""
        return self.zonal_matrix(state) @ m2c

    def linearise(self, state: MixedEffectsState) -> NormalEquations:
        """Model and derivatives about a state."""
        z = self._zonal_matrices(state)
        rows, actuator_factor = self._slope_gains(state)[:, None], 1 + state.actuator_gain
        scaled_modes = actuator_factor[:, None] * self.modes

        def modal(zonal: NDArray[np.float64]) -> NDArray[np.float64]:
            return np.asarray(rows * (zonal @ scaled_modes))

        unit = modal(z.total)
        parts = (*z.jacobian, *z.by_profile, *z.by_edge, *z.by_fourfold, *z.variants)
        common = np.stack([unit, *(state.gain * modal(part) for part in parts)])
        # A sampling position acts as a shift shared by the lenslets of a column (x) or a row (y).
        half = unit.shape[0] // 2
        sampling_derivative = np.concatenate([common[1, :half], common[2, half:]])
        model = state.gain * unit + state.sampling[self.lines, None] * sampling_derivative
        return normal_equations(
            common, state.gain * rows * self._actuator_derivatives(z, actuator_factor), self.modes,
            state.gain * (z.total @ scaled_modes), self.weighted.data - model, self.precision,
            self.offset(state), sampling_derivative, self.lines, self.trends,
        )  # fmt: skip

    def _outward_derivative(self, jacobian: NDArray[np.float64]) -> NDArray[np.float64]:
        """Derivative of the zonal matrix by outward positions of the actuators ``(n_slopes, n_act)``."""
        return np.asarray(jacobian[0] * self.outward[0] + jacobian[1] * self.outward[1])

    def _fourfold(self, registration: Registration, width: float) -> list[NDArray[np.float64]]:
        """Four-fold terms of the zonal matrix ``(n_slopes, n_act)``: lobes along the axes less those between."""
        if not self.pitch:
            return [np.zeros((self.weighted.data.shape[0], self.model.n_act))] * N_FOURFOLD
        terms, affine = [], registration.affine(self.model.sub_aperture_m)[0]
        for distance, relative_width in FOURFOLD_LOBES:
            total = 0.0
            for number in range(8):
                angle = number * np.pi / 4
                shift = affine @ (self.pitch * distance * np.array([np.cos(angle), np.sin(angle)]))
                lobe = replace(
                    registration, shift_x=registration.shift_x + shift[0], shift_y=registration.shift_y + shift[1]
                )
                total = total + (-1.0) ** number * self.model.zonal_matrix(lobe, width * relative_width)
            terms.append(np.asarray(total))
        return terms

    def _actuator_derivatives(
        self, z: _ZonalMatrices, actuator_factor: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Weighted derivatives by the effects of the actuators ``(n_effects, n_slopes, n_act)``."""
        return np.stack(
            [z.total, z.by_width * actuator_factor, z.jacobian[0] * actuator_factor, z.jacobian[1] * actuator_factor]
        )

    def _slope_gains(self, state: MixedEffectsState) -> NDArray[np.float64]:
        """Gain of every slope relative to the common one ``(n_slopes,)``."""
        return np.asarray(1 + state.slope_gain + self.trends @ state.trend)

    def zonal_matrix(self, state: MixedEffectsState) -> NDArray[np.float64]:
        """Slopes per unit command ``(n_slopes, n_act)`` at a state, random effects included."""
        z = self._zonal_matrices(state)
        half = len(z.total) // 2
        sampling_derivative = np.concatenate([z.jacobian[0, :half], z.jacobian[1, half:]])
        sampled_matrix = z.total + state.sampling[self.lines, None] * sampling_derivative
        scale = state.gain * self._slope_gains(state) * self.weighted.by_slope
        return np.asarray(scale[:, None] * sampled_matrix * (1 + state.actuator_gain))

    def estimate_priors(self, state: MixedEffectsState, system: NormalEquations) -> PriorEstimate:
        """Estimate the scatter of the random effects from a solution.

        One step of expectation and maximisation (Dempster, Laird & Rubin 1977): the most likely variance of
        a group of effects is the mean square of their estimates plus their mean posterior variance. Where
        the data have no information that is the prior; the scatter of an absent effect decreases from step
        to step.
        """
        variance = system.posterior_variance()
        head, n_act = VARIANTS + self.n_variants, self.model.n_act
        counts = (self.n_lines, self.trends.shape[1], N_ACTUATOR_EFFECTS * n_act)
        lines, _, actuators, slopes = np.split(variance[head:], np.cumsum(counts))
        gains, widths, *positions = self.priors.noise_inflation * actuators.reshape(-1, n_act)
        squares = {
            "sampling": np.square(state.sampling) + lines,
            "actuator_gain": np.square(state.actuator[0]) + gains,
            "actuator_width": np.square(state.actuator[1]) + widths,
            "actuator_position": np.square(state.actuator[2:]) + np.array(positions),
            "slope_gain": np.square(state.slope_gain) + slopes,
        }
        usual = Priors()
        scatter = {
            name: max(float(np.sqrt(np.mean(square))), _MIN_PRIOR_RATIO * getattr(usual, name))
            for name, square in squares.items()
        }
        if self.trends.shape[1]:
            scatter["noise_inflation"] = system.estimate_noise_inflation()
        n_effective_parameters = float(np.sum(1 - variance * self.precision))
        return PriorEstimate(replace(self.priors, **scatter), n_effective_parameters)

    def actuator_corrections(self, state: MixedEffectsState, system: NormalEquations) -> ActuatorCorrections:
        """Differences between the mirror of a solution and the nominal one."""
        # The slope gains, eliminated first, come last.
        inner = len(system.schur_complement)
        n_act = self.model.n_act
        first = inner - N_ACTUATOR_EFFECTS * n_act
        groups = [slice(first + k * n_act, first + (k + 1) * n_act) for k in range(N_ACTUATOR_EFFECTS)]
        usual = Priors()
        bounds = [
            (_MIN_PRIOR_RATIO * getattr(usual, name), _MAX_PRIOR_RATIO * getattr(usual, name))
            for name in _ACTUATOR_PRIORS
        ]
        # A misfit of the model enlarges the noise that the effects are compared with.
        rms = float(np.sqrt(np.mean(np.square(system.residual))))
        value, sigma = empirical_bayes(
            system.schur_complement, self.offset(state)[:inner], self.precision[:inner], groups, bounds,
            max(rms, self.weighted.noise_level(system.residual)),
        )  # fmt: skip
        gains, widths, along_x, along_y = groups
        positions = np.stack([value[along_x], value[along_y]])
        return ActuatorCorrections(value[gains], sigma[gains], value[widths], state.profile, positions)

    def move(self, state: MixedEffectsState, step: NDArray[np.floating]) -> MixedEffectsState:
        """The state after a step, in the order of the unknowns."""
        n_act = self.model.n_act
        counts = self.n_variants, self.n_lines, self.trends.shape[1], N_ACTUATOR_EFFECTS * n_act
        variant, sampling, trend, actuators, slopes = np.split(step[VARIANTS:], np.cumsum(counts))
        # The matrix is linear in gain times share, so the step is exact in that product.
        gain = state.gain + step[GAIN]
        gain_ratio = state.gain / gain if gain > _MIN_GAIN_RATIO * state.gain else 1.0
        return MixedEffectsState(
            gain, state.alpha + step[1:6],
            float(np.clip(state.width + step[WIDTH], -0.5, 1.0)),
            state.profile + gain_ratio * step[PROFILE:EDGE], state.edge + step[EDGE:FOURFOLD],
            state.fourfold + gain_ratio * step[FOURFOLD:VARIANTS],
            state.variant + gain_ratio * variant, state.sampling + sampling, state.trend + trend,
            state.actuator + actuators.reshape(-1, n_act), state.slope_gain + slopes,
        )  # fmt: skip


def edge_actuators(model: SyntheticModel) -> tuple[NDArray[np.float64], NDArray[np.float64], float]:
    """One for edge actuators, else zero ``(n_act,)``, outward ``(2, n_act)``, and pitch in % of a sub-aperture."""
    if not hasattr(model, "actuator_positions_m"):
        return np.zeros(model.n_act), np.zeros((2, model.n_act)), 0.0
    positions = model.actuator_positions_m
    centred = positions - positions.mean(axis=0)
    distance = np.linalg.norm(positions[:, None] - positions, axis=2)
    nearest = np.sort(distance, axis=1)[:, 1]
    neighbours = (distance < 1.3 * np.median(nearest)).sum(axis=1)
    edge = (neighbours < np.median(neighbours)).astype(float)
    pitch = float(100 / model.sub_aperture_m * np.median(nearest))
    return edge, 0.55 * pitch * (centred / np.maximum(np.linalg.norm(centred, axis=1), 1e-12)[:, None]).T, pitch


def slope_trends(model: SyntheticModel, valid: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Trends of the slope gains over the pupil, one prior standard deviation each.

    With independent priors, thousands of slope gains would have to depart to follow a trend, which some
    actuators and a scaling can follow at less cost. So the trends are unknowns of their own: the squared
    positions along x and along y, separately for x and y slopes. Linear trends are degenerate with shifts.

    Parameters
    ----------
    model
        A model with a prior scatter of trends (:class:`~escape_hw.api.synthetic_model.HasGainTrend`).
    valid
        Valid sub-apertures ``(n_rows, n_columns)``.

    Returns
    -------
    ndarray, ``(n_slopes, 4)``
        Relative, of zero mean; ``(n_slopes, 0)`` for a model without trends.
    """
    count = int(valid.sum())
    scatter = model.gain_trend if isinstance(model, HasGainTrend) else 0.0
    if not scatter:
        return np.zeros((2 * count, 0))
    positions = np.argwhere(valid)[:, ::-1]
    half = np.array(valid.shape[::-1]) / 2
    squares = np.square((positions + 0.5) / half - 1)
    return scatter * np.kron(np.eye(2), squares - squares.mean(axis=0))


def empirical_bayes(
    information: NDArray[np.float64],
    value: NDArray[np.float64],
    precision: NDArray[np.float64],
    groups: Sequence[slice],
    bounds: Sequence[tuple[float, float]],
    noise: float = 1.0,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Posterior of random effects under the priors that maximise the evidence.

    The variance of each group is the fixed point ``sum x^2 / sum(1 - var / scatter^2)`` (MacKay 1992, eq.
    4.9 and 4.10), with a few zero effects added to the count. Unlike a chosen prior, it goes to its lower
    bound where the data have no information, and the effects go to zero with it.

    Parameters
    ----------
    information
        Normal matrix of the unknowns including their present priors ``(n, n)``.
    value
        The solution relative to the prior means ``(n,)``.
    precision
        Present prior precisions ``(n,)``.
    groups
        Unknowns that share a scatter.
    bounds
        Smallest and largest scatter of each group.
    noise
        Noise of the data in the units of ``information``.

    Returns
    -------
    value, sigma : ndarray, ``(n,)``
        Posterior mean and standard error.
    """
    data = (information - np.diag(precision)) / noise**2
    # The gradient vanishes at the solution.
    right_hand_side = information @ value / noise**2
    prior = precision.copy()
    for _ in range(_ITERATIONS):
        covariance = np.linalg.inv(data + np.diag(prior))
        posterior_mean = covariance @ right_hand_side
        for group, (smallest, largest) in zip(groups, bounds, strict=True):
            n_determined = np.sum(1 - np.diag(covariance)[group] * prior[group])
            square = np.square(posterior_mean[group]).sum() / (float(n_determined) + _PSEUDO_COUNT)
            prior[group] = 1 / np.clip(square, smallest**2, largest**2)
    return posterior_mean, np.sqrt(np.maximum(np.diag(covariance), 0.0))
