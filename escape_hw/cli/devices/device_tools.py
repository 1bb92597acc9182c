"""Shared parts of the commands for single devices."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Generic, TypeVar

from typer.core import TyperCommand

from escape_hw.cli.context import CommandContext
from escape_hw.cli.options import SystemSelection
from escape_hw.errors import ConfigError
from escape_hw.runtime.procedures.declaration import Parameter

if TYPE_CHECKING:
    from escape_hw.api.device import Device
    from escape_hw.config.system import SystemConfig

D = TypeVar("D", bound="Device")


class DeviceCommand(TyperCommand):
    """A command whose first argument names a system, which ``--driver`` replaces."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse the command line; with ``--driver`` the system is empty."""
        before_values = args[: args.index("--")] if "--" in args else args
        if any(word.partition("=")[0] == "--driver" for word in before_values):
            args = ["", *args]
        return super().parse_args(ctx, args)

    def format_help(self, ctx: Any, formatter: Any) -> None:
        """Write the help, which does not call the system required: its text says when it is."""
        for parameter in self.params:
            if parameter.name == "system":
                parameter.required = False
        super().format_help(ctx, formatter)


@dataclass(frozen=True)
class SelectedDevice(Generic[D]):
    """One device, not open, and the system that it is part of, if it is."""

    key: str
    device: D
    config: SystemConfig | None
    #: Driver and serial number, or its place in the system and serial number.
    label: str

    @property
    def section(self) -> Any:
        """Its section of ``[devices]``; ``None`` without a system."""
        return None if self.config is None else getattr(self.config.devices, self.key)

    @property
    def is_hardware(self) -> bool:
        """Whether it is meant to be a real device."""
        from escape_hw.bench import resolve_mode

        return self.config is None or resolve_mode(self.section, self.config) == "hardware"

    def announce_change(self, context: CommandContext, what: str) -> None:
        """Announce how a real device is about to change; nothing for a simulated one."""
        if self.is_hardware:
            context.notify(f"this changes hardware, {self.label}: {what}")


def select_device(
    context: CommandContext, selection: SystemSelection, key: str, kind: type[D]
) -> SelectedDevice[D]:
    """One device of a system, or of a driver; not open."""
    from escape_hw.bench import build_device, build_standalone_device, resolve_mode

    if not selection.driver:
        if selection.serial:
            raise ConfigError(f"--serial {selection.serial}: goes with --driver; a system file has its own")
        config = context.load_config(selection)
        section = getattr(config.devices, key)
        if section is None:
            raise ConfigError(f"system '{config.system.name}' has no {key}, [devices.{key}]")
        twin = resolve_mode(section, config) == "sim"
        context.set_device(section.sim_driver if twin else section.driver, section.serial)
        label = f"devices.{key} {section.serial}".rstrip()
        return SelectedDevice(key, build_device(key, config, kind), config, label)
    if selection.mode is not None or selection.seed is not None:
        raise ConfigError("--mode and --seed: not with --driver, which opens one real device")
    settings = _parse_settings(key, selection.set)
    if selection.serial:
        if settings.get("serial", selection.serial) != selection.serial:
            other = settings["serial"]
            raise ConfigError(
                f"--serial {selection.serial} contradicts --set serial={other}; give one of them"
            )
        settings["serial"] = selection.serial
    serial = str(settings.get("serial", ""))
    context.set_device(selection.driver, serial)
    device = build_standalone_device(selection.driver, kind, **settings)
    return SelectedDevice(key, device, None, f"{selection.driver} {serial}".rstrip())


def check_number(option: str, value: float | None, low: float, high: float, unit: str) -> float | None:
    """The number of an option, ``None`` if it is not given; :class:`ConfigError` if it is out of range."""
    checked: float | None = Parameter(option, "float", low=low, high=high, unit=unit).check(value)
    return checked


def _parse_settings(key: str, changes: tuple[str, ...]) -> dict[str, Any]:
    """Settings of a driver of ``devices.KEY``, from ``key=value`` and ``table.key=value``."""
    from escape_hw.config.loader import parse_override

    settings: dict[str, Any] = {}
    for text in changes:
        override = parse_override(text, within=("devices", key))
        *tables, last = override.path
        table = settings
        for name in tables:
            table = table.setdefault(name, {})
            if not isinstance(table, dict):
                raise ConfigError(f"--set  {text}: {name} has a value already, {table!r}")
        table[last] = override.value
    return settings
