"""Figure of the residual of a fit over the sub-apertures and the actuators."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from escape_hw.api.results import GoodnessOfFit, find_outliers
from escape_hw.report.figures import style

_MAP = "viridis"
#: The colours end at this percentile, so that a few outliers, which are marked, do not hide the rest.
_PERCENTILE = 98.0
#: Least end of the colour scale in standard errors: the residuals of noise are of one colour.
_MIN_LIMIT = 2.0
_LABEL = "rms residual [standard errors]"


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
    shown = np.concatenate([found.by_sub_aperture, found.by_actuator])
    limit = max(float(np.percentile(shown, _PERCENTILE)), _MIN_LIMIT)
    _draw_map(pupil, found.by_sub_aperture, _grid_places(valid), limit, "sub-apertures")
    rms, axes = found.by_actuator, [pupil]
    if layout is not None and int(layout.sum()) == rms.size:
        places_m = _grid_places(layout)
    if places_m is not None and len(places_m) == rms.size:
        _draw_map(mirror, rms, places_m, limit, "actuators")
        axes.append(mirror)
    else:
        style.style_axes(mirror).plot(rms, ".", color=style.SERIES[0], ms=4)
        mirror.axhline(1.0, color=style.MUTED, lw=1.0, ls=":")
        mirror.set(xlabel="actuator", ylabel=_LABEL, ylim=(0, None))
        mirror.set_title(_title("actuators", rms), color=style.INK, fontsize=9.5)
    extend = "max" if shown.max(initial=0.0) > limit else "neither"
    style.colour_bar(figure, axes, _MAP, (0.0, limit), _LABEL, extend=extend)
    return figure


def _grid_places(used: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Columns and rows of the used places of a grid ``(n, 2)``."""
    return np.argwhere(used)[:, ::-1].astype(float)


def _title(kind: str, rms: NDArray[np.float64]) -> str:
    return f"{kind}: median {np.median(rms):.2g}, largest {rms.max():.2g}"


def _draw_map(
    axes: Axes, rms: NDArray[np.float64], places: NDArray[np.float64], limit: float, kind: str
) -> None:
    """Draw values at their places ``(n, 2)`` as (x, y), rows downwards; outliers with a border."""
    width = np.zeros(rms.size)
    width[find_outliers(rms)] = 1.6
    # An actuator out of service has no residual, which is not a good fit.
    judged = np.where(rms > 0, rms, np.nan)
    spots, radius = style.discs(places, style.map_colours(judged, _MAP, 0.0, limit), width)
    spots.set_edgecolor(style.SERIES[5])
    style.hide_axes(axes).add_collection(spots)
    low, high = places.min(axis=0) - 1.2 * radius, places.max(axis=0) + 1.2 * radius
    axes.set(xlim=(low[0], high[0]), ylim=(high[1], low[1]), aspect="equal")
    axes.set_title(_title(kind, rms), color=style.INK, fontsize=9.5)
