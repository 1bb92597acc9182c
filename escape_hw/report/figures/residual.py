"""Figure of the residual of a fit over the sub-apertures and the actuators."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PatchCollection
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from numpy.typing import NDArray

from escape_hw.api.results import GoodnessOfFit, find_outliers
from escape_hw.report.figures import style

_MAP = "viridis"
#: The colours end at this percentile, so that a few outliers, which are marked, do not hide the rest.
_PERCENTILE = 98.0
#: Least end of the colour scale in standard errors: the residuals of noise are of one colour.
_MIN_LIMIT = 2.0


def residual_map(
    found: GoodnessOfFit,
    valid: NDArray[np.bool_],
    layout: NDArray[np.bool_] | None = None,
    places_m: NDArray[np.float64] | None = None,
) -> Figure:
    """Rms residual of the sub-apertures and of the actuators in standard errors.

    Parameters
    ----------
    found
        The residuals.
    valid
        Valid sub-apertures ``(n_rows, n_columns)``.
    layout, places_m
        Map of the actuators, or their positions ``(n_act, 2)``. Without either, or with those of another
        mirror, the actuators are shown by their number.
    """
    figure = style.new_figure(8.4, 3.9)
    pupil, mirror = figure.subplots(1, 2)
    rows, columns = np.nonzero(valid)
    _draw_map(figure, pupil, found.by_sub_aperture, np.stack([columns, rows], axis=1), "sub-apertures")
    rms = found.by_actuator
    if layout is not None and int(layout.sum()) == rms.size:
        rows, columns = np.nonzero(layout)
        _draw_map(figure, mirror, rms, np.stack([columns, rows], axis=1), "actuators")
    elif places_m is not None and len(places_m) == rms.size:
        _draw_map(figure, mirror, rms, places_m, "actuators")
    else:
        style.style_axes(mirror).plot(rms, ".", color=style.SERIES[0], ms=4)
        mirror.axhline(1.0, color=style.MUTED, lw=1.0, ls=":")
        mirror.set(xlabel="actuator", ylabel="rms residual [standard errors]", ylim=(0, None))
        mirror.set_title("actuators", fontsize=9.5)
    return figure


def _draw_map(
    figure: Figure, axes: Axes, rms: NDArray[np.float64], places: NDArray[np.float64], title: str
) -> None:
    """Draw values at their places ``(n, 2)`` as (x, y), rows downwards, with a colour bar of their own."""
    limit = max(float(np.percentile(rms, _PERCENTILE)), _MIN_LIMIT)
    distance = np.hypot(*(places[:, None, k] - places[:, k] for k in (0, 1)))
    np.fill_diagonal(distance, np.inf)
    radius = 0.5 * float(np.median(distance.min(axis=1))) if len(places) > 1 else 0.5
    spots = PatchCollection([Circle((x, y), radius) for x, y in places], linewidths=0)
    spots.set_facecolor([tuple(c) for c in style.map_colours(rms, _MAP, 0.0, limit)])
    style.hide_axes(axes).add_collection(spots)
    marked = [Circle(places[k], radius) for k in find_outliers(rms)]
    axes.add_collection(PatchCollection(marked, facecolor="none", edgecolor=style.SERIES[5], linewidth=1.2))
    low, high = places.min(axis=0) - radius, places.max(axis=0) + radius
    axes.set(xlim=(low[0], high[0]), ylim=(high[1], low[1]), aspect="equal")
    axes.set_title(f"{title}, median {np.median(rms):.2g}", color=style.INK, fontsize=9.5)
    style.colour_bar(figure, [axes], _MAP, (0.0, limit), "rms residual [standard errors]")
