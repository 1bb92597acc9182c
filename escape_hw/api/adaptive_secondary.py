"""Interface of adaptive secondary mirrors: a floating thin shell with position sensors and states."""

from __future__ import annotations

import abc
import enum
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import final

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.mirror import DeformableMirror
from escape_hw.deprecation import renamed_members
from escape_hw.errors import DeviceError
from escape_hw.safety.limits import MirrorLimits


class ShellState(enum.StrEnum):
    """State of an adaptive secondary. ``FAULT`` is latched."""

    #: Coils without power.
    OFF = "off"
    #: Coils powered, shell on its reference body.
    RESTED = "rested"
    #: Shell floating and flat.
    SET = "set"
    #: Shell floating and following commands.
    RUNNING = "running"
    #: Stopped by the mirror itself until :meth:`AdaptiveSecondary.recover` is called.
    FAULT = "fault"


#: Order of the states that ``go_to`` steps through.
STATE_ORDER = (ShellState.OFF, ShellState.RESTED, ShellState.SET, ShellState.RUNNING)


@dataclass(frozen=True, slots=True)
class ShellHealth:
    """Health record of an adaptive secondary.

    Parameters
    ----------
    time_ns
        Time on the device's clock.
    state
        State of the mirror.
    gap_m
        Mean gap between shell and reference body in metres.
    current_a
        Largest coil current in amperes.
    temperature_c
        Highest temperature in degrees Celsius.
    skipped
        Number of commands since ``open`` that the mirror did not execute.
    fault
        Cause of a fault, empty otherwise.
    contaminated
        Actuators that the mirror has disabled, in the numbering of the layout; drivers report theirs.
    owner
        Client that has control, if the mirror reports it.
    """

    time_ns: int
    state: ShellState
    gap_m: float
    current_a: float
    temperature_c: float
    skipped: int
    fault: str = ""
    contaminated: tuple[int, ...] = ()
    owner: str = ""


