"""Interface of deformable mirrors; the guard limits every command, of twins and hardware."""

from __future__ import annotations

import abc
import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Literal, final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from escape_hw.api.device import Device
from escape_hw.api.representation import describe_value, short_repr
from escape_hw.deprecation import renamed_members
from escape_hw.errors import CommandRejected, DeviceError, SettingRejected
from escape_hw.safety.guard import CommandGuard, GuardReport, load_compiled_check
from escape_hw.safety.limits import MirrorLimits, all_pairs, nearest_pairs, neighbour_pairs


@dataclass(frozen=True, slots=True, eq=False)
class DMInfo:
    """Identity and geometry of a deformable mirror.

    Parameters
    ----------
    layout
        Boolean map ``(rows, columns)``, true where there is an actuator (numbered in row-major order), or
        ``None`` if the actuators are not on a grid.
    positions_m
        Actuator positions ``(n_act, 2)`` as (x, y) in metres on the mirror, from its centre; x increases
        along the columns of the layout, y along its rows. All NaN where the arrangement is not known: the
        guard then takes any two actuators for neighbours.
    stroke_m
        Metres of surface at the actuator for a command of 1; NaN if it is not known.
    """

    model: str
    serial: str
    n_act: int
    layout: NDArray[np.bool_] | None
    positions_m: NDArray[np.float64]
    stroke_m: float
    simulated: bool
    __repr__ = short_repr


@dataclass(frozen=True, slots=True, eq=False)
class SendReport:
    """Result of one command.

    Parameters
    ----------
    sent
        Present shape of the mirror ``(n_act,)``, read-only.
    sent_ns
        Time on the mirror's clock, nanoseconds.
    guard
        Changes made by the guard.
    skipped
        True if the mirror did not execute the command and kept ``sent``, its last shape.
    """

    sent: NDArray[np.float64]
    sent_ns: int
    guard: GuardReport
    skipped: bool = False
    __repr__ = short_repr


