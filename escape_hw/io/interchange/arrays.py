"""Interaction matrices in text, NumPy or FITS files, with a description of their order, signs and units.

The description is a TOML file of four tables, the fields of :class:`MatrixTable`, :class:`SensorTable`,
:class:`ActuatorTable` and :class:`ModeTable`. Names of files are relative to its folder.
"""

from __future__ import annotations

import os
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError
from pydantic_core import ErrorDetails

from escape_hw.api.flips import turn_image
from escape_hw.api.interaction_matrix import InteractionMatrix
from escape_hw.api.pyramid import PyramidPupils
from escape_hw.api.results import CalibrationResult
from escape_hw.api.sensor import SensorGeometry, SubApertureGrid
from escape_hw.array_files import array_names, read_array
from escape_hw.bounded_files import MAX_TEXT_BYTES, read_bounded, reason_of
from escape_hw.errors import ConfigError, IncompatibleProduct
from escape_hw.suggestions import closest_match, did_you_mean

#: Response of a pixel, relative to the largest, below which ``valid = "nonzero"`` counts it as zero.
_ZERO = 1e-12


class _Table(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)


class MatrixTable(_Table):
    """Table [matrix]: the array.

    Parameters
    ----------
    file
        Text, ``.npy``, ``.npz`` or FITS, each also compressed by gzip; empty: given on the command line.
    array
        Name of the array in an ``.npz`` archive, or of the FITS extension; empty: the first.
    order
        ``"slopes-commands"``: a row per slope and a column per command; ``"commands-slopes"``: the transpose.
        Maps of slopes are last, with a first axis of commands: x and y ``"maps-beside"`` each other
        ``(n, rows, 2 columns)``, or x ``"maps-above"`` y ``(n, 2 rows, columns)``.
    slopes
        Order of the slopes of an array without maps: ``"x-y"`` (all x, then all y), ``"y-x"``, or pairs
        ``"xy-pairs"``.
    scale
        Slope of ESCAPE per command of full stroke (pixels; of a pyramid relative to the mean flux) for a 1 in
        the file.
    sigma
        Standard error of an element in the file's unit; 0: unknown.
    method, simulated
        How it was measured, and whether by a simulation; absent: simulated if the system is a twin.
    """

    file: str = ""
    array: str = ""
    order: Literal["slopes-commands", "commands-slopes", "maps-beside", "maps-above"] = "slopes-commands"
    slopes: Literal["x-y", "y-x", "xy-pairs"] = "x-y"
    scale: float = 1.0
    sigma: float = Field(0.0, ge=0)
    method: str = "push-pull"
    simulated: bool | None = None


class SensorTable(_Table):
    """Table [sensor]: valid sub-apertures and camera.

    Parameters
    ----------
    valid
        Mask of the valid sub-apertures in the file's orientation: the name of a file, or ``"nonzero"`` for
        maps (those with any response). A mask of two maps, beside or above each other, may be given for x
        and y. A mask smaller than the system's ``n_sub`` is centred on it; of a larger one equal margins
        without valid sub-apertures are cut.
    transpose, flip_x, flip_y
        What makes the camera's image that of the system: rows and columns exchanged, then mirrored along x
        (columns) and y (rows). Slopes are exchanged and change their signs with it.
    sign_x, sign_y
        -1: polarity of the slopes along that axis, after the flips.
    """

    valid: str
    transpose: bool = False
    flip_x: bool = False
    flip_y: bool = False
    sign_x: Literal[-1, 1] = 1
    sign_y: Literal[-1, 1] = 1


class ActuatorTable(_Table):
    """Table [actuators]: their numbering.

    Parameters
    ----------
    order
        Number in ESCAPE's layout of each actuator of the file, or the name of a file with them; empty: as in
        the file.
    transpose, flip_x, flip_y
        For a layout on a grid instead: the file counts row by row on a map that becomes the system's by these
        operations, in this order.
    sign
        -1: commands have the opposite sign.
    """

    order: list[int] | str = ""
    transpose: bool = False
    flip_x: bool = False
    flip_y: bool = False
    sign: Literal[-1, 1] = 1


class ModeTable(_Table):
    """Table [modes]: the mode-to-command matrix of a modal matrix.

    Parameters
    ----------
    file, array
        As in [matrix]; ``(n_act, n_modes)`` or its transpose, actuators in the file's order. Empty: single
        actuators.
    """

    file: str = ""
    array: str = ""


class ArrayDescription(_Table):
    """The description of a matrix in arrays."""

    matrix: MatrixTable
    sensor: SensorTable
    actuators: ActuatorTable = ActuatorTable()
    modes: ModeTable = ModeTable()


