"""Shared parts of the commands for single devices."""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeVar

from escape_hw.cli.context import CommandContext
from escape_hw.cli.options import SystemSelection

if TYPE_CHECKING:
    from escape_hw.api.device import Device
    from escape_hw.config.system import SystemConfig

D = TypeVar("D", bound="Device")


def announce_change(context: CommandContext, config: SystemConfig, key: str, what: str) -> None:
    """Announce how a real device is about to change; nothing for a simulated one."""
    from escape_hw.bench import resolve_mode

    section = getattr(config.devices, key)
    if resolve_mode(section, config) == "hardware":
        context.notify(f"this changes hardware, devices.{key} {section.serial}: {what}")


def build_single_device(
    context: CommandContext, selection: SystemSelection, key: str, kind: type[D]
) -> tuple[SystemConfig, D]:
    """Configuration and one device of a system, not open."""
    from escape_hw.bench import build_device

    config = context.load_config(selection)
    return config, build_device(key, config, kind)
