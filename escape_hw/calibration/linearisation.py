"""SPRINT's problem at one state: model, derivatives, weights, and the system that they make."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.departures import PEDESTAL, MirrorDepartures
from escape_hw.api.model import SyntheticModel
from escape_hw.api.registration import Registration
from escape_hw.calibration.derivatives import modal_matrix, pedestal_jacobian, zonal_jacobian
from escape_hw.calibration.evidence import believed
from escape_hw.calibration.extra_unknowns import ExtraUnknown, FoundExtra
from escape_hw.calibration.misfit import NormalEquations, Priors, normal_equations
from escape_hw.calibration.slope_trends import slope_trends
from escape_hw.calibration.weighted import WeightedMatrix

#: Places of the common parameters among the unknowns; the registration has places 1 to 5.
GAIN, WIDTH, SHAPE = 0, 6, 7


#: Shares of a variant below which its derivatives are taken for the model's own.
_SMALL_SHARE = 0.25
#: Share of the pedestal below which the whole is taken to move as the influence functions do without it.
_SMALL_PEDESTAL = 0.05
#: Share of the gain down to which a step may take it for shares to follow its product with them.
_LEAST_KEPT = 0.05
#: Random effects of which there are many of a kind, in the order of the unknowns ...
_EFFECTS = ("sampling", "actuator_gain", "actuator_width", "slope_gain")
#: ... and the shares of their usual scatter below and above which none is taken to be.
_LEAST_SCATTER, _MOST_SCATTER = 0.05, 1.0


@dataclass(frozen=True, slots=True)
class Learned:
    """Scatter of the random effects as the data have it, and how many unknowns the data decided."""

    priors: Priors
    decided: float


@dataclass(slots=True, eq=False)
class State:
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
class _Shapes:
    """Zonal matrices at a state, in standard errors: derivatives, variants, and the whole."""

    moved: NDArray[np.float64]
    by_width: NDArray[np.float64]
    by_shape: NDArray[np.float64]
    variants: list[NDArray[np.float64]]
    shaped: NDArray[np.float64]


class Problem:
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
        bends: Sequence[NDArray[np.float64]] = (),
        extras: Sequence[ExtraUnknown] = (),
    ) -> None:
        self.weighted, self.bends, self.priors = weighted, tuple(bends), priors
        self.extras = tuple(extras)
        self.model, self.modes = model, self.weighted.modes
        self.variants = tuple(model.variants())
        rows, cols = np.nonzero(weighted.valid)
        means, scatters = self._told()
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
                np.full(model.n_act, priors.shared * priors.actuator_gain**-2),
                np.full(model.n_act, priors.actuator_width**-2),
                np.full(weighted.data.shape[0], priors.slope_gain**-2),
            ]
        )

    def start(self, registration: Registration) -> State:
        """State to start from: a registration, and the gain that fits it."""
        n_act, n_slopes = self.model.n_act, self.weighted.data.shape[0]
        zeros = np.zeros(n_act)
        model = self.weighted.weigh(modal_matrix(self.model, registration, self.modes))
        gain = float(np.vdot(model, self.weighted.data) / np.vdot(model, model))
        return State(
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

    def _told(self) -> NDArray[np.float64]:
        """Prior means and scatters of variants, extra unknowns and bends in shares ``(2, n_variants)``."""
        shares = np.array([np.zeros(self.n_variants), np.ones(self.n_variants)])
        if self.priors.extras:
            first = len(self.variants)
            shares[:, first : first + len(self.extras)] = np.transpose(self.priors.extras)
        return shares

    def offset(self, state: State) -> NDArray[np.float64]:
        """Distance of a state from the priors' means, in the order of the unknowns."""
        return state.offset(*self._means)

    @property
    def n_variants(self) -> int:
        """Shares of variants, extra unknowns and bends among the unknowns."""
        return len(self.variants) + len(self.extras) + len(self.bends)

    def extras_found(self, state: State) -> tuple[FoundExtra, ...]:
        """The extra unknowns at a state."""
        first = len(self.variants)
        return tuple(
            FoundExtra(one, SHAPE + 1 + first + k, float(state.variant[first + k]))
            for k, one in enumerate(self.extras)
        )

    def _changes(self, state: State) -> list[NDArray[np.float64]]:
        """What one share of each extra unknown does to the zonal matrix, not weighted."""
        here, w, first = Registration.from_array(state.alpha), 1.0 + state.width, len(self.variants)
        return [one.per_share(here, w, float(state.variant[first + k])) for k, one in enumerate(self.extras)]

    def _shapes(self, state: State) -> _Shapes:
        """The zonal matrix of a state and what it is made of, weighted."""
        here, w, weigh = Registration.from_array(state.alpha), 1.0 + state.width, self.weighted.weigh
        zonal, moved = (weigh(part) for part in zonal_jacobian(self.model, here, w))
        base = moved
        variants = []
        for variant, share in zip(self.variants, state.variant, strict=False):
            if abs(share) < _SMALL_SHARE:
                variants.append(weigh(variant.zonal_matrix(here, w)) - zonal)
                continue
            # What a large share brings with it moves with the mirror in a way of its own.
            changed, changes = (weigh(part) for part in zonal_jacobian(variant, here, w))
            variants.append(changed - zonal)
            moved = moved + share * (changes - base)
        if abs(state.shape) < _SMALL_PEDESTAL:
            broad = weigh(self.model.zonal_matrix(here, w * PEDESTAL))
        else:
            broad, changes = (weigh(part) for part in pedestal_jacobian(self.model, here, w))
            moved = moved + state.shape * (changes - base)
        by_width, by_shape = moved[5] * w, broad - zonal
        variants += [weigh(change) for change in self._changes(state)]
        variants += [zonal @ bend for bend in self.bends]
        shaped = zonal + state.shape * by_shape + state.actuator_width * by_width
        for share, difference in zip(state.variant, variants, strict=True):
            shaped = shaped + share * difference
        return _Shapes(moved, by_width, by_shape, variants, shaped)

    def matrix(self, state: State, m2c: NDArray[np.float64]) -> NDArray[np.float64]:
        """Slopes per unit of any modes ``(n_slopes, n)`` at a state, random effects included.

        Parameters
        ----------
        state
            Where.
        m2c
            Modes ``(n_act, n)``.
        """
        return self.zonal(state) @ m2c

    def linearise(self, state: State) -> NormalEquations:
        """Model and derivatives about a state."""
        z = self._shapes(state)
        moved, by_width, by_shape, variants, shaped = z.moved, z.by_width, z.by_shape, z.variants, z.shaped
        rows, acting = self._slope_gains(state)[:, None], 1 + state.actuator_gain
        acted = acting[:, None] * self.modes

        def modal(z: NDArray[np.float64]) -> NDArray[np.float64]:
            return np.asarray(rows * (z @ acted))

        unit = modal(shaped)
        common = np.stack([unit, *(state.gain * modal(z) for z in (*moved, by_shape, *variants))])
        # Where a slope samples the wavefront: a shift shared by the lenslets of a column (x) or row (y).
        half = unit.shape[0] // 2
        sampled = np.concatenate([common[1, :half], common[2, half:]])
        model = state.gain * unit + state.sampling[self.lines, None] * sampled
        return normal_equations(
            common,
            state.gain * rows * shaped,
            state.gain * rows * by_width * acting,
            self.modes,
            state.gain * (shaped @ acted),
            self.weighted.data - model,
            self.precision,
            self.offset(state),
            sampled,
            self.lines,
            self.trends,
        )

    def _slope_gains(self, state: State) -> NDArray[np.float64]:
        """Gain of every slope beside the common one ``(n_slopes,)``."""
        return np.asarray(1 + state.slope_gain + self.trends @ state.trend)

    def zonal(self, state: State) -> NDArray[np.float64]:
        """Slopes per unit command ``(n_slopes, n_act)`` at a state, random effects included."""
        z = self._shapes(state)
        half = len(z.shaped) // 2
        sampled = np.concatenate([z.moved[0, :half], z.moved[1, half:]])
        whole = z.shaped + state.sampling[self.lines, None] * sampled
        scale = state.gain * self._slope_gains(state) * self.weighted.by_slope
        return np.asarray(scale[:, None] * whole * (1 + state.actuator_gain))

    def learned(self, state: State, system: NormalEquations) -> Learned:
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
        parts = lines, self.priors.shared * gains, widths, slopes
        for name, part in zip(_EFFECTS, parts, strict=True):
            least = _LEAST_SCATTER * getattr(usual, name)
            found = float(np.mean(np.square(getattr(state, name)) + part))
            scatter[name] = max(float(np.sqrt(found)), least)
        if self.trends.shape[1]:
            scatter["shared"] = system.shared_noise()
        decided = float(np.sum(1 - variance * self.precision))
        return Learned(replace(self.priors, **scatter), decided)

    def departures(self, state: State, system: NormalEquations) -> MirrorDepartures:
        """How the mirror of a solution differs from the model's.

        Parameters
        ----------
        state, system
            Solution, and the problem about it.
        """
        # Slopes' gains, eliminated first, come last.
        inner = len(system.whole)
        n_act = self.model.n_act
        kinds = slice(inner - 2 * n_act, inner - n_act), slice(inner - n_act, inner)
        usual = Priors()
        bounds = [
            (_LEAST_SCATTER * each, _MOST_SCATTER * each)
            for each in (usual.actuator_gain, usual.actuator_width)
        ]
        # Where the model does not fit, single actuators are to be believed less.
        rms = float(np.sqrt(np.mean(np.square(system.residual))))
        value, sigma = believed(
            system.whole, self.offset(state)[:inner], self.precision[:inner], kinds, bounds,
            max(rms, self.weighted.noise(system.residual)),
        )  # fmt: skip
        gains, widths = kinds
        return MirrorDepartures(value[gains], sigma[gains], value[widths], state.shape)

    def move(self, state: State, step: NDArray[np.floating]) -> State:
        """The state after a step, in the order of the unknowns."""
        n_act = self.model.n_act
        counts = self.n_variants, self.n_lines, self.trends.shape[1], n_act, n_act
        variant, sampling, trend, gains, widths, slopes = np.split(step[8:], np.cumsum(counts))
        # What gain and shares make together is linear in their product: there the step is exact.
        gain = state.gain + step[GAIN]
        kept = state.gain / gain if gain > _LEAST_KEPT * state.gain else 1.0
        return State(
            gain,
            state.alpha + step[1:6],
            float(np.clip(state.width + step[WIDTH], -0.5, 1.0)),
            float(np.clip(state.shape + kept * step[SHAPE], -0.5, 0.5)),
            state.variant + kept * variant,
            state.sampling + sampling,
            state.trend + trend,
            state.actuator_gain + gains,
            state.actuator_width + widths,
            state.slope_gain + slopes,
        )
