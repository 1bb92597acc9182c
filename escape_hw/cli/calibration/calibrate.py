"""``escape calibrate``."""

from __future__ import annotations

import shlex
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from escape_hw.cli import options
from escape_hw.cli.context import CommandContext, command_context
from escape_hw.errors import EscapeError

if TYPE_CHECKING:
    from escape_hw.api.results import CalibrationResult
    from escape_hw.runtime.session.record import BenchRecord


def calibrate(
    system: Annotated[
        str | None,
        typer.Argument(help="Name of a system (see 'escape systems') or a TOML file; not with --resume."),
    ] = None,
    method: Annotated[
        str | None,
        typer.Option(
            "--method", help="push-pull, push-pull-fast, modulated, docrime or escape (the default)."
        ),
    ] = None,
    frames: Annotated[
        int | None,
        typer.Option("--frames", min=1, help="Frames (push-pull: per push and pull; modulated: per batch)."),
    ] = None,
    poke: Annotated[
        float | None, typer.Option("--poke", help="Poke, rms surface as a fraction of full stroke.")
    ] = None,
    modes: Annotated[int | None, typer.Option("--modes", min=1, help="Number of modes.")] = None,
    accuracy: Annotated[
        float | None,
        typer.Option(
            "--accuracy", help="Stop when the shifts are known to this % of a sub-aperture; else exit 1."
        ),
    ] = None,
    snr: Annotated[
        float | None,
        typer.Option("--snr", help="Stop when every mode has this signal-to-noise ratio; else exit 1."),
    ] = None,
    closed_loop: Annotated[
        Path | None,
        typer.Option("--closed-loop", metavar="FILE", help="Measure in closed loop, with this matrix."),
    ] = None,
    plain: Annotated[
        bool, typer.Option("--plain", help="The paper's estimator, turbulence not whitened (docrime).")
    ] = False,
    estimator: Annotated[
        str | None,
        typer.Option("--estimator", help="What ESCAPE fits: auto, matrix or telemetry (few frames)."),
    ] = None,
    pokes: options.PokePattern = None,
    solver: options.Solver = None,
    modes_choice: options.ModesChoice = None,
    loss: options.Loss = None,
    also: options.ExtraParameters = None,
    resume: Annotated[
        Path | None,
        typer.Option(
            "--resume",
            metavar="RUN",
            help="Go on with a run that was broken off (its folder); products go to a new one (--out).",
        ),
    ] = None,
    force: options.Force = False,
    out: options.Out = None,
    set: options.Set = None,
    seed: options.Seed = None,
    mode: options.Mode = None,
    json: options.Json = False,
    quiet: options.Quiet = False,
) -> None:
    """Measure an interaction matrix and, with ESCAPE, the registration behind it."""
    with command_context("calibrate", json=json, quiet=quiet) as context:
        request_options = {
            "method": method, "frames": frames, "poke": poke, "accuracy": accuracy, "snr": snr,
            "plain": plain or None, "estimator": estimator,
            "closed_loop": None if closed_loop is None else str(closed_loop.absolute()),
        }  # fmt: skip
        from escape_hw.runtime.procedures.calibration import CalibrationRequest, CalibrationTask

        request = CalibrationRequest.from_options(request_options, resume)
        changes: dict[str, object] = {
            "pokes": pokes, "solver": solver, "modes_choice": modes_choice, "loss": loss,
            "extra_parameters": options.as_toml_list(also),
        }  # fmt: skip
        task = CalibrationTask(request, resume=resume, force=force, settings=changes)
        selection = options.SystemSelection.of(_system_or_run(system, resume), set, seed, mode)
        if modes is not None:
            selection = _with_modes(context, selection, modes)
        try:
            context.run_task(task, selection, out, partial(_show, context), resume)
        except (EscapeError, KeyboardInterrupt) as error:
            _suggest_resume(context, error, resume, force)
            raise


def _suggest_resume(
    context: CommandContext, error: BaseException, resumed_run: Path | None, force: bool
) -> None:
    """Add the command that goes on, when a state was kept, here or in the run before."""
    from escape_hw.io.fits.run_state import STATE_FILE

    folders = [] if context.folder is None else [context.folder.path]
    folders += [] if resumed_run is None or context.folder is None else [resumed_run]
    resumable = next((folder for folder in folders if (folder / STATE_FILE).is_file()), None)
    if resumable is not None:
        words = ["escape", "calibrate", "--resume", str(resumable), *(["--force"] if force else [])]
        error.add_note(f"go on with: {shlex.join(words)}")


def _system_or_run(system: str | None, resume: Path | None) -> str:
    """The system that is named, or the configuration of the run to resume."""
    from escape_hw.errors import ConfigError

    if system is not None:
        return system
    if resume is None:
        raise ConfigError("which system? Name one (see 'escape systems'), or a run with --resume")
    return str(resume / "config.toml")


def _with_modes(
    context: CommandContext, selection: options.SystemSelection, modes: int
) -> options.SystemSelection:
    """The choice with another number of modes; the loop goes on dropping the same share of them.

    Who sets ``loop.dropped_modes`` gets what was set.
    """
    from escape_hw.runtime.procedures.calibration import mode_count_overrides

    if any(text.partition("=")[0].strip() == "loop.dropped_modes" for text in selection.set):
        return selection.with_overrides(f"basis.n_modes={modes}")
    configured_system = context.load_config(selection)
    overrides, dropped = mode_count_overrides(configured_system, modes)
    if dropped != configured_system.loop.dropped_modes:
        context.notify(
            f"loop.dropped_modes: {configured_system.loop.dropped_modes} becomes {dropped} with {modes} modes"
        )
    return selection.with_overrides(*overrides)


def _show(
    context: CommandContext, result: CalibrationResult, record: BenchRecord, document: dict[str, Any]
) -> None:
    from escape_hw.cli.formatting import (
        format_calibration,
        format_criteria,
        format_products,
        rich_table,
        status_line,
    )
    from escape_hw.report.tables import registration_table

    context.show(status_line(record.simulated, result.partial), *format_calibration(result))
    if result.registration is not None:
        context.show(rich_table(registration_table({"": result.registration}, record.planted)))
    context.show(*format_criteria(document["criteria"]), *format_products(document["products"]))
