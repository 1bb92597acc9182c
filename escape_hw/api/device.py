"""Base class of all devices: name, opening and closing."""

from __future__ import annotations

import abc
import inspect
import logging
import threading
import time
from collections.abc import Callable
from types import TracebackType
from typing import Self, TypeVar, final

from escape_hw.api.representation import describe_value
from escape_hw.errors import DeviceError, EscapeError, NotOpen, raised_at

log = logging.getLogger(__name__)
T = TypeVar("T")


class _DriverCalls:
    """Context in which hooks are called: any exception of its own becomes a defect of the driver."""

    def __init__(self, device: Device) -> None:
        self._device = device

    def __enter__(self) -> None:
        """Nothing to prepare: one context serves all calls."""

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if isinstance(error, Exception) and not isinstance(error, EscapeError | MemoryError):
            log.info("%s: exception of its driver", self._device.name, exc_info=error)
            text = f"failed with {type(error).__name__}: {error}{raised_at(error)}"
            raise self._device.driver_defect(text) from error


class Device(abc.ABC):
    """A device that is opened, used and closed; usable as a context manager.

    ``open`` and ``close`` are idempotent and thread-safe. Nothing happens on garbage collection, and no
    vendor library is loaded before ``open``. Drivers implement ``_open`` and ``_close``.
    """

    def __init_subclass__(cls, **options: object) -> None:
        """Refuse a class that replaces a final method, such as the opening, or the ``send`` of a mirror.

        Raises
        ------
        TypeError
            Names the method.
        """
        super().__init_subclass__(**options)
        for base in cls.__mro__[1:]:
            for name, member in vars(base).items():
                if getattr(member, "__final__", False) and inspect.getattr_static(cls, name) is not member:
                    raise TypeError(
                        f"{cls.__name__}.{name} replaces a final method of {base.__name__}; "
                        "implement the hooks of its interface instead"
                    )

    def __init__(self, name: str) -> None:
        self.name = name
        self._is_open = False
        #: Held while the connection changes, and during transfers that closing must not interrupt.
        self._lock = threading.RLock()
        #: Entered around every call of a hook that the driver implements.
        self._driver_calls = _DriverCalls(self)

    @property
    def is_open(self) -> bool:
        """True between a successful ``open`` and ``close``."""
        return self._is_open

    @final
    def open(self) -> Self:
        """Connect; does nothing when already open.

        Raises
        ------
        DeviceError
            The device cannot be reached, or its driver has a defect; everything opened so far is closed.
        """
        with self._lock:
            if self._is_open:
                return self
            self._before_open()
            try:
                with self._driver_calls:
                    self._open()
            except BaseException as cause:
                self._clean_up(self._release_after_failed_open, cause)
                raise
            self._is_open = True
            try:
                with self._driver_calls:
                    self._after_open()
            except BaseException as cause:
                self._is_open = False
                self._clean_up(self._close, cause)
                raise
        return self

    @final
    def close(self) -> None:
        """Make the device safe and disconnect; does nothing when already closed.

        The connection is closed even if the device cannot be made safe.

        Raises
        ------
        DeviceError
            The device could not be made safe (for example, a mirror could not be flattened) or did not
            disconnect. It counts as closed.
        """
        with self._lock:
            if not self._is_open:
                return
            try:
                with self._driver_calls:
                    self._before_close()
            except BaseException as cause:
                self._is_open = False
                self._clean_up(self._close, cause)
                raise
            self._is_open = False
            with self._driver_calls:
                self._close()

    def __enter__(self) -> Self:
        return self.open()

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        if error is None:
            self.close()
        else:
            self._clean_up(self.close, error)

    def require_open(self) -> None:
        """Raise :class:`NotOpen` unless the device is open."""
        if not self._is_open:
            raise NotOpen(self.name, "not open; call open() first, or use it in a 'with' statement")

    def driver_defect(self, what: str) -> DeviceError:
        """The error of a driver that breaks its interface; ``what`` says how, as in "returned None"."""
        driver = f"{type(self).__module__}.{type(self).__qualname__}"
        return DeviceError(self.name, f"{what}; this is a defect of its driver, {driver}")

    def _require_kind(self, value: object, kind: type[T], what: str) -> T:
        """Refuse what a driver returns if it is of another type; ``what`` names it in the message."""
        if not isinstance(value, kind):
            raise self.driver_defect(f"{what} is {describe_value(value)}, not a {kind.__name__}")
        return value

    @property
    def applies_twin_section(self) -> bool:
        """Whether the device is simulated as ``[twin]`` of its system says.

        The registration of such a mirror and such a sensor is ``[twin.registration]``; results are compared
        with it only then.
        """
        return False

    def now_ns(self) -> int:
        """Monotonic clock of the device in nanoseconds; the clock of a twin is simulated."""
        return time.monotonic_ns()

    def _clean_up(self, step: Callable[[], None], cause: BaseException) -> None:
        """Run a clean-up step after a failure; its own failure is added to the first one as a note."""
        try:
            step()
        except Exception as second:
            if type(second) is type(cause) and str(second) == str(cause):
                # A lost device fails in the same way at every step.
                log.debug("same failure during clean-up: %s", second)
                return
            log.warning("further failure during clean-up: %s: %s", type(second).__name__, second)
            cause.add_note(f"then, during clean-up: {type(second).__name__}: {second}")

    @abc.abstractmethod
    def _open(self) -> None:
        """Connect to the device."""

    @abc.abstractmethod
    def _close(self) -> None:
        """Disconnect; must not raise when the device is already disconnected."""

    def _release_after_failed_open(self) -> None:  # noqa: B027 - an optional hook
        """Release resources that a failed ``_open`` has acquired."""

    def _after_open(self) -> None:  # noqa: B027 - an optional hook
        """Hook for the base class of a kind of device, called after ``_open``."""

    def _before_open(self) -> None:  # noqa: B027 - an optional hook
        """Hook for the base class of a kind of device, called before ``_open``: loads what takes long."""

    def _before_close(self) -> None:  # noqa: B027 - an optional hook
        """Hook for the base class of a kind of device, called before ``_close``: flattens a mirror."""