@renamed_members(go="go_to", glance="observe_health")
class AdaptiveSecondary(DeformableMirror):
    """A deformable mirror with measured positions, a health record and states.

    The mirror follows commands in the state ``RUNNING`` only. ``open`` goes to that state unless ``lift``
    is false; ``close`` flattens and rests the shell. Only :meth:`recover` ends a fault. In addition to the
    hooks of a mirror, drivers implement ``_state``, ``_step``, ``_recover``, ``_measure_positions``,
    ``_health`` and, if the mirror can be observed without control, ``_observe_health``.

    Every method raises :class:`NotOpen` if the mirror is not connected, and :class:`DeviceError` if it does
    not answer.

    Parameters
    ----------
    name, limits
        As for :class:`~escape_hw.api.mirror.DeformableMirror`.
    lift
        Go to ``RUNNING`` on opening.

    Attributes
    ----------
    lift
        As above; may be changed while the mirror is closed.
    leave_set
        ``close`` leaves a floating shell floating and flat instead of resting it.
    """

    def __init__(self, name: str, limits: MirrorLimits, *, lift: bool = True) -> None:
        super().__init__(name, limits)
        self.lift = lift
        self.leave_set = False

    @property
    def state(self) -> ShellState:
        """Present state."""
        self.require_open()
        return self._present_state()

    @property
    def health(self) -> ShellHealth:
        """Present health record."""
        self.require_open()
        return self._present_health()

    @final
    def observe_health(self) -> ShellHealth:
        """Health record without taking control of the mirror; works open or closed.

        Raises
        ------
        DeviceError
            The mirror reports its health only to the client in control.
        """
        return self._present_health() if self.is_open else self._in_layout(self._observe_health)

    @final
    def measured_positions(self) -> NDArray[np.float64]:
        """Measured actuator positions ``(n_act,)``, fractions of full stroke; NaN where unreadable."""
        self.require_open()
        with self._driver_calls:
            positions = np.array(self._measure_positions(), dtype=np.float64)
        if positions.shape != (self.info.n_act,):
            raise DeviceError(
                self.name, f"reported positions of shape {positions.shape} for {self.info.n_act} actuators"
            )
        return self._from_hardware(positions).copy()

    @final
    def go_to(self, state: ShellState) -> None:
        """Go to a state, stepping through the states in between (:data:`STATE_ORDER`).

        Raises
        ------
        DeviceError
            A fault is latched, or the mirror did not reach a state.
        ValueError
            ``state`` is ``FAULT``.
        """
        if state is ShellState.FAULT:
            raise ValueError("state is fault, which cannot be requested; choose off, rested, set or running")
        with self._lock:
            self.require_open()
            while (now := self._healthy_state()) is not state:
                if now is ShellState.RUNNING:
                    self.flatten()
                up = STATE_ORDER.index(state) > STATE_ORDER.index(now)
                next_state = STATE_ORDER[STATE_ORDER.index(now) + (1 if up else -1)]
                with self._driver_calls:
                    self._step(next_state)
                if (reached := self._present_state()) is not next_state:
                    raise DeviceError(
                        self.name,
                        f"is {reached}, not {next_state}, after a step from {now}; see its health",
                    )
                if next_state is ShellState.SET:
                    # Lifting the shell makes it flat, regardless of the last command.
                    self._guard_when_open().reset(self.flat)

    @final
    def recover(self) -> None:
        """End a fault; the shell is at rest afterwards. Does nothing without a fault.

        Raises
        ------
        DeviceError
            The fault persists.
        """
        with self._lock:
            self.require_open()
            if self._present_state() is not ShellState.FAULT:
                return
            with self._driver_calls:
                self._recover()
            if self._present_state() is ShellState.FAULT:
                raise DeviceError(self.name, f"the fault persists: {self._present_health().fault}")

    def _present_state(self) -> ShellState:
        with self._driver_calls:
            return self._require_kind(self._state(), ShellState, "its state")

    def _present_health(self) -> ShellHealth:
        return self._in_layout(self._health)

    def _in_layout(self, read: Callable[[], ShellHealth]) -> ShellHealth:
        """A health record of the hardware with the numbering of the layout."""
        with self._driver_calls:
            health = self._require_kind(read(), ShellHealth, "its health record")
            return replace(health, contaminated=self._numbers_in_layout(health.contaminated))

    def _healthy_state(self) -> ShellState:
        state = self._present_state()
        if state is ShellState.FAULT:
            raise self._fault_error(self._present_health().fault)
        return state

    def _fault_error(self, fault: str) -> DeviceError:
        return DeviceError(self.name, f"fault latched: {fault}; remove the cause, then call recover()")

    def _not_running_error(self, state: ShellState, why: str = "") -> DeviceError:
        return DeviceError(
            self.name, f"is {state} and follows no commands{why}; call go_to(ShellState.RUNNING)"
        )

    def _accepts_commands(self) -> bool:
        return self._present_state() is ShellState.RUNNING

    def _after_open(self) -> None:
        super()._after_open()
        if self.lift:
            self.go_to(ShellState.RUNNING)

    def _before_close(self) -> None:
        end = ShellState.SET if self.leave_set else ShellState.RESTED
        try:
            super()._before_close()
        except DeviceError as error:
            # An unattended shell that cannot be flattened must not stay floating.
            self._clean_up(lambda: self._step_down(end), error)
            raise
        if self._present_state() in (ShellState.SET, ShellState.RUNNING):
            self.go_to(end)

    def _step_down(self, end: ShellState) -> None:
        """Step down to a state without flattening."""
        for state in reversed(STATE_ORDER[STATE_ORDER.index(end) : -1]):
            if self._state() in STATE_ORDER[STATE_ORDER.index(state) + 1 :]:
                self._step(state)

    @final
    def _send(self, command: NDArray[np.float64]) -> NDArray[np.float64] | None:
        state = self._known_state()
        if state is ShellState.FAULT:
            self._healthy_state()
        if state is not ShellState.RUNNING:
            raise self._not_running_error(state)
        return self._send_to_shell(command)

    def _known_state(self) -> ShellState:
        """Last reported state; called before every command, so it must be fast."""
        return self._state()

    def _observe_health(self) -> ShellHealth:
        """Read the health record without control; called while the mirror is not open."""
        raise DeviceError(self.name, "reports its health only to the client in control; open it first")

    @abc.abstractmethod
    def _send_to_shell(self, command: NDArray[np.float64]) -> NDArray[np.float64] | None:
        """Transfer a guarded command ``(n_act,)`` to the running mirror.

        Returns
        -------
        ndarray or None
            The present shape if the mirror skipped the command; ``None`` if it executed it.
        """

    @abc.abstractmethod
    def _state(self) -> ShellState:
        """Present state."""

    @abc.abstractmethod
    def _step(self, state: ShellState) -> None:
        """Go to ``state``, which is adjacent to the present state in :data:`STATE_ORDER`."""

    @abc.abstractmethod
    def _recover(self) -> None:
        """End a fault; the state is ``RESTED`` or ``OFF`` afterwards."""

    @abc.abstractmethod
    def _measure_positions(self) -> NDArray[np.float64]:
        """Measured positions ``(n_act,)``, fractions of full stroke."""

    @abc.abstractmethod
    def _health(self) -> ShellHealth:
        """Read the health record."""
