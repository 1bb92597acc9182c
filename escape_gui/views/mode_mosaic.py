"""Mosaic of slope maps: x and y of each mode side by side, modes row by row in one image."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.interaction_matrix import snr_per_mode

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
    """Divide each mode by its rms slope, for a common symmetric scale (paper: IM figures).

    Parameters
    ----------
    data
        Matrix ``(n_slopes, n_modes)``.
    weight_by_snr
        Multiply by the Wiener weight; otherwise noise looks like a strong mode.
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
    """Image of a page: colour indices as of :func:`colour_indices`.

    Parameters
    ----------
    valid
        Valid sub-apertures ``(rows, columns)``.
    values
        Normalised matrix ``(n_slopes, n_modes)``, see :func:`normalise_modes`.
    modes
        Modes of the page.
    """
    image = np.full(layout.size, OUTSIDE, np.uint8)
    rows, columns = layout.shape
    indices = colour_indices(values[:, modes.start : modes.stop])
    for position in range(len(modes)):
        top, left = layout.corner(position)
        for part, slopes in enumerate(np.split(indices[:, position], 2)):
            start = left + part * (columns + _GAP)
            image[top : top + rows, start : start + columns][valid] = slopes
    return image
