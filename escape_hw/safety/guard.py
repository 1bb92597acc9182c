"""The guard between a requested command and the mirror: what passes obeys every limit."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from escape_hw.errors import CommandRejected
from escape_hw.safety.limits import MirrorLimits

#: Rounds of clip and scale before the guard falls back to a pure scaling, which always obeys.
_ROUNDS = 4
#: Head-room for rounding, so that a command at a limit is not touched again.
_ULP = 1e-12


@dataclass(frozen=True, slots=True)
class GuardReport:
    """What the guard did to one command (counts of actuators, and scale factors)."""

    clipped: int = 0
    slewed: int = 0
    disabled: int = 0
    neighbour_scale: float = 1.0
    mean_removed: float = 0.0

    @property
    def untouched(self) -> bool:
        """True when the mirror gets exactly what was asked for."""
        return self == GuardReport()


class CommandGuard:
    """Checks and limits commands for one mirror; remembers the last shape sent.

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
    """

    def __init__(
        self, device: str, n_act: int, limits: MirrorLimits, pairs: NDArray[np.intp] | None = None
    ) -> None:
        if any(not 0 <= i < n_act for i in limits.disabled):
            raise ValueError(
                f"{device}: disabled actuators {limits.disabled} do not all lie in 0..{n_act - 1}"
            )
        self.device, self.n_act, self.limits = device, n_act, limits
        self.pairs = np.empty((0, 2), dtype=np.intp) if pairs is None else pairs
        self.last = np.zeros(n_act)
        self._enabled = np.ones(n_act, dtype=bool)
        self._enabled[list(limits.disabled)] = False

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
        asked = np.asarray(command)
        if asked.dtype.kind not in "fiu":
            raise CommandRejected(
                self.device, f"command has type {asked.dtype}; give real numbers, fractions of full stroke"
            )
        if asked.shape != (self.n_act,):
            raise CommandRejected(
                self.device, f"command has shape {asked.shape}; this mirror takes ({self.n_act},)"
            )
        wanted = np.array(asked, dtype=np.float64, order="C")
        bad = np.flatnonzero(~np.isfinite(wanted))
        if bad.size:
            raise CommandRejected(
                self.device,
                f"actuator {bad[0]} is {wanted[bad[0]]} ({bad.size} of {self.n_act} not finite); "
                "the whole command is refused and the last shape kept",
            )
        return wanted

    def __call__(self, command: ArrayLike) -> tuple[NDArray[np.float64], GuardReport]:
        """Limit a command; the result obeys every rule at once.

        Raises
        ------
        CommandRejected
            See :meth:`validate`.
        """
        wanted = self.validate(command)
        lim = self.limits
        off = int(np.count_nonzero(wanted[~self._enabled]))
        wanted[~self._enabled] = 0.0
        clipped = slewed = 0
        scale, removed = 1.0, 0.0
        safe = wanted
        for _ in range(_ROUNDS):
            before = safe
            safe, shift = self._limit_mean(safe)
            removed += shift
            safe, n = self._clip(safe, -lim.max_stroke, lim.max_stroke)
            clipped = max(clipped, n)
            safe, factor = self._limit_neighbours(safe)
            scale *= factor
            safe, n = self._limit_slew(safe)
            slewed = max(slewed, n)
            if safe is before or np.array_equal(safe, before):
                break
        if not self.obeys(safe):
            safe, scale = self._towards(safe), 0.0
        self.last = safe
        return safe, GuardReport(clipped, slewed, off, scale, removed)

    def reset(self, shape: NDArray[np.float64] | None = None) -> None:
        """Tell the guard which shape the mirror really has (zeros after a device reset)."""
        self.last = np.zeros(self.n_act) if shape is None else np.array(shape, dtype=np.float64)

    def obeys(self, shape: NDArray[np.float64]) -> bool:
        """True when ``shape`` obeys every rule, counted from the last shape sent."""
        lim = self.limits
        ok = bool(np.abs(shape).max(initial=0.0) <= lim.max_stroke + _ULP)
        ok = ok and not shape[~self._enabled].any()
        if lim.max_slew is not None:
            ok = ok and bool(np.abs(shape - self.last).max() <= lim.max_slew + _ULP)
        if lim.max_mean is not None and self._enabled.any():
            ok = ok and abs(float(shape[self._enabled].mean())) <= lim.max_mean + _ULP
        if lim.max_neighbour is not None and len(self.pairs):
            ok = ok and self._worst_step(shape) <= lim.max_neighbour + _ULP
        return ok

    def _worst_step(self, shape: NDArray[np.float64]) -> float:
        return float(np.abs(shape[self.pairs[:, 0]] - shape[self.pairs[:, 1]]).max())

    def _limit_mean(self, shape: NDArray[np.float64]) -> tuple[NDArray[np.float64], float]:
        limit = self.limits.max_mean
        if limit is None or not self._enabled.any():
            return shape, 0.0
        mean = float(shape[self._enabled].mean())
        excess = mean - float(np.clip(mean, -limit, limit))
        if abs(excess) <= _ULP:
            return shape, 0.0
        return np.where(self._enabled, shape - excess, 0.0), excess

    @staticmethod
    def _clip(shape: NDArray[np.float64], low: float, high: float) -> tuple[NDArray[np.float64], int]:
        n = int(np.count_nonzero((shape < low) | (shape > high)))
        return (np.clip(shape, low, high), n) if n else (shape, 0)

    def _limit_neighbours(self, shape: NDArray[np.float64]) -> tuple[NDArray[np.float64], float]:
        limit = self.limits.max_neighbour
        if limit is None or not len(self.pairs):
            return shape, 1.0
        worst = self._worst_step(shape)
        return (shape * (limit / worst), limit / worst) if worst > limit + _ULP else (shape, 1.0)

    def _limit_slew(self, shape: NDArray[np.float64]) -> tuple[NDArray[np.float64], int]:
        limit = self.limits.max_slew
        if limit is None:
            return shape, 0
        step = shape - self.last
        n = int(np.count_nonzero(np.abs(step) > limit + _ULP))
        return (self.last + np.clip(step, -limit, limit), n) if n else (shape, 0)

    def _towards(self, shape: NDArray[np.float64]) -> NDArray[np.float64]:
        """Go as far from the last shape towards ``shape`` as every rule allows.

        The rules are convex and the last shape obeys them, so any point of the straight line up
        to the first breach obeys them too.
        """
        low, high = 0.0, 1.0
        for _ in range(40):
            middle = 0.5 * (low + high)
            if self.obeys(self.last + middle * (shape - self.last)):
                low = middle
            else:
                high = middle
        return np.asarray(self.last + low * (shape - self.last))
