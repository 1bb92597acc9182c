"""Arrays in files of others: text, NumPy or FITS.

Claims of a file about its size are checked before memory is taken.
"""

from __future__ import annotations

import gzip
import io
import math
import zipfile
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.lib import format as npy_format
from numpy.typing import NDArray

from escape_hw.bounded_files import MAX_ARRAY_BYTES, read_bounded, reason_of
from escape_hw.errors import ProductError


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


def read_array(path: Path, name: str = "") -> NDArray[Any]:
    """An array of a text, NumPy or FITS file, which may be compressed by gzip.

    Parameters
    ----------
    name
        Of the array in an archive, or of the FITS extension; empty: the first.

    Raises
    ------
    ProductError
        Not there, damaged, or without such an array.
    """
    try:
        return decode_array(_read_content(path), name)
    except Exception as error:
        # NumPy, astropy and zlib raise errors of many kinds for damaged files.
        raise ProductError(f"{path}: cannot be read ({reason_of(error)})") from error


def array_names(path: Path) -> list[str]:
    """Names of the arrays in an ``.npz`` archive or of the images in a FITS file; empty for other files.

    Raises
    ------
    OSError, ValueError
        As :func:`load_arrays`.
    """
    content = _read_content(path)
    if content.startswith(b"SIMPLE"):
        from astropy.io import fits

        with fits.open(io.BytesIO(content), memmap=False) as hdus:
            return [hdu.name for hdu in hdus if hdu.is_image and hdu.data is not None]
    return list(decode_arrays(content)) if content.startswith(b"PK") else []


def decode_array(content: bytes, name: str = "", n_axes: int | None = None) -> NDArray[Any]:
    """As :func:`read_array`, of the content of a file; of a FITS file the first image with ``n_axes``.

    Raises
    ------
    ValueError
        Damaged, or without such an array. NumPy and astropy raise errors of many more kinds.
    """
    if content.startswith(b"SIMPLE"):
        from astropy.io import fits

        with fits.open(io.BytesIO(content), memmap=False) as hdus:
            images = [hdu for hdu in hdus if hdu.is_image and hdu.data is not None]
            named = [hdu for hdu in images if not name or hdu.name == name.upper()]
            chosen = [hdu for hdu in named if n_axes in (None, hdu.data.ndim)]
            if not chosen:
                axes = "" if n_axes is None else f" with {n_axes} axes"
                raise ValueError(f"has no image {name!r}{axes}, only {[hdu.name for hdu in images]}")
            return np.array(chosen[0].data)
    if not content.startswith((b"PK", b"\x93NUMPY")):
        return np.atleast_2d(np.loadtxt(io.StringIO(content.decode("utf-8").replace(",", " "))))
    loaded = decode_arrays(content)
    if isinstance(loaded, np.ndarray):
        return loaded
    if name and name not in loaded:
        raise ValueError(f"has no array {name!r}, only {', '.join(loaded)}")
    return loaded[name] if name else next(iter(loaded.values()))


def _read_content(path: Path) -> bytes:
    """The content of a file, without compression by gzip."""
    content = read_bounded(path, MAX_ARRAY_BYTES)
    return _unpack(content) if content.startswith(b"\x1f\x8b") else content


def _unpack(content: bytes) -> bytes:
    with gzip.open(io.BytesIO(content)) as packed:
        unpacked = packed.read(MAX_ARRAY_BYTES + 1)
    if len(unpacked) > MAX_ARRAY_BYTES:
        raise ValueError(f"larger than {MAX_ARRAY_BYTES / 1e6:.0f} MB when unpacked")
    return unpacked


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
