"""Adaptive secondary mirrors: a thin shell that floats, knows where it is, and may fall asleep."""

from __future__ import annotations

import abc
import enum
from dataclasses import dataclass
from typing import final

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.mirror import DeformableMirror
from escape_hw.errors import DeviceError
from escape_hw.safety.limits import MirrorLimits


class ShellState(enum.StrEnum):
    """Where an adaptive secondary stands, from off to running; a fault is latched."""

    #: Coils without power.
    OFF = "off"
    #: Power on, the shell lies on its reference body.
    RESTED = "rested"
    #: The shell floats, flat.
    SET = "set"
    #: The shell floats and follows commands.
    RUNNING = "running"
    #: Stopped by itself; stays so until somebody asks for recovery.
    FAULT = "fault"


#: The states that ``go_to`` moves through, one after the other.
STATE_ORDER = (ShellState.OFF, ShellState.RESTED, ShellState.SET, ShellState.RUNNING)


@dataclass(frozen=True, slots=True)
class ShellHealth:
    """What the mirror says of itself.

    Parameters
    ----------
    time_ns
        When, on the device's clock.
    state
        Where it stands.
    gap_m
        Mean gap between shell and reference body in metres.
    current_a
        Largest coil current in amperes.
    temperature_c
        Highest temperature in degrees Celsius.
    skipped
        Commands that the mirror itself did not execute since it was opened.
    fault
        Why it is in ``FAULT``, empty otherwise.
    contaminated
        Actuators that the mirror itself took out of service.
    owner
        Who controls it, where it can tell.
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


class AdaptiveSecondary(DeformableMirror):
    """A deformable mirror with positions, health and states of its own.

    Commands are followed in the state ``RUNNING`` only. ``open`` leads there unless ``lift`` is
    false; ``close`` flattens and rests the shell. A fault is latched: nothing but :meth:`recover`
    ends it, and no command, no closing and no opening does. Drivers fill in ``_state``, ``_step``,
    ``_recover``, ``_measure_positions``, ``_health`` and, where it can be watched without control, ``_observe_health``
    beside those of a mirror.

    Parameters
    ----------
    name, limits
        As for every mirror.
    lift
        Lead the mirror to ``RUNNING`` when it is opened.

    Attributes
    ----------
    lift
        As above; may be changed while it is closed.
    leave_set
        ``close`` leaves a floating shell afloat and flat instead of resting it.
    """

    def __init__(self, name: str, limits: MirrorLimits, *, lift: bool = True) -> None:
        super().__init__(name, limits)
        self.lift = lift
        self.leave_set = False

    @property
    def state(self) -> ShellState:
        """Where the mirror stands.

        Raises
        ------
        NotOpen
            The mirror is not connected.
        """
        self.require_open()
        return self._state()

    @property
    def health(self) -> ShellHealth:
        """What the mirror says of itself, now.

        Raises
        ------
        NotOpen, DeviceError
            The mirror is not connected, or does not answer.
        """
        self.require_open()
        return self._health()

    @final
    def observe_health(self) -> ShellHealth:
        """What the mirror says of itself, without taking control of it; works open or not.

        Raises
        ------
        DeviceError
            It does not answer, or can only be watched by who controls it.
        """
        return self._health() if self.is_open else self._observe_health()

    @final
    def measured_positions(self) -> NDArray[np.float64]:
        """Where the actuators really are ``(n_act,)``, fractions of full stroke; NaN where unreadable.

        Raises
        ------
        NotOpen, DeviceError
            The mirror is not connected, or did not deliver a position for each actuator.
        """
        self.require_open()
        places = np.array(self._measure_positions(), dtype=np.float64)
        if places.shape != (self.info.n_act,):
            raise DeviceError(
                self.name, f"reported positions of shape {places.shape} for {self.info.n_act} actuators"
            )
        return places

    @final
    def go_to(self, state: ShellState) -> None:
        """Lead the mirror to a state, one step of the ladder after the other.

        Raises
        ------
        NotOpen
            The mirror is not connected.
        DeviceError
            A fault is latched, or the mirror did not follow.
        ValueError
            ``FAULT`` is asked for.
        """
        if state is ShellState.FAULT:
            raise ValueError("nobody goes to a fault; choose off, rested, set or running")
        with self._lock:
            self.require_open()
            while (now := self._healthy_state()) is not state:
                if now is ShellState.RUNNING:
                    self.flatten()
                up = STATE_ORDER.index(state) > STATE_ORDER.index(now)
                next_state = STATE_ORDER[STATE_ORDER.index(now) + (1 if up else -1)]
                self._step(next_state)
                if self._state() is not next_state:
                    raise DeviceError(
                        self.name,
                        f"is {self._state()}, not {next_state}, after a step from {now}; see its health",
                    )
                if next_state is ShellState.SET:
                    # A shell that floats anew is flat, whatever was sent before it was rested.
                    self._guard_when_open().reset(self.flat)

    @final
    def recover(self) -> None:
        """End a fault: the shell is at rest afterwards. Does nothing when there is none.

        Raises
        ------
        NotOpen, DeviceError
            The mirror is not connected, or the fault persists.
        """
        with self._lock:
            self.require_open()
            if self._state() is not ShellState.FAULT:
                return
            self._recover()
            if self._state() is ShellState.FAULT:
                raise DeviceError(self.name, f"the fault persists: {self._health().fault}")

    def _healthy_state(self) -> ShellState:
        state = self._state()
        if state is ShellState.FAULT:
            raise self._fault_error(self._health().fault)
        return state

    def _fault_error(self, fault: str) -> DeviceError:
        """The error of a mirror that stopped itself."""
        return DeviceError(self.name, f"fault latched: {fault}; see to the cause, then call recover()")

    def _not_running_error(self, state: ShellState, why: str = "") -> DeviceError:
        """The error of a mirror that is not running."""
        return DeviceError(self.name, f"is {state} and follows no commands{why}; call go(ShellState.RUNNING)")

    def _accepts_commands(self) -> bool:
        return self._state() is ShellState.RUNNING

    def _after_open(self) -> None:
        super()._after_open()
        if self.lift:
            self.go_to(ShellState.RUNNING)

    def _before_close(self) -> None:
        end = ShellState.SET if self.leave_set else ShellState.RESTED
        try:
            super()._before_close()
        except DeviceError as error:
            # A shell that cannot be flattened is better at rest than afloat with nobody there.
            self._clean_up(lambda: self._step_down(end), error)
            raise
        if self._state() in (ShellState.SET, ShellState.RUNNING):
            self.go_to(end)

    def _step_down(self, end: ShellState) -> None:
        """Step down to a state without asking for a shape."""
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
        """Where the mirror stood when it last spoke: asked before every command, so it must be cheap."""
        return self._state()

    def _observe_health(self) -> ShellHealth:
        """Ask for the health over a way that needs no control; the mirror is not open."""
        raise DeviceError(self.name, "tells its health only to who controls it; open it first")

    @abc.abstractmethod
    def _send_to_shell(self, command: NDArray[np.float64]) -> NDArray[np.float64] | None:
        """Transfer a guarded command ``(n_act,)`` to the running mirror.

        Returns
        -------
        ndarray or None
            The shape it has now where it refused this one and kept another; ``None``: as commanded.
        """

    @abc.abstractmethod
    def _state(self) -> ShellState:
        """Where the mirror stands."""

    @abc.abstractmethod
    def _step(self, state: ShellState) -> None:
        """Go one step of the ladder, up or down, to ``state``."""

    @abc.abstractmethod
    def _recover(self) -> None:
        """End a fault; leads to ``RESTED`` or ``OFF``."""

    @abc.abstractmethod
    def _measure_positions(self) -> NDArray[np.float64]:
        """Positions ``(n_act,)``, fractions of full stroke."""

    @abc.abstractmethod
    def _health(self) -> ShellHealth:
        """Ask the mirror for its health."""
