"""FITS extensions that several products share: sensor geometry, metrics, temporal response, registration."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from astropy.io import fits
from numpy.typing import NDArray

from escape_hw.api.influence import InfluenceProfile
from escape_hw.api.pyramid import PyramidPupils
from escape_hw.api.registration import PARAMETERS, Registration
from escape_hw.api.results import (
    ActuatorCorrections,
    Estimate,
    GoodnessOfFit,
    RegistrationEstimate,
    SprintIteration,
    TemporalResponse,
)
from escape_hw.api.sensor import SensorGeometry, SubApertureGrid, require_kind
from escape_hw.errors import ProductError
from escape_hw.io.fits import file as fits_file

_PUPILS = "PUPILS"
_COMMON_CARDS = {"COUNTS": "counts", "BACKGND": "background"}
#: Header cards of every kind of geometry and the attribute that each holds; those that early versions did
#: not write have a default there.
_CARDS: dict[str, dict[str, str]] = {
    SubApertureGrid.kind: {
        "PITCH": "pitch_px", "MOTION": "motion_px", "AIR": "turbulence_px", "POKES": "pokes",
        "NOISE": "pixel_noise", **_COMMON_CARDS,
    },
    PyramidPupils.kind: {
        "DIAMETER": "diameter_px", "MOTION": "motion", "CENTRESD": "centre_sigma_px", "POKES": "pokes",
        "LOOKS": "n_effective", "STEADY": "persistent_fraction", "NORMAL": "normalisation",
        "MODULAT": "modulation", "TILTRMS": "residual_tilt", **_COMMON_CARDS,
    },
}  # fmt: skip


#: Header cards of ``SubApertureGrid.numbering_offsets``: least and largest along x, then along y.
_NUMBERING = ("NUMBXMIN", "NUMBXMAX", "NUMBYMIN", "NUMBYMAX")
#: Header cards of ``PyramidPupils.mean_low_orders``, those of the x slopes before those of the y slopes.
_LOW_ORDERS = tuple(f"MEAN{axis}{number}" for axis in "XY" for number in range(6))


def geometry_cards(geometry: SensorGeometry) -> dict[str, float | str]:
    """Scalars of a geometry by FITS keyword."""
    values = {key: getattr(geometry, name) for key, name in _CARDS[geometry.kind].items()}
    if isinstance(geometry, SubApertureGrid):
        values |= {"ORIGINX": geometry.origin_px[0], "ORIGINY": geometry.origin_px[1]}
        values |= dict(zip(_NUMBERING, np.ravel(geometry.numbering_offsets), strict=True))
    if isinstance(geometry, PyramidPupils) and geometry.mean_low_orders is not None:
        values |= dict(zip(_LOW_ORDERS, geometry.mean_low_orders.T.ravel(), strict=True))
    return {key: value if isinstance(value, str) else float(value) for key, value in values.items()}


def geometry_fields(kind: str, cards: Mapping[str, Any]) -> dict[str, Any]:
    """Inverse of :func:`geometry_cards` but for the origin: arguments of the geometry, where given."""
    found = {name: cards[key] for key, name in _CARDS[kind].items() if key in cards}
    fields: dict[str, Any] = {
        name: value if isinstance(value, str) else float(value) for name, value in found.items()
    }
    if kind == SubApertureGrid.kind:
        offsets = [int(cards.get(key, 0)) for key in _NUMBERING]
        fields["numbering_offsets"] = (tuple(offsets[:2]), tuple(offsets[2:]))
    elif all(key in cards for key in _LOW_ORDERS):
        coefficients = [float(cards[key]) for key in _LOW_ORDERS]
        fields["mean_low_orders"] = np.reshape(coefficients, (2, -1)).T
    return fields


def reference_slopes(geometry: SensorGeometry) -> NDArray[np.float32]:
    """Reference slopes ``(n_valid, 2)`` in the unit of the slopes."""
    if isinstance(geometry, PyramidPupils):
        return np.asarray(geometry.references, np.float32)
    return np.asarray(require_kind(geometry, SubApertureGrid).references_px, np.float32)


def pack_grid(grid: SensorGeometry) -> list[Any]:
    """The mask, the references with all numbers of the geometry as cards, and the flux map.

    The card SENSOR gives the kind of sensor.
    """
    references, cards = reference_slopes(grid), {**geometry_cards(grid), "SENSOR": grid.kind}
    hdus = [
        fits_file.image_extension("VALID", grid.valid),
        fits_file.image_extension("GRID", references, grid.slope_unit, **cards),
        fits_file.image_extension("FLUX", np.asarray(grid.flux, np.float32)),
    ]
    if isinstance(grid, PyramidPupils):
        (x, y), (left, top) = grid.centres_px.T, grid.corners_px.T
        hdus.append(fits_file.table_extension(_PUPILS, {"X": x, "Y": y, "CORNERX": left, "CORNERY": top}))
    return hdus


def unpack_grid(path: Path, hdus: fits.HDUList) -> SensorGeometry:
    """Inverse of :func:`pack_grid`.

    Raises
    ------
    ProductError
        Parts are missing, do not fit each other, or belong to a kind of sensor that is not known.
    """
    header = fits_file.require_extension(path, hdus, "GRID").header
    valid = fits_file.read_array(path, hdus, "VALID", np.uint8).astype(bool)
    references = fits_file.read_array(path, hdus, "GRID", np.float32)
    if references.shape != (int(valid.sum()), 2):
        raise ProductError(f"{path}: GRID has shape {references.shape}, VALID marks {int(valid.sum())}")
    fits_file.require_values(path, "GRID", references, -1e6, 1e6)
    # Products of early versions have no card SENSOR; they are Shack-Hartmann sensors.
    kind = str(header.get("SENSOR", SubApertureGrid.kind))
    if kind not in _CARDS:
        raise ProductError(f"{path}: its sensor is of kind '{kind}'; this version reads {', '.join(_CARDS)}")
    fields = {
        "valid": valid,
        "flux": fits_file.read_array(path, hdus, "FLUX", np.float32),
        **geometry_fields(kind, header),
    }
    if kind == SubApertureGrid.kind:
        origin = (float(header["ORIGINX"]), float(header["ORIGINY"]))
        return SubApertureGrid(origin_px=origin, references_px=references, **fields)
    table = fits_file.require_extension(path, hdus, _PUPILS).data
    if len(table) != 4:
        raise ProductError(f"{path}: {_PUPILS} has {len(table)} rows; a pyramid makes four images")
    return PyramidPupils(
        centres_px=np.stack([table["X"], table["Y"]], axis=1).astype(np.float64),
        corners_px=np.stack([table["CORNERX"], table["CORNERY"]], axis=1).astype(np.intp),
        references=references,
        **fields,
    )


def pack_metrics(metrics: Mapping[str, Any], name: str = "METRICS") -> fits.BinTableHDU:
    """Scalars by name as a table.

    Numbers are stored in the column VALUE, where NaN and infinity are allowed (a header card cannot
    hold them); whatever is no float is kept exactly as JSON in the column TEXT.
    """
    numbers, as_text = [], []
    for value in metrics.values():
        if isinstance(value, np.generic | np.ndarray):
            value = value.tolist()
        if isinstance(value, float):
            numbers.append(value)
            as_text.append("")
        else:
            numbers.append(float(value) if isinstance(value, int) else math.nan)
            as_text.append(json.dumps(value))
    return fits_file.table_extension(
        name,
        {
            "NAME": np.array([json.dumps(key) for key in metrics], dtype=str),
            "VALUE": np.array(numbers, float),
            "TEXT": np.array(as_text, dtype=str),
        },
    )


def unpack_metrics(path: Path, hdus: fits.HDUList, name: str = "METRICS") -> dict[str, Any]:
    """Inverse of :func:`pack_metrics`."""
    data = fits_file.require_extension(path, hdus, name).data
    try:
        return {
            json.loads(row["NAME"]): json.loads(row["TEXT"]) if row["TEXT"] else float(row["VALUE"])
            for row in data
        }
    except (KeyError, ValueError, TypeError) as error:
        raise ProductError(f"{path}: extension {name} is not a table of metrics ({error})") from error


def pack_response(response: TemporalResponse) -> fits.BinTableHDU:
    """The temporal response, one row per frame of delay."""
    return fits_file.table_extension("RESPONSE", {"WEIGHT": response.weights, "SIGMA": response.sigma})


def unpack_response(path: Path, hdus: fits.HDUList) -> TemporalResponse | None:
    """Inverse of :func:`pack_response`; ``None`` when the product has none."""
    if "RESPONSE" not in hdus:
        return None
    return TemporalResponse(_column(hdus, "RESPONSE", "WEIGHT"), _column(hdus, "RESPONSE", "SIGMA"))


def pack_registration(estimate: RegistrationEstimate) -> list[Any]:
    """Parameters with errors, their covariance, and the iterations that led there."""
    rows = [*estimate.parameters().values(), estimate.gain, estimate.width, *estimate.extras.values()]
    alpha = fits_file.table_extension(
        "ALPHA",
        {
            "NAME": np.array([*PARAMETERS, "gain", "width", *estimate.extras]),
            "VALUE": np.array([row.value for row in rows]),
            "SIGMA": np.array([row.sigma for row in rows]),
            "UNIT": np.array([fits_file.header_text(row.unit) for row in rows]),
        },
        CONVERGE=bool(estimate.converged),
    )
    steps = estimate.iterations
    values = np.array([step.registration.to_array() for step in steps]).reshape(-1, len(PARAMETERS))
    iterations = fits_file.table_extension(
        "SPRINT",
        {
            **{name.upper(): values[:, i] for i, name in enumerate(PARAMETERS)},
            "GAIN": np.array([step.gain for step in steps], float),
            "STEP": np.array([step.step_norm for step in steps], float),
            "CHI2": np.array([step.chi2 for step in steps], float),
        },
    )
    between_runs = estimate.repeatability_covariance
    notes = {
        "chi2": float(estimate.chi2),
        "warnings": list(estimate.warnings),
        "notes": list(estimate.notes),
    }
    return [
        alpha,
        fits_file.image_extension("COVAR", np.asarray(estimate.covariance, np.float64)),
        iterations,
        pack_metrics(notes, "ALPHANOT"),
        *([] if between_runs is None else [fits_file.image_extension("REPEATCO", between_runs)]),
        *([] if estimate.goodness_of_fit is None else _pack_goodness_of_fit(estimate.goodness_of_fit)),
        *([] if estimate.actuator_corrections is None else _pack_actuators(estimate.actuator_corrections)),
        *([] if estimate.influence_profile is None else [pack_profile(estimate.influence_profile)]),
    ]


def _pack_goodness_of_fit(found: GoodnessOfFit) -> list[fits.BinTableHDU]:
    """Residuals of the sub-apertures with what they amount to, and of the actuators."""
    return [
        fits_file.table_extension(
            "RESIDSUB", {"RMS": found.by_sub_aperture}, MODELFIT=found.fits, MISFIT=found.misfit
        ),
        fits_file.table_extension("RESIDACT", {"RMS": found.by_actuator}),
    ]


def _unpack_goodness_of_fit(path: Path, hdus: fits.HDUList) -> GoodnessOfFit | None:
    """``None`` where the fit was not judged, as in products of earlier versions."""
    if "RESIDSUB" not in hdus:
        return None
    fits_file.require_extension(path, hdus, "RESIDACT")
    header = hdus["RESIDSUB"].header
    return GoodnessOfFit(
        bool(header["MODELFIT"]), float(header["MISFIT"]),
        *(_column(hdus, name, "RMS") for name in ("RESIDSUB", "RESIDACT")),
    )  # fmt: skip


#: Column of the share of a broad component in products of version 0.1.0, among the terms of the shape.
_PEDESTAL_TERM = 2


#: Columns of the errors of width and positions, which products of early versions do not have.
_ACTUATOR_ERRORS = ("WIDTH_SIG", "SHIFT_X_SIG", "SHIFT_Y_SIG")


def _pack_actuators(corrections: ActuatorCorrections) -> list[Any]:
    columns = {
        "GAIN": corrections.gain, "SIGMA": corrections.gain_sigma, "WIDTH": corrections.width,
        "SHIFT_X": corrections.position[0], "SHIFT_Y": corrections.position[1],
    }  # fmt: skip
    errors = corrections.width_sigma, *corrections.position_sigma
    for name, sigma in zip(_ACTUATOR_ERRORS, errors, strict=True):
        columns[name] = np.broadcast_to(sigma, corrections.gain.shape)
    hdus = [
        fits_file.table_extension("ACTUATOR", columns),
        fits_file.table_extension("SHAPE", {"VALUE": corrections.shape}),
    ]
    if corrections.shape_covariance is not None:
        hdus.append(
            fits_file.image_extension("SHAPECOV", np.asarray(corrections.shape_covariance, np.float64))
        )
    return hdus


def _unpack_actuators(path: Path, hdus: fits.HDUList) -> ActuatorCorrections | None:
    """``None`` where SPRINT did not fit actuators."""
    if "ACTUATOR" not in hdus:
        return None
    gain, sigma, width = (_column(hdus, "ACTUATOR", name) for name in ("GAIN", "SIGMA", "WIDTH"))
    if "SHAPE" not in hdus:  # version 0.1.0
        shape = np.zeros(_PEDESTAL_TERM + 1)
        shape[_PEDESTAL_TERM] = float(hdus["ACTUATOR"].header["PEDESTAL"])
        return ActuatorCorrections(gain, sigma, width, shape, np.zeros((2, gain.size)))
    position = np.stack([_column(hdus, "ACTUATOR", name) for name in ("SHIFT_X", "SHIFT_Y")])
    shape = _column(hdus, "SHAPE", "VALUE")
    if "SHAPECOV" not in hdus:
        return ActuatorCorrections(gain, sigma, width, shape, position)
    errors = [_column(hdus, "ACTUATOR", name) for name in _ACTUATOR_ERRORS]
    return ActuatorCorrections(
        gain, sigma, width, shape, position, errors[0], np.stack(errors[1:]),
        fits_file.read_array(path, hdus, "SHAPECOV", np.float64),
    )  # fmt: skip


#: Columns of the profile of the influence functions and its attributes.
_PROFILE_COLUMNS = {
    "RADIUS": "radius", "NOMINAL": "nominal", "FITTED": "fitted", "SIGMA": "sigma", "EDGE": "edge",
    "EDGE_SIG": "edge_sigma",
}  # fmt: skip


def pack_profile(profile: InfluenceProfile) -> fits.BinTableHDU:
    """Profile of the influence functions; NaN where there is none of edge actuators."""
    columns = {key: np.asarray(getattr(profile, name)) for key, name in _PROFILE_COLUMNS.items()}
    missing = np.full(profile.radius.size, np.nan)
    return fits_file.table_extension(
        "PROFILE", {key: values if values.size else missing for key, values in columns.items()}
    )


def unpack_profile(hdus: fits.HDUList) -> InfluenceProfile | None:
    """Inverse of :func:`pack_profile`; ``None`` when the product has none."""
    if "PROFILE" not in hdus:
        return None
    columns = {name: _column(hdus, "PROFILE", key) for key, name in _PROFILE_COLUMNS.items()}
    if np.isnan(columns["edge"]).all():
        columns |= {"edge": np.zeros(0), "edge_sigma": np.zeros(0)}
    return InfluenceProfile(**columns)


def unpack_registration(path: Path, hdus: fits.HDUList) -> RegistrationEstimate | None:
    """Inverse of :func:`pack_registration`; ``None`` when the product has none."""
    if "ALPHA" not in hdus:
        return None
    value, sigma = _column(hdus, "ALPHA", "VALUE"), _column(hdus, "ALPHA", "SIGMA")
    units = [str(unit) for unit in hdus["ALPHA"].data["UNIT"]]
    names = [str(name) for name in hdus["ALPHA"].data["NAME"]]
    notes = unpack_metrics(path, hdus, "ALPHANOT")
    fits_file.require_extension(path, hdus, "SPRINT")
    columns = [_column(hdus, "SPRINT", name.upper()) for name in PARAMETERS]
    gain, step, chi2 = (_column(hdus, "SPRINT", name) for name in ("GAIN", "STEP", "CHI2"))
    n = len(PARAMETERS)
    return RegistrationEstimate(
        registration=Registration.from_array(value[:n]),
        covariance=fits_file.read_array(path, hdus, "COVAR", np.float64),
        gain=Estimate(float(value[n]), float(sigma[n]), units[n]),
        width=Estimate(float(value[n + 1]), float(sigma[n + 1]), units[n + 1]),
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
        extras={
            names[k]: Estimate(float(value[k]), float(sigma[k]), units[k]) for k in range(n + 2, len(names))
        },
        actuator_corrections=_unpack_actuators(path, hdus),
        influence_profile=unpack_profile(hdus),
        repeatability_covariance=(
            fits_file.read_array(path, hdus, "REPEATCO", np.float64) if "REPEATCO" in hdus else None
        ),
        goodness_of_fit=_unpack_goodness_of_fit(path, hdus),
    )


def _column(hdus: fits.HDUList, extension: str, name: str) -> Any:
    return np.asarray(hdus[extension].data[name], dtype=np.float64)
