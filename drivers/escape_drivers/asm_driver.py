"""Driver ``asm``: an adaptive secondary mirror behind a TCP link."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from escape_drivers import asm_messages as m
from escape_drivers.asm_codec import AsmCodec
from escape_drivers.asm_link import AsmLink, Refused
from escape_drivers.asm_options import EMULATOR, RANGES, AsmOptions
from escape_drivers.asm_welcome import require_fit, require_meant
from escape_drivers.options import read_options, require_between, require_serial
from escape_hw.api.adaptive_secondary import AdaptiveSecondary, ShellHealth, ShellState
from escape_hw.api.emulator import Emulator, EmulatorRequest
from escape_hw.api.mirror import DMInfo
from escape_hw.config.registry import emulator_factory
from escape_hw.errors import DeviceError

if TYPE_CHECKING:
    from escape_hw.config.device_models import MirrorConfig
    from escape_hw.config.models import SystemConfig

log = logging.getLogger(__name__)

#: Pause between two looks at a step that is on its way, seconds.
_LOOK_S = 0.02


def make_asm(name: str, config: SystemConfig, shared: dict[str, object]) -> AsmMirror:
    """Entry point ``asm``.

    Raises
    ------
    ConfigError
        No serial number, or an option is wrong.
    """
    section = config.devices.dm
    require_serial(name, section)
    options = read_options(AsmOptions, name, section)
    require_between(name, options, RANGES)
    emulator = None
    if options.host == EMULATOR:
        emulator = emulator_factory("asm")(EmulatorRequest(port=0, shared=shared, config=config))
    return AsmMirror(name, section, options, emulator=emulator)


class AsmMirror(AdaptiveSecondary):
    """An adaptive secondary behind ESCAPE's own link, or behind another by another codec.

    Every command is acknowledged with measured positions before the next one leaves: nothing queues.
    While nothing else is sent a thread gives signs of life, so that the mirror's watchdog knows that
    somebody is there. A link that breaks is reported by the call that meets it and got back in the
    background; nothing is sent again by itself, the mirror stays in the state it is in.

    Parameters
    ----------
    name
        Of the device.
    section
        Geometry, limits and serial number.
    options
        Of the link.
    make_codec
        Makes the codec of a connection; the observatory's own goes here.
    emulator
        Started before and stopped after, instead of the configured address.
    """

    def __init__(
        self,
        name: str,
        section: MirrorConfig,
        options: AsmOptions,
        *,
        make_codec: Callable[[], m.Codec] = AsmCodec,
        emulator: Emulator | None = None,
    ) -> None:
        super().__init__(name, section.limits.to_limits(), lift=options.lift)
        self._section, self._options, self._make_codec = section, options, make_codec
        self._emulator = emulator
        self._link = self._new_link(m.Role.CONTROL)
        self._info = section.info("adaptive secondary over TCP", simulated=False)
        self._metres = np.empty(section.n_act)
        self._stop = threading.Event()
        self._beating: threading.Thread | None = None
        self._ack: m.Ack | None = None
        self._known, self._fault = ShellState.OFF, ""
        self._found: NDArray[np.float64] | None = None
        self._tried_s = 0.0
        self._said = ""
        self._skips_in_a_row = self._skipped = 0

    # ------------------------------------------------------------------ identity
    @property
    def info(self) -> DMInfo:
        """Identity and geometry."""
        return self._info

    @property
    def last_ack(self) -> m.Ack | None:
        """The last acknowledgement: result, times on the mirror's clock, measured positions in metres."""
        return self._ack

    def parameter(self, key: str) -> float:
        """One of the mirror's own parameters, such as ``telemetry_hz``.

        Raises
        ------
        NotOpen, DeviceError
            Not connected, or the mirror knows no such parameter.
        """
        return self._parameter(m.GetParam(key))

    def set_parameter(self, key: str, value: float) -> float:
        """Set one of the mirror's own parameters; returns the value in force.

        Raises
        ------
        NotOpen, DeviceError
            Not connected, or the mirror refused the name or the value.
        """
        return self._parameter(m.SetParam(key, value))

    def _parameter(self, request: m.GetParam | m.SetParam) -> float:
        self.require_open()
        with self._lock:
            return self._link.ask(request, m.Param).value

    # ------------------------------------------------------------------ connection
    def _new_link(self, role: m.Role) -> AsmLink:
        o = self._options
        return AsmLink(
            self.name, (o.host, o.port), role, self._make_codec,
            connect_s=o.connect_s, reply_s=o.reply_s, unasked=self._listen,
        )  # fmt: skip

    def _open(self) -> None:
        self._link.address = self._address()
        self._adopt(self._link.connect())
        self._stop.clear()
        self._beating = threading.Thread(target=self._beat, name=f"{self.name} heartbeat", daemon=True)
        self._beating.start()

    def _adopt(self, welcome: m.Welcome) -> None:
        """Take over what the mirror says of itself when a connection begins."""
        disabled = require_fit(self.name, self._section, welcome)
        self._identify(welcome)
        if disabled:
            self._link.ask(m.SetDisabled(disabled, "devices.dm.limits.disabled"), m.Done)
        self._known, self._skips_in_a_row = welcome.state, 0
        floats = welcome.state in (ShellState.SET, ShellState.RUNNING)
        self._found = welcome.present.astype(np.float64) / self._section.stroke_m if floats else None

    def _identify(self, welcome: m.Welcome) -> None:
        model = f"adaptive secondary over TCP, protocol {welcome.version}{', emulated' * welcome.simulated}"
        self._info = self._section.info(model, simulated=welcome.simulated, serial=welcome.serial)

    def _close(self) -> None:
        self._stop.set()
        if self._beating is not None:
            self._beating.join()
            self._beating = None
        self._link.drop("it was closed")
        if self._emulator is not None:
            self._emulator.stop()

    def _abandon(self) -> None:
        self._close()

    def _present_shape(self) -> NDArray[np.float64] | None:
        return self._found

    # ------------------------------------------------------------------ signs of life
    def _beat(self) -> None:
        """Give a sign of life whenever nothing else was said for a while; get a lost link back."""
        pause = self._options.heartbeat_s
        while not self._stop.wait(pause / 4):
            if self._link.is_up and time.monotonic() - self._link.heard_s < pause:
                continue
            # Whoever holds the lock is talking to the mirror, which is a sign of life as well.
            if self._lock.acquire(blocking=False):
                try:
                    self._sign()
                finally:
                    self._lock.release()

    def _sign(self) -> None:
        before = self._known
        try:
            if self._link.is_up:
                self._ask_state()
            elif self.is_open and time.monotonic() > self._retry_at_s():
                self._reconnect()
        except DeviceError as error:
            # Nobody is there to raise it to; the next call meets it, too.
            if str(error) != self._said:
                log.warning("%s", error)
            self._said = str(error)
        else:
            self._said = ""
            if self._known is not before:
                log.warning(
                    "%s: went from %s to %s by itself %s", self.name, before, self._known, self._fault
                )

    def _retry_at_s(self) -> float:
        """When a lost connection is tried again, on this computer's monotonic clock."""
        return max(self._tried_s, self._link.heard_s) + self._options.retry_s

    def _reconnect(self) -> None:
        """Get a lost connection back; the mirror stays as it is, nothing is sent again."""
        self._tried_s = time.monotonic()
        welcome = self._link.connect()
        try:
            self._adopt(welcome)
        except DeviceError as error:
            self._link.drop(f"it came back, but {error.args[1]}")
            raise
        # What became of the last command before the link broke is not known; its shape is.
        self._checked().reset(self._found)
        log.warning("%s: the link is back; the mirror is %s, nothing was sent again", self.name, self._known)

    def _listen(self, news: m.Reply) -> None:
        if isinstance(news, m.Fault):
            self._known, self._fault = news.state, news.text
            log.error("%s: fault: %s", self.name, news.text)

    # ------------------------------------------------------------------ questions
    def _ask_state(self) -> ShellState:
        with self._lock:
            return self._note(self._link.ask(m.Heartbeat(), m.Ack))

    def _note(self, ack: m.Ack) -> ShellState:
        if ack.positions.size != self._metres.size:
            raise DeviceError(
                self.name, f"reported {ack.positions.size} positions for {self._metres.size} actuators"
            )
        self._ack, self._known = ack, ack.state
        return ack.state

    def _state(self) -> ShellState:
        return self._ask_state()

    def _known_state(self) -> ShellState:
        return self._known

    def _measure(self) -> NDArray[np.float64]:
        with self._lock:
            ack = self._link.ask(m.Heartbeat(), m.Ack)
            self._note(ack)
        return ack.positions.astype(np.float64) / self._section.stroke_m

    def _health(self) -> ShellHealth:
        with self._lock:
            return _translated(self._link.ask(m.GetHealth(), m.Health))

    def _glance(self) -> ShellHealth:
        link = self._new_link(m.Role.TELEMETRY)
        link.address = self._address()
        try:
            welcome = link.connect()
            require_meant(self.name, self._section, welcome)
            self._identify(welcome)
            return _translated(link.ask(m.GetHealth(), m.Health))
        finally:
            link.drop("it was only looked at")
            if self._emulator is not None:
                self._emulator.stop()

    def _address(self) -> tuple[str, int]:
        """Where to connect; starts the emulator if there is one."""
        if self._emulator is None:
            return self._options.host, self._options.port
        host, _, port = self._emulator.start().removeprefix("tcp ").rpartition(":")
        return host, int(port)

    # ------------------------------------------------------------------ what moves
    def _step(self, state: ShellState) -> None:
        if state is ShellState.SET:
            self._skips_in_a_row = 0
        self._link.ask(m.SetState(state), m.Done)
        deadline = time.monotonic() + self._options.step_s
        while (now := self._ask_state()) is not state and now is not ShellState.FAULT:
            if time.monotonic() > deadline:
                raise DeviceError(
                    self.name, f"is {now} and not {state} after {self._options.step_s:g} s; see its health"
                )
            time.sleep(_LOOK_S)

    def _recover(self) -> None:
        self._link.ask(m.Recover(), m.Done)
        self._fault = ""

    def _drive(self, command: NDArray[np.float64]) -> NDArray[np.float64] | None:
        np.multiply(command, self._section.stroke_m, out=self._metres)
        try:
            ack = self._link.command(self._metres)
        except Refused as refusal:
            raise self._explained(refusal) from refusal
        self._note(ack)
        if ack.result is m.Result.APPLIED:
            self._skips_in_a_row = 0
            return None
        if ack.result is not m.Result.SKIPPED:
            raise DeviceError(
                self.name,
                f"changed a command ({ack.result.name.lower()}, {ack.clipped} actuators): some went out of "
                "service, or its limits became tighter; open it again, which says what to configure",
            )
        self._skipped += 1
        self._skips_in_a_row += 1
        if self._skips_in_a_row >= self._options.max_skips:
            raise DeviceError(
                self.name,
                f"skipped {self._skips_in_a_row} commands in a row and kept its last shape; they exceed "
                f"limits of its own: lower max_slew in devices.{self.name}.limits, and see its health",
            )
        return self._checked().last

    def _explained(self, refusal: Refused) -> DeviceError:
        """The error for a refused command, in the words of every adaptive secondary."""
        nak = refusal.nak
        self._known = nak.state
        if nak.code is m.Result.PANIC:
            self._fault = nak.text
            return self._latched(nak.text)
        if nak.code is m.Result.WRONG_STATE:
            return self._asleep(nak.state, f" ({nak.text})")
        return refusal


def _translated(health: m.Health) -> ShellHealth:
    return ShellHealth(
        health.time_ns, health.state, health.gap_m, health.current_a, health.temperature_c, health.skipped,
        health.fault, health.contaminated, health.owner,
    )  # fmt: skip
