"""Import of a calibration of pyRTC, and export of an interaction matrix with its settings."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.interaction_matrix import InteractionMatrix
from escape_hw.api.pyramid import PyramidPupils
from escape_hw.api.results import CalibrationResult
from escape_hw.api.sensor import SensorGeometry, SubApertureGrid, require_kind
from escape_hw.bounded_files import MAX_TEXT_BYTES, read_bounded
from escape_hw.errors import IncompatibleProduct, ProductError
from escape_hw.io.documents import registration_document
from escape_hw.io.interchange.optional_packages import import_optional
from escape_hw.io.interchange.pyrtc.files import (
    MATRIX,
    REFERENCES,
    VALID,
    LegacyConvention,
    PyrtcFile,
    read_file,
    require_frame_order,
    write_array,
    write_file,
)
from escape_hw.io.interchange.pyrtc.geometry import PyrtcLenslets, PyrtcPupils
from escape_hw.io.storage import write_atomic


@dataclass(frozen=True, slots=True)
class TargetSystem:
    """The system of ours that a calibration is read for.

    ``kind`` is that of its sensor, ``n_sub`` the sub-apertures across its pupil; ``simulated`` marks the
    result as simulated.
    """

    system: str
    kind: str
    n_sub: int
    n_act: int
    simulated: bool


@dataclass(frozen=True, slots=True, eq=False)
class PyrtcConfig:
    """The sections of a pyRTC configuration that define its calibration.

    Keys are those of 2.x; pyRTC 1.x wrote the same words in one (``subApSpacing``), and gave the centres of
    pupils by row and column.
    """

    path: Path
    slopes: dict[str, Any]
    loop: dict[str, Any]
    wfs: dict[str, Any]
    wfc: dict[str, Any]
    old: bool = False

    @classmethod
    def read(cls, path: Path | str) -> PyrtcConfig:
        """Read a YAML file.

        Raises
        ------
        ConfigError
            The YAML library is not installed.
        ProductError
            Not there, or no configuration of pyRTC's.
        """
        yaml = import_optional("yaml", "Reading pyRTC's configuration")
        path = Path(path)
        try:
            document = yaml.safe_load(read_bounded(path, MAX_TEXT_BYTES).decode("utf-8"))
        except OSError as error:
            raise ProductError(f"{path}: cannot be read ({error.strerror or error})") from error
        except (yaml.YAMLError, ValueError, RecursionError) as error:
            raise ProductError(f"{path}: not YAML ({' '.join(str(error).split())})") from error
        sections = document if isinstance(document, dict) else {}
        found = {name: sections.get(name) or {} for name in ("slopes", "loop", "wfs", "wfc")}
        wrong = [name for name, section in found.items() if not isinstance(section, dict)]
        if wrong or not found["slopes"]:
            raise ProductError(f"{path}: no configuration of pyRTC's; it has no section 'slopes'")
        keys = [str(key) for section in found.values() for key in section]
        old = any(key != _to_snake_case(key) for key in keys)
        new = {
            name: {_to_snake_case(str(k)): v for k, v in section.items()} for name, section in found.items()
        }
        return cls(path, **new, old=old)

    def file(self, section: dict[str, Any], key: str) -> Path | None:
        """A file that a section names, relative to the configuration; ``None`` where it names none."""
        name = str(section.get(key) or "")
        return self.path.parent / name if name else None

    def need(self, section: str, key: str, kind: type[Any]) -> Any:
        """A value that must be there.

        Raises
        ------
        ProductError
            It is missing or of another type.
        """
        value = getattr(self, section).get(key)
        try:
            return kind(value)
        except (TypeError, ValueError) as error:
            raise ProductError(f"{self.path}: {section}.{key} is {value!r}; a number is needed") from error

    @property
    def shape(self) -> tuple[int, int]:
        """Frame (rows, columns) after pyRTC's down-sampling."""
        factor = max(int(self.wfs.get("downsample_factor") or 0), 1)
        return self.need("wfs", "height", int) // factor, self.need("wfs", "width", int) // factor


