"""Procedures that start from the file of an interaction matrix."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from escape_hw.errors import IncompatibleProduct
from escape_hw.runtime.procedures.declaration import ProcedureSpec, parameter
from escape_hw.runtime.procedures.model_psf import MODEL_PSF_FRAMES, model_psf

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from escape_hw.api.procedure import Procedure
    from escape_hw.bench import Bench
    from escape_hw.config.system import SystemConfig
    from escape_hw.io.fits.matrix import MatrixProduct

ResultT = TypeVar("ResultT")


def load_fitting_matrix(im: Path, config: SystemConfig, simulated: bool = False) -> MatrixProduct:
    """Read a matrix that belongs to this system, basis, mirror and, unless ``simulated``, mode.

    Raises
    ------
    ProductError, IncompatibleProduct
        The file is damaged or belongs to another system.
    """
    from escape_hw.io.fits.file import expect
    from escape_hw.io.fits.matrix import explain_modes

    product = load_matrix_of_mirror(
        im,
        config,
        expect_basis=config.basis.kind,
        allow_simulated=simulated or config.system.mode == "sim",
    )
    found = product.matrix.n_modes
    expect(product.path, "number of modes", found, config.basis.n_modes, explain_modes(found))
    return product


def load_matrix_of_mirror(im: Path, config: SystemConfig, **expected: Any) -> MatrixProduct:
    """Read a matrix of this system, kind of sensor and layout of actuators.

    The layout is judged before modes and sub-apertures: no setting of theirs would make another layout fit.

    Raises
    ------
    ProductError, IncompatibleProduct
        The file is damaged, belongs to another system, or is not as ``expected`` (:func:`load_matrix`).
    """
    from escape_hw.config import layouts
    from escape_hw.io.fits.matrix import load_matrix

    product = load_matrix(
        im,
        expect_system=config.system.name,
        expect_sensor=config.sensor.kind,
        expect_actuators=config.devices.dm.n_act,
        **expected,
    )
    layouts.require_same_positions(product.matrix.layout, config.devices.dm.layout, f"{product.path}:")
    return product


def require_hardware_matrix(product: MatrixProduct, bench: Bench, force: bool) -> None:
    """Refuse a simulated matrix on an open bench of real devices.

    Single devices may have a mode of their own, so the configured mode does not decide.

    Raises
    ------
    IncompatibleProduct
        The matrix was made in simulation, and the bench is hardware.
    """
    if product.matrix.simulated and not bench.simulated and not force:
        raise IncompatibleProduct(
            f"{product.path}: made in simulation; it is not for hardware (--force overrides)"
        )


class MatrixProcedure(ProcedureSpec[ResultT]):
    """Base class of the procedures that close the loop with an interaction matrix."""

    closes_loop = True

    im: Path = parameter(help="Interaction matrix to close the loop with.", label="Matrix", kind="matrix")
    strehl: bool = parameter(
        default=True, help="Measure the model PSF and the Strehl ratios.", label="Measure Strehl", last=True
    )
    force: bool = parameter(
        default=False, help="Allow a simulated matrix on hardware.", on_server=False, last=True
    )

    def load(self, config: SystemConfig, simulated: bool = False) -> None:
        """Read the matrix."""
        self.product = load_fitting_matrix(self.im, config, self.force or simulated)

    def take_model_psf(self, bench: Bench) -> Procedure[NDArray[np.float32] | None]:
        """Measure the model PSF; ``None`` without a science camera or if Strehl ratios are not wanted."""
        if not self.strehl or bench.science is None:
            return None
        return (yield from model_psf(bench))

    @classmethod
    def preparation_frames(cls, bench: Bench, arguments: Mapping[str, Any]) -> int:
        """Sensor frames that pass while the model PSF is measured; 0 if it is not."""
        if not arguments.get("strehl") or bench.science is None:
            return 0
        rate = bench.wfs.settings.frame_rate_hz
        return math.ceil(MODEL_PSF_FRAMES * rate / bench.science.settings.frame_rate_hz)
