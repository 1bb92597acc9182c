"""Nominal influence functions of a system: the profile, plate or file that its configuration names."""

from __future__ import annotations

import logging
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from astropy.io import fits

from escape_hw.api.influence import MODEL_FITS_CARD
from escape_hw.errors import ConfigError
from escape_sim.mirror.influence_functions import (
    InfluenceFunctions,
    actuator_positions,
    exponential_profile,
    pitch_on_pupil,
)
from escape_sim.mirror.influence_maps import MapSettings, read_maps
from escape_sim.mirror.measured import MeasuredInfluenceFunctions
from escape_sim.mirror.thin_plate import thin_plate_surfaces

if TYPE_CHECKING:
    from escape_hw.config.system import SystemConfig

#: Influence functions that are kept: building those of a plate or a large file takes seconds.
_MAX_CACHED = 8

log = logging.getLogger(__name__)


def gaussian_functions(config: SystemConfig) -> InfluenceFunctions:
    """Single Gaussians of the configured coupling at the nominal positions, whatever the nominal shape."""
    return InfluenceFunctions(actuator_positions(config), pitch_on_pupil(config), config.devices.dm.coupling)


def nominal_influence_functions(config: SystemConfig) -> InfluenceFunctions | MeasuredInfluenceFunctions:
    """Influence functions of the design's mirror, ``devices.dm.influence``.

    Raises
    ------
    ConfigError
        No plate has the configured coupling, or the file is missing or not usable.
    """
    mirror, pitch = config.devices.dm, pitch_on_pupil(config)
    if mirror.influence == "gaussian":
        return gaussian_functions(config)
    if mirror.influence == "exponential":
        profile = exponential_profile(mirror.coupling, mirror.rounding)
        return InfluenceFunctions(actuator_positions(config), pitch, mirror.coupling, profile=profile)
    positions = tuple(map(tuple, mirror.positions().tolist()))
    if mirror.influence == "thin-plate":
        return _thin_plate(positions, mirror.coupling, mirror.plate_rim, pitch)
    settings = MapSettings(
        mirror.influence_unit, mirror.influence_poke, mirror.influence_wavefront, mirror.influence_positions,
        mirror.influence_pixel_m, mirror.pitch_m, mirror.stroke_m,
    )  # fmt: skip
    file = Path(mirror.influence_file).expanduser()
    try:
        status = file.stat()
    except (OSError, ValueError) as error:
        raise ConfigError(f"devices.dm.influence_file: {file} cannot be read: {error}") from error
    hardware = (mirror.mode or config.system.mode) == "hardware"
    return _from_file(str(file), (status.st_mtime_ns, status.st_size), positions, settings, pitch, hardware)


@lru_cache(_MAX_CACHED)
def _thin_plate(
    positions: tuple[tuple[float, ...], ...], coupling: float, rim: float, pitch_m: float
) -> MeasuredInfluenceFunctions:
    at = np.array(positions)
    try:
        surfaces, pixel = thin_plate_surfaces(at, coupling, rim)
    except ValueError as error:
        raise ConfigError(f"devices.dm.coupling: {error}") from error
    return MeasuredInfluenceFunctions(surfaces, pixel * pitch_m, positions_m=at * pitch_m)


@lru_cache(_MAX_CACHED)
def _from_file(
    file: str,
    status: tuple[int, int],  # a changed file is read again
    positions: tuple[tuple[float, ...], ...],
    settings: MapSettings,
    pitch_m: float,
    hardware: bool,
) -> MeasuredInfluenceFunctions:
    maps = read_maps(file, np.array(positions), settings)
    _warn_of_origin(file, hardware)
    return MeasuredInfluenceFunctions(
        maps.surfaces, maps.pixel * pitch_m, positions_m=maps.positions * pitch_m,
        centre_px=maps.centre_px, orientation=maps.orientation,
        place_sigma=np.multiply(maps.sigma, [pitch_m, pitch_m, 1, 1, 1]).tolist(),
    )  # fmt: skip


def _warn_of_origin(file: str, hardware: bool) -> None:
    """Warn of a product of ``escape influence`` whose model did not fit, or of a twin for a real mirror.

    Other files do not have its cards.
    """
    try:
        header = fits.getheader(file)
    except OSError:  # not FITS
        return
    if header.get(MODEL_FITS_CARD) is False:
        log.warning(
            "devices.dm.influence_file: %s is of a fit whose model did not fit; its influence functions may "
            "be wrong beyond their errors ('escape influence' prints what does not fit)", file,
        )  # fmt: skip
    if hardware and header.get("SIMULATE") is True:
        log.warning(
            "devices.dm.influence_file: %s was made on a twin (SIMULATE = T), the mirror is real: measure "
            "its influence functions, or calibrate it and run 'escape influence' on the result", file,
        )  # fmt: skip
