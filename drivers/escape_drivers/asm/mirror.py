"""Driver ``asm``: an adaptive secondary mirror behind a TCP link, and the check of its configuration."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import NDArray

from escape_drivers.asm import messages as m
from escape_drivers.asm.codec import AsmCodec
from escape_drivers.asm.link import AsmLink, MirrorRefusal
from escape_drivers.asm.messages import Welcome
from escape_drivers.asm.options import EMULATOR, AsmOptions
from escape_drivers.common.mirror import require_geometry
from escape_drivers.common.options import (
    keywords_of,
    layout_of,
    mirror_settings,
    require_serial,
    section_options,
)
from escape_hw.api.adaptive_secondary import AdaptiveSecondary, ShellHealth, ShellState
from escape_hw.api.emulator import Emulator, EmulatorRequest
from escape_hw.api.mirror import DMInfo
from escape_hw.config.devices import mirror_info
from escape_hw.config.layouts import n_actuators, shorten
from escape_hw.config.options import parse_limits, parse_options
from escape_hw.config.registry import emulator_factory
from escape_hw.errors import DeviceError, NotOpen, SettingRejected
from escape_hw.safety.limits import CAUTIOUS_LIMITS, MirrorLimits
from escape_hw.supervision import BackgroundThread

if TYPE_CHECKING:
    from escape_hw.config.devices import MirrorConfig
    from escape_hw.config.registry import DeviceContext


#: Head-room for the mirror's limits, which come as single-precision numbers.
_ROUNDING = 1e-6


@dataclass(frozen=True, slots=True)
class ExpectedMirror:
    """The mirror that is meant, and the limits of its commands.

    Parameters
    ----------
    serial
        Serial number.
    layout
        Arrangement of the actuators; empty: by the number that the mirror reports.
    pitch_m
        Distance between actuators, metres.
    stroke_m
        Metres of surface for a command of 1; ``None``: the mirror's own largest command.
    limits
        Limits of every command; ``None``: :data:`CAUTIOUS_LIMITS
        <escape_hw.safety.limits.CAUTIOUS_LIMITS>` within those that the mirror reports.
    """

    serial: str
    layout: str = ""
    pitch_m: float = 1.0
    stroke_m: float | None = None
    limits: MirrorLimits | None = None

    def completed(self, name: str, welcome: Welcome) -> ExpectedMirror:
        """What was left open, from the mirror's own report."""
        stroke_m = welcome.max_command_m if self.stroke_m is None else self.stroke_m
        limits = self.limits or replace(
            CAUTIOUS_LIMITS,
            max_stroke=min(CAUTIOUS_LIMITS.max_stroke, welcome.max_command_m / stroke_m),
            max_slew=min(CAUTIOUS_LIMITS.max_slew or 2.0, welcome.max_step_m / stroke_m),
            disabled=tuple(sorted(welcome.disabled)),
        )
        layout = self.layout or layout_of(name, welcome.last_command_m.size)
        return replace(self, layout=layout, stroke_m=stroke_m, limits=limits)

    def info(self, model: str, serial: str, *, simulated: bool) -> DMInfo:
        """Identity and geometry; NaN for a stroke that is not known yet."""
        stroke_m = math.nan if self.stroke_m is None else self.stroke_m
        return mirror_info(self.layout, self.pitch_m, stroke_m, model, serial, simulated=simulated)


def require_identity(name: str, expected: ExpectedMirror, welcome: Welcome) -> None:
    """Require the expected mirror; an observer needs no further checks."""
    n_act = n_actuators(expected.layout)
    if welcome.last_command_m.size != n_act:
        raise DeviceError(
            name,
            f"has {welcome.last_command_m.size} actuators, but the layout {shorten(expected.layout)!r} has "
            f"{n_act}; correct layout or the address",
        )
    if expected.serial != welcome.serial:
        raise DeviceError(
            name,
            f"is {welcome.serial!r}, not {expected.serial!r}; correct serial or the address",
        )


def require_compatible(name: str, limits: MirrorLimits, stroke_m: float, welcome: Welcome) -> tuple[int, ...]:
    """Require limits of ours that lie within the mirror's own.

    Returns
    -------
    tuple of int
        Configured actuators to be taken out of service that still are in service; empty: none.

    Raises
    ------
    SettingRejected
        A limit of ours exceeds the mirror's, or actuators are out of service that the configuration
        counts on.
    """
    slew = limits.max_slew if limits.max_slew is not None else 2 * limits.max_stroke
    for key, configured, reported in (
        ("max_stroke", limits.max_stroke, welcome.max_command_m / stroke_m),
        ("max_slew", slew, welcome.max_step_m / stroke_m),
    ):
        if configured > reported * (1 + _ROUNDING):
            raise SettingRejected(
                name,
                f"limits.{key} is {configured:g}; the mirror itself skips commands beyond "
                f"{reported:.4g}: set it to that or less",
            )
    unexpected = sorted(set(welcome.disabled) - set(limits.disabled))
    if unexpected:
        all_disabled = sorted({*welcome.disabled, *limits.disabled})
        raise SettingRejected(
            name,
            f"actuators {unexpected} are out of service that the configuration counts on; set "
            f"limits.disabled = {all_disabled}",
        )
    return () if set(limits.disabled) == set(welcome.disabled) else limits.disabled