@dataclass(frozen=True, slots=True, eq=False)
class ArrayTarget:
    """The system of ours that a matrix is read for.

    Parameters
    ----------
    system, simulated
        Its name, and whether it is a twin.
    n_sub
        Sub-apertures across the pupil.
    n_act
        Number of actuators.
    layout
        Map of the actuators; ``None`` without a grid.
    pitch_px, region_px
        Nominal pitch of the lenslets and size (width, height) of the camera's region, of a Shack-Hartmann
        sensor.
    pupils_px, normalisation, modulation
        Nominal pupil images, of a pyramid; ``pupils_px`` is ``None`` for a Shack-Hartmann sensor.
    """

    system: str
    simulated: bool
    n_sub: int
    n_act: int
    layout: NDArray[np.bool_] | None
    pitch_px: float
    region_px: tuple[int, int]
    pupils_px: NDArray[np.float64] | None = None
    normalisation: str = "global"
    modulation: float = 0.0


def read_description(path: Path) -> ArrayDescription:
    """Read a description.

    Raises
    ------
    ConfigError
        It cannot be read, or a key is invalid; one line per key.
    """
    try:
        document = tomllib.loads(read_bounded(path, MAX_TEXT_BYTES).decode("utf-8"))
        return ArrayDescription.model_validate(document)
    except ValidationError as error:
        details = error.errors(include_url=False)
        lines = [f"{path}  {'.'.join(map(str, one['loc']))}: {_problem(one)}" for one in details]
        raise ConfigError("\n".join(lines)) from error
    except (OSError, ValueError) as error:
        raise ConfigError(f"{path}: cannot be read ({reason_of(error)})") from error


def _problem(detail: ErrorDetails) -> str:
    """What is wrong with a key of the description."""
    if detail["type"] == "extra_forbidden":
        return f"unknown key{did_you_mean(_closest_key([str(step) for step in detail['loc']]))}"
    value = "" if detail["type"] == "missing" else f", not {detail['input']!r}"
    return f"{detail['msg'][:1].lower()}{detail['msg'][1:]}{value}"


def _closest_key(path: list[str]) -> str | None:
    """Suggestion for an unknown key: a similar one of its table, or the same name in another table."""
    fields = ArrayDescription.model_fields.items()
    keys = {table: list(getattr(field.annotation, "model_fields", {})) for table, field in fields}
    if len(path) == 1:
        return closest_match(path[0], keys)
    table, key = path
    neighbour = closest_match(key, keys[table])
    if neighbour is not None:
        return f"{table}.{neighbour}"
    return next((f"{other}.{key}" for other in keys if key in keys[other]), None)


def import_arrays(
    description: ArrayDescription, folder: Path, target: ArrayTarget, file: Path | None = None
) -> CalibrationResult:
    """Read a matrix as a product of a system.

    Parameters
    ----------
    folder
        Folder of the files that the description names.
    file
        Another matrix than the description's.

    Raises
    ------
    ProductError
        A file is missing or damaged.
    IncompatibleProduct
        The parts do not fit each other or the system.
    """
    table = description.matrix
    if file is None and not table.file:
        raise ConfigError("matrix.file of the description is empty; name the file there, or with --im")
    path = file or folder / table.file
    array = _read_numbers(path, table.array)
    if not np.isfinite(array).all():
        n = int((~np.isfinite(array)).sum())
        raise IncompatibleProduct(
            f"{path}: {n} of {array.size} elements are not finite; replace them by zeros"
        )
    valid, x, y = _slopes_of_commands(path, array, description, folder)
    valid, x, y = _turn_camera(description.sensor, valid, x, y)
    padded = _centre_mask(valid, target.n_sub)
    order = actuator_order(description.actuators, target, folder)
    m2c, columns = _commands(path, description, folder, x.shape[1], order)
    data = _scale(path, table.scale, description.actuators.sign * np.concatenate([x, y])[:, columns])
    notes = [f"read from {path.name}"]
    if not table.sigma:
        notes.append("it has no standard errors; uncertainties of a registration assume equal ones")
    grid = design_geometry(padded, target)
    simulated = target.simulated if table.simulated is None else table.simulated
    matrix = InteractionMatrix(
        data, np.full(data.shape, abs(table.scale) * table.sigma, np.float32), m2c, padded,
        target.system, table.method, simulated, slope_unit=grid.slope_unit,
    )  # fmt: skip
    return CalibrationResult(matrix, grid, 0, 0, 0.0, notes=tuple(notes))


def _read_numbers(path: Path, name: str = "") -> NDArray[np.float64]:
    """An array of real numbers; others are refused."""
    array = read_array(path, name)
    if array.dtype.kind not in "biuf":
        raise IncompatibleProduct(f"{path}: has elements of type {array.dtype}; save real numbers")
    return np.asarray(array, dtype=np.float64)


