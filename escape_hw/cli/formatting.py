"""Formatting of results for the terminal."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from rich import box
from rich.console import JustifyMethod
from rich.table import Table as RichTable
from rich.text import Text

from escape_hw.api.influence import InfluenceProfile
from escape_hw.api.results import CalibrationResult, RegistrationEstimate
from escape_hw.errors import ProductError
from escape_hw.report.tables import Table, criterion_symbol
from escape_hw.report.verdict import Quality, assess

_QUALITY_STYLES = {
    Quality.GOOD: "bold green", Quality.USABLE: "bold yellow", Quality.NOT_USABLE: "bold red",
    Quality.ABORTED: "bold yellow",
}  # fmt: skip

_CRITERION_STYLES = {"✓": "green", "!": "bold yellow", "✗": "bold red"}


def status_line(simulated: bool, partial: bool) -> Text:
    """A line with the origin of a result (simulation or hardware) and whether it was aborted."""
    text = (
        Text("SIMULATED", style="bold black on yellow") if simulated else Text("HARDWARE", style="bold green")
    )
    if partial:
        text.append("  ABORTED: partial data", style="bold red")
    return text


def rich_table(content: Table, title: str | None = None) -> RichTable:
    """A table for the terminal."""
    # Without rules between columns the table fits a terminal of 80 columns.
    table = RichTable(title=title, title_justify="left", box=box.SIMPLE_HEAD, pad_edge=False)
    for number, heading in enumerate(content.headings):
        numbers = content.numeric and number > 0
        # Headings and words may wrap on a narrow terminal; values with standard errors may not.
        widest = max((len(row[number]) for row in content.rows if "±" in row[number]), default=None)
        justify: JustifyMethod = "right" if numbers else "left"
        table.add_column(heading, justify=justify, min_width=widest, overflow="fold")
    for row in content.rows:
        table.add_row(*(Text(cell) for cell in row))
    return table


def format_calibration(result: CalibrationResult) -> list[str]:
    """A calibration in a few lines."""
    matrix = result.matrix
    snr = (result.measured or matrix).snr()
    seconds = f"{result.sky_seconds:.3g} s{', simulated' if matrix.simulated else ''}"
    lines = [
        f"{matrix.method}: {matrix.n_modes} modes, {result.grid.n_valid} {result.grid.elements}, "
        f"{result.frames} frames ({seconds}), {result.lost_frames} lost",
    ]
    if np.isfinite(snr).all():
        median = sorted(snr)[len(snr) // 2]
        lines.append(f"signal-to-noise ratio per mode: minimum {snr.min():.3g}, median {median:.3g}")
    if result.response is not None:
        lines.append(f"delay: {result.response.delay_frames:.2f} frames")
    return [*lines, *result.notes]


#: Runs whose result is a few numbers, by command, with these numbers.
_VALUES = {
    "sensor": "sensor: {n_sub_apertures} sub-apertures, {counts:.4g} counts per frame in a bright one, "
    "background {background:.4g} counts",
    "model-psf": "PSF of the flat mirror without turbulence: peak {peak:.4g} counts, total {total:.4g} "
    "counts",
    "dark": "dark frame: mean {mean:.4g} counts, scatter {scatter:.4g} counts rms over the pixels",
    "flat": "relative response of the pixels: mean {mean:.4g}, scatter {scatter:.4g} rms over the pixels",
}


def format_criteria(checks: Iterable[Mapping[str, Any]]) -> list[Text]:
    """Criteria with a tick, a cross, or an exclamation mark where met with a limitation."""
    return [
        Text(f"{symbol} {entry['text']}", style=_CRITERION_STYLES[symbol])
        for entry in checks
        for symbol in [criterion_symbol(entry)]
    ]


def registration_remarks(estimate: RegistrationEstimate, shown: Sequence[str] = ()) -> list[str]:
    """Warnings of a registration and, where the model does not fit, its notes, without those ``shown``."""
    notes = estimate.notes if estimate.model_fits is False else ()
    return [remark for remark in (*estimate.warnings, *notes) if remark not in shown]


def format_verdict(document: Mapping[str, Any]) -> list[Text]:
    """The line of verdict on a result; none on a result without a criterion."""
    verdict = assess(document)
    return [] if verdict is None else [Text(str(verdict), style=_QUALITY_STYLES[verdict.quality])]


def format_values(document: Mapping[str, Any]) -> list[str]:
    """The numbers of a run whose result is a few of them (ProductError: one is missing or no number)."""
    command = document["command"]
    try:
        return [_VALUES[command].format_map(document)] if command in _VALUES else []
    except (KeyError, TypeError, ValueError) as error:
        raise ProductError(
            f"the result of '{command}' is damaged: {type(error).__name__}: {error}"
        ) from error


def format_products(products: Mapping[str, Any]) -> list[str]:
    """Paths of the products."""
    return [f"{name}: {path}" for name, path in products.items()]


#: Distances in pitches at which a profile is printed.
_PROFILE_STEP, _PROFILE_END = 0.5, 3.0


def profile_lines(profile: InfluenceProfile) -> list[str]:
    """The profile of the influence functions, a line every half pitch."""
    wanted = (profile.radius > 0) & (profile.radius < _PROFILE_END + 0.01)
    wanted &= np.isclose(profile.radius % _PROFILE_STEP, 0) | np.isclose(
        profile.radius % _PROFILE_STEP, _PROFILE_STEP
    )
    return [
        f"at {profile.radius[k]:.1f} pitches: {profile.fitted[k]:.3f} ± {profile.sigma[k]:.3f} of the peak, "
        f"nominal {profile.nominal[k]:.3f}"
        for k in np.flatnonzero(wanted)
    ]
