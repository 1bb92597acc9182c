"""``escape export`` and ``escape import``: files and streams of pyRTC, AOT and milk, and plain arrays."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from escape_hw.cli import options
from escape_hw.cli.command import command
from escape_hw.cli.context import CommandContext
from escape_hw.errors import ConfigError, IncompatibleProduct, ProductError

if TYPE_CHECKING:
    from escape_hw.api.results import CalibrationResult
    from escape_hw.config.system import SystemConfig
    from escape_hw.io.fits.matrix import MatrixProduct
    from escape_hw.io.interchange.stream import Stream

export_app = typer.Typer(help="Write files of other software: pyRTC, AOT, milk.", no_args_is_help=True)
import_app = typer.Typer(
    help="Read files of other software: pyRTC, AOT, milk, plain arrays.", no_args_is_help=True
)

_Product = Annotated[Path, typer.Argument(metavar="IM", help="Interaction matrix (FITS).")]
_OutFile = Annotated[Path, typer.Option("--out", metavar="FILE", help="Product to write (FITS).")]
_Frames = Annotated[int, typer.Option("--frames", min=1, help="Number of arrays.")]
_Arrays = Annotated[Path, typer.Option("--out", metavar="FILE", help="Arrays to write (.npz).")]
#: Longest wait for the next array of a stream, in seconds.
_TIMEOUT_S = 10.0


@export_app.command("pyrtc")
@command("export pyrtc")
def export_pyrtc(
    context: CommandContext,
    im: _Product,
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder for pyRTC's files.")],
    commands: Annotated[
        bool, typer.Option("--commands", help="For single actuators instead of the matrix's modes.")
    ] = False,
    modes: Annotated[
        Path | None, typer.Option("--modes", metavar="FILE", help="For these modes (pyRTC's m2c file).")
    ] = None,
) -> None:
    """Write a matrix for pyRTC 2.x, with mask, references, modes and settings."""
    import numpy as np

    from escape_hw.io.fits.matrix import load_matrix
    from escape_hw.io.interchange.pyrtc.calibration import FrameSettings, export_matrix, export_paths
    from escape_hw.io.interchange.pyrtc.files import read_file
    from escape_hw.io.storage import refuse_existing

    if commands and modes is not None:
        raise ConfigError("--commands and --modes: choose one of them")
    refuse_existing(*export_paths(out).values())
    product = load_matrix(im)
    system_config = _system_config(product)
    wanted = None if modes is None else np.asarray(read_file(modes).data, float)
    if commands:
        wanted = np.eye(product.matrix.m2c.shape[0])
    wfs = system_config.devices.wfs
    counts = getattr(system_config.sensor, "threshold", 0.0) * (2**wfs.bit_depth - 1)
    files = export_matrix(out, product.result, FrameSettings((wfs.region[3], wfs.region[2]), counts), wanted)
    _report_export(context, product, im, files)


@export_app.command("aot")
@command("export aot")
def export_aot(
    context: CommandContext,
    im: _Product,
    out: Annotated[Path, typer.Option("--out", metavar="FILE", help="AOT file to write (.fits).")],
    telemetry: Annotated[
        Path | None, typer.Option("--telemetry", metavar="FILE", help="Of 'escape loop --record' (FITS).")
    ] = None,
) -> None:
    """Write a matrix, and telemetry of a loop, in the AOT standard (needs aotpy)."""
    from escape_hw.io.fits.matrix import load_matrix
    from escape_hw.io.fits.telemetry import load_telemetry
    from escape_hw.io.interchange.aot import AotSystem, write_aot
    from escape_hw.io.storage import refuse_existing

    refuse_existing(out)
    product = load_matrix(im)
    system_config = _system_config(product)
    dm = system_config.devices.dm
    places = [(float(x), float(y)) for x, y in dm.positions() * dm.pitch_m]
    facts = AotSystem(
        system_config.system.pupil_m, system_config.system.wavelength_m, dm.stroke_m, tuple(places),
        system_config.devices.wfs.frame_rate_hz,
    )  # fmt: skip
    record = None if telemetry is None else load_telemetry(telemetry).result
    path = write_aot(out, product.result, facts, record, product.config_text)
    _report_export(context, product, im, {"aot": path})


@export_app.command("milk")
@command("export milk")
def export_milk(
    context: CommandContext,
    file: Annotated[Path, typer.Argument(metavar="FILE", help="Interaction matrix (FITS) or array (.npy).")],
    name: Annotated[str, typer.Argument(metavar="NAME", help="Name of the image, or prefix of the names.")],
    version: Annotated[
        str, typer.Option("--layout", metavar="VERSION", help="Version of ImageStreamIO of the reader.")
    ] = "2.00",
) -> None:
    """Write shared-memory images for milk and CACAO; they stay until the computer restarts."""
    from escape_hw.io.fits.matrix import load_matrix
    from escape_hw.io.interchange.milk.layout import shm_path
    from escape_hw.io.interchange.milk.matrix import calibration_images
    from escape_hw.io.interchange.pyrtc.files import read_file

    if not name:
        raise ConfigError("NAME is empty: give the images a name, for example 'escape'")
    if file.suffix == ".npy":
        _publish(name, read_file(file).data, version)
        context.show(f"{name}: {shm_path(name)}")
        context.report(files={name: shm_path(name)})
        return
    product = load_matrix(file)
    images = calibration_images(product.result, _system_config(product).devices.dm.actuator_map())
    files = {}
    for ending, data in images.items():
        _publish(f"{name}_{ending}", data, version)
        files[ending] = shm_path(f"{name}_{ending}")
    _report_export(context, product, file, files)


@import_app.command("pyrtc")
@command("import pyrtc", without=("seed",))
def import_pyrtc(
    context: CommandContext,
    config: Annotated[Path, typer.Argument(metavar="CONFIG", help="pyRTC's configuration (YAML).")],
    selection: options.Selection,
    out: _OutFile,
    im: Annotated[
        Path | None, typer.Option("--im", metavar="FILE", help="Matrix (default: loop.im_file).")
    ] = None,
    frame_order: Annotated[
        str | None,
        typer.Option(
            "--frame-order", help="Axis order of the frames, for files of pyRTC 1.x: yx, xy or as_is."
        ),
    ] = None,
) -> None:
    """Read the matrix of a pyRTC configuration as a product of a system."""
    from escape_hw.io.interchange.pyrtc.calibration import PyrtcConfig, TargetSystem, import_matrix
    from escape_hw.io.storage import refuse_existing

    refuse_existing(out)
    ours = context.load_config(selection)
    target = TargetSystem(
        ours.system.name, ours.sensor.kind, ours.sensor.n_sub, ours.devices.dm.n_act, ours.simulated
    )
    result = import_matrix(PyrtcConfig.read(config), target, im, frame_order)
    _save_import(context, out, result, ours, config)


@import_app.command("aot")
@command("import aot", without=("seed",))
def import_aot(
    context: CommandContext,
    file: Annotated[Path, typer.Argument(metavar="FILE", help="AOT file.")],
    selection: options.Selection,
    out: _OutFile,
    telemetry: Annotated[
        Path | None, typer.Option("--telemetry", metavar="FILE", help="Also write its telemetry (FITS).")
    ] = None,
    loop: Annotated[str, typer.Option("--loop", help="Name of the loop (default: the only one).")] = "",
    stroke: Annotated[
        float | None, typer.Option("--stroke", help="Metres of surface for a command of 1.")
    ] = None,
) -> None:
    """Read a matrix, and telemetry, of an AOT file as products of a system (needs aotpy)."""
    from dataclasses import replace

    from escape_hw.io.fits.telemetry import save_telemetry
    from escape_hw.io.interchange.aot import read_aot
    from escape_hw.io.storage import refuse_existing
    from escape_hw.runtime.session.record import config_provenance

    refuse_existing(out, telemetry)
    ours = context.load_config(selection)
    content = read_aot(file, stroke, loop)
    found = content.calibration
    if found is None:
        raise IncompatibleProduct(f"{file}: this loop has no matrix that maps commands to measurements")
    if found.matrix.m2c.shape[0] != ours.devices.dm.n_act:
        raise IncompatibleProduct(
            f"{file}: its mirror has {found.matrix.m2c.shape[0]} actuators, that of system "
            f"'{ours.system.name}' {ours.devices.dm.n_act}"
        )
    simulated = found.matrix.simulated or ours.simulated
    matrix = replace(found.matrix, system=ours.system.name, simulated=simulated)
    if telemetry is not None and content.telemetry is not None:
        save_telemetry(telemetry, content.telemetry, ours.system.name, simulated, config_provenance(ours))
    elif telemetry is not None:
        raise IncompatibleProduct(f"{file}: has no measurements with matching commands")
    _save_import(context, out, replace(found, matrix=matrix), ours, file, telemetry)


@import_app.command("arrays")
@command("import arrays", without=("seed",))
def import_plain_arrays(
    context: CommandContext,
    description: Annotated[
        Path, typer.Argument(metavar="DESCRIPTION", help="Order, signs and units of the arrays (TOML).")
    ],
    selection: options.Selection,
    out: _OutFile,
    im: Annotated[
        Path | None, typer.Option("--im", metavar="FILE", help="Matrix (default: matrix.file).")
    ] = None,
) -> None:
    """Read a matrix in text, NumPy or FITS files as a product of a system."""
    from escape_hw.io.interchange.arrays import described_files, import_arrays, read_description
    from escape_hw.io.storage import refuse_existing
    from escape_hw.runtime.session.array_target import array_target

    refuse_existing(out)
    ours, facts = context.load_config(selection), read_description(description)
    folder = description.absolute().parent
    result = import_arrays(facts, folder, array_target(ours), im)
    _save_import(context, out, result, ours, description, others=described_files(facts, folder, im))


@import_app.command("milk")
@command("import milk")
def import_milk(
    context: CommandContext,
    name: Annotated[str, typer.Argument(metavar="NAME", help="Name of the shared-memory image.")],
    out: _Arrays,
    frames: _Frames = 1,
) -> None:
    """Read arrays of a shared-memory image of milk."""
    from escape_hw.io.interchange.milk.stream import MilkStream
    from escape_hw.io.storage import refuse_existing

    refuse_existing(out)
    _record_stream(context, MilkStream.open(name), frames, out)


@import_app.command("pyrtc-stream")
@command("import pyrtc-stream")
def import_pyrtc_stream(
    context: CommandContext,
    name: Annotated[str, typer.Argument(metavar="NAME", help="Name of the stream.")],
    out: _Arrays,
    frames: _Frames = 1,
) -> None:
    """Read arrays of a stream of a running pyRTC (needs pyshmem)."""
    from escape_hw.io.interchange.pyrtc.stream import ShmemStream
    from escape_hw.io.storage import refuse_existing

    refuse_existing(out)
    _record_stream(context, ShmemStream.open(name), frames, out)


def _system_config(product: MatrixProduct) -> SystemConfig:
    """The configuration stored in a product."""
    from escape_hw.config.loader import load_text

    if not product.config_text.strip():
        raise IncompatibleProduct(f"{product.path}: has no configuration; calibrate again with this version")
    return load_text(product.config_text, str(product.path))


def _report_export(context: CommandContext, product: MatrixProduct, im: Path, files: dict[str, Path]) -> None:
    context.show(*(f"{name}: {path}" for name, path in files.items()))
    context.set_subject(product.matrix.system, product.matrix.simulated, None)
    context.report(im=im.absolute(), files={name: path.absolute() for name, path in files.items()})


def _save_import(
    context: CommandContext,
    out: Path,
    result: CalibrationResult,
    config: SystemConfig,
    source: Path,
    telemetry: Path | None = None,
    others: Sequence[Path] = (),
) -> None:
    """Save an imported calibration, with its source and other files as its parents."""
    from dataclasses import replace

    from escape_hw.cli.formatting import format_calibration, status_line
    from escape_hw.io.documents import calibration_document
    from escape_hw.io.fits.matrix import save_matrix
    from escape_hw.io.provenance import file_sha256
    from escape_hw.runtime.session.record import config_provenance

    # The modes come from the file.
    parents = {file.name: file_sha256(file) for file in (source, *others)}
    origin = replace(config_provenance(config), basis="file", parents=parents)
    path = save_matrix(out, result, origin)
    context.show(
        status_line(result.matrix.simulated, result.partial), *format_calibration(result), f"im: {path}"
    )
    products: dict[str, Any] = {"im": path.absolute()}
    if telemetry is not None:
        products["telemetry"] = telemetry.absolute()
    context.set_subject(config.system.name, result.matrix.simulated, None)
    context.report(**calibration_document(result), source=source.absolute(), products=products)


def _publish(name: str, data: Any, version: str) -> None:
    from escape_hw.io.interchange.milk.stream import MilkStream

    try:
        stream = MilkStream.create(name, data.shape, data.dtype, version=version)
    except ValueError as error:
        raise ConfigError(str(error)) from error
    stream.write(data)
    stream.close()


def _record_stream(context: CommandContext, stream: Stream, frames: int, out: Path) -> None:
    """Save the newest array of a stream and those that follow."""
    import io

    import numpy as np

    from escape_hw.io.interchange.stream import StreamReadError
    from escape_hw.io.storage import write_atomic

    try:
        found = [stream.latest()]
        while len(found) < frames:
            following = stream.read_after(found[-1].count, _TIMEOUT_S)
            if following is None:
                raise ProductError(f"stream '{stream.name}': nothing written for {_TIMEOUT_S:g} s")
            found.append(following)
    except StreamReadError as error:
        raise ProductError(str(error)) from error
    finally:
        stream.close()
    counts, times = np.array([[each.count, each.written_ns] for each in found]).T
    buffer = io.BytesIO()
    np.savez(buffer, data=np.stack([each.data for each in found]), count=counts, written_ns=times)
    write_atomic(out, buffer.getvalue())
    missed = int(counts[-1] - counts[0]) + 1 - len(found)
    context.show(f"{len(found)} arrays of {stream.shape} {stream.dtype}, {missed} missed: {out}")
    context.report(stream=stream.name, frames=len(found), missed=missed, file=out.absolute())
