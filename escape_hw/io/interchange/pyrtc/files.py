"""Calibration files of pyRTC.

Format 2 read and written, arrays of pyRTC 1.x read and converted to the conventions of 2.x.
"""

from __future__ import annotations

import io
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from escape_hw.array_files import load_arrays
from escape_hw.errors import ConfigError, IncompatibleProduct, ProductError
from escape_hw.io.documents import to_plain_values
from escape_hw.io.provenance import get_software_version
from escape_hw.io.storage import write_atomic

FORMAT = 2
MATRIX, VALID, REFERENCES = "interaction_matrix", "valid_sub_aps", "ref_slopes"

_RECORD, _DATA = "pyrtc_calibration", "data"


@dataclass(frozen=True, slots=True, eq=False)
class PyrtcFile:
    """An array of pyRTC with the metadata of its file.

    ``record`` is ``None`` for a file of pyRTC 1.x; pyRTC does not read ``extra_arrays`` of the archive.
    """

    path: Path
    data: NDArray[Any]
    record: dict[str, Any] | None
    extra_arrays: dict[str, NDArray[Any]] = field(default_factory=dict)

    @property
    def legacy(self) -> bool:
        """True for a file of pyRTC 1.x."""
        return self.record is None


def read_file(path: Path | str, kind: str | None = None) -> PyrtcFile:
    """Read a calibration file of either generation.

    Parameters
    ----------
    kind
        Expected kind, checked where the file gives one: :data:`MATRIX`, :data:`VALID` or :data:`REFERENCES`.

    Raises
    ------
    ProductError
        Not there, damaged, or from a newer pyRTC.
    IncompatibleProduct
        Sound, but of another kind.
    """
    path = Path(path)
    try:
        parts = load_arrays(path)
    except OSError as error:
        raise ProductError(f"{path}: cannot be read ({error.strerror or error})") from error
    except ValueError as error:
        raise ProductError(f"{path}: damaged, or not a calibration file of pyRTC ({error})") from error
    if isinstance(parts, np.ndarray):
        return PyrtcFile(path, parts, None)
    return _with_record(path, parts, kind)


def _with_record(path: Path, parts: dict[str, NDArray[Any]], kind: str | None) -> PyrtcFile:
    if _RECORD not in parts:
        if len(parts) != 1:
            raise ProductError(f"{path}: an archive of {len(parts)} arrays without a record of pyRTC's")
        return PyrtcFile(path, next(iter(parts.values())), None)
    if _DATA not in parts:
        raise ProductError(f"{path}: has a record of pyRTC's, but no array '{_DATA}'")
    try:
        record = json.loads(str(parts[_RECORD][()]))
        number = int(record.get("format", 0))
    except (ValueError, TypeError, AttributeError, RecursionError) as error:
        raise ProductError(f"{path}: its record is damaged ({error})") from error
    if number > FORMAT:
        raise ProductError(
            f"{path}: format {number}, written by pyRTC {record.get('pyrtc_version', 'unknown')}; "
            f"this version reads up to {FORMAT}; update ESCAPE"
        )
    found = record.get("kind")
    if kind is not None and found not in (None, kind):
        raise IncompatibleProduct(f"{path}: holds {found!r}; {kind!r} is needed")
    extra_arrays = {name: part for name, part in parts.items() if name not in (_DATA, _RECORD)}
    return PyrtcFile(path, parts[_DATA], record, extra_arrays)


def write_file(
    path: Path,
    data: NDArray[Any],
    kind: str,
    record: Mapping[str, Any] | None = None,
    extra_arrays: Mapping[str, NDArray[Any]] | None = None,
) -> Path:
    """Write a calibration file of a kind that pyRTC 2.x reads, atomically and under exactly this name.

    pyRTC reads neither ``record``, further entries of the record, nor ``extra_arrays``.

    Raises
    ------
    StorageError
        The file cannot be written.
    """
    full_record = {
        "format": FORMAT,
        "kind": kind,
        "image_axes": "yx",
        "written_by": f"ESCAPE {get_software_version()}",
        **(record or {}),
    }
    buffer = io.BytesIO()
    arrays = {
        _DATA: np.asarray(data),
        _RECORD: np.array(json.dumps(to_plain_values(full_record))),
        **(extra_arrays or {}),
    }
    np.savez(buffer, **arrays)  # type: ignore[arg-type]  # numpy types its keywords as one flag
    write_atomic(path, buffer.getvalue())
    return path


