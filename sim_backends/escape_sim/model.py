"""SPRINT's nominal synthetic model of a Shack-Hartmann system, fast and analytic."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import DTypeLike, NDArray

from escape_hw.api.model import SyntheticModel
from escape_hw.api.pyramid import PyramidPupils
from escape_hw.api.registration import Registration
from escape_hw.api.sensor import SensorGeometry, SubApertureGrid, of_kind
from escape_hw.config.sensor_models import ShackHartmannSection
from escape_sim.geometry import PupilGeometry, actuator_positions, pitch_on_pupil, pupil_geometry
from escape_sim.influence import InfluenceFunctions
from escape_sim.mode_surfaces import N_DERIVATIVES, GaussianFactors, gaussian_factors, mode_surfaces
from escape_sim.slope_operator import SlopeOperator
from escape_sim.slope_weights import slope_weights

if TYPE_CHECKING:
    from escape_hw.config.models import SystemConfig

#: Relative doubt about the spots' motion: blur within the lenslets counts as motion too.
_MOTION_DOUBT = 0.25
#: Up to this many modes, their surfaces are quicker made than the slopes of all actuators.
_FEW = 12


def make_model(config: SystemConfig, grid: SensorGeometry | None) -> SyntheticModel:
    """Entry point ``fast``; without a grid, the nominal one of the design."""
    if config.sensor.kind == "pyramid":
        from escape_sim.pyramid_model import PyramidModel, nominal_pupils

        return PyramidModel(config, nominal_pupils(config) if grid is None else of_kind(grid, PyramidPupils))
    return ShackHartmannModel(
        config, nominal_grid(config) if grid is None else of_kind(grid, SubApertureGrid)
    )


def nominal_grid(config: SystemConfig) -> SubApertureGrid:
    """The design's grid, centred on the camera region, valid where the design beam is bright enough."""
    pupil = pupil_geometry(config)
    n, p = pupil.n_sub, pupil.n_pix
    flux = np.square(pupil.amplitude, dtype=float).reshape(n, p, n, p).sum(axis=(1, 3))
    flux /= np.percentile(flux[flux > 0], 95)
    valid = flux >= config.sensor.min_flux
    pitch = config.sensor_as(ShackHartmannSection).pitch_px
    width, height = config.devices.wfs.region[2:]
    origin = ((width - 1) / 2 - pitch * (n - 1) / 2, (height - 1) / 2 - pitch * (n - 1) / 2)
    references = np.zeros((int(valid.sum()), 2), np.float32)
    return SubApertureGrid(pitch, origin, valid, references, flux.astype(np.float32), 0.0)


