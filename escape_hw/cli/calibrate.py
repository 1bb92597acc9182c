"""``escape calibrate``."""

from __future__ import annotations

import shlex
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from escape_hw.cli import options
from escape_hw.cli.session import Session, session
from escape_hw.errors import EscapeError

if TYPE_CHECKING:
    from escape_hw.api.results import CalibrationResult
    from escape_hw.runtime.records import BenchRecord


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
    pokes: options.Pokes = None,
    solver: options.Solver = None,
    modes_choice: options.ModesChoice = None,
    loss: options.Loss = None,
    also: options.Also = None,
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
    with session("calibrate", json=json, quiet=quiet) as one:
        asked = {
            "method": method, "frames": frames, "poke": poke, "accuracy": accuracy, "snr": snr,
            "plain": plain or None, "estimator": estimator,
            "closed_loop": None if closed_loop is None else str(closed_loop.absolute()),
        }  # fmt: skip
        from escape_hw.runtime.calibration_task import CalibrationRequest, CalibrationTask

        request = CalibrationRequest.of(asked, resume)
        changes: dict[str, object] = {
            "pokes": pokes, "solver": solver, "modes_choice": modes_choice, "loss": loss,
            "also": options.listed(also),
        }  # fmt: skip
        task = CalibrationTask(request, resume=resume, force=force, settings=changes)
        choice = options.Choice.of(_system(system, resume), set, seed, mode)
        if modes is not None:
            choice = _with_modes(one, choice, modes)
        try:
            one.perform(task, choice, out, partial(_show, one), resume)
        except (EscapeError, KeyboardInterrupt) as error:
            _tell_way_on(one, error, resume, force)
            raise


def _tell_way_on(one: Session, error: BaseException, resumed: Path | None, force: bool) -> None:
    """Add the command that goes on, when a state was kept, here or in the run before."""
    from escape_hw.io.state_file import STATE

    folders = [] if one.folder is None else [one.folder.path]
    folders += [] if resumed is None or one.folder is None else [resumed]
    kept = next((folder for folder in folders if (folder / STATE).is_file()), None)
    if kept is not None:
        words = ["escape", "calibrate", "--resume", str(kept), *(["--force"] if force else [])]
        error.add_note(f"go on with: {shlex.join(words)}")


def _system(system: str | None, resume: Path | None) -> str:
    """The system that is named, or the configuration of the run to resume."""
    from escape_hw.errors import ConfigError

    if system is not None:
        return system
    if resume is None:
        raise ConfigError("which system? Name one (see 'escape systems'), or a run with --resume")
    return str(resume / "config.toml")


def _with_modes(one: Session, choice: options.Choice, modes: int) -> options.Choice:
    """The choice with another number of modes; the loop goes on dropping the same share of them.

    Who sets ``loop.dropped_modes`` gets what was set.
    """
    from escape_hw.runtime.calibration_task import with_modes

    if any(text.partition("=")[0].strip() == "loop.dropped_modes" for text in choice.set):
        return choice.plus(f"basis.n_modes={modes}")
    usual = one.configured(choice)
    overrides, dropped = with_modes(usual, modes)
    if dropped != usual.loop.dropped_modes:
        one.tell(f"loop.dropped_modes: {usual.loop.dropped_modes} becomes {dropped} with {modes} modes")
    return choice.plus(*overrides)


def _show(one: Session, result: CalibrationResult, record: BenchRecord, document: dict[str, Any]) -> None:
    from escape_hw.cli.views import bands, calibration_lines, checks_view, products_view, rich_table
    from escape_hw.report.tables import registration_table

    one.show(bands(record.simulated, result.partial), *calibration_lines(result))
    if result.registration is not None:
        one.show(rich_table(registration_table({"": result.registration}, record.planted)))
    one.show(*checks_view(document["criteria"]), *products_view(document["products"]))
