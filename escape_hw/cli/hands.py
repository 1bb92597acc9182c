"""What the commands for single devices share: the device alone, and a word before it changes."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, TypeVar

from escape_hw.cli.options import Choice
from escape_hw.cli.session import Session

if TYPE_CHECKING:
    from escape_hw.api.device import Device
    from escape_hw.config.models import SystemConfig

D = TypeVar("D", bound="Device")


def on_hardware(config: SystemConfig, key: str) -> bool:
    """True when this device of the system is a real one."""
    from escape_hw.bench import mode_of

    return mode_of(getattr(config.devices, key), config) == "hardware"


def announce(one: Session, config: SystemConfig, key: str, what: str) -> None:
    """Say before it happens that a real device is about to change, and how."""
    if on_hardware(config, key):
        serial = getattr(config.devices, key).serial
        one.tell(f"this changes hardware, devices.{key} {serial}: {what}")


@contextmanager
def opened(one: Session, device: D) -> Iterator[D]:
    """The device, open; closed at the end whatever happens, and no Ctrl-C breaks into that."""
    one.was_opened = True
    try:
        with device:
            try:
                yield device
            finally:
                one.interrupts.begin_closing()
    finally:
        one.interrupts.end_closing()


def told(
    one: Session, command: str, config: SystemConfig, simulated: bool, changed: bool, **rest: Any
) -> None:
    """The command's document."""
    from escape_hw.io.documents import head

    start = head(command, config.system.name, simulated, config.system.seed)
    one.result({**start, "changed": changed, **rest})


def single(one: Session, choice: Choice, key: str, kind: type[D]) -> tuple[SystemConfig, D]:
    """Configuration and one device of a system, not open.

    Raises
    ------
    ConfigError
        Wrong configuration, or no such device.
    """
    from escape_hw.bench import build_device

    config = one.configured(choice)
    return config, build_device(key, config, kind)
