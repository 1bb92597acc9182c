"""Mirror surface of all actuators for a command, in single precision, and its drift with the registration."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numba import njit
from numpy.typing import NDArray

from escape_hw.api.registration import PARAMETERS, Registration
from escape_sim.mirror.influence_functions import InfluenceFunctions
from escape_sim.mirror.measured import MeasuredInfluenceFunctions
from escape_sim.mirror.rounded_exponential import ExponentialInfluenceFunctions

if TYPE_CHECKING:
    from escape_hw.config.twin import TwinDrift


#: Height, relative to the peak, below which an influence function is omitted. The error of a surface is
#: below this times the command, summed over distant actuators.
NEGLIGIBLE_HEIGHT = 1e-6
#: Speed of a matrix product relative to the loop over windows, per multiplication (measured: 4 to 7).
_GEMM_SPEEDUP = 6.0


#: Influence functions of a mirror under any registration.
InfluenceModel = InfluenceFunctions | MeasuredInfluenceFunctions | ExponentialInfluenceFunctions
#: Surface ``(n_y, n_x)`` in fractions of full stroke for a command ``(n_act,)``, on a fixed grid.
SurfaceFunction = Callable[[NDArray[np.float64]], NDArray[np.float32]]


def make_mirror_surface(
    influence: InfluenceModel,
    registration: Registration,
    sub_aperture_m: float,
    x_m: NDArray[np.float64],
    y_m: NDArray[np.float64],
) -> SurfaceFunction:
    """Build the fastest surface function for these influence functions.

    One matrix product over all actuators is fastest if each reaches across much of the pupil; with
    many actuators it is faster to add each on the samples that it reaches. Registration and grid are given
    as for :meth:`InfluenceFunctions.factors`.
    """
    if not isinstance(influence, InfluenceFunctions):
        return GriddedSurface(influence.surfaces(registration, sub_aperture_m, x_m, y_m))
    along_x, along_y = influence.factors(registration, sub_aperture_m, x_m, y_m)
    windows = WindowedSurface(along_x, along_y)
    dense = x_m.size * y_m.size * influence.n_act * along_x.shape[2]
    return windows if windows.products * _GEMM_SPEEDUP < dense else DenseSurface(along_x, along_y)


class DenseSurface:
    """Separable influence functions, added by one matrix product.

    ``along_x (n_x, n_act, n_terms)`` and ``along_y (n_y, n_act, n_terms)`` are the factors of
    :meth:`InfluenceFunctions.factors`.
    """

    def __init__(self, along_x: NDArray[np.float64], along_y: NDArray[np.float64]) -> None:
        self._terms = along_x.shape[2]
        self._x = np.ascontiguousarray(along_x.reshape(len(along_x), -1).T, dtype=np.float32)
        self._y = np.ascontiguousarray(along_y.reshape(len(along_y), -1), dtype=np.float32)

    def __call__(self, command: NDArray[np.float64]) -> NDArray[np.float32]:
        """Surface ``(n_y, n_x)`` in fractions of full stroke for a command ``(n_act,)``."""
        weights = np.repeat(command, self._terms).astype(np.float32)
        return np.asarray((self._y * weights) @ self._x)


def _windows(
    profile: NDArray[np.float64], threshold: NDArray[np.float64] | float
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """First sample and the one after the last ``(k,)`` where each profile ``(n, k)`` exceeds a threshold."""
    above = np.abs(profile) > threshold
    reached = above.any(axis=0)
    first = np.where(reached, above.argmax(axis=0), 0)
    return first, np.where(reached, len(profile) - above[::-1].argmax(axis=0), 0)


class WindowedSurface:
    """Separable influence functions, each added on the samples that it reaches.

    Factors as for :class:`DenseSurface`. ``products`` is the number of multiplications per surface.
    """

    def __init__(self, along_x: NDArray[np.float64], along_y: NDArray[np.float64]) -> None:
        n_x, _, terms = along_x.shape
        x, y = along_x.reshape(n_x, -1), along_y.reshape(len(along_y), -1)
        # The threshold applies to the product with the largest value of the other factor.
        highest_x, highest_y = (np.maximum(np.abs(f).max(axis=0), 1e-30) for f in (x, y))
        # Factors of one actuator contiguous in memory, in the order of the actuators.
        self._x, self._y = (np.ascontiguousarray(f.T, dtype=np.float32) for f in (x, y))
        self._left, self._right = _windows(x, NEGLIGIBLE_HEIGHT / highest_y)
        self._top, self._bottom = _windows(y, NEGLIGIBLE_HEIGHT / highest_x)
        self._terms, self._shape = terms, (len(along_y), n_x)
        self.products = int(((self._right - self._left) * (self._bottom - self._top)).sum())

    def __call__(self, command: NDArray[np.float64]) -> NDArray[np.float32]:
        """Surface ``(n_y, n_x)`` in fractions of full stroke for a command ``(n_act,)``."""
        out = np.zeros(self._shape, np.float32)
        _add_windows(
            np.asarray(command, np.float32), self._terms, self._x, self._y, self._left, self._right,
            self._top, self._bottom, out,
        )  # fmt: skip
        return out


@njit(cache=True, fastmath=True, nogil=True)
def _add_windows(command, terms, along_x, along_y, left, right, top, bottom, out):  # type: ignore[no-untyped-def]  # pragma: no cover
    for k in range(along_x.shape[0]):
        weight = command[k // terms]
        if weight == 0:
            continue
        line = along_x[k, left[k] : right[k]]
        for i in range(top[k], bottom[k]):
            factor = weight * along_y[k, i]
            target = out[i, left[k] : right[k]]
            for j in range(line.size):
                target[j] += factor * line[j]


class GriddedSurface:
    """Influence functions of any shape ``(n_act, n_y, n_x)``, each added on the samples that it reaches.

    The samples are stored by rows, all actuators of a row together: reading them takes most of the time.
    """

    def __init__(self, surfaces: NDArray[np.float64]) -> None:
        size = np.abs(surfaces)
        threshold = NEGLIGIBLE_HEIGHT * float(size.max())
        top, bottom = _windows(size.max(axis=2).T, threshold)
        left, right = _windows(size.max(axis=1).T, threshold)
        n_y, n_x = self._shape = surfaces.shape[1:]
        rows, columns = np.arange(n_y)[:, None], np.arange(n_x)
        reached = ((top <= rows) & (rows < bottom))[:, :, None] & (
            (left[:, None] <= columns) & (columns < right[:, None])
        )
        self._samples = surfaces.transpose(1, 0, 2)[reached].astype(np.float32)
        self._left, self._right, self._top, self._bottom = left, right, top, bottom

    def __call__(self, command: NDArray[np.float64]) -> NDArray[np.float32]:
        """Surface ``(n_y, n_x)`` in fractions of full stroke for a command ``(n_act,)``."""
        out = np.zeros(self._shape, np.float32)
        _add_rows(
            np.asarray(command, np.float32), self._samples, self._left, self._right, self._top, self._bottom,
            out,
        )  # fmt: skip
        return out


@njit(cache=True, fastmath=True, nogil=True)
def _add_rows(command, samples, left, right, top, bottom, out):  # type: ignore[no-untyped-def]  # pragma: no cover
    begin = 0
    for i in range(out.shape[0]):
        for k in range(command.size):
            if top[k] <= i < bottom[k]:
                weight = command[k]
                line = samples[begin : begin + right[k] - left[k]]
                begin += line.size
                if weight == 0:
                    continue
                target = out[i, left[k] : right[k]]
                for j in range(line.size):
                    target[j] += weight * line[j]


#: Largest change of each parameter, in its unit, before the surface is computed anew. The shifts'
#: 0.01 % of a sub-aperture is a fifth of the smallest uncertainty of a registration.
_MAX_PARAMETER_CHANGE = np.array([0.01, 0.01, 3e-4, 0.003, 0.003])


class Flexure:
    """True registration of the mirror as a function of time, from ``start`` at time zero.

    ``update_interval_s`` is the time after which a parameter may have changed enough for a new surface;
    between surfaces ``interpolation_interval_s`` apart linear interpolation is as accurate.
    """

    def __init__(self, start: Registration, drift: TwinDrift) -> None:
        self._start, self._drift = start, drift
        rate, swing = (
            np.array([getattr(part, name) for name in PARAMETERS]) for part in (drift.rate, drift.swing)
        )
        max_rate = float(
            ((np.abs(rate) + np.abs(swing) * 2 * math.pi / drift.period_s) / _MAX_PARAMETER_CHANGE).max()
        )
        self.update_interval_s = 1 / max_rate if max_rate else math.inf
        # The second bound is for sinusoids whose whole amplitude is less than a hundred changes.
        self.interpolation_interval_s = min(100 * self.update_interval_s, drift.period_s / 64)

    def at(self, time_s: float) -> Registration:
        """Registration at a time of the twin's clock in seconds."""
        registration = Registration.from_array(self._start.to_array() + self._drift.offsets_at(time_s))
        return replace(registration, anamorphosis_angle=self._start.anamorphosis_angle)


