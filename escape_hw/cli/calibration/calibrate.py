"""``escape calibrate``: the calibrations in one command, chosen by ``--method``."""

from __future__ import annotations

import inspect
import shlex
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import typer

from escape_hw.cli import options
from escape_hw.cli.calibration.display import show_calibration
from escape_hw.cli.calibration.procedure_command import (
    option_name,
    procedure_options,
    split_common,
    with_signature,
)
from escape_hw.cli.context import CommandContext, command_context
from escape_hw.errors import ConfigError, EscapeError
from escape_hw.runtime.procedures.calibration import (
    CALIBRATIONS,
    METHODS,
    CalibrationProcedure,
    saved_request,
)
from escape_hw.runtime.procedures.declaration import Parameter, present_names

_System = Annotated[
    str | None,
    typer.Argument(help="Name of a system (see 'escape systems') or a TOML file; not with --resume."),
]
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


def _calibrate(arguments: dict[str, Any]) -> None:
    own, common = split_common(arguments)
    system, modes, method = arguments["system"], own.pop("modes"), own.pop("method")
    with command_context("calibrate", json=common["json"], quiet=common["quiet"]) as context:
        request = _request(method, own)
        selection = options.SystemSelection.of(
            _system_or_run(system, request.resume), common["set"], common["seed"], common["mode"]
        )
        if modes is not None:
            selection = _with_modes(context, selection, modes)
        try:
            context.run_procedure(request, selection, common["out"], show_calibration, request.resume)
        except (EscapeError, KeyboardInterrupt) as error:
            _suggest_resume(context, error, request)
            raise


def _request(method: str | None, arguments: dict[str, Any]) -> CalibrationProcedure:
    """The request of the method that is given, or of the run to resume.

    Raises
    ------
    ConfigError
        The method is unknown or does not have one of the given options.
    """
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
        error.add_note(f"go on with: {shlex.join(words)}")


def _system_or_run(system: str | None, resume: Path | None) -> str:
    """The given system, or the configuration of the run to resume."""
    if system is not None:
        return system
    if resume is None:
        raise ConfigError("which system? Name one (see 'escape systems'), or a run with --resume")
    return str(resume / "config.toml")


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


def _parameter(name: str, annotation: Any) -> inspect.Parameter:
    return inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=None, annotation=annotation)


calibrate = with_signature(
    _calibrate,
    [
        _parameter("system", _System),
        _parameter("method", _Method),
        _parameter("modes", _Modes),
        *procedure_options(_all_parameters(), optional=True),
    ],
    "calibrate",
    "Measure an interaction matrix and, with ESCAPE, the registration behind it.",
)
