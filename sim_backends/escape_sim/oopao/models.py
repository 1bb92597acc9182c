"""OOPAO as synthetic model, by push-pull of its mirror; the reference for the fast models."""

from __future__ import annotations

import abc
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.pyramid import PyramidPupils
from escape_hw.api.registration import Registration
from escape_hw.api.sensor import SensorGeometry, SubApertureGrid
from escape_hw.api.synthetic_model import SyntheticModel
from escape_hw.config.sensor import ShackHartmannSection
from escape_hw.errors import CalibrationError, ConfigError
from escape_hw.pipeline.slopes.pyramid import slopes_of_image
from escape_sim.mirror.influence_functions import InfluenceFunctions
from escape_sim.models.base import DesignModel
from escape_sim.models.factory import model_geometry
from escape_sim.oopao.library import (
    SourceAndTelescope,
    make_lenslets,
    make_source,
    mis_registration,
    oopao_classes,
    suppress_output,
)
from escape_sim.oopao.optics import SAMPLING, OOPAOPyramid, window_moments
from escape_sim.optics.modulation import ModulationPath
from escape_sim.optics.pupil import PupilGeometry, pupil_from_images, pupil_geometry

if TYPE_CHECKING:
    from escape_hw.config.system import SystemConfig


#: Surface in metres of a push or pull: a thousandth of a wave, for negligible non-linearity.
POKE_SURFACE_M = 0.5e-9


#: Actuators propagated together; limits the memory.
_BATCH = 16
#: Widths whose mirrors are kept.
_MAX_CACHED_MIRRORS = 8