class DriftingSurface:
    """Function from commands to surfaces under a drifting registration.

    The surface depends on the time only. Separable influence functions are recomputed once per
    ``flexure.update_interval_s``; others, which take longer, a hundred times less often, with linear
    interpolation in between. Parameters as for :func:`make_mirror_surface`.
    """

    def __init__(
        self,
        influence: InfluenceModel,
        flexure: Flexure,
        sub_aperture_m: float,
        x_m: NDArray[np.float64],
        y_m: NDArray[np.float64],
    ) -> None:
        self._influence, self._flexure, self._sub_aperture_m = influence, flexure, sub_aperture_m
        self._x, self._y = x_m, y_m
        interval_s = flexure.update_interval_s
        self._interpolated = not isinstance(influence, InfluenceFunctions) and math.isfinite(interval_s)
        self._interval_s = flexure.interpolation_interval_s if self._interpolated else interval_s
        self._steps = {0: self._surface_of_step(0)}

    def __call__(self, command: NDArray[np.float64], time_s: float) -> NDArray[np.float32]:
        """Surface ``(n_y, n_x)`` in fractions of full stroke for a command ``(n_act,)`` at a time."""
        number = math.floor(time_s / self._interval_s)
        wanted = (number, number + 1) if self._interpolated else (number,)
        steps = self._steps
        if not steps.keys() >= set(wanted):
            steps = self._steps = {step: steps.get(step) or self._surface_of_step(step) for step in wanted}
        if not self._interpolated:
            return steps[number](command)
        share = time_s / self._interval_s - number
        return steps[number]((1 - share) * command) + steps[number + 1](share * command)

    def _surface_of_step(self, number: int) -> SurfaceFunction:
        """Surface function for the middle of interval ``number``; if they are interpolated, for its start."""
        time_s = 0.0
        if math.isfinite(self._interval_s):
            time_s = (number if self._interpolated else number + 0.5) * self._interval_s
        registration = self._flexure.at(time_s)
        return make_mirror_surface(self._influence, registration, self._sub_aperture_m, self._x, self._y)