@dataclass(frozen=True, slots=True, eq=False)
class _CalibrationFiles:
    """The files of a calibration, and what those of pyRTC 1.x meant."""

    matrix: PyrtcFile
    mask: PyrtcFile | None
    references: PyrtcFile | None
    frame: LegacyConvention

    @classmethod
    def read(cls, config: PyrtcConfig, im: Path | None, frame_order: str | None) -> _CalibrationFiles:
        path = im or config.file(config.loop, "im_file")
        if path is None:
            raise ProductError(f"{config.path}: loop.im_file names no interaction matrix; name one with --im")
        mask, references = (
            None if named is None else read_file(named, kind)
            for named, kind in (
                (config.file(config.slopes, "valid_sub_aps_file"), VALID),
                (config.file(config.slopes, "ref_slopes_file"), REFERENCES),
            )
        )
        files = (read_file(path, MATRIX), mask, references)
        for file in files:
            if file is not None and file.legacy:
                require_frame_order(file, frame_order)
        pyramid = str(config.slopes.get("type", "")).lower() == "pywfs"
        window = 0 if pyramid else int(np.round(config.need("slopes", "sub_ap_spacing", float)))
        frame = LegacyConvention(
            frame_order or "as_is", pyramid, window, default_pupils="pupils" not in config.slopes
        )
        return cls(*files, frame)

    def mask_or_default(self, shape: tuple[int, int]) -> NDArray[np.bool_]:
        """The mask; all sub-apertures if no file gives one."""
        if self.mask is None:
            return np.ones(shape, bool)
        mask = np.asarray(self.mask.data, bool)
        return self.frame.map(mask) if self.mask.legacy else mask

    def references_or_default(self, shape: tuple[int, int]) -> NDArray[np.float32]:
        """The reference slopes; zeros if no file gives them."""
        if self.references is None:
            return np.zeros(shape, np.float32)
        data = np.asarray(self.references.data, np.float32)
        return self.frame.references(data) if self.references.legacy else data

    def rows(self, n_slopes: int) -> NDArray[np.float64]:
        """The matrix with the rows of pyRTC 2.x ``(n_slopes, n_modes)``."""
        file, data = self.matrix, np.asarray(self.matrix.data, float)
        if data.ndim != 2 or data.shape[0] != n_slopes:
            raise IncompatibleProduct(
                f"{file.path}: has shape {data.shape}; the configuration's sensor gives {n_slopes} slopes"
            )
        if not file.legacy or self.frame.frame_order != "xy":
            return data
        if self.mask is None or not self.mask.legacy:
            raise IncompatibleProduct(
                f"{file.path}: its rows can be put in order only with the mask it was measured with; name "
                "that in slopes.valid_sub_aps_file"
            )
        return np.asarray(self.frame.matrix(data, np.asarray(self.mask.data, bool)))


@dataclass(frozen=True, slots=True, eq=False)
class _SensorMapping:
    """Our geometry, which rows of pyRTC's signal its slopes are, and with which signs."""

    grid: SensorGeometry
    rows: NDArray[np.intp]
    signs: NDArray[np.int8]
    notes: tuple[str, ...] = ()