log = logging.getLogger(__name__)

#: Interval between two checks of a state transition, seconds.
_STEP_POLL_S = 0.02


class AsmMirror(AdaptiveSecondary):
    """An adaptive secondary behind ESCAPE's own link, or behind another by another codec.

    Every command is acknowledged with measured positions before the next one leaves: nothing queues.
    While nothing else is sent, a thread sends heartbeats for the mirror's watchdog. A broken link is
    reported by the call that meets it and reconnected in the background; nothing is sent again
    automatically, and the mirror keeps its state.

    Parameters
    ----------
    serial
        Serial number; a mirror with another one is refused.
    name
        Name in messages.
    layout, pitch_m, stroke_m, limits
        As in :class:`ExpectedMirror`; by default as the mirror reports. A table of limits has those that
        differ from the cautious ones.
    make_codec
        Makes the codec of a connection; the observatory's own goes here.
    emulator
        Started before and stopped after, instead of the configured address.
    **options
        Fields of :class:`~escape_drivers.asm.options.AsmOptions`, such as ``host``.

    Raises
    ------
    ConfigError
        The serial number is missing, or geometry, limits or an option is wrong.
    """

    def __init__(
        self,
        serial: str | int,
        *,
        name: str = "asm",
        layout: str = "",
        pitch_m: float = 1.0,
        stroke_m: float | None = None,
        limits: MirrorLimits | Mapping[str, Any] | None = None,
        make_codec: Callable[[], m.Codec] = AsmCodec,
        emulator: Emulator | None = None,
        **options: Any,
    ) -> None:
        self._options = parse_options(AsmOptions, name, options, keywords_of(type(self)))
        given_limits = None if limits is None else parse_limits(name, limits)
        super().__init__(name, given_limits or CAUTIOUS_LIMITS, lift=self._options.lift)
        layout = require_geometry(name, layout, pitch_m, stroke_m)
        self._expected = ExpectedMirror(
            require_serial("serial", serial), layout, pitch_m, stroke_m, given_limits
        )
        self._make_codec, self._emulator = make_codec, emulator
        self._is_on_twin = emulator is not None
        if emulator is None and self._options.host == EMULATOR:
            self._emulator = emulator_factory("asm")(EmulatorRequest(port=0))
        self._link = self._make_link(m.Role.CONTROL)
        model = "adaptive secondary over TCP"
        self._info = self._expected.info(model, self._expected.serial, simulated=False) if layout else None
        self._metres, self._stroke_m = np.empty(0), math.nan
        self._heartbeat: BackgroundThread | None = None
        self._last_state, self._fault_text = ShellState.OFF, ""
        self._initial_shape: NDArray[np.float64] | None = None
        self._last_attempt_s = 0.0
        self._last_warning = ""
        self._consecutive_skips = 0

    @classmethod
    def from_section(cls, section: MirrorConfig, context: DeviceContext) -> Self:
        """The mirror of ``[devices.dm]``; raises ``ConfigError`` as the class does."""
        options = section_options(AsmOptions, context.name, section)
        emulator = None
        if options["host"] == EMULATOR:
            request = EmulatorRequest(port=0, shared=context.shared, config=context.system)
            emulator = emulator_factory("asm")(request)
        return cls(**mirror_settings(context.name, section), emulator=emulator, **options)

    # ------------------------------------------------------------------ identity
    @property
    def info(self) -> DMInfo:
        """Identity and geometry; ``NotOpen`` before a connection if no layout was given."""
        if self._info is None:
            raise NotOpen(self.name, "its number of actuators is known once it is open; call open() first")
        return self._info

    @property
    def applies_twin_section(self) -> bool:
        """True with the emulator of the same process, whose actuators are those of the simulated bench."""
        return self._is_on_twin

    def parameter(self, key: str) -> float:
        """One of the mirror's own parameters, such as ``telemetry_hz``; ``DeviceError`` if it has none."""
        return self._parameter(m.GetParam(key))

    def set_parameter(self, key: str, value: float) -> float:
        """Set one of the mirror's own parameters; returns the value in force, ``DeviceError`` if refused."""
        return self._parameter(m.SetParam(key, value))

    def _parameter(self, request: m.GetParam | m.SetParam) -> float:
        self.require_open()
        with self._lock:
            return self._link.request(request, m.Param).value

    # ------------------------------------------------------------------ connection
    def _make_link(self, role: m.Role) -> AsmLink:
        o = self._options
        return AsmLink(
            self.name, (o.host, o.port), role, self._make_codec,
            connect_s=o.connect_s, reply_s=o.reply_s, on_unsolicited=self._on_unsolicited,
        )  # fmt: skip

    def _open(self) -> None:
        self._link.address = self._start_address()
        self._apply_welcome(self._connect(self._link))
        period_s = self._options.heartbeat_s / 4
        self._heartbeat = BackgroundThread(f"{self.name} heartbeat", self._send_heartbeat_if_due, period_s)
        self._heartbeat.start()

    def _connect(self, link: AsmLink) -> m.Welcome:
        """Connect; the mirror's report has the disabled actuators in the numbering of the layout."""
        welcome = link.connect()
        return replace(welcome, disabled=self._numbers_in_layout(welcome.disabled))

    def _apply_welcome(self, welcome: m.Welcome) -> None:
        """Adopt identity and state of the mirror at the beginning of a connection."""
        expected = self._update_info(welcome)
        assert expected.limits is not None
        assert expected.stroke_m is not None
        self.limits, self._stroke_m = expected.limits, expected.stroke_m
        if self._metres.size != n_actuators(expected.layout):
            self._metres = np.empty(n_actuators(expected.layout))
        disabled = require_compatible(self.name, self.limits, self._stroke_m, welcome)
        if disabled:
            in_hardware = self._numbers_in_hardware(disabled)
            self._link.request(m.SetDisabled(in_hardware, "limits.disabled"), m.Done)
        self._last_state, self._consecutive_skips = welcome.state, 0
        is_floating = welcome.state in (ShellState.SET, ShellState.RUNNING)
        self._initial_shape = (
            welcome.last_command_m.astype(np.float64) / self._stroke_m if is_floating else None
        )

    def _update_info(self, welcome: Welcome) -> ExpectedMirror:
        """Require the expected mirror; what was left open is as it reports."""
        expected = self._expected.completed(self.name, welcome)
        require_identity(self.name, expected, welcome)
        model = f"adaptive secondary over TCP, protocol {welcome.version}{', emulated' * welcome.simulated}"
        self._info = expected.info(model, welcome.serial, simulated=welcome.simulated)
        return expected

    def _close(self) -> None:
        if self._heartbeat is not None:
            # A heartbeat in progress ends with its answer or its time-out.
            self._heartbeat.stop(self._options.connect_s + 2 * self._options.reply_s)
            self._heartbeat = None
        self._link.disconnect("it was closed")
        if self._emulator is not None:
            self._emulator.stop()

    def _release_after_failed_open(self) -> None:
        self._close()

    def _present_shape(self) -> NDArray[np.float64] | None:
        return self._initial_shape

    # ------------------------------------------------------------------ heartbeats
    def _send_heartbeat_if_due(self) -> None:
        """Send a heartbeat when nothing else was sent for a while; restore a lost link."""
        if self._link.is_up and time.monotonic() - self._link.last_reply_s < self._options.heartbeat_s:
            return
        # A thread that holds the lock is exchanging messages, which also resets the watchdog.
        if self._lock.acquire(blocking=False):
            try:
                self._send_heartbeat()
            finally:
                self._lock.release()

    def _send_heartbeat(self) -> None:
        before = self._last_state
        try:
            if self._link.is_up:
                self._state()
            elif self.is_open and time.monotonic() > self._retry_at_s():
                self._reconnect()
        except DeviceError as error:
            # There is no caller in this thread; the next call raises the error.
            if str(error) != self._last_warning:
                log.warning("%s", error)
            self._last_warning = str(error)
        else:
            self._last_warning = ""
            if self._last_state is not before:
                log.warning(
                    "%s: changed from %s to %s without a command %s",
                    self.name, before, self._last_state, self._fault_text,
                )  # fmt: skip

    def _retry_at_s(self) -> float:
        """When a lost connection is tried again, on this computer's monotonic clock."""
        return max(self._last_attempt_s, self._link.last_reply_s) + self._options.retry_s

    def _reconnect(self) -> None:
        """Restore a lost connection; the mirror keeps its state, and nothing is sent again."""
        self._last_attempt_s = time.monotonic()
        welcome = self._connect(self._link)
        try:
            self._apply_welcome(welcome)
        except DeviceError as error:
            self._link.disconnect(f"it came back, but {error.args[1]}")
            raise
        # What became of the last command before the link broke is not known; its shape is.
        self._guard_when_open().reset(self._present_in_layout())
        log.warning(
            "%s: the link is back; the mirror is %s, nothing was sent again", self.name, self._last_state
        )

    def _on_unsolicited(self, message: m.Reply) -> None:
        if isinstance(message, m.FaultReport):
            self._last_state, self._fault_text = message.state, message.text
            log.error("%s: fault: %s", self.name, message.text)

    # ------------------------------------------------------------------ questions
    def _state(self) -> ShellState:
        with self._lock:
            return self._record_ack(self._link.request(m.Heartbeat(), m.Ack))

    def _record_ack(self, ack: m.Ack) -> ShellState:
        if ack.positions.size != self._metres.size:
            raise DeviceError(
                self.name, f"reported {ack.positions.size} positions for {self._metres.size} actuators"
            )
        self._last_state = ack.state
        return ack.state

    def _known_state(self) -> ShellState:
        return self._last_state

    def _measure_positions(self) -> NDArray[np.float64]:
        with self._lock:
            ack = self._link.request(m.Heartbeat(), m.Ack)
            self._record_ack(ack)
        return ack.positions.astype(np.float64) / self._stroke_m

    def _health(self) -> ShellHealth:
        with self._lock:
            return _to_shell_health(self._link.request(m.GetHealth(), m.HealthReport))

    def _observe_health(self) -> ShellHealth:
        link = self._make_link(m.Role.TELEMETRY)
        link.address = self._start_address()
        try:
            self._update_info(self._connect(link))
            return _to_shell_health(link.request(m.GetHealth(), m.HealthReport))
        finally:
            link.disconnect("status query only")
            if self._emulator is not None:
                self._emulator.stop()

    def _start_address(self) -> tuple[str, int]:
        """Where to connect; starts the emulator if there is one."""
        if self._emulator is None:
            return self._options.host, self._options.port
        host, _, port = self._emulator.start().removeprefix("tcp ").rpartition(":")
        return host, int(port)

    # ------------------------------------------------------------------ what moves
    def _step(self, state: ShellState) -> None:
        if state is ShellState.SET:
            self._consecutive_skips = 0
        self._link.request(m.SetState(state), m.Done)
        deadline = time.monotonic() + self._options.step_s
        while (now := self._state()) is not state and now is not ShellState.FAULT:
            if time.monotonic() > deadline:
                raise DeviceError(
                    self.name, f"is {now} and not {state} after {self._options.step_s:g} s; see its health"
                )
            time.sleep(_STEP_POLL_S)

    def _recover(self) -> None:
        self._link.request(m.Recover(), m.Done)
        self._fault_text = ""

    def _send_to_shell(self, command: NDArray[np.float64]) -> NDArray[np.float64] | None:
        np.multiply(command, self._stroke_m, out=self._metres)
        try:
            ack = self._link.command(self._metres)
        except MirrorRefusal as refusal:
            raise self._device_error_for(refusal) from refusal
        self._record_ack(ack)
        if ack.result is m.Result.APPLIED:
            self._consecutive_skips = 0
            return None
        if ack.result is not m.Result.SKIPPED:
            raise DeviceError(
                self.name,
                f"changed a command ({ack.result.name.lower()}, {ack.clipped} actuators): "
                "some were disabled, "
                "or its limits became tighter; open it again to see what to configure",
            )
        self._consecutive_skips += 1
        if self._consecutive_skips >= self._options.max_skips:
            raise DeviceError(
                self.name,
                f"skipped {self._consecutive_skips} commands in a row and kept its last shape; they exceed "
                f"limits of its own: lower limits.max_slew, and see its health",
            )
        return self._to_hardware(self._guard_when_open().last)

    def _device_error_for(self, refusal: MirrorRefusal) -> DeviceError:
        """The error for a refused command, in the words of every adaptive secondary."""
        nak = refusal.nak
        self._last_state = nak.state
        if nak.code is m.Result.PANIC:
            self._fault_text = nak.text
            return self._fault_error(nak.text)
        if nak.code is m.Result.WRONG_STATE:
            return self._not_running_error(nak.state, f" ({nak.text})")
        return refusal


def _to_shell_health(health: m.HealthReport) -> ShellHealth:
    return ShellHealth(
        health.time_ns, health.state, health.gap_m, health.current_a, health.temperature_c, health.skipped,
        health.fault, health.contaminated, health.owner,
    )  # fmt: skip


#: Name of the entry point in version 0.1.0, which an environment installed then still has.
make_asm = AsmMirror
