"""The application with its commands; numerical libraries are imported when a command runs."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from functools import cache
from typing import Annotated, Any

import typer

from escape_hw.cli.calibration import calibrate, reproduce, sweep
from escape_hw.cli.calibration.procedure_command import procedure_command
from escape_hw.cli.command import CommandGroup
from escape_hw.cli.devices import asm, camera, discover, dm, emulate, modulator, with_stand_ins
from escape_hw.cli.products import influence, interchange
from escape_hw.cli.products import inspection as products
from escape_hw.cli.renamed import current_words
from escape_hw.cli.system import configuration as systems
from escape_hw.cli.system import doctor, gui, keys, perf, serve, streams, udev
from escape_hw.runtime.procedures.calibration import CALIBRATIONS
from escape_hw.runtime.procedures.registry import PROCEDURES


def _version(requested: bool) -> None:
    if requested:
        from escape_hw.version import __version__

        typer.echo(f"escape {__version__}")
        raise typer.Exit


def _common(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version and stop.")
    ] = False,
) -> None:
    """Options of the program itself."""


def build_app() -> typer.Typer:
    """The application with a command for every procedure."""
    app = typer.Typer(
        name="escape",
        cls=CommandGroup,
        help="Calibrates adaptive-optics systems without a calibration source.",
        epilog="Exit codes: 0 done · 1 finished but failed its own criterion · 2 bad usage or configuration, "
        "nothing opened · 3 device or safety fault, mirror made safe · 130 aborted, a partial result saved "
        "if there is one.",
        no_args_is_help=True,
        add_completion=True,
        pretty_exceptions_enable=False,
        rich_markup_mode="rich",
    )
    app.callback()(_common)
    app.command("systems")(systems.systems)
    app.add_typer(systems.config_app, name="config")
    app.command("calibrate")(calibrate.calibrate)
    for procedure in PROCEDURES:
        if procedure.name not in CALIBRATIONS:
            app.command(procedure.name)(procedure_command(procedure))
    app.command("sweep")(sweep.sweep)
    app.command("serve")(serve.serve)
    app.add_typer(keys.app, name="keys")
    app.add_typer(reproduce.app, name="reproduce")
    app.add_typer(interchange.export_app, name="export")
    app.add_typer(interchange.import_app, name="import")
    app.command("show")(products.show)
    app.command("compare")(products.compare)
    app.command("report")(products.report)
    app.command("influence")(influence.influence)
    app.command("night-log")(products.night_log)
    app.command("perf")(perf.perf)
    app.add_typer(dm.app, name="dm")
    app.add_typer(camera.app, name="camera")
    app.add_typer(modulator.app, name="modulator")
    app.add_typer(asm.app, name="asm")
    app.command("gui")(gui.gui)
    app.command("replay")(gui.replay)
    app.command("doctor")(doctor.doctor)
    app.command("discover")(discover.discover)
    app.add_typer(udev.app, name="udev")
    app.command("emulate")(emulate.emulate)
    app.command("with-stand-ins")(with_stand_ins.with_stand_ins)
    app.command("streams")(streams.streams)
    return app


app = build_app()


@cache
def _make_command(application: typer.Typer) -> Any:
    """The application as one command; made from all signatures, which takes as long as a short command."""
    return typer.main.get_command(application)


def run(arguments: Sequence[str] | None = None) -> None:
    """Run with these arguments (the process's own by default); ends the process."""
    words = current_words(sys.argv[1:] if arguments is None else arguments)
    command = _make_command(app)
    if "--json" not in words:
        command(words, prog_name="escape")
    try:
        # Not standalone: a wrong option, too, must yield a document.
        code = command(words, prog_name="escape", standalone_mode=False)
    except Exception as error:
        if not hasattr(error, "format_message") or not hasattr(error, "exit_code"):
            raise
        _print_usage_error(error, words)
        code = error.exit_code
    sys.exit(code if isinstance(code, int) else 0)


def _print_usage_error(error: Exception, words: Sequence[str]) -> None:
    from escape_hw.io.documents import dumps, header_fields

    message = str(error.format_message())  # type: ignore[attr-defined]
    typer.echo(f"error: {message}", err=True)
    command = next((word for word in words if not word.startswith("-")), "")
    failure = {"type": "UsageError", "message": message}
    typer.echo(dumps({**header_fields(command, None, None, None), "error": failure}))