@renamed_members(
    allowed_share="largest_legal_scale", obeys="is_legal", tap="callback", flattened_count="flatten_count"
)
class DeformableMirror(Device):
    """A deformable mirror. Commands are float64 ``(n_act,)``, fractions of full stroke.

    ``send`` is final: every command passes the :class:`~escape_hw.safety.guard.CommandGuard`.
    Drivers implement ``_open``, ``_close``, ``_send`` and set ``info`` in ``_open``. Closing first ramps
    to the flat shape. Every method raises :class:`NotOpen` if the mirror is not connected.

    Attributes
    ----------
    sent_count, clipped_count, rejected_count, flatten_count
        Numbers since ``open`` of commands sent, actuator commands clipped, commands rejected, and calls of
        ``flatten``.
    callback
        Called with every shape sent, see :class:`~escape_hw.api.callbacks.Callbacks`.
    order
        Number in the layout of each actuator of the hardware ``(n_act,)`` (``devices.dm.order``); ``None``:
        the hardware counts as the layout does. Set before ``open``. Commands, limits and shapes are in the
        numbering of the layout everywhere except in the hooks of drivers.
    polarity
        -1 if a positive command of the hardware shortens the optical path (``devices.dm.polarity``); drivers
        get the commands with the opposite sign.
    """

    #: Largest step of the ramp of ``flatten``, fraction of full stroke.
    RAMP_STEP = 0.1

    def __init__(self, name: str, limits: MirrorLimits) -> None:
        super().__init__(name)
        self.limits = limits
        self.sent_count = 0
        self.clipped_count = 0
        self.rejected_count = 0
        self.flatten_count = 0
        self.callback: Callable[[NDArray[np.float64]], object] | None = None
        self.order: NDArray[np.intp] | None = None
        self.polarity: Literal[-1, 1] = 1
        self._flat: NDArray[np.float64] | None = None
        self._guard: CommandGuard | None = None
        self._shape_known = False

    @property
    @abc.abstractmethod
    def info(self) -> DMInfo:
        """Identity and geometry; available once open."""

    @property
    def shape(self) -> NDArray[np.float64]:
        """The last command that the mirror accepted, ``(n_act,)`` (a copy)."""
        return self._guard_when_open().last.copy()

    @property
    def flat(self) -> NDArray[np.float64]:
        """The command of the flat shape, ``(n_act,)`` (a copy); zeros unless set."""
        n_act = self._guard_when_open().n_act
        return np.zeros(n_act) if self._flat is None else self._flat.copy()

    @final
    def set_flat(self, command: ArrayLike) -> None:
        """Set the command of the flat shape; the mirror does not move.

        Raises
        ------
        CommandRejected
            The command is malformed or breaks a limit other than slew.
        """
        violation = self.find_violation(command)
        if violation is not None:
            raise CommandRejected(self.name, f"flat command rejected: {violation}")
        self._flat = self._guard_when_open().validate(command)

    @final
    def send(self, command: ArrayLike) -> SendReport:
        """Send one command ``(n_act,)``, fractions of full stroke, through the guard.

        Returns the shape that was sent and what the guard changed.

        Raises
        ------
        CommandRejected
            Malformed or not finite; nothing is sent.
        DeviceError
            The transfer failed. The mirror has either shape: until a transfer succeeds, the slew rule is
            obeyed from both, and ``flatten`` sends.
        """
        # Locked because the slew rule refers to the previous command that reached the mirror.
        with self._lock:
            guard = self._guard_when_open()
            try:
                safe, report = guard.limit(command)
            except CommandRejected:
                self.rejected_count += 1
                raise
            try:
                with self._driver_calls:
                    kept_shape = self._send(self._to_hardware(safe))
                if kept_shape is not None:
                    self._require_shape(kept_shape, "the shape that it kept")
            except BaseException:
                # The command may have reached the mirror although its acknowledgement did not arrive.
                self._shape_known = False
                guard.mark_uncertain(safe)
                raise
            shape = safe if kept_shape is None else self._from_hardware(kept_shape)
            guard.set_last(shape)
            self._shape_known = True
            self.sent_count += 1
            self.clipped_count += report.clipped
            if self.callback is not None:
                self.callback(shape)
            return SendReport(shape, self.now_ns(), report, kept_shape is not None)

    @final
    def check(self, command: ArrayLike) -> tuple[NDArray[np.float64], GuardReport]:
        """The shape that :meth:`send` would send now, and the guard's changes; sends nothing.

        See :meth:`CommandGuard.limit <escape_hw.safety.guard.CommandGuard.limit>`.
        """
        return self._guard_when_open().limit(command)

    @final
    def is_legal(self, command: NDArray[np.float64]) -> bool:
        """Whether :meth:`send` would send a shape ``(n_act,)`` unchanged; sends nothing."""
        return self._guard_when_open().is_legal(command)

    @final
    def find_violation(self, command: ArrayLike) -> str | None:
        """Message for the first rule other than slew that a command ``(n_act,)`` breaks, or ``None``.

        Raises
        ------
        CommandRejected
            The command is malformed.
        """
        guard = self._guard_when_open()
        return guard.find_violation(guard.validate(command))

    @final
    def largest_legal_scale(self, command: ArrayLike) -> float:
        """Largest factor up to 1 at which a scaled shape ``(n_act,)`` obeys every limit except slew.

        A measurement scales its pokes by it so that no actuator is clipped. Sends nothing. See
        :meth:`CommandGuard.largest_legal_scale <escape_hw.safety.guard.CommandGuard.largest_legal_scale>`.
        """
        return self._guard_when_open().largest_legal_scale(command)

    @final
    def flatten(self) -> None:
        """Ramp to the flat shape in steps of at most :data:`RAMP_STEP`.

        Legal in every connected state. Does nothing while the mirror accepts no commands (at rest).

        Raises
        ------
        DeviceError
            The mirror did not reach the flat shape.
        """
        with self._lock:
            guard = self._guard_when_open()
            if not self._accepts_commands():
                return
            self.flatten_count += 1
            target = self.flat
            step = min(self.RAMP_STEP, self.limits.max_slew or self.RAMP_STEP)
            distance = float(np.abs(target - guard.last).max(initial=0.0))
            # Twice the direct number of steps, because the way out of an illegal shape is longer; one more,
            # because the first step after a failed transfer may lead to the last shape only.
            for _ in range(3 + 2 * math.ceil(distance / step)):
                move = target - guard.last
                largest = float(np.abs(move).max(initial=0.0))
                if largest == 0.0 and self._shape_known:
                    return
                self.send(target if largest <= step else guard.last + move * (step / largest))
            if not np.array_equal(target, guard.last):
                raise DeviceError(
                    self.name, "did not reach its flat shape; check max_slew against the flat and the limits"
                )

    def _guard_when_open(self) -> CommandGuard:
        self.require_open()
        if self._guard is None:
            raise DeviceError(self.name, "has no guard; its driver must not override _after_open")
        return self._guard

    def _after_open(self) -> None:
        info = self._require_kind(self.info, DMInfo, "info")
        if (defect := _find_defect(info)) is not None:
            raise self.driver_defect(defect)
        try:
            guard = CommandGuard(self.name, info.n_act, self.limits, _pairs_of(info))
        except ValueError as error:
            raise SettingRejected(self.name, f"its limits do not fit ({error})") from error
        if self.order is not None and not np.array_equal(np.sort(self.order), np.arange(info.n_act)):
            raise SettingRejected(
                self.name,
                f"order has {self.order.size} numbers; it must have each of 0 to {info.n_act - 1} once",
            )
        if self._flat is not None and self._flat.size != info.n_act:
            raise SettingRejected(
                self.name,
                f"its flat shape is of {self._flat.size} actuators, and it has {info.n_act}; "
                "make a new object for another mirror",
            )
        present = self._present_in_layout()
        guard.reset(present)
        self._guard, self._shape_known = guard, present is not None
        self.sent_count = self.clipped_count = self.rejected_count = self.flatten_count = 0

    def _present_in_layout(self) -> NDArray[np.float64] | None:
        """The shape that the hardware reports, in the numbering of the layout; ``None``: unknown."""
        present = self._present_shape()
        if present is None:
            return None
        self._require_shape(present, "its present shape")
        return self._from_hardware(present)

    def _require_shape(self, shape: object, what: str) -> None:
        """Refuse a shape of the hardware that is no finite ``(n_act,)``; ``what`` names it in the message."""
        array = self._require_kind(shape, np.ndarray, what)
        n_act = self.info.n_act
        if array.dtype.kind not in "fiu" or array.shape != (n_act,) or not np.isfinite(array).all():
            raise self.driver_defect(f"{what} is {describe_value(array)}, not {n_act} finite numbers")

    def _to_hardware(self, shape: NDArray[np.float64]) -> NDArray[np.float64]:
        """A shape ``(n_act,)`` with the numbering and the sign of the hardware, read-only."""
        if self.order is None and self.polarity == 1:
            return shape
        shape = self.polarity * (shape if self.order is None else shape[self.order])
        shape.setflags(write=False)
        return shape

    def _from_hardware(self, shape: NDArray[np.float64]) -> NDArray[np.float64]:
        """A shape ``(n_act,)`` of the hardware with the numbering and the sign of the layout, read-only."""
        if self.order is None and self.polarity == 1:
            return shape
        in_layout = self.polarity * (shape if self.order is None else shape[np.argsort(self.order)])
        in_layout.setflags(write=False)
        return in_layout

    def _numbers_in_layout(self, actuators: Iterable[int]) -> tuple[int, ...]:
        """Numbers in the layout of actuators of the hardware, ascending."""
        return _renumber(actuators, self.order)

    def _numbers_in_hardware(self, actuators: Iterable[int]) -> tuple[int, ...]:
        """Numbers in the hardware of actuators of the layout, ascending."""
        return _renumber(actuators, None if self.order is None else np.argsort(self.order))

    def _before_open(self) -> None:
        load_compiled_check()

    def _before_close(self) -> None:
        self.flatten()

    def _present_shape(self) -> NDArray[np.float64] | None:
        """Shape ``(n_act,)`` of the hardware on opening, if it can be read.

        ``None``: unknown; the guard assumes zeros, and ``flatten`` always sends.
        """
        return None

    def _accepts_commands(self) -> bool:
        """False while the mirror is at rest and follows no commands."""
        return True

    @abc.abstractmethod
    def _send(self, command: NDArray[np.float64]) -> NDArray[np.float64] | None:
        """Transfer a guarded, C-contiguous, read-only float64 command ``(n_act,)``.

        It has the numbering and the sign of the hardware, as shapes that are read back have.

        Returns
        -------
        ndarray or None
            ``None``: the command was accepted. A mirror that skipped it returns the shape that it kept,
            read-only.
        """


