"""The streams that a run would have sent, from what it left behind."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.optical_gains import GainsResult
from escape_hw.api.registration import PARAMETERS, TO_STREAM_UNITS
from escape_hw.api.results import CalibrationResult, LoopResult, RegistrationEstimate

if TYPE_CHECKING:
    from escape_hw.report.content import RunContent

Meta = Mapping[str, float | str]


@dataclass(frozen=True, slots=True, eq=False)
class RecordedStream:
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


def recorded_streams(run: RunContent) -> dict[str, RecordedStream]:
    """Every stream that a run can fill, by name."""
    found: dict[str, RecordedStream] = {}
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
        found["registration_track"] = RecordedStream(len(table), lambda n: table[:n], {"stage": "tracking"})
    return found


def main_calibration(run: RunContent) -> tuple[str, CalibrationResult] | None:
    """The calibration that a run was made for: the last one with a registration, or else the last one."""
    fitted = [item for item in run.calibrations.items() if item[1].registration is not None]
    every = fitted or list(run.calibrations.items())
    return every[-1] if every else None


def _constant_stream(data: NDArray[Any], meta: Meta) -> RecordedStream:
    return RecordedStream(1, lambda _: data, meta)


def _calibration(label: str, result: CalibrationResult) -> dict[str, RecordedStream]:
    matrix = result.measured or result.matrix
    meta: Meta = {"stage": label, "method": matrix.method, "frames": float(result.frames)}
    found = {
        "valid": _constant_stream(matrix.valid, meta),
        "matrix": _constant_stream(matrix.data, meta),
        "matrix_sigma": _constant_stream(matrix.sigma, meta),
    }
    if result.mean_frame is not None:
        found["frames"] = _constant_stream(result.mean_frame, {"stage": "mean frame"})
    if result.registration is not None:
        found |= _sprint(result.registration)
    return found


def _sprint(estimate: RegistrationEstimate) -> dict[str, RecordedStream]:
    steps = estimate.iterations
    if not steps:
        return {}
    path = np.array([step.registration.to_array() for step in steps]) * TO_STREAM_UNITS
    # The steps tell how the fit went; what came of it, model errors included, is the last word.
    path[-1] = estimate.registration.to_array() * TO_STREAM_UNITS
    norm = np.array([step.step_norm for step in steps])
    sigma, unknown = estimate.sigma * TO_STREAM_UNITS, np.full(len(PARAMETERS), np.nan)
    n = len(steps)
    meta: Meta = {"stage": "SPRINT"}
    return {
        "registration": RecordedStream(n, lambda k: path[:k], meta),
        "step_norm": RecordedStream(n, lambda k: norm[:k], meta),
        "registration_sigma": RecordedStream(n, lambda k: sigma if k == n else unknown, meta),
    }


def _gains(label: str, result: GainsResult) -> dict[str, RecordedStream]:
    rounds = [one.gains for one in result.rounds]
    if not rounds:
        return {}
    meta: Meta = {"stage": "bootstrap", "method": result.method, "label": label}
    n = len(rounds)
    return {
        "gains": RecordedStream(n, lambda k: rounds[k - 1].value, meta),
        "gains_sigma": RecordedStream(n, lambda k: rounds[k - 1].sigma, meta),
        "gains_smooth": RecordedStream(n, lambda k: rounds[k - 1].trend, meta),
        "gains_rounds": RecordedStream(n, lambda k: np.array([one.best for one in rounds[:k]]), meta),
    }


def _loop(label: str, loop: LoopResult) -> dict[str, RecordedStream]:
    meta: Meta = {"stage": label}
    found: dict[str, RecordedStream] = {}
    if loop.last_frame is not None:
        found["frames"] = _constant_stream(loop.last_frame, meta)
    if loop.last_command.size:
        found["commands"] = _constant_stream(loop.last_command, meta)
    if loop.psf is not None:
        found["psf"] = _constant_stream(loop.psf, meta)
    if loop.model_psf is not None:
        found["model_psf"] = _constant_stream(loop.model_psf, meta)
    residual = loop.residual_nm
    if residual.size:
        found["residual"] = RecordedStream(residual.size, lambda k: residual[:k], meta)
    return found


def _table(track: Mapping[str, Any]) -> NDArray[np.float64]:
    """Rows of the stream ``registration_track`` from the document's columns."""
    names = ("seconds", *PARAMETERS, *(f"{name}_sigma" for name in PARAMETERS))
    table = np.array([track[name] for name in names], float).T
    table[:, 1:6] *= TO_STREAM_UNITS
    table[:, 6:11] *= TO_STREAM_UNITS
    return table
