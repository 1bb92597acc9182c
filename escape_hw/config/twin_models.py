"""Configuration of the twins: the truth a calibration never reads.

Whatever is left out describes an ideal device; a bundled system names its imperfections.
"""

from __future__ import annotations

from typing import Annotated, Self

from pydantic import Field, model_validator

from escape_hw.api.registration import Registration
from escape_hw.config.section import Breach, Listed, Section, enforce
from escape_hw.config.twin_drift import TwinDrift, TwinSeeing
from escape_hw.config.twin_sky import TwinAtmosphere, TwinContamination, TwinStar


class TwinRegistration(Section):
    """Hidden registration of mirror and sensor (paper, Table 1)."""

    shift_x: float = Field(0.0, ge=-5000, le=5000, description="shift along columns, % of a sub-aperture")
    shift_y: float = Field(0.0, ge=-5000, le=5000, description="shift along rows, % of a sub-aperture")
    rotation: float = Field(0.0, ge=-180, le=180, description="rotation from +x towards +y, degrees")
    radial_scaling: float = Field(0.0, ge=-30, le=30, description="scaling along x, % of the diameter")
    tangential_scaling: float = Field(0.0, ge=-30, le=30, description="scaling along y, % of the diameter")
    anamorphosis_angle: float = Field(
        0.0, ge=-180, le=180, description="turns the axes of the two scalings from +y towards +x, degrees"
    )

    def to_registration(self) -> Registration:
        """The registration as the models take it."""
        return Registration(
            self.shift_x,
            self.shift_y,
            self.rotation,
            self.radial_scaling,
            self.tangential_scaling,
            self.anamorphosis_angle,
        )


class TwinMirror(Section):
    """How the twin's mirror differs from its data sheet."""

    gain_scatter: float = Field(
        0.0, ge=0, le=0.5, description="scatter of the actuators' gains, rms fraction"
    )
    coupling: float | None = Field(
        None, ge=0.01, le=0.9, description="true coupling, fraction; absent: as devices.dm.coupling"
    )
    width_scatter: float = Field(
        0.0, ge=0, le=0.5, description="scatter of the influence functions' widths, rms fraction"
    )
    wing_fraction: float = Field(
        0.0,
        ge=0,
        le=0.5,
        description="share of each influence function in wings wider than its core, fraction",
    )
    influence_file: str = Field(
        "", description="FITS file of measured influence functions (n_act, n, n); empty: Gaussians"
    )
    influence_pixel_m: float | None = Field(
        None, gt=0, le=10, description="distance of its points on the pupil, metres; needed with a file"
    )
    settling_s: float = Field(
        0.0, ge=0, le=1, description="time constant of the response to a command, seconds"
    )
    creep_fraction: float = Field(0.0, ge=0, le=0.5, description="share of a step that creeps, fraction")
    creep_time_s: float = Field(30.0, gt=0, le=1e5, description="time constant of the creep, seconds")

    @model_validator(mode="after")
    def _rules(self) -> Self:
        if self.influence_file and self.influence_pixel_m is None:
            enforce([Breach("influence_pixel_m", "", "influence_file needs the distance of its points")])
        return self


class TwinCamera(Section):
    """Light and noise of a twin's camera (e- = photo-electrons)."""

    photons_per_frame: float = Field(
        1e7, gt=0, le=1e12, description="signal over the whole pupil in one exposure, e-"
    )
    read_noise_e: float = Field(0.0, ge=0, le=1000, description="read noise of a pixel, e- rms")
    full_well_e: float = Field(10000.0, ge=100, le=1e7, description="signal of a pixel at full scale, e-")
    dark_e: float = Field(0.0, ge=0, le=1e5, description="dark signal of a pixel in one exposure, e-")
    excess_noise: float = Field(
        1.0, ge=1, le=1.4143, description="excess noise factor of a multiplying detector; 1: none"
    )
    background: float = Field(
        0.0, ge=0, le=1e5, description="constant level under the image (offset), e- per pixel and frame"
    )
    fixed_pattern: float = Field(
        0.0, ge=0, le=0.5, description="scatter of the pixels' sensitivities, rms fraction"
    )


class TwinSensor(TwinCamera):
    """The twin's wavefront-sensor camera and the lenslet grid that really falls on it."""

    grid_offset_px: Listed[
        tuple[Annotated[float, Field(ge=-100, le=100)], Annotated[float, Field(ge=-100, le=100)]]
    ] = Field((0.0, 0.0), description="offset of the lenslet grid from the region's centre, (x, y) in pixels")
    pitch_px: float | None = Field(
        None, ge=2, le=1000, description="true pitch of the lenslets, pixels; absent: as sensor.pitch_px"
    )


