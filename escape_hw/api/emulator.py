"""Interfaces of device emulators and of the simulated bench behind the vendor-library stand-ins."""

from __future__ import annotations

import abc
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol, Self


@dataclass(frozen=True, slots=True)
class EmulatorRequest:
    """Settings of an emulator.

    Parameters
    ----------
    host
        Address to listen on.
    port
        TCP port; ``None``: the port of the real device, 0: any free port.
    pty
        Use a pseudo-terminal (a serial line) instead of the network.
    options
        Settings specific to this emulator, as text.
    shared
        Dictionary shared by the twins of an opened system; ``None`` for an emulator without a system.
    config
        Configuration of that system (:class:`~escape_hw.config.system.SystemConfig`).
    """

    host: str = "127.0.0.1"
    port: int | None = None
    pty: bool = False
    options: Mapping[str, str] = field(default_factory=dict)
    shared: dict[str, object] | None = None
    config: Any = None


class Emulator(abc.ABC):
    """An emulated device behind its real interface; usable as a context manager.

    ``violations`` lists violations of the protocol that real hardware may tolerate: commands in the wrong
    order, unread errors, values out of range, a second client.
    """

    @abc.abstractmethod
    def start(self) -> str:
        """Start listening; returns the address, such as ``tcp 127.0.0.1:50000`` or ``pty /dev/pts/4``.

        Raises
        ------
        ConfigError
            The address is not available.
        """

    @abc.abstractmethod
    def stop(self) -> None:
        """Close all connections and stop listening; may be repeated."""

    @property
    @abc.abstractmethod
    def violations(self) -> tuple[str, ...]:
        """Protocol violations of clients, in order."""

    @abc.abstractmethod
    def report(self) -> dict[str, Any]:
        """Counters and present state of the device, as plain values."""

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(self, *exception: object) -> None:
        self.stop()


#: Type of an entry point of the group ``escape.emulators``; raises ``ConfigError`` on an unknown option.
EmulatorFactory = Callable[[EmulatorRequest], Emulator]


class StandInBench(Protocol):
    """A simulated bench that real drivers access through stand-ins of their vendor libraries."""

    @property
    def environment(self) -> Mapping[str, str]:
        """Environment variables with which the drivers of a process find the bench."""

    def start(self) -> str:
        """Start serving; returns the address. Raises ``EscapeError`` without a C compiler."""

    def stop(self) -> None:
        """Close all connections; may be repeated."""


#: Type of an entry point of the group ``escape.stand_ins``; called with the configuration of the system
#: (:class:`~escape_hw.config.system.SystemConfig`).
StandInBenchFactory = Callable[[Any], StandInBench]
