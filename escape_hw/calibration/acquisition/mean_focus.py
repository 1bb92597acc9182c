"""The turbulence's own share in the mean focus of a run, told from how it moves on."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.sensor import SubApertureGrid

#: Length of a block in seconds: long for vibrations and pokes, short for the wind to cross the pupil.
_BLOCK_S = 0.05
#: Fewest rows of the regression, for its five unknowns.
_MIN_ROWS = 16
#: Share of the variance of the focus that the wind must explain. One layer leaves 0.92 and more, two
#: layers at right angles 0.8 and less, and there the plain mean is the better one (docs/decisions).
_MIN_EXPLAINED_VARIANCE = 0.9
_FOCUS_INDEX = 2


class StaticFocusEstimator:
    """Follows tilt, focus and astigmatism of the slopes and tells their mean focus without the wind's.

    Turbulence that the wind carries past obeys ``d s / dt = -(v . grad) s``. With a weight w over the
    pupil and its potential u (``grad u = -w r``, u = 0 at the rim), partial integration gives

        d/dt sum(u s_x) = -v_x sum(w x s_x) - v_y sum(w y s_x),   and likewise for s_y.

    So the rate at which the tilts change tells focus and astigmatism of the air alone: what stands
    still in the instrument has no rate. And the instrument's square lattice has focus (its pitch), but
    no astigmatism. Focus is therefore regressed on the rates of both tilts and on both astigmatisms,
    and the intercept is the focus that stands still. Nothing about the wind need be known.

    Parameters
    ----------
    grid
        The sensor's grid.
    frame_rate_hz
        Of the sensor.
    """

    def __init__(self, grid: SubApertureGrid, frame_rate_hz: float) -> None:
        self._grid = grid
        self._weights = _weights(grid.valid).astype(np.float32)
        self._block_frames = max(1, round(_BLOCK_S * frame_rate_hz))
        self._sum, self._count = np.zeros(grid.n_slopes, np.float32), 0
        self._blocks: list[NDArray[np.float32]] = []

    def add(self, slopes: NDArray[np.float32]) -> None:
        """Take the slopes of the next frame ``(n_slopes,)``."""
        self._sum += slopes
        self._count += 1
        if self._count == self._block_frames:
            self._blocks.append(self._weights @ (self._sum / np.float32(self._block_frames)))
            self._sum[:], self._count = 0, 0

    def state(self) -> NDArray[np.float32]:
        """All blocks so far ``(n, 5)``, for :meth:`restore`."""
        return np.array(self._blocks, np.float32).reshape(-1, len(self._weights))

    def restore(self, blocks: NDArray[np.float32]) -> None:
        """Go on from the blocks of a run that was broken off; what came between is not known."""
        self._blocks = [*blocks, np.full(len(self._weights), np.nan, np.float32)]

    def static_focus(self) -> float | None:
        """Focus that stands still, as slope per sub-aperture from the middle; ``None`` if unknown.

        It is unknown when the run is too short, and when the wind does not explain how focus changes:
        several layers, or no turbulence.
        """
        blocks = np.array(self._blocks, dtype=np.float64).reshape(-1, len(self._weights))
        # Smoothed alike, so that rates and values belong together.
        value = (blocks[:-2] + 2 * blocks[1:-1] + blocks[2:]) / 4
        rate = (blocks[2:, :_FOCUS_INDEX] - blocks[:-2, :_FOCUS_INDEX]) / 2
        known = np.isfinite(value).all(axis=1) & np.isfinite(rate).all(axis=1)
        value, rate = value[known], rate[known]
        if len(value) < _MIN_ROWS:
            return None
        terms = np.column_stack([np.ones(len(value)), rate, value[:, _FOCUS_INDEX + 1 :]])
        focus = value[:, _FOCUS_INDEX]
        coefficients = np.linalg.lstsq(terms, focus, rcond=None)[0]
        residual_variance = float(np.square(focus - terms @ coefficients).sum()) / (
            len(terms) - terms.shape[1]
        )
        if residual_variance > (1 - _MIN_EXPLAINED_VARIANCE) * float(focus.var(ddof=1)):
            return None
        return float(coefficients[0])

    def correct_mean(self, mean: NDArray[np.float64]) -> NDArray[np.float64]:
        """Mean slopes ``(n_slopes,)`` with the focus that stands still instead of the mean one.

        Where that is unknown they stay as they are.
        """
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


def _weights(valid: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Weights ``(5, n_slopes)`` of both tilts, focus and both astigmatisms; w falls off to the rim."""
    rows, columns = np.nonzero(valid)
    x, y = columns - columns.mean(), rows - rows.mean()
    r2 = x * x + y * y
    # The rim lies half a sub-aperture beyond the outermost one's middle.
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
