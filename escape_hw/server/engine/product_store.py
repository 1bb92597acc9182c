"""Store of the products that requests may name."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from pathlib import Path

from escape_hw.errors import ConfigError, ProductError
from escape_hw.io.fits import file as fits_file
from escape_hw.io.fits.gains import KIND_GAINS, load_gains
from escape_hw.io.fits.loop import KIND_PSF, load_loop
from escape_hw.io.fits.matrix import KIND_MATRIX, load_matrix
from escape_hw.remote.state import ProductEntry


class ProductStore:
    """Products by name. Only the paths are stored, not the contents.

    Parameters
    ----------
    folders
        Folders that clients may load files from.
    products
        Products at the start; those whose file is missing are left out.
    """

    def __init__(self, folders: Iterable[Path], products: Iterable[ProductEntry] = ()) -> None:
        self._folders = tuple(folder.resolve() for folder in folders)
        self._products = {one.name: one for one in products if Path(one.path).is_file()}

    @property
    def products(self) -> tuple[ProductEntry, ...]:
        """The products, the newest last."""
        return tuple(self._products.values())

    def matrix_path(self, name: str) -> Path:
        """Path of a matrix (ConfigError: there is no matrix of that name)."""
        product = self._products.get(name)
        if product is None or product.kind != "matrix":
            known = ", ".join(one.name for one in self.products if one.kind == "matrix") or "none"
            raise ConfigError(f"there is no matrix '{name}' (available: {known}); load it, or calibrate")
        return Path(product.path)

    def readable_path(self, path: str) -> Path:
        """Resolve a path from a client (ProductError: outside the folders that clients may load from)."""
        resolved = Path(path).expanduser().resolve()
        if not any(resolved.is_relative_to(folder) for folder in self._folders):
            where = ", ".join(map(str, self._folders))
            raise ProductError(
                f"{resolved}: this server reads from {where} only; copy the file there, or start the server "
                "with --read FOLDER"
            )
        return resolved

    def load(self, path: str, name: str | None = None) -> ProductEntry:
        """Add a file that a client named (ProductError: the path is not allowed, or as for :meth:`add`)."""
        return self.add(self.readable_path(path), name)

    def add(self, path: Path, name: str | None = None) -> ProductEntry:
        """Add a file under a name, by default its own; a number is appended if another file has that name.

        ProductError: the file cannot be read, is damaged, or of another kind.
        """
        hdus, _ = fits_file.read(path)
        kind = str(fits_file.header_dict(hdus).get("KIND", ""))
        describe = _KINDS.get(kind)
        if describe is None:
            raise ProductError(f"{path}: a product of kind '{kind}'; a server loads {', '.join(_KINDS)}")
        word, summary = describe(path)
        valid_name = re.sub(r"[^\w .+@:-]", "-", path.stem if name is None else name)[:80]
        valid_name = self._free_name(valid_name, path)
        product = ProductEntry(name=valid_name, kind=word, path=str(path), summary=summary)
        self._products.pop(valid_name, None)
        self._products[valid_name] = product
        return product

    def _free_name(self, name: str, path: Path) -> str:
        """The name, or with the first number that makes it differ from those of other files."""
        names = (name, *(f"{name}-{number}" for number in range(2, len(self._products) + 3)))
        return next(
            one for one in names if one not in self._products or self._products[one].path == str(path)
        )


def _matrix(path: Path) -> tuple[str, str]:
    result = load_matrix(path).result
    return "matrix", f"{result.matrix.method}, {result.frames} frames, {result.matrix.n_modes} modes"


def _gains(path: Path) -> tuple[str, str]:
    result = load_gains(path).result
    return "gains", f"gains relative to {result.method}, {len(result.rounds)} rounds"


def _psf(path: Path) -> tuple[str, str]:
    result = load_loop(path).result
    return "psf", f"loop with {result.method}, {result.frames} frames"


_KINDS: dict[str, Callable[[Path], tuple[str, str]]] = {
    KIND_MATRIX: _matrix, KIND_GAINS: _gains, KIND_PSF: _psf,
}  # fmt: skip