def _scale(path: Path, scale: float, data: NDArray[np.float64]) -> NDArray[np.float32]:
    """The matrix in ESCAPE's unit; a product without any response, or beyond the numbers, is refused."""
    with np.errstate(over="ignore"):
        scaled = (scale * data).astype(np.float32)
    if not (np.isfinite(scaled).all() and scaled.any()):
        raise IncompatibleProduct(
            f"{path}: largest element {np.abs(data).max(initial=0):g}, times matrix.scale = {scale:g}; "
            "slopes must be finite and not all zero"
        )
    return scaled


def _name_arrays(path: Path, remedy: str) -> str:
    """The arrays of a file with several and what to do, for a message; empty for other files."""
    names = array_names(path)
    return f"; {path.name} has the arrays {', '.join(names)}: {remedy}" if len(names) > 1 else ""


def _slopes_of_commands(
    path: Path, array: NDArray[np.float64], description: ArrayDescription, folder: Path
) -> tuple[NDArray[np.bool_], NDArray[np.float64], NDArray[np.float64]]:
    """Mask, and x and y slopes ``(n_valid, n_commands)``, in the file's orientation."""
    table, name = description.matrix, description.sensor.valid
    n_axes = 3 if table.order.startswith("maps") else 2
    if array.ndim != n_axes:
        others = _name_arrays(path, "name one with matrix.array")
        raise IncompatibleProduct(
            f"{path}: has shape {array.shape}; {table.order!r} needs {n_axes} axes{others}"
        )
    if n_axes == 3:
        maps = _split_maps(path, array, table.order == "maps-beside")
        seen = np.abs(maps).max(axis=(0, 1))
        valid = seen > _ZERO * seen.max() if name == "nonzero" else _read_mask(folder / name)
        if valid.shape != maps.shape[2:]:
            raise IncompatibleProduct(
                f"{path}: maps of {maps.shape[2:]} slopes; the mask {name} is {valid.shape}"
            )
        x, y = np.moveaxis(maps[:, :, valid], -1, 1)
        return valid, x, y
    if name == "nonzero":
        raise IncompatibleProduct(f"{path}: sensor.valid = 'nonzero' needs maps of slopes; name a mask")
    valid = _read_mask(folder / name)
    data, n = array.T if table.order == "commands-slopes" else array, int(valid.sum())
    if len(data) != 2 * n:
        hint = "; transpose it with matrix.order" if data.shape[1] == 2 * n else ""
        raise IncompatibleProduct(f"{path}: {len(data)} slopes for {n} valid sub-apertures of {name}{hint}")
    if table.slopes == "xy-pairs":
        return valid, data[0::2], data[1::2]
    first, second = data[:n], data[n:]
    return (valid, first, second) if table.slopes == "x-y" else (valid, second, first)


def _split_maps(path: Path, array: NDArray[np.float64], beside: bool) -> NDArray[np.float64]:
    """Maps ``(2, n, rows, columns)`` of x and y slopes."""
    axis = 2 if beside else 1
    if array.shape[axis] % 2:
        raise IncompatibleProduct(f"{path}: has shape {array.shape}; axis {axis} has x and y, an even number")
    return np.stack(np.split(array, 2, axis=axis))


def _read_mask(path: Path) -> NDArray[np.bool_]:
    """A mask, of which the two for x and y must be equal."""
    mask = read_array(path) != 0
    if mask.ndim != 2:
        others = _name_arrays(path, "save the mask alone")
        raise IncompatibleProduct(f"{path}: has shape {mask.shape}; a mask has rows and columns{others}")
    for axis in (0, 1):
        if mask.shape[axis] == 2 * mask.shape[1 - axis]:
            first, second = np.split(mask, 2, axis=axis)
            if not np.array_equal(first, second):
                raise IncompatibleProduct(f"{path}: the masks for x and y differ; give one for both")
            mask = first
    return np.asarray(mask)


def _turn_camera(
    table: SensorTable, valid: NDArray[np.bool_], x: NDArray[np.float64], y: NDArray[np.float64]
) -> tuple[NDArray[np.bool_], NDArray[np.float64], NDArray[np.float64]]:
    """Mask and slopes in the orientation of the system's camera."""
    number = np.full(valid.shape, -1)
    number[valid] = np.arange(int(valid.sum()))
    number = turn_image(number, table.transpose, table.flip_x, table.flip_y)
    if table.transpose:
        x, y = y, x
    rows = number[number >= 0]
    sign_x, sign_y = table.sign_x * (-1 if table.flip_x else 1), table.sign_y * (-1 if table.flip_y else 1)
    return number >= 0, sign_x * x[rows], sign_y * y[rows]