def import_matrix(
    config: PyrtcConfig, target: TargetSystem, im: Path | None = None, frame_order: str | None = None
) -> CalibrationResult:
    """Read the calibration that a configuration of pyRTC's names.

    Parameters
    ----------
    im
        Another interaction matrix than ``loop.im_file``.
    frame_order
        How files of pyRTC 1.x were made, see :mod:`~escape_hw.io.interchange.pyrtc.files`.

    Raises
    ------
    ProductError
        A file is missing or damaged.
    IncompatibleProduct
        The parts do not fit each other or the system, or files of pyRTC 1.x lack the description of how they
        were made.
    """
    files = _CalibrationFiles.read(config, im, frame_order)
    file, record = files.matrix, files.matrix.record or {}
    sensor = (_map_pyramid if files.frame.pyramid else _map_lenslets)(config, target, files)
    data = files.rows(len(sensor.rows))[sensor.rows] * sensor.signs[:, None]
    sigma = file.extra_arrays.get("sigma", np.zeros(file.data.shape))
    if sigma.shape != file.data.shape:
        raise ProductError(f"{file.path}: standard errors of shape {sigma.shape} for {file.data.shape}")
    matrix = InteractionMatrix(
        data.astype(np.float32), sigma[sensor.rows].astype(np.float32),
        _read_modes(config, target, data.shape[1]),
        sensor.grid.valid, target.system, str(record.get("method", "pyrtc")),
        target.simulated or bool(record.get("simulated", False)),
        {"pyrtc_version": str(record.get("pyrtc_version", "1.x" if file.legacy else "2.x"))},
        sensor.grid.slope_unit,
    )  # fmt: skip
    notes = [f"read from pyRTC's {file.path.name}", *sensor.notes]
    if "sigma" not in file.extra_arrays:
        notes.append("it has no standard errors; uncertainties of a registration assume equal ones")
    return CalibrationResult(matrix, sensor.grid, int(record.get("frames") or 0), 0, 0.0, notes=tuple(notes))


def _map_lenslets(config: PyrtcConfig, target: TargetSystem, files: _CalibrationFiles) -> _SensorMapping:
    _require_kind(config, target, "shack-hartmann")
    windows = PyrtcLenslets(
        config.need("slopes", "sub_ap_spacing", float),
        config.need("slopes", "sub_ap_offset_x", int),
        config.need("slopes", "sub_ap_offset_y", int),
        config.shape,
    )
    shape = (2 * windows.n, windows.n)
    grid, rows, note = windows.grid(
        files.mask_or_default(shape), files.references_or_default(shape), target.n_sub
    )
    return _SensorMapping(grid, rows, np.ones(len(rows), np.int8), () if note is None else (note,))


def _map_pyramid(config: PyrtcConfig, target: TargetSystem, files: _CalibrationFiles) -> _SensorMapping:
    _require_kind(config, target, "pyramid")
    rows, columns = config.shape
    left, right, top, bottom = columns // 4, int(0.75 * columns), rows // 4, int(0.75 * rows)
    centres = [(left, top), (left, bottom), (right, top), (right, bottom)]
    radius = min(rows - bottom, columns - right)
    if "pupils" in config.slopes:
        centres = [_parse_point(config, entry) for entry in config.slopes["pupils"]]
        if config.old and files.frame.frame_order == "yx":
            centres = [(x, y) for y, x in centres]
        radius = config.need("slopes", "pupils_radius", int)
    images = PyrtcPupils(tuple(centres), radius, float(config.slopes.get("central_obscuration_ratio") or 0.0))
    return _SensorMapping(*images.pupils(files.references_or_default((images.n, 2 * images.n)), target.n_sub))


def _to_snake_case(key: str) -> str:
    """A key of pyRTC 1.x as 2.x spells it: ``IMFile`` becomes ``im_file``."""
    return re.sub(r"(?<=[a-z0-9])(?=[A-Z])|(?<=[A-Z])(?=[A-Z][a-z])", "_", key).lower()


def _parse_point(config: PyrtcConfig, entry: object) -> tuple[int, int]:
    parts = entry.split(",") if isinstance(entry, str) else entry
    try:
        x, y = (int(part) for part in parts)  # type: ignore[attr-defined]
    except (TypeError, ValueError) as error:
        raise ProductError(f"{config.path}: slopes.pupils: {entry!r} is not 'x,y'") from error
    return x, y


