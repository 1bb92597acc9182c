"""Slope maps of modes as arrays: the mosaic of all modes, and one mode in several matrices."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from escape_gui.views.images import slope_map_pair
from escape_hw.api.interaction_matrix import InteractionMatrix, snr_per_mode
from escape_hw.pipeline.statistics import root_mean_square

#: Limits of the colour scale, in units of the mode's rms slope (as in the report's figure).
LIMIT = 2.5
#: Colour index outside the pupil; values have the indices 1 to 255, a value of zero :data:`ZERO`.
OUTSIDE, ZERO = 0, 128
#: Pixels between the two maps of a mode and between modes.
_GAP, _MARGIN = 1, 3


@dataclass(frozen=True, slots=True)
class MosaicLayout:
    """Positions of the maps in the image of a page. All lengths are in sub-apertures, one pixel each."""

    #: Rows and columns of one map.
    shape: tuple[int, int]
    #: Number of modes per row and per column of the page.
    columns: int
    rows: int
    #: Space above each map for the number of the mode.
    head: int = 0

    @property
    def per_page(self) -> int:
        return self.columns * self.rows

    @property
    def cell(self) -> tuple[int, int]:
        """Height and width of the cell of a mode with its margin."""
        return self.shape[0] + _MARGIN + self.head, 2 * self.shape[1] + _GAP + _MARGIN

    @property
    def size(self) -> tuple[int, int]:
        height, width = self.cell
        return self.rows * height + _MARGIN, self.columns * width + _MARGIN

    def corner(self, position: int) -> tuple[int, int]:
        """Row and column of the first pixel of the map at a position on the page."""
        height, width = self.cell
        line, place = divmod(position, self.columns)
        return _MARGIN + self.head + line * height, _MARGIN + place * width

    def at(self, row: float, column: float) -> tuple[int, str, int, int] | None:
        """Position on the page, ``x`` or ``y``, row and column in the map at a point; ``None`` outside."""
        height, width = self.cell
        down, into_row = divmod(int(np.floor(row)) - _MARGIN - self.head, height)
        right, into_column = divmod(int(np.floor(column)) - _MARGIN, width)
        n_rows, n_columns = self.shape
        part, inside = divmod(into_column, n_columns + _GAP)
        on_map = into_row < n_rows and inside < n_columns and part < 2
        if not (on_map and 0 <= down < self.rows and 0 <= right < self.columns):
            return None
        return down * self.columns + right, "xy"[part], into_row, inside


def fit_layout(
    shape: tuple[int, int], n_modes: int, size: tuple[float, float], min_width: float, head: float
) -> MosaicLayout:
    """The layout with the most modes per page, for a widget of ``size`` (width, height).

    ``min_width`` is the minimum width of a mode's pair of maps, ``head`` the height of the number above it,
    all in screen pixels.
    """
    width, height = size
    best = MosaicLayout(shape, 1, 1)
    for columns in range(1, max(1, min(n_modes, int(width // min_width))) + 1):
        pixels = width / (columns * best.cell[1] + _MARGIN)
        one = MosaicLayout(shape, columns, 1, int(np.ceil(head / max(pixels, 1e-6))))
        rows = max(1, min(int((height / max(pixels, 1e-6) - _MARGIN) // one.cell[0]), -(-n_modes // columns)))
        if rows * columns > best.per_page or columns == 1:
            best = MosaicLayout(shape, columns, rows, one.head)
        if rows * columns >= n_modes:
            break
    return best


@dataclass(frozen=True, slots=True, eq=False)
class ModeStatistics:
    """Statistics of each mode."""

    #: Rms slope per unit mode ``(n_modes,)``.
    rms: NDArray[np.float64]
    #: Signal-to-noise ratio ``(n_modes,)``; infinite without standard errors.
    snr: NDArray[np.float64]

    @classmethod
    def of(cls, data: NDArray[np.floating], sigma: NDArray[np.floating] | None) -> ModeStatistics:
        """Compute from a matrix ``(n_slopes, n_modes)`` and its standard errors, if known."""
        rms = np.sqrt(np.mean(np.square(data, dtype=float), axis=0))
        if sigma is None or sigma.shape != data.shape:
            return cls(rms, np.full(rms.shape, np.inf))
        return cls(rms, np.asarray(snr_per_mode(data, np.nan_to_num(sigma, nan=0.0, posinf=0.0))))

    def wiener_weight(self) -> NDArray[np.float64]:
        """Fraction of each mode's power that is signal, SNR² / (1 + SNR²), from 0 to 1."""
        with np.errstate(invalid="ignore"):
            power = np.square(self.snr)
            return np.asarray(np.where(np.isinf(power), 1.0, power / (1.0 + power)))


def normalise_modes(
    data: NDArray[np.floating], statistics: ModeStatistics, weight_by_snr: bool
) -> NDArray[np.float32]:
    """Divide each mode of a matrix ``(n_slopes, n_modes)`` by its rms slope (paper: IM figures).

    ``weight_by_snr`` multiplies by the Wiener weight; otherwise noise looks like a strong mode.
    """
    scale = np.divide(1.0, statistics.rms, out=np.zeros_like(statistics.rms), where=statistics.rms > 0)
    if weight_by_snr:
        scale = scale * statistics.wiener_weight()
    return np.asarray(data * scale, dtype=np.float32)


def colour_indices(values: NDArray[np.floating], limit: float = LIMIT) -> NDArray[np.uint8]:
    """Colour indices of signed values, 1 to 255 with zero at 128; :data:`OUTSIDE` for NaN."""
    scaled = np.clip(np.nan_to_num(values, nan=0.0, posinf=limit, neginf=-limit) * (127 / limit), -127, 127)
    indices = (np.rint(scaled) + ZERO).astype(np.uint8)
    return np.where(np.isnan(values), np.uint8(OUTSIDE), indices)


