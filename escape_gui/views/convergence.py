"""Convergence of SPRINT and drift of the registration, in the units in which they are shown."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.registration import PARAMETERS, TO_STREAM_UNITS
from escape_hw.api.results import describe_outcome

#: Titles of the parameters, in the order of ``PARAMETERS``.
NAMES = ("Shift x", "Shift y", "Rotation", "Radial scaling", "Tangential scaling")
#: Groups of parameters with a common axis: title, unit, indices.
GROUPS: tuple[tuple[str, str, tuple[int, ...]], ...] = (
    ("Shift", "% of a sub-aperture", (0, 1)),
    ("Rotation", "deg", (2,)),
    ("Scaling", "% of the diameter", (3, 4)),
)
#: Unit of each parameter.
UNITS = tuple(next(unit for _, unit, members in GROUPS if k in members) for k in range(len(NAMES)))


@dataclass(frozen=True, slots=True, eq=False)
class ConvergenceHistory:
    """Iterations of SPRINT."""

    #: Parameters by iteration ``(n_iterations, 5)`` in the paper's units.
    values: NDArray[np.float64]
    #: Standard errors of the last iteration ``(5,)``; NaN if not known yet.
    sigma: NDArray[np.float64]
    #: Relative norm of each step ``(n_iterations,)``; NaN for the starting point.
    step_norm: NDArray[np.float64]
    #: ``None`` during the fit.
    converged: bool | None = None
    #: Whether the model fits; ``None`` if that was not judged.
    model_fits: bool | None = None

    @classmethod
    def of(
        cls,
        registration: NDArray[np.floating],
        sigma: NDArray[np.floating] | None,
        step_norm: NDArray[np.floating] | None,
        converged: bool | None = None,
        model_fits: bool | None = None,
    ) -> ConvergenceHistory:
        """Build from the streams ``registration``, ``registration_sigma`` and ``step_norm``."""
        values = np.asarray(registration, float).reshape(-1, len(PARAMETERS)) / TO_STREAM_UNITS
        errors = np.full(len(PARAMETERS), np.nan)
        if sigma is not None and np.size(sigma) == errors.size:
            errors = np.asarray(sigma, float).ravel() / TO_STREAM_UNITS
        norm = np.full(len(values), np.nan)
        if step_norm is not None:
            # The streams are read one after another and may differ by an iteration.
            known = np.asarray(step_norm, float).ravel()[: len(values)]
            norm[: known.size] = np.where(known > 0, known, np.nan)
        return cls(values, errors, norm, converged, model_fits)

    @property
    def iterations(self) -> NDArray[np.int_]:
        return np.arange(1, len(self.values) + 1)

    def normalise(self) -> ConvergenceHistory:
        """Divide each parameter by its largest magnitude (paper: SPRINT figure)."""
        largest = np.max(np.abs(self.values), axis=0, initial=0.0)
        scale = np.where(largest > 0, largest, 1.0)
        return replace(self, values=self.values / scale, sigma=self.sigma / scale)

    def headline(self) -> str:
        n = len(self.values)
        state = "running" if self.converged is None else describe_outcome(self.converged, self.model_fits)
        return f"{state}, {n} iteration{'' if n == 1 else 's'}"


@dataclass(frozen=True, slots=True, eq=False)
class RegistrationDrift:
    """The registration over time."""

    #: Time since the start of tracking ``(n,)``, in ``unit``.
    time: NDArray[np.float64]
    #: ``s``, ``min`` or ``h``, depending on the duration.
    unit: str
    #: Parameters and standard errors ``(n, 5)`` in the paper's units.
    values: NDArray[np.float64]
    sigma: NDArray[np.float64]
    #: Exchanges and alarms: time in ``unit``, kind of event.
    marks: tuple[tuple[float, str], ...] = ()

    @classmethod
    def of(cls, track: NDArray[np.floating], marks: Sequence[tuple[float, str]] = ()) -> RegistrationDrift:
        """Build from the stream ``registration_track`` ``(n, 11)`` and marks at times in seconds."""
        table = np.asarray(track, float).reshape(-1, 11)
        seconds = table[:, 0]
        unit, size = _time_unit(float(seconds[-1]) if seconds.size else 0.0)
        return cls(
            seconds / size,
            unit,
            table[:, 1:6] / TO_STREAM_UNITS,
            table[:, 6:11] / TO_STREAM_UNITS,
            tuple((at / size, what) for at, what in marks),
        )

    def since_start(self) -> NDArray[np.float64]:
        """Difference of each parameter to its first finite value ``(n, 5)``."""
        if not len(self.values):
            return self.values
        known = np.isfinite(self.values)
        first = np.argmax(known, axis=0)
        return np.asarray(self.values - self.values[first, np.arange(self.values.shape[1])])


def _time_unit(seconds: float) -> tuple[str, float]:
    if seconds < 300:
        return "s", 1.0
    return ("min", 60.0) if seconds < 3 * 3600 else ("h", 3600.0)


def short_unit(unit: str) -> str:
    """A unit as axes, fields and narrow columns show it."""
    return _SHORT.get(unit.lower(), unit)


_SHORT = {
    "frame": "frames",
    "% of a sub-aperture": "% sub-ap.", "% of sub aperture": "% sub-ap.",
    "% of the diameter": "% diam.", "% of diameter": "% diam.",
}  # fmt: skip