def _require_kind(config: PyrtcConfig, target: TargetSystem, kind: str) -> None:
    if target.kind != kind:
        raise IncompatibleProduct(
            f"{config.path}: its sensor is a {kind}; system '{target.system}' has "
            f"sensor.kind = '{target.kind}'"
        )


def _read_modes(config: PyrtcConfig, target: TargetSystem, n_modes: int) -> NDArray[np.float64]:
    """The mode-to-command matrix: a file's, or single actuators as pyRTC has it without one."""
    path = config.file(config.wfc, "m2c_file")
    if path is None and config.wfc.get("basis"):
        raise IncompatibleProduct(
            f"{config.path}: wfc.basis lets pyRTC compute its modes; save them there "
            "(numpy.save('m2c.npy', wfc.M2C)) and name the file in wfc.m2c_file"
        )
    if path is None:
        m2c = np.eye(target.n_act)[:, :n_modes]
    elif ".dat" in path.name:
        m2c = np.fromfile(path).reshape(target.n_act, -1)
    else:
        m2c = np.asarray(read_file(path).data, float)
    if m2c.shape != (target.n_act, n_modes):
        raise IncompatibleProduct(
            f"{path or config.path}: the modes have shape {m2c.shape}; {(target.n_act, n_modes)} belongs to "
            f"system '{target.system}' and this matrix"
        )
    return m2c


_FILE_NAMES = {
    "im": "im.npz", "valid": "valid_sub_aps.npz", "references": "ref_slopes.npz", "m2c": "m2c.npy",
    "settings": "pyrtc.yaml",
}  # fmt: skip
#: Maximum relative part of a requested mode outside of the span of the matrix's modes.
_MAX_RESIDUAL = 1e-6


@dataclass(frozen=True, slots=True)
class FrameSettings:
    """Camera properties that pyRTC needs besides the geometry.

    ``shape`` is the frame (rows, columns); below ``threshold``, in counts, a pixel of a spot counts as dark.
    """

    shape: tuple[int, int]
    threshold: float


def convert_basis(matrix: InteractionMatrix, m2c: NDArray[np.float64]) -> InteractionMatrix:
    """The matrix for other modes in the span of its own.

    Of the matrix ``D`` for the modes ``M`` it is ``D M^+ M'``, with the requested modes ``M' (n_act, n)``.

    Raises
    ------
    IncompatibleProduct
        A requested mode is not a linear combination of the matrix's modes.
    """
    if m2c.shape[0] != matrix.m2c.shape[0]:
        raise IncompatibleProduct(
            f"the requested modes have {m2c.shape[0]} actuators, the matrix {matrix.m2c.shape[0]}"
        )
    transform = np.linalg.lstsq(matrix.m2c, m2c, rcond=None)[0]
    outside = np.linalg.norm(matrix.m2c @ transform - m2c, axis=0) / np.linalg.norm(m2c, axis=0)
    if outside.max(initial=0.0) > _MAX_RESIDUAL:
        raise IncompatibleProduct(
            f"mode {int(outside.argmax())} of those requested is not a linear combination of the "
            f"matrix's {matrix.n_modes} modes ({outside.max():.2g} of it is left over); calibrate with "
            f"basis.n_modes={m2c.shape[0]}, or take the matrix's own modes"
        )
    data = (matrix.data.astype(float) @ transform).astype(np.float32)
    variance = np.square(matrix.sigma.astype(float)) @ np.square(transform)
    return InteractionMatrix(
        data, np.sqrt(variance).astype(np.float32), m2c, matrix.valid, matrix.system, matrix.method,
        matrix.simulated, dict(matrix.metrics), matrix.slope_unit,
    )  # fmt: skip


def export_paths(folder: Path) -> dict[str, Path]:
    """Paths by name of the files that :func:`export_matrix` writes into a folder."""
    return {name: folder / file for name, file in _FILE_NAMES.items()}


