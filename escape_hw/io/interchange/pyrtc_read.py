"""A calibration of pyRTC's, found through its configuration, as a calibration of ours."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.matrix import InteractionMatrix
from escape_hw.api.results import CalibrationResult
from escape_hw.api.sensor import SensorGeometry
from escape_hw.errors import IncompatibleProduct, ProductError
from escape_hw.io.interchange.optional import library
from escape_hw.io.interchange.pyrtc_file import MATRIX, REFERENCES, VALID, PyrtcFile, read_file
from escape_hw.io.interchange.pyrtc_legacy import LegacyFrame, require_way
from escape_hw.io.interchange.pyrtc_lenslets import PyrtcLenslets
from escape_hw.io.interchange.pyrtc_pupils import PyrtcPupils


@dataclass(frozen=True, slots=True)
class Target:
    """The system of ours that a calibration is read for.

    Parameters
    ----------
    system
        Its name.
    kind
        Kind of its sensor.
    n_sub
        Sub-apertures across its pupil.
    n_act
        Number of its actuators.
    simulated
        Whether what comes in counts as simulated.
    """

    system: str
    kind: str
    n_sub: int
    n_act: int
    simulated: bool


@dataclass(frozen=True, slots=True, eq=False)
class PyrtcConfig:
    """The sections of a configuration of pyRTC's that say what its calibration means.

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
        yaml = library("yaml", "Reading pyRTC's configuration")
        path = Path(path)
        try:
            document = yaml.safe_load(path.read_text(encoding="utf-8"))
        except OSError as error:
            raise ProductError(f"{path}: cannot be read ({error.strerror or error})") from error
        except (yaml.YAMLError, UnicodeDecodeError) as error:
            raise ProductError(f"{path}: not YAML ({' '.join(str(error).split())})") from error
        sections = document if isinstance(document, dict) else {}
        found = {name: sections.get(name) or {} for name in ("slopes", "loop", "wfs", "wfc")}
        wrong = [name for name, section in found.items() if not isinstance(section, dict)]
        if wrong or not found["slopes"]:
            raise ProductError(f"{path}: no configuration of pyRTC's; it has no section 'slopes'")
        keys = [str(key) for section in found.values() for key in section]
        old = any(key != _spelled(key) for key in keys)
        new = {name: {_spelled(str(k)): v for k, v in section.items()} for name, section in found.items()}
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
class _Files:
    """The files of a calibration, and what those of pyRTC 1.x meant."""

    matrix: PyrtcFile
    mask: PyrtcFile | None
    references: PyrtcFile | None
    frame: LegacyFrame

    @classmethod
    def read(cls, config: PyrtcConfig, im: Path | None, way: str | None) -> _Files:
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
                require_way(file, way)
        pyramid = str(config.slopes.get("type", "")).lower() == "pywfs"
        window = 0 if pyramid else int(np.round(config.need("slopes", "sub_ap_spacing", float)))
        frame = LegacyFrame(way or "as_is", pyramid, window, default_pupils="pupils" not in config.slopes)
        return cls(*files, frame)

    def mask_or(self, shape: tuple[int, int]) -> NDArray[np.bool_]:
        """The mask; everything where no file says."""
        if self.mask is None:
            return np.ones(shape, bool)
        mask = np.asarray(self.mask.data, bool)
        return self.frame.map(mask) if self.mask.legacy else mask

    def references_or(self, shape: tuple[int, int]) -> NDArray[np.float32]:
        """The reference slopes; zeros where no file says."""
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
        if not file.legacy or self.frame.way != "xy":
            return data
        if self.mask is None or not self.mask.legacy:
            raise IncompatibleProduct(
                f"{file.path}: its rows can be put in order only with the mask it was measured with; name "
                "that in slopes.valid_sub_aps_file"
            )
        return np.asarray(self.frame.matrix(data, np.asarray(self.mask.data, bool)))


@dataclass(frozen=True, slots=True, eq=False)
class _Sensor:
    """Our geometry, which rows of pyRTC's signal its slopes are, and with which signs."""

    grid: SensorGeometry
    rows: NDArray[np.intp]
    signs: NDArray[np.int8]
    notes: tuple[str, ...] = ()


