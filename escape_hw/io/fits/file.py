"""FITS files with checksums.

Headers and extensions of a product, atomic writing, verified reading, and the class of a product that was
read.
"""

from __future__ import annotations

import hashlib
import io
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, Self, TypeVar

import numpy as np
from astropy.io import fits
from astropy.utils.exceptions import AstropyWarning
from numpy.typing import NDArray

from escape_hw.bounded_files import max_product_bytes, read_bounded
from escape_hw.errors import IncompatibleProduct, ProductError
from escape_hw.io.provenance import Provenance, format_utc, get_git_state, get_software_version
from escape_hw.io.storage import write_atomic

#: Version of the products' layout; a higher one is refused on reading.
SCHEMA = 1
_BLOCK = 2880


def expect(path: Path, what: str, found: object, wanted: object, remedy: str = "") -> None:
    """Raise IncompatibleProduct where something that is wanted (not ``None``) differs from what was found."""
    if wanted is not None and found != wanted:
        out = f" ({remedy})" if remedy else ""
        raise IncompatibleProduct(f"{path}: its {what} is {found!r}; {wanted!r} is needed{out}")


def header_text(text: str) -> str:
    """Text as a FITS header can hold it: printable ASCII, anything else as an escape."""
    escaped = text.encode("unicode_escape").decode("ascii")
    return "".join(c for c in escaped if c.isprintable())


#: Kind of what a panel of the window shows, not a calibration product.
KIND_SCREEN = "SCREEN"


def primary_hdu(
    kind: str, system: str, simulated: bool, partial: bool, origin: Provenance
) -> fits.PrimaryHDU:
    """An empty primary HDU; its header holds kind, schema and origin of the file."""
    header = fits.Header()
    cards: list[tuple[str, Any, str]] = [
        ("KIND", kind, "kind of product"),
        ("SCHEMA", SCHEMA, "version of the layout"),
        ("NHDU", 0, "number of HDUs in this file"),
        ("SYSTEM", header_text(system), "system it was made on"),
        ("SIMULATE", simulated, "T: a simulated device took part"),
        ("FINISH", "aborted" if partial else "complete", "complete, or aborted by the operator"),
        ("BASIS", header_text(origin.basis), "kind of modal basis"),
        ("ORIGIN", "ESCAPE", "software"),
        ("SOFTVER", header_text(get_software_version()), "version of the software"),
        ("GITSTATE", header_text(get_git_state()), "commit of the software"),
        ("TIMESYS", "UTC", "time system of all dates"),
        ("DATE", format_utc(), "when the file was written"),
    ]
    if origin.started is not None:
        cards.append(("DATE-OBS", format_utc(origin.started), "when the measurement began"))
    if origin.seed is not None:
        cards.append(("SEED", int(origin.seed), "seed of the random streams"))
    for number, (name, serial) in enumerate(sorted(origin.serials.items()), 1):
        cards.append((f"DEVICE{number}", header_text(name), "device"))
        cards.append((f"SERIAL{number}", header_text(serial), "its serial number"))
    for number, (name, digest) in enumerate(sorted(origin.parents.items()), 1):
        cards.append((f"PARENT{number}", header_text(name), "made from this file"))
        cards.append((f"PARSHA{number}", header_text(digest), ""))
    for card in cards:
        header.append(card)
    return fits.PrimaryHDU(header=header)


def image_extension(name: str, data: NDArray[Any], unit: str = "", **cards: Any) -> fits.ImageHDU:
    """An image extension; ``cards`` become header cards (finite numbers, text or booleans)."""
    if data.dtype == np.bool_:
        data = data.astype(np.uint8)
    hdu = fits.ImageHDU(np.ascontiguousarray(data), name=name)
    _set_cards(hdu, {"BUNIT": unit, **cards} if unit else cards)
    return hdu


def text_extension(name: str, content: str) -> fits.ImageHDU:
    """Text of any length and alphabet as bytes in UTF-8."""
    # The closing newline keeps an empty text from becoming an extension without data.
    return fits.ImageHDU(np.frombuffer(content.encode() + b"\n", np.uint8).copy(), name=name)


def table_extension(name: str, columns: dict[str, NDArray[Any]], **cards: Any) -> fits.BinTableHDU:
    """A binary table from equally long columns (numbers or ASCII text)."""
    columns_out = []
    for key, values in columns.items():
        if values.dtype.kind in "US":
            encoded = np.char.encode(values, "ascii") if values.dtype.kind == "U" else values
            columns_out.append(fits.Column(key, f"{max(encoded.dtype.itemsize, 1)}A", array=encoded))
        else:
            columns_out.append(fits.Column(key, "D", array=values.astype(np.float64)))
    hdu = fits.BinTableHDU.from_columns(columns_out, name=name)
    _set_cards(hdu, cards)
    return hdu


