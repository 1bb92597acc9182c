"""Streams of pyRTC 2.x, through the package that makes them (``pyshmem``, MIT licence)."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from escape_hw.errors import ProductError
from escape_hw.io.interchange.optional_packages import import_optional
from escape_hw.io.interchange.stream import Publication, StreamReadError

#: Seconds within which a snapshot of a stream that is written all the time must succeed.
_SNAPSHOT_S = 1.0


class ShmemStream:
    """An open stream of pyRTC's; see :class:`~escape_hw.io.interchange.stream.Stream`.

    Made by :meth:`open` or :meth:`create`.
    """

    def __init__(self, handle: Any) -> None:
        self._handle = handle
        self.name = str(handle.name)
        self.shape = tuple(int(n) for n in handle.shape)
        self.dtype: DTypeLike = np.dtype(handle.dtype)

    @classmethod
    def open(cls, name: str, *, write: bool = False) -> ShmemStream:
        """Attach to a stream that exists.

        Raises
        ------
        ConfigError
            ``pyshmem`` is not installed.
        ProductError
            The stream does not exist or cannot be read by this version.
        """
        pyshmem = import_optional("pyshmem", "Reading pyRTC's streams")
        try:
            # Of a stream on a graphics card the copy in main memory is read.
            return cls(pyshmem.open(name, gpu_device=False, readonly=not write))
        except FileNotFoundError as error:
            known = ", ".join(pyshmem.list_streams()) or "none"
            raise ProductError(
                f"stream '{name}': not there (pyRTC's streams of this user: {known}); start pyRTC first"
            ) from error
        except (RuntimeError, ValueError, OSError) as error:
            raise ProductError(f"stream '{name}': cannot be opened ({error})") from error

    @classmethod
    def create(cls, name: str, shape: tuple[int, ...], dtype: DTypeLike) -> ShmemStream:
        """Make a stream, in place of one of that name and another shape.

        Raises
        ------
        ConfigError
            ``pyshmem`` is not installed.
        """
        pyshmem = import_optional("pyshmem", "Writing pyRTC's streams")
        try:
            return cls(pyshmem.create(name, shape=shape, dtype=dtype, notify=True))
        except FileExistsError:
            found = cls.open(name, write=True)
            if found.shape == shape and found.dtype == np.dtype(dtype):
                return found
            found.close()
            pyshmem.unlink_quiet(name)
            return cls(pyshmem.create(name, shape=shape, dtype=dtype, notify=True))

    @property
    def count(self) -> int:
        """Number of the newest write."""
        return int(self._handle.count)

    def latest(self) -> Publication:
        """See :meth:`~escape_hw.io.interchange.stream.Stream.latest`."""
        try:
            return _to_publication(self._handle.read_publication(timeout=_SNAPSHOT_S))
        except (TimeoutError, RuntimeError) as error:
            raise StreamReadError(f"stream '{self.name}': {error}") from error

    def read_after(self, count: int, timeout_s: float) -> Publication | None:
        """See :meth:`~escape_hw.io.interchange.stream.Stream.read_after`."""
        if self.count <= count and timeout_s <= 0:
            return None
        try:
            return _to_publication(
                self._handle.read_after_publication(count, timeout=max(timeout_s, _SNAPSHOT_S * 1e-3))
            )
        except TimeoutError:
            return None
        except RuntimeError as error:
            raise StreamReadError(f"stream '{self.name}': {error}") from error

    def write(self, data: NDArray[Any]) -> None:
        """See :meth:`~escape_hw.io.interchange.stream.Stream.write`."""
        self._handle.write(data)

    def close(self) -> None:
        """See :meth:`~escape_hw.io.interchange.stream.Stream.close`."""
        self._handle.close()

    def unlink(self) -> None:
        """Remove the stream for all processes."""
        import_optional("pyshmem", "Removing pyRTC's streams").unlink_quiet(self.name)


def _to_publication(found: Any) -> Publication:
    return Publication(found.payload, int(found.count), int(found.write_time * 1e9))
