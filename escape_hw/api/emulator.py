"""Interfaces of device emulators and of the simulated bench behind stand-ins of vendor libraries."""

from __future__ import annotations

import abc
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from types import TracebackType
from typing import Any, Protocol, Self


@dataclass(frozen=True, slots=True)
class EmulatorRequest:
    """How an emulator is wanted.

    Parameters
    ----------
    host
        Address of the network interface that it listens on.
    port
        TCP port; ``None``: the one that the real device has, 0: any that is free.
    pty
        Answer on a pseudo-terminal (a serial line) instead of on the network.
    options
        Further settings that only this emulator understands, as text.
    shared
        Dictionary of an opened system, through which the emulator finds the twins that it belongs to;
        ``None``: it stands alone.
    config
        Configuration of that system (a :class:`~escape_hw.config.system.SystemConfig`).
    """

    host: str = "127.0.0.1"
    port: int | None = None
    pty: bool = False
    options: Mapping[str, str] = field(default_factory=dict)
    shared: dict[str, object] | None = None
    config: Any = None


class Emulator(abc.ABC):
    """A device that answers on its own wire; usable as a context manager.

    It is strict: violations of the protocol that a real device may tolerate for a while (a wrong order, an
    error never queried, a value out of range, a second owner) are recorded in ``violations``.
    """

    @abc.abstractmethod
    def start(self) -> str:
        """Begin to listen; returns where, such as ``tcp 127.0.0.1:50000`` or ``pty /dev/pts/4``.

        Raises
        ------
        ConfigError
            The address cannot be listened on.
        """

    @abc.abstractmethod
    def stop(self) -> None:
        """Hang up and stop listening; may be repeated."""

    @property
    @abc.abstractmethod
    def violations(self) -> tuple[str, ...]:
        """Violations of the protocol by clients, in order."""

    @abc.abstractmethod
    def report(self) -> dict[str, Any]:
        """Counters and the device's present state, as plain values."""

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()


#: What an entry point of the group ``escape.emulators`` is. Raises ``ConfigError`` on an unknown option.
EmulatorFactory = Callable[[EmulatorRequest], Emulator]


class StandInBench(Protocol):
    """A simulated bench that real drivers reach, each through its own library."""

    @property
    def environment(self) -> Mapping[str, str]:
        """What a process needs in its environment for its drivers to find the bench."""

    def start(self) -> str:
        """Begin to serve; returns where.

        Raises
        ------
        EscapeError
            This machine cannot: it has no C compiler, for instance.
        """

    def stop(self) -> None:
        """Hang up on everybody; may be repeated."""


#: What an entry point of the group ``escape.rehearsals`` is: takes the configuration of the system
#: (:class:`~escape_hw.config.system.SystemConfig`).
StandInBenchFactory = Callable[[Any], StandInBench]
