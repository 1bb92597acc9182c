"""Camera frames on disk."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from astropy.io import fits as astropy_fits
from numpy.typing import NDArray

from escape_hw.api.camera import CameraInfo, CameraSettings, Frame, Region
from escape_hw.api.representation import short_repr
from escape_hw.io.fits import file as fits_file
from escape_hw.io.fits.file import Product
from escape_hw.io.provenance import Provenance

KIND_FRAMES = "FRAMES"
#: Columns of the table of times: counter, exposure and arrival in nanoseconds, saturated pixels.
_COLUMNS = ("INDEX", "EXPOSED", "ARRIVED", "SATURATED")


def save_frames(
    path: Path,
    frames: Sequence[Frame],
    info: CameraInfo,
    settings: CameraSettings,
    system: str,
    origin: Provenance | None = None,
    *,
    partial: bool = False,
) -> Path:
    """Write frames as one cube ``(n_frames, rows, columns)`` with their counters and times.

    Returns
    -------
    Path
        The file written; a ``partial`` recording, which ended before its last frame, is written as
        ``*.partial.fits``.

    Raises
    ------
    StorageError
        The file cannot be written.
    """
    region = settings.region
    cards = {
        "CAMERA": (info.model, "camera"),
        "SERIAL": (info.serial, "its serial number"),
        "EXPTIME": (settings.exposure_s, "exposure, s"),
        "RATE": (settings.frame_rate_hz, "frames per second, Hz"),
        "GAINDB": (settings.gain_db, "analogue gain, dB"),
        "REGX": (region.x, "first column of the region"),
        "REGY": (region.y, "first row of the region"),
    }
    rows = [(frame.index, frame.exposed_ns, frame.arrived_ns, frame.n_saturated) for frame in frames]
    columns = dict(zip(_COLUMNS, np.array(rows, np.int64).T, strict=True))
    hdus = [
        fits_file.image_extension("FRAMES", np.stack([frame.data for frame in frames]), "count"),
        fits_file.table_extension("TIMES", columns),
    ]
    return fits_file.write_product(
        path, KIND_FRAMES, hdus, system, info.simulated, origin, partial=partial, cards=cards
    )


@dataclass(frozen=True, slots=True, eq=False)
class RecordedFrames:
    """Frames as a camera delivered them: counts, neither dark-subtracted nor divided by a flat.

    Parameters
    ----------
    data
        Counts ``(n_frames, rows, columns)``.
    index
        The device's own frame counter ``(n_frames,)``; gaps are lost frames.
    exposed_ns, arrived_ns
        Monotonic time of the end of each exposure and of its arrival ``(n_frames,)``, nanoseconds.
    n_saturated
        Pixels at the top of the scale ``(n_frames,)``.
    """

    data: NDArray[np.uint16]
    index: NDArray[np.int64]
    exposed_ns: NDArray[np.int64]
    arrived_ns: NDArray[np.int64]
    n_saturated: NDArray[np.int64]
    camera: str
    serial: str
    settings: CameraSettings
    __repr__ = short_repr

    @property
    def lost_frames(self) -> int:
        """Gaps of the frame counter."""
        return int(np.sum(np.diff(self.index) - 1))

    @property
    def rate_hz(self) -> float:
        """Frames per second by the times of exposure, lost ones counted; 0 for a single frame."""
        seconds = 1e-9 * float(np.ptp(self.exposed_ns)) if self.index.size else 0.0
        return float(np.ptp(self.index)) / seconds if seconds > 0 else 0.0


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class FramesProduct(Product[RecordedFrames]):
    """Camera frames read from disk."""


def load_frames(path: Path | str) -> FramesProduct:
    """Read frames that :func:`save_frames` wrote.

    Raises
    ------
    ProductError
        Not there, truncated, damaged, of another kind, incomplete or from a newer version.
    """
    return FramesProduct.read(path, KIND_FRAMES, _unpack)


def _unpack(path: Path, hdus: astropy_fits.HDUList, header: dict[str, Any]) -> RecordedFrames:
    data = fits_file.read_array(path, hdus, "FRAMES", np.uint16)
    times = fits_file.require_extension(path, hdus, "TIMES").data
    index, exposed, arrived, saturated = (np.asarray(times[name]).astype(np.int64) for name in _COLUMNS)
    if len(index) != len(data):
        raise ValueError(f"{len(data)} frames, {len(index)} times")
    region = Region(int(header["REGX"]), int(header["REGY"]), data.shape[2], data.shape[1])
    settings = CameraSettings(
        region, float(header["EXPTIME"]), float(header["RATE"]), float(header["GAINDB"])
    )
    camera, serial = str(header["CAMERA"]), str(header["SERIAL"])
    return RecordedFrames(data, index, exposed, arrived, saturated, camera, serial, settings)
