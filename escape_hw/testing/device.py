"""Contract checks of every device."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from escape_hw.api.adaptive_secondary import AdaptiveSecondary, ShellState
from escape_hw.api.camera import Camera
from escape_hw.api.device import Device
from escape_hw.api.mirror import DeformableMirror
from escape_hw.api.modulator import Modulation, TipTiltModulator
from escape_hw.api.phase_screen import PhaseScreen
from escape_hw.errors import NotOpen
from escape_hw.testing.checks import READS, Factory, assert_refused, check, factory_check


@factory_check(Device, READS)
def check_construction_does_not_connect(factory: Factory) -> None:
    """Construction does not connect, and garbage collection does nothing."""
    device = factory()
    assert isinstance(device, Device), f"the factory returned {type(device).__name__}, not a Device"
    assert not device.is_open, f"{device.name}: open before open() was called"
    assert isinstance(device.name, str), f"the name is {device.name!r}; it must be text"
    assert device.name.strip(), "the name is empty; messages need it"
    assert factory() is not device, "the factory returned the same device twice; each check needs a new one"
    classes = [kind.__name__ for kind in type(device).__mro__ if "__del__" in vars(kind)]
    assert not classes, f"{device.name}: {classes} define __del__; nothing may happen on garbage collection"


@factory_check(Device, READS)
def check_final_methods_are_not_overridden(factory: Factory) -> None:
    """The driver does not override the final public methods."""
    device = factory()
    own = type(device)
    for base in own.__mro__:
        for name, method in vars(base).items():
            if getattr(method, "__final__", False):
                assert getattr(own, name) is method, (
                    f"{own.__name__} overrides {base.__name__}.{name}, which is final; "
                    f"implement the hook _{name} instead"
                )


@factory_check(Device, READS)
def check_open_and_close_repeat(factory: Factory) -> None:
    """``open`` and ``close`` may be repeated and alternated."""
    device = factory()
    device.close()
    assert not device.is_open, "open after close() of a device that was never opened"
    try:
        for turn in ("first", "second"):
            for _ in range(2):
                assert device.open() is device, "open() must return the device"
                assert device.is_open, f"not open after open(), {turn} time"
            for _ in range(2):
                assert device.close() is None, "close() must return nothing"
                assert not device.is_open, f"still open after close(), {turn} time"
    finally:
        device.close()


@factory_check(Device, READS)
def check_context_manager(factory: Factory) -> None:
    """``with`` opens and closes, and does not suppress exceptions."""
    device = factory()
    with device as entered:
        assert entered is device, "'with' must return the device itself"
        assert device.is_open, "not open inside 'with'"
    assert not device.is_open, "still open after 'with'"
    mistake = ZeroDivisionError("inside 'with'")
    try:
        with device:
            raise mistake
    except ZeroDivisionError as caught:
        assert caught is mistake, "'with' replaced the exception of its body"
    else:
        raise AssertionError("'with' suppressed an exception of its body")
    assert not device.is_open, "still open after an exception inside 'with'"


@factory_check(Device, READS)
def check_refuses_use_unless_open(factory: Factory) -> None:
    """Calls that need an open device raise ``NotOpen`` before ``open`` and after ``close``."""
    device = factory()
    for when in ("before open()", "after close()"):
        for what, call in _calls_needing_open(device).items():
            assert_refused(device, NotOpen, f"{what} {when}", call)
        with device:
            assert device.is_open, "not open inside 'with'"


@check(Device, READS)
def check_clock_is_monotonic(device: Device) -> None:
    """``now_ns`` is an integer and does not decrease."""
    times = [device.now_ns() for _ in range(100)]
    assert all(type(t) is int for t in times), f"now_ns returned {type(times[0]).__name__}, not int"
    assert times == sorted(times), "now_ns decreased between two calls"


def _calls_needing_open(device: Any) -> dict[str, Callable[[], object]]:
    if isinstance(device, DeformableMirror):
        uses: dict[str, Callable[[], object]] = {
            "send": lambda: device.send([0.0]),
            "flatten": device.flatten,
            "set_flat": lambda: device.set_flat([0.0]),
            "shape": lambda: device.shape,
        }
        if isinstance(device, AdaptiveSecondary):
            uses |= {
                "state": lambda: device.state,
                "health": lambda: device.health,
                "measured_positions": device.measured_positions,
                "go_to": lambda: device.go_to(ShellState.RESTED),
                "recover": device.recover,
            }
        return uses
    if isinstance(device, Camera):
        return {"start": device.start, "next_frame": device.next_frame, "poll": device.poll}
    if isinstance(device, TipTiltModulator):
        circle = Modulation(0.0, 1.0)
        return {
            "check": lambda: device.check(circle),
            "modulate": lambda: device.modulate(circle),
            "park": device.park,
        }
    if isinstance(device, PhaseScreen):
        return {"set": device.set}
    return {"require_open": device.require_open}