class OOPAOPushPullModel(DesignModel, abc.ABC):
    """Small-signal slopes as push minus pull of OOPAO's ``DeformableMirror``."""

    name = "oopao"

    def __init__(self, config: SystemConfig, pupil: PupilGeometry, light: SourceAndTelescope) -> None:
        super().__init__(config, pupil)
        if not isinstance(self._nominal, InfluenceFunctions):
            raise ConfigError(
                f"devices.dm.influence = '{config.devices.dm.influence}' needs calibration.model = 'fast'; "
                "OOPAO's mirror has Gaussian influence functions, and sums of them ('exponential')"
            )
        self._profile = self._nominal.profile
        self._light = light
        n = pupil.n_sub * pupil.n_pix
        # OOPAO's mirror has its n samples from edge to edge, its wavefront at pixel centres: lengths for
        # the mirror must be larger by this factor.
        self._edge_factor = n / (n - 1)
        self._mirrors: dict[float, Any] = {}

    def influence_functions(self) -> tuple[NDArray[np.float64], NDArray[np.bool_], float]:
        """Nominal influence functions, see :class:`SyntheticModel`."""
        modes = np.sum(
            [share * self._nominal_mirror(width).modes for share, width in self._profile],
            axis=0,
            dtype=float,
        )
        lit = self._pupil.lit
        return modes.T.reshape(self.n_act, *lit.shape), lit, self._pupil.pixel_m

    def zonal_matrix(self, registration: Registration, width: float = 1.0) -> NDArray[np.float64]:
        """Slopes per unit command ``(n_slopes, n_act)``, see :class:`SyntheticModel`.

        Small signals are linear: the slopes are the sums of those of OOPAO's Gaussian mirrors.
        """
        return np.asarray(
            sum(
                share * self._push_pull(registration, width * relative_width)
                for share, relative_width in self._profile
            )
        )

    def _push_pull(self, registration: Registration, width: float) -> NDArray[np.float64]:
        """Slopes per unit command of Gaussian influence functions ``width`` times the nominal width."""
        mirror = self.registered_mirror(registration, width)
        # The optical path changes by twice the surface.
        pokes = np.eye(self.n_act) * 2 * POKE_SURFACE_M
        batches = [pokes[:, start : start + _BATCH] for start in range(0, self.n_act, _BATCH)]
        differences = [self._slopes(mirror, batch) - self._slopes(mirror, -batch) for batch in batches]
        strokes = self._config.devices.dm.stroke_m / (2 * POKE_SURFACE_M)
        return np.asarray(np.concatenate(differences, axis=1) * strokes)

    def variants(self) -> list[Self]:
        """No variants: there is no turbulence or spot motion to be uncertain about."""
        return []

    def registered_mirror(self, registration: Registration, width: float) -> Any:
        """OOPAO's mirror under a registration, its influence functions ``width`` times as wide."""
        shift = mis_registration(registration, self.sub_aperture_m * self._edge_factor)
        with suppress_output():
            return self._nominal_mirror(width).apply_mis_registration(shift)

    def _nominal_mirror(self, width: float) -> Any:
        """OOPAO's mirror without misregistration."""
        if width not in self._mirrors:
            if len(self._mirrors) >= _MAX_CACHED_MIRRORS:
                self._mirrors.clear()
            with suppress_output():
                self._mirrors[width] = oopao_classes().DeformableMirror(
                    telescope=self._light.telescope,
                    nSubap=self._pupil.n_sub,
                    mechCoupling=self._gaussian.coupling,
                    coordinates=self._gaussian.positions_m * self._edge_factor,
                    pitch=self._gaussian.pitch_m * self._edge_factor * width,
                    print_dm_properties=False,
                )
        return self._mirrors[width]

    @abc.abstractmethod
    def _slopes(self, mirror: Any, paths_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Slopes ``(n_slopes, n)`` of mirror shapes, optical path per actuator ``(n_act, n)``."""


class OOPAOPyramidModel(OOPAOPushPullModel):
    """Small-signal slopes of a pyramid with mirror, registration, field and prism by OOPAO 1.0.

    OOPAO's own slopes are not used, since they assume that the four images are on a perfect square.

    ``pupils`` are the pupil images measured on the camera.

    Raises
    ------
    ConfigError
        OOPAO is not installed.
    CalibrationError
        The pupils do not fit the design.
    """

    def __init__(self, config: SystemConfig, pupils: PyramidPupils) -> None:
        pupil = pupil_from_images(config, pupils)
        self._pupils = pupils
        self._sensor = OOPAOPyramid(
            pupil.amplitude, float(pupil.n_sub), config.system.wavelength_m, pupils.centres_px,
            config.devices.wfs.region[:1:-1], ModulationPath.circle(pupils.modulation), samples=pupil.n_pix,
            diameter_m=pupil.sub_aperture_m * pupil.n_sub,
        )  # fmt: skip
        super().__init__(config, pupil, self._sensor.light)

    def _slopes(self, mirror: Any, paths_m: NDArray[np.float64]) -> NDArray[np.float64]:
        n = len(self._pupil.coordinates_m)
        out = np.empty((self._pupils.n_slopes, paths_m.shape[1]))
        for number, path in enumerate(paths_m.T):
            with suppress_output():
                mirror.coefs = path
            surface = np.asarray(mirror.OPD, dtype=float).reshape(n, n)
            # In double precision, since the pokes are small.
            frame = self._sensor.frame(surface, np.zeros(self._sensor.shape))
            out[:, number] = slopes_of_image(frame, self._pupils)
        return out


class OOPAOShackHartmannModel(OOPAOPushPullModel):
    """Small-signal slopes of a Shack-Hartmann sensor with mirror, registration and diffraction by OOPAO 1.0.

    Slopes are centres of gravity without threshold over the camera's windows, including light of the
    neighbouring lenslets. Not used are OOPAO's centroid, whose relative threshold makes matrices depend
    on the stroke; its ``SPRINT``, whose rounding loses shifts at the scale of a bench; and its modal
    bases, whose signs change between runs. ``grid`` is the grid measured on the camera.

    Raises
    ------
    ConfigError
        OOPAO is not installed.
    CalibrationError
        The grid does not fit the design.
    """

    def __init__(self, config: SystemConfig, grid: SubApertureGrid) -> None:
        pupil, self._grid = pupil_geometry(config), grid
        n_sub = pupil.n_sub
        if grid.valid.shape != (n_sub, n_sub):
            raise CalibrationError(f"the grid has {grid.valid.shape} lenslets; sensor.n_sub is {n_sub}")
        light = make_source(pupil.amplitude, pupil.sub_aperture_m * n_sub, config.system.wavelength_m)
        super().__init__(config, pupil, light)
        self._lenslets = make_lenslets(self._light, n_sub, SAMPLING * pupil.n_pix)
        lit = self._lenslets.sh_data["src_0"].valid_subapertures
        if (grid.valid & ~lit).any():
            raise CalibrationError(
                f"{int((grid.valid & ~lit).sum())} valid sub-apertures of the grid lie outside the design's "
                "pupil; check the grid and sensor.n_sub"
            )
        spot_px = config.sensor_as(ShackHartmannSection).spot_px
        self._moments = window_moments(
            grid, np.asarray(lit), config.devices.wfs.region[:1:-1], pupil.n_pix, spot_px
        )

    @property
    def numbering_offsets(self) -> tuple[tuple[int, int], tuple[int, int]]:
        """Competing numberings of the lenslets, see :class:`HasNumberingOffsets`."""
        return self._grid.numbering_offsets

    def _slopes(self, mirror: Any, paths_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Spot positions ``(n_slopes, n)`` in camera pixels for mirror shapes ``(n_act, n)``."""
        n = paths_m.shape[1]
        # OOPAO drops the last axis of a single wavefront, so it is propagated twice.
        if n == 1:
            paths_m = np.repeat(paths_m, 2, axis=1)
        with suppress_output():
            mirror.coefs = paths_m
        self._light.propagate(mirror, self._lenslets)
        spots = np.asarray(self._lenslets.maps_intensity)[:n]
        total, along_x, along_y = np.zeros((3, n, len(self._moments[0].lenslet)))
        for part in self._moments:
            # OOPAO's image of a lenslet has x along its rows.
            over_y = np.einsum("bkxy,kyl->bkxl", spots[:, part.lenslet], part.along_y, optimize=True)
            total += np.einsum("bkx,kx->bk", over_y[..., 0], part.along_x[..., 0])
            along_x += np.einsum("bkx,kx->bk", over_y[..., 0], part.along_x[..., 1])
            along_y += np.einsum("bkx,kx->bk", over_y[..., 1], part.along_x[..., 0])
        return np.concatenate([along_x / total, along_y / total], axis=1).T


def make_oopao_model(config: SystemConfig, grid: SensorGeometry | None) -> SyntheticModel:
    """Entry point ``oopao``; without a grid, on the design's nominal one.

    Raises
    ------
    ConfigError
        OOPAO is not installed.
    CalibrationError
        The grid does not fit the design.
    """
    geometry = model_geometry(config, grid)
    if isinstance(geometry, PyramidPupils):
        return OOPAOPyramidModel(config, geometry)
    return OOPAOShackHartmannModel(config, geometry)


#: Name of the entry point in the metadata of editable installations made before it was renamed.
make_model = make_oopao_model
