"""Statistics of the slopes over a run: mean, rms, correlation over time, and static focus."""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.sensor import SensorGeometry, SubApertureGrid

#: Lag of the correlation in frames: a poke is gone from the slopes, turbulence is not.
_LAG_FRAMES = 2
#: Blocks of a run at most whose means give the correlation over time; at least half as many.
_MAX_BLOCKS = 64
#: Blocks below which the number of independent realisations is unknown.
_MIN_BLOCKS = 4
#: Share of the slopes' variance below which turbulence cannot be distinguished from noise.
_MIN_TURBULENCE_FRACTION = 0.02
#: Block length of the focus regression in seconds: long for vibrations and pokes, short for the wind to cross
#: the pupil.
_BLOCK_S = 0.05
#: Fewest rows of the regression, for its five unknowns.
_MIN_ROWS = 16
#: Share of the variance of the focus that the wind must explain. A single layer leaves at least 0.92, two
#: layers at right angles at most 0.8, for which the plain mean is better (docs/decisions).
_MIN_EXPLAINED_VARIANCE = 0.9
_FOCUS_INDEX = 2


class SlopeStatistics:
    """Running mean, rms and temporal correlation of the slopes, and the rms of the pokes."""

    def __init__(self, n_slopes: int) -> None:
        self.n_slopes = n_slopes
        self._n_frames = 0
        self._sum = np.zeros(n_slopes)
        self._sum_of_squares = np.zeros(n_slopes)
        self._poke_power = self._lag_products = self._tilt_power = self._tilt_lag_products = 0.0
        self._n_lag_pairs = 0
        self._recent_slopes: deque[NDArray[np.float32]] = deque(maxlen=_LAG_FRAMES)
        self._blocks, self._block_length = [np.zeros(n_slopes)], 1

    def add(self, slopes: NDArray[np.float32], poke: NDArray[np.float64] | None = None) -> None:
        """Add the slopes of one frame ``(n_slopes,)``, and its poke ``(n_modes,)``."""
        if self._n_frames == self._block_length * len(self._blocks):
            if len(self._blocks) == _MAX_BLOCKS:
                self._blocks = [a + b for a, b in zip(self._blocks[::2], self._blocks[1::2], strict=True)]
                self._block_length *= 2
            self._blocks.append(np.zeros(self.n_slopes))
        self._blocks[-1] += slopes
        tilt = _tilts(slopes)
        if len(self._recent_slopes) == _LAG_FRAMES:
            self._lag_products += float(self._recent_slopes[0] @ slopes)
            self._tilt_lag_products += float((_tilts(self._recent_slopes[0]) * tilt).mean())
            self._n_lag_pairs += 1
        self._recent_slopes.append(slopes.copy())
        self._n_frames += 1
        self._sum += slopes
        self._sum_of_squares += np.square(slopes, dtype=np.float64)
        self._tilt_power += float(np.square(tilt).mean())
        if poke is not None:
            self._poke_power += float(poke @ poke)

    def extend(self, slopes: NDArray[np.float32]) -> None:
        """Add the slopes of many frames ``(n, n_slopes)`` to mean and rms, not to the correlation."""
        self._n_frames += len(slopes)
        self._sum += slopes.sum(axis=0, dtype=np.float64)
        self._sum_of_squares += np.einsum("ts,ts->s", slopes, slopes, dtype=np.float64)
        self._tilt_power += float(np.square(_tilts(slopes)).mean(axis=1).sum())

    def state(self) -> NDArray[np.float64]:
        """All sums and counts ``(7 + blocks, n_slopes)``, for :meth:`restore`."""
        numbers = (
            float(self._n_frames),
            self._poke_power,
            self._lag_products,
            float(self._n_lag_pairs),
            float(self._block_length),
        )
        rows = (np.full(self.n_slopes, number) for number in numbers)
        out = np.stack([self._sum, self._sum_of_squares, *rows, *self._blocks])
        # States of older versions, which can be resumed, have the number of frames here as well.
        out[2, 1:3] = self._tilt_power, self._tilt_lag_products
        return out

    def restore(self, state: NDArray[np.float64]) -> None:
        """Continue from the array of :meth:`state`."""
        self._sum, self._sum_of_squares, self._n_frames = state[0].copy(), state[1].copy(), int(state[2, 0])
        self._poke_power, self._lag_products = float(state[3, 0]), float(state[4, 0])
        self._n_lag_pairs, self._block_length = int(state[5, 0]), int(state[6, 0])
        self._tilt_power = float(state[2, 1]) if state[2, 1] != state[2, 0] else 0.0
        self._tilt_lag_products = float(state[2, 2]) if state[2, 2] != state[2, 0] else np.nan
        self._blocks = [row.copy() for row in state[7:]]
        self._recent_slopes.clear()

    def annotate_geometry(self, grid: SensorGeometry, *, closed: bool = False) -> SensorGeometry:
        """Return the geometry with mean and rms of the slopes, pokes, independent samples and persistence.

        In closed loop (``closed``) the persistent part of the slopes is not attributed to turbulence, and the
        rms of the tilt is given instead.
        """
        if self._n_frames < 2:
            return grid
        mean_squares = self._sum_of_squares / self._n_frames
        variance = float(np.maximum(mean_squares - np.square(self._sum / self._n_frames), 0).mean())
        poke_rms = float(np.sqrt(self._poke_power / self._n_frames))
        persistent_fraction = self._persistence(variance)
        n_effective = self._effective_samples(variance, persistent_fraction, poked=poke_rms > 0)
        return grid.with_slope_statistics(
            float(np.sqrt(variance)), poke_rms, n_effective, 0.0 if closed else persistent_fraction,
            self._tilt_rms() if closed else 0.0, self._sum / self._n_frames,
        )  # fmt: skip

    def update_references(
        self, grid: SensorGeometry, focus_estimator: StaticFocusEstimator | None = None
    ) -> SensorGeometry:
        """Return the geometry with references from the mean slopes of all frames of the run.

        ``focus_estimator``, fed with the same frames, replaces the mean focus by the static focus.
        """
        if self._n_frames < 2:
            return grid
        mean = self._sum / self._n_frames
        return grid.with_mean_slopes(mean if focus_estimator is None else focus_estimator.correct_mean(mean))

    def _tilt_rms(self) -> float:
        """Rms per axis of the slopes' mean over the pupil, about its mean over time."""
        mean = np.square(_tilts(self._sum) / self._n_frames).mean()
        return float(np.sqrt(max(self._tilt_power / self._n_frames - mean, 0.0)))

    def _persistence(self, variance: float) -> float:
        """Correlation of the slopes at a lag of :data:`_LAG_FRAMES`, between 0 and 1."""
        if not self._n_lag_pairs or not variance > 0:
            return 0.0
        mean = float(np.square(self._sum / self._n_frames).sum())
        correlation = (self._lag_products / self._n_lag_pairs - mean) / (variance * self.n_slopes)
        return float(np.clip(correlation, 0.0, 1.0))

    def _effective_samples(self, variance: float, persistent_fraction: float, *, poked: bool) -> float:
        """Number of independent realisations of the turbulence: of the slopes, or of their tilts if fewer.

        The large scales of the turbulence last longest, and change the sensitivity of a pyramid most.
        """
        complete = self._blocks[: self._n_frames // self._block_length]
        if len(complete) < _MIN_BLOCKS or not variance > 0:
            return 0.0
        means = np.stack(complete) / self._block_length
        n_effective = self._realisations(means, variance, persistent_fraction if poked else 1.0)
        tilt_variance = self._tilt_rms() ** 2
        if tilt_variance > 0:
            mean = np.square(_tilts(self._sum) / self._n_frames).mean()
            fraction = (self._tilt_lag_products / self._n_lag_pairs - mean) / tilt_variance
            fraction = float(np.clip(fraction, 0.0, 1.0)) if poked and np.isfinite(fraction) else 1.0
            n_effective = min(n_effective, self._realisations(_tilts(means), tilt_variance, fraction))
        return n_effective

    def _realisations(self, means: NDArray[np.float64], variance: float, turbulence_fraction: float) -> float:
        """Independent realisations in the run, from the means over its blocks ``(n_blocks, n)``.

        The variance of a mean over many correlation times is that of the turbulence times the integral of
        its correlation, over the duration. The correlations between blocks are added up to the first one
        that is not positive (initial positive sequence, Geyer 1992). Noise and pokes, all but
        ``turbulence_fraction`` of the variance, are new in every frame. Turbulence that outlasts the run
        is in its mean, so that a run has at least about four realisations.
        """
        if turbulence_fraction <= _MIN_TURBULENCE_FRACTION:
            return float(self._n_frames)
        deviations = means - means.mean(axis=0)
        n_blocks, n = means.shape
        covariance = np.array(
            [np.vdot(deviations[: n_blocks - lag], deviations[lag:]) for lag in range(n_blocks)]
        ) / (n_blocks * n)
        covariance[0] -= (1 - turbulence_fraction) * variance / self._block_length
        ends = np.flatnonzero(covariance[1:] <= 0)
        total = covariance[0] + 2 * covariance[1 : 1 + int(ends[0]) if len(ends) else None].sum()
        integral = self._block_length * total / (turbulence_fraction * variance)
        return self._n_frames / max(float(integral), 1.0)


def _tilts(slopes: NDArray[np.floating]) -> NDArray[np.float64]:
    """Means of the x and of the y slopes over the pupil ``(..., 2)``."""
    return np.asarray(slopes.reshape(*slopes.shape[:-1], 2, -1).mean(axis=-1, dtype=np.float64))


class StaticFocusEstimator:
    """Separates the static focus of the instrument from the mean focus of wind-driven turbulence.

    Frozen turbulence obeys ``d s / dt = -(v . grad) s``. With a weight w over the pupil and its potential u
    (``grad u = -w r``, u = 0 at the rim), partial integration gives

        d/dt sum(u s_x) = -v_x sum(w x s_x) - v_y sum(w y s_x),   and likewise for s_y.

    The rates of the tilts therefore depend on focus and astigmatism of the turbulence alone, because static
    aberrations have no rate. The square lattice of the instrument has focus (its pitch) but no astigmatism.
    Focus is regressed on the rates of both tilts and on both astigmatisms; the intercept is the static focus.
    The wind need not be known.
    """

    def __init__(self, grid: SubApertureGrid, frame_rate_hz: float) -> None:
        self._grid = grid
        self._weights = _moment_weights(grid.valid).astype(np.float32)
        self._block_frames = max(1, round(_BLOCK_S * frame_rate_hz))
        self._sum, self._count = np.zeros(grid.n_slopes, np.float32), 0
        self._blocks: list[NDArray[np.float32]] = []

    def add(self, slopes: NDArray[np.float32]) -> None:
        """Add the slopes of the next frame ``(n_slopes,)``."""
        self._sum += slopes
        self._count += 1
        if self._count == self._block_frames:
            self._blocks.append(self._weights @ (self._sum / np.float32(self._block_frames)))
            self._sum[:], self._count = 0, 0

    def state(self) -> NDArray[np.float32]:
        """Moments of all blocks ``(n, 5)``, for :meth:`restore`."""
        return np.array(self._blocks, np.float32).reshape(-1, len(self._weights))

    def restore(self, blocks: NDArray[np.float32]) -> None:
        """Continue from the blocks of an interrupted run, with a gap after them."""
        self._blocks = [*blocks, np.full(len(self._weights), np.nan, np.float32)]

    def static_focus(self) -> float | None:
        """Static focus, as slope per sub-aperture from the middle.

        ``None`` if the run is too short, or if a single wind does not explain the changes of the focus
        (several layers, or no turbulence).
        """
        blocks = np.array(self._blocks, dtype=np.float64).reshape(-1, len(self._weights))
        # Values and rates are smoothed equally.
        value = (blocks[:-2] + 2 * blocks[1:-1] + blocks[2:]) / 4
        rate = (blocks[2:, :_FOCUS_INDEX] - blocks[:-2, :_FOCUS_INDEX]) / 2
        known = np.isfinite(value).all(axis=1) & np.isfinite(rate).all(axis=1)
        value, rate = value[known], rate[known]
        if len(value) < _MIN_ROWS:
            return None
        terms = np.column_stack([np.ones(len(value)), rate, value[:, _FOCUS_INDEX + 1 :]])
        focus = value[:, _FOCUS_INDEX]
        coefficients = np.linalg.lstsq(terms, focus, rcond=None)[0]
        dof = len(terms) - terms.shape[1]
        residual_variance = float(np.square(focus - terms @ coefficients).sum()) / dof
        if residual_variance > (1 - _MIN_EXPLAINED_VARIANCE) * float(focus.var(ddof=1)):
            return None
        return float(coefficients[0])

    def correct_mean(self, mean: NDArray[np.float64]) -> NDArray[np.float64]:
        """Mean slopes ``(n_slopes,)`` with the static focus in place of the mean focus, where it is known."""
        focus = self.static_focus()
        if focus is None:
            return mean
        rows, columns = np.nonzero(self._grid.valid)
        weight = self._grid.flux[self._grid.valid].astype(float)
        at = np.stack([columns, rows]) - np.array([[columns @ weight], [rows @ weight]]) / weight.sum()
        positions = at.ravel()
        xy_weights = np.concatenate([weight, weight])
        fitted_focus = float(xy_weights @ (positions * mean)) / float(xy_weights @ np.square(positions))
        return np.asarray(mean + (focus - fitted_focus) * positions)


def _moment_weights(valid: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Weights ``(5, n_slopes)`` of both tilts, focus and both astigmatisms; w is zero at the rim."""
    rows, columns = np.nonzero(valid)
    x, y = columns - columns.mean(), rows - rows.mean()
    r2 = x * x + y * y
    # The rim lies half a sub-aperture beyond the centre of the outermost one.
    w = 1 - r2 / (np.sqrt(r2.max()) + 0.5) ** 2
    u, zero = np.square(w), np.zeros_like(w)
    total = (w * r2).sum()
    shapes = [
        (u / u.sum(), zero),
        (zero, u / u.sum()),
        (w * x / total, w * y / total),
        (w * x / total, -w * y / total),
        (w * y / total, w * x / total),
    ]
    return np.array([np.concatenate(shape) for shape in shapes])
