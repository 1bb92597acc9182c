"""Figures of the bench: stacked PSFs, mirror, sensor, the loop in time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from numpy.typing import NDArray

from escape_hw.api.results import LoopResult, StrehlEstimate
from escape_hw.api.sensor import SubApertureGrid
from escape_hw.report import style
from escape_hw.report.tables import percent

#: Half width of the PSF cut-outs in pixels, and decades of the log stretch.
_HALF, _DECADES = 32, 3.5
_PSF_MAP, _FRAME_MAP = "inferno", "magma"


def stacked_psfs(loops: Mapping[str, LoopResult], psf_px: float | None = None) -> Figure:
    """The model PSF and one stacked closed-loop PSF per matrix (paper: stacked PSF figures).

    Logarithmic stretch relative to the model's maximum; the three Strehl ratios stand below each
    in the paper's order: peak, optical transfer function, encircled energy.

    Parameters
    ----------
    loops
        Closed-loop runs by label; runs without an image are left out.
    psf_px
        lambda/D in pixels, for axes in lambda/D; pixels without it.
    """
    shown = {label: loop for label, loop in loops.items() if loop.psf is not None}
    model = next((loop.model_psf for loop in shown.values() if loop.model_psf is not None), None)
    n = len(shown) + (model is not None)
    figure = style.new_figure(0.9 + 2.3 * max(n, 1), 3.35)
    panels = list(figure.subplots(1, max(n, 1), squeeze=False)[0])
    reference = (
        _peak(model) if model is not None else max((_peak(s.psf) for s in shown.values()), default=1.0)
    )
    places = iter(panels)
    if model is not None:
        _psf_panel(next(places), model, reference, psf_px, "model", None)
    for label, loop in shown.items():
        _psf_panel(next(places), loop.psf, reference, psf_px, label, loop.strehl)
    for panel in panels[1:]:
        panel.set_yticklabels([])
    unit = "pixel" if psf_px is None else "λ/D"
    panels[0].set_ylabel(f"offset [{unit}]", color=style.INK, fontsize=8.5)
    style.colour_bar(figure, panels, _PSF_MAP, (-_DECADES, 0), "log₁₀ of flux / model maximum", 0.62)
    return figure


def _psf_panel(
    axes: Axes,
    image: NDArray[np.float32] | None,
    reference: float,
    psf_px: float | None,
    title: str,
    strehl: StrehlEstimate | None,
) -> None:
    cut = _cut(np.zeros((2, 2)) if image is None else np.asarray(image, float))
    stretched = np.log10(np.maximum(cut / reference, 10.0**-_DECADES))
    half = cut.shape[0] / 2 / (psf_px or 1.0)
    axes.imshow(
        stretched,
        cmap=_PSF_MAP,
        vmin=-_DECADES,
        vmax=0,
        extent=(-half, half, half, -half),
        interpolation="nearest",
    )
    style.tidy(axes, grid=False).set_title(title, fontweight="bold", fontsize=10)
    axes.tick_params(length=2)
    if strehl is not None:
        rows = (("peak", strehl.peak), ("OTF", strehl.otf), ("encircled", strehl.encircled))
        below = "\n".join(f"{name:>9}  {percent(value)}" for name, value in rows)
        axes.set_xlabel(below, family="monospace", fontsize=8, labelpad=5, color=style.INK)
    else:
        axes.set_xlabel("without turbulence", fontsize=8.5, labelpad=5, color=style.MUTED)


def _peak(image: NDArray[np.float32] | None) -> float:
    return float(np.max(image, initial=1e-12)) if image is not None else 1.0


def _cut(image: NDArray[np.float64]) -> NDArray[np.float64]:
    """Square around the maximum, as large as the image allows up to the usual size."""
    row, column = np.unravel_index(int(np.argmax(image)), image.shape)
    half = int(min(_HALF, row, column, image.shape[0] - 1 - row, image.shape[1] - 1 - column))
    if half < 4:
        return image
    return image[row - half : row + half + 1, column - half : column + half + 1]


def mirror(command: NDArray[np.float64], layout: NDArray[np.bool_], title: str = "mirror command") -> Figure:
    """A mirror command on the map of its actuators, in percent of full stroke.

    Parameters
    ----------
    command
        ``(n_act,)``, numbered row by row over ``layout``.
    """
    values = np.full(layout.shape, np.nan)
    values[layout] = 100 * np.asarray(command, float)
    limit = max(float(np.nanmax(np.abs(values), initial=0.0)), 1.0)
    figure = style.new_figure(4.4, 3.7)
    axes = style.bare(figure.subplots())
    axes.imshow(style.paint(values, style.DIVERGING, -limit, limit, ~layout), interpolation="nearest")
    axes.set_title(title, color=style.INK, fontsize=9.5)
    style.colour_bar(figure, [axes], style.DIVERGING, (-limit, limit), "command [% of full stroke]")
    return figure


def sensor(
    frame: NDArray[np.generic], grid: SubApertureGrid | None = None, title: str = "sensor frame"
) -> Figure:
    """A frame of the wavefront sensor with the sub-apertures that were found on it."""
    image = np.asarray(frame, float)
    figure = style.new_figure(4.9, 4.2)
    axes = style.tidy(figure.subplots(), grid=False)
    high = float(np.percentile(image, 99.8))
    low = float(np.percentile(image, 5))
    # A square root brings out the faint spots at the edge of the beam.
    scaled = np.sqrt(np.clip((image - low) / max(high - low, 1e-12), 0, 1))
    axes.imshow(scaled, cmap=_FRAME_MAP, interpolation="nearest", norm=Normalize(0, 1))
    if grid is not None:
        half = grid.pitch_px / 2
        for x, y in grid.centres_px():
            axes.add_patch(
                Rectangle(
                    (x - half, y - half), 2 * half, 2 * half, fill=False, ec="#7fd6c0", lw=0.35, alpha=0.7
                )
            )
        title = f"{title}, {grid.n_valid} valid sub-apertures of {grid.pitch_px:.2f} pixels"
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
        axes.plot(seconds, loop.residual_nm, color=colour, lw=0.9, label=_residual_label(label, loop))
    style.tidy(axes).set(xlabel="bench time [s]", ylabel="residual wavefront [nm rms]")
    axes.set_ylim(bottom=0)
    axes.margins(x=0.01)
    if shown:
        style.legend(axes, ncols=3, loc="lower left", bbox_to_anchor=(0, 1.0), borderaxespad=0.2)
    return figure


def _residual_label(label: str, loop: LoopResult) -> str:
    return f"{label}: {loop.residual_rms_nm:.0f} nm" + ("" if loop.stable else " (unstable)")


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
    style.tidy(left).set(xlabel="loop gain", ylabel="residual wavefront [nm rms]")
    style.tidy(right).set(xlabel="loop gain", ylabel="Strehl ratio, peak [%]")
    if scans:
        style.legend(left, ncols=3, loc="lower left", bbox_to_anchor=(0, 1.0), borderaxespad=0.2)
    return figure
