"""Section [twin]: the true state of the simulated bench, which no calibration reads."""

from __future__ import annotations

import math
from typing import Annotated, Self

from pydantic import Field, model_validator

from escape_hw.api.registration import PARAMETERS, Registration
from escape_hw.config.section import RuleViolation, Section, TomlArray, raise_violations

_Shift = Annotated[float, Field(ge=-500, le=500)]
_Angle = Annotated[float, Field(ge=-90, le=90)]
_Scaling = Annotated[float, Field(ge=-30, le=30)]


class TwinDriftRate(Section):
    """Steady drift of each parameter of the registration, from the moment the bench is switched on."""

    shift_x: _Shift = Field(0.0, description="% of a sub-aperture per second")
    shift_y: _Shift = Field(0.0, description="% of a sub-aperture per second")
    rotation: _Angle = Field(0.0, description="degrees per second")
    radial_scaling: _Scaling = Field(0.0, description="% of the diameter per second")
    tangential_scaling: _Scaling = Field(0.0, description="% of the diameter per second")


class TwinDriftSwing(Section):
    """Amplitude of a slow sinusoid of each parameter, which starts at zero."""

    shift_x: _Shift = Field(0.0, description="% of a sub-aperture")
    shift_y: _Shift = Field(0.0, description="% of a sub-aperture")
    rotation: _Angle = Field(0.0, description="degrees")
    radial_scaling: _Scaling = Field(0.0, description="% of the diameter")
    tangential_scaling: _Scaling = Field(0.0, description="% of the diameter")


class TwinDrift(Section):
    """Flexure: how the registration moves on from ``twin.registration`` (``rate t + swing sin``)."""

    rate: TwinDriftRate = Field(default_factory=TwinDriftRate, description="steady drift")
    swing: TwinDriftSwing = Field(default_factory=TwinDriftSwing, description="amplitude of the sinusoid")
    period_s: float = Field(600.0, ge=0.1, le=1e6, description="period of the sinusoid, seconds")

    @property
    def is_drifting(self) -> bool:
        """Whether anything moves at all."""
        return any(getattr(part, name) for part in (self.rate, self.swing) for name in PARAMETERS)

    def offsets_at(self, time_s: float) -> list[float]:
        """How far each of the five parameters is from ``twin.registration`` at a time of the twin's clock."""
        phase_sine = math.sin(2 * math.pi * time_s / self.period_s)
        return [getattr(self.rate, n) * time_s + getattr(self.swing, n) * phase_sine for n in PARAMETERS]


class TwinSeeing(Section):
    """Fried parameter relative to its value at the start: ``1 + rate t + swing sin``, of plates and air."""

    rate: float = Field(0.0, ge=-1, le=1, description="steady change of r0 per second, fraction")
    swing: float = Field(0.0, ge=-0.95, le=0.95, description="amplitude of a sinusoid of r0, fraction")
    period_s: float = Field(600.0, ge=0.1, le=1e6, description="period of that sinusoid, seconds")
    least: float = Field(0.2, gt=0, le=1, description="r0 never falls below this, fraction of the start's")
    most: float = Field(5.0, ge=1, le=100, description="r0 never grows above this, fraction of the start's")

    @model_validator(mode="after")
    def _rules(self) -> Self:
        if 1 - abs(self.swing) < self.least:
            message = f"takes r0 below twin.seeing.least ({self.least:g}) in every period"
            raise_violations([RuleViolation("swing", self.swing, message)])
        return self


_Fraction = Annotated[float, Field(gt=0, le=1)]
_Speed = Annotated[float, Field(ge=0, le=200)]
_Degrees = Annotated[float, Field(ge=-360, le=360)]


class TwinAtmosphere(Section):
    """Open-air turbulence in layers, one entry of each list per layer."""

    r0_m: float = Field(gt=0, le=100, description="Fried parameter of all layers at 500 nm, metres")
    outer_scale_m: float = Field(gt=0, le=1e7, description="outer scale, metres")
    fraction: TomlArray[tuple[_Fraction, ...]] = Field(
        min_length=1, max_length=20, description="share of each layer in the turbulence, sums to 1"
    )
    speed_m_s: TomlArray[tuple[_Speed, ...]] = Field(
        description="wind speed of each layer, metres per second across the pupil"
    )
    direction_deg: TomlArray[tuple[_Degrees, ...]] = Field(
        description="where the wind of each layer blows to, degrees from +x towards +y"
    )
    boiling_s: Annotated[float, Field(allow_inf_nan=True)] = Field(
        math.inf,
        ge=0.02,
        description="time in which moving air forgets its shape (to 1/e), seconds; inf: never",
    )

    @model_validator(mode="after")
    def _rules(self) -> Self:
        n = len(self.fraction)
        violations = [
            RuleViolation(key, list(value), f"needs one entry for each of the {n} layers, has {len(value)}")
            for key, value in (("speed_m_s", self.speed_m_s), ("direction_deg", self.direction_deg))
            if len(value) != n
        ]
        total = sum(self.fraction)
        if abs(total - 1) > 1e-3:
            violations.append(RuleViolation("fraction", list(self.fraction), f"sums to {total:.6g}, not 1"))
        raise_violations(violations)
        return self


