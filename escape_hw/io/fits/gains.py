"""Optical gains on disk."""

from __future__ import annotations

from dataclasses import asdict, dataclass, fields
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
from escape_hw.io.provenance import Provenance

KIND_GAINS = "OG"
#: Rows of a gain vector, in the order of :class:`OpticalGains`.
_VECTOR_NAMES = tuple(one.name for one in fields(OpticalGains) if one.name != "common_sigma")
_ROUND_FIELDS = tuple(one.name for one in fields(GainRound) if one.name not in ("gains", "strehl"))


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
    run = {
        "loop_gain": float(result.loop_gain),
        "frames": result.frames,
        "lost_frames": result.lost_frames,
        "notes": list(result.notes),
        "closure": [asdict(step) for step in result.closure],
        "rounds": [_round_scalars(one) for one in result.rounds],
        "beside": {name: gains.common_sigma for name, gains in result.comparisons.items()},
    }
    cubes = {
        "GAINS": [_vector_rows(one.gains) for one in result.rounds],
        "BESIDE": [_vector_rows(one) for one in result.comparisons.values()],
    }
    images = [fits_file.image_extension(name, np.stack(cube)) for name, cube in cubes.items() if cube]
    cards = {
        "METHOD": (result.method, "the matrix that the gains are relative to"),
        "CONVERGE": (bool(result.converged), "the bootstrap converged"),
    }
    return fits_file.write_product(
        path, KIND_GAINS, [fits_parts.pack_metrics(run, "RUN"), *images], system, simulated, origin,
        partial=result.partial, cards=cards,
    )  # fmt: skip


def load_gains(path: Path | str) -> GainsProduct:
    """Read a bootstrap of optical gains.

    Raises
    ------
    ProductError
        Not there, truncated, damaged, of another kind, incomplete or from a newer version.
    """
    return GainsProduct.read(path, KIND_GAINS, _unpack)


def _round_scalars(one: GainRound) -> dict[str, Any]:
    scalars = {name: getattr(one, name) for name in _ROUND_FIELDS}
    strehl = None if one.strehl is None else asdict(one.strehl)
    return {**scalars, "common_sigma": one.gains.common_sigma, "strehl": strehl}


def _vector_rows(gains: OpticalGains) -> NDArray[np.float64]:
    return np.stack([getattr(gains, name) for name in _VECTOR_NAMES])


def _unpack_round(rows: NDArray[np.float64], scalars: dict[str, Any]) -> GainRound:
    strehl = scalars["strehl"]
    if strehl is not None:
        strehl = StrehlEstimate(**{method: Estimate(**value) for method, value in strehl.items()})
    fields_of_round = {name: scalars[name] for name in _ROUND_FIELDS}
    return GainRound(_unpack_gains(rows, scalars["common_sigma"]), strehl=strehl, **fields_of_round)


def _unpack_gains(rows: NDArray[np.float64], common_sigma: float) -> OpticalGains:
    return OpticalGains(**dict(zip(_VECTOR_NAMES, rows, strict=True)), common_sigma=float(common_sigma))


def _unpack(path: Path, hdus: astropy_fits.HDUList, header: dict[str, Any]) -> GainsResult:
    run = fits_parts.unpack_metrics(path, hdus, "RUN")
    # An extension that would hold no array is not written.
    rounds, others = (
        fits_file.read_array(path, hdus, name, np.float64) if run[key] else ()
        for name, key in (("GAINS", "rounds"), ("BESIDE", "beside"))
    )
    return GainsResult(
        method=str(header["METHOD"]),
        rounds=tuple(_unpack_round(*one) for one in zip(rounds, run["rounds"], strict=True)),
        closure=tuple(ClosureStep(**step) for step in run["closure"]),
        converged=bool(header["CONVERGE"]),
        loop_gain=float(run["loop_gain"]),
        frames=int(run["frames"]),
        lost_frames=int(run["lost_frames"]),
        comparisons={
            name: _unpack_gains(rows, common_sigma)
            for rows, (name, common_sigma) in zip(others, run["beside"].items(), strict=True)
        },
        partial=header["FINISH"] == "aborted",
        notes=tuple(str(note) for note in run["notes"]),
    )
