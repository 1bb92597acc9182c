"""Calibration files of pyRTC: format 2 written and read, the bare arrays of pyRTC 1.x read.

Format 2 (pyRTC 2.0 and later) is an ``.npz`` archive under any file name, with the array ``data`` and the
JSON record ``pyrtc_calibration``, whose keys ``format`` and ``kind`` say what it is. pyRTC 1.x wrote
``.npy`` files that say nothing.
"""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from escape_hw.errors import IncompatibleProduct, ProductError
from escape_hw.io.documents import plain
from escape_hw.io.provenance import software_version
from escape_hw.io.storage import write_atomic

FORMAT = 2
MATRIX, VALID, REFERENCES = "interaction_matrix", "valid_sub_aps", "ref_slopes"

_RECORD, _DATA = "pyrtc_calibration", "data"


@dataclass(frozen=True, slots=True, eq=False)
class PyrtcFile:
    """An array of pyRTC's and what its file says of it.

    Parameters
    ----------
    path
        Where it was read.
    data
        The array.
    record
        The record; ``None`` for a file of pyRTC 1.x, which has none.
    more
        Further arrays of the archive, which pyRTC does not read.
    """

    path: Path
    data: NDArray[Any]
    record: dict[str, Any] | None
    more: dict[str, NDArray[Any]] = field(default_factory=dict)

    @property
    def legacy(self) -> bool:
        """True for a file of pyRTC 1.x."""
        return self.record is None


def read_file(path: Path | str, kind: str | None = None) -> PyrtcFile:
    """Read a calibration file of either generation.

    Parameters
    ----------
    path
        The file; its ending does not matter.
    kind
        What it must be where it says so: :data:`MATRIX`, :data:`VALID` or :data:`REFERENCES`.

    Raises
    ------
    ProductError
        Not there, damaged, or from a newer pyRTC.
    IncompatibleProduct
        Sound, but of another kind.
    """
    path = Path(path)
    try:
        # From memory: numpy leaves the file of a damaged archive open.
        loaded = np.load(io.BytesIO(path.read_bytes()), allow_pickle=False)
        if isinstance(loaded, np.ndarray):
            return PyrtcFile(path, loaded, None)
        with loaded as archive:
            parts = {name: archive[name] for name in archive.files}
    except OSError as error:
        raise ProductError(f"{path}: cannot be read ({error.strerror or error})") from error
    except (ValueError, EOFError, zipfile.BadZipFile, KeyError) as error:
        raise ProductError(f"{path}: damaged, or not a calibration file of pyRTC ({error})") from error
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
    except (ValueError, TypeError, AttributeError) as error:
        raise ProductError(f"{path}: its record is damaged ({error})") from error
    if number > FORMAT:
        raise ProductError(
            f"{path}: format {number}, written by pyRTC {record.get('pyrtc_version', 'unknown')}; "
            f"this version reads up to {FORMAT}; update ESCAPE"
        )
    found = record.get("kind")
    if kind is not None and found not in (None, kind):
        raise IncompatibleProduct(f"{path}: holds {found!r}; {kind!r} is needed")
    more = {name: part for name, part in parts.items() if name not in (_DATA, _RECORD)}
    return PyrtcFile(path, parts[_DATA], record, more)


def write_file(
    path: Path,
    data: NDArray[Any],
    kind: str,
    record: Mapping[str, Any] | None = None,
    more: Mapping[str, NDArray[Any]] | None = None,
) -> Path:
    """Write a calibration file that pyRTC 2.x reads; whole or not at all.

    Parameters
    ----------
    path
        Exactly this name.
    data
        The array.
    kind
        :data:`MATRIX`, :data:`VALID` or :data:`REFERENCES`.
    record, more
        Further entries of the record and further arrays, which pyRTC does not read.

    Raises
    ------
    StorageError
        It cannot be written.
    """
    whole = {
        "format": FORMAT,
        "kind": kind,
        "image_axes": "yx",
        "written_by": f"ESCAPE {software_version()}",
        **(record or {}),
    }
    buffer = io.BytesIO()
    arrays = {_DATA: np.asarray(data), _RECORD: np.array(json.dumps(plain(whole))), **(more or {})}
    np.savez(buffer, **arrays)  # type: ignore[arg-type]  # numpy types its keywords as one flag
    write_atomic(path, buffer.getvalue())
    return path


def write_array(path: Path, data: NDArray[Any]) -> Path:
    """Write a bare ``.npy`` file, as pyRTC keeps mode-to-command matrices and gains.

    Raises
    ------
    StorageError
        It cannot be written.
    """
    buffer = io.BytesIO()
    np.save(buffer, np.asarray(data), allow_pickle=False)
    write_atomic(path, buffer.getvalue())
    return path
