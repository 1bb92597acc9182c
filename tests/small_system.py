"""The bundled Shack-Hartmann bench made small, so that tests run at thousands of frames per second."""

from __future__ import annotations

from escape_hw.config.loader import load_system
from escape_hw.config.system import SystemConfig

#: 12 x 12 lenslets, 37 actuators, 30 modes, moderate turbulence; everything else as on the real bench.
SMALL = (
    "sensor.n_sub=12",
    "sensor.beam_radius_m=inf",
    "devices.wfs.region=[220,156,200,200]",
    'devices.dm.layout="circle-7"',
    "devices.dm.pitches_across_pupil=5.0",
    "devices.dm.pitch_m=2.7e-3",
    "devices.screen.screen=2",
    "basis.n_modes=30",
    "calibration.sprint_modes=20",
    "loop.dropped_modes=4",
    "twin.wfs.photons_per_frame=2.5e6",
)
#: A nominal mirror with Gaussian influence functions, for tests whose reference has such a mirror.
GAUSSIAN = ("devices.dm.influence=gaussian", "devices.dm.coupling=0.4")
#: A true mirror that is nearly so, with every actuator where it belongs, for tests of an accuracy that the
#: scatter of the positions (1 % of the pitch) on a mirror like a DM97 hides: 97 actuators define the shift to
#: 0.26 % of a sub-aperture and the rotation to 0.014 degrees, whatever the frames.
GAUSSIAN_TWIN = (
    *GAUSSIAN,
    "twin.mirror.shape=gaussian",
    "twin.mirror.coupling=0.43",
    "twin.mirror.gain_scatter=0.05",
    "twin.mirror.wing_fraction=0.03",
)


def configuration(*more: str, seed: int | None = None) -> SystemConfig:
    """The configuration of the small bench, with further overrides."""
    return load_system("razor-shwfs", overrides=(*SMALL, *more), seed=seed)
