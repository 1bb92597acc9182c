"""Products that a server or a recording names, read from disk beside the window's own thread."""

from __future__ import annotations

import logging
import threading
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

#: Order of methods in every list: measured with a source, measured without, computed.
_METHOD_ORDER = (
    "push-pull",
    "push-pull-fast",
    "modulated",
    "docrime",
    "docrime-whitened",
    "docrime-closed",
    "escape",
)


@dataclass(frozen=True, slots=True)
class LoadedProducts:
    """What was read so far; each time something is added it is a new one with a higher number.

    Parameters
    ----------
    number
        Counts up with every change.
    matrices, gains
        By label, baselines before what was measured without a source, and that before what was computed.
    troubles
        What could not be read, and why.
    """

    number: int = 0
    matrices: dict[str, InteractionMatrix] = field(default_factory=dict)
    gains: dict[str, GainCurve] = field(default_factory=dict)
    errors: dict[str, str] = field(default_factory=dict)


class ProductLibrary:
    """Reads products once, in a thread of its own, and shows what it has as a :class:`LoadedProducts`.

    ``close`` ends the thread.
    """

    def __init__(self) -> None:
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="escape-library")
        self._futures: dict[tuple[str, str, int], Future[RunContent]] = {}
        self._collected_keys: tuple[object, ...] = ()
        self._loaded = LoadedProducts()
        self._lock = threading.Lock()

    def request(self, products: Iterable[ProductEntry]) -> None:
        """Read these, and forget others; returns at once."""
        known = {_key(one): one for one in products if one.kind in ("matrix", "gains")}
        with self._lock:
            for key in [key for key in self._futures if key not in known]:
                del self._futures[key]
            for key, one in known.items():
                if key not in self._futures:
                    self._futures[key] = self._pool.submit(_read, Path(one.path))

    @property
    def is_reading(self) -> bool:
        """Whether something is still being read."""
        with self._lock:
            return any(not one.done() for one in self._futures.values())

    @property
    def loaded(self) -> LoadedProducts:
        """Everything that has been read by now."""
        with self._lock:
            ready = {key: one for key, one in self._futures.items() if one.done()}
            if tuple(ready) != self._collected_keys:
                self._collected_keys = tuple(ready)
                self._loaded = _collect(self._loaded.number + 1, ready)
            return self._loaded

    def close(self) -> None:
        """End the thread."""
        self._pool.shutdown(wait=True, cancel_futures=True)


def _key(product: ProductEntry) -> tuple[str, str, int]:
    """A product by name, place and age: a file written again is another one."""
    try:
        age = Path(product.path).stat().st_mtime_ns
    except OSError:
        age = 0
    return product.name, product.path, age


def _read(path: Path) -> RunContent:
    # Reading FITS takes half a second to load; a window is there before.
    from escape_hw.report.content import read_product

    return read_product(path)


def _collect(number: int, ready: dict[tuple[str, str, int], Future[RunContent]]) -> LoadedProducts:
    matrices: dict[str, InteractionMatrix] = {}
    gains: dict[str, GainCurve] = {}
    errors: dict[str, str] = {}
    for (name, path, _), future in ready.items():
        error = future.exception()
        if isinstance(error, EscapeError):
            errors[name] = str(error)
            continue
        if error is not None:
            log.error("%s cannot be shown", path, exc_info=error)
            errors[name] = f"{path}: {error}"
            continue
        run = future.result()
        for label, matrix in run.matrices().items():
            _add_unique(matrices, label, name, matrix)
        for label, result in run.gains.items():
            if result.gains is None:
                continue
            gains[label] = GainCurve.of(label, result.gains, [one.gains.best for one in result.rounds])
            gains |= {other: GainCurve.of(other, one) for other, one in result.comparisons.items()}
    ordered = dict(sorted(matrices.items(), key=lambda item: _method_rank(item[1])))
    return LoadedProducts(number, ordered, gains, errors)


def _add_unique(
    matrices: dict[str, InteractionMatrix], label: str, name: str, matrix: InteractionMatrix
) -> None:
    """Under its label, or under label and product when another matrix has that label already."""
    taken = matrices.get(label)
    if taken is not None and _is_same_matrix(taken, matrix):
        return
    matrices[label if taken is None else f"{label} ({name})"] = matrix


def _is_same_matrix(one: InteractionMatrix, other: InteractionMatrix) -> bool:
    """Whether it is one matrix twice: as its own product, and inside of what was computed from it."""
    return one.data.shape == other.data.shape and bool((one.data == other.data).all())


def _method_rank(matrix: InteractionMatrix) -> int:
    return _METHOD_ORDER.index(matrix.method) if matrix.method in _METHOD_ORDER else len(_METHOD_ORDER)