def page_modes(layout: MosaicLayout, n_modes: int, page: int) -> range:
    """Modes on a page; ``page`` is limited to the pages there are."""
    page = max(0, min(page, pages(layout, n_modes) - 1))
    return range(page * layout.per_page, min(n_modes, (page + 1) * layout.per_page))


def pages(layout: MosaicLayout, n_modes: int) -> int:
    """Number of pages."""
    return max(1, -(-n_modes // layout.per_page))


def render_page(
    layout: MosaicLayout, valid: NDArray[np.bool_], values: NDArray[np.float32], modes: range
) -> NDArray[np.uint8]:
    """Colour indices of a page, from ``valid`` ``(rows, columns)`` and normalised ``(n_slopes, n_modes)``."""
    image = np.full(layout.size, OUTSIDE, np.uint8)
    rows, columns = layout.shape
    indices = colour_indices(values[:, modes.start : modes.stop])
    for position in range(len(modes)):
        top, left = layout.corner(position)
        for part, slopes in enumerate(np.split(indices[:, position], 2)):
            start = left + part * (columns + _GAP)
            image[top : top + rows, start : start + columns][valid] = slopes
    return image


#: Limits of the colour scale of differences.
_LIMITS = (0.1, 0.25, 0.5, 1.0, LIMIT)


@dataclass(frozen=True, slots=True, eq=False)
class MapTile:
    """Maps of x and y side by side."""

    #: Title, and numbers below it.
    title: str
    note: str
    #: ``(rows, 2 * columns + 1)``, NaN outside the pupil.
    maps: NDArray[np.floating]
    #: Limits of the colour scale.
    limits: tuple[float, float]
    #: Diverging colour scale with symmetric limits; otherwise sequential.
    signed: bool


def tiles(matrices: Mapping[str, InteractionMatrix], mode: int) -> list[MapTile]:
    """Tiles of one mode, index from 0; matrices by label, in display order.

    Slopes of each matrix that has the mode, divided by their rms; the difference of the last and the first
    matrix; standard error and signal-to-noise ratio of the last matrix with standard errors.
    """
    available = {label: one for label, one in matrices.items() if mode < one.n_modes}
    shown = [_slope_tile(label, one, mode) for label, one in available.items()]
    if len(available) > 1:
        labels = list(available)
        compared = (labels[-1], labels[0])
        shown += _difference_tile(compared, available[compared[0]], available[compared[1]], mode)
    with_errors = [(label, one) for label, one in available.items() if np.any(one.sigma[:, mode] > 0)]
    if with_errors:
        shown += _error_tiles(*with_errors[-1], mode)
    return shown


def _slope_tile(label: str, matrix: InteractionMatrix, mode: int) -> MapTile:
    column = matrix.data[:, mode].astype(float)
    rms = root_mean_square(column)
    snr = float(snr_per_mode(matrix.data[:, [mode]], matrix.sigma[:, [mode]])[0])
    with_errors = f", SNR {snr:.3g}" if np.isfinite(snr) else ""
    unit = "" if matrix.slope_unit == "1" else f" {matrix.slope_unit}"
    note = f"rms {rms:.3g}{unit}{with_errors}"
    return MapTile(label, note, slope_map_pair(column / (rms or 1.0), matrix.valid), (-LIMIT, LIMIT), True)


def _difference_tile(
    labels: Sequence[str], first: InteractionMatrix, second: InteractionMatrix, mode: int
) -> list[MapTile]:
    """First minus second, each divided by its rms over the common sub-apertures."""
    if first.valid.shape != second.valid.shape:
        return []
    a, b = (slope_map_pair(one.data[:, mode].astype(float), one.valid) for one in (first, second))
    both = np.isfinite(a) & np.isfinite(b)
    if not both.any():
        return []
    rms_a, rms_b = (root_mean_square(one[both]) or 1.0 for one in (a, b))
    difference = np.where(both, a / rms_a - b / rms_b, np.nan)
    correlation = float(np.mean(a[both] * b[both])) / (rms_a * rms_b)
    note = f"correlation {correlation:.3f}, relative gain {rms_a / rms_b:.2f}"
    spread = 3 * root_mean_square(difference[both])
    limit = next((one for one in _LIMITS if one >= spread), _LIMITS[-1])
    return [MapTile(f"{labels[0]} − {labels[1]}", note, difference, (-limit, limit), True)]


def _error_tiles(label: str, matrix: InteractionMatrix, mode: int) -> list[MapTile]:
    """Standard error relative to the rms slope, and ratio of slope to standard error."""
    column, sigma = matrix.data[:, mode].astype(float), matrix.sigma[:, mode].astype(float)
    rms = root_mean_square(column) or 1.0
    relative = sigma / rms
    top = float(np.nanmax(relative[np.isfinite(relative)], initial=0.0))
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.abs(column) / sigma
    middle = float(np.nanmedian(ratio))
    errors, ratios = slope_map_pair(relative, matrix.valid), slope_map_pair(ratio, matrix.valid)
    note = f"1 σ, rms {root_mean_square(sigma) / rms:.2g}"
    return [
        MapTile(f"Error of {label}", note, errors, (0.0, _round_up(top)), False),
        MapTile(f"SNR of {label}", f"median {middle:.3g}", ratios, (0.0, _round_up(2 * middle)), False),
    ]


def _round_up(value: float) -> float:
    """The next of 1, 2, 5, 10, ..., so that a scale does not change with small changes of the data."""
    if not 0 < value < np.inf:
        return 1.0
    decade = 10.0 ** np.floor(np.log10(value))
    return float(next(step for step in (1, 2, 5, 10) if step * decade >= value * (1 - 1e-9)) * decade)
