"""``escape influence``: the influence functions that SPRINT has found, as a file."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from escape_hw.cli.command import command
from escape_hw.cli.context import CommandContext
from escape_hw.errors import IncompatibleProduct

if TYPE_CHECKING:
    from escape_hw.io.fits.matrix import MatrixProduct


@command("influence")
def influence(
    context: CommandContext,
    source: Annotated[
        Path,
        typer.Argument(metavar="IM", help="Matrix with a registration (FITS), or folder of a run."),
    ],
    out: Annotated[Path, typer.Option("--out", metavar="FILE", help="Influence functions to write (FITS).")],
) -> None:
    """Write the influence functions that SPRINT has found, with errors; moves no device.

    The file can be the nominal mirror of the next run: devices.dm.influence = "file".
    """
    from escape_hw.calibration.sprint.influence_estimate import estimate_influence_functions
    from escape_hw.cli.formatting import profile_lines, registration_remarks
    from escape_hw.config.loader import load_text
    from escape_hw.config.registry import model_factory
    from escape_hw.io.fits.influence import save_influence
    from escape_hw.io.storage import refuse_existing
    from escape_hw.runtime.session.record import config_provenance

    refuse_existing(out)
    product = _fitted_matrix(source)
    if not product.config_text.strip():
        raise IncompatibleProduct(f"{product.path}: has no configuration; calibrate again with this version")
    config = load_text(product.config_text, str(product.path))
    registration = product.registration
    if registration is None:
        raise IncompatibleProduct(f"{product.path}: has no registration; run 'escape sprint' on it first")
    model = model_factory(config.calibration.model)(config, product.grid)
    found = estimate_influence_functions(model, registration)
    dm, matrix = config.devices.dm, product.matrix
    magnification = dm.pitch_m * dm.pitches_across_pupil / config.system.pupil_m
    origin = replace(config_provenance(config), parents={product.path.name: product.sha256})
    path = save_influence(out, found, matrix.system, matrix.simulated, magnification, origin)
    if registration.model_fits is False:
        context.show(registration.outcome, *registration_remarks(registration))
    context.show(
        f"influence functions of {len(found.gain)} actuators, {found.surfaces.shape[2]} x "
        f"{found.surfaces.shape[1]} points: {path}",
        *profile_lines(found.profile),
    )
    context.set_subject(matrix.system, matrix.simulated, None)
    context.report(
        im=product.path.absolute(), model_fits=registration.model_fits, profile=found.profile,
        products={"influence": path.absolute()},
    )  # fmt: skip


def _fitted_matrix(source: Path) -> MatrixProduct:
    """The matrix, or the first of a run folder, whose influence functions were fitted."""
    from escape_hw.io.fits.matrix import load_matrix
    from escape_hw.io.run_folder import read_result

    if not source.is_dir():
        return load_matrix(source)
    for path in read_result(source)["products"].values():
        if path.suffix == ".fits" and _is_matrix(path):
            product = load_matrix(path)
            if product.registration is not None:
                return product
    raise IncompatibleProduct(f"{source}: has no matrix with a registration; run 'escape sprint' on one")


def _is_matrix(path: Path) -> bool:
    from escape_hw.io.fits import file as fits_file
    from escape_hw.io.fits.matrix import KIND_MATRIX

    return bool(fits_file.read(path)[0][0].header["KIND"] == KIND_MATRIX)