Offset = Listed[tuple[Annotated[float, Field(ge=-20, le=20)], Annotated[float, Field(ge=-20, le=20)]]]


class TwinPyramid(Section):
    """How the twin's pyramid and its modulator differ from the design."""

    centre_offsets_px: Listed[tuple[Offset, Offset, Offset, Offset]] = Field(
        ((0.0, 0.0), (0.0, 0.0), (0.0, 0.0), (0.0, 0.0)),
        description="offset of each pupil image from sensor.pupils_px, (x, y) in pixels",
    )
    rooftop: float = Field(
        0.0, ge=0, le=5, description="length of the edge that stands in for the pyramid's tip, lambda/D"
    )
    ellipse: float = Field(
        0.0, ge=-0.5, le=0.5, description="difference of the modulation's radii along x and y, fraction"
    )
    phase: float = Field(
        0.0, ge=-60, le=60, description="what the modulation's axes lack of a quarter turn, degrees"
    )
    drift: float = Field(
        0.0, ge=0, le=5, description="amplitude of the slow drift of the modulation's centre, lambda/D"
    )
    drift_time_s: float = Field(600.0, gt=0, le=1e6, description="period of that drift, seconds")
    start_s: float = Field(0.0, ge=0, le=60, description="time that the modulator takes to start, seconds")


class TwinVibration(Section):
    """Tip-tilt vibration of the bench: sinusoids, one entry of each list per line."""

    amplitude_rad: Listed[tuple[Annotated[float, Field(ge=0, le=1)], ...]] = Field(
        (), description="amplitude of each line on the sky, radians"
    )
    frequency_hz: Listed[tuple[Annotated[float, Field(gt=0, le=20000)], ...]] = Field(
        (), description="frequency of each line, hertz"
    )

    @model_validator(mode="after")
    def _rules(self) -> Self:
        n, m = len(self.amplitude_rad), len(self.frequency_hz)
        if n != m:
            enforce(
                [
                    Breach(
                        "frequency_hz",
                        list(self.frequency_hz),
                        f"needs one frequency for each of the {n} amplitudes, has {m}",
                    )
                ]
            )
        return self


class TwinNcpa(Section):
    """Non-common-path aberration: what the science camera sees and the sensor does not."""

    rms_m: float = Field(0.0, ge=0, le=1e-4, description="wavefront error, metres rms")
    n_modes: int = Field(15, ge=1, le=1000, description="number of low-order modes that share it")


class TwinConfig(Section):
    """The simulated bench."""

    substeps: int = Field(2, ge=1, le=50, description="steps of the mirror's motion simulated per exposure")
    run_seed: int | None = Field(
        None,
        ge=0,
        le=2**63 - 1,
        description="seed of what differs from run to run (air, noise, timing) on the bench that system.seed "
        "makes; absent: system.seed",
    )
    paced: bool = Field(False, description="true: run in real time; false: as fast as the computer can")
    loss_probability: float = Field(0.0, ge=0, le=0.5, description="probability that a frame is lost")
    latency_s: float = Field(0.0, ge=0, le=1, description="time from sending a command to its start, seconds")
    latency_jitter_s: float = Field(0.0, ge=0, le=1, description="scatter of the latency, seconds rms")
    readout_s: float = Field(
        0.0, ge=0, le=60, description="time from the end of an exposure to its arrival, seconds"
    )
    registration: TwinRegistration = Field(
        default_factory=TwinRegistration, description="hidden registration"
    )
    drift: TwinDrift = Field(default_factory=TwinDrift, description="flexure: how the registration moves")
    seeing: TwinSeeing = Field(default_factory=TwinSeeing, description="how the turbulence changes")
    mirror: TwinMirror = Field(default_factory=TwinMirror, description="imperfections of the mirror")
    wfs: TwinSensor = Field(default_factory=TwinSensor, description="light and noise of the sensor's camera")
    science: TwinCamera = Field(
        default_factory=TwinCamera, description="light and noise of the science camera"
    )
    pyramid: TwinPyramid = Field(
        default_factory=TwinPyramid, description="imperfections of a pyramid and its modulator"
    )
    vibration: TwinVibration = Field(default_factory=TwinVibration, description="tip-tilt vibration")
    ncpa: TwinNcpa = Field(default_factory=TwinNcpa, description="non-common-path aberration")
    atmosphere: TwinAtmosphere | None = Field(None, description="open air above a telescope; absent: none")
    star: TwinStar | None = Field(None, description="star and sky; absent: light as in twin.wfs")
    contamination: TwinContamination = Field(
        default_factory=TwinContamination, description="dust and uneven light on the pupil"
    )
