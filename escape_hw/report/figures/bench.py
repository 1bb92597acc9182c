"""Figures of the bench.

PSFs, mirror command, sensor frame with its geometry, residual wavefront, temporal response, gain scan.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import singledispatch
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PatchCollection
from matplotlib.colors import PowerNorm
from matplotlib.figure import Figure, FigureBase
from matplotlib.patches import Circle, Rectangle
from matplotlib.ticker import LogLocator, MaxNLocator, NullFormatter, ScalarFormatter
from numpy.typing import NDArray

from escape_hw.api.pyramid import PyramidPupils
from escape_hw.api.results import LoopResult, StrehlEstimate, TemporalResponse
from escape_hw.api.sensor import SensorGeometry, SubApertureGrid
from escape_hw.report.figures import style
from escape_hw.report.tables import format_percent

_OUTLINE_COLOUR = "#7fd6c0"


@singledispatch
def draw_geometry(grid: SensorGeometry, axes: Axes) -> str:
    """Draw a geometry into the axes of a frame.

    Returns
    -------
    str
        A few words on it, for the title.
    """
    raise TypeError(f"no drawing for a sensor of kind '{grid.kind}'")


@draw_geometry.register
def _draw_lenslets(grid: SubApertureGrid, axes: Axes) -> str:
    half = grid.pitch_px / 2
    squares = [Rectangle((x - half, y - half), 2 * half, 2 * half) for x, y in grid.centres_px()]
    # One artist: hundreds would take most of the time of the figure.
    axes.add_collection(
        PatchCollection(squares, facecolor="none", edgecolor=_OUTLINE_COLOUR, linewidth=0.35, alpha=0.7)
    )
    return f"{grid.n_valid} valid {grid.elements} of {grid.pitch_px:.2f} pixels"


@draw_geometry.register
def _draw_pupils(grid: PyramidPupils, axes: Axes) -> str:
    n = grid.valid.shape[0]
    line = np.arange(n)
    for (x, y), (left, top) in zip(grid.centres_px, grid.corners_px, strict=True):
        axes.add_patch(
            Circle((x, y), grid.diameter_px / 2, fill=False, ec=_OUTLINE_COLOUR, lw=0.8, alpha=0.9)
        )
        axes.contour(
            left + line, top + line, grid.valid.astype(float), [0.5], colors=_OUTLINE_COLOUR, linewidths=0.4
        )
        axes.plot(x, y, "+", color=_OUTLINE_COLOUR, ms=5, mew=0.6)
    return f"four images of {grid.diameter_px:.1f} pixels, {grid.n_valid} valid {grid.elements}"


#: Half width of the PSF cut-outs in pixels, and decades of the log stretch.
_HALF, _DECADES = 32, 3.5
#: Width of the border that holds background only, in pixels.
_BORDER = 4
_PSF_MAP, _FRAME_MAP = "inferno", "magma"
#: Power of the counts that the colours of a frame follow.
_ROOT = 0.5


def stacked_psfs(loops: Mapping[str, LoopResult], psf_px: float | None = None) -> Figure:
    """The model PSF and one stacked closed-loop PSF per matrix (paper: stacked PSF figures).

    See :func:`draw_psfs`.
    """
    n = len(_loops_with_images(loops)) + (_model_psf(loops) is not None)
    figure = style.new_figure(0.9 + 2.3 * max(n, 1), 3.35)
    draw_psfs(figure, loops, psf_px)
    return figure


def draw_psfs(
    figure: FigureBase, loops: Mapping[str, LoopResult], psf_px: float | None = None, rows: int = 1
) -> None:
    """Draw the PSFs into a figure or a part of one; runs without an image are left out.

    All images are scaled to the model's flux. Logarithmic stretch relative to the model's maximum,
    backgrounds subtracted; the three Strehl ratios are below each in the paper's order: peak, optical
    transfer function, encircled energy. Axes are in lambda/D where ``psf_px`` gives it in pixels, else in
    pixels.
    """
    shown, model = _loops_with_images(loops), _model_psf(loops)
    images = {label: _subtract_background(loop.psf) for label, loop in shown.items() if loop.psf is not None}
    n = max(len(shown) + (model is not None), 1)
    panels = figure.subplots(rows, -(-n // rows), squeeze=False)
    model_image = None if model is None else _subtract_background(model)
    references = [model_image] if model_image is not None else list(images.values())
    reference = max((float(image.max(initial=1e-12)) for image in references), default=1.0)
    panels_left = iter(panels.ravel())
    if model_image is not None:
        _psf_panel(
            next(panels_left), model_image, reference, psf_px, "model", None, missing="without turbulence"
        )
    for label, image in images.items():
        scaled = image if model_image is None else _scale_to_flux(image, float(model_image.sum()))
        _psf_panel(next(panels_left), scaled, reference, psf_px, label, shown[label].strehl)
    for panel in panels_left:
        panel.set_visible(False)
    unit = "pixel" if psf_px is None else "λ/D"
    for line in panels:
        line[0].set_ylabel(f"offset [{unit}]", color=style.INK, fontsize=8.5)
        for panel in line[1:]:
            panel.set_yticklabels([])
    shrink = 0.62 if rows == 1 else 1.0
    style.colour_bar(
        figure, list(panels.ravel()), _PSF_MAP, (-_DECADES, 0), "log₁₀ of flux / model maximum", shrink
    )


def _loops_with_images(loops: Mapping[str, LoopResult]) -> dict[str, LoopResult]:
    return {label: loop for label, loop in loops.items() if loop.psf is not None}


def _model_psf(loops: Mapping[str, LoopResult]) -> NDArray[np.float32] | None:
    return next((loop.model_psf for loop in loops.values() if loop.model_psf is not None), None)


def _psf_panel(
    axes: Axes,
    image: NDArray[np.float64],
    reference: float,
    psf_px: float | None,
    title: str,
    strehl: StrehlEstimate | None,
    missing: str = "no Strehl ratio",
) -> None:
    """Draw an image; ``missing`` stands below it where there is no Strehl ratio."""
    cropped = _crop_around_peak(image)
    stretched = np.log10(np.maximum(cropped / reference, 10.0**-_DECADES))
    half = cropped.shape[0] / 2 / (psf_px or 1.0)
    axes.imshow(
        stretched,
        cmap=_PSF_MAP,
        vmin=-_DECADES,
        vmax=0,
        extent=(-half, half, half, -half),
        interpolation="nearest",
    )
    style.style_axes(axes, grid=False).set_title(title, fontweight="bold", fontsize=10)
    axes.tick_params(length=2)
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(MaxNLocator(5))
    if strehl is not None:
        rows = (("peak", strehl.peak), ("OTF", strehl.otf), ("encircled", strehl.encircled))
        below = "\n".join(f"{name:>9}  {format_percent(value)}" for name, value in rows)
        axes.set_xlabel(below, family="monospace", fontsize=8, labelpad=5, color=style.INK)
    else:
        axes.set_xlabel(missing, fontsize=8.5, labelpad=5, color=style.MUTED)


def _subtract_background(image: NDArray[np.float32]) -> NDArray[np.float64]:
    """The image less the median of its border; on a logarithmic scale an offset would hide the halo."""
    border = np.ones(image.shape, bool)
    border[_BORDER:-_BORDER, _BORDER:-_BORDER] = False
    return np.asarray(image - np.median(image[border]), float)


def _scale_to_flux(image: NDArray[np.float64], flux: float) -> NDArray[np.float64]:
    """The image scaled to a flux; an image without light is returned unchanged."""
    own = float(image.sum())
    return image * (flux / own) if own > 0 else image


def _crop_around_peak(image: NDArray[np.float64]) -> NDArray[np.float64]:
    """Square around the maximum, as large as the image allows up to the usual size."""
    row, column = np.unravel_index(int(np.argmax(image)), image.shape)
    half = int(min(_HALF, row, column, image.shape[0] - 1 - row, image.shape[1] - 1 - column))
    if half < 4:
        return image
    return image[row - half : row + half + 1, column - half : column + half + 1]


def mirror_on_grid(command: NDArray[np.float64], layout: NDArray[np.bool_]) -> Figure:
    """A mirror command on the map of its actuators, in percent of full stroke.

    Parameters
    ----------
    command
        ``(n_act,)``, numbered row by row over ``layout``.
    """
    values = np.full(layout.shape, np.nan)
    values[layout] = 100 * np.asarray(command, float)
    figure, axes, limit = _mirror_axes(values)
    axes.imshow(style.map_colours(values, style.DIVERGING, -limit, limit, ~layout), interpolation="nearest")
    return figure


def mirror_without_grid(command: NDArray[np.float64], places_m: NDArray[np.float64]) -> Figure:
    """A mirror command at the actuators' positions, in percent of full stroke.

    Parameters
    ----------
    command
        ``(n_act,)``.
    places_m
        Actuator positions ``(n_act, 2)`` as (x, y), y along the rows of other figures.
    """
    values = 100 * np.asarray(command, float)
    figure, axes, limit = _mirror_axes(values)
    actuators, radius = style.discs(places_m, style.map_colours(values, style.DIVERGING, -limit, limit))
    axes.add_collection(actuators)
    reach = float(np.abs(places_m).max(initial=0.0)) + radius
    axes.set(xlim=(-reach, reach), ylim=(reach, -reach), aspect="equal")
    return figure


def _mirror_axes(values: NDArray[np.float64]) -> tuple[Figure, Axes, float]:
    """Figure, axes and the ends of the colour scale for a command in percent."""
    limit = max(float(np.nanmax(np.abs(values), initial=0.0)), 1.0)
    figure = style.new_figure(4.4, 3.7)
    axes = style.hide_axes(figure.subplots())
    axes.set_title("mirror command", color=style.INK, fontsize=9.5)
    style.colour_bar(figure, [axes], style.DIVERGING, (-limit, limit), "command [% of full stroke]")
    return figure, axes, limit


def sensor_frame(
    frame: NDArray[np.generic], grid: SensorGeometry | None = None, title: str = "sensor frame"
) -> Figure:
    """A frame of the wavefront sensor with what was found on it, in counts."""
    image = np.asarray(frame, float)
    figure = style.new_figure(5.4, 4.2)
    axes = style.style_axes(figure.subplots(), grid=False)
    high = float(np.percentile(image, 99.8))
    low = float(np.percentile(image, 5))
    limits = (low, max(high, low + 1e-6))
    # A square root brings out the faint spots at the edge of the beam.
    axes.imshow(image, cmap=_FRAME_MAP, interpolation="nearest", norm=PowerNorm(_ROOT, *limits, clip=True))
    style.colour_bar(figure, [axes], _FRAME_MAP, limits, "counts [ADU]", extend="both", power=_ROOT)
    if grid is not None:
        title = f"{title}, {draw_geometry(grid, axes)}"
    axes.set_title(title, fontsize=9.5)
    axes.set(xlabel="x [pixel]", ylabel="y [pixel]")
    return figure


def residual_strip(loops: Mapping[str, LoopResult]) -> Figure:
    """Residual wavefront rms against time, one line per loop."""
    shown = {label: loop for label, loop in loops.items() if loop.residual_nm.size}
    figure = style.new_figure(8.4, 2.8)
    axes = figure.subplots()
    for (label, loop), colour in zip(shown.items(), style.SERIES * 2, strict=False):
        seconds = np.linspace(0, loop.frames / loop.rate_hz, loop.residual_nm.size)
        axes.plot(
            seconds, loop.residual_nm, color=colour, lw=0.8, alpha=0.85, label=_residual_label(label, loop)
        )
    style.style_axes(axes).set(xlabel="time in closed loop [s]", ylabel="residual wavefront [nm rms]")
    _logarithmic_residual(axes)
    axes.margins(x=0.01)
    if shown:
        style.legend(axes, ncols=3, loc="lower left", bbox_to_anchor=(0, 1.0), borderaxespad=0.2)
    return figure


def _logarithmic_residual(axes: Axes) -> None:
    """Logarithmic scale: the residual before closing or near instability is ten times larger."""
    axes.set_yscale("log")
    axes.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axes.yaxis.set_major_formatter(ScalarFormatter())
    axes.yaxis.set_minor_formatter(NullFormatter())


def _residual_label(label: str, loop: LoopResult) -> str:
    return f"{label}: {loop.residual_rms_nm:.0f} nm" + ("" if loop.stable else " (unstable)")


def temporal_response(response: TemporalResponse) -> Figure:
    """Share of a command's effect that appears in each of the frames after it."""
    figure = style.new_figure(4.4, 3.7)
    axes = figure.subplots()
    lags = np.arange(response.weights.size)
    axes.bar(lags, 100 * response.weights, width=0.7, color=style.SERIES[0])
    axes.errorbar(
        lags, 100 * response.weights, 100 * response.sigma, fmt="none", ecolor=style.INK, capsize=3, lw=1.0
    )
    style.style_axes(axes).set(xlabel="frames after the command", ylabel="share of the response [%]")
    axes.axhline(0.0, color=style.MUTED, lw=0.7)
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.set_title(f"mean delay {response.delay_frames:.2f} frames", fontsize=9.5)
    return figure


