"""One frame of a whole bench, by the twin and by OOPAO."""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from typing import TYPE_CHECKING, Any

import numpy as np

from escape_hw.api.modulator import Modulation
from escape_hw.bench import Bench
from escape_hw.config.sensor import PyramidSection
from escape_sim.mirror.influence_functions import actuator_positions, pitch_on_pupil
from escape_sim.oopao.library import (
    SourceAndTelescope,
    make_pyramid,
    make_source,
    oopao_classes,
    suppress_output,
)
from escape_sim.optics.pupil import pupil_geometry

if TYPE_CHECKING:
    from escape_hw.config.system import SystemConfig

#: OOPAO's atmosphere thinks in telescopes: a bench is made a thousand times larger.
_SCALE = 1000.0
#: Few enough to be cheap, enough that no call repeats the one before.
_N_COMMANDS = 8


def twin_frame(config: SystemConfig) -> Callable[[], object]:
    """A call that sends a command and takes a frame, from device to device."""
    bench = Bench.from_config(config).open()
    if isinstance(config.sensor, PyramidSection) and bench.modulator and config.devices.modulator:
        section = config.devices.modulator
        radius = config.sensor.modulation * section.rad_per_lambda_d
        bench.modulator.modulate(Modulation(radius, section.frequency_hz))
    commands = 0.02 * np.random.default_rng(0).uniform(-1, 1, (_N_COMMANDS, bench.dm.info.n_act))
    counter = iter(range(1 << 62))

    def call() -> object:
        bench.dm.send(commands[next(counter) % _N_COMMANDS])
        return bench.wfs.next_frame(1.0).data

    return call


def oopao_frame(config: SystemConfig) -> Callable[[], object]:
    """A call that moves OOPAO's atmosphere and mirror and reads its sensor, noise included.

    A Shack-Hartmann sensor has its cheapest sampling, eight pixels per lenslet. A pyramid has the
    region's size, with the images on a square.
    """
    lib, pupil = oopao_classes(), pupil_geometry(config)
    twin, scale = config.twin, 1.0 if config.twin.atmosphere else _SCALE
    diameter = config.system.pupil_m * scale
    light = make_source(pupil.amplitude, diameter, config.system.wavelength_m)
    power = float(np.square(pupil.amplitude, dtype=float).sum()) * light.photons_per_unit
    telescope, source = light.telescope, light.source
    with suppress_output():
        # As many photons per frame as the twin has.
        rate = config.devices.wfs.frame_rate_hz
        photons = twin.star.electrons(1 / rate) if twin.star else twin.wfs.photons_per_frame
        telescope.samplingTime = 1 / rate
        telescope.pupilReflectivity = telescope.pupilReflectivity * (photons * rate / power)
        atmosphere = import_module("OOPAO.Atmosphere").Atmosphere(
            telescope, **_layer_options(config, diameter)
        )
        atmosphere.initializeAtmosphere(telescope)
        mirror = lib.DeformableMirror(
            telescope=telescope,
            nSubap=pupil.n_sub,
            mechCoupling=config.devices.dm.coupling,
            coordinates=actuator_positions(config) * scale,
            pitch=pitch_on_pupil(config) * scale,
            print_dm_properties=False,
        )
        sensor = _sensor(config, light, pupil.n_sub)
        sensor.cam.photonNoise = True
        sensor.cam.readoutNoise = twin.wfs.read_noise_e
    rng = np.random.default_rng(0)
    paths = 0.02 * 2 * config.devices.dm.stroke_m * rng.uniform(-1, 1, (_N_COMMANDS, mirror.nValidAct))
    counter = iter(range(1 << 62))

    def call() -> object:
        with suppress_output():
            atmosphere.update()
            mirror.coefs = paths[next(counter) % _N_COMMANDS]
            # '**' starts a new propagation; '*' continues it.
            source**atmosphere * telescope * mirror * sensor
            return sensor.signal

    return call


def _layer_options(config: SystemConfig, diameter: float) -> dict[str, Any]:
    """OOPAO's parameters of the layers of the open-air turbulence, or for the screen on the bench."""
    open_air, screen = config.twin.atmosphere, config.devices.screen
    if open_air is not None:
        r0, outer, speeds = open_air.r0_m, open_air.outer_scale_m, list(open_air.speed_m_s)
        fractions, directions = list(open_air.fraction), list(open_air.direction_deg)
    else:
        r0 = screen.screens_r0_m[screen.screen] if screen else 1.0
        # OOPAO's is that at 500 nm.
        r0 *= _SCALE * (500e-9 / config.system.wavelength_m) ** 1.2
        outer, speeds = 4 * diameter, [(screen.speed_m_s if screen else 0.0) * _SCALE]
        fractions, directions = [1.0], [20.0]
    return {
        "r0": r0,
        "L0": outer,
        "windSpeed": speeds,
        "fractionalR0": fractions,
        "windDirection": directions,
        "altitude": [0.0] * len(speeds),
    }


def _sensor(config: SystemConfig, light: SourceAndTelescope, n_sub: int) -> Any:
    """OOPAO's sensor for a design."""
    if isinstance(config.sensor, PyramidSection):
        spare = config.devices.wfs.region[2] - 2 * n_sub
        sensor = make_pyramid(light, n_sub, spare // 4 * 2, (spare - spare // 4 * 2) // 2)
        sensor.modulation = config.sensor.modulation
        return sensor
    return oopao_classes().ShackHartmann(
        nSubap=n_sub, telescope=light.telescope, lightRatio=config.sensor.min_flux, threshold_cog=0
    )
