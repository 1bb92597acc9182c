"""One mode as several matrices see it, with their difference, errors and signal-to-noise ratio."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from escape_gui.views.mode_mosaic import LIMIT
from escape_hw.api.interaction_matrix import InteractionMatrix, snr_per_mode

#: Ends that the scale of differences may take.
_LIMITS = (0.1, 0.25, 0.5, 1.0, LIMIT)


@dataclass(frozen=True, slots=True, eq=False)
class MapTile:
    """A pair of maps, x and y beside each other.

    Parameters
    ----------
    title
        What it shows.
    note
        Numbers that go with it.
    maps
        ``(rows, 2 * columns + 1)``, NaN outside the pupil.
    limits
        Ends of the colour scale; symmetric for signed maps.
    signed
        Whether the sign matters.
    """

    title: str
    note: str
    maps: NDArray[np.float64]
    limits: tuple[float, float]
    signed: bool


def map_pair(valid: NDArray[np.bool_], slopes: NDArray[np.floating]) -> NDArray[np.float64]:
    """Maps of x and y with a column between them ``(rows, 2 * columns + 1)``, NaN outside the pupil."""
    rows, columns = valid.shape
    both = np.full((rows, 2 * columns + 1), np.nan)
    n = int(valid.sum())
    both[:, :columns][valid] = slopes[:n]
    both[:, columns + 1 :][valid] = slopes[n:]
    return both


def tiles(
    matrices: Mapping[str, InteractionMatrix], mode: int, compared: tuple[str, str] | None = None
) -> list[MapTile]:
    """Everything to be seen of one mode.

    Parameters
    ----------
    matrices
        By label, in the order to show them; those that lack the mode are left out.
    mode
        Counted from 0.
    beside
        Labels of the two whose difference is shown; by default the last and the first.

    Returns
    -------
    list of Tile
        One for each matrix, each divided by its own rms slope; the difference of two of them; standard
        error and signal-to-noise ratio of the last one that states errors.
    """
    available = {label: one for label, one in matrices.items() if mode < one.n_modes}
    found = [_slope_tile(label, one, mode) for label, one in available.items()]
    if compared is None and len(available) > 1:
        labels = list(available)
        compared = (labels[-1], labels[0])
    if compared is not None and set(compared) <= set(available):
        found += _difference_tile(compared, available[compared[0]], available[compared[1]], mode)
    with_errors = [(label, one) for label, one in available.items() if np.any(one.sigma[:, mode] > 0)]
    if with_errors:
        found += _error_tiles(*with_errors[-1], mode)
    return found


def _slope_tile(label: str, matrix: InteractionMatrix, mode: int) -> MapTile:
    column = matrix.data[:, mode].astype(float)
    rms = _rms(column)
    snr = float(snr_per_mode(matrix.data[:, [mode]], matrix.sigma[:, [mode]])[0])
    with_errors = f", SNR {snr:.3g}" if np.isfinite(snr) else ""
    unit = "" if matrix.slope_unit == "1" else f" {matrix.slope_unit}"
    note = f"rms {rms:.3g}{unit}{with_errors}"
    return MapTile(label, note, map_pair(matrix.valid, column / (rms or 1.0)), (-LIMIT, LIMIT), True)


def _difference_tile(
    labels: Sequence[str], first: InteractionMatrix, second: InteractionMatrix, mode: int
) -> list[MapTile]:
    """First less second, each divided by its rms over the sub-apertures that both have."""
    if first.valid.shape != second.valid.shape:
        return []
    a, b = (map_pair(one.valid, one.data[:, mode]) for one in (first, second))
    both = np.isfinite(a) & np.isfinite(b)
    if not both.any():
        return []
    rms_a, rms_b = (_rms(one[both]) or 1.0 for one in (a, b))
    difference = np.where(both, a / rms_a - b / rms_b, np.nan)
    correlation = float(np.mean(a[both] * b[both])) / (rms_a * rms_b)
    note = f"correlation {correlation:.3f}, gain {rms_a / rms_b:.2f}"
    limit = _smallest_limit(3 * _rms(difference[both]), _LIMITS)
    return [MapTile(f"{labels[0]} − {labels[1]}", note, difference, (-limit, limit), True)]


def _error_tiles(label: str, matrix: InteractionMatrix, mode: int) -> list[MapTile]:
    """Standard errors, and the ratio of slope to error."""
    column, sigma = matrix.data[:, mode].astype(float), matrix.sigma[:, mode].astype(float)
    rms = _rms(column) or 1.0
    relative = sigma / rms
    top = float(np.nanmax(relative[np.isfinite(relative)], initial=0.0))
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.abs(column) / sigma
    middle = float(np.nanmedian(ratio))
    return [
        MapTile(
            f"Error of {label}",
            f"1 σ, rms {_rms(sigma) / rms:.2g}",
            map_pair(matrix.valid, relative),
            (0.0, _round_up(top)),
            False,
        ),
        MapTile(
            f"SNR of {label}",
            f"median {middle:.3g}",
            map_pair(matrix.valid, ratio),
            (0.0, _round_up(2 * middle)),
            False,
        ),
    ]


def _smallest_limit(wanted: float, limits: tuple[float, ...]) -> float:
    """The least of the limits that is not below what is wanted, or the last."""
    return next((one for one in limits if one >= wanted), limits[-1])


def _round_up(value: float) -> float:
    """The next of 1, 2, 5, 10, ...; the end of a scale that stays put while numbers move a little."""
    if not 0 < value < np.inf:
        return 1.0
    decade = 10.0 ** np.floor(np.log10(value))
    return float(next(step for step in (1, 2, 5, 10) if step * decade >= value * (1 - 1e-9)) * decade)


def _rms(values: NDArray[np.float64]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))
