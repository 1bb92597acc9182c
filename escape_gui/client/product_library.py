"""Products listed by a server or a recorded run, read from disk in a worker thread."""

from __future__ import annotations

import logging
from collections.abc import Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from escape_gui.views.gain_curves import GainCurve
from escape_hw.api.interaction_matrix import InteractionMatrix
from escape_hw.errors import EscapeError
from escape_hw.remote.state import ProductEntry

if TYPE_CHECKING:
    from escape_hw.report.content import RunContent

log = logging.getLogger(__name__)

#: Order of methods in lists: measured with a calibration source, measured without one, computed.
_METHOD_ORDER = (
    "push-pull", "push-pull-fast", "modulated", "docrime", "docrime-whitened", "docrime-closed", "escape",
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class LoadedProducts:
    """Products read so far; replaced by a new object at every change."""

    #: By label; matrices in the order of ``_METHOD_ORDER``.
    matrices: dict[str, InteractionMatrix] = field(default_factory=dict)
    gains: dict[str, GainCurve] = field(default_factory=dict)


class ProductLibrary:
    """Reads each product once in a worker thread; all methods belong to the window's thread."""

    def __init__(self) -> None:
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="escape-library")
        self._futures: dict[tuple[str, str, int], Future[RunContent | None]] = {}
        self._collected_keys: tuple[object, ...] = ()
        self._loaded = LoadedProducts()

    def request(self, products: Iterable[ProductEntry]) -> None:
        """Start to read these matrices and gains, and drop others; returns at once."""
        known = {_key(one): one for one in products if one.kind in ("matrix", "gains")}
        for key in self._futures.keys() - known.keys():
            del self._futures[key]
        for key, one in known.items():
            if key not in self._futures:
                self._futures[key] = self._pool.submit(_read, Path(one.path))

    @property
    def loaded(self) -> LoadedProducts:
        """The products read so far; the same object until another one is ready."""
        ready = {key: one for key, one in self._futures.items() if one.done()}
        if tuple(ready) != self._collected_keys:
            self._collected_keys = tuple(ready)
            self._loaded = _collect(ready)
        return self._loaded

    def close(self) -> None:
        self._pool.shutdown(wait=True, cancel_futures=True)


def _key(product: ProductEntry) -> tuple[str, str, int]:
    """Name, path and modification time of a product: a file that is written again is read again."""
    try:
        age = Path(product.path).stat().st_mtime_ns
    except OSError:
        age = 0
    return product.name, product.path, age


def _read(path: Path) -> RunContent | None:
    """Content of a product; ``None`` when it cannot be read, which is logged."""
    # Imported here: it takes half a second, and the window appears before.
    from escape_hw.report.content import read_product

    try:
        return read_product(path)
    except Exception as error:
        log.error("cannot read %s: %s", path, error, exc_info=not isinstance(error, EscapeError))
        return None


def _collect(ready: dict[tuple[str, str, int], Future[RunContent | None]]) -> LoadedProducts:
    matrices: dict[str, InteractionMatrix] = {}
    gains: dict[str, GainCurve] = {}
    for (name, _, _), future in ready.items():
        run = future.result()
        if run is None:
            continue
        for label, matrix in run.matrices().items():
            _add_unique(matrices, label, name, matrix)
        for label, result in run.gains.items():
            if result.gains is None:
                continue
            gains[label] = GainCurve.of(label, result.gains, [one.gains.best for one in result.rounds])
            gains |= {other: GainCurve.of(other, one) for other, one in result.comparisons.items()}
    rank = {method: k for k, method in enumerate(_METHOD_ORDER)}
    ordered = dict(sorted(matrices.items(), key=lambda item: rank.get(item[1].method, len(rank))))
    return LoadedProducts(ordered, gains)


def _add_unique(
    matrices: dict[str, InteractionMatrix], label: str, name: str, matrix: InteractionMatrix
) -> None:
    """Add a matrix under its label, with the product's name appended if the label is in use.

    The same matrix may be read twice: as a product, and inside a product that was computed from it.
    """
    other = matrices.get(label)
    if other is not None and other.data.shape == matrix.data.shape and (other.data == matrix.data).all():
        return
    matrices[label if other is None else f"{label} ({name})"] = matrix
