"""OOPAO as the synthetic model that SPRINT inverts: the reference for the fast model."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.registration import Registration
from escape_hw.api.sensor import SensorGeometry, SubApertureGrid, of_kind
from escape_hw.config.sensor_models import ShackHartmannSection
from escape_hw.errors import CalibrationError
from escape_sim.geometry import actuator_positions, pitch_on_pupil, pupil_geometry
from escape_sim.model import nominal_grid
from escape_sim.oopao_bridge import make_lenslets, make_light, mis_registration, oopao, quiet
from escape_sim.oopao_readout import SAMPLING, window_levers

if TYPE_CHECKING:
    from escape_hw.config.models import SystemConfig

#: Surface in metres of the push and of the pull: a thousandth of a wave, so that what is not
#: linear stays below the other differences between models.
STEP_M = 0.5e-9
#: Actuators propagated together; bounds the memory.
_BATCH = 16


def make_model(config: SystemConfig, grid: SensorGeometry | None) -> OOPAOModel:
    """Entry point ``oopao``; without a grid, the nominal one of the design.

    Raises
    ------
    ConfigError
        OOPAO is not installed, or the system has no Shack-Hartmann sensor.
    CalibrationError
        The grid does not fit the design.
    """
    config.sensor_as(ShackHartmannSection)
    return OOPAOModel(config, nominal_grid(config) if grid is None else of_kind(grid, SubApertureGrid))


class OOPAOModel:
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

    name = "oopao"

    def __init__(self, config: SystemConfig, grid: SubApertureGrid) -> None:
        pupil = pupil_geometry(config)
        n_sub, n = pupil.n_sub, pupil.n_sub * pupil.n_pix
        if grid.valid.shape != (n_sub, n_sub):
            raise CalibrationError(f"the grid has {grid.valid.shape} lenslets; sensor.n_sub is {n_sub}")
        self._pupil, self._dm = pupil, config.devices.dm
        # OOPAO's mirror lays its n samples from edge to edge, its wavefront has them at pixel
        # centres: everything the mirror is told in metres must be this much larger.
        self._edge = n / (n - 1)
        self._positions = actuator_positions(config)
        self._pitch = pitch_on_pupil(config)
        self._light = make_light(pupil.amplitude, pupil.sub_aperture_m * n_sub, config.system.wavelength_m)
        self._lenslets = make_lenslets(self._light, n_sub, SAMPLING * pupil.n_pix)
        lit = self._lenslets.sh_data["src_0"].valid_subapertures
        if (grid.valid & ~lit).any():
            raise CalibrationError(
                f"{int((grid.valid & ~lit).sum())} valid sub-apertures of the grid lie outside the design's "
                "pupil; check the grid and sensor.n_sub"
            )
        self._n_slopes = grid.n_slopes
        self._levers = window_levers(
            grid,
            np.asarray(lit),
            config.devices.wfs.region[:1:-1],
            pupil.n_pix,
            config.sensor_as(ShackHartmannSection).spot_px,
        )
        self._mirrors: dict[float, Any] = {}

    @property
    def n_act(self) -> int:
        """Number of actuators."""
        return len(self._positions)

    @property
    def sub_aperture_m(self) -> float:
        """Size of a sub-aperture on the pupil in metres."""
        return self._pupil.sub_aperture_m

    def influence_functions(self) -> tuple[NDArray[np.float64], NDArray[np.bool_], float]:
        """Nominal influence functions ``(n_act, n, n)``, pupil ``(n, n)`` and pixel size in metres."""
        modes = np.asarray(self._mirror(1.0).modes, dtype=float)
        lit = self._pupil.lit
        return modes.T.reshape(self.n_act, *lit.shape), lit, self._pupil.pixel_m

    def zonal_matrix(self, registration: Registration, width: float = 1.0) -> NDArray[np.float64]:
        """Slopes in camera pixels per unit command ``(n_slopes, n_act)``, all x then all y.

        Parameters
        ----------
        registration
            Registration of the mirror.
        width
            Scale of the influence functions' width relative to nominal.
        """
        moved = mis_registration(registration, self.sub_aperture_m * self._edge)
        with quiet():
            mirror = self._mirror(width).apply_mis_registration(moved)
        # The mirror reflects: a surface of STEP_M changes the path by twice that.
        pokes = np.eye(self.n_act) * 2 * STEP_M
        out = np.empty((self._n_slopes, self.n_act))
        for start in range(0, self.n_act, _BATCH):
            part = pokes[:, start : start + _BATCH]
            out[:, start : start + _BATCH] = self._slopes(mirror, part) - self._slopes(mirror, -part)
        return out * (self._dm.stroke_m / (2 * STEP_M))

    def variants(self) -> list[OOPAOModel]:
        """None: spots at rest leave nothing in doubt, see :class:`SyntheticModel`."""
        return []

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

    def _mirror(self, width: float) -> Any:
        """OOPAO's mirror in nominal position; the few widths in use are kept."""
        if width not in self._mirrors:
            if len(self._mirrors) >= 4:
                self._mirrors.clear()
            with quiet():
                self._mirrors[width] = oopao().DeformableMirror(
                    telescope=self._light.telescope,
                    nSubap=self._pupil.n_sub,
                    mechCoupling=self._dm.coupling,
                    coordinates=self._positions * self._edge,
                    pitch=self._pitch * self._edge * width,
                    print_dm_properties=False,
                )
        return self._mirrors[width]
