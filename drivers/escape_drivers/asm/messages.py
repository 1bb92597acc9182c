"""Messages between client and adaptive secondary, without their encoding.

An observatory's own protocol keeps these and brings another codec, see :class:`Codec`.
"""

from __future__ import annotations

import enum
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.adaptive_secondary import ShellState


class ProtocolError(Exception):
    """The peer sent what the protocol does not allow; the connection is of no further use."""


class Role(enum.IntEnum):
    """What a connection is for: one owner controls, many watch."""

    CONTROL = 0
    TELEMETRY = 1


class Result(enum.IntEnum):
    """What became of a request."""

    APPLIED = 0
    CLIPPED = 1
    SKIPPED = 2
    STALE = 3
    WRONG_STATE = 4
    BAD_LENGTH = 5
    NOT_OWNER = 6
    NOT_FINITE = 7
    PANIC = 8
    UNSUPPORTED = 9


# --------------------------------------------------------------------- requests
@dataclass(frozen=True, slots=True)
class Hello:
    """First message of a connection.

    ``token`` is that of a session to be resumed, 0 for a new one; ``name`` names the
    mirror's owner to a second client.
    """

    role: Role
    token: int
    name: str


@dataclass(frozen=True, slots=True)
class Heartbeat:
    """Feeds the watchdog; answered by an :class:`Ack` with live positions."""


@dataclass(frozen=True, slots=True)
class GetHealth:
    """Request a :class:`HealthReport`."""


@dataclass(frozen=True, slots=True)
class SetState:
    """Start a step of the state sequence; answered at once, the step ends later."""

    state: ShellState


@dataclass(frozen=True, slots=True)
class Recover:
    """An operator has seen to the fault."""


@dataclass(frozen=True, slots=True)
class SetDisabled:
    """Disable exactly these actuators, in addition to those disabled by the mirror."""

    actuators: tuple[int, ...]
    reason: str


@dataclass(frozen=True, slots=True)
class GetParam:
    """Request a parameter."""

    key: str


@dataclass(frozen=True, slots=True)
class SetParam:
    """Set a parameter; answered by :class:`Param` with the value in force."""

    key: str
    value: float


Request = Hello | Heartbeat | GetHealth | SetState | Recover | SetDisabled | GetParam | SetParam


# --------------------------------------------------------------------- replies
@dataclass(frozen=True, slots=True, eq=False)
class Welcome:
    """Answer to :class:`Hello`: identity and limits of the mirror.

    ``last_command_m`` is its shape ``(n_act,)`` in metres from flat, as last commanded; ``disabled`` are
    all disabled actuators.
    """

    echo: int
    version: int
    token: int
    serial: str
    simulated: bool
    state: ShellState
    max_command_m: float
    max_step_m: float
    hold_s: float
    rest_s: float
    disabled: tuple[int, ...]
    last_command_m: NDArray[np.float32]


@dataclass(frozen=True, slots=True, eq=False)
class Ack:
    """Answer to a command or heartbeat, with measured positions ``(n_act,)`` in metres from flat.

    ``received_ns`` and ``applied_ns`` are on the mirror's clock; ``holding`` is true when the watchdog
    holds the last shape because no message arrives.
    """

    echo: int
    result: Result
    state: ShellState
    clipped: int
    holding: bool
    received_ns: int
    applied_ns: int
    positions: NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class Nak:
    """A request that was refused; nothing of it was done."""

    echo: int
    code: Result
    state: ShellState
    text: str


@dataclass(frozen=True, slots=True)
class Done:
    """A request other than a command was accepted."""

    echo: int
    state: ShellState
    text: str


@dataclass(frozen=True, slots=True)
class Param:
    """A parameter in force."""

    echo: int
    key: str
    value: float


@dataclass(frozen=True, slots=True)
class HealthReport:
    """Health of the mirror; ``echo`` is 0 in an unsolicited report."""

    echo: int
    state: ShellState
    time_ns: int
    gap_m: float
    current_a: float
    temperature_c: float
    coolant_c: float
    humidity: float
    dew_point_c: float
    applied: int
    skipped: int
    crc_errors: int
    contaminated: tuple[int, ...]
    owner: str
    fault: str


@dataclass(frozen=True, slots=True)
class FaultReport:
    """Sent unasked when the mirror stops itself; it stays so until :class:`Recover`."""

    state: ShellState
    text: str
    echo: int = 0


@dataclass(frozen=True, slots=True, eq=False)
class TelemetrySample:
    """A sample for observers: command, position (metres from flat), current (amperes), flags."""

    counter: int
    state: ShellState
    time_ns: int
    command: NDArray[np.float32]
    position: NDArray[np.float32]
    current: NDArray[np.float32]
    flags: NDArray[np.uint8]
    echo: int = 0


Reply = Welcome | Ack | Nak | Done | Param | HealthReport | FaultReport | TelemetrySample


class Codec(Protocol):
    """Encodes requests and decodes replies; uses no socket and no clock."""

    def request(self, sequence: int, time_ns: int, message: Request) -> bytes | bytearray:
        """The bytes of a request."""

    def command(
        self, sequence: int, time_ns: int, counter: int, metres: NDArray[np.float64]
    ) -> bytes | bytearray:
        """The bytes of a shape ``(n_act,)``, metres from flat; valid until the next call."""

    def feed(self, data: bytes | bytearray | memoryview) -> list[Reply]:
        """Whole replies among what has arrived so far, in order.

        Raises
        ------
        ProtocolError
            The bytes received are not this protocol; later bytes are ignored.
        """
