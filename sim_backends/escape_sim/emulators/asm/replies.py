"""Payloads of the replies of the emulated adaptive secondary."""

from __future__ import annotations

import struct
import time

import numpy as np

from escape_hw.api.adaptive_secondary import STATE_ORDER, ShellState
from escape_sim.emulators.asm.controller import AsmController
from escape_sim.emulators.asm.protocol import encode_bitmap, encode_floats, encode_text
from escape_sim.mirror.shell import AMBIENT_C, RISE_C_PER_A

#: States in the order of their numbers on the link.
STATES = [*STATE_ORDER, ShellState.FAULT]
#: Constant sensor values: coolant and dew point in degrees Celsius, relative humidity.
COOLANT_C, HUMIDITY, DEW_POINT_C = 12.0, 0.3, 2.0


class ReplyWriter:
    """Encodes the present state of a mirror with serial number ``serial``; formats in asm-link.md."""

    def __init__(self, controller: AsmController, serial: str) -> None:
        self._controller, self._serial = controller, serial

    @property
    def _state(self) -> int:
        return STATES.index(self._controller.shell.state)

    def welcome(self, echo: int, version: int, role: int, token: int) -> bytes:
        """Identity, limits, unusable actuators and present shape."""
        controller, limits = self._controller, self._controller.limits
        n_act = controller.shell.n_act
        fixed = struct.pack(
            "<IBBBBHHQffff", echo, version, role, self._state, 1, n_act, 0, token,
            limits.max_command_m, limits.max_step_m, limits.hold_s, limits.rest_s,
        )  # fmt: skip
        unusable = encode_bitmap(controller.out_of_service, n_act)
        return fixed + encode_text(self._serial) + unusable + encode_floats(controller.present_m)

    def ack(self, echo: int, result: int, clipped: int, received_ns: int) -> bytes:
        """Result of a command or heartbeat, with measured positions."""
        controller = self._controller
        fixed = struct.pack(
            "<IHBBHHQQ", echo, result, self._state, int(controller.holding), clipped, 0, received_ns,
            time.monotonic_ns(),
        )  # fmt: skip
        return fixed + encode_floats(controller.positions_m())

    def nak(self, echo: int, code: int, message: str) -> bytes:
        """A request was refused."""
        return struct.pack("<IHBB", echo, code, self._state, 0) + encode_text(message)

    def done(self, echo: int, message: str) -> bytes:
        """A request was accepted."""
        return struct.pack("<IB", echo, self._state) + encode_text(message)

    def parameter(self, echo: int, key: str) -> bytes:
        """Value of a parameter."""
        return struct.pack("<Id", echo, self._controller.parameters[key]) + encode_text(key)

    def fault(self, message: str) -> bytes:
        """The mirror has entered the state ``FAULT``."""
        return bytes([self._state]) + encode_text(message)

    def health(self, echo: int, owner: str, damaged: int) -> bytes:
        """Health record."""
        controller, shell = self._controller, self._controller.shell
        current = float(shell.currents_a().max())
        fixed = struct.pack(
            "<IBxxxQffffffIII", echo, self._state, time.monotonic_ns(),
            shell.gap_m(), current, AMBIENT_C + RISE_C_PER_A * current, COOLANT_C, HUMIDITY, DEW_POINT_C,
            controller.applied & 0xFFFFFFFF, controller.skipped & 0xFFFFFFFF, damaged & 0xFFFFFFFF,
        )  # fmt: skip
        contaminated = encode_bitmap(controller.contaminated, shell.n_act)
        return fixed + contaminated + encode_text(owner) + encode_text(shell.fault or controller.last_event)

    def telemetry(self) -> bytes:
        """Command, positions, currents and flags of all actuators, for observers."""
        controller = self._controller
        fixed = struct.pack(
            "<IBxHQ", controller.applied & 0xFFFFFFFF, self._state, controller.shell.n_act,
            time.monotonic_ns(),
        )  # fmt: skip
        shape = controller.present_m.copy()
        unused = sorted(controller.out_of_service)
        if unused:
            # Unusable actuators exert no force; the shell follows their neighbours.
            numbers = np.arange(shape.size)
            shape[unused] = np.interp(unused, np.delete(numbers, unused), np.delete(shape, unused))
        measured = (controller.positions_m(), controller.shell.currents_a())
        flags: bytes = controller.flags().tobytes()
        return fixed + b"".join(map(encode_floats, (shape, *measured))) + flags
