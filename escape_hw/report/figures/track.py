"""Time series of a tracked run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from escape_hw.report.figures import style


def track_figure(
    track: Mapping[str, Sequence[float | None]],
    exchanges: Sequence[Mapping[str, Any]],
    alarms: Sequence[Mapping[str, Any]],
    injected: Mapping[str, Sequence[float]] | None = None,
) -> Figure:
    """Shift, rotation, optical gain and Strehl ratio (or residual) against time, with error bands.

    Parameters
    ----------
    track
        Columns of the table, see :data:`~escape_hw.api.tracking.COLUMNS`.
    exchanges, alarms
        Their ``seconds`` are marked; of exchanges, those ``accepted``.
    injected
        True registration of a twin at the table's moments, by parameter.
    """
    columns = {name: np.array(values, float) for name, values in track.items()}
    t = columns["seconds"]
    figure = style.new_figure(9.2, 6.2)
    panels = figure.subplots(2, 2, sharex=True).ravel()
    for colour, name in zip(style.SERIES, ("shift_x", "shift_y"), strict=False):
        median = float(np.median(columns[name])) if t.size else 0.0
        _draw_with_error(
            panels[0], t, columns[name] - median, columns[f"{name}_sigma"], colour, name.replace("_", " ")
        )
        if injected is not None:
            panels[0].plot(t, np.array(injected[name]) - median, ":", color=style.INK, lw=1.2)
    style.style_axes(panels[0]).set_title("shift about its median [% of a sub-aperture]", fontsize=9.5)
    panels[0].legend(frameon=False, fontsize=8)
    _draw_with_error(panels[1], t, columns["rotation"], columns["rotation_sigma"], style.SERIES[0])
    if injected is not None:
        panels[1].plot(t, injected["rotation"], ":", color=style.INK, lw=1.2)
    style.style_axes(panels[1]).set_title("rotation [deg]", fontsize=9.5)
    _draw_with_error(panels[2], t, columns["optical_gain"], columns["optical_gain_sigma"], style.SERIES[0])
    style.style_axes(panels[2]).set_title("mean optical gain relative to the first matrix", fontsize=9.5)
    known = np.isfinite(columns["strehl"])
    if known.any():
        _draw_with_error(
            panels[3], t[known], columns["strehl"][known], columns["strehl_sigma"][known], style.SERIES[0]
        )
        style.style_axes(panels[3]).set_title("Strehl ratio, peak", fontsize=9.5)
    else:
        panels[3].plot(t, columns["residual_nm"], color=style.SERIES[0], lw=1.2)
        style.style_axes(panels[3]).set_title("residual wavefront [nm rms]", fontsize=9.5)
    for panel in panels:
        for one in exchanges:
            if one["accepted"]:
                panel.axvline(float(one["seconds"]), color=style.MUTED, lw=0.8, ls=":")
        for one in alarms:
            panel.axvline(float(one["seconds"]), color=style.SERIES[1], lw=1.2)
    for panel in panels[2:]:
        panel.set_xlabel("seconds")
    return figure


def _draw_with_error(
    panel: Axes,
    t: NDArray[np.float64],
    value: NDArray[np.float64],
    sigma: NDArray[np.float64],
    colour: str,
    label: str | None = None,
) -> None:
    """A line with its standard error."""
    panel.fill_between(t, value - sigma, value + sigma, color=colour, alpha=0.3, lw=0)
    panel.plot(t, value, color=colour, lw=1.2, label=label)
