"""OOPAO as synthetic model: push-pull of its mirror in front of its Shack-Hartmann sensor or pyramid; the reference for the fast models."""

from __future__ import annotations

import abc
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.pyramid import PyramidPupils
from escape_hw.api.registration import Registration
from escape_hw.api.sensor import SensorGeometry, SubApertureGrid, require_kind
from escape_hw.api.synthetic_model import SyntheticModel
from escape_hw.config.sensor import ShackHartmannSection
from escape_hw.errors import CalibrationError
from escape_hw.pipeline.slopes.pyramid import slopes_of_image
from escape_sim.mirror.influence_functions import actuator_positions, pitch_on_pupil
from escape_sim.models.shack_hartmann import nominal_grid
from escape_sim.oopao.library import (
    SourceAndTelescope,
    make_lenslets,
    make_source,
    mis_registration,
    oopao,
    quiet,
)
from escape_sim.oopao.optics import SAMPLING, OOPAOPyramid, window_moments
from escape_sim.optics.modulation import ModulationPath
from escape_sim.optics.pupil import PupilGeometry, pupil_from_images, pupil_geometry

if TYPE_CHECKING:
    from escape_hw.config.system import SystemConfig


#: Surface in metres of the push and of the pull: a thousandth of a wave, so that what is not
#: linear stays below the other differences between models.
POKE_SURFACE_M = 0.5e-9


class OOPAOMirror:
    """OOPAO's ``DeformableMirror`` for a design.

    Parameters
    ----------
    config
        The design.
    pupil
        Its sampled pupil.
    light
        Source and telescope of that pupil.
    """

    def __init__(self, config: SystemConfig, pupil: PupilGeometry, light: SourceAndTelescope) -> None:
        n = pupil.n_sub * pupil.n_pix
        self._pupil, self._telescope, self._dm = pupil, light.telescope, config.devices.dm
        # OOPAO's mirror lays its n samples from edge to edge, its wavefront has them at pixel
        # centres: everything the mirror is told in metres must be this much larger.
        self._edge_factor = n / (n - 1)
        self._positions = actuator_positions(config)
        self._pitch = pitch_on_pupil(config)
        self._mirrors: dict[float, Any] = {}

    @property
    def n_act(self) -> int:
        """Number of actuators."""
        return len(self._positions)

    @property
    def unit_command_factor(self) -> float:
        """Full strokes in the difference of a push and a pull of :data:`POKE_SURFACE_M`."""
        return self._dm.stroke_m / (2 * POKE_SURFACE_M)

    def influence_functions(self) -> tuple[NDArray[np.float64], NDArray[np.bool_], float]:
        """Nominal influence functions ``(n_act, n, n)``, pupil ``(n, n)`` and pixel size in metres."""
        modes = np.asarray(self._nominal(1.0).modes, dtype=float)
        lit = self._pupil.lit
        return modes.T.reshape(self.n_act, *lit.shape), lit, self._pupil.pixel_m

    def moved(self, registration: Registration, width: float) -> Any:
        """The mirror under a registration, its influence functions ``width`` times as wide."""
        shift = mis_registration(registration, self._pupil.sub_aperture_m * self._edge_factor)
        with quiet():
            return self._nominal(width).apply_mis_registration(shift)

    def _nominal(self, width: float) -> Any:
        """OOPAO's mirror in nominal position; the few widths in use are kept."""
        if width not in self._mirrors:
            if len(self._mirrors) >= 4:
                self._mirrors.clear()
            with quiet():
                self._mirrors[width] = oopao().DeformableMirror(
                    telescope=self._telescope,
                    nSubap=self._pupil.n_sub,
                    mechCoupling=self._dm.coupling,
                    coordinates=self._positions * self._edge_factor,
                    pitch=self._pitch * self._edge_factor * width,
                    print_dm_properties=False,
                )
        return self._mirrors[width]


#: Actuators propagated together; bounds the memory.
_BATCH = 16


