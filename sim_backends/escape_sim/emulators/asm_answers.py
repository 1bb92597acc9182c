"""Payloads of what the emulated adaptive secondary says."""

from __future__ import annotations

import struct
import time

import numpy as np

from escape_hw.api.adaptive_secondary import LADDER, ShellState
from escape_sim.emulators import asm_wire as w
from escape_sim.emulators.asm_body import AsmBody
from escape_sim.shell import AMBIENT_C, RISE_C_PER_A

#: States as the wire numbers them.
STATES = [*LADDER, ShellState.FAULT]
#: Sensors that have no physics here: coolant and dew point in degrees Celsius, relative humidity.
COOLANT_C, HUMIDITY, DEW_POINT_C = 12.0, 0.3, 2.0


class Answers:
    """Writes payloads from the mirror's present state.

    Parameters
    ----------
    body
        The mirror.
    serial
        What it is called.
    """

    def __init__(self, body: AsmBody, serial: str) -> None:
        self._body, self._serial = body, serial

    @property
    def _state(self) -> int:
        return STATES.index(self._body.shell.state)

    def welcome(self, echo: int, version: int, role: int, token: int) -> bytes:
        """Who the mirror is."""
        body, limits = self._body, self._body.limits
        n_act = body.shell.n_act
        fixed = struct.pack(
            "<IBBBBHHQffff", echo, version, role, self._state, 1, n_act, 0, token,
            limits.max_command_m, limits.max_step_m, limits.hold_s, limits.rest_s,
        )  # fmt: skip
        return fixed + w.text(self._serial) + w.bitmap(body.out_of_service, n_act) + w.floats(body.present_m)

    def ack(self, echo: int, result: int, clipped: int, received_ns: int) -> bytes:
        """A command or heartbeat was taken, with positions."""
        body = self._body
        flags = int(body.holding)
        fixed = struct.pack(
            "<IHBBHHQQ", echo, result, self._state, flags, clipped, 0, received_ns, time.monotonic_ns()
        )
        return fixed + w.floats(body.positions_m())

    def nak(self, echo: int, code: int, words: str) -> bytes:
        """A request was refused."""
        return struct.pack("<IHBB", echo, code, self._state, 0) + w.text(words)

    def done(self, echo: int, words: str) -> bytes:
        """A request was accepted."""
        return struct.pack("<IB", echo, self._state) + w.text(words)

    def parameter(self, echo: int, key: str) -> bytes:
        """A parameter in force."""
        return struct.pack("<Id", echo, self._body.parameters[key]) + w.text(key)

    def fault(self, words: str) -> bytes:
        """The mirror has stopped itself."""
        return bytes([self._state]) + w.text(words)

    def health(self, echo: int, owner: str, damaged: int) -> bytes:
        """How the mirror is."""
        body, shell = self._body, self._body.shell
        current = float(shell.currents_a().max())
        fixed = struct.pack(
            "<IBxxxQffffffIII", echo, self._state, time.monotonic_ns(),
            shell.gap_m(), current, AMBIENT_C + RISE_C_PER_A * current, COOLANT_C, HUMIDITY, DEW_POINT_C,
            body.applied & 0xFFFFFFFF, body.skipped & 0xFFFFFFFF, damaged & 0xFFFFFFFF,
        )  # fmt: skip
        return (
            fixed
            + w.bitmap(body.contaminated, shell.n_act)
            + w.text(owner)
            + w.text(shell.fault or body.note)
        )

    def telemetry(self) -> bytes:
        """A sample for observers."""
        body = self._body
        fixed = struct.pack(
            "<IBxHQ", body.applied & 0xFFFFFFFF, self._state, body.shell.n_act, time.monotonic_ns()
        )
        flags: bytes = body.flags().tobytes()
        shape = body.present_m.copy()
        idle = sorted(body.out_of_service)
        if idle:
            # No force acts there; the shell goes where its neighbours take it.
            numbers = np.arange(shape.size)
            shape[idle] = np.interp(idle, np.delete(numbers, idle), np.delete(shape, idle))
        return (
            fixed + w.floats(shape) + w.floats(body.positions_m()) + w.floats(body.shell.currents_a()) + flags
        )
