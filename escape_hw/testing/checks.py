"""What a contract check is, and the few tools that checks are written with."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, Protocol, TypeVar, cast

from escape_hw.api.device import Device
from escape_hw.errors import DeviceError

#: Makes a fresh device that is not open.
Factory = Callable[[], Any]
E = TypeVar("E", bound=DeviceError)

#: Opens, reads and closes; what every device does on opening and closing still happens.
READS = 0
#: Moves by a percent of the range at most.
TINY = 1
#: Moves within what normal operation uses.
NORMAL = 2
#: Uses the full range that the limits allow.
FULL = 3


class Check(Protocol):
    """A contract check: takes a factory, raises ``AssertionError`` when the contract is broken.

    ``level`` says how much it moves or changes: 0 nothing, 1 tiny, 2 normal, 3 full range. It
    raises ``unittest.SkipTest`` when the device has nothing to check.
    """

    __name__: str
    __doc__: str | None
    level: int

    def __call__(self, factory: Factory) -> None:
        """Run the check on devices made by ``factory``."""


def check(level: int) -> Callable[[Callable[[Factory], None]], Check]:
    """Make a function a check of the given level."""

    def decorate(function: Callable[[Factory], None]) -> Check:
        decorated = cast(Check, function)
        decorated.level = level
        return decorated

    return decorate


def checks_up_to(checks: tuple[Check, ...], max_level: int) -> list[Check]:
    """Those of ``checks`` that change no more than ``max_level`` allows."""
    return [one for one in checks if one.level <= max_level]


def assert_refused(device: Device, error: type[E], why: str, call: Callable[..., object], *args: object) -> E:
    """Require that ``call(*args)`` raises ``error`` and that the message names the device.

    Parameters
    ----------
    why
        What was tried, for the message of a failure: "a command that holds NaN".
    """
    try:
        answer = call(*args)
    except error as refusal:
        assert device.name in str(refusal), f"{why}: the error does not name {device.name!r}: {refusal}"
        assert refusal.device == device.name, f"{why}: the error's device is {refusal.device!r}"
        return refusal
    except Exception as other:
        raise AssertionError(
            f"{why}: {error.__name__} was due, {type(other).__name__} came: {other}"
        ) from other
    raise AssertionError(f"{why}: {error.__name__} was due, but it was let through and gave {answer!r}")


@contextmanager
def replace_hook(device: Device, hook: str, replacement: Callable[..., Any]) -> Iterator[None]:
    """Put ``replacement`` in place of one of the driver's hooks, on this one device only."""
    setattr(device, hook, replacement)
    try:
        yield
    finally:
        delattr(device, hook)


@contextmanager
def open_device(factory: Factory) -> Iterator[Any]:
    """Give a fresh device, open; close it afterwards without hiding a failure of the check."""
    device = factory()
    device.open()
    try:
        yield device
    except BaseException as failure:
        # The check's own failure is the news; that the device did not close either stands beside it.
        try:
            device.close()
        except DeviceError as second:
            failure.add_note(f"and then it did not close: {type(second).__name__}: {second}")
        raise
    device.close()
