"""Guard between a requested command and the mirror: a command that passes obeys every limit."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from escape_hw.errors import CommandRejected
from escape_hw.safety.limits import MirrorLimits

#: Tolerance for rounding: a command exactly at a limit passes unchanged.
_ROUNDING = 1e-12
#: Commands are first clipped to this magnitude, which keeps sums and products finite.
_MAX_MAGNITUDE = 1e3


@dataclass(frozen=True, slots=True)
class GuardReport:
    """What the guard did to one command.

    Parameters
    ----------
    clipped
        Number of actuators whose command exceeded ``max_stroke``.
    slewed
        Number of actuators whose change exceeded ``max_slew``.
    disabled
        Number of disabled actuators with a non-zero command.
    scale
        Factor applied to the shape to respect ``max_neighbour``, ``max_mean`` and ``max_abs_sum``; 1 if not
        needed.
    mean_removed
        Mean subtracted to respect ``max_mean``, fraction of full stroke.
    """

    clipped: int = 0
    slewed: int = 0
    disabled: int = 0
    scale: float = 1.0
    mean_removed: float = 0.0

    @property
    def is_unchanged(self) -> bool:
        """True when the command was sent as requested."""
        return self == _UNCHANGED


_UNCHANGED = GuardReport()


class CommandGuard:
    """Validates and limits the commands of one mirror, and stores the last shape sent.

    The set of legal shapes is convex and contains zero. A command outside it is brought inside without
    iteration: the mean is reduced, the stroke is clipped, and the shape is scaled. The slew rule then
    limits the step from the last shape towards this legal shape. The result therefore obeys every rule,
    and repeating a command converges to its legal shape.

    If the last shape breaks a rule (see :meth:`reset`), no single command can satisfy both that rule and
    the slew rule. The slew rule has priority, and each command reduces the violation of the other rule.

    ``pairs``: neighbour pairs ``(n_pairs, 2)``, see :func:`~escape_hw.safety.limits.neighbour_pairs`.

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
        # Least and greatest command per actuator that the mirror may have, after a transfer that failed.
        self._possible: tuple[NDArray[np.float64], NDArray[np.float64]] | None = None
        # Imported here because numba is slow to import and reading a configuration does not need it.
        from escape_hw.safety.compiled_check import obeys_limits

        self._obeys_limits = obeys_limits
        # The stroke limit is exact, the others have a tolerance; a rule that is off has an infinite limit.
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
              for limit in (limits.max_slew, limits.max_mean, limits.max_neighbour, limits.max_abs_sum)),
        )  # fmt: skip

    def validate(self, command: ArrayLike) -> NDArray[np.float64]:
        """Check type, shape and finiteness.

        Returns a new C-contiguous array ``(n_act,)``, float64.

        Raises
        ------
        CommandRejected
            Wrong type or shape, or a value that is not finite; the message gives its index.
        """
        # Raise CommandRejected even where the caller lets numpy raise on overflow.
        with np.errstate(all="ignore"):
            return self._validate(command)

    def limit(self, command: ArrayLike) -> tuple[NDArray[np.float64], GuardReport]:
        """Limit a command so that it obeys every rule. Does not change the last shape.

        Returns
        -------
        safe : ndarray of float64, ``(n_act,)``
            Read-only. Identical to the command if that obeys every rule; otherwise every rule is obeyed
            to within rounding (1e-12), and the stroke limit exactly.
        report : GuardReport

        Raises
        ------
        CommandRejected
            See :meth:`validate`.
        """
        with np.errstate(all="ignore"):
            requested = self._validate(command)
            if self.is_legal(requested):
                return _read_only(requested), _UNCHANGED
            legal, clipped, disabled, scale, removed = self._apply_static_limits(requested)
            safe, slewed = self._apply_slew_limit(legal)
            return _read_only(safe), GuardReport(clipped, slewed, disabled, scale, removed)

    def set_last(self, shape: NDArray[np.float64]) -> None:
        """Store a copy of a shape from :meth:`limit` as the present shape of the mirror."""
        # Driver, callbacks and caller hold the array itself and can make it writable again.
        self.last = _read_only(shape.copy())
        self._possible = None

    def mark_uncertain(self, shape: NDArray[np.float64]) -> None:
        """Store a shape from :meth:`limit` whose transfer failed: the mirror may have it, or not.

        Until a shape is known again (:meth:`set_last`, :meth:`reset`), the slew rule is obeyed from the last
        shape and from every uncertain one. Returning to the last shape is always possible.
        """
        lowest, highest = (self.last, self.last) if self._possible is None else self._possible
        self._possible = np.minimum(lowest, shape), np.maximum(highest, shape)

    def mark_sequence(self, shapes: Sequence[NDArray[np.float64]]) -> None:
        """Store legal shapes that the mirror takes one after the other by itself: it may have any of them.

        As :meth:`mark_uncertain` of each; the last shape becomes the one of them from which the farthest
        possible shape is least far. The first step after a sequence is within the slew rule if a shape of the
        sequence is that close to all others, and otherwise leads there.
        """
        for shape in shapes:
            self.mark_uncertain(shape)
        assert self._possible is not None
        lowest, highest = self._possible
        # The last one of those that are equally good, because a sequence often has ended.
        central = min(reversed(shapes), key=lambda shape: max(_peak(shape - lowest), _peak(highest - shape)))
        self.last = _read_only(central.copy())

    def __call__(self, command: ArrayLike) -> tuple[NDArray[np.float64], GuardReport]:
        """:meth:`limit`, then :meth:`set_last`."""
        safe, report = self.limit(command)
        self.set_last(safe)
        return safe, report

    def reset(self, shape: ArrayLike | None = None) -> None:
        """Set the present shape of the mirror, by default zeros; it may break the limits.

        Raises
        ------
        CommandRejected
            The shape is malformed, see :meth:`validate`.
        """
        self.last = _read_only(np.zeros(self.n_act) if shape is None else self.validate(shape))
        self._possible = None

    def is_legal(self, shape: NDArray[np.float64]) -> bool:
        """True when ``shape`` obeys every rule, the slew rule relative to every shape the mirror may have."""
        references = (self.last,) if self._possible is None else (self.last, *self._possible)
        return all(self._obeys_limits(shape, reference, *self._rules) for reference in references)

    def find_violation(self, shape: NDArray[np.float64]) -> str | None:
        """Message for the first rule other than slew that ``shape`` breaks, or ``None``."""
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
        if lim.max_abs_sum is not None:
            total = float(np.abs(shape).sum())
            if total > lim.max_abs_sum + _ROUNDING:
                return f"the sum of magnitudes exceeds max_abs_sum = {lim.max_abs_sum} ({total:.6g})"
        return None

    def largest_legal_scale(self, shape: ArrayLike) -> float:
        """Largest factor up to 1 at which the scaled shape obeys every rule except slew.

        Scaling preserves the form of a shape, whereas :meth:`limit` clips single actuators. Disabled
        actuators are ignored.

        Raises
        ------
        CommandRejected
            See :meth:`validate`.
        """
        requested = self.validate(shape)
        requested[self._disabled] = 0.0
        peak = _peak(requested)
        stroke_scale = min(1.0, self.limits.max_stroke / peak) if peak > 0 else 1.0
        return stroke_scale * self._scale(requested * stroke_scale)

    def _validate(self, command: ArrayLike) -> NDArray[np.float64]:
        array = self._as_array(command)
        if array.dtype.kind not in "fiu":
            raise CommandRejected(
                self.device, f"command has type {array.dtype}; give real numbers, fractions of full stroke"
            )
        if array.shape != (self.n_act,):
            raise CommandRejected(
                self.device, f"command has shape {array.shape}; this mirror takes ({self.n_act},)"
            )
        requested = np.array(array, dtype=np.float64, order="C")
        # One pass: the sum of squares is not finite if any element is not.
        if not math.isfinite(requested.dot(requested)):
            self._require_finite(requested)
        return requested

    def _as_array(self, command: ArrayLike) -> NDArray[np.generic]:
        """Convert to an array; any failure becomes a :class:`CommandRejected`."""
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

    def _require_finite(self, requested: NDArray[np.float64]) -> None:
        bad = np.flatnonzero(~np.isfinite(requested))
        if bad.size:
            raise CommandRejected(
                self.device,
                f"actuator {bad[0]} is {requested[bad[0]]} ({bad.size} of {self.n_act} not finite); "
                "the command is rejected and the last shape kept",
            )

    def _worst_step(self, shape: NDArray[np.float64]) -> float:
        return _peak(shape.take(self._first_of_pair) - shape.take(self._second_of_pair))

    def _apply_static_limits(
        self, requested: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], int, int, float, float]:
        """Bring a shape within every rule except slew.

        Returns the legal shape, and as in :class:`GuardReport` clipped, disabled, scale and mean removed.
        """
        lim = self.limits
        disabled = int(np.count_nonzero(requested[self._disabled]))
        shape = _clamp(requested, _MAX_MAGNITUDE)
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
        """Largest factor up to 1 at which ``shape`` obeys the rules on neighbours, mean and sum."""
        lim, scale = self.limits, 1.0
        if lim.max_mean is not None:
            mean = abs(float(shape.dot(self._mean_weights)))
            scale = lim.max_mean / mean if mean > lim.max_mean + _ROUNDING else scale
        if lim.max_neighbour is not None and self._first_of_pair.size:
            step = self._worst_step(shape)
            scale = min(scale, lim.max_neighbour / step) if step > lim.max_neighbour + _ROUNDING else scale
        if lim.max_abs_sum is not None:
            total = float(np.abs(shape).sum())
            scale = min(scale, lim.max_abs_sum / total) if total > lim.max_abs_sum + _ROUNDING else scale
        return scale

    def _apply_slew_limit(self, legal: NDArray[np.float64]) -> tuple[NDArray[np.float64], int]:
        """Step from the last shape towards a legal one as far as the slew rule allows.

        Each actuator moves by at most the slew limit. If the result breaks another rule (for example the
        mean), the whole step is scaled instead: a point between two legal shapes is legal by convexity.
        """
        slew = self.limits.max_slew
        if slew is None:
            return legal, 0
        move = legal - self.last
        backward, forward = self._slew_bounds(slew)
        bound = np.where(move < 0, backward, forward)
        far = np.abs(move)
        slewed = int(np.count_nonzero(far > bound + _ROUNDING))
        if not slewed:
            return legal, 0
        each = self._within_stroke(self.last + np.minimum(np.maximum(move, -backward), forward))
        if self.is_legal(each):
            return each, slewed
        moving = far > 0
        fraction = float((bound[moving] / far[moving]).min(initial=1.0))
        return self._within_stroke(self.last + move * fraction), slewed

    def _slew_bounds(self, slew: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Largest moves ``(n_act,)`` from the last shape towards lower and higher commands, both positive.

        A command lies within the slew limit of every shape that the mirror may have.
        """
        lowest, highest = (self.last, self.last) if self._possible is None else self._possible
        backward = np.maximum(slew - (highest - self.last), 0.0)
        forward = np.maximum(slew - (self.last - lowest), 0.0)
        return backward, forward

    def _within_stroke(self, shape: NDArray[np.float64]) -> NDArray[np.float64]:
        """Remove rounding beyond the stroke limit, or beyond the last shape if that exceeds the limit."""
        bound = max(self.limits.max_stroke, _peak(self.last))
        return _clamp(shape, bound)


def load_compiled_check() -> None:
    """Load the compiled check of the limits, which may take seconds, before a mirror waits for heartbeats."""
    CommandGuard("", 1, MirrorLimits()).is_legal(np.zeros(1))


def _peak(values: NDArray[np.float64]) -> float:
    return float(np.abs(values).max(initial=0.0))


def _clamp(values: NDArray[np.float64], bound: float) -> NDArray[np.float64]:
    """Clip to ``-bound .. bound``; several times faster than ``np.clip`` on small arrays."""
    return np.minimum(np.maximum(values, -bound), bound)


def _read_only(shape: NDArray[np.float64]) -> NDArray[np.float64]:
    """Make an array read-only, because caller, driver and callbacks share it."""
    shape.setflags(write=False)
    return shape
