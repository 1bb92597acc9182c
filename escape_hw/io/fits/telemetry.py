"""Recorded telemetry of a loop on disk: slopes and the commands that answered them, frame by frame."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from astropy.io import fits as astropy_fits
from numpy.typing import NDArray

from escape_hw.api.representation import short_repr
from escape_hw.io.fits import file as fits_file
from escape_hw.io.fits.file import Product
from escape_hw.io.provenance import Provenance

KIND_TELEMETRY = "TELEM"
#: Extension, type and unit of every part.
_PARTS = {
    "index": ("INDEX", np.int64, ""),
    "exposed_s": ("EXPOSED", np.float64, "s"),
    "slopes": ("SLOPES", np.float32, ""),
    "commands": ("COMMANDS", np.float64, ""),
}


@dataclass(frozen=True, slots=True, eq=False)
class LoopTelemetry:
    """What passed through a loop.

    Parameters
    ----------
    index
        The camera's number of every frame ``(n,)``; gaps are lost frames.
    exposed_s
        End of its exposure ``(n,)``, seconds since the first; all 0 when unknown.
    slopes
        ``(n, n_slopes)``, in the sensor's unit.
    commands
        What the mirror got in answer ``(n, n_act)``, fractions of full stroke.

    Raises
    ------
    ValueError
        The parts are not equally long.
    """

    index: NDArray[np.int64]
    exposed_s: NDArray[np.float64]
    slopes: NDArray[np.float32]
    commands: NDArray[np.float64]
    __repr__ = short_repr

    def __post_init__(self) -> None:
        lengths = {len(part) for part in (self.index, self.exposed_s, self.slopes, self.commands)}
        if len(lengths) != 1:
            raise ValueError(f"the parts have {sorted(lengths)} frames; they must be equally long")

    @property
    def rate_hz(self) -> float:
        """Frames per second including lost ones; 0 when unknown."""
        seconds = float(np.ptp(self.exposed_s)) if self.index.size else 0.0
        return float(np.ptp(self.index)) / seconds if seconds > 0 else 0.0


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class TelemetryProduct(Product[LoopTelemetry]):
    """Telemetry read from disk."""


def save_telemetry(
    path: Path, record: LoopTelemetry, system: str, simulated: bool, origin: Provenance | None = None
) -> Path:
    """Write telemetry.

    Raises
    ------
    StorageError
        The file cannot be written; no partial file remains.
    """
    hdus = [
        fits_file.image_extension(extension, getattr(record, name).astype(dtype), unit)
        for name, (extension, dtype, unit) in _PARTS.items()
    ]
    return fits_file.write_product(path, KIND_TELEMETRY, hdus, system, simulated, origin)


def load_telemetry(path: Path | str) -> TelemetryProduct:
    """Read telemetry.

    Raises
    ------
    ProductError
        Not there, truncated, damaged, of another kind, incomplete or from a newer version.
    """
    return TelemetryProduct.read(path, KIND_TELEMETRY, _unpack)


def _unpack(path: Path, hdus: astropy_fits.HDUList, header: dict[str, Any]) -> LoopTelemetry:
    return LoopTelemetry(
        **{
            name: fits_file.read_array(path, hdus, extension, dtype)
            for name, (extension, dtype, _) in _PARTS.items()
        }
    )
