"""``escape export`` and ``escape import``: files and streams of other adaptive-optics software."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from escape_hw.cli import options
from escape_hw.cli.session import Session, session

if TYPE_CHECKING:
    from escape_hw.api.results import CalibrationResult
    from escape_hw.config.models import SystemConfig

export_app = typer.Typer(help="Write what other software reads: pyRTC.", no_args_is_help=True)
import_app = typer.Typer(help="Read what other software wrote: pyRTC.", no_args_is_help=True)

_Product = Annotated[Path, typer.Argument(metavar="IM", help="Interaction matrix (FITS).")]
_OutFile = Annotated[Path, typer.Option("--out", metavar="FILE", help="Product to write (FITS).")]


@export_app.command("pyrtc")
def export_pyrtc(
    im: _Product,
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder for pyRTC's files.")],
    commands: Annotated[
        bool, typer.Option("--commands", help="For single actuators instead of the matrix's modes.")
    ] = False,
    modes: Annotated[
        Path | None, typer.Option("--modes", metavar="FILE", help="For these modes (pyRTC's m2c file).")
    ] = None,
    json: options.Json = False,
) -> None:
    """Write a matrix as pyRTC 2.x reads it, with mask, references, modes and settings."""
    with session("export pyrtc", json=json) as one:
        import numpy as np

        from escape_hw.errors import ConfigError
        from escape_hw.io.documents import head
        from escape_hw.io.fits import load_matrix
        from escape_hw.io.interchange.pyrtc_file import read_file
        from escape_hw.io.interchange.pyrtc_write import FrameFacts, export_matrix

        if commands and modes is not None:
            raise ConfigError("--commands and --modes: the matrix can be for one of them only")
        product = load_matrix(im)
        wanted = None if modes is None else np.asarray(read_file(modes).data, float)
        if commands:
            wanted = np.eye(product.matrix.m2c.shape[0])
        facts = FrameFacts.of_config(im, product.config_text)
        files = export_matrix(out, product.result, facts, wanted)
        one.show(*(f"{name}: {path}" for name, path in files.items()))
        document = head("export pyrtc", product.matrix.system, product.matrix.simulated, None)
        one.result({**document, "im": im.absolute(), "files": _absolute(files)})


@import_app.command("pyrtc")
def import_pyrtc(
    config: Annotated[Path, typer.Argument(metavar="CONFIG", help="pyRTC's configuration (YAML).")],
    system: options.System,
    out: _OutFile,
    im: Annotated[
        Path | None, typer.Option("--im", metavar="FILE", help="Matrix (default: loop.im_file).")
    ] = None,
    legacy: Annotated[
        str | None,
        typer.Option("--legacy", help="How files of pyRTC 1.x were made: yx, xy or as_is."),
    ] = None,
    set: options.Set = None,
    mode: options.Mode = None,
    json: options.Json = False,
) -> None:
    """Read the matrix that a configuration of pyRTC's names, for a system of ours."""
    with session("import pyrtc", json=json) as one:
        from escape_hw.io.interchange.pyrtc_read import PyrtcConfig, Target, import_matrix

        ours = one.configured(options.Choice.of(system, set, None, mode))
        target = Target(
            ours.system.name, ours.sensor.kind, ours.sensor.n_sub, ours.devices.dm.n_act, ours.simulated
        )
        theirs = PyrtcConfig.read(config)
        result = import_matrix(theirs, target, im, legacy)
        _keep(one, "import pyrtc", out, result, ours, config)


def _keep(
    one: Session, command: str, out: Path, result: CalibrationResult, config: SystemConfig, source: Path
) -> None:
    """Write a calibration that was read, with what it was read from as its parent."""
    from dataclasses import replace

    from escape_hw.cli.views import bands, calibration_lines
    from escape_hw.io.documents import calibration_document, head
    from escape_hw.io.fits import save_matrix
    from escape_hw.io.provenance import sha256_of
    from escape_hw.runtime.records import config_record

    # What its modes are, nobody here computed.
    origin = replace(config_record(config), basis="file", parents={source.name: sha256_of(source)})
    path = save_matrix(out, result, origin)
    one.show(bands(result.matrix.simulated, result.partial), *calibration_lines(result), f"im: {path}")
    document = head(command, config.system.name, result.matrix.simulated, None)
    document |= calibration_document(result)
    one.result({**document, "source": source.absolute(), "products": {"im": path.absolute()}})


def _absolute(files: dict[str, Path]) -> dict[str, Any]:
    return {name: path.absolute() for name, path in files.items()}
