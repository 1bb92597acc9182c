"""SPRINT's problem at one state: model, derivatives, weights, and the system that they make."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.matrix import InteractionMatrix
from escape_hw.api.model import SyntheticModel
from escape_hw.api.registration import Registration
from escape_hw.calibration.misfit import NormalEquations, Priors, normal_equations

#: Half steps of the central differences, in the units of the parameters.
_STEPS = np.array([2.0, 2.0, 0.05, 0.2, 0.2])
_WIDTH_STEP = 0.05
#: Width of the broad pedestal that influence functions may stand on, relative to their own.
_PEDESTAL = 1.7
#: Places of the common parameters among the unknowns; the registration has places 1 to 5.
GAIN, WIDTH, SHAPE = 0, 6, 7


@dataclass(slots=True, eq=False)
class State:
    """Present values: common parameters and random effects."""

    gain: float
    alpha: NDArray[np.float64]
    width: float
    shape: float
    variant: NDArray[np.float64]
    sampling: NDArray[np.float64]
    actuator_gain: NDArray[np.float64]
    actuator_width: NDArray[np.float64]
    slope_gain: NDArray[np.float64]

    def offset(self) -> NDArray[np.float64]:
        """Distance from the priors' means, in the order of the unknowns."""
        head = np.concatenate([[0.0], np.zeros(5), [self.width, self.shape]])
        return np.concatenate(
            [head, self.variant, self.sampling, self.actuator_gain, self.actuator_width, self.slope_gain]
        )


def _near(rows: NDArray[np.intp], columns: NDArray[np.intp], reach: float) -> NDArray[np.float64]:
    """How near slopes are ``(n_slopes, n_slopes)``: 1 in one place, falling to 0 at ``reach`` lenslets."""
    down, right = (np.abs(at[:, None] - at[None, :]) / reach for at in (rows, columns))
    weight = np.maximum(1 - down, 0.0) * np.maximum(1 - right, 0.0)
    return np.tile(weight, (2, 2))


class Problem:
    """One matrix, one model, and the weights between them."""

    def __init__(
        self, matrix: InteractionMatrix, model: SyntheticModel, columns: NDArray[np.intp], priors: Priors
    ) -> None:
        data = matrix.data[:, columns].astype(float)
        sigma = matrix.sigma[:, columns].astype(float)
        self.model, self.priors = model, priors
        self.m2c = matrix.m2c[:, columns]
        self.measured_errors = bool((sigma > 0).all())
        if self.measured_errors:
            # Standard errors factor into slopes' noise and modes' excitation: both estimators say so.
            power = np.log(sigma)
            self.by_slope = np.exp(power.mean(axis=1) - power.mean())
            self.by_mode = np.exp(power.mean(axis=0))
        else:
            self.by_slope = np.ones(data.shape[0])
            self.by_mode = np.full(data.shape[1], max(float(data.std()), 1e-30))
        self.data = data / self.by_slope[:, None] / self.by_mode
        self.modes = self.m2c / self.by_mode
        self.variants = tuple(model.variants())
        rows, cols = np.nonzero(matrix.valid)
        # x slopes share what their column does to them, y slopes what their row does.
        self.lines = np.unique(np.concatenate([cols, matrix.valid.shape[1] + rows]), return_inverse=True)[1]
        self.n_lines = int(self.lines.max()) + 1
        self.near = _near(rows, cols, max(matrix.valid.shape) / 2)
        self.precision = np.concatenate(
            [
                np.zeros(6),
                [priors.width**-2, priors.shape**-2],
                np.ones(len(self.variants)),
                np.full(self.n_lines, priors.sampling**-2),
                np.full(model.n_act, priors.actuator_gain**-2),
                np.full(model.n_act, priors.actuator_width**-2),
                np.full(data.shape[0], priors.slope_gain**-2),
            ]
        )

    def start(self, registration: Registration) -> State:
        """State to start from: a registration, and the gain that fits it."""
        n_act, n_slopes = self.model.n_act, self.data.shape[0]
        zeros = np.zeros(n_act)
        model = self._weighted(self.model.zonal_matrix(registration)) @ self.modes
        gain = float(np.vdot(model, self.data) / np.vdot(model, model))
        return State(
            gain,
            registration.to_array(),
            0.0,
            0.0,
            np.zeros(len(self.variants)),
            np.zeros(self.n_lines),
            zeros,
            zeros.copy(),
            np.zeros(n_slopes),
        )

    def _weighted(self, zonal: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(zonal / self.by_slope[:, None])

    def linearise(self, state: State) -> NormalEquations:
        """Model and derivatives about a state."""
        here, w = Registration.from_array(state.alpha), 1.0 + state.width
        zonal = {0: self._weighted(self.model.zonal_matrix(here, w))}
        for side in (-1, 1):
            zonal[side] = self._weighted(self.model.zonal_matrix(here, w * (1 + side * _WIDTH_STEP)))
        by_width = (zonal[1] - zonal[-1]) / (2 * _WIDTH_STEP)
        by_shape = self._weighted(self.model.zonal_matrix(here, w * _PEDESTAL)) - zonal[0]
        moved = []
        for k, step in enumerate(_STEPS):
            d = np.eye(5)[k] * step
            plus, minus = (
                self._weighted(self.model.zonal_matrix(Registration.from_array(state.alpha + s * d), w))
                for s in (1, -1)
            )
            moved.append((plus - minus) / (2 * step))
        rows = (1 + state.slope_gain)[:, None]
        acting = 1 + state.actuator_gain
        shaped = zonal[0] + state.shape * by_shape + state.actuator_width * by_width

        def modal(z: NDArray[np.float64]) -> NDArray[np.float64]:
            return np.asarray(rows * (z * acting) @ self.modes)

        variants = [self._weighted(v.zonal_matrix(here, w)) - zonal[0] for v in self.variants]
        for share, difference in zip(state.variant, variants, strict=True):
            shaped = shaped + share * difference
        unit = modal(shaped)
        parts = (*moved, by_width, by_shape, *variants)
        common = np.stack([unit, *(state.gain * modal(z) for z in parts)])
        # Where a slope samples the wavefront: a shift shared by the lenslets of a column (x) or row (y).
        sampled = np.zeros((self.lines.max() + 1, *unit.shape))
        half = unit.shape[0] // 2
        rows_of = np.arange(unit.shape[0])
        sampled[self.lines, rows_of] = np.where((rows_of < half)[:, None], common[1], common[2])
        common = np.concatenate([common, sampled])
        model = state.gain * unit + np.einsum("l,lsm->sm", state.sampling, sampled)
        return normal_equations(
            common,
            state.gain * rows * shaped,
            state.gain * rows * by_width * acting,
            self.modes,
            state.gain * (shaped * acting) @ self.modes,
            self.data - model,
            self.precision,
            state.offset(),
        )

    def move(self, state: State, step: NDArray[np.floating]) -> State:
        """The state after a step, in the order of the unknowns."""
        n_act = self.model.n_act
        v, n = len(self.variants), len(self.variants) + self.n_lines
        variant, sampling, gains, widths, slopes = np.split(step[8:], [v, n, n + n_act, n + 2 * n_act])
        return State(
            state.gain + step[GAIN],
            state.alpha + step[1:6],
            float(np.clip(state.width + step[WIDTH], -0.5, 1.0)),
            float(np.clip(state.shape + step[SHAPE], -0.5, 0.5)),
            state.variant + variant,
            state.sampling + sampling,
            state.actuator_gain + gains,
            state.actuator_width + widths,
            state.slope_gain + slopes,
        )
