"""Results as tables of text, for the terminal and for the report."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from escape_hw.api.optical_gains import GainsResult
from escape_hw.api.registration import PARAMETERS, Registration
from escape_hw.api.results import Estimate, LoopResult, RegistrationEstimate

#: Labels of methods in figures, tables and lists, in the order of lists: matrices measured with a calibration
#: source, measured without one, computed.
METHOD_LABELS = {
    "push-pull": "push-pull",
    "push-pull-fast": "fast push-pull",
    "push-pull-fast-closed": "fast push-pull, closed loop",
    "modulated": "modulation",
    "docrime": "DO-CRIME",
    "docrime-whitened": "DO-CRIME",
    "docrime-closed": "DO-CRIME, closed loop",
    "escape": "ESCAPE",
    "simulated": "simulation",
}

#: Names and units as the paper's Table 1 writes them.
TITLES = {
    "shift_x": ("Shift X", "% of Sub Aperture"),
    "shift_y": ("Shift Y", "% of Sub Aperture"),
    "rotation": ("Rotation", "deg"),
    "radial_scaling": ("Radial Scaling", "% of Diameter"),
    "tangential_scaling": ("Tangential Scaling", "% of Diameter"),
    "anamorphosis": ("Anamorphosis", "% of Diameter"),
    "pupil_shift_x": ("Pupil Shift X", "% of Sub Aperture"),
    "pupil_shift_y": ("Pupil Shift Y", "% of Sub Aperture"),
}


STREHL_HEADINGS = ("Strehl, peak [%]", "Strehl, OTF [%]", "Strehl, encircled [%]")


@dataclass(frozen=True, slots=True)
class Table:
    """A table of text: headings and rows, the first column naming the row; numbers in the others."""

    headings: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    numeric: bool = True


def criterion_symbol(criterion: Mapping[str, Any]) -> str:
    """A tick for a criterion that is met, an exclamation mark if with a limitation, else a cross."""
    if not criterion["met"]:
        return "✗"
    return "!" if criterion.get("limited") else "✓"


def format_with_error(value: Estimate) -> str:
    """Value and standard error, both rounded to the error's second digit."""
    if not math.isfinite(value.value) or not math.isfinite(value.sigma) or value.sigma >= 1e6:
        return f"{value.value:.4g} ± {value.sigma:.2g}".replace("-", "−")
    if value.sigma <= 0:
        return f"{value.value:.4g}".replace("-", "−")
    digits = max(0, 1 - math.floor(math.log10(value.sigma)))
    # Adding 0.0 turns a rounded −0.0 into 0.0.
    number = f"{round(value.value, digits) + 0.0:.{digits}f}".replace("-", "−")
    return f"{number} ± {format_error(value.sigma)}"


def format_error(sigma: float) -> str:
    """A standard error with two significant digits, also if the second is a nought."""
    if not math.isfinite(sigma) or not 0 < sigma < 1e6:
        return f"{sigma:.2g}"
    return f"{sigma:.{max(0, 1 - math.floor(math.log10(sigma)))}f}"


def format_percent(value: Estimate) -> str:
    """A ratio and its standard error in percent; a question mark if the run was too short for one."""
    if not math.isfinite(value.sigma):
        return f"{100 * value.value:5.1f} ± ? %"
    return f"{100 * value.value:5.1f} ± {100 * value.sigma:.1f} %"


def registration_table(
    estimates: Mapping[str, RegistrationEstimate], injected: Registration | None = None
) -> Table:
    """Registration in the form of the paper's Table 1: components down, estimates across.

    Parameters
    ----------
    estimates
        By column heading, such as ``SHORT``; an empty heading means alpha alone.
    injected
        True values of a twin, shown in the last column; a column after each estimate then gives its
        error in standard errors.
    """
    parameters = {k: {**one.parameters(), **one.extras} for k, one in estimates.items()}
    sigmas = {label: one.repeatability_sigma for label, one in estimates.items()}
    between_runs = {
        label: dict(zip(PARAMETERS, sigma.tolist(), strict=True))
        for label, sigma in sigmas.items()
        if sigma is not None
    }
    return parameters_table(parameters, injected, between_runs)


