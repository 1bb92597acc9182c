"""The streams that a run would have sent, from what it left behind."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.gains import GainsResult
from escape_hw.api.registration import PARAMETERS, TO_PLAIN
from escape_hw.api.results import CalibrationResult, LoopResult, RegistrationEstimate

if TYPE_CHECKING:
    from escape_hw.report.content import RunContent

Meta = Mapping[str, float | str]


@dataclass(frozen=True, slots=True, eq=False)
class Course:
    """What a stream held at any time of the run.

    Parameters
    ----------
    length
        Steps it came in.
    at
        Its entry after so many steps, 1 to ``length``; ``None``: not there yet.
    meta
        What it says of itself.
    """

    length: int
    at: Callable[[int], NDArray[Any] | None]
    meta: Meta


def courses(run: RunContent) -> dict[str, Course]:
    """Every stream that a run can fill, by name."""
    found: dict[str, Course] = {}
    main = main_calibration(run)
    if main is not None:
        found |= _calibration(*main)
    for label, gains in run.gains.items():
        found |= _gains(label, gains)
    if run.loops:
        found |= _loop(*list(run.loops.items())[-1])
    track = run.document.get("track")
    if track and track["seconds"]:
        table = _table(track)
        found["registration_track"] = Course(len(table), lambda n: table[:n], {"stage": "tracking"})
    return found


def main_calibration(run: RunContent) -> tuple[str, CalibrationResult] | None:
    """The calibration that a run was made for: the last one with a registration, or else the last one."""
    fitted = [item for item in run.calibrations.items() if item[1].registration is not None]
    every = fitted or list(run.calibrations.items())
    return every[-1] if every else None


def _still(data: NDArray[Any], meta: Meta) -> Course:
    return Course(1, lambda _: data, meta)


def _calibration(label: str, result: CalibrationResult) -> dict[str, Course]:
    matrix = result.measured or result.matrix
    meta: Meta = {"stage": label, "method": matrix.method, "frames": float(result.frames)}
    found = {
        "valid": _still(matrix.valid, meta),
        "matrix": _still(matrix.data, meta),
        "matrix_sigma": _still(matrix.sigma, meta),
    }
    if result.mean_frame is not None:
        found["frames"] = _still(result.mean_frame, {"stage": "mean frame"})
    if result.registration is not None:
        found |= _sprint(result.registration)
    return found


def _sprint(estimate: RegistrationEstimate) -> dict[str, Course]:
    steps = estimate.iterations
    if not steps:
        return {}
    path = np.array([step.registration.to_array() for step in steps]) * TO_PLAIN
    # The steps tell how the fit went; what came of it, model errors included, is the last word.
    path[-1] = estimate.registration.to_array() * TO_PLAIN
    norm = np.array([step.step_norm for step in steps])
    sigma, unknown = estimate.sigma * TO_PLAIN, np.full(len(PARAMETERS), np.nan)
    n = len(steps)
    meta: Meta = {"stage": "SPRINT"}
    return {
        "registration": Course(n, lambda k: path[:k], meta),
        "step_norm": Course(n, lambda k: norm[:k], meta),
        "registration_sigma": Course(n, lambda k: sigma if k == n else unknown, meta),
    }


def _gains(label: str, result: GainsResult) -> dict[str, Course]:
    rounds = [one.gains for one in result.rounds]
    if not rounds:
        return {}
    meta: Meta = {"stage": "bootstrap", "method": result.method, "label": label}
    n = len(rounds)
    return {
        "gains": Course(n, lambda k: rounds[k - 1].value, meta),
        "gains_sigma": Course(n, lambda k: rounds[k - 1].sigma, meta),
        "gains_smooth": Course(n, lambda k: rounds[k - 1].trend, meta),
        "gains_rounds": Course(n, lambda k: np.array([one.best for one in rounds[:k]]), meta),
    }


def _loop(label: str, loop: LoopResult) -> dict[str, Course]:
    meta: Meta = {"stage": label}
    found: dict[str, Course] = {}
    if loop.last_frame is not None:
        found["frames"] = _still(loop.last_frame, meta)
    if loop.last_command.size:
        found["commands"] = _still(loop.last_command, meta)
    if loop.psf is not None:
        found["psf"] = _still(loop.psf, meta)
    if loop.model_psf is not None:
        found["model_psf"] = _still(loop.model_psf, meta)
    residual = loop.residual_nm
    if residual.size:
        found["residual"] = Course(residual.size, lambda k: residual[:k], meta)
    return found


def _table(track: Mapping[str, Any]) -> NDArray[np.float64]:
    """Rows of the stream ``registration_track`` from the document's columns."""
    names = ("seconds", *PARAMETERS, *(f"{name}_sigma" for name in PARAMETERS))
    table = np.array([track[name] for name in names], float).T
    table[:, 1:6] *= TO_PLAIN
    table[:, 6:11] *= TO_PLAIN
    return table
