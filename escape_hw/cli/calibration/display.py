"""Results of the procedures on the terminal."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Protocol

if TYPE_CHECKING:
    from rich.console import RenderableType

    from escape_hw.api.results import CalibrationResult, LoopResult
    from escape_hw.api.tracking import TrackResult
    from escape_hw.calibration.optical_gain.bootstrap import GainsRun


class Terminal(Protocol):
    """Where results are printed."""

    def show(self, *items: RenderableType) -> None:
        """Print results for people on standard output."""


#: Prints a result; gets the result, whether it is simulated, and its document.
Display = Callable[["Terminal", Any, bool, dict[str, Any]], None]


def display_function(name: str) -> Display:
    """The function that prints the result of a procedure."""
    return _DISPLAYS.get(name, show_document)


def show_document(context: Terminal, result: object, simulated: bool, document: dict[str, Any]) -> None:
    """Print criteria and products, for procedures without a table of their own."""
    from escape_hw.cli.formatting import format_criteria, format_products, status_line

    context.show(status_line(simulated, bool(document.get("partial"))))
    context.show(*format_criteria(document.get("criteria", ())), *format_products(document["products"]))


def show_calibration(
    context: Terminal, result: CalibrationResult, simulated: bool, document: dict[str, Any]
) -> None:
    """Print size, signal-to-noise ratio and registration of a calibration."""
    from escape_hw.api.registration import Registration
    from escape_hw.cli.formatting import (
        format_calibration,
        format_criteria,
        format_products,
        rich_table,
        status_line,
    )
    from escape_hw.report.tables import registration_table

    context.show(status_line(simulated, result.partial), *format_calibration(result))
    if result.registration is not None:
        values = document.get("injected")
        injected = None if values is None else Registration(**values)
        context.show(rich_table(registration_table({"": result.registration}, injected)))
    context.show(*format_criteria(document["criteria"]), *format_products(document["products"]))


def show_sprint(
    context: Terminal, result: CalibrationResult, simulated: bool, document: dict[str, Any]
) -> None:
    """Print the registration."""
    from escape_hw.cli.formatting import format_criteria, format_products, rich_table, status_line
    from escape_hw.report.tables import registration_table

    if result.registration is not None:
        table = registration_table({"": result.registration})
        context.show(status_line(result.matrix.simulated, False), rich_table(table))
    context.show(*format_criteria(document["criteria"]), *format_products(document["products"]))


def show_gains(context: Terminal, run: GainsRun, simulated: bool, document: dict[str, Any]) -> None:
    """Print the rounds of the optical gains."""
    from escape_hw.cli.formatting import format_criteria, format_products, rich_table, status_line
    from escape_hw.report.tables import rounds_table

    result = run.result
    context.show(status_line(simulated, result.partial), rich_table(rounds_table(result)))
    context.show(
        *format_criteria(document["criteria"]), *result.notes, *format_products(document["products"])
    )


def show_loop(context: Terminal, result: LoopResult, simulated: bool, document: dict[str, Any]) -> None:
    """Print the performance of a closed loop."""
    from escape_hw.cli.formatting import format_products, rich_table, status_line
    from escape_hw.report.tables import METHOD_LABELS, strehl_table

    label = METHOD_LABELS.get(result.method, result.method)
    context.show(status_line(simulated, result.partial), rich_table(strehl_table({label: result})))
    context.show(*result.notes, *format_products(document["products"]))


def show_track(context: Terminal, result: TrackResult, simulated: bool, document: dict[str, Any]) -> None:
    """Print the last registration of a track, its exchanges and its alarms."""
    from escape_hw.api.registration import Registration
    from escape_hw.api.results import Estimate
    from escape_hw.cli.formatting import format_products, rich_table, status_line
    from escape_hw.report.tables import parameters_table

    context.show(status_line(simulated, result.partial))
    found = {name: Estimate(**value) for name, value in document["registration"].items()}
    if found:
        injected = Registration(**document["injected_end"]) if document["injected_end"] else None
        context.show(rich_table(parameters_table({"": found}, injected)))
    if document["injected_note"]:
        context.show(document["injected_note"])
    if result.optical_gain.size:
        value, sigma = result.optical_gain.mean(), result.optical_gain_sigma.mean()
        context.show(f"optical gain relative to the first matrix: {value:.3f} ± {sigma:.3f}")
    accepted = sum(exchange.accepted for exchange in result.exchanges)
    context.show(f"{len(result.exchanges)} matrices proposed, {accepted} exchanged")
    context.show(*(f"alarm after {alarm.seconds:.0f} s: {alarm.text}" for alarm in result.alarms))
    context.show(*format_products(document["products"]))


_DISPLAYS: dict[str, Display] = {
    "sprint": show_sprint, "loop": show_loop, "gains": show_gains, "track": show_track,
}  # fmt: skip
