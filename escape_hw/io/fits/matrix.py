"""Interaction matrices and modal bases in FITS files."""

from __future__ import annotations

import io
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from astropy.io import fits as astropy_fits
from numpy.typing import ArrayLike, NDArray

from escape_hw.api.interaction_matrix import InteractionMatrix
from escape_hw.api.results import CalibrationResult, RegistrationEstimate
from escape_hw.api.sensor import SensorGeometry
from escape_hw.bounded_files import max_product_bytes, read_bounded
from escape_hw.errors import IncompatibleProduct, ProductError
from escape_hw.io.fits import extensions
from escape_hw.io.fits import file as fits_file
from escape_hw.io.fits.file import Product
from escape_hw.io.provenance import Provenance

KIND_MATRIX = "IM"
#: Largest magnitude of a value in a matrix or basis, in its own unit; anything beyond is damage.
_LARGEST = 1e12


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class MatrixProduct(Product[CalibrationResult]):
    """An interaction matrix read from disk."""

    @property
    def matrix(self) -> InteractionMatrix:
        """The matrix to close the loop with."""
        return self.result.matrix

    @property
    def grid(self) -> SensorGeometry:
        """The sensor's geometry that its slopes belong to."""
        return self.result.grid

    @property
    def registration(self) -> RegistrationEstimate | None:
        """The registration it was computed for, when it is a pseudo-synthetic matrix."""
        return self.result.registration


def save_matrix(path: Path | str, result: CalibrationResult, origin: Provenance | None = None) -> Path:
    """Write a calibration's matrix with grid, errors, basis, registration and configuration.

    The result of an aborted run is written as ``*.partial.fits``.

    Returns
    -------
    Path
        The file written.

    Raises
    ------
    StorageError
        The file cannot be written; no partial file remains.
    ValueError
        Matrix and grid do not belong together.
    """
    matrix = result.matrix
    if not np.array_equal(matrix.valid, result.grid.valid):
        raise ValueError(f"the matrix and the geometry mark different {result.grid.elements} as valid")
    hdus = [
        *_pack_matrix(matrix, ""),
        fits_file.image_extension("M2C", matrix.m2c.astype(np.float64)),
        *extensions.pack_grid(result.grid),
        extensions.pack_metrics(
            {"sky_seconds": float(result.sky_seconds), "notes": list(result.notes)}, "RUN"
        ),
    ]
    if result.measured is not None:
        hdus += _pack_matrix(result.measured, "MEAS_")
    if result.registration is not None:
        hdus += extensions.pack_registration(result.registration)
    if result.response is not None:
        hdus.append(extensions.pack_response(result.response))
    if result.mean_frame is not None:
        hdus.append(fits_file.image_extension("FRAME", result.mean_frame.astype(np.float32), "count"))
    cards = {
        "METHOD": (matrix.method, "how the matrix was made"),
        "FRAMES": (int(result.frames), "frames used"),
        "LOST": (int(result.lost_frames), "frames lost"),
    }
    return fits_file.write_product(
        Path(path), KIND_MATRIX, hdus, matrix.system, matrix.simulated, origin, partial=result.partial,
        cards=cards,
    )  # fmt: skip


def load_matrix(
    path: Path | str,
    *,
    expect_system: str | None = None,
    expect_sensor: str | None = None,
    expect_basis: str | None = None,
    expect_modes: int | None = None,
    expect_actuators: int | None = None,
    expect_m2c: ArrayLike | None = None,
    expect_sub_apertures: tuple[int, int] | None = None,
    allow_simulated: bool = True,
) -> MatrixProduct:
    """Read a matrix; every ``expect_...`` that is given must hold.

    Parameters
    ----------
    expect_system, expect_sensor, expect_basis, expect_modes, expect_actuators
        Name of the system, kind of sensor, kind of basis, number of modes and of actuators.
    expect_m2c
        Mode-to-command matrix ``(n_act, n_modes)``, compared element by element.
    expect_sub_apertures
        Shape ``(n_rows, n_columns)`` of the sub-apertures.
    allow_simulated
        False on hardware: a simulated matrix is refused.

    Raises
    ------
    ProductError
        Not there, truncated, damaged, of another kind, incomplete or from a newer version.
    IncompatibleProduct
        Sound, but not for this system, basis, mirror or mode.
    """
    product = MatrixProduct.read(path, KIND_MATRIX, _unpack)
    path, header, matrix = product.path, product.header, product.matrix
    system = None if expect_system is None else fits_file.header_text(expect_system)
    for what, found, wanted, hint in (
        ("system", header["SYSTEM"], system, ""),
        ("kind of sensor", product.grid.kind, expect_sensor, ""),
        ("kind of basis", header["BASIS"], expect_basis, ""),
        ("number of actuators", matrix.m2c.shape[0], expect_actuators, ""),
        ("number of modes", matrix.n_modes, expect_modes, explain_modes(matrix.n_modes)),
        ("grid of sub-apertures", matrix.valid.shape, expect_sub_apertures, ""),
    ):
        fits_file.expect(path, what, found, wanted, hint)
    if expect_m2c is not None:
        _expect_basis(path, matrix.m2c, np.asarray(expect_m2c, float))
    if matrix.simulated and not allow_simulated:
        raise IncompatibleProduct(f"{path}: made in simulation; it is not for hardware (--force overrides)")
    return product


def explain_modes(found: int) -> str:
    """With which setting a matrix of another number of modes would fit."""
    return f"basis.n_modes={found} would take this one"


