"""Optical gains on disk."""

from __future__ import annotations

from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from astropy.io import fits as astropy_fits
from numpy.typing import NDArray

from escape_hw.api.gains import ClosureStep, GainRound, GainsResult, OpticalGains
from escape_hw.api.results import Measured, StrehlEstimate
from escape_hw.io import fits_file, fits_parts
from escape_hw.io.fits import partial_path
from escape_hw.io.product import Product
from escape_hw.io.provenance import Provenance

KIND_GAINS = "OG"
#: Rows of a gain vector, in the order of :class:`OpticalGains`.
_ROWS = tuple(one.name for one in fields(OpticalGains) if one.name != "common_sigma")
_SCALARS = tuple(one.name for one in fields(GainRound) if one.name not in ("gains", "strehl"))
_WAYS = tuple(one.name for one in fields(StrehlEstimate))


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
        It cannot be written; no half product is left.
    """
    origin = origin or Provenance()
    if result.partial:
        path = partial_path(path)
    head = fits_file.primary(KIND_GAINS, system, simulated, result.partial, origin)
    head.header["METHOD"] = (fits_file.plain(result.method), "the matrix that the gains are relative to")
    head.header["CONVERGE"] = (bool(result.converged), "the bootstrap converged")
    run = {
        "loop_gain": float(result.loop_gain),
        "frames": result.frames,
        "lost_frames": result.lost_frames,
        "notes": list(result.notes),
        "closure": [asdict(step) for step in result.closure],
        "rounds": [_scalars(one) for one in result.rounds],
        "beside": {name: gains.common_sigma for name, gains in result.beside.items()},
    }
    hdus = [head, fits_parts.pack_metrics(run, "RUN"), fits_file.text("CONFIG", origin.config_text)]
    if result.rounds:
        hdus.append(fits_file.image("GAINS", np.stack([_rows(one.gains) for one in result.rounds])))
    if result.beside:
        hdus.append(fits_file.image("BESIDE", np.stack([_rows(one) for one in result.beside.values()])))
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


def _scalars(one: GainRound) -> dict[str, Any]:
    """What a round holds beside its gains' rows, as plain values."""
    plain = {name: getattr(one, name) for name in _SCALARS}
    strehl = None if one.strehl is None else {way: asdict(getattr(one.strehl, way)) for way in _WAYS}
    return {**plain, "common_sigma": one.gains.common_sigma, "strehl": strehl}


def _rows(gains: OpticalGains) -> NDArray[np.float64]:
    return np.stack([getattr(gains, name) for name in _ROWS])


def _gains(rows: NDArray[np.float64], common_sigma: float) -> OpticalGains:
    value, sigma, trend, trend_sigma, best, best_sigma = rows
    return OpticalGains(value, sigma, trend, trend_sigma, best, best_sigma, float(common_sigma))


def _round(rows: NDArray[np.float64], plain: dict[str, Any]) -> GainRound:
    strehl = plain["strehl"]
    made = GainRound(gains=_gains(rows, plain["common_sigma"]), **{name: plain[name] for name in _SCALARS})
    if strehl is None:
        return made
    return replace(made, strehl=StrehlEstimate(*(Measured(**strehl[way]) for way in _WAYS)))


def _unpack(path: Path, hdus: astropy_fits.HDUList, header: dict[str, Any]) -> GainsResult:
    run = fits_parts.unpack_metrics(path, hdus, "RUN")
    rounds, beside = run["rounds"], run["beside"]
    cube = fits_file.array(path, hdus, "GAINS", np.float64) if rounds else np.zeros((0, len(_ROWS), 0))
    others = fits_file.array(path, hdus, "BESIDE", np.float64) if beside else np.zeros((0, len(_ROWS), 0))
    return GainsResult(
        method=str(header["METHOD"]),
        rounds=tuple(_round(rows, plain) for rows, plain in zip(cube, rounds, strict=True)),
        closure=tuple(ClosureStep(**step) for step in run["closure"]),
        converged=bool(header["CONVERGE"]),
        loop_gain=float(run["loop_gain"]),
        frames=int(run["frames"]),
        lost_frames=int(run["lost_frames"]),
        beside={
            name: _gains(rows, common) for rows, (name, common) in zip(others, beside.items(), strict=True)
        },
        partial=header["FINISH"] == "aborted",
        notes=tuple(str(note) for note in run["notes"]),
    )