def write_array(path: Path, data: NDArray[Any]) -> Path:
    """Write a bare ``.npy`` file, as pyRTC keeps mode-to-command matrices and gains.

    Raises
    ------
    StorageError
        The file cannot be written.
    """
    buffer = io.BytesIO()
    np.save(buffer, np.asarray(data), allow_pickle=False)
    write_atomic(path, buffer.getvalue())
    return path


FRAME_ORDERS = ("yx", "xy", "as_is")


@dataclass(frozen=True, slots=True)
class LegacyConvention:
    """How files of pyRTC 1.x were made.

    Parameters
    ----------
    frame_order
        ``"yx"``, ``"xy"`` or ``"as_is"``.
    pyramid
        Whether the sensor is a pyramid.
    window
        Pixels across a lenslet's window; 0 for a pyramid.
    default_pupils
        The pupil images were at pyRTC's default places. Transposing exchanges two of them.

    Raises
    ------
    ConfigError
        The name is unknown.
    """

    frame_order: str
    pyramid: bool = False
    window: int = 0
    default_pupils: bool = False

    def __post_init__(self) -> None:
        if self.frame_order not in FRAME_ORDERS:
            raise ConfigError(f"--frame-order {self.frame_order}: it is one of {', '.join(FRAME_ORDERS)}")

    def map(self, slope_map: NDArray[Any]) -> NDArray[Any]:
        """A slope map or mask as 2.x has it: ``(2 N, N)``, x above y; a pyramid's ``(2 R, 4 R)``."""
        if self.frame_order != "xy":
            return slope_map
        if self.pyramid:
            x, y = np.hsplit(slope_map, 2)
            return np.hstack([y.T, x.T] if self.default_pupils else [x.T, y.T])
        # With rows and columns exchanged, what was called x is y.
        x, y = np.vsplit(slope_map, 2)
        return np.vstack([y.T, x.T])

    def references(self, references: NDArray[Any]) -> NDArray[np.float32]:
        """Reference slopes as 2.x has them: even windows were centred half a pixel off."""
        reordered = self.map(np.asarray(references, np.float32))
        off = self.frame_order != "as_is" and not self.pyramid and self.window % 2 == 0
        return reordered + np.float32(0.5) if off else reordered

    def matrix(self, matrix: NDArray[Any], old_valid: NDArray[np.bool_]) -> NDArray[Any]:
        """An interaction matrix of 1.x ``(n_slopes, n_modes)`` with its rows in the order of 2.x.

        ``old_valid`` is the mask it was made with, as 1.x had it.
        """
        numbers = np.full(old_valid.shape, -1)
        numbers[tuple(slope_positions(old_valid, self.pyramid))] = np.arange(int(old_valid.sum()))
        reordered = self.map(numbers)
        return np.asarray(matrix[reordered[tuple(slope_positions(reordered >= 0, self.pyramid))]])


def require_frame_order(file: PyrtcFile, frame_order: str | None) -> None:
    """Refuse a file of pyRTC 1.x without the orientation of its frames (:class:`IncompatibleProduct`)."""
    if frame_order is None:
        raise IncompatibleProduct(
            f"{file.path}: a file of pyRTC 1.x without the orientation of its frames; give it with "
            "--frame-order yx (frames as the camera gave them), xy (transposed by pyRTC's camera adapter) or "
            "as_is (already as 2.x has it)"
        )


def slope_positions(valid: NDArray[np.bool_], pyramid: bool) -> NDArray[np.intp]:
    """Positions of a signal's slopes in pyRTC's map, rows and columns ``(2, n_slopes)``.

    All x come first, each row by row: a Shack-Hartmann map has y below, a pyramid's beside.
    """
    if not pyramid:
        return np.array(np.nonzero(valid))
    half = valid.shape[1] // 2
    rows, columns = np.nonzero(valid[:, :half])
    return np.array([np.r_[rows, rows], np.r_[columns, columns + half]])
