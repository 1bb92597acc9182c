"""OOPAO as the synthetic model that SPRINT inverts: the reference for the fast model."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.registration import Registration
from escape_hw.errors import CalibrationError
from escape_sim.geometry import PupilGeometry, actuator_positions, pitch_on_pupil, pupil_geometry
from escape_sim.oopao_bridge import make_lenslets, make_light, mis_registration, oopao, quiet

if TYPE_CHECKING:
    from escape_hw.api.sensor import SubApertureGrid
    from escape_hw.config.models import SystemConfig

#: Surface in metres of the push and of the pull: a hundredth of a wave, well inside the linear range.
STEP_M = 5e-9
#: Actuators propagated together; bounds the memory.
_BATCH = 16


def make_model(config: SystemConfig, grid: SubApertureGrid | None) -> OOPAOModel:
    """Entry point ``oopao``: the model of the nominal design.

    Parameters
    ----------
    config
        The system; its ``twin`` section is not read.
    grid
        Grid found from frames, or ``None`` for the sub-apertures the design lights.

    Raises
    ------
    ConfigError
        OOPAO is not installed.
    CalibrationError
        The grid does not fit the design.
    """
    pupil = pupil_geometry(config)
    if grid is not None and grid.valid.shape != (pupil.n_sub, pupil.n_sub):
        raise CalibrationError(
            f"the grid has {grid.valid.shape} sub-apertures; sensor.n_sub is {pupil.n_sub} across"
        )
    return OOPAOModel(
        actuator_positions(config),
        pitch_on_pupil(config),
        config.devices.dm.coupling,
        config.devices.dm.stroke_m,
        pupil.amplitude,
        pupil.sub_aperture_m,
        nominal_valid(pupil, config.sensor.min_flux) if grid is None else grid.valid,
        config.system.wavelength_m,
        config.sensor.pitch_px if grid is None else grid.pitch_px,
        config.sensor.spot_px,
    )


def nominal_valid(pupil: PupilGeometry, min_flux: float) -> NDArray[np.bool_]:
    """Sub-apertures ``(n_sub, n_sub)`` with at least ``min_flux`` of the light of a bright one."""
    power = np.square(pupil.amplitude, dtype=float).reshape(
        pupil.n_sub, pupil.n_pix, pupil.n_sub, pupil.n_pix
    )
    flux = power.sum(axis=(1, 3))
    return np.asarray(flux >= min_flux * np.percentile(flux[flux > 0], 95))


class OOPAOModel:
    """Mirror and Shack-Hartmann sensor computed by OOPAO 1.0 throughout.

    Slopes are push minus pull of OOPAO's diffractive sensor with its threshold off, over a window
    of whole pixels nearest to a lenslet. OOPAO's ``SPRINT`` class, whose rounding loses shifts at
    the scale of a bench, and its modal bases, whose signs change between runs, are not used.

    Parameters
    ----------
    positions_m
        Nominal actuator positions ``(n_act, 2)`` as (x, y) on the pupil in metres.
    pitch_m
        Actuator pitch on the pupil in metres.
    coupling
        Mechanical coupling.
    stroke_m
        Metres of surface for a command of 1; the mirror reflects, so the path changes by twice that.
    amplitude
        Pupil amplitude ``(n, n)``, ``n`` an even multiple of ``n_sub``.
    sub_aperture_m
        Size of a sub-aperture on the pupil in metres.
    valid
        Valid sub-apertures ``(n_sub, n_sub)``.
    wavelength_m
        Wavelength in metres.
    pitch_px, spot_px
        Lenslet pitch and lambda/d in camera pixels.
    """

    name = "oopao"

    def __init__(
        self,
        positions_m: NDArray[np.float64],
        pitch_m: float,
        coupling: float,
        stroke_m: float,
        amplitude: NDArray[np.float32],
        sub_aperture_m: float,
        valid: NDArray[np.bool_],
        wavelength_m: float,
        pitch_px: float,
        spot_px: float,
    ) -> None:
        n, n_sub = amplitude.shape[0], valid.shape[0]
        if amplitude.shape != (n, n) or valid.shape != (n_sub, n_sub) or n % (2 * n_sub):
            raise ValueError(
                f"amplitude {amplitude.shape} and valid {valid.shape} must be square, "
                "with an even number of samples per sub-aperture"
            )
        self._positions, self._pitch, self._coupling = positions_m, pitch_m, coupling
        self._stroke, self._sub_aperture, self._valid = stroke_m, sub_aperture_m, valid
        self._pupil = amplitude > 0
        self._pixel = sub_aperture_m * n_sub / n
        # OOPAO's mirror lays its n samples from edge to edge, its wavefront has them at pixel
        # centres: everything the mirror is told in metres must be this much larger.
        self._edge = n / (n - 1)
        # Two OOPAO pixels per lambda/d.
        self._pixels = spot_px / 2
        self._light = make_light(amplitude, sub_aperture_m * n_sub, wavelength_m)
        self._lenslets = make_lenslets(self._light, n_sub, 2 * round(pitch_px / spot_px))
        dark = valid & ~self._lenslets.sh_data["src_0"].valid_subapertures
        if dark.any():
            raise CalibrationError(
                f"{int(dark.sum())} valid sub-apertures of the grid lie outside the design's pupil; "
                "check the grid's position and sensor.n_sub"
            )
        self._mirrors: dict[float, Any] = {}

    @property
    def n_act(self) -> int:
        """Number of actuators."""
        return len(self._positions)

    @property
    def sub_aperture_m(self) -> float:
        """Size of a sub-aperture on the pupil in metres."""
        return self._sub_aperture

    def influence_functions(self) -> tuple[NDArray[np.float64], NDArray[np.bool_], float]:
        """Nominal influence functions ``(n_act, n, n)``, pupil ``(n, n)`` and pixel size in metres."""
        n = self._pupil.shape[0]
        modes = np.asarray(self._mirror(1.0).modes, dtype=float)
        return modes.T.reshape(self.n_act, n, n), self._pupil, self._pixel

    def zonal_matrix(self, registration: Registration, width: float = 1.0) -> NDArray[np.float64]:
        """Slopes in camera pixels per unit command ``(n_slopes, n_act)``, all x then all y.

        Parameters
        ----------
        registration
            Registration of the mirror.
        width
            Scale of the influence functions' width relative to nominal.
        """
        moved = mis_registration(registration, self._sub_aperture * self._edge)
        with quiet():
            mirror = self._mirror(width).apply_mis_registration(moved)
        step = 2 * STEP_M
        pokes = np.eye(self.n_act) * step
        both = np.concatenate([self._valid, self._valid])
        out = np.empty((int(both.sum()), self.n_act))
        for start in range(0, self.n_act, _BATCH):
            part = pokes[:, start : start + _BATCH]
            difference = self._slopes(mirror, part) - self._slopes(mirror, -part)
            out[:, start : start + _BATCH] = difference[both]
        return out * (self._pixels * self._stroke * 2 / (2 * step))

    def _slopes(self, mirror: Any, paths_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Slope maps ``(2 n_sub, n_sub, n)`` in OOPAO's pixels for optical paths ``(n_act, n)``."""
        n = paths_m.shape[1]
        # OOPAO drops the last axis of a single wavefront, so one is sensed as two.
        if n == 1:
            paths_m = np.repeat(paths_m, 2, axis=1)
        light = self._light
        with quiet():
            mirror.coefs = paths_m
            # '**' starts a new propagation; '*' alone would add to the last one.
            light.source**light.telescope * mirror * self._lenslets
            return np.array(self._lenslets.signal_2D[..., :n])

    def _mirror(self, width: float) -> Any:
        """OOPAO's mirror in nominal position; the few widths in use are kept."""
        if width not in self._mirrors:
            if len(self._mirrors) >= 4:
                self._mirrors.clear()
            with quiet():
                self._mirrors[width] = oopao().DeformableMirror(
                    telescope=self._light.telescope,
                    nSubap=self._valid.shape[0],
                    mechCoupling=self._coupling,
                    coordinates=self._positions * self._edge,
                    pitch=self._pitch * self._edge * width,
                    print_dm_properties=False,
                )
        return self._mirrors[width]
