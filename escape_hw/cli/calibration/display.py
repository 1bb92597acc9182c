"""Results of the procedures on the terminal."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from escape_hw.runtime.procedures.calibration import METHODS

if TYPE_CHECKING:
    from rich.console import RenderableType

    from escape_hw.api.results import CalibrationResult, LoopResult
    from escape_hw.api.tracking import TrackResult
    from escape_hw.calibration.optical_gain.bootstrap import GainsRun


def format_result(
    procedure: str, result: object, simulated: bool, document: dict[str, Any]
) -> Iterator[RenderableType]:
    """Format the result of a procedure: its origin, its values, criteria, verdict and products.

    A procedure without a table or numbers of its own has criteria and products only.
    """
    from escape_hw.cli.formatting import (
        format_criteria,
        format_products,
        format_values,
        format_verdict,
        status_line,
    )
    from escape_hw.io.run_folder import RESULT_FILE

    yield status_line(simulated, bool(document.get("partial")))
    if procedure in _VALUES:
        yield from _VALUES[procedure](result, document)
    yield from format_values(document)
    yield from format_criteria(document.get("criteria", ()))
    yield from format_verdict(document)
    # Without a product, the numbers are in the document only.
    yield from format_products(document["products"] or {"result": Path(document["folder"]) / RESULT_FILE})


def _calibration(result: CalibrationResult, document: dict[str, Any]) -> Iterator[RenderableType]:
    """Size, signal-to-noise ratio and registration."""
    from escape_hw.cli.formatting import format_calibration

    yield from format_calibration(result)
    yield from _registration(result, document, result.notes)


def _registration(
    result: CalibrationResult, document: dict[str, Any], shown: Sequence[str] = ()
) -> Iterator[RenderableType]:
    from escape_hw.api.registration import Registration
    from escape_hw.cli.formatting import registration_remarks, rich_table
    from escape_hw.report.tables import registration_table

    if result.registration is not None:
        injected = document.get("injected")
        known = None if injected is None else Registration(**injected)
        yield rich_table(registration_table({"": result.registration}, known))
        yield from registration_remarks(result.registration, shown)


def _gains(run: GainsRun, document: dict[str, Any]) -> Iterator[RenderableType]:
    """The rounds of the optical gains."""
    from escape_hw.cli.formatting import rich_table
    from escape_hw.report.tables import rounds_table

    yield rich_table(rounds_table(run.result))
    yield from run.result.notes


def _loop(result: LoopResult, document: dict[str, Any]) -> Iterator[RenderableType]:
    """The performance of a closed loop."""
    from escape_hw.cli.formatting import rich_table
    from escape_hw.report.tables import METHOD_LABELS, strehl_table

    yield rich_table(strehl_table({METHOD_LABELS.get(result.method, result.method): result}))
    yield from result.notes


def _track(result: TrackResult, document: dict[str, Any]) -> Iterator[RenderableType]:
    """The last registration of a track, its exchanges and its alarms."""
    from escape_hw.api.registration import Registration
    from escape_hw.api.results import Estimate
    from escape_hw.cli.formatting import rich_table
    from escape_hw.report.tables import parameters_table

    found = {name: Estimate(**value) for name, value in document["registration"].items()}
    if found:
        injected = Registration(**document["injected_end"]) if document["injected_end"] else None
        yield rich_table(parameters_table({"": found}, injected))
    if document["injected_note"]:
        yield document["injected_note"]
    if result.optical_gain.size:
        value, sigma = result.optical_gain.mean(), result.optical_gain_sigma.mean()
        yield f"optical gain relative to the first matrix: {value:.3f} ± {sigma:.3f}"
    accepted = sum(exchange.accepted for exchange in result.exchanges)
    yield f"{len(result.exchanges)} matrices proposed, {accepted} exchanged"
    yield from (f"alarm after {alarm.seconds:.0f} s: {alarm.text}" for alarm in result.alarms)


_VALUES: dict[str, Callable[[Any, dict[str, Any]], Iterator[RenderableType]]] = {
    **dict.fromkeys(METHODS, _calibration),
    "sprint": _registration, "loop": _loop, "gains": _gains, "track": _track,
}  # fmt: skip
