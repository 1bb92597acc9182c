"""How far two interaction matrices agree."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.registration import PARAMETERS, UNITS
from escape_hw.api.results import CalibrationResult, Estimate, RegistrationEstimate
from escape_hw.config.layouts import shorten
from escape_hw.errors import IncompatibleProduct
from escape_hw.report.figures.matrix import representative_modes
from escape_hw.report.tables import TITLES, Table, format_error, format_with_error

#: Standard deviation of normal values relative to their median absolute deviation.
_NORMAL_MAD = 1.4826
#: Change of an actuator's gain, in standard deviations of the changes of all, from which on it is not chance;
#: and relative, from which on it is named.
_OUTLYING, _NAMED_CHANGE = 6.0, 0.05


@dataclass(frozen=True, slots=True, eq=False)
class MatrixComparison:
    """Two matrices side by side, over the sub-apertures that both have.

    Parameters
    ----------
    correlation
        Correlation of the two columns of every mode (about zero, not their means), ``(n_modes,)``.
    gain_ratio
        Regression of B on A: the gain of B relative to A, ``(n_modes,)``.
    relative_rms
        rms difference over the rms of A, ``(n_modes,)``.
    total_relative_rms
        The same over the whole matrix.
    common
        Number of sub-apertures that both have.
    elements
        What they are called.
    registration
        B minus A with combined standard errors; empty unless both have one.
    between_runs
        The same with their errors between runs of one set-up, which a change is to be compared with; empty
        unless both have them.
    changed_actuators
        Change of the fitted gain, B relative to A, of actuators that changed unlike the others, by 5 % at
        least.
    """

    correlation: NDArray[np.float64]
    gain_ratio: NDArray[np.float64]
    relative_rms: NDArray[np.float64]
    total_relative_rms: float
    common: int
    elements: str
    registration: dict[str, Estimate]
    between_runs: dict[str, Estimate]
    changed_actuators: dict[int, float]

    def to_dict(self) -> dict[str, Any]:
        """Plain values for JSON."""
        return {
            "common_sub_apertures": self.common,
            "correlation": self.correlation.tolist(),
            "gain_ratio": self.gain_ratio.tolist(),
            "relative_rms": self.relative_rms.tolist(),
            "total_relative_rms": self.total_relative_rms,
            "changed_actuators": {str(k): v for k, v in self.changed_actuators.items()},
            "median_correlation": float(np.median(self.correlation)),
            "registration_difference": {k: v.to_dict() for k, v in self.registration.items()} or None,
            "difference_between_runs": {k: v.to_dict() for k, v in self.between_runs.items()} or None,
        }


def compare(a: CalibrationResult, b: CalibrationResult) -> MatrixComparison:
    """Compare two matrices of the same basis.

    Raises
    ------
    IncompatibleProduct
        Another kind of sensor, basis, number of modes or grid.
    """
    if a.grid.kind != b.grid.kind:
        raise IncompatibleProduct(
            f"the matrices are of different sensors ({a.grid.kind}, {b.grid.kind}) and cannot be compared"
        )
    if a.matrix.m2c.shape != b.matrix.m2c.shape or not np.allclose(a.matrix.m2c, b.matrix.m2c, atol=1e-9):
        layouts = [shorten(one.matrix.layout) for one in (a, b)]
        actuators = f" and actuators at other places ({', '.join(layouts)})" if len({*layouts}) == 2 else ""
        raise IncompatibleProduct(
            f"the matrices have different modal bases{actuators}; their modes cannot be compared"
        )
    if a.matrix.valid.shape != b.matrix.valid.shape:
        raise IncompatibleProduct(
            f"the grids differ: {a.matrix.valid.shape} and {b.matrix.valid.shape} {a.grid.elements}"
        )
    both = a.matrix.valid & b.matrix.valid
    if not both.any():
        raise IncompatibleProduct(f"the two matrices have no valid {a.grid.elements} in common")
    left, right = (np.asarray(m.data, float)[np.tile(both[m.valid], 2)] for m in (a.matrix, b.matrix))
    power_left, power_right = np.sum(left**2, axis=0), np.sum(right**2, axis=0)
    cross = np.sum(left * right, axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        correlation = cross / np.sqrt(power_left * power_right)
        gain = cross / power_left
        relative = np.sqrt(np.sum((right - left) ** 2, axis=0) / power_left)
    total = math.sqrt(float(np.sum((right - left) ** 2)) / max(float(power_left.sum()), 1e-300))
    return MatrixComparison(
        correlation, gain, relative, total, int(both.sum()), a.grid.elements,
        _registration_difference(a, b, lambda one: one.sigma),
        _registration_difference(a, b, lambda one: one.repeatability_sigma),
        _changed_actuators(a, b),
    )  # fmt: skip


def _changed_actuators(a: CalibrationResult, b: CalibrationResult) -> dict[int, float]:
    first, second = (
        None if one.registration is None else one.registration.actuator_corrections for one in (a, b)
    )
    if first is None or second is None or first.gain.size != second.gain.size:
        return {}
    changed = changed_gains(first.gain, second.gain)
    return {number: change for number, change in changed.items() if abs(change) > _NAMED_CHANGE}


def changed_gains(first: NDArray[np.float64], second: NDArray[np.float64]) -> dict[int, float]:
    """Change of the gain of actuators, beyond the common one, where it stands out of that of the others.

    Parameters
    ----------
    first, second
        Relative gains of the actuators beyond the common one, of two runs ``(n_act,)``.
    """
    ratio = (1 + second) / (1 + first)
    change = ratio / np.median(ratio) - 1
    scatter = _NORMAL_MAD * float(np.median(np.abs(change)))
    outlying = np.flatnonzero(np.abs(change) > _OUTLYING * scatter)
    return {int(k): float(change[k]) for k in outlying[np.argsort(-np.abs(change[outlying]))]}


def _registration_difference(
    a: CalibrationResult,
    b: CalibrationResult,
    errors_of: Callable[[RegistrationEstimate], NDArray[np.float64] | None],
) -> dict[str, Estimate]:
    if a.registration is None or b.registration is None:
        return {}
    first, second = errors_of(a.registration), errors_of(b.registration)
    if first is None or second is None:
        return {}
    change = b.registration.registration.to_array() - a.registration.registration.to_array()
    return {
        name: Estimate(float(value), float(sigma), UNITS[name])
        for name, value, sigma in zip(PARAMETERS, change, np.hypot(first, second), strict=True)
    }


def summary_lines(result: MatrixComparison) -> list[str]:
    """The comparison in a few lines."""
    changed = [f"{number} ({100 * change:+.0f} %)" for number, change in result.changed_actuators.items()]
    return [
        f"{result.correlation.size} modes over {result.common} common {result.elements}",
        f"correlation per mode: minimum {np.min(result.correlation):.4f}, "
        f"median {np.median(result.correlation):.4f}",
        f"gain of B relative to A: median {np.median(result.gain_ratio):.4f}",
        f"relative rms difference: {100 * result.total_relative_rms:.2f} % over the whole matrix",
        *([f"actuators whose gain changed unlike the others': {', '.join(changed)}"] if changed else []),
    ]


def mode_table(result: MatrixComparison) -> Table:
    """A dozen evenly spaced modes with correlation, gain ratio and relative difference."""
    rows = tuple(
        (
            f"{mode + 1}",
            f"{result.correlation[mode]:.4f}",
            f"{result.gain_ratio[mode]:.4f}",
            f"{100 * result.relative_rms[mode]:.2f} %",
        )
        for mode in representative_modes(result.correlation.size, 12)
    )
    return Table(("Mode", "correlation", "gain B / A", "relative rms difference"), rows)


def registration_table(result: MatrixComparison) -> Table:
    """Difference of the registrations with combined errors, and its significance as a change between runs."""
    rows = []
    for name, value in result.registration.items():
        row = [f"{TITLES[name][0]} [{TITLES[name][1]}]", format_with_error(value)]
        between = result.between_runs.get(name)
        if between is not None:
            significance = f"{between.value / between.sigma:+.1f}" if between.sigma > 0 else "–"
            row += [format_error(between.sigma), significance.replace("-", "−")]
        rows.append(tuple(row))
    headings = ("± between runs", "change / σ") if result.between_runs else ()
    return Table(("Component", "α(B) − α(A)", *headings), tuple(rows))