def _set_cards(hdu: Any, cards: Mapping[str, Any]) -> None:
    for key, value in cards.items():
        hdu.header[key] = header_text(value) if isinstance(value, str) else value


def write(path: Path, hdus: Sequence[Any]) -> str:
    """Write the HDUs atomically, each with CHECKSUM and DATASUM.

    Returns
    -------
    str
        SHA-256 of the file.

    Raises
    ------
    StorageError
        The file cannot be written; no partial file remains.
    """
    hdus[0].header["NHDU"] = len(hdus)
    buffer = io.BytesIO()
    fits.HDUList(list(hdus)).writeto(buffer, checksum=True, output_verify="exception")
    content = buffer.getvalue()
    write_atomic(path, content)
    return hashlib.sha256(content).hexdigest()


def partial_path(path: Path) -> Path:
    """The name under which an aborted run saves what it measured: ``im.partial.fits``."""
    return path if path.name.endswith(".partial.fits") else path.with_suffix(".partial.fits")


def write_product(
    path: Path,
    kind: str,
    hdus: Sequence[Any],
    system: str,
    simulated: bool,
    origin: Provenance | None = None,
    *,
    partial: bool = False,
    cards: Mapping[str, tuple[Any, str]] | None = None,
) -> Path:
    """Write a product: primary header, extensions, and the configuration of its origin.

    Parameters
    ----------
    path
        File name; a partial product is written as ``*.partial.fits``.
    hdus
        Extensions that hold the result.
    cards
        Further cards of the primary header, each with its comment.

    Returns
    -------
    Path
        The file written.

    Raises
    ------
    StorageError
        The file cannot be written; no partial file remains.
    """
    origin = origin or Provenance()
    path = partial_path(path) if partial else path
    primary = primary_hdu(kind, system, simulated, partial, origin)
    for key, (value, comment) in (cards or {}).items():
        primary.header[key] = (header_text(value) if isinstance(value, str) else value, comment)
    write(path, [primary, *hdus, text_extension("CONFIG", origin.config_text)])
    return path


def read(path: Path, kind: str | None = None) -> tuple[fits.HDUList, str]:
    """Read a product and check it from end to end.

    Parameters
    ----------
    kind
        The kind of product needed, ``None`` for any.

    Returns
    -------
    hdus : HDUList
        In memory, every extension loaded.
    sha256 : str

    Raises
    ------
    ProductError
        Not there, not FITS, truncated, damaged, of another kind or from a newer version; the
        message names the file and the check.
    """
    try:
        content = read_bounded(path, max_product_bytes())
    except OSError as error:
        raise ProductError(f"{path}: cannot be read ({error.strerror or error})") from error
    _check_bytes(path, content)
    # Astropy reports much of what matters as warnings; here each of them is a reason to stop.
    with warnings.catch_warnings():
        warnings.simplefilter("error", AstropyWarning)
        warnings.simplefilter("error", UserWarning)
        try:
            hdus = fits.open(io.BytesIO(content), memmap=False, lazy_load_hdus=False, checksum=True)
            for hdu in hdus:
                hdu.verify("exception")
                _ = hdu.data
        except Exception as error:
            raise ProductError(f"{path}: damaged; FITS structure: {_first_line(error)}") from error
    _check_hdus(path, hdus, kind)
    return hdus, hashlib.sha256(content).hexdigest()


def _check_bytes(path: Path, content: bytes) -> None:
    if not content.startswith(b"SIMPLE  ="):
        raise ProductError(f"{path}: not a FITS file (it does not begin with SIMPLE)")
    if len(content) % _BLOCK:
        raise ProductError(
            f"{path}: truncated; its {len(content)} bytes are not a whole number of {_BLOCK}-byte blocks"
        )
    if b"CHECKSUM=" not in content[: 20 * _BLOCK]:
        raise ProductError(f"{path}: carries no checksum; it is damaged or not an ESCAPE product")
    # CHECKSUM makes the ones' complement sum of each HDU and of the file zero. It is tested on
    # the raw bytes, before any parser sees a flipped bit.
    if int(np.frombuffer(content, ">u4").sum(dtype=np.uint64)) % 0xFFFFFFFF:
        raise ProductError(f"{path}: damaged; checksum of the file is wrong (truncated or changed)")