class OOPAOPushPullModel(abc.ABC):
    """Small-signal slopes as push minus pull of OOPAO's mirror.

    Parameters
    ----------
    config
        The design.
    pupil
        Its sampled pupil.
    light
        Source and telescope of that pupil.
    """

    name = "oopao"

    def __init__(self, config: SystemConfig, pupil: PupilGeometry, light: SourceAndTelescope) -> None:
        self._pupil = pupil
        self._mirror = OOPAOMirror(config, pupil, light)

    @property
    def n_act(self) -> int:
        """Number of actuators."""
        return self._mirror.n_act

    @property
    def sub_aperture_m(self) -> float:
        """Size of a sub-aperture, or of a pixel of the pupil image, on the pupil in metres."""
        return self._pupil.sub_aperture_m

    def influence_functions(self) -> tuple[NDArray[np.float64], NDArray[np.bool_], float]:
        """Nominal influence functions ``(n_act, n, n)``, pupil ``(n, n)`` and pixel size in metres."""
        return self._mirror.influence_functions()

    def zonal_matrix(self, registration: Registration, width: float = 1.0) -> NDArray[np.float64]:
        """Slopes per unit command ``(n_slopes, n_act)``, all x then all y, in the sensor's slope unit.

        Parameters
        ----------
        registration
            Registration of the mirror.
        width
            Scale of the influence functions' width relative to nominal.
        """
        mirror = self._mirror.moved(registration, width)
        # The mirror reflects: a surface of STEP_M changes the path by twice that.
        pokes = np.eye(self.n_act) * 2 * POKE_SURFACE_M
        parts = [pokes[:, start : start + _BATCH] for start in range(0, self.n_act, _BATCH)]
        moved = [self._slopes(mirror, part) - self._slopes(mirror, -part) for part in parts]
        return np.asarray(np.concatenate(moved, axis=1) * self._mirror.unit_command_factor)

    def variants(self) -> list[Self]:
        """None: OOPAO's sensors at rest leave nothing in doubt, see :class:`SyntheticModel`."""
        return []

    @abc.abstractmethod
    def _slopes(self, mirror: Any, paths_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Slopes ``(n_slopes, n)`` of mirror shapes, optical path per actuator ``(n_act, n)``."""


class OOPAOPyramidModel(OOPAOPushPullModel):
    """Small-signal slopes with mirror, registration, field and prism by OOPAO 1.0.

    Slopes are push minus pull about a flat wavefront. OOPAO's own slopes are not used, for they take
    the four images for a perfect square.

    Parameters
    ----------
    config
        The design: sensor, mirror and beam. Its ``twin`` section is not read.
    pupils
        The pupil images found on the camera.

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
            with quiet():
                mirror.coefs = path
            surface = np.asarray(mirror.OPD, dtype=float).reshape(n, n)
            # In double precision: the steps are small.
            frame = self._sensor.frame(surface, np.zeros(self._sensor.shape))
            out[:, number] = slopes_of_image(frame, self._pupils)
        return out


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
        from escape_sim.models.pyramid import nominal_pupils

        pupils = nominal_pupils(config) if grid is None else require_kind(grid, PyramidPupils)
        return OOPAOPyramidModel(config, pupils)
    return OOPAOShackHartmannModel(
        config, nominal_grid(config) if grid is None else require_kind(grid, SubApertureGrid)
    )


class OOPAOShackHartmannModel(OOPAOPushPullModel):
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
        self._light = make_source(pupil.amplitude, pupil.sub_aperture_m * n_sub, config.system.wavelength_m)
        super().__init__(config, pupil, self._light)
        self._lenslets = make_lenslets(self._light, n_sub, SAMPLING * pupil.n_pix)
        lit = self._lenslets.sh_data["src_0"].valid_subapertures
        if (grid.valid & ~lit).any():
            raise CalibrationError(
                f"{int((grid.valid & ~lit).sum())} valid sub-apertures of the grid lie outside the design's "
                "pupil; check the grid and sensor.n_sub"
            )
        self._moments = window_moments(
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
        total, along_x, along_y = np.zeros((3, n, len(self._moments[0].lenslet)))
        for part in self._moments:
            # OOPAO lays the image of a lenslet down with x along its rows.
            over_y = np.einsum("bkxy,kyl->bkxl", spots[:, part.lenslet], part.along_y, optimize=True)
            total += np.einsum("bkx,kx->bk", over_y[..., 0], part.along_x[..., 0])
            along_x += np.einsum("bkx,kx->bk", over_y[..., 0], part.along_x[..., 1])
            along_y += np.einsum("bkx,kx->bk", over_y[..., 1], part.along_x[..., 0])
        return np.concatenate([along_x / total, along_y / total], axis=1).T
