"""Declaration of contract checks, and helper functions for checks."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import wraps
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


#: The checks by class of device, without those of its base classes.
CHECKS: dict[type, list[Check]] = {}


def factory_check(kind: type, level: int) -> Callable[[Callable[[Factory], None]], Check]:
    """Decorate a function of a factory as a check of devices of a class."""

    def decorate(function: Callable[[Factory], None]) -> Check:
        decorated = cast(Check, function)
        decorated.level = level
        CHECKS.setdefault(kind, []).append(decorated)
        return decorated

    return decorate


def check(kind: type, level: int) -> Callable[[Callable[[Any], None]], Check]:
    """Decorate a function of an open device as a check of devices of a class."""

    def decorate(function: Callable[[Any], None]) -> Check:
        @wraps(function)
        def open_and_check(factory: Factory) -> None:
            with open_device(factory) as device:
                function(device)

        return factory_check(kind, level)(open_and_check)

    return decorate


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


def assert_identified(info: Any, kind: type[Any]) -> None:
    """Require the identity of a device that products need: class of ``info``, model, ``simulated``."""
    assert isinstance(info, kind), f"info is {type(info).__name__}, not {kind.__name__}"
    assert info.model.strip(), "info.model is empty; products need it"
    assert type(info.simulated) is bool, f"info.simulated is {info.simulated!r}, neither true nor false"


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
