"""``escape calibrate``: the calibrations in one command, chosen by ``--method``."""

from __future__ import annotations

import shlex
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import Annotated, Any

import typer

from escape_hw.cli import options
from escape_hw.cli.calibration.procedure_command import (
    option_name,
    procedure_options,
)
from escape_hw.cli.command import build_command, keyword
from escape_hw.cli.context import CommandContext
from escape_hw.errors import ConfigError, EscapeError
from escape_hw.runtime.procedures.calibration import (
    CALIBRATIONS,
    METHODS,
    CalibrationProcedure,
    saved_request,
)
from escape_hw.runtime.procedures.declaration import Parameter, present_names

_Method = Annotated[str | None, typer.Option("--method", metavar="|".join(METHODS), help="Default: escape.")]
_Modes = Annotated[
    int | None, typer.Option("--modes", min=1, help="Number of modes. Default: as configured.")
]


def _all_parameters() -> list[Parameter]:
    """The parameters of all methods, with the help of ESCAPE and what other methods add to it."""
    found: dict[str, Parameter] = {}
    for procedure in reversed(CALIBRATIONS.values()):
        for one in procedure.parameters():
            known = found.setdefault(one.name, one)
            if one.help not in known.help:
                found[one.name] = replace(known, help=f"{known.help} {procedure.title}: {one.help}")
    return sorted(found.values(), key=lambda one: one.last)


def _calibrate(
    context: CommandContext,
    selection: options.SystemSelection,
    method: str | None,
    modes: int | None,
    out: Path | None,
    **arguments: Any,
) -> None:
    request = _request(method, arguments)
    if not selection.system:
        if request.resume is None:
            raise ConfigError("which system? Name one (see 'escape systems'), or a run with --resume")
        selection = replace(selection, system=str(request.resume / "config.toml"))
    if modes is not None:
        selection = _with_modes(context, selection, modes)
    try:
        context.run_procedure(request, selection, out, request.resume)
    except (EscapeError, KeyboardInterrupt) as error:
        _suggest_resume(context, error, request)
        raise


def _request(method: str | None, arguments: dict[str, Any]) -> CalibrationProcedure:
    """The request of the method that is given, or of the run to resume."""
    if method is None:
        resume = arguments["resume"]
        method = "escape" if resume is None else str(saved_request(resume)["method"])
    if method not in CALIBRATIONS:
        raise ConfigError(f"--method {method}: unknown; it is one of {', '.join(METHODS)}")
    given = {
        name: value
        for name, value in present_names(_all_parameters(), arguments, option_name).items()
        if value is not None
    }
    for name in given:
        users = [
            key for key, each in CALIBRATIONS.items() if any(name == one.name for one in each.parameters())
        ]
        if method not in users:
            raise ConfigError(f"{option_name(name)}: it needs --method {' or '.join(users)}, not {method}")
    return CALIBRATIONS[method].from_arguments(given, option_name)


def _suggest_resume(context: CommandContext, error: BaseException, request: CalibrationProcedure) -> None:
    """Add the command that resumes the run if a state was saved, in this run or in the one before."""
    from escape_hw.io.fits.run_state import STATE_FILE

    folders = [] if context.folder is None else [context.folder.path]
    folders += [] if request.resume is None or context.folder is None else [request.resume]
    resumable = next((folder for folder in folders if (folder / STATE_FILE).is_file()), None)
    if resumable is not None:
        words = ["escape", "calibrate", "--resume", str(resumable), *(["--force"] if request.force else [])]
        saved = datetime.fromtimestamp((resumable / STATE_FILE).stat().st_mtime)
        error.add_note(f"its state was saved at {saved:%H:%M:%S}")
        error.add_note(f"resume with: {shlex.join(words)}")


def _with_modes(
    context: CommandContext, selection: options.SystemSelection, modes: int
) -> options.SystemSelection:
    """The selection with another number of modes; the loop drops the same fraction of them.

    ``loop.dropped_modes`` is left alone if it is overridden itself.
    """
    if any(text.partition("=")[0].strip() == "loop.dropped_modes" for text in selection.set):
        return selection.with_overrides(f"basis.n_modes={modes}")
    config = context.load_config(selection)
    before = config.loop.dropped_modes
    dropped = min(before, modes * before // config.basis.n_modes)
    if dropped == before:
        return selection.with_overrides(f"basis.n_modes={modes}")
    context.notify(f"loop.dropped_modes: {before} becomes {dropped} with {modes} modes")
    return selection.with_overrides(f"basis.n_modes={modes}", f"loop.dropped_modes={dropped}")


calibrate = build_command(
    _calibrate,
    "calibrate",
    [
        keyword("selection", options.OptionalSelection, options.NO_SYSTEM),
        keyword("method", _Method, None),
        keyword("modes", _Modes, None),
        *procedure_options(_all_parameters(), optional=True),
        keyword("out", options.Out, None),
    ],
    help="Measure an interaction matrix and, with ESCAPE, the registration behind it.",
    quiet=True,
)
