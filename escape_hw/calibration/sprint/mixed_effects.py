"""The mixed-effects problem of SPRINT.

:class:`MixedEffectsProblem` computes model, derivatives and residual at a state; below it are the trends of
the slope gains and the empirical-Bayes estimate of single actuators.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dpotrf, dpotri, dpotrs

from escape_hw.api.registration import Registration
from escape_hw.api.results import ActuatorCorrections
from escape_hw.api.synthetic_model import HasGainTrend, SyntheticModel
from escape_hw.calibration.modes.derivatives import modal_matrix, zonal_jacobian
from escape_hw.calibration.sprint.covariance import LinearisedProblem
from escape_hw.calibration.sprint.extra_parameters import ExtraParameterModel, FittedExtraParameter
from escape_hw.calibration.sprint.influence_shape import (
    KEEP_DERIVATIVES_WITHIN,
    KEEP_WITHIN,
    InfluenceShape,
)
from escape_hw.calibration.sprint.normal_equations import NormalEquations, Priors, normal_equations
from escape_hw.calibration.sprint.weighted_matrix import WeightedMatrix
from escape_hw.pipeline.statistics import NORMAL_RATIO, root_mean_square

#: Indices of the common parameters among the unknowns; those of the registration are 1 to 5.
GAIN, WIDTH, SHAPE = 0, 6, 7
#: Share of a variant below which its derivatives by the registration are taken to be the model's own.
_SMALL_SHARE = 0.25
#: Relative gain after a step above which the step of shares and effects is scaled to keep their product with
#: the gain linear.
_MIN_GAIN_RATIO = 0.05
#: Effects of single actuators, in the order of the unknowns, and the priors of their scatter.
_ACTUATOR_PRIORS = ("actuator_gain", "actuator_width", "actuator_position", "actuator_position")
N_ACTUATOR_EFFECTS = len(_ACTUATOR_PRIORS)
#: Precision of the mean of the actuator gains, relative to that of one: their mean is the common gain. If it
#: were free, a common gain far too large with all actuators far below it would bring them closer to each
#: other, which their prior rewards.
_MEAN_STIFFNESS = 1e3
#: Limits of the estimated scatter relative to the usual priors.
_MIN_PRIOR_RATIO, _MAX_PRIOR_RATIO = 0.05, 3.0
#: Relative change of the fitted matrix below which derivatives are kept: they change by about as much. With
#: five times as much, solutions for matrices of high signal-to-noise ratio differ by their stated errors.
_KEEP_BELOW = 0.002
#: The same for a mirror that is followed, whose registration and width stay within :data:`KEEP_WITHIN`: the
#: change is that of shares and effects, in which the matrix is linear.
_FOLLOW_BELOW = 0.05
#: The same at a solution, where the stated errors follow from the derivatives.
_SAME_BELOW = 1e-4
#: Iterations of the empirical-Bayes fixed point, and relative change of all scatters that ends them.
_ITERATIONS, _NEGLIGIBLE_CHANGE = 20, 0.02
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
    shape: NDArray[np.float64]
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
    """Zonal matrices at a state: derivatives, terms of the shape, variants, and their sum."""

    jacobian: NDArray[np.float64]
    by_width: NDArray[np.float64]
    terms: list[NDArray[np.float64]]
    variants: list[NDArray[np.float64]]
    total: NDArray[np.float64]
    #: Registration and width.
    at: NDArray[np.float64]


def _position(state: MixedEffectsState) -> NDArray[np.float64]:
    """Registration and relative width of a state ``(6,)``."""
    return np.append(state.alpha, 1.0 + state.width)


class VariantDerivatives:
    """Changes of a model's derivatives in its variants, kept as long as the registration hardly changes."""

    def __init__(self, model: SyntheticModel, variants: Sequence[SyntheticModel]) -> None:
        self._model, self._variants = model, variants
        self._at: NDArray[np.float64] | None = None
        self._base: NDArray[np.float64] | None = None
        self._changes: dict[int, NDArray[np.float32]] = {}

    def change(self, number: int, registration: Registration, width: float) -> NDArray[np.float32]:
        """Derivatives of a variant less those of the model ``(6, n_slopes, n_act)``."""
        at = np.append(registration.to_array(), width)
        if self._at is None or (np.abs(at - self._at) >= KEEP_DERIVATIVES_WITHIN).any():
            self._at, self._base = at, None
            self._changes.clear()
        if number not in self._changes:
            here, w = Registration.from_array(self._at[:5]), float(self._at[5])
            if self._base is None:
                self._base = zonal_jacobian(self._model, here, w)[1]
            difference = zonal_jacobian(self._variants[number], here, w)[1] - self._base
            self._changes[number] = difference.astype(np.float32)
        return self._changes[number]


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
    earlier
        A problem with the same model that was solved before, of which terms of the shape are used, and the
        derivatives at its solution if the matrix is the same, too.
    usual_priors
        Scatter that the limits of the estimated one are relative to.
    follow
        Whether the zonal derivatives of ``earlier``, which may have another matrix, are used as long as the
        zonal matrix hardly changes: for a mirror that moves slowly.
    """

    def __init__(
        self,
        weighted: WeightedMatrix,
        model: SyntheticModel,
        priors: Priors,
        command_curves: Sequence[NDArray[np.float64]] = (),
        extras: Sequence[ExtraParameterModel] = (),
        earlier: MixedEffectsProblem | None = None,
        usual_priors: Priors | None = None,
        follow: bool = False,
    ) -> None:
        self.weighted, self.command_curves, self.priors = weighted, tuple(command_curves), priors
        self.extras, self._usual_priors = tuple(extras), usual_priors or Priors()
        self.model, self.modes = model, self.weighted.modes
        self.variants = tuple(model.variants())
        rows, cols = np.nonzero(weighted.valid)
        self._mean_variant, scatters = self._prior_moments()
        # The x slopes of a column of sub-apertures share a sampling position, and the y slopes of a row.
        self.lines = np.unique(np.concatenate([cols, weighted.valid.shape[1] + rows]), return_inverse=True)[1]
        self.n_lines = int(self.lines.max()) + 1
        self.shape: InfluenceShape = earlier.shape if earlier else InfluenceShape(model)
        # Derivatives that :meth:`linearise` uses as long as the fitted matrix hardly changes.
        self.kept: tuple[_ZonalMatrices, NormalEquations] | None = None
        if earlier and earlier.weighted is weighted:
            self.kept = earlier.kept
        # The last extrapolated matrix with its state and derivatives: a step is tried before it is taken.
        self._extrapolated: tuple[MixedEffectsState, _ZonalMatrices, NDArray[np.float64]] | None = None
        self._follow = follow
        self.near: _ZonalMatrices | None = earlier.near if earlier and follow else None
        self.variant_derivatives: VariantDerivatives = (
            earlier.variant_derivatives if earlier else VariantDerivatives(model, self.variants)
        )
        self.trends = slope_trends(model, weighted.valid)
        self._mean_shape, self._mean_actuator = self._prior_mirror()
        self.precision = np.concatenate([
            np.zeros(6), [priors.width**-2], (priors.shape_scale * self.shape.prior_sigma) ** -2.0,
            scatters**-2,
            np.full(self.n_lines, priors.sampling**-2), np.ones(self.trends.shape[1]),
            *(np.full(model.n_act, self._actuator_precision(name)) for name in _ACTUATOR_PRIORS),
            np.full(weighted.data.shape[0], priors.slope_gain**-2),
        ])  # fmt: skip

    def _actuator_precision(self, name: str) -> float:
        """Prior precision of an effect of the actuators."""
        return float(self.priors.noise_inflation * getattr(self.priors, name) ** -2)

    def initial_state(self, registration: Registration) -> MixedEffectsState:
        """A registration, the gain that fits best there, and the prior means."""
        n_slopes = self.weighted.data.shape[0]
        model = self.weighted.weigh(modal_matrix(self.model, registration, self.modes))
        gain = float(np.vdot(model, self.weighted.data) / np.vdot(model, model))
        return MixedEffectsState(
            gain, registration.to_array(), self.priors.mean_width, self._mean_shape.copy(),
            self._mean_variant.copy(), np.zeros(self.n_lines), np.zeros(self.trends.shape[1]),
            self._mean_actuator.copy(), np.zeros(n_slopes),
        )  # fmt: skip

    def _prior_moments(self) -> NDArray[np.float64]:
        """Prior means and scatters of the shares of variants, extras and curves ``(2, n_variants)``."""
        shares = np.array([np.zeros(self.n_variants), np.ones(self.n_variants)])
        if self.priors.extras:
            first = len(self.variants)
            shares[:, first : first + len(self.extras)] = np.transpose(self.priors.extras)
        return shares

    def _prior_mirror(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Prior means of the shape ``(n_terms,)`` and the effects of actuators ``(n_effects, n_act)``."""
        shape, effects = np.zeros(self.shape.n_terms), np.zeros((N_ACTUATOR_EFFECTS, self.model.n_act))
        earlier = self.priors.actuators
        if earlier is not None:
            shape[: earlier.shape.size] = earlier.shape
            effects[:] = earlier.gain, earlier.width, *earlier.position
        return shape, effects

    def offset(self, state: MixedEffectsState) -> NDArray[np.float64]:
        """Distance of a state from the prior means, in the order of the unknowns."""
        shape, actuator = state.shape - self._mean_shape, state.actuator - self._mean_actuator
        common = [*np.zeros(6), state.width - self.priors.mean_width, *shape]
        effects = state.sampling, state.trend, actuator.ravel(), state.slope_gain
        return np.concatenate([common, state.variant - self._mean_variant, *effects])

    def actuator_gain_changes(self, state: MixedEffectsState) -> NDArray[np.float64]:
        """Relative gain of every actuator at a state less its prior mean ``(n_act,)``."""
        return np.asarray(state.actuator_gain - self._mean_actuator[0])

    @property
    def first_variant(self) -> int:
        """Index of the first variant among the unknowns."""
        return SHAPE + self.shape.n_terms

    @property
    def n_variants(self) -> int:
        """Number of shares: of variants, extra parameters and command curves."""
        return len(self.variants) + len(self.extras) + len(self.command_curves)

    def extra_parameter_values(self, state: MixedEffectsState) -> tuple[FittedExtraParameter, ...]:
        """The extra parameters at a state."""
        first = len(self.variants)
        return tuple(
            FittedExtraParameter(one, self.first_variant + first + k, float(state.variant[first + k]))
            for k, one in enumerate(self.extras)
        )

    def _zonal_matrices(self, state: MixedEffectsState) -> _ZonalMatrices:
        """The zonal matrix of a state and its parts."""
        registration, w = Registration.from_array(state.alpha), 1.0 + state.width
        shaped = self.shape.linearise(registration, w, state.shape)
        jacobian, variants = shaped.jacobian, []
        for number, (variant, share) in enumerate(zip(self.variants, state.variant, strict=False)):
            variants.append(variant.zonal_matrix(registration, w) - shaped.nominal)
            # A large share changes the derivatives by the registration.
            if abs(share) >= _SMALL_SHARE:
                jacobian = jacobian + share * self.variant_derivatives.change(number, registration, w)

        def profile_matrix(model: SyntheticModel, at: Registration) -> NDArray[np.float64]:
            return self.shape.profile_matrix(model, at, w, state.shape)

        first = len(self.variants)
        for extra, share in zip(self.extras, state.variant[first:], strict=False):
            variants.append(extra.matrix_change(profile_matrix, registration, float(share)))
        variants += [shaped.nominal @ command_curve for command_curve in self.command_curves]
        z = _ZonalMatrices(jacobian, jacobian[5] * w, shaped.terms, variants, shaped.matrix, _position(state))
        z.total = self._add_effects(shaped.matrix, state, z)
        return z

    def _matrices_nearby(self, state: MixedEffectsState) -> _ZonalMatrices:
        """The zonal matrix of a state and its parts, with derivatives from near it if they are to be kept."""
        if self.near is not None and (np.abs(_position(state) - self.near.at) < KEEP_WITHIN).all():
            total = self._extrapolate_zonal(state, self.near)
            if np.linalg.norm(total - self.near.total) < _FOLLOW_BELOW * np.linalg.norm(total):
                return replace(self.near, total=total)
        z = self._zonal_matrices(state)
        if self._follow:
            self.near = z
        return z

    @staticmethod
    def _add_effects(
        shaped: NDArray[np.float64], state: MixedEffectsState, z: _ZonalMatrices
    ) -> NDArray[np.float64]:
        """The zonal matrix of a state from that of the common shape, with the derivatives of ``z``."""
        _, width, along_x, along_y = state.actuator
        total = np.asarray(shaped + width * z.by_width)
        total += along_x * z.jacobian[0]
        total += along_y * z.jacobian[1]
        for share, difference in zip(state.variant, z.variants, strict=True):
            total += share * difference
        return total

    def _sampled(
        self, state: MixedEffectsState, total: NDArray[np.float64], z: _ZonalMatrices
    ) -> NDArray[np.float64]:
        """The zonal matrix with the sampling positions of a state.

        A position acts as a shift shared by the lenslets of a column (x) or a row (y).
        """
        half = len(total) // 2
        along_axes = np.concatenate([z.jacobian[0, :half], z.jacobian[1, half:]])
        return np.asarray(total + state.sampling[self.lines, None] * along_axes)

    def matrix(self, state: MixedEffectsState, m2c: NDArray[np.float64]) -> NDArray[np.float64]:
        """Slopes per unit of modes ``m2c (n_act, n)`` at a state, random effects included."""
        return self._with_gains(state, self._matrices_nearby(state)) @ m2c

    def linearise(self, state: MixedEffectsState) -> NormalEquations:
        """Model and derivatives about a state."""
        if self.kept is not None and (system := self._update_kept(state, *self.kept)):
            return system
        z = self._matrices_nearby(state)
        actuator_factor = 1 + state.actuator_gain
        # The weights of the slopes are applied together with their gains.
        scale = (state.gain * self._slope_gains(state) / self.weighted.by_slope)[:, None]
        parts = (z.total, *z.jacobian, *z.terms, *z.variants)
        common = np.empty((len(parts), *self.weighted.data.shape))
        scaled_modes = actuator_factor[:, None] * self.modes
        for part, derivative in zip(parts, common, strict=True):
            np.matmul(part, scaled_modes, out=derivative)
            derivative *= scale
        half = len(scale) // 2
        sampling_derivative = np.concatenate([common[1, :half], common[2, half:]])
        residual = self.weighted.data - common[0] - state.sampling[self.lines, None] * sampling_derivative
        model = common[0] / self._slope_gains(state)[:, None]
        common[0] /= state.gain
        system = normal_equations(
            common, self._actuator_derivatives(z, scale, actuator_factor), self.modes, model, residual,
            self.precision, self.offset(state), sampling_derivative, self.lines, self.trends,
            _MEAN_STIFFNESS * self._actuator_precision("actuator_gain"),
        )  # fmt: skip
        self.kept = z, system
        return system

    def relinearise(self, state: MixedEffectsState, system: LinearisedProblem) -> LinearisedProblem:
        """Model and derivatives about a state, of which ``system`` may have those from near it."""
        if self.kept is not None:
            residual = self.kept[1].residual
            change = np.linalg.norm(system.residual - residual)
            if change < _SAME_BELOW * np.linalg.norm(self.weighted.data - residual):
                return system
            self.kept = self.near = None
        return self.linearise(state)

    def _extrapolate_zonal(self, state: MixedEffectsState, z: _ZonalMatrices) -> NDArray[np.float64]:
        """The zonal matrix of a state, with derivatives from near it ``(n_slopes, n_act)``."""
        registration, w = Registration.from_array(state.alpha), 1.0 + state.width
        return self._add_effects(self.shape.matrix(registration, w, state.shape, z.terms), state, z)

    def _extrapolate(self, state: MixedEffectsState, z: _ZonalMatrices) -> NDArray[np.float64]:
        """The weighted matrix of a state, with derivatives from near it ``(n_slopes, n_modes)``."""
        if self._extrapolated is not None and self._extrapolated[:2] == (state, z):
            return self._extrapolated[2]
        total = self._extrapolate_zonal(state, z)
        scale = (state.gain * self._slope_gains(state) / self.weighted.by_slope)[:, None]
        modes = (1 + state.actuator_gain)[:, None] * self.modes
        model = np.asarray(scale * (self._sampled(state, total, z) @ modes))
        self._extrapolated = state, z, model
        return model

    def extrapolate_residual(self, state: MixedEffectsState) -> NDArray[np.float64]:
        """The residual about a state, with the derivatives of the last linearisation."""
        assert self.kept is not None
        return np.asarray(self.weighted.data - self._extrapolate(state, self.kept[0]))

    def _update_kept(
        self, state: MixedEffectsState, z: _ZonalMatrices, system: NormalEquations
    ) -> NormalEquations | None:
        """The system of a state with derivatives from near it; ``None`` if it is too far."""
        model = self._extrapolate(state, z)
        before = self.weighted.data - system.residual
        if np.linalg.norm(model - before) > _KEEP_BELOW * np.linalg.norm(before):
            return None
        return system.update(self.weighted.data - model, self.precision, self.offset(state))

    @staticmethod
    def _actuator_derivatives(
        z: _ZonalMatrices, scale: NDArray[np.float64], actuator_factor: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Weighted derivatives by the effects of the actuators ``(n_effects, n_slopes, n_act)``."""
        derivatives = np.stack([z.total, z.by_width, z.jacobian[0], z.jacobian[1]])
        derivatives *= scale
        derivatives[1:] *= actuator_factor
        return derivatives

    def _slope_gains(self, state: MixedEffectsState) -> NDArray[np.float64]:
        """Gain of every slope relative to the common one ``(n_slopes,)``."""
        return np.asarray(1 + state.slope_gain + self.trends @ state.trend)

    def zonal_matrix(self, state: MixedEffectsState) -> NDArray[np.float64]:
        """Slopes per unit command ``(n_slopes, n_act)`` at a state, random effects included."""
        return self._with_gains(state, self._zonal_matrices(state))

    def _with_gains(self, state: MixedEffectsState, z: _ZonalMatrices) -> NDArray[np.float64]:
        """The zonal matrix of a state from its parts, with sampling positions and gains."""
        scale = state.gain * self._slope_gains(state)
        return np.asarray(scale[:, None] * self._sampled(state, z.total, z) * (1 + state.actuator_gain))

    def estimate_priors(self, state: MixedEffectsState, system: NormalEquations) -> PriorEstimate:
        """Estimate the scatter of the random effects from a solution (:func:`estimate_scatters`)."""
        groups = self._effect_groups(system)
        usual, inner = self._usual_priors, len(system.schur_complement)
        bounds = {
            name: (_MIN_PRIOR_RATIO * getattr(usual, name), _MAX_PRIOR_RATIO * getattr(usual, name))
            for name in (*groups, "slope_gain")
        }
        # A misfit of the model enlarges the noise that the effects are compared with.
        noise = max(root_mean_square(system.residual), self.weighted.noise_level(system.residual))
        present = np.array([getattr(self.priors, name) for name in groups])
        ratios = estimate_scatters(
            system.schur_complement, self.offset(state)[:inner], self.precision[:inner],
            list(groups.values()),
            [np.divide(bounds[name], scatter) for name, scatter in zip(groups, present, strict=True)], noise,
        )  # fmt: skip
        # The fit takes the noise as one: relative to a larger one the priors are narrower.
        scatter = dict(zip(groups, (present * ratios / noise).tolist(), strict=True))
        # The slope gains were eliminated: one step of expectation and maximisation (Dempster, Laird & Rubin
        # 1977).
        variance = system.posterior_variance()
        mean_square = float(np.mean(np.square(state.slope_gain) + variance[inner:]))
        scatter["slope_gain"] = float(np.clip(np.sqrt(mean_square), *bounds["slope_gain"]))
        inflation = system.estimate_noise_inflation() if self.trends.shape[1] else 1.0
        priors = replace(self.priors, **scatter, noise_inflation=inflation)
        return PriorEstimate(priors, float(np.sum(1 - variance * self.precision)))

    def excess_scatters(self, state: MixedEffectsState, system: NormalEquations) -> dict[str, float]:
        """Groups of effects of the mirror that scatter by more than their priors can, and by how many times.

        The scatter is that of the bulk, from the median: single actuators may fail. Those of the sensor are
        not judged: lenslets of real benches scatter by more, and the registration hardly depends on it.
        """
        offset, usual = self.offset(state), self._usual_priors
        groups = self._effect_groups(system)
        relative = {
            name: offset[groups[name]] / getattr(usual, name) for name in ("shape_scale", *_ACTUATOR_PRIORS)
        }
        relative["shape_scale"] /= self.shape.prior_sigma
        ratios = {
            name: NORMAL_RATIO * float(np.median(np.abs(values))) / _MAX_PRIOR_RATIO
            for name, values in relative.items()
        }
        return {name: ratio for name, ratio in ratios.items() if ratio > 1}

    def _effect_groups(self, system: NormalEquations) -> dict[str, NDArray[np.intp]]:
        """Unknowns of each group of random effects, by the name of its scatter in :class:`Priors`."""
        inner, n_act = len(system.schur_complement), self.model.n_act
        first = inner - N_ACTUATOR_EFFECTS * n_act
        lines = np.arange(first - self.trends.shape[1] - self.n_lines, first - self.trends.shape[1])
        groups = {"shape_scale": np.arange(SHAPE, self.first_variant), "sampling": lines}
        for number, name in enumerate(_ACTUATOR_PRIORS):
            members = np.arange(first + number * n_act, first + (number + 1) * n_act)
            groups[name] = np.concatenate([groups[name], members]) if name in groups else members
        return groups

    def actuator_corrections(self, state: MixedEffectsState, system: NormalEquations) -> ActuatorCorrections:
        """Differences between the mirror of a solution and the nominal one."""
        inner = len(system.schur_complement)
        variance = np.diag(np.linalg.inv(system.schur_complement))[
            inner - N_ACTUATOR_EFFECTS * self.model.n_act :
        ]
        noise = self.weighted.noise_level(system.residual)
        # Rounding makes variances negative where a solution that is refused has no information.
        sigma = noise * np.sqrt(np.maximum(variance, 0.0)).reshape(N_ACTUATOR_EFFECTS, -1)
        gain, width, *position = state.actuator
        return ActuatorCorrections(
            gain, sigma[0], width, state.shape, np.array(position), sigma[1], sigma[2:]
        )  # fmt: skip

    def move(self, state: MixedEffectsState, step: NDArray[np.floating]) -> MixedEffectsState:
        """The state after a step, in the order of the unknowns."""
        n_act = self.model.n_act
        counts = self.n_variants, self.n_lines, self.trends.shape[1], N_ACTUATOR_EFFECTS * n_act
        variant, sampling, trend, actuators, slopes = np.split(step[self.first_variant :], np.cumsum(counts))
        # The matrix is linear in gain times share or effect, so the step is exact in that product.
        gain = state.gain + step[GAIN]
        gain_ratio = state.gain / gain if gain > _MIN_GAIN_RATIO * state.gain else 1.0
        return MixedEffectsState(
            gain, state.alpha + step[1:6],
            float(np.clip(state.width + step[WIDTH], -0.5, 1.0)),
            state.shape + gain_ratio * step[SHAPE : self.first_variant],
            state.variant + gain_ratio * variant, state.sampling + gain_ratio * sampling,
            state.trend + gain_ratio * trend, state.actuator + gain_ratio * actuators.reshape(-1, n_act),
            state.slope_gain + gain_ratio * slopes,
        )  # fmt: skip


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


def estimate_scatters(
    information: NDArray[np.float64],
    value: NDArray[np.float64],
    precision: NDArray[np.float64],
    groups: Sequence[NDArray[np.intp]],
    bounds: Sequence[Sequence[float] | NDArray[np.float64]],
    noise: float = 1.0,
) -> NDArray[np.float64]:
    """Scatter of groups of random effects that maximises the evidence, relative to the present one.

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
        Indices of the unknowns that share a factor on their prior scatter.
    bounds
        Smallest and largest factor of each group.
    noise
        Noise of the data in the units of ``information``.

    Returns
    -------
    ndarray, ``(n_groups,)``
    """
    # In units of the prior scatter, where there is one.
    unit = np.where(precision > 0, np.maximum(precision, 1e-300) ** -0.5, 1.0)
    data = (information - np.diag(precision)) * np.outer(unit, unit) / noise**2
    # The gradient vanishes at the solution.
    right_hand_side = unit * (information @ value) / noise**2
    prior, ratios = (precision > 0).astype(float), np.ones(len(groups))
    for _ in range(_ITERATIONS):
        factor, failed = dpotrf(data + np.diag(prior))
        if failed:  # no information on some unknown
            break
        posterior_mean, before = dpotrs(factor, right_hand_side)[0], ratios.copy()
        variance = np.diag(dpotri(factor, overwrite_c=True)[0])
        for number, (group, (smallest, largest)) in enumerate(zip(groups, bounds, strict=True)):
            n_determined = float(np.sum(1 - variance[group] * prior[group]))
            square = np.square(posterior_mean[group]).sum() / (n_determined + _PSEUDO_COUNT)
            ratios[number] = np.clip(np.sqrt(square), smallest, largest)
            prior[group] = ratios[number] ** -2
        if (np.abs(ratios / before - 1) < _NEGLIGIBLE_CHANGE).all():
            break
    return ratios