def _centre_mask(valid: NDArray[np.bool_], n_sub: int) -> NDArray[np.bool_]:
    """The mask on ``n_sub x n_sub``; a larger one is cut by equal margins without valid sub-apertures."""
    margins = [(n_sub - n) / 2 for n in valid.shape]
    cut = tuple(slice(int(-m), int(m)) if m < 0 else slice(None) for m in margins)
    if any(m % 1 for m in margins) or valid[cut].sum() < valid.sum():
        raise IncompatibleProduct(
            f"the mask of {valid.shape[0]} x {valid.shape[1]} sub-apertures cannot be centred on "
            f"sensor.n_sub = {n_sub}; correct sensor.n_sub of the system (--set sensor.n_sub=N), or the "
            "empty rows and columns of the mask"
        )
    return np.pad(valid[cut], [(max(int(m), 0),) * 2 for m in margins])


def actuator_order(table: ActuatorTable, target: ArrayTarget, folder: Path = Path()) -> NDArray[np.intp]:
    """Number in the system's layout of each actuator of the file.

    Raises
    ------
    IncompatibleProduct
        The order is no permutation of the system's actuators, or flips are asked for without a grid.
    """
    turned = table.transpose or table.flip_x or table.flip_y
    order: NDArray[np.intp] | NDArray[np.float64]
    if not table.order:
        order = np.arange(target.n_act) if not turned else _order_on_grid(table, target)
    elif turned:
        raise ConfigError("actuators.order gives the numbering; remove transpose, flip_x and flip_y")
    elif isinstance(table.order, str):
        order = _read_numbers(folder / table.order).ravel()
    else:
        order = np.array(table.order, dtype=np.intp)
    if not np.array_equal(np.sort(order), np.arange(target.n_act)):
        raise IncompatibleProduct(
            f"actuators.order has {order.size} numbers; the {target.n_act} actuators of system "
            f"'{target.system}' need each whole number of 0 to {target.n_act - 1} once"
        )
    return order.astype(np.intp)


def _order_on_grid(table: ActuatorTable, target: ArrayTarget) -> NDArray[np.intp]:
    if target.layout is None:
        raise IncompatibleProduct(
            f"the actuators of system '{target.system}' are on no grid; give actuators.order instead of flips"
        )
    ours = np.full(target.layout.shape, -1)
    ours[target.layout] = np.arange(target.n_act)
    theirs = turn_image(ours, False, table.flip_x, table.flip_y)
    theirs = theirs.T if table.transpose else theirs
    return np.asarray(theirs[theirs >= 0], dtype=np.intp)


def _commands(
    path: Path, description: ArrayDescription, folder: Path, n: int, order: NDArray[np.intp]
) -> tuple[NDArray[np.float64], NDArray[np.intp]]:
    """Mode-to-command matrix, and the file's column of each of its modes."""
    if not description.modes.file:
        if n != order.size:
            raise IncompatibleProduct(
                f"{path}: is for {n} commands; the system has {order.size} actuators (a modal matrix needs "
                "modes.file)"
            )
        # Single actuators, in our numbering.
        return np.eye(n), np.argsort(order)
    m2c = _read_numbers(folder / description.modes.file, description.modes.array)
    if m2c.shape == (n, order.size) and n != order.size:
        m2c = m2c.T
    if m2c.shape != (order.size, n):
        others = _name_arrays(folder / description.modes.file, "name one with modes.array")
        raise IncompatibleProduct(
            f"{description.modes.file}: has shape {m2c.shape}; {order.size} actuators and the {n} modes of "
            f"{path.name} need ({order.size}, {n}){others}"
        )
    return m2c[np.argsort(order)], np.arange(n)


def design_geometry(valid: NDArray[np.bool_], target: ArrayTarget) -> SensorGeometry:
    """The design's geometry with valid sub-apertures ``(n_sub, n_sub)``; light and references are unknown."""
    n, references = target.n_sub, np.zeros((int(valid.sum()), 2), np.float32)
    light = valid.astype(np.float32)
    if target.pupils_px is not None:
        corners = np.round(target.pupils_px - (n - 1) / 2).astype(np.intp)
        return PyramidPupils(
            target.pupils_px, float(n), corners, valid, references, light, 0.0,
            normalisation=target.normalisation, modulation=target.modulation,
        )  # fmt: skip
    x, y = ((side - 1) / 2 - target.pitch_px * (n - 1) / 2 for side in target.region_px)
    return SubApertureGrid(target.pitch_px, (x, y), valid, references, light, 0.0)


def described_files(description: ArrayDescription, folder: Path, file: Path | None = None) -> list[Path]:
    """The files that make up a matrix, for the product's provenance."""
    order = description.actuators.order
    names = (description.sensor.valid, order if isinstance(order, str) else "", description.modes.file)
    parts = [folder / name for name in names if name and name != "nonzero"]
    return [file or folder / description.matrix.file, *(part for part in parts if os.path.isfile(part))]