def _pack_matrix(matrix: InteractionMatrix, prefix: str) -> list[Any]:
    return [
        fits_file.image_extension(
            f"{prefix}IM", matrix.data.astype(np.float32), matrix.slope_unit, METHOD=matrix.method
        ),
        fits_file.image_extension(f"{prefix}SIGMA", matrix.sigma.astype(np.float32), matrix.slope_unit),
        extensions.pack_metrics(matrix.metrics, f"{prefix}METRICS"),
    ]


def _unpack_matrix(
    path: Path, hdus: astropy_fits.HDUList, header: dict[str, Any], prefix: str
) -> InteractionMatrix:
    cards = fits_file.require_extension(path, hdus, f"{prefix}IM").header
    matrix = InteractionMatrix(
        data=fits_file.read_array(path, hdus, f"{prefix}IM", np.float32),
        sigma=fits_file.read_array(path, hdus, f"{prefix}SIGMA", np.float32),
        m2c=fits_file.read_array(path, hdus, "M2C", np.float64),
        valid=fits_file.read_array(path, hdus, "VALID", np.uint8).astype(bool),
        system=str(header["SYSTEM"]),
        method=str(cards["METHOD"]),
        simulated=bool(header["SIMULATE"]),
        metrics=extensions.unpack_metrics(path, hdus, f"{prefix}METRICS"),
        slope_unit=str(cards["BUNIT"]),
        layout=_read_layout(path, hdus),
    )
    # A single measurement of each element has no standard error; it is NaN.
    known_sigma = matrix.sigma[~np.isnan(matrix.sigma)]
    for name, values, low in (("IM", matrix.data, -_LARGEST), ("SIGMA", known_sigma, 0.0)):
        fits_file.require_values(path, f"{prefix}{name}", values, low, _LARGEST)
    fits_file.require_values(path, "M2C", matrix.m2c, -_LARGEST, _LARGEST)
    return matrix


def _read_layout(path: Path, hdus: astropy_fits.HDUList) -> str:
    """Layout of the actuators in the stored configuration; empty if there is none."""
    try:
        return str(tomllib.loads(fits_file.read_text(path, hdus, "CONFIG"))["devices"]["dm"]["layout"])
    except (KeyError, TypeError, ValueError):
        return ""


def _unpack(path: Path, hdus: astropy_fits.HDUList, header: dict[str, Any]) -> CalibrationResult:
    run = extensions.unpack_metrics(path, hdus, "RUN")
    for card in ("FRAMES", "LOST"):
        if type(header[card]) is not int or header[card] < 0:
            raise ProductError(f"{path}: its card {card} is {header[card]!r}; a number of frames is needed")
    frame = fits_file.read_array(path, hdus, "FRAME", np.float32) if "FRAME" in hdus else None
    return CalibrationResult(
        matrix=_unpack_matrix(path, hdus, header, ""),
        grid=extensions.unpack_grid(path, hdus),
        frames=int(header["FRAMES"]),
        lost_frames=int(header["LOST"]),
        sky_seconds=float(run["sky_seconds"]),
        response=extensions.unpack_response(path, hdus),
        registration=extensions.unpack_registration(path, hdus),
        measured=_unpack_matrix(path, hdus, header, "MEAS_") if "MEAS_IM" in hdus else None,
        partial=header["FINISH"] == "aborted",
        mean_frame=frame,
        notes=tuple(str(note) for note in run["notes"]),
    )


def _expect_basis(path: Path, found: NDArray[np.float64], wanted: NDArray[np.float64]) -> None:
    fits_file.expect(path, "shape of the basis", found.shape, wanted.shape)
    worst = float(np.abs(found - wanted).max(initial=0.0))
    if worst > 1e-9 * max(1.0, float(np.abs(wanted).max(initial=0.0))):
        raise IncompatibleProduct(
            f"{path}: its basis differs from this system's (by up to {worst:.3g} of stroke per unit mode)"
        )


def load_basis(path: Path | str) -> NDArray[np.float64]:
    """Mode-to-command matrix of a file.

    Parameters
    ----------
    path
        An interaction matrix written by ESCAPE, or any FITS file whose first image with two axes
        is the matrix, actuators along its rows (``NAXIS2``).

    Returns
    -------
    ndarray of float64, ``(n_act, n_modes)``
        As stored; nothing is scaled.

    Raises
    ------
    ProductError
        Not there, damaged, without such an image, or with values that are not finite.
    """
    path = Path(path)
    try:
        content = io.BytesIO(read_bounded(path, max_product_bytes()))
        with astropy_fits.open(content, memmap=False) as hdus:
            if "KIND" not in hdus[0].header:
                return _read_matrix_image(path, hdus)
    except ProductError:
        raise
    except Exception as error:
        # Astropy raises errors of many kinds for damaged files.
        raise ProductError(f"{path}: cannot be read as FITS ({error})") from error
    return load_matrix(path).matrix.m2c


def _read_matrix_image(path: Path, hdus: astropy_fits.HDUList) -> NDArray[np.float64]:
    images = (hdu.data for hdu in hdus if hdu.is_image and hdu.data is not None)
    m2c = next((np.asarray(data, np.float64) for data in images if data.ndim == 2), None)
    if m2c is None:
        raise ProductError(f"{path}: holds no image with two axes; a basis is (n_actuators, n_modes)")
    if not np.isfinite(m2c).all():
        raise ProductError(f"{path}: the basis holds values that are not finite")
    return m2c
