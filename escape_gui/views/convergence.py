"""SPRINT's course and the registration's drift, in the units and the form that they are shown in."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.registration import PARAMETERS, TO_STREAM_UNITS

#: Names of the parameters for people, in the order of ``PARAMETERS``.
NAMES = ("Shift x", "Shift y", "Rotation", "Radial scaling", "Tangential scaling")
#: Parameters that share a unit, and the axis they are read on.
GROUPS: tuple[tuple[str, str, tuple[int, ...]], ...] = (
    ("Shift", "% of a sub-aperture", (0, 1)),
    ("Rotation", "deg", (2,)),
    ("Scaling", "% of the diameter", (3, 4)),
)
#: Unit of each parameter, in their order.
UNITS = tuple(next(unit for _, unit, members in GROUPS if k in members) for k in range(len(NAMES)))


@dataclass(frozen=True, slots=True, eq=False)
class ConvergenceHistory:
    """SPRINT so far.

    Parameters
    ----------
    values
        Parameters by iteration ``(n_iterations, 5)`` in the paper's units.
    sigma
        Standard errors of the last iteration ``(5,)``; NaN where they are not known yet.
    step_norm
        Relative norm of each step ``(n_iterations,)``; NaN where there was none (the start).
    converged
        ``None`` while it runs.
    """

    values: NDArray[np.float64]
    sigma: NDArray[np.float64]
    step_norm: NDArray[np.float64]
    converged: bool | None = None

    @classmethod
    def of(
        cls,
        registration: NDArray[np.floating],
        sigma: NDArray[np.floating] | None,
        step_norm: NDArray[np.floating] | None,
        converged: bool | None = None,
    ) -> ConvergenceHistory:
        """From the streams ``registration``, ``registration_sigma`` and ``step_norm``."""
        values = np.asarray(registration, float).reshape(-1, len(PARAMETERS)) / TO_STREAM_UNITS
        errors = np.full(len(PARAMETERS), np.nan)
        if sigma is not None and np.size(sigma) == errors.size:
            errors = np.asarray(sigma, float).ravel() / TO_STREAM_UNITS
        norm = np.full(len(values), np.nan)
        if step_norm is not None:
            # Read at another moment, it may be one iteration ahead or behind.
            given = np.asarray(step_norm, float).ravel()[: len(values)]
            norm[: given.size] = np.where(given > 0, given, np.nan)
        return cls(values, errors, norm, converged)

    @property
    def iterations(self) -> NDArray[np.int_]:
        """Numbers of the iterations, from 1."""
        return np.arange(1, len(self.values) + 1)

    @property
    def scale(self) -> NDArray[np.float64]:
        """What each parameter is divided by to be normalised ``(5,)``: its largest size on the way."""
        largest = np.max(np.abs(self.values), axis=0, initial=0.0)
        return np.where(largest > 0, largest, 1.0)

    def normalised(self) -> ConvergenceHistory:
        """Every parameter divided by its largest size, so that one axis serves all (paper: SPRINT figure)."""
        return ConvergenceHistory(
            self.values / self.scale, self.sigma / self.scale, self.step_norm, self.converged
        )

    def headline(self) -> str:
        """Its state in a few words."""
        n = len(self.values)
        turns = f"{n} iteration{'' if n == 1 else 's'}"
        if self.converged is None:
            return f"running, {turns}"
        return f"{'converged' if self.converged else 'NOT converged'}, {turns}"


@dataclass(frozen=True, slots=True, eq=False)
class RegistrationDrift:
    """The registration over time.

    Parameters
    ----------
    time
        Since tracking began ``(n,)``, in ``unit``.
    unit
        ``s``, ``min`` or ``h``, as the length asks.
    values, sigma
        ``(n, 5)`` in the paper's units.
    marks
        Moments worth a line: time in ``unit``, and what happened.
    """

    time: NDArray[np.float64]
    unit: str
    values: NDArray[np.float64]
    sigma: NDArray[np.float64]
    marks: tuple[tuple[float, str], ...] = ()

    @classmethod
    def of(cls, track: NDArray[np.floating], marks: Sequence[tuple[float, str]] = ()) -> RegistrationDrift:
        """From the stream ``registration_track`` ``(n, 11)`` and marks at seconds."""
        table = np.asarray(track, float).reshape(-1, 11)
        seconds = table[:, 0]
        unit, size = time_unit(float(seconds[-1]) if seconds.size else 0.0)
        return cls(
            seconds / size,
            unit,
            table[:, 1:6] / TO_STREAM_UNITS,
            table[:, 6:11] / TO_STREAM_UNITS,
            tuple((at / size, what) for at, what in marks),
        )

    def since_start(self) -> NDArray[np.float64]:
        """Change of every parameter since its first known value ``(n, 5)``."""
        if not len(self.values):
            return self.values
        known = np.isfinite(self.values)
        first = np.argmax(known, axis=0)
        return np.asarray(self.values - self.values[first, np.arange(self.values.shape[1])])


def time_unit(seconds: float) -> tuple[str, float]:
    """Unit that suits a length of time, and its size in seconds."""
    if seconds < 300:
        return "s", 1.0
    return ("min", 60.0) if seconds < 3 * 3600 else ("h", 3600.0)


def short_unit(unit: str) -> str:
    """A unit as an axis or a narrow column has room for it."""
    return _SHORT.get(unit.lower(), unit)


_SHORT = {
    "% of a sub-aperture": "% sub-ap.", "% of sub aperture": "% sub-ap.",
    "% of the diameter": "% diam.", "% of diameter": "% diam.",
}  # fmt: skip
