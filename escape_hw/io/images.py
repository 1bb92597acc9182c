"""Camera frames on disk."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.frames import CameraInfo, CameraSettings, Frame
from escape_hw.io import fits_file
from escape_hw.io.provenance import Provenance

KIND_FRAMES = "FRAMES"


def save_frames(
    path: Path,
    frames: Sequence[Frame],
    info: CameraInfo,
    settings: CameraSettings,
    system: str,
    origin: Provenance | None = None,
) -> Path:
    """Write frames as one cube ``(n_frames, rows, columns)`` with their counters and times.

    Returns
    -------
    Path
        The file written.

    Raises
    ------
    StorageError
        It cannot be written.
    """
    origin = origin or Provenance()
    head = fits_file.primary(KIND_FRAMES, system, info.simulated, False, origin)
    region = settings.region
    cards = {
        "CAMERA": (fits_file.plain(info.model), "camera"),
        "SERIAL": (fits_file.plain(info.serial), "its serial number"),
        "EXPTIME": (settings.exposure_s, "exposure, s"),
        "RATE": (settings.frame_rate_hz, "frames per second, Hz"),
        "GAINDB": (settings.gain_db, "analogue gain, dB"),
        "REGX": (region.x, "first column of the region"),
        "REGY": (region.y, "first row of the region"),
    }
    for key, value in cards.items():
        head.header[key] = value
    columns: dict[str, NDArray[Any]] = {
        "INDEX": np.array([frame.index for frame in frames], np.int64),
        "EXPOSED": np.array([frame.exposed_ns for frame in frames], np.int64),
        "ARRIVED": np.array([frame.arrived_ns for frame in frames], np.int64),
        "SATURATED": np.array([frame.n_saturated for frame in frames], np.int32),
    }
    hdus = [
        head,
        fits_file.image("FRAMES", np.stack([frame.data for frame in frames]), "count"),
        fits_file.table("TIMES", columns),
        fits_file.text("CONFIG", origin.config_text),
    ]
    fits_file.write(path, hdus)
    return path
