"""What every product read from disk carries."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, Self, TypeVar

from escape_hw.errors import ProductError
from escape_hw.io import fits_file

if TYPE_CHECKING:
    from astropy.io import fits as astropy_fits

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
        unpack: Callable[[Path, astropy_fits.HDUList, dict[str, Any]], R],
    ) -> Self:
        """Read a product of a kind.

        Parameters
        ----------
        path
            The file.
        kind
            What it must be.
        unpack
            Makes the result of path, parts and header.

        Raises
        ------
        ProductError
            Not there, truncated, damaged, of another kind, incomplete or from a newer version.
        """
        path = Path(path)
        hdus, sha256 = fits_file.read(path, kind)
        header = fits_file.header_dict(hdus)
        try:
            result = unpack(path, hdus, header)
        except (KeyError, ValueError, TypeError, IndexError) as error:
            raise ProductError(f"{path}: its parts do not fit together ({error})") from error
        return cls(path, result, fits_file.read_text(path, hdus, "CONFIG"), header, sha256)
