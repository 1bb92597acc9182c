"""OOPAO as the synthetic Shack-Hartmann model that SPRINT inverts: the reference for the fast model."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.model import SyntheticModel
from escape_hw.api.pyramid import PyramidPupils
from escape_hw.api.sensor import SensorGeometry, SubApertureGrid, of_kind
from escape_hw.config.sensor_models import ShackHartmannSection
from escape_hw.errors import CalibrationError
from escape_sim.geometry import pupil_geometry
from escape_sim.model import nominal_grid
from escape_sim.oopao_bridge import make_lenslets, make_light, quiet
from escape_sim.oopao_push_pull import PushPullModel
from escape_sim.oopao_readout import SAMPLING, window_levers

if TYPE_CHECKING:
    from escape_hw.config.models import SystemConfig


def make_model(config: SystemConfig, grid: SensorGeometry | None) -> SyntheticModel:
    """Entry point ``oopao``; without a grid, the nominal one of the design.

    Raises
    ------
    ConfigError
        OOPAO is not installed.
    CalibrationError
        The grid does not fit the design.
    """
    if config.sensor.kind == "pyramid":
        from escape_sim.oopao_pyramid_model import OOPAOPyramidModel
        from escape_sim.pyramid_model import nominal_pupils

        pupils = nominal_pupils(config) if grid is None else of_kind(grid, PyramidPupils)
        return OOPAOPyramidModel(config, pupils)
    return OOPAOModel(config, nominal_grid(config) if grid is None else of_kind(grid, SubApertureGrid))


class OOPAOModel(PushPullModel):
    """Small-signal slopes with mirror, registration, field and diffraction by OOPAO 1.0.

    Slopes are push minus pull, the centre of gravity without threshold over the camera's own windows
    of OOPAO's spots, the neighbours' included. Three things of OOPAO's are not used: its centroid,
    whose relative threshold makes matrices depend on the stroke; its ``SPRINT``, whose rounding
    loses shifts at the scale of a bench; its modal bases, whose signs change between runs.

    Parameters
    ----------
    config
        The design: sensor, mirror and beam. Its ``twin`` section is not read.
    grid
        The grid found on the camera.
    """

    def __init__(self, config: SystemConfig, grid: SubApertureGrid) -> None:
        pupil = pupil_geometry(config)
        n_sub = pupil.n_sub
        if grid.valid.shape != (n_sub, n_sub):
            raise CalibrationError(f"the grid has {grid.valid.shape} lenslets; sensor.n_sub is {n_sub}")
        self._light = make_light(pupil.amplitude, pupil.sub_aperture_m * n_sub, config.system.wavelength_m)
        super().__init__(config, pupil, self._light)
        self._lenslets = make_lenslets(self._light, n_sub, SAMPLING * pupil.n_pix)
        lit = self._lenslets.sh_data["src_0"].valid_subapertures
        if (grid.valid & ~lit).any():
            raise CalibrationError(
                f"{int((grid.valid & ~lit).sum())} valid sub-apertures of the grid lie outside the design's "
                "pupil; check the grid and sensor.n_sub"
            )
        self._levers = window_levers(
            grid,
            np.asarray(lit),
            config.devices.wfs.region[:1:-1],
            pupil.n_pix,
            config.sensor_as(ShackHartmannSection).spot_px,
        )

    def _slopes(self, mirror: Any, paths_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Spot positions ``(n_slopes, n)`` in camera pixels for mirror shapes ``(n_act, n)``."""
        n = paths_m.shape[1]
        # OOPAO drops the last axis of a single wavefront, so one is sensed as two.
        if n == 1:
            paths_m = np.repeat(paths_m, 2, axis=1)
        light = self._light
        with quiet():
            mirror.coefs = paths_m
            # '**' starts a new propagation; '*' alone would add to the last one.
            light.source**light.telescope * mirror * self._lenslets
            spots = np.asarray(self._lenslets.maps_intensity)[:n]
        total, along_x, along_y = np.zeros((3, n, len(self._levers[0].lenslet)))
        for part in self._levers:
            # OOPAO lays the image of a lenslet down with x along its rows.
            over_y = np.einsum("bkxy,kyl->bkxl", spots[:, part.lenslet], part.along_y, optimize=True)
            total += np.einsum("bkx,kx->bk", over_y[..., 0], part.along_x[..., 0])
            along_x += np.einsum("bkx,kx->bk", over_y[..., 0], part.along_x[..., 1])
            along_y += np.einsum("bkx,kx->bk", over_y[..., 1], part.along_x[..., 0])
        return np.concatenate([along_x / total, along_y / total], axis=1).T
