"""Results as JSON documents for ``--json`` and ``result.json``."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import asdict, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np

from escape_hw.api.interaction_matrix import InteractionMatrix
from escape_hw.api.optical_gains import GainRound, GainsResult, OpticalGains
from escape_hw.api.registration import PARAMETERS, UNITS
from escape_hw.api.results import (
    CalibrationResult,
    Estimate,
    LoopResult,
    RegistrationEstimate,
    StrehlEstimate,
)
from escape_hw.api.tracking import TrackResult

#: Version of the documents' fields.
SCHEMA = 1


def to_plain_values(value: Any) -> Any:
    """Plain JSON values; NaN and infinity become ``None``."""
    if isinstance(value, Estimate):
        return to_plain_values(value.to_dict())
    if is_dataclass(value) and not isinstance(value, type):
        return to_plain_values(asdict(value))
    if isinstance(value, Mapping):
        return {str(key): to_plain_values(item) for key, item in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return to_plain_values(value.tolist())
    if isinstance(value, list | tuple | set | frozenset):
        return [to_plain_values(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if isinstance(value, Path):
        return str(value)
    return value


def dumps(document: Mapping[str, Any]) -> str:
    """One strict JSON document (RFC 8259: no NaN)."""
    return json.dumps(to_plain_values(document), indent=2, allow_nan=False, ensure_ascii=False)


def header_fields(
    command: str, system: str | None, simulated: bool | None, seed: int | None
) -> dict[str, Any]:
    """What every document begins with; ``None`` where a command concerns no system."""
    return {"schema": SCHEMA, "command": command, "system": system, "simulated": simulated, "seed": seed}


def snr_document(matrix: InteractionMatrix) -> dict[str, Any]:
    """Minimum and median signal-to-noise ratio over the modes; ``None`` for a computed matrix."""
    snr = matrix.snr()
    return {"min": float(snr.min()), "median": float(np.median(snr))}


def registration_document(estimate: RegistrationEstimate | None) -> dict[str, Any]:
    """What SPRINT found; all ``None`` when it did not run."""
    if estimate is None:
        return dict.fromkeys(
            ("registration", "gain", "gain_sigma", "iterations", "converged", "model_fits", "outcome")
        )
    between_runs = estimate.repeatability_sigma
    return {
        "registration": {name: value.to_dict() for name, value in estimate.parameters().items()},
        "repeatability_sigma": (
            None if between_runs is None else dict(zip(PARAMETERS, between_runs.tolist(), strict=True))
        ),
        "gain": estimate.gain.value,
        "gain_sigma": estimate.gain.sigma,
        "width": estimate.width.to_dict(),
        "extras": {name: value.to_dict() for name, value in estimate.extras.items()},
        "iterations": len(estimate.iterations),
        "converged": estimate.converged,
        "model_fits": estimate.model_fits,
        "misfit": None if estimate.goodness_of_fit is None else estimate.goodness_of_fit.misfit,
        "outcome": estimate.outcome,
        "chi2": estimate.chi2,
        "warnings": list(estimate.warnings),
        "registration_notes": list(estimate.notes),
        "influence_profile": to_plain_values(estimate.influence_profile),
    }


def calibration_document(result: CalibrationResult) -> dict[str, Any]:
    """A calibration in plain values; the signal-to-noise ratio is that of the measured matrix."""
    response = result.response
    return {
        "method": result.matrix.method,
        "frames": result.frames,
        "lost_frames": result.lost_frames,
        "sky_seconds": result.sky_seconds,
        "n_modes": result.matrix.n_modes,
        "n_sub_apertures": result.grid.n_valid,
        **registration_document(result.registration),
        "snr": snr_document(result.measured or result.matrix),
        "clipped_pokes": (result.measured or result.matrix).metrics.get("clipped_pokes"),
        "delay_frames": None if response is None else response.delay_frames,
        "response": None if response is None else {"weights": response.weights, "sigma": response.sigma},
        "partial": result.partial,
        "notes": list(result.notes),
    }


def strehl_document(strehl: StrehlEstimate | None) -> dict[str, Any] | None:
    """The Strehl ratio three ways; ``None`` where it was not measured."""
    if strehl is None:
        return None
    methods = {"peak": strehl.peak, "otf": strehl.otf, "encircled": strehl.encircled}
    return {name: {"value": one.value, "sigma": one.sigma} for name, one in methods.items()}


def loop_document(result: LoopResult) -> dict[str, Any]:
    """A closed-loop run in plain values."""
    return {
        **_attributes(result, "method", "gain", "gain_sigma", "leak", "dropped_modes", "frames"),
        "strehl": strehl_document(result.strehl),
        **_attributes(result, "residual_rms_nm", "rate_hz"),
        "latency_us": dict(result.latency_us),
        **_attributes(result, "lost_frames", "stable", "partial"),
        "notes": list(result.notes),
    }


def gains_document(result: GainsResult) -> dict[str, Any]:
    """A bootstrap of optical gains in plain values; ``optical_gain`` is what to scale a matrix by."""
    gains = result.gains
    no_gains = {"optical_gain": None, "sigma": None, "common_sigma": None}
    return {
        "method": result.method,
        **(no_gains if gains is None else _best_gains(gains)),
        "as_measured": None if gains is None else {"value": gains.value, "sigma": gains.sigma},
        "trend": None if gains is None else {"value": gains.trend, "sigma": gains.trend_sigma},
        "rounds": [_round_document(one) for one in result.rounds],
        "closure": [asdict(step) for step in result.closure],
        **_attributes(result, "converged", "loop_gain", "frames", "lost_frames"),
        "beside": {name: _best_gains(one) for name, one in result.comparisons.items()},
        "partial": result.partial,
        "notes": list(result.notes),
    }


def _round_document(one: GainRound) -> dict[str, Any]:
    return {
        **_attributes(one, "poke", "frames"),
        **_best_gains(one.gains),
        **_attributes(one, "change", "expected_change", "reached", "residual_nm", "strehl_loss"),
        "strehl": strehl_document(one.strehl),
    }


def _best_gains(gains: OpticalGains) -> dict[str, Any]:
    return {"optical_gain": gains.best, "sigma": gains.best_sigma, "common_sigma": gains.common_sigma}


def _attributes(result: object, *names: str) -> dict[str, Any]:
    return {name: getattr(result, name) for name in names}


#: Maximum number of rows in a document; the CSV table has all rows.
_MAX_ROWS = 2000


def track_document(result: TrackResult) -> dict[str, Any]:
    """Fields of ``escape track --json`` apart from header and footer."""
    n = len(result.rows["seconds"])
    stride = max(1, -(-n // _MAX_ROWS))
    residual, strehl = result.column("residual_nm"), result.column("strehl")
    return {
        "seconds": result.rows["seconds"][-1] if n else 0.0,
        **_attributes(result, "frames", "lost_frames", "rate_hz", "poke", "stable", "partial"),
        "registration": {
            name: {"value": column[-1], "sigma": result.rows[f"{name}_sigma"][-1], "unit": UNITS[name]}
            for name, column in result.rows.items()
            if name in PARAMETERS and n
        },
        **_attributes(result, "optical_gain", "optical_gain_sigma"),
        "residual_rms_nm": float(np.sqrt(np.nanmean(np.square(residual)))) if n else None,
        "strehl": float(np.nanmean(strehl)) if np.isfinite(strehl).any() else None,
        "exchanges": [asdict(one) for one in result.exchanges],
        "alarms": [asdict(one) for one in result.alarms],
        "track": {name: column[::stride] for name, column in result.rows.items()},
    }