def gain_scan(scans: Mapping[str, Sequence[Mapping[str, Any]]]) -> Figure:
    """Residual and Strehl ratio (peak) against the loop gain, one line per matrix.

    Parameters
    ----------
    scans
        Runs by label, each as :func:`escape_hw.io.documents.loop_document` writes it.
    """
    figure = style.new_figure(8.4, 3.0)
    left, right = figure.subplots(1, 2)
    for (label, runs), colour in zip(scans.items(), style.SERIES * 2, strict=False):
        ordered = sorted((run for run in runs if run["stable"]), key=lambda run: float(run["gain"]))
        line = {"color": colour, "ms": 3, "lw": 1.2, "label": label}
        left.plot([run["gain"] for run in ordered], [run["residual_rms_nm"] for run in ordered], "o-", **line)
        rated = [(run["gain"], run["strehl"]["peak"]) for run in ordered if run["strehl"]]
        if rated:
            values = 100 * np.array([[peak["value"], peak["sigma"] or 0.0] for _, peak in rated])
            right.errorbar([g for g, _ in rated], values[:, 0], values[:, 1], fmt="o-", capsize=2, **line)
    style.style_axes(left).set(xlabel="loop gain", ylabel="residual wavefront [nm rms]")
    _logarithmic_residual(left)
    style.style_axes(right).set(xlabel="loop gain", ylabel="Strehl ratio, peak [%]")
    if scans:
        style.legend(left, ncols=3, loc="lower left", bbox_to_anchor=(0, 1.0), borderaxespad=0.2)
    return figure
