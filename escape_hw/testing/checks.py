"""Type of a contract check, and helper functions for checks."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any, Protocol, TypeVar, cast

from escape_hw.api.device import Device
from escape_hw.errors import DeviceError

#: Creates a new device that is not open.
Factory = Callable[[], Any]
E = TypeVar("E", bound=DeviceError)

#: Opens, reads and closes; moves only what opening and closing move.
READS = 0
#: Moves by at most a percent of the range.
TINY = 1
#: Moves within the range of normal operation.
NORMAL = 2
#: Uses the full range within the limits.
FULL = 3


class Check(Protocol):
    """A contract check: called with a factory, it raises ``AssertionError`` on a violation.

    ``level`` is the largest change it makes: 0 nothing, 1 tiny, 2 normal, 3 full range. It raises
    ``unittest.SkipTest`` if it does not apply to the device.
    """

    __name__: str
    __doc__: str | None
    level: int

    def __call__(self, factory: Factory) -> None:
        """Run the check on devices from ``factory``."""


def check(level: int) -> Callable[[Callable[[Factory], None]], Check]:
    """Decorate a function as a check of the given level."""

    def decorate(function: Callable[[Factory], None]) -> Check:
        decorated = cast(Check, function)
        decorated.level = level
        return decorated

    return decorate


def checks_in(namespace: Mapping[str, object]) -> tuple[Check, ...]:
    """The checks defined in a module so far, in order; ``namespace`` is its ``globals()``."""
    return tuple(
        cast(Check, one)
        for name, one in namespace.items()
        if name.startswith("check_") and getattr(one, "__module__", "") == namespace["__name__"]
    )


def checks_up_to(checks: tuple[Check, ...], max_level: int) -> list[Check]:
    """The checks up to a level."""
    return [one for one in checks if one.level <= max_level]


def assert_refused(device: Device, error: type[E], why: str, call: Callable[..., object], *args: object) -> E:
    """Require that ``call(*args)`` raises ``error`` with the name of the device; returns the error.

    ``why`` describes the call for the message of a failure, for example "a command with NaN".
    """
    try:
        answer = call(*args)
    except error as refusal:
        assert device.name in str(refusal), f"{why}: the error does not name {device.name!r}: {refusal}"
        assert refusal.device == device.name, f"{why}: the error's device is {refusal.device!r}"
        return refusal
    except Exception as other:
        raise AssertionError(
            f"{why}: expected {error.__name__}, got {type(other).__name__}: {other}"
        ) from other
    raise AssertionError(f"{why}: expected {error.__name__}, but it was accepted and returned {answer!r}")


@contextmanager
def replace_hook(device: Device, hook: str, replacement: Callable[..., Any]) -> Iterator[None]:
    """Replace one hook of the driver, on this device only."""
    setattr(device, hook, replacement)
    try:
        yield
    finally:
        delattr(device, hook)


@contextmanager
def open_device(factory: Factory) -> Iterator[Any]:
    """Open a new device and close it afterwards; a failure of the check takes precedence."""
    device = factory()
    device.open()
    try:
        yield device
    except BaseException as failure:
        try:
            device.close()
        except DeviceError as second:
            failure.add_note(f"then the device did not close: {type(second).__name__}: {second}")
        raise
    device.close()
