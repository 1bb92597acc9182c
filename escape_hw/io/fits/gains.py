"""Optical gains on disk."""

from __future__ import annotations

from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from astropy.io import fits as astropy_fits
from numpy.typing import NDArray

from escape_hw.api.optical_gains import ClosureStep, GainRound, GainsResult, OpticalGains
from escape_hw.api.results import Estimate, StrehlEstimate
from escape_hw.io.fits import extensions as fits_parts
from escape_hw.io.fits import file as fits_file
from escape_hw.io.fits.file import Product
from escape_hw.io.fits.matrix import partial_path
from escape_hw.io.provenance import Provenance

KIND_GAINS = "OG"
#: Rows of a gain vector, in the order of :class:`OpticalGains`.
_VECTOR_NAMES = tuple(one.name for one in fields(OpticalGains) if one.name != "common_sigma")
_ROUND_FIELDS = tuple(one.name for one in fields(GainRound) if one.name not in ("gains", "strehl"))
_STREHL_METHODS = tuple(one.name for one in fields(StrehlEstimate))


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class GainsProduct(Product[GainsResult]):
    """Optical gains read from disk."""


def save_gains(
    path: Path, result: GainsResult, system: str, simulated: bool, origin: Provenance | None = None
) -> Path:
    """Write a bootstrap of optical gains; an aborted one as ``*.partial.fits``.

    The gains of every round are an image ``(rounds, 6, n_modes)`` with the rows value, sigma, trend,
    trend_sigma, best, best_sigma; those of other matrices one ``(matrices, 6, n_modes)``.

    Returns
    -------
    Path
        The file written.

    Raises
    ------
    StorageError
        The file cannot be written; no partial file remains.
    """
    origin = origin or Provenance()
    if result.partial:
        path = partial_path(path)
    primary = fits_file.primary_hdu(KIND_GAINS, system, simulated, result.partial, origin)
    primary.header["METHOD"] = (
        fits_file.header_text(result.method),
        "the matrix that the gains are relative to",
    )
    primary.header["CONVERGE"] = (bool(result.converged), "the bootstrap converged")
    run = {
        "loop_gain": float(result.loop_gain),
        "frames": result.frames,
        "lost_frames": result.lost_frames,
        "notes": list(result.notes),
        "closure": [asdict(step) for step in result.closure],
        "rounds": [_round_scalars(one) for one in result.rounds],
        "beside": {name: gains.common_sigma for name, gains in result.comparisons.items()},
    }
    hdus = [
        primary,
        fits_parts.pack_metrics(run, "RUN"),
        fits_file.text_extension("CONFIG", origin.config_text),
    ]
    if result.rounds:
        hdus.append(
            fits_file.image_extension("GAINS", np.stack([_vector_rows(one.gains) for one in result.rounds]))
        )
    if result.comparisons:
        hdus.append(
            fits_file.image_extension(
                "BESIDE", np.stack([_vector_rows(one) for one in result.comparisons.values()])
            )
        )
    fits_file.write(path, hdus)
    return path


def load_gains(path: Path | str) -> GainsProduct:
    """Read a bootstrap of optical gains.

    Raises
    ------
    ProductError
        Not there, truncated, damaged, of another kind, incomplete or from a newer version.
    """
    return GainsProduct.read(path, KIND_GAINS, _unpack)


def _round_scalars(one: GainRound) -> dict[str, Any]:
    """Scalars of a round."""
    scalars = {name: getattr(one, name) for name in _ROUND_FIELDS}
    strehl = (
        None
        if one.strehl is None
        else {method: asdict(getattr(one.strehl, method)) for method in _STREHL_METHODS}
    )
    return {**scalars, "common_sigma": one.gains.common_sigma, "strehl": strehl}


def _vector_rows(gains: OpticalGains) -> NDArray[np.float64]:
    return np.stack([getattr(gains, name) for name in _VECTOR_NAMES])


def _gains_from_rows(rows: NDArray[np.float64], common_sigma: float) -> OpticalGains:
    value, sigma, trend, trend_sigma, best, best_sigma = rows
    return OpticalGains(value, sigma, trend, trend_sigma, best, best_sigma, float(common_sigma))


def _round_from_rows(rows: NDArray[np.float64], scalars: dict[str, Any]) -> GainRound:
    strehl = scalars["strehl"]
    gain_round = GainRound(
        gains=_gains_from_rows(rows, scalars["common_sigma"]),
        **{name: scalars[name] for name in _ROUND_FIELDS},
    )
    if strehl is None:
        return gain_round
    return replace(
        gain_round, strehl=StrehlEstimate(*(Estimate(**strehl[method]) for method in _STREHL_METHODS))
    )


def _unpack(path: Path, hdus: astropy_fits.HDUList, header: dict[str, Any]) -> GainsResult:
    run = fits_parts.unpack_metrics(path, hdus, "RUN")
    rounds, beside = run["rounds"], run["beside"]
    cube = (
        fits_file.read_array(path, hdus, "GAINS", np.float64)
        if rounds
        else np.zeros((0, len(_VECTOR_NAMES), 0))
    )
    others = (
        fits_file.read_array(path, hdus, "BESIDE", np.float64)
        if beside
        else np.zeros((0, len(_VECTOR_NAMES), 0))
    )
    return GainsResult(
        method=str(header["METHOD"]),
        rounds=tuple(_round_from_rows(rows, scalars) for rows, scalars in zip(cube, rounds, strict=True)),
        closure=tuple(ClosureStep(**step) for step in run["closure"]),
        converged=bool(header["CONVERGE"]),
        loop_gain=float(run["loop_gain"]),
        frames=int(run["frames"]),
        lost_frames=int(run["lost_frames"]),
        comparisons={
            name: _gains_from_rows(rows, shared_sigma)
            for rows, (name, shared_sigma) in zip(others, beside.items(), strict=True)
        },
        partial=header["FINISH"] == "aborted",
        notes=tuple(str(note) for note in run["notes"]),
    )
