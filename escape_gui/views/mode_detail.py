"""One mode in several matrices, with their difference, standard error and signal-to-noise ratio."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from escape_gui.views.images import slope_map_pair
from escape_gui.views.mode_mosaic import LIMIT
from escape_hw.api.interaction_matrix import InteractionMatrix, snr_per_mode

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


def tiles(
    matrices: Mapping[str, InteractionMatrix], mode: int, compared: tuple[str, str] | None = None
) -> list[MapTile]:
    """Tiles of one mode.

    Parameters
    ----------
    matrices
        By label, in display order; matrices without the mode are left out.
    mode
        Index from 0.
    compared
        Labels of the two matrices whose difference is shown; by default the last and the first.

    Returns
    -------
    list of MapTile
        Slopes of each matrix divided by their rms; the difference of two matrices; standard error and
        signal-to-noise ratio of the last matrix with standard errors.
    """
    available = {label: one for label, one in matrices.items() if mode < one.n_modes}
    shown = [_slope_tile(label, one, mode) for label, one in available.items()]
    if compared is None and len(available) > 1:
        labels = list(available)
        compared = (labels[-1], labels[0])
    if compared is not None and set(compared) <= set(available):
        shown += _difference_tile(compared, available[compared[0]], available[compared[1]], mode)
    with_errors = [(label, one) for label, one in available.items() if np.any(one.sigma[:, mode] > 0)]
    if with_errors:
        shown += _error_tiles(*with_errors[-1], mode)
    return shown


def _slope_tile(label: str, matrix: InteractionMatrix, mode: int) -> MapTile:
    column = matrix.data[:, mode].astype(float)
    rms = _rms(column)
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
    rms_a, rms_b = (_rms(one[both]) or 1.0 for one in (a, b))
    difference = np.where(both, a / rms_a - b / rms_b, np.nan)
    correlation = float(np.mean(a[both] * b[both])) / (rms_a * rms_b)
    note = f"correlation {correlation:.3f}, relative gain {rms_a / rms_b:.2f}"
    spread = 3 * _rms(difference[both])
    limit = next((one for one in _LIMITS if one >= spread), _LIMITS[-1])
    return [MapTile(f"{labels[0]} − {labels[1]}", note, difference, (-limit, limit), True)]


def _error_tiles(label: str, matrix: InteractionMatrix, mode: int) -> list[MapTile]:
    """Standard error relative to the rms slope, and ratio of slope to standard error."""
    column, sigma = matrix.data[:, mode].astype(float), matrix.sigma[:, mode].astype(float)
    rms = _rms(column) or 1.0
    relative = sigma / rms
    top = float(np.nanmax(relative[np.isfinite(relative)], initial=0.0))
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.abs(column) / sigma
    middle = float(np.nanmedian(ratio))
    errors, ratios = slope_map_pair(relative, matrix.valid), slope_map_pair(ratio, matrix.valid)
    note = f"1 σ, rms {_rms(sigma) / rms:.2g}"
    return [
        MapTile(f"Standard error of {label}", note, errors, (0.0, _round_up(top)), False),
        MapTile(f"SNR of {label}", f"median {middle:.3g}", ratios, (0.0, _round_up(2 * middle)), False),
    ]


def _round_up(value: float) -> float:
    """The next of 1, 2, 5, 10, ..., so that a scale does not change with small changes of the data."""
    if not 0 < value < np.inf:
        return 1.0
    decade = 10.0 ** np.floor(np.log10(value))
    return float(next(step for step in (1, 2, 5, 10) if step * decade >= value * (1 - 1e-9)) * decade)


def _rms(values: NDArray[np.float64]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))
