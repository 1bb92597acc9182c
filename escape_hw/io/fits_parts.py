"""The parts of a product as FITS extensions, and back."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from astropy.io import fits

from escape_hw.api.departures import MirrorDepartures
from escape_hw.api.registration import PARAMETERS, Registration
from escape_hw.api.results import Measured, RegistrationEstimate, SprintIteration, TemporalResponse
from escape_hw.errors import ProductError
from escape_hw.io import fits_file


def pack_metrics(metrics: Mapping[str, Any], name: str = "METRICS") -> fits.BinTableHDU:
    """Scalars by name as a table.

    Numbers stand in the column VALUE, where NaN and infinity are allowed (a header card cannot
    hold them); whatever is no float is kept exactly as JSON in the column TEXT.
    """
    numbers, exact = [], []
    for value in metrics.values():
        if isinstance(value, np.generic | np.ndarray):
            value = value.tolist()
        if isinstance(value, float):
            numbers.append(value)
            exact.append("")
        else:
            numbers.append(float(value) if isinstance(value, int) else math.nan)
            exact.append(json.dumps(value))
    return fits_file.table(
        name,
        {
            "NAME": np.array([json.dumps(key) for key in metrics], dtype=str),
            "VALUE": np.array(numbers, float),
            "TEXT": np.array(exact, dtype=str),
        },
    )


def unpack_metrics(path: Path, hdus: fits.HDUList, name: str = "METRICS") -> dict[str, Any]:
    """Inverse of :func:`pack_metrics`."""
    data = fits_file.need(path, hdus, name).data
    try:
        return {
            json.loads(row["NAME"]): json.loads(row["TEXT"]) if row["TEXT"] else float(row["VALUE"])
            for row in data
        }
    except (KeyError, ValueError, TypeError) as error:
        raise ProductError(f"{path}: extension {name} is no table of metrics ({error})") from error


def pack_response(response: TemporalResponse) -> fits.BinTableHDU:
    """The temporal response, one row per frame of delay."""
    return fits_file.table("RESPONSE", {"WEIGHT": response.weights, "SIGMA": response.sigma})


def unpack_response(path: Path, hdus: fits.HDUList) -> TemporalResponse | None:
    """Inverse of :func:`pack_response`; ``None`` when the product has none."""
    if "RESPONSE" not in hdus:
        return None
    return TemporalResponse(_column(hdus, "RESPONSE", "WEIGHT"), _column(hdus, "RESPONSE", "SIGMA"))


def pack_registration(estimate: RegistrationEstimate) -> list[Any]:
    """Parameters with errors, their covariance, and the iterations that led there."""
    rows = [*estimate.measured().values(), estimate.gain, estimate.width]
    alpha = fits_file.table(
        "ALPHA",
        {
            "NAME": np.array([*PARAMETERS, "gain", "width"]),
            "VALUE": np.array([row.value for row in rows]),
            "SIGMA": np.array([row.sigma for row in rows]),
            "UNIT": np.array([fits_file.plain(row.unit) for row in rows]),
        },
        CONVERGE=bool(estimate.converged),
    )
    steps = estimate.iterations
    values = np.array([step.registration.to_array() for step in steps]).reshape(-1, len(PARAMETERS))
    iterations = fits_file.table(
        "SPRINT",
        {
            **{name.upper(): values[:, i] for i, name in enumerate(PARAMETERS)},
            "GAIN": np.array([step.gain for step in steps], float),
            "STEP": np.array([step.step_norm for step in steps], float),
            "CHI2": np.array([step.chi2 for step in steps], float),
        },
    )
    notes = {
        "chi2": float(estimate.chi2),
        "warnings": list(estimate.warnings),
        "notes": list(estimate.notes),
    }
    return [
        alpha,
        fits_file.image("COVAR", np.asarray(estimate.covariance, np.float64)),
        iterations,
        pack_metrics(notes, "ALPHANOT"),
        *([] if estimate.departures is None else [_pack_departures(estimate.departures)]),
    ]


def _pack_departures(apart: MirrorDepartures) -> fits.BinTableHDU:
    columns = {"GAIN": apart.gain, "SIGMA": apart.gain_sigma, "WIDTH": apart.width}
    return fits_file.table("ACTUATOR", columns, PEDESTAL=float(apart.pedestal))


def _unpack_departures(hdus: fits.HDUList) -> MirrorDepartures | None:
    """``None`` where SPRINT did not look, and in products of earlier versions."""
    if "ACTUATOR" not in hdus:
        return None
    gain, sigma, width = (_column(hdus, "ACTUATOR", name) for name in ("GAIN", "SIGMA", "WIDTH"))
    return MirrorDepartures(gain, sigma, width, float(hdus["ACTUATOR"].header["PEDESTAL"]))


def unpack_registration(path: Path, hdus: fits.HDUList) -> RegistrationEstimate | None:
    """Inverse of :func:`pack_registration`; ``None`` when the product has none."""
    if "ALPHA" not in hdus:
        return None
    value, sigma = _column(hdus, "ALPHA", "VALUE"), _column(hdus, "ALPHA", "SIGMA")
    units = [str(unit) for unit in hdus["ALPHA"].data["UNIT"]]
    notes = unpack_metrics(path, hdus, "ALPHANOT")
    fits_file.need(path, hdus, "SPRINT")
    columns = [_column(hdus, "SPRINT", name.upper()) for name in PARAMETERS]
    gain, step, chi2 = (_column(hdus, "SPRINT", name) for name in ("GAIN", "STEP", "CHI2"))
    n = len(PARAMETERS)
    return RegistrationEstimate(
        registration=Registration.from_array(value[:n]),
        covariance=fits_file.array(path, hdus, "COVAR", np.float64),
        gain=Measured(float(value[n]), float(sigma[n]), units[n]),
        width=Measured(float(value[n + 1]), float(sigma[n + 1]), units[n + 1]),
        converged=bool(hdus["ALPHA"].header["CONVERGE"]),
        iterations=tuple(
            SprintIteration(
                Registration.from_array([column[i] for column in columns]),
                float(gain[i]),
                float(step[i]),
                float(chi2[i]),
            )
            for i in range(gain.size)
        ),
        chi2=float(notes["chi2"]),
        warnings=tuple(str(note) for note in notes["warnings"]),
        # Products of earlier versions have none.
        notes=tuple(str(note) for note in notes.get("notes", ())),
        departures=_unpack_departures(hdus),
    )


def _column(hdus: fits.HDUList, extension: str, name: str) -> Any:
    return np.asarray(hdus[extension].data[name], dtype=np.float64)
