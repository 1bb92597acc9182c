"""NumPy files of others, whose claims about their size are checked before memory is taken."""

from __future__ import annotations

import io
import math
import zipfile
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.lib import format as npy_format
from numpy.typing import NDArray

from escape_hw.bounded_files import MAX_ARRAY_BYTES, read_bounded


def load_arrays(path: Path) -> NDArray[Any] | dict[str, NDArray[Any]]:
    """The array of an ``.npy`` file, or the arrays of an ``.npz`` archive by name.

    Raises
    ------
    OSError
        The file cannot be read or is too large.
    ValueError
        It is no such file, an array claims more bytes than there are, or the arrays of an archive together
        need more than :data:`~escape_hw.bounded_files.MAX_ARRAY_BYTES`.
    """
    return decode_arrays(read_bounded(path, MAX_ARRAY_BYTES))


def decode_arrays(content: bytes) -> NDArray[Any] | dict[str, NDArray[Any]]:
    """As :func:`load_arrays`, of the content of a file.

    Raises
    ------
    ValueError
        As there.
    """
    try:
        if content.startswith(b"PK"):
            return _load_archive(content)
        _require_complete(io.BytesIO(content), len(content))
        # From memory: numpy leaves the file of a damaged archive open.
        loaded = np.load(io.BytesIO(content), allow_pickle=False)
    except Exception as error:
        # NumPy, zipfile, zlib and tokenize raise errors of many kinds for damaged files.
        raise ValueError(f"{type(error).__name__}: {error}") from error
    return np.asarray(loaded)


def _load_archive(content: bytes) -> dict[str, NDArray[Any]]:
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        members = archive.infolist()
        total = sum(member.file_size for member in members)
        if total > MAX_ARRAY_BYTES:
            raise ValueError(f"its arrays would need {total / 1e6:.0f} MB")
        for member in members:
            with archive.open(member) as stream:
                _require_complete(stream, member.file_size)
    with np.load(io.BytesIO(content), allow_pickle=False) as loaded:
        return {name: loaded[name] for name in loaded.files}


def _require_complete(stream: IO[bytes], size: int) -> None:
    """Refuse an array whose header claims more bytes than its file has."""
    version = npy_format.read_magic(stream)
    read_header = npy_format.read_array_header_1_0 if version == (1, 0) else npy_format.read_array_header_2_0
    shape, _, dtype = read_header(stream)
    claimed = math.prod(shape) * dtype.itemsize
    if min(shape, default=0) < 0 or claimed > size:
        raise ValueError(f"its header claims {claimed} bytes of data; the file has {size}")
