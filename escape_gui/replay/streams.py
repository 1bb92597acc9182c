"""Streams of a server, reconstructed from the products of a run."""

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
    """Entries of a stream during a run."""

    #: Number of steps.
    length: int
    #: Returns the entry after a step, 1 to ``length``.
    at: Callable[[int], NDArray[Any]]
    #: Metadata of all entries.
    meta: Meta


def recorded_streams(run: RunContent) -> dict[str, RecordedStream]:
    """All streams for which a run has data, by name."""
    streams: dict[str, RecordedStream] = {}
    main = main_calibration(run)
    if main is not None:
        streams |= _calibration(*main)
    for label, gains in run.gains.items():
        streams |= _gains(label, gains)
    if run.loops:
        streams |= _loop(*list(run.loops.items())[-1])
    track = run.document.get("track")
    if track and track["seconds"]:
        table = _table(track)
        streams["registration_track"] = RecordedStream(len(table), lambda n: table[:n], {"stage": "tracking"})
    return streams


def main_calibration(run: RunContent) -> tuple[str, CalibrationResult] | None:
    """Label and result of a run's last calibration with a registration, else of its last calibration."""
    fitted = [item for item in run.calibrations.items() if item[1].registration is not None]
    candidates = fitted or list(run.calibrations.items())
    return candidates[-1] if candidates else None


def _constant_stream(data: NDArray[Any], meta: Meta) -> RecordedStream:
    return RecordedStream(1, lambda _: data, meta)


def _calibration(label: str, result: CalibrationResult) -> dict[str, RecordedStream]:
    matrix = result.measured or result.matrix
    meta: Meta = {"stage": label, "method": matrix.method, "frames": float(result.frames)}
    streams = {
        "valid": _constant_stream(matrix.valid, meta),
        "matrix": _constant_stream(matrix.data, meta),
        "matrix_sigma": _constant_stream(matrix.sigma, meta),
    }
    if result.mean_frame is not None:
        streams["frames"] = _constant_stream(result.mean_frame, {"stage": "mean frame"})
    if result.registration is not None:
        streams |= _sprint(result.registration)
    return streams


def _sprint(estimate: RegistrationEstimate) -> dict[str, RecordedStream]:
    steps = estimate.iterations
    if not steps:
        return {}
    path = np.array([step.registration.to_array() for step in steps]) * TO_STREAM_UNITS
    # The result differs from the last step by the corrections for model errors.
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
    streams: dict[str, RecordedStream] = {}
    if loop.last_frame is not None:
        streams["frames"] = _constant_stream(loop.last_frame, meta)
    if loop.last_command.size:
        streams["commands"] = _constant_stream(loop.last_command, meta)
    if loop.psf is not None:
        streams["psf"] = _constant_stream(loop.psf, meta)
    if loop.model_psf is not None:
        streams["model_psf"] = _constant_stream(loop.model_psf, meta)
    residual = loop.residual_nm
    if residual.size:
        streams["residual"] = RecordedStream(residual.size, lambda k: residual[:k], meta)
    return streams


def _table(track: Mapping[str, Any]) -> NDArray[np.float64]:
    """Stream ``registration_track`` ``(n, 11)`` from the columns of the document."""
    names = ("seconds", *PARAMETERS, *(f"{name}_sigma" for name in PARAMETERS))
    table = np.array([track[name] for name in names], float).T
    table[:, 1:6] *= TO_STREAM_UNITS
    table[:, 6:11] *= TO_STREAM_UNITS
    return table
