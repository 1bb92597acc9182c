"""One frame of a whole bench, by the twin and by OOPAO."""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from typing import TYPE_CHECKING, Any

import numpy as np

from escape_hw.api.modulator import Modulation
from escape_hw.config.sensor_models import PyramidSection
from escape_sim.devices import make_mirror, make_wfs_camera
from escape_sim.geometry import actuator_positions, pitch_on_pupil, pupil_geometry
from escape_sim.oopao_bridge import Light, make_light, make_pyramid, oopao, quiet
from escape_sim.sim_modulator import make_modulator

if TYPE_CHECKING:
    from escape_hw.config.models import SystemConfig

#: OOPAO's atmosphere thinks in telescopes: the same bench a thousand times larger.
_SCALE = 1000.0
#: Few enough to be cheap, enough that no call repeats the one before.
_N_COMMANDS = 8


def twin_frame(config: SystemConfig) -> Callable[[], object]:
    """A call that sends a command and takes a frame, from device to device."""
    shared: dict[str, object] = {}
    mirror = make_mirror("dm", config, shared).open()
    camera = make_wfs_camera("wfs", config, shared).open()
    if isinstance(config.sensor, PyramidSection) and config.devices.modulator is not None:
        section = config.devices.modulator
        radius = config.sensor.modulation * section.rad_per_lambda_d
        make_modulator("modulator", config, shared).open().modulate(Modulation(radius, section.frequency_hz))
    commands = 0.02 * np.random.default_rng(0).uniform(-1, 1, (_N_COMMANDS, mirror.info.n_act))
    turn = iter(range(1 << 62))

    def call() -> object:
        mirror.send(commands[next(turn) % _N_COMMANDS])
        return camera.next_frame(1.0).data

    return call


def oopao_frame(config: SystemConfig) -> Callable[[], object]:
    """A call that moves OOPAO's atmosphere and mirror and reads its sensor, noise included.

    A Shack-Hartmann sensor has its cheapest sampling, eight pixels per lenslet. A pyramid has the
    region's size, with the images on a square.
    """
    lib, pupil = oopao(), pupil_geometry(config)
    diameter = config.system.pupil_m * _SCALE
    light = make_light(pupil.amplitude, diameter, config.system.wavelength_m)
    power = float(np.square(pupil.amplitude, dtype=float).sum()) * light.unit
    telescope, source = light.telescope, light.source
    with quiet():
        # As many photons per frame as the twin has.
        rate = config.devices.wfs.frame_rate_hz
        telescope.samplingTime = 1 / rate
        telescope.pupilReflectivity = telescope.pupilReflectivity * (
            config.twin.wfs.photons_per_frame * rate / power
        )
        screen = config.devices.screen
        r0 = screen.screens_r0_m[screen.screen] if screen else 1.0
        atmosphere = import_module("OOPAO.Atmosphere").Atmosphere(
            telescope,
            r0=r0 * _SCALE * (500e-9 / config.system.wavelength_m) ** 1.2,
            L0=4 * diameter,
            windSpeed=[(screen.speed_m_s if screen else 0.0) * _SCALE],
            fractionalR0=[1.0],
            windDirection=[20],
            altitude=[0.0],
        )
        atmosphere.initializeAtmosphere(telescope)
        mirror = lib.DeformableMirror(
            telescope=telescope,
            nSubap=pupil.n_sub,
            mechCoupling=config.devices.dm.coupling,
            coordinates=actuator_positions(config) * _SCALE,
            pitch=pitch_on_pupil(config) * _SCALE,
            print_dm_properties=False,
        )
        sensor = _sensor(config, light, pupil.n_sub)
        sensor.cam.photonNoise = True
        sensor.cam.readoutNoise = config.twin.wfs.read_noise_e
    rng = np.random.default_rng(0)
    paths = 0.02 * 2 * config.devices.dm.stroke_m * rng.uniform(-1, 1, (_N_COMMANDS, mirror.nValidAct))
    turn = iter(range(1 << 62))

    def call() -> object:
        with quiet():
            atmosphere.update()
            mirror.coefs = paths[next(turn) % _N_COMMANDS]
            # '**' starts a new propagation; '*' goes on with it.
            source**atmosphere * telescope * mirror * sensor
            return sensor.signal

    return call


def _sensor(config: SystemConfig, light: Light, n_sub: int) -> Any:
    """OOPAO's sensor for a design."""
    if isinstance(config.sensor, PyramidSection):
        spare = config.devices.wfs.region[2] - 2 * n_sub
        sensor = make_pyramid(light, n_sub, spare // 4 * 2, (spare - spare // 4 * 2) // 2)
        sensor.modulation = config.sensor.modulation
        return sensor
    return oopao().ShackHartmann(
        nSubap=n_sub, telescope=light.telescope, lightRatio=config.sensor.min_flux, threshold_cog=0
    )