def export_matrix(
    folder: Path, result: CalibrationResult, frame: FrameSettings, m2c: NDArray[np.float64] | None = None
) -> dict[str, Path]:
    """Write matrix, mask, references, modes and the settings that go with them; files are replaced.

    Parameters
    ----------
    m2c
        Modes that pyRTC's commands are to mean ``(n_act, n_modes)``; the matrix's own by default.

    Returns
    -------
    dict
        The paths, see :func:`export_paths`.

    Raises
    ------
    IncompatibleProduct
        pyRTC cannot read a sensor like this, or the modes differ from the matrix's.
    StorageError
        A file cannot be written.
    """
    matrix = result.matrix if m2c is None else convert_basis(result.matrix, m2c)
    slopes, mask, references, (data, sigma) = _sensor_parts(result.grid, frame, matrix)
    paths = export_paths(folder)
    kind = {"wfs_type": "pywfs" if isinstance(result.grid, PyramidPupils) else "shwfs"}
    record = {
        "system": matrix.system,
        "method": matrix.method,
        "simulated": matrix.simulated,
        "slope_unit": matrix.slope_unit,
        "frames": result.frames,
        "lost_frames": result.lost_frames,
        "delay_frames": None if result.response is None else result.response.delay_frames,
        **registration_document(result.registration),
    }
    write_file(paths["im"], data, MATRIX, record, {"sigma": sigma})
    write_file(paths["valid"], mask, VALID, kind)
    write_file(paths["references"], references, REFERENCES, kind)
    write_array(paths["m2c"], matrix.m2c)
    sections = {
        "slopes": slopes,
        "wfc": {
            "num_actuators": matrix.m2c.shape[0],
            "num_modes": matrix.n_modes,
            "m2c_file": _FILE_NAMES["m2c"],
        },
        "loop": {"im_file": _FILE_NAMES["im"]},
    }
    yaml_lines = ["# Written by ESCAPE: merge these keys into pyRTC's configuration, in this folder."]
    for name, values in sections.items():
        yaml_lines.append(f"{name}:")
        for key, value in values.items():
            if isinstance(value, list):
                yaml_lines += [f"  {key}:", *(f'  - "{item}"' for item in value)]
            else:
                yaml_lines.append(f"  {key}: {value}")
    write_atomic(paths["settings"], ("\n".join(yaml_lines) + "\n").encode())
    return paths


def _sensor_parts(
    grid: SensorGeometry, frame: FrameSettings, matrix: InteractionMatrix
) -> tuple[dict[str, Any], NDArray[np.bool_], NDArray[np.float32], tuple[NDArray[np.float32], ...]]:
    """The slopes section, mask, references, and matrix and errors row by row as pyRTC has them."""
    both = (matrix.data, matrix.sigma)
    if isinstance(grid, PyramidPupils):
        images = PyrtcPupils.from_pupils(grid)
        section = {
            "type": "PYWFS",
            "signal_type": "slopes",
            "pupils": [f"{x},{y}" for x, y in images.centres],
            "pupils_radius": images.radius,
            "ref_slopes_file": _FILE_NAMES["references"],
        }
        rows = tuple(images.rows_of(grid, part) for part in both)
        return section, images.mask_of(), images.references_of(grid), rows
    lenslets = require_kind(grid, SubApertureGrid)
    windows = PyrtcLenslets.from_grid(lenslets, frame.shape)
    section = {
        "type": "SHWFS",
        "signal_type": "slopes",
        "sub_ap_spacing": windows.spacing,
        "sub_ap_offset_x": windows.offset_x,
        "sub_ap_offset_y": windows.offset_y,
        # pyRTC's threshold is the product of these two.
        "image_noise": frame.threshold,
        "contrast": 1.0,
        "valid_sub_aps_file": _FILE_NAMES["valid"],
        "ref_slopes_file": _FILE_NAMES["references"],
    }
    return section, windows.mask_of(lenslets), windows.references_of(lenslets), both