class ShackHartmannModel:
    """Small-signal slopes of a diffractive Shack-Hartmann sensor behind a Gaussian-actuator mirror.

    The centre of gravity of a spot is a smooth function of the phase on its lenslet; its first
    derivative at a flat wavefront is a fixed weight map per lenslet, so a matrix is one small
    product per sub-aperture and no frame is ever rendered.

    Parameters
    ----------
    config
        The design: sensor, mirror and beam. Its ``twin`` section is not read.
    grid
        The grid found on the camera.
    """

    name = "fast"

    def __init__(self, config: SystemConfig, grid: SubApertureGrid) -> None:
        self._pupil = pupil_geometry(config)
        if grid.valid.shape != (self._pupil.n_sub, self._pupil.n_sub):
            raise ValueError(
                f"the grid has {grid.valid.shape} lenslets, "
                f"the design {self._pupil.n_sub} x {self._pupil.n_sub}"
            )
        self._positions = actuator_positions(config)
        self._pitch = pitch_on_pupil(config)
        self._coupling = config.devices.dm.coupling
        self._metres = 2 * config.devices.dm.stroke_m
        self._config, self._grid = config, grid
        self._variants: list[ShackHartmannModel] | None = None
        weights = slope_weights(config, grid, self._pupil)
        self._slopes = SlopeOperator(weights, grid.valid, self._pupil.sub_aperture_m)

    @property
    def n_act(self) -> int:
        """Number of actuators."""
        return len(self._positions)

    @property
    def sub_aperture_m(self) -> float:
        """Size of a sub-aperture on the pupil in metres."""
        return self._pupil.sub_aperture_m

    def influence_functions(self) -> tuple[NDArray[np.float64], NDArray[np.bool_], float]:
        """Nominal influence functions for the modal basis, see :class:`SyntheticModel`."""
        # Half the sampling is ample for shapes as smooth as these.
        pupil = PupilGeometry(
            self._pupil.n_sub, self._pupil.n_pix // 2, self._pupil.sub_aperture_m,
            self._pupil.coordinates_m.reshape(-1, 2).mean(axis=1), self._pupil.amplitude[::2, ::2],
        )  # fmt: skip
        x = pupil.coordinates_m
        surfaces = self._influence(1.0).surfaces(Registration(), self.sub_aperture_m, x, x)
        r2 = x[:, None] ** 2 + x[None, :] ** 2
        radius = self._pupil.n_sub * self._pupil.sub_aperture_m / 2
        return surfaces, r2 <= radius**2, pupil.pixel_m

    def zonal_matrix(self, registration: Registration, width: float = 1.0) -> NDArray[np.float64]:
        """Slopes in pixels per unit command ``(n_slopes, n_act)``, see :class:`SyntheticModel`."""
        if registration.anamorphosis_angle:
            # A slanted Gaussian has no factors along x and y.
            at = self._slopes.nodes_m
            surfaces = self._influence(width).surfaces(registration, self.sub_aperture_m, at, at)
            return np.asarray(self._slopes.slopes(np.moveaxis(surfaces, 0, 2).copy()) * self._metres)
        factors = self._factors(registration, width, np.float64)
        return np.asarray(self._slopes.zonal(factors)[0] * self._metres)

    def zonal_jacobian(
        self, registration: Registration, width: float = 1.0
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Zonal matrix and its derivatives, see :class:`DifferentiableModel`; single precision."""
        factors = self._factors(registration, width, np.float32)
        parts = self._slopes.zonal(factors, derivatives=True) * np.float32(self._metres)
        out = np.empty((N_DERIVATIVES, *parts.shape[1:]))
        for p, ((along_x, along_y), (wide_x, wide_y)) in enumerate(
            zip(factors.place, factors.spread, strict=True)
        ):
            out[p] = parts[1] * along_x + parts[2] * along_y
            if wide_x:
                out[p] += parts[3] * wide_x
            if wide_y:
                out[p] += parts[4] * wide_y
        return parts[0].astype(float), out

    def modal_matrix(
        self, registration: Registration, m2c: NDArray[np.float64], width: float = 1.0
    ) -> NDArray[np.float64]:
        """Slopes per unit mode ``(n_slopes, n_modes)``, see :class:`DifferentiableModel`."""
        factors = self._factors(registration, width, np.float32)
        if m2c.shape[1] <= _FEW:
            return np.asarray(self._slopes.slopes(mode_surfaces(factors, m2c)) * self._metres, dtype=float)
        return np.asarray(self._slopes.zonal(factors)[0] @ (m2c * self._metres))

    def modal_jacobian(
        self, registration: Registration, m2c: NDArray[np.float64], width: float = 1.0
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Modal matrix and its derivatives, see :class:`DifferentiableModel`; single precision."""
        factors = self._factors(registration, width, np.float32)
        parts = self._slopes.zonal(factors, derivatives=True)
        modes = (m2c * self._metres).astype(np.float32)
        out = np.zeros((N_DERIVATIVES, parts.shape[1], m2c.shape[1]))
        for p in range(N_DERIVATIVES):
            for part, share in zip(parts[1:3], factors.place[p], strict=True):
                if share.any():
                    out[p] += part @ (share[:, None] * modes)
        for part, shares in zip(parts[3:], factors.spread.T, strict=True):
            wider = part @ modes
            for p in np.flatnonzero(shares).tolist():
                out[p] += wider * shares[p]
        return np.asarray(parts[0] @ modes, dtype=float), out

    def variants(self) -> list[ShackHartmannModel]:
        """The same sensor with spots that move by a quarter more than the slopes say."""
        if self._variants is None:
            grid = replace(self._grid, motion_px=self._grid.motion_px * (1 + _MOTION_DOUBT))
            self._variants = [ShackHartmannModel(self._config, grid)] if grid.motion_px else []
        return list(self._variants)

    def _factors(self, registration: Registration, width: float, dtype: DTypeLike) -> GaussianFactors:
        at = self._slopes.nodes_m
        return gaussian_factors(self._influence(width), registration, self.sub_aperture_m, at, at, dtype)

    def _influence(self, width: float) -> InfluenceFunctions:
        return InfluenceFunctions(self._positions, self._pitch, self._coupling, width)
