"""A tracked run as a document."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import numpy as np

from escape_hw.api.registration import PARAMETERS, UNITS
from escape_hw.api.tracking import TrackResult

#: Rows that a document holds at most; the table beside it has all.
_ROWS = 2000


def track_document(result: TrackResult) -> dict[str, Any]:
    """What ``escape track --json`` says beside the head and the tail."""
    n = len(result.rows["seconds"])
    every = max(1, -(-n // _ROWS))
    residual, strehl = result.column("residual_nm"), result.column("strehl")
    return {
        "seconds": result.rows["seconds"][-1] if n else 0.0,
        "frames": result.frames,
        "lost_frames": result.lost_frames,
        "rate_hz": result.rate_hz,
        "poke": result.poke,
        "stable": result.stable,
        "partial": result.partial,
        "registration": {
            name: {"value": column[-1], "sigma": result.rows[f"{name}_sigma"][-1], "unit": UNITS[name]}
            for name, column in result.rows.items()
            if name in PARAMETERS and n
        },
        "optical_gain": result.optical_gain,
        "optical_gain_sigma": result.optical_gain_sigma,
        "residual_rms_nm": float(np.sqrt(np.nanmean(np.square(residual)))) if n else None,
        "strehl": float(np.nanmean(strehl)) if np.isfinite(strehl).any() else None,
        "exchanges": [asdict(one) for one in result.exchanges],
        "alarms": [asdict(one) for one in result.alarms],
        "track": {name: column[::every] for name, column in result.rows.items()},
    }
