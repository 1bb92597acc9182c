"""Deformable mirrors: one checked way in, for twins and metal alike."""

from __future__ import annotations

import abc
from dataclasses import dataclass
from typing import final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from escape_hw.api.device import Device
from escape_hw.errors import CommandRejected
from escape_hw.safety.guard import CommandGuard, GuardReport
from escape_hw.safety.limits import MirrorLimits, neighbour_pairs


@dataclass(frozen=True, slots=True, eq=False)
class DMInfo:
    """Identity and geometry of a deformable mirror.

    Parameters
    ----------
    layout
        Boolean map ``(rows, columns)``, true where an actuator stands (numbered row by row), or
        ``None`` when the actuators do not stand on a grid.
    positions_m
        Actuator positions ``(n_act, 2)`` as (x, y) in metres on the mirror, from its centre.
    stroke_m
        Metres of surface at the actuator for a command of 1.
    """

    model: str
    serial: str
    n_act: int
    layout: NDArray[np.bool_] | None
    positions_m: NDArray[np.float64]
    stroke_m: float
    simulated: bool


@dataclass(frozen=True, slots=True, eq=False)
class SendReport:
    """What became of one command: the shape sent, when, and what the guard did to it."""

    sent: NDArray[np.float64]
    sent_ns: int
    guard: GuardReport


class DeformableMirror(Device):
    """A deformable mirror. Commands are float64 ``(n_act,)``, fractions of full stroke.

    ``send`` is final: every command passes the :class:`~escape_hw.safety.guard.CommandGuard`.
    Drivers fill in ``_open``, ``_close``, ``_send`` and set ``info`` in ``_open``.
    """

    #: Largest step of the ramp that ``flatten`` uses, fraction of full stroke.
    RAMP_STEP = 0.1

    def __init__(self, name: str, limits: MirrorLimits) -> None:
        super().__init__(name)
        self.limits = limits
        self.sent_count = 0
        self.clipped_count = 0
        self.rejected_count = 0
        self._flat: NDArray[np.float64] | None = None
        self._guard: CommandGuard | None = None

    @property
    @abc.abstractmethod
    def info(self) -> DMInfo:
        """Identity and geometry; available once open."""

    @property
    def shape(self) -> NDArray[np.float64]:
        """The last command sent, ``(n_act,)`` (a copy)."""
        return self._checked().last.copy()

    @property
    def flat(self) -> NDArray[np.float64]:
        """The command that ``flatten`` ends at, ``(n_act,)``; zeros unless set."""
        n_act = self.info.n_act
        return np.zeros(n_act) if self._flat is None else self._flat.copy()

    @final
    def set_flat(self, command: ArrayLike) -> None:
        """Choose the command that stands for a flat mirror.

        Raises
        ------
        CommandRejected
            The command is malformed or breaks a limit by itself.
        """
        guard = self._checked()
        wanted = guard.validate(command)
        if np.abs(wanted).max(initial=0.0) > self.limits.max_stroke:
            raise CommandRejected(self.name, f"flat exceeds max_stroke = {self.limits.max_stroke}")
        self._flat = wanted

    @final
    def send(self, command: ArrayLike) -> SendReport:
        """Send one shape through the guard.

        Parameters
        ----------
        command
            ``(n_act,)`` real numbers, fractions of full stroke.

        Returns
        -------
        SendReport
            The shape that was really sent and what the guard changed.

        Raises
        ------
        CommandRejected
            Malformed or not finite: nothing is sent and the last shape stays.
        NotOpen, DeviceError
            The mirror is not connected or the transfer failed.
        """
        guard = self._checked()
        previous = guard.last
        try:
            safe, report = guard(command)
        except CommandRejected:
            self.rejected_count += 1
            raise
        try:
            self._send(safe)
        except BaseException:
            guard.last = previous
            raise
        self.sent_count += 1
        self.clipped_count += report.clipped
        return SendReport(safe, self.now_ns(), report)

    @final
    def flatten(self) -> None:
        """Ramp to the flat shape in steps of at most :data:`RAMP_STEP`; legal whenever open."""
        guard = self._checked()
        target = self.flat
        step = min(self.RAMP_STEP, self.limits.max_slew or 1.0)
        for _ in range(1 + int(np.ceil(4.0 / step))):
            move = target - guard.last
            largest = float(np.abs(move).max(initial=0.0))
            if largest == 0.0:
                break
            self.send(target if largest <= step else guard.last + move * (step / largest))
        if not guard.last.any() and self.sent_count == 0:
            self.send(target)

    def _checked(self) -> CommandGuard:
        self.require_open()
        if self._guard is None:
            raise CommandRejected(self.name, "has no guard; this is a defect of its driver")
        return self._guard

    def _after_open(self) -> None:
        info = self.info
        pairs = None if info.layout is None else neighbour_pairs(info.layout)
        self._guard = CommandGuard(self.name, info.n_act, self.limits, pairs)

    def _before_close(self) -> None:
        self.flatten()

    @abc.abstractmethod
    def _send(self, command: NDArray[np.float64]) -> None:
        """Transfer a guarded, C-contiguous float64 command ``(n_act,)``."""