class TwinStar(Section):
    """The star that the sensor looks at; takes the place of ``twin.wfs.photons_per_frame``."""

    magnitude: float = Field(ge=-30, le=30, description="magnitude of the star in the sensor's band")
    zero_point: float = Field(
        ge=0, le=40, description="magnitude of a star that gives one photo-electron per second in all"
    )
    sky_magnitude: float | None = Field(
        None, ge=0, le=40, description="sky brightness, magnitudes per square arcsecond; absent: dark"
    )
    field_arcsec: float = Field(
        2.0, gt=0, le=600, description="diameter of the sensor's round field of view, arcseconds"
    )

    def electrons(self, exposure_s: float) -> float:
        """Photo-electrons from the star in an exposure, over the whole sensor."""
        return float(10 ** (0.4 * (self.zero_point - self.magnitude)) * exposure_s)

    def sky_electrons(self, exposure_s: float) -> float:
        """Photo-electrons from the sky in an exposure, over the whole sensor."""
        if self.sky_magnitude is None:
            return 0.0
        area = math.pi / 4 * self.field_arcsec**2
        return float(10 ** (0.4 * (self.zero_point - self.sky_magnitude)) * area * exposure_s)


class TwinContamination(Section):
    """Dust and uneven light on the pupil, which the configuration's design part knows nothing of.

    Actuators that had to be switched off because of it are known: ``devices.dm.limits.disabled``.
    """

    edge_share: float = Field(
        0.0, ge=0, le=1, description="contaminated share of the pupil's circumference, fraction"
    )
    angle_deg: float = Field(
        0.0, ge=-360, le=360, description="middle of the contaminated arc, degrees from +x towards +y"
    )
    depth: float = Field(
        0.15, gt=0, le=1, description="how far it reaches inwards, fraction of the pupil's radius"
    )
    transmission: float = Field(
        1.0, ge=0, le=1, description="share of the light that passes the contaminated part"
    )
    unevenness: float = Field(
        0.0, ge=0, le=0.5, description="smooth scatter of the light over the pupil, rms fraction"
    )
    edge_unevenness: float = Field(
        0.0,
        ge=0,
        le=0.2,
        description="scatter of the pupil's radius around its circumference, rms fraction of the radius",
    )


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
            raise_violations(
                [RuleViolation("influence_pixel_m", "", "influence_file needs the distance of its points")]
            )
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

    grid_offset_px: TomlArray[
        tuple[Annotated[float, Field(ge=-100, le=100)], Annotated[float, Field(ge=-100, le=100)]]
    ] = Field((0.0, 0.0), description="offset of the lenslet grid from the region's centre, (x, y) in pixels")
    pitch_px: float | None = Field(
        None, ge=2, le=1000, description="true pitch of the lenslets, pixels; absent: as sensor.pitch_px"
    )


Offset = TomlArray[tuple[Annotated[float, Field(ge=-20, le=20)], Annotated[float, Field(ge=-20, le=20)]]]


class TwinPyramid(Section):
    """How the twin's pyramid and its modulator differ from the design."""

    centre_offsets_px: TomlArray[tuple[Offset, Offset, Offset, Offset]] = Field(
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

    amplitude_rad: TomlArray[tuple[Annotated[float, Field(ge=0, le=1)], ...]] = Field(
        (), description="amplitude of each line on the sky, radians"
    )
    frequency_hz: TomlArray[tuple[Annotated[float, Field(gt=0, le=20000)], ...]] = Field(
        (), description="frequency of each line, hertz"
    )

    @model_validator(mode="after")
    def _rules(self) -> Self:
        n, m = len(self.amplitude_rad), len(self.frequency_hz)
        if n != m:
            raise_violations(
                [
                    RuleViolation(
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
