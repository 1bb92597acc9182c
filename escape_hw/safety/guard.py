"""The guard between a requested command and the mirror: what passes obeys every limit."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from escape_hw.errors import CommandRejected
from escape_hw.safety.limits import MirrorLimits

#: Head-room for rounding, so that a command at a limit is not touched again.
_ROUNDING = 1e-12
#: Nothing this far beyond full stroke means anything; bounding it keeps sums and products finite.
_MAX_MAGNITUDE = 1e3


@dataclass(frozen=True, slots=True)
class GuardReport:
    """What the guard did to one command.

    Parameters
    ----------
    clipped
        Actuators asked to go beyond ``max_stroke``.
    slewed
        Actuators that could not go all the way in one command.
    disabled
        Disabled actuators that were asked to move.
    scale
        Factor that brought the shape within ``max_neighbour`` and ``max_mean``, 1 if not needed.
    mean_removed
        Mean taken off to respect ``max_mean``, fraction of full stroke.
    """

    clipped: int = 0
    slewed: int = 0
    disabled: int = 0
    scale: float = 1.0
    mean_removed: float = 0.0

    @property
    def is_unchanged(self) -> bool:
        """True when the mirror gets exactly what was asked for."""
        return self == _UNCHANGED


_UNCHANGED = GuardReport()


class CommandGuard:
    """Checks and limits commands for one mirror; remembers the last shape sent.

    Every rule is convex, and the last shape obeys them all. A command that breaks a rule is first
    made legal by itself (mean, stroke, then a scaling, which needs no iteration because zero obeys
    every rule); the slew rule then decides how far towards it this command may go. So the result
    always obeys, and repeating a command always arrives.

    When a mirror is found in a shape that breaks a rule (see :meth:`reset`), no single command
    can obey both the slew rule and the broken one. Slew wins, and each command breaks the other
    rule by less than the one before.

    Parameters
    ----------
    device
        Name used in error messages.
    n_act
        Number of actuators.
    limits
        The limits to enforce.
    pairs
        Neighbour pairs ``(n_pairs, 2)``, see :func:`~escape_hw.safety.limits.neighbour_pairs`.

    Raises
    ------
    ValueError
        A disabled actuator or a neighbour pair does not exist on this mirror.
    """

    def __init__(
        self, device: str, n_act: int, limits: MirrorLimits, pairs: NDArray[np.intp] | None = None
    ) -> None:
        if any(not 0 <= i < n_act for i in limits.disabled):
            raise ValueError(
                f"{device}: disabled actuators {limits.disabled} do not all lie in 0..{n_act - 1}"
            )
        self.device, self.n_act, self.limits = device, n_act, limits
        pairs = np.empty((0, 2), dtype=np.intp) if pairs is None else pairs
        if len(pairs) and not (pairs.min() >= 0 and pairs.max() < n_act):
            raise ValueError(f"{device}: neighbour pairs name actuators outside 0..{n_act - 1}")
        self._first_of_pair, self._second_of_pair = (np.ascontiguousarray(pairs[:, k]) for k in (0, 1))
        self._disabled = np.array(sorted(set(limits.disabled)), dtype=np.intp)
        self._enabled = np.ones(n_act, dtype=bool)
        self._enabled[self._disabled] = False
        n_enabled = int(self._enabled.sum())
        self._mean_weights = self._enabled / n_enabled if n_enabled else np.zeros(n_act)
        self.last = _read_only(np.zeros(n_act))
        # Imported here: it brings a compiler along, which those who only read a configuration do without.
        from escape_hw.safety.limit_check import obeys_limits

        self._obeys_limits = obeys_limits
        # Stroke holds exactly, the other rules to within rounding; what is off is infinite.
        off, mean = math.inf, limits.max_mean is not None
        neighbours = limits.max_neighbour is not None
        none = np.empty(0, dtype=np.intp)
        self._rules = (
            self._disabled,
            self._mean_weights if mean else np.empty(0),
            self._first_of_pair if neighbours else none,
            self._second_of_pair if neighbours else none,
            limits.max_stroke,
            *(off if limit is None else limit + _ROUNDING
              for limit in (limits.max_slew, limits.max_mean, limits.max_neighbour)),
        )  # fmt: skip

    def validate(self, command: ArrayLike) -> NDArray[np.float64]:
        """Check type, shape and finiteness.

        Returns
        -------
        ndarray of float64, ``(n_act,)``
            A fresh C-contiguous copy.

        Raises
        ------
        CommandRejected
            Wrong type or shape, or any value that is not finite (its index is named).
        """
        # A caller that has numpy raise on overflow must still get CommandRejected.
        with np.errstate(all="ignore"):
            return self._validated(command)

    def limit(self, command: ArrayLike) -> tuple[NDArray[np.float64], GuardReport]:
        """Limit a command; the result obeys every rule at once. Remembers nothing.

        Returns
        -------
        safe : ndarray of float64, ``(n_act,)``
            Read-only. Bit for bit what was asked for when that obeys every rule; otherwise every
            rule is obeyed to within rounding (1e-12), stroke exactly.
        report : GuardReport

        Raises
        ------
        CommandRejected
            See :meth:`validate`.
        """
        with np.errstate(all="ignore"):
            wanted = self._validated(command)
            if self.is_legal(wanted):
                return _read_only(wanted), _UNCHANGED
            legal, clipped, disabled, scale, removed = self._apply_static_limits(wanted)
            safe, slewed = self._apply_slew_limit(legal)
            return _read_only(safe), GuardReport(clipped, slewed, disabled, scale, removed)

    def set_last(self, shape: NDArray[np.float64]) -> None:
        """Remember a shape from :meth:`limit` as the one that the mirror has now."""
        self.last = shape

    def __call__(self, command: ArrayLike) -> tuple[NDArray[np.float64], GuardReport]:
        """:meth:`limit`, then :meth:`set_last`."""
        safe, report = self.limit(command)
        self.set_last(safe)
        return safe, report

    def reset(self, shape: ArrayLike | None = None) -> None:
        """Tell the guard which shape the mirror really has; zeros when not given.

        Raises
        ------
        CommandRejected
            The shape is malformed, see :meth:`validate`.
        """
        self.last = _read_only(np.zeros(self.n_act) if shape is None else self.validate(shape))

    def is_legal(self, shape: NDArray[np.float64]) -> bool:
        """True when ``shape`` obeys every rule, counted from the last shape sent."""
        return bool(self._obeys_limits(shape, self.last, *self._rules))

    def find_violation(self, shape: NDArray[np.float64]) -> str | None:
        """The first rule that ``shape`` breaks by itself (slew apart), in words, or ``None``."""
        lim = self.limits
        peak = _peak(shape)
        if peak > lim.max_stroke:
            worst = int(np.abs(shape).argmax())
            return f"actuator {worst} exceeds max_stroke = {lim.max_stroke} ({peak:.6g})"
        if self._disabled.size and shape[self._disabled].any():
            culprit = int(self._disabled[np.flatnonzero(shape[self._disabled])[0]])
            return f"actuator {culprit} is disabled and must stay at zero"
        if lim.max_mean is not None:
            mean = float(shape.dot(self._mean_weights))
            if abs(mean) > lim.max_mean + _ROUNDING:
                return f"the mean exceeds max_mean = {lim.max_mean} ({mean:.6g})"
        if lim.max_neighbour is not None and self._first_of_pair.size:
            step = self._worst_step(shape)
            if step > lim.max_neighbour + _ROUNDING:
                return f"two neighbours exceed max_neighbour = {lim.max_neighbour} ({step:.6g})"
        return None

    def largest_legal_scale(self, shape: ArrayLike) -> float:
        """Largest factor, at most 1, with which a shape breaks no rule by itself (slew apart).

        A shape scaled by it keeps its form, where :meth:`limit` cuts single actuators off. Disabled
        actuators do not count: no factor makes them legal.

        Raises
        ------
        CommandRejected
            See :meth:`validate`.
        """
        wanted = self.validate(shape)
        wanted[self._disabled] = 0.0
        peak = _peak(wanted)
        share = min(1.0, self.limits.max_stroke / peak) if peak > 0 else 1.0
        return share * self._scale(wanted * share)

    def _validated(self, command: ArrayLike) -> NDArray[np.float64]:
        asked = self._as_array(command)
        if asked.dtype.kind not in "fiu":
            raise CommandRejected(
                self.device, f"command has type {asked.dtype}; give real numbers, fractions of full stroke"
            )
        if asked.shape != (self.n_act,):
            raise CommandRejected(
                self.device, f"command has shape {asked.shape}; this mirror takes ({self.n_act},)"
            )
        wanted = np.array(asked, dtype=np.float64, order="C")
        # The sum of squares is the cheapest test that one NaN or infinity cannot pass.
        if not math.isfinite(wanted.dot(wanted)):
            self._require_finite(wanted)
        return wanted

    def _as_array(self, command: ArrayLike) -> NDArray[np.generic]:
        """Make an array of it, and whatever goes wrong on the way a :class:`CommandRejected`."""
        try:
            if np.ma.is_masked(command):
                raise CommandRejected(self.device, "command has masked elements; fill them first")
            return np.asarray(command)
        except CommandRejected:
            raise
        except Exception as error:
            raise CommandRejected(
                self.device, f"command is not an array of numbers ({type(command).__name__}: {error})"
            ) from error

    def _require_finite(self, wanted: NDArray[np.float64]) -> None:
        bad = np.flatnonzero(~np.isfinite(wanted))
        if bad.size:
            raise CommandRejected(
                self.device,
                f"actuator {bad[0]} is {wanted[bad[0]]} ({bad.size} of {self.n_act} not finite); "
                "the whole command is refused and the last shape kept",
            )

    def _worst_step(self, shape: NDArray[np.float64]) -> float:
        return _peak(shape.take(self._first_of_pair) - shape.take(self._second_of_pair))

    def _apply_static_limits(
        self, wanted: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], int, int, float, float]:
        """Make a shape obey every rule but slew.

        Returns
        -------
        legal, clipped, disabled, scale, mean_removed
        """
        lim = self.limits
        disabled = int(np.count_nonzero(wanted[self._disabled]))
        shape = _clamp(wanted, _MAX_MAGNITUDE)
        shape[self._disabled] = 0.0
        removed = 0.0
        if lim.max_mean is not None:
            mean = float(shape.dot(self._mean_weights))
            if abs(mean) > lim.max_mean + _ROUNDING:
                removed = mean - math.copysign(lim.max_mean, mean)
                shape[self._enabled] -= removed
        clipped = int(np.count_nonzero(np.abs(shape) > lim.max_stroke))
        shape = _clamp(shape, lim.max_stroke)
        scale = self._scale(shape)
        return (shape if scale == 1.0 else shape * scale), clipped, disabled, scale, removed

    def _scale(self, shape: NDArray[np.float64]) -> float:
        """Largest factor up to 1 that makes ``shape`` obey the neighbour and the mean rule."""
        lim, scale = self.limits, 1.0
        if lim.max_mean is not None:
            mean = abs(float(shape.dot(self._mean_weights)))
            scale = lim.max_mean / mean if mean > lim.max_mean + _ROUNDING else scale
        if lim.max_neighbour is not None and self._first_of_pair.size:
            step = self._worst_step(shape)
            scale = min(scale, lim.max_neighbour / step) if step > lim.max_neighbour + _ROUNDING else scale
        return scale

    def _apply_slew_limit(self, legal: NDArray[np.float64]) -> tuple[NDArray[np.float64], int]:
        """Go from the last shape towards a legal one as far as the slew rule allows.

        Each actuator goes as far as it may, so that one far away does not hold the others back.
        Where that breaks a rule (the mean may, as the far ones lag), all move in proportion: a
        point on the straight line between two legal shapes is legal.
        """
        slew = self.limits.max_slew
        if slew is None:
            return legal, 0
        move = legal - self.last
        far = np.abs(move)
        slewed = int(np.count_nonzero(far > slew + _ROUNDING))
        if not slewed:
            return legal, 0
        each = self._within_stroke(self.last + _clamp(move, slew))
        if self.is_legal(each):
            return each, slewed
        return self._within_stroke(self.last + move * (slew / far.max())), slewed

    def _within_stroke(self, shape: NDArray[np.float64]) -> NDArray[np.float64]:
        """Take off what rounding added beyond the stroke (or beyond the last shape, if that is)."""
        bound = max(self.limits.max_stroke, _peak(self.last))
        return _clamp(shape, bound)


def _peak(values: NDArray[np.float64]) -> float:
    return float(np.abs(values).max(initial=0.0))


def _clamp(values: NDArray[np.float64], bound: float) -> NDArray[np.float64]:
    """Clip to ``-bound .. bound`` (several times faster than ``np.clip`` on so few values)."""
    return np.minimum(np.maximum(values, -bound), bound)


def _read_only(shape: NDArray[np.float64]) -> NDArray[np.float64]:
    """Make an array read-only: caller, driver and guard share it, and none may change it."""
    shape.setflags(write=False)
    return shape