def _find_defect(info: DMInfo) -> str | None:
    """What is wrong with the geometry that a driver reports, or ``None``."""
    if not isinstance(info.n_act, int | np.integer) or info.n_act < 1:
        return f"info.n_act is {describe_value(info.n_act)}; a mirror has at least one actuator"
    positions, layout = info.positions_m, info.layout
    if not isinstance(positions, np.ndarray) or positions.shape != (info.n_act, 2):
        return f"info.positions_m is {describe_value(positions)}, not an array ({info.n_act}, 2)"
    if layout is None:
        return None
    if not isinstance(layout, np.ndarray) or layout.dtype != np.bool_ or layout.ndim != 2:
        return f"info.layout is {describe_value(layout)}, neither a map of true and false nor None"
    if layout.sum() != info.n_act:
        return f"its layout has {layout.sum()} positions for {info.n_act} actuators"
    return None


def _pairs_of(info: DMInfo) -> NDArray[np.intp]:
    """Pairs of neighbours ``(n_pairs, 2)`` for the guard; all pairs where the arrangement is not known."""
    if info.layout is not None:
        return neighbour_pairs(info.layout)
    if np.isnan(info.positions_m).all():
        return all_pairs(info.n_act)
    return nearest_pairs(info.positions_m)


def _renumber(actuators: Iterable[int], numbers: NDArray[np.intp] | None) -> tuple[int, ...]:
    if numbers is None:
        return tuple(sorted(actuators))
    # Numbers beyond the layout are passed on unchanged: the check of the number of actuators reports them.
    return tuple(sorted(int(numbers[k]) if k < numbers.size else k for k in actuators))
