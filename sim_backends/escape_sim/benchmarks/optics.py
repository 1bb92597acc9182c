"""Frames per second of the twin, and the synthetic model, against OOPAO."""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from importlib.metadata import version
from typing import TYPE_CHECKING

import numpy as np

from escape_hw.api.benchmark import BenchmarkRow, alternate
from escape_hw.api.registration import Registration
from escape_hw.config.load import load_system
from escape_sim import model as fast_model
from escape_sim import oopao_model
from escape_sim.devices import make_mirror, make_wfs_camera
from escape_sim.geometry import actuator_positions, pitch_on_pupil, pupil_geometry
from escape_sim.oopao_bridge import make_light, oopao, quiet

if TYPE_CHECKING:
    from escape_hw.config.models import SystemConfig

_SYSTEM = "razor-shwfs"
#: OOPAO's atmosphere thinks in telescopes: the same bench a thousand times larger.
_SCALE = 1000.0
#: Few enough to be cheap, enough that no call repeats the one before.
_N_COMMANDS = 8


def run() -> list[BenchmarkRow]:
    """All rows of the stage."""
    # One propagation per frame, as in OOPAO.
    fast = load_system(_SYSTEM, overrides=["twin.substeps=1", "twin.loss_probability=0"])
    inside = load_system(
        _SYSTEM, overrides=["twin.substeps=1", "twin.loss_probability=0", "system.optics=oopao"]
    )
    peer = f"OOPAO {version('OOPAO')}"
    rows = []
    ours_s, peer_s = alternate(twin_frame(fast), oopao_frame(fast), seconds=3.0)
    rows.append(_rate("optics: twin frames", ours_s, peer_s, f"{peer}: atmosphere, mirror, sensor, noise"))
    ours_s, peer_s = alternate(twin_frame(fast), twin_frame(inside), seconds=3.0)
    rows.append(_rate("optics: twin frames, OOPAO inside", ours_s, peer_s, f"{peer} as system.optics"))
    rows.append(_matrix(fast, peer))
    return rows


def _rate(stage: str, ours_s: float, peer_s: float | None, peer: str) -> BenchmarkRow:
    note = "24 x 24 lenslets, 192 x 192 pupil samples; ours on 400 x 400 camera pixels"
    return BenchmarkRow(stage, 1 / ours_s, 1 / peer_s if peer_s else None, peer, "frame/s", "higher", note)


def _matrix(config: SystemConfig, peer: str) -> BenchmarkRow:
    ours, theirs = fast_model.make_model(config, None), oopao_model.make_model(config, None)
    at = Registration(-16.0, -71.0, -0.77, 2.9, 0.0)
    a, b = ours.zonal_matrix(at), theirs.zonal_matrix(at)
    agreement = float(np.linalg.norm(a - b) / np.linalg.norm(b))
    ours_s, peer_s = alternate(
        lambda: ours.zonal_matrix(at), lambda: theirs.zonal_matrix(at), seconds=3.0, rounds=3
    )
    return BenchmarkRow(
        "optics: synthetic zonal matrix",
        ours_s * 1e3,
        None if peer_s is None else peer_s * 1e3,
        f"{peer}: mirror and sensor, push and pull",
        "ms",
        "lower",
        f"relative difference {agreement:.1e}",
    )


def twin_frame(config: SystemConfig) -> Callable[[], object]:
    """A call that sends a command and takes a frame, from device to device."""
    shared: dict[str, object] = {}
    mirror = make_mirror("dm", config, shared).open()
    camera = make_wfs_camera("wfs", config, shared).open()
    commands = 0.02 * np.random.default_rng(0).uniform(-1, 1, (_N_COMMANDS, mirror.info.n_act))
    turn = iter(range(1 << 62))

    def call() -> object:
        mirror.send(commands[next(turn) % _N_COMMANDS])
        return camera.next_frame(1.0).data

    return call


def oopao_frame(config: SystemConfig) -> Callable[[], object]:
    """A call that moves OOPAO's atmosphere and mirror and reads its sensor, noise included.

    Its sensor has its cheapest sampling, eight pixels per lenslet.
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
        sensor = lib.ShackHartmann(
            nSubap=pupil.n_sub, telescope=telescope, lightRatio=config.sensor.min_flux, threshold_cog=0
        )
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