def parameters_table(
    estimates: Mapping[str, Mapping[str, Estimate]],
    injected: Registration | None = None,
    between_runs: Mapping[str, Mapping[str, float]] | None = None,
) -> Table:
    """As :func:`registration_table`, of parameters by name with their errors, and those between runs."""
    headings, between = ["Component"], between_runs or {}
    for label in estimates:
        headings.append(f"α {label}".strip())
        if label in between:
            headings.append("± between runs")
        if injected is not None:
            headings.append("Δ / σ")
    if injected is not None:
        headings.append("injected")
    truth: dict[str, float] = {}
    if injected is not None:
        along, shear = injected.axis_scalings_and_shear
        truth = {**along.to_dict(), "anamorphosis": shear}
    rows = []
    for name in (name for name in TITLES if any(name in estimate for estimate in estimates.values())):
        title, unit = TITLES[name]
        row = [f"{title} [{unit}]"]
        for label, estimate in estimates.items():
            value = estimate.get(name)
            row.append("–" if value is None else format_with_error(value))
            if label in between:
                row.append(format_error(between[label][name]) if name in between[label] else "–")
            if injected is not None:
                row.append("–" if value is None or name not in truth else _format_pull(value, truth[name]))
        if injected is not None:
            row.append(f"{truth[name]:.4g}".replace("-", "−") if name in truth else "–")
        rows.append(tuple(row))
    return Table(tuple(headings), tuple(rows))


def _format_pull(value: Estimate, truth: float) -> str:
    if not value.sigma > 0:
        return "–"
    return f"{(value.value - truth) / value.sigma:+.1f}".replace("-", "−")


def strehl_table(loops: Mapping[str, LoopResult]) -> Table:
    """Three Strehl ratios with errors, gain, residual and stability of every loop."""
    headings = ("Matrix", *STREHL_HEADINGS, "gain", "rms [nm]", "loop")
    rows = []
    for label, loop in loops.items():
        strehl = loop.strehl
        values = (None,) * 3 if strehl is None else (strehl.peak, strehl.otf, strehl.encircled)
        ratios = ("–" if value is None else format_percent(value).strip(" %") for value in values)
        state = f"stable {loop.frames / loop.rate_hz:.0f} s" if loop.stable else "UNSTABLE"
        if loop.partial:
            state += ", aborted"
        rows.append((label, *ratios, _format_gain(loop), f"{loop.residual_rms_nm:.0f}", state))
    return Table(headings, tuple(rows))


def _format_gain(loop: LoopResult) -> str:
    error = f" ± {loop.gain_sigma:.3f}" if loop.gain_sigma is not None else ""
    return f"{loop.gain:.3f}{error}"


def rounds_table(result: GainsResult) -> Table:
    """Rounds of a bootstrap of optical gains: poke, frames, mean gain, its change, cost."""
    headings = (
        "Round", "poke [% of stroke]", "frames", "mean gain", "change [%]", "Strehl lost [%]", "Strehl [%]",
    )  # fmt: skip
    rows = []
    for number, one in enumerate(result.rounds, 1):
        gains = one.gains
        own = float(np.sqrt(np.mean(np.square(gains.best_sigma)) / gains.n_modes))
        mean = float(np.mean(gains.best))
        rows.append(
            (
                str(number),
                f"{100 * one.poke:.3g}",
                str(one.frames),
                format_with_error(Estimate(mean, math.hypot(own, mean * gains.common_sigma))),
                f"{100 * one.change:.1f}",
                f"{100 * one.strehl_loss:.2g}",
                "–" if one.strehl is None else format_percent(one.strehl.peak).strip(" %"),
            )
        )
    return Table(headings, tuple(rows))
