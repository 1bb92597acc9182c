"""Figures of SPRINT: convergence, fitted influence functions, and error against the frames used."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, FuncFormatter, MaxNLocator, NullLocator

from escape_hw.api.influence import InfluenceProfile
from escape_hw.api.registration import PARAMETERS, Registration
from escape_hw.api.results import RegistrationEstimate
from escape_hw.report.figures import style
from escape_hw.report.tables import TITLES, format_with_error

_SHORT_UNITS = {"% of Sub Aperture": "% sub-ap.", "deg": "deg", "% of Diameter": "% diam."}


def convergence(estimate: RegistrationEstimate, injected: Registration | None = None) -> Figure:
    """Step norm above, the five parameters below, per iteration (paper: SPRINT convergence figure).

    The band is the final standard error around the final value, the dotted line the injected value.
    """
    steps = estimate.iterations
    number = np.arange(1, len(steps) + 1)
    figure = style.new_figure(7.8, 8.2)
    panels = figure.subplots(6, 1, sharex=True, height_ratios=[1.6, 1, 1, 1, 1, 1])
    norm = np.array([step.step_norm for step in steps], float)
    # A step of zero (the start, or a change of the model) has no place on a logarithmic scale: a gap.
    panels[0].plot(number, _positive_or_nan(norm), "o-", color=style.SERIES[0], ms=3, lw=1.3)
    if (norm > 0).any():
        panels[0].set_yscale("log")
    style.style_axes(panels[0]).set_ylabel("relative\nstep norm")
    panels[0].set_title(
        f"{estimate.outcome}; {len(steps)} iterations, reduced χ² {estimate.chi2:.3g}",
        loc="left", color=style.INK, fontsize=9.5,
    )  # fmt: skip
    for panel, (name, value) in zip(panels[1:], estimate.parameters().items(), strict=True):
        title, unit = TITLES[name]
        track = [getattr(step.registration, name) for step in steps]
        panel.plot(number, track, "o-", color=style.SERIES[2], ms=2.5, lw=1.3)
        low, high = value.value - value.sigma, value.value + value.sigma
        panel.axhspan(low, high, color=style.SERIES[1], alpha=0.35, lw=0)
        if injected is not None:
            panel.axhline(getattr(injected, name), color=style.INK, lw=1.0, ls=":")
        style.style_axes(panel).set_ylabel(f"{title}\n[{_SHORT_UNITS[unit]}]", fontsize=7.5)
        panel.margins(y=0.2)
        panel.yaxis.set_major_locator(MaxNLocator(3))
        panel.set_title(format_with_error(value), loc="right", fontsize=8.5, color=style.INK, pad=2)
    panels[-1].set_xlabel("iteration")
    panels[-1].xaxis.set_major_locator(MaxNLocator(integer=True))
    figure.align_ylabels(list(panels))
    return figure


def influence_profile(profile: InfluenceProfile) -> Figure:
    """Nominal and fitted profile of the influence functions, the fitted ones with standard errors."""
    figure = style.new_figure(7.8, 3.4)
    panels = figure.subplots(1, 2)
    curves = [(profile.fitted, profile.sigma, "fitted", style.SERIES[0], "-")]
    if profile.edge.size:
        # Dashed: the profile of all actuators below it may be the same.
        curves.append((profile.edge, profile.edge_sigma, "fitted, edge actuators", style.SERIES[1], "-."))
    panels[0].plot(profile.radius, profile.nominal, "--", color=style.INK, lw=1.1, label="nominal")
    for values, sigma, label, colour, line in curves:
        panels[0].plot(profile.radius, values, line, color=colour, lw=1.4, label=label)
        panels[1].plot(profile.radius, values - profile.nominal, line, color=colour, lw=1.4)
        for panel, middle in zip(panels, (values, values - profile.nominal), strict=True):
            low, high = middle - sigma, middle + sigma
            panel.fill_between(profile.radius, low, high, color=colour, alpha=0.3, lw=0)
    panels[1].axhline(0, color=style.INK, lw=1.1, ls="--")
    for panel, label in zip(panels, ("surface / peak", "difference from nominal / peak"), strict=True):
        style.style_axes(panel).set(xlabel="distance from the actuator [pitches]", ylabel=label)
    panels[0].legend(frameon=False, fontsize=8, labelcolor=style.INK)
    return figure


#: Bounds, how they are drawn, and what they are called.
_BOUNDS = (
    ("bound", "--", "Cramér-Rao bound, real mirror"),
    ("exact_bound", ":", "Cramér-Rao bound, exact model"),
)


def error_curves(curves: Mapping[str, Any]) -> Figure:
    """Error of the registration against the number of frames.

    Parameters
    ----------
    curves
        ``{"frames": [...], "estimators": {name: {parameter: [rms, ...]}}, "bound": {parameter:
        [...]}, "goal": {parameter: value}}``; ``bound`` (Cramér-Rao, random effects included),
        ``exact_bound`` (for an exact model) and ``goal`` may be missing.
    """
    frames = np.asarray(curves["frames"], float)
    figure = style.new_figure(9.2, 5.2)
    panels = figure.subplots(2, 3).ravel()
    for panel, name in zip(panels, PARAMETERS, strict=False):
        title, unit = TITLES[name]
        for (label, errors), colour in zip(curves["estimators"].items(), style.SERIES, strict=False):
            if name in errors:
                panel.loglog(
                    frames, _positive_or_nan(errors[name]), "o-", ms=3, lw=1.4, color=colour, label=label
                )
        for key, line, label in _BOUNDS:
            if name in curves.get(key, {}):
                panel.loglog(
                    frames, _positive_or_nan(curves[key][name]), line, lw=1.1, color=style.INK, label=label
                )
        if name in curves.get("goal", {}):
            panel.axhline(curves["goal"][name], color=style.SERIES[5], lw=1.2, ls="-.", label="goal")
        style.style_axes(panel).set_title(title, fontsize=9.5)
        panel.set(xlabel="frames", ylabel=f"rms error [{_SHORT_UNITS[unit]}]")
        # Plain numbers of frames: powers of ten are not useful over one decade.
        labelled = frames[:: -(-frames.size // 5)]
        panel.xaxis.set_major_locator(FixedLocator(list(labelled)))
        panel.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:.0f}"))
        panel.xaxis.set_minor_locator(NullLocator())
    handles, labels = panels[0].get_legend_handles_labels()
    style.hide_axes(panels[5]).legend(
        handles, labels, loc="center", frameon=False, fontsize=9, labelcolor=style.INK
    )
    return figure


def _positive_or_nan(values: Any) -> Any:
    data = np.asarray(values, float)
    return np.where(data > 0, data, np.nan)