def import_matrix(
    config: PyrtcConfig, target: Target, im: Path | None = None, way: str | None = None
) -> CalibrationResult:
    """Read the calibration that a configuration of pyRTC's names.

    Parameters
    ----------
    config
        The configuration.
    target
        The system it is read for.
    im
        Another interaction matrix than ``loop.im_file``.
    way
        How files of pyRTC 1.x were made, see :mod:`~escape_hw.io.interchange.pyrtc_legacy`.

    Raises
    ------
    ProductError
        A file is missing or damaged.
    IncompatibleProduct
        The parts do not fit each other or the system, or files are old and nobody said how they were made.
    """
    files = _Files.read(config, im, way)
    file, record = files.matrix, files.matrix.record or {}
    sensor = (_pyramid if files.frame.pyramid else _lenslets)(config, target, files)
    data = files.rows(len(sensor.rows))[sensor.rows] * sensor.signs[:, None]
    sigma = file.more.get("sigma", np.zeros(file.data.shape))
    if sigma.shape != file.data.shape:
        raise ProductError(f"{file.path}: standard errors of shape {sigma.shape} for {file.data.shape}")
    matrix = InteractionMatrix(
        data.astype(np.float32), sigma[sensor.rows].astype(np.float32), _modes(config, target, data.shape[1]),
        sensor.grid.valid, target.system, str(record.get("method", "pyrtc")),
        target.simulated or bool(record.get("simulated", False)),
        {"pyrtc_version": str(record.get("pyrtc_version", "1.x" if file.legacy else "2.x"))},
        sensor.grid.slope_unit,
    )  # fmt: skip
    notes = [f"read from pyRTC's {file.path.name}", *sensor.notes]
    if "sigma" not in file.more:
        notes.append("it tells no standard errors; errors of a registration found from it rest on equal ones")
    return CalibrationResult(matrix, sensor.grid, int(record.get("frames") or 0), 0, 0.0, notes=tuple(notes))


def _lenslets(config: PyrtcConfig, target: Target, files: _Files) -> _Sensor:
    _require_kind(config, target, "shack-hartmann")
    windows = PyrtcLenslets(
        config.need("slopes", "sub_ap_spacing", float),
        config.need("slopes", "sub_ap_offset_x", int),
        config.need("slopes", "sub_ap_offset_y", int),
        config.shape,
    )
    shape = (2 * windows.n, windows.n)
    grid, rows, note = windows.grid(files.mask_or(shape), files.references_or(shape), target.n_sub)
    return _Sensor(grid, rows, np.ones(len(rows), np.int8), () if note is None else (note,))


def _pyramid(config: PyrtcConfig, target: Target, files: _Files) -> _Sensor:
    _require_kind(config, target, "pyramid")
    rows, columns = config.shape
    left, right, top, bottom = columns // 4, int(0.75 * columns), rows // 4, int(0.75 * rows)
    centres = [(left, top), (left, bottom), (right, top), (right, bottom)]
    radius = min(rows - bottom, columns - right)
    if "pupils" in config.slopes:
        centres = [_point(config, entry) for entry in config.slopes["pupils"]]
        if config.old and files.frame.way == "yx":
            centres = [(x, y) for y, x in centres]
        radius = config.need("slopes", "pupils_radius", int)
    images = PyrtcPupils(tuple(centres), radius, float(config.slopes.get("central_obscuration_ratio") or 0.0))
    return _Sensor(*images.pupils(files.references_or((images.n, 2 * images.n)), target.n_sub))


def _spelled(key: str) -> str:
    """A key of pyRTC 1.x as 2.x spells it: ``IMFile`` becomes ``im_file``."""
    return re.sub(r"(?<=[a-z0-9])(?=[A-Z])|(?<=[A-Z])(?=[A-Z][a-z])", "_", key).lower()


def _point(config: PyrtcConfig, entry: object) -> tuple[int, int]:
    parts = entry.split(",") if isinstance(entry, str) else entry
    try:
        x, y = (int(part) for part in parts)  # type: ignore[attr-defined]
    except (TypeError, ValueError) as error:
        raise ProductError(f"{config.path}: slopes.pupils: {entry!r} is not 'x,y'") from error
    return x, y


def _require_kind(config: PyrtcConfig, target: Target, kind: str) -> None:
    if target.kind != kind:
        raise IncompatibleProduct(
            f"{config.path}: its sensor is a {kind}; system '{target.system}' has "
            f"sensor.kind = '{target.kind}'"
        )


def _modes(config: PyrtcConfig, target: Target, n_modes: int) -> NDArray[np.float64]:
    """The mode-to-command matrix: a file's, or single actuators as pyRTC has it without one."""
    path = config.file(config.wfc, "m2c_file")
    if path is None and config.wfc.get("basis"):
        raise IncompatibleProduct(
            f"{config.path}: wfc.basis asks pyRTC to compute its modes; save them there "
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