def _check_hdus(path: Path, hdus: fits.HDUList, kind: str | None) -> None:
    for number, hdu in enumerate(hdus):
        if "CHECKSUM" not in hdu.header or "DATASUM" not in hdu.header:
            raise ProductError(f"{path}: damaged; HDU {number} ({hdu.name}) carries no checksum")
    header = hdus[0].header
    if "KIND" not in header or "SCHEMA" not in header or "NHDU" not in header:
        raise ProductError(f"{path}: a FITS file, but not an ESCAPE product (no KIND, SCHEMA or NHDU)")
    for key, kind_of_value in (("KIND", str), ("SCHEMA", int), ("NHDU", int)):
        if type(header[key]) is not kind_of_value:
            raise ProductError(f"{path}: its card {key} is {header[key]!r}; it is no ESCAPE product")
    if header["SCHEMA"] > SCHEMA:
        raise ProductError(
            f"{path}: written by a newer version (schema {header['SCHEMA']}, this one reads up to {SCHEMA}); "
            "update ESCAPE"
        )
    if header["NHDU"] != len(hdus):
        raise ProductError(f"{path}: truncated; {len(hdus)} of {header['NHDU']} HDUs are there")
    if kind is not None and header["KIND"] != kind:
        raise ProductError(f"{path}: its kind is {header['KIND']!r}; a product of kind {kind!r} is needed")


def _first_line(error: BaseException) -> str:
    return (str(error).strip() or type(error).__name__).splitlines()[0]


def require_extension(path: Path, hdus: fits.HDUList, name: str) -> Any:
    """The extension of that name, or :class:`ProductError` when it is missing."""
    if name not in hdus:
        raise ProductError(f"{path}: extension {name} is missing")
    return hdus[name]


def read_array(path: Path, hdus: fits.HDUList, name: str, dtype: Any) -> NDArray[Any]:
    """An extension's image in the machine's own byte order, C-contiguous."""
    data = require_extension(path, hdus, name).data
    if not isinstance(data, np.ndarray):
        raise ProductError(f"{path}: extension {name} holds no image")
    return np.ascontiguousarray(data).astype(np.dtype(dtype).newbyteorder("="))


def require_values(path: Path, name: str, values: NDArray[Any], low: float, high: float) -> None:
    """Raise :class:`ProductError` unless every value is finite and within ``low`` .. ``high``."""
    if values.size and not (float(values.min()) >= low and float(values.max()) <= high):
        raise ProductError(f"{path}: {name} holds values that are not finite, or not in {low:g} .. {high:g}")


def read_text(path: Path, hdus: fits.HDUList, name: str) -> str:
    """Text written by :func:`text_extension`."""
    return read_array(path, hdus, name, np.uint8).tobytes().decode().removesuffix("\n")


def header_dict(hdus: fits.HDUList) -> dict[str, Any]:
    """The primary header's own cards as plain values."""
    skip = {"SIMPLE", "BITPIX", "NAXIS", "EXTEND", "CHECKSUM", "DATASUM", "COMMENT", "HISTORY", ""}
    return {key: value for key, value in hdus[0].header.items() if key not in skip}


R = TypeVar("R")


@dataclass(frozen=True, slots=True, eq=False)
class Product(Generic[R]):
    """A result read from disk.

    ``config_text`` is the whole configuration it was measured with (TOML), ``header`` the primary
    header's cards, ``sha256`` the checksum that a product made from this one names as its parent.
    """

    path: Path
    result: R
    config_text: str
    header: dict[str, Any]
    sha256: str

    def __repr__(self) -> str:
        return f"<{type(self).__name__} {self.path}: {self.result!r}>"

    @classmethod
    def read(
        cls,
        path: Path | str,
        kind: str,
        unpack: Callable[[Path, fits.HDUList, dict[str, Any]], R],
    ) -> Self:
        """Read a product of a kind; ``unpack`` makes the result from path, HDUs and header.

        Raises
        ------
        ProductError
            Not there, truncated, damaged, of another kind, incomplete or from a newer version.
        """
        path = Path(path)
        hdus, sha256 = read(path, kind)
        header = header_dict(hdus)
        try:
            result, config = unpack(path, hdus, header), read_text(path, hdus, "CONFIG")
        except ProductError:
            raise
        except Exception as error:
            # Whatever a crafted file makes of the parts, it is the file that is wrong.
            raise ProductError(f"{path}: its parts do not fit together ({error})") from error
        return cls(path, result, config, header, sha256)
