"""Section [twin]: true state of the simulated bench. No calibration reads it."""

from __future__ import annotations

import math
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from escape_hw.api.flips import Flip
from escape_hw.api.registration import PARAMETERS, Registration
from escape_hw.config.section import OrderText, RuleViolation, Section, TomlArray, raise_violations

_Shift = Annotated[float, Field(ge=-500, le=500)]
_Angle = Annotated[float, Field(ge=-90, le=90)]
_Scaling = Annotated[float, Field(ge=-30, le=30)]


class TwinDriftRate(Section):
    """Linear drift of each parameter of the registration from the start of the bench."""

    shift_x: _Shift = Field(0.0, description="% of a sub-aperture per second")
    shift_y: _Shift = Field(0.0, description="% of a sub-aperture per second")
    rotation: _Angle = Field(0.0, description="degrees per second")
    radial_scaling: _Scaling = Field(0.0, description="% of the diameter per second")
    tangential_scaling: _Scaling = Field(0.0, description="% of the diameter per second")


class TwinDriftSwing(Section):
    """Amplitude of a slow sine of each parameter, zero at the start."""

    shift_x: _Shift = Field(0.0, description="% of a sub-aperture")
    shift_y: _Shift = Field(0.0, description="% of a sub-aperture")
    rotation: _Angle = Field(0.0, description="degrees")
    radial_scaling: _Scaling = Field(0.0, description="% of the diameter")
    tangential_scaling: _Scaling = Field(0.0, description="% of the diameter")


class TwinDrift(Section):
    """Flexure: drift of ``twin.registration`` by ``rate t + swing sin(2 pi t / period)``."""

    rate: TwinDriftRate = Field(default_factory=TwinDriftRate, description="linear drift")
    swing: TwinDriftSwing = Field(default_factory=TwinDriftSwing, description="amplitude of the sinusoid")
    period_s: float = Field(600.0, ge=0.1, le=1e6, description="period of the sinusoid, seconds")

    @property
    def is_drifting(self) -> bool:
        """Whether the registration drifts."""
        return any(getattr(part, name) for part in (self.rate, self.swing) for name in PARAMETERS)

    def offsets_at(self, time_s: float) -> list[float]:
        """Offsets of the five parameters from ``twin.registration`` at a time of the twin's clock."""
        phase_sine = math.sin(2 * math.pi * time_s / self.period_s)
        return [getattr(self.rate, n) * time_s + getattr(self.swing, n) * phase_sine for n in PARAMETERS]


class TwinSeeing(Section):
    """Fried parameter relative to the start: ``1 + rate t + swing sin(2 pi t / period)``."""

    rate: float = Field(0.0, ge=-1, le=1, description="linear change of r0 per second, fraction")
    swing: float = Field(0.0, ge=-0.95, le=0.95, description="amplitude of the sinusoid of r0, fraction")
    period_s: float = Field(600.0, ge=0.1, le=1e6, description="period of the sinusoid, seconds")
    least: float = Field(0.2, gt=0, le=1, description="lower bound of r0, fraction of its initial value")
    most: float = Field(5.0, ge=1, le=100, description="upper bound of r0, fraction of its initial value")

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
        min_length=1, max_length=20, description="fraction of the turbulence in each layer, sums to 1"
    )
    speed_m_s: TomlArray[tuple[_Speed, ...]] = Field(
        description="wind speed of each layer, metres per second across the pupil"
    )
    direction_deg: TomlArray[tuple[_Degrees, ...]] = Field(
        description="direction of motion of each layer, degrees from +x towards +y"
    )
    boiling_s: Annotated[float, Field(allow_inf_nan=True)] = Field(
        math.inf,
        ge=0.02,
        description="boiling: correlation time (1/e) in the moving frame, seconds; inf: frozen flow",
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
    """Guide star of the sensor; replaces ``twin.wfs.photons_per_frame``."""

    magnitude: float = Field(ge=-30, le=30, description="magnitude of the star in the band of the sensor")
    zero_point: float = Field(
        ge=0, le=40, description="magnitude of a star with one photo-electron per second on the whole sensor"
    )
    sky_magnitude: float | None = Field(
        None, ge=0, le=40, description="sky brightness, magnitudes per square arcsecond; absent: dark"
    )
    field_arcsec: float = Field(
        2.0, gt=0, le=600, description="diameter of the round field of view of the sensor, arcseconds"
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
    """Contamination and uneven illumination of the pupil, unknown to the calibration.

    Actuators that were disabled because of it are in ``devices.dm.limits.disabled``.
    """

    edge_share: float = Field(
        0.0, ge=0, le=1, description="contaminated fraction of the circumference of the pupil"
    )
    angle_deg: float = Field(
        0.0, ge=-360, le=360, description="centre of the contaminated arc, degrees from +x towards +y"
    )
    depth: float = Field(
        0.15, gt=0, le=1, description="radial extent of the contamination, fraction of the pupil radius"
    )
    transmission: float = Field(1.0, ge=0, le=1, description="transmission of the contaminated part")
    unevenness: float = Field(
        0.0, ge=0, le=0.5, description="smooth variation of the illumination over the pupil, rms fraction"
    )
    edge_unevenness: float = Field(
        0.0, ge=0, le=0.2, description="variation of the pupil radius along the circumference, rms fraction"
    )


class TwinRegistration(Section):
    """True registration of mirror and sensor (paper, Table 1)."""

    shift_x: float = Field(0.0, ge=-5000, le=5000, description="shift along columns, % of a sub-aperture")
    shift_y: float = Field(0.0, ge=-5000, le=5000, description="shift along rows, % of a sub-aperture")
    rotation: float = Field(0.0, ge=-180, le=180, description="rotation from +x towards +y, degrees")
    radial_scaling: float = Field(0.0, ge=-30, le=30, description="scaling along x, % of the diameter")
    tangential_scaling: float = Field(0.0, ge=-30, le=30, description="scaling along y, % of the diameter")
    anamorphosis_angle: float = Field(
        0.0, ge=-180, le=180, description="rotation of the axes of the scalings from +y towards +x, degrees"
    )

    def to_registration(self) -> Registration:
        """The registration for the models."""
        return Registration(**self.model_dump())


class TwinMirror(Section):
    """Deviations of the mirror from its data sheet.

    The shape ``exponential`` is drawn from ``system.seed``, as measured ALPAO mirrors are: rounding,
    four-fold term, positions and edge actuators, and the length unless ``coupling`` sets it.
    """

    shape: Literal["gaussian", "exponential", "thin-plate", "file", "nominal"] = Field(
        "gaussian",
        description="true influence functions: gaussian, exponential, thin-plate, file, or nominal (those of "
        "devices.dm.influence)",
    )
    order: OrderText = Field("none", description="true value of devices.dm.order")
    polarity: Literal[-1, 1] = Field(1, description="true value of devices.dm.polarity")
    gain_scatter: float = Field(0.0, ge=0, le=0.5, description="scatter of the actuator gains, rms fraction")
    coupling: float | None = Field(
        None, ge=0.01, le=0.9, description="true coupling, fraction; absent: as devices.dm.coupling"
    )
    stroke_m: float | None = Field(
        None,
        gt=0,
        le=1e-3,
        description="true metres of surface at the actuator for a command of 1; absent: as "
        "devices.dm.stroke_m",
    )
    width_scatter: float = Field(
        0.0, ge=0, le=0.5, description="scatter of the widths of the influence functions, rms fraction"
    )
    wing_fraction: float = Field(
        0.0, ge=0, le=0.5, description="fraction of each influence function in wings wider than its core"
    )
    influence_file: str = Field(
        "", description="FITS or .npy file of influence functions (n_act, n_y, n_x), for the shape file"
    )
    influence_pixel_m: float | None = Field(
        None, gt=0, le=10, description="pixel size of influence_file on the pupil, metres; needed with a file"
    )
    settling_s: float = Field(
        0.0, ge=0, le=1, description="time constant of the response to a command, seconds"
    )
    creep_fraction: float = Field(0.0, ge=0, le=0.5, description="fraction of a step that creeps")
    creep_time_s: float = Field(30.0, gt=0, le=1e5, description="time constant of the creep, seconds")

    @property
    def true_shape(self) -> str:
        """The shape; ``file`` wherever a file is given."""
        return "file" if self.influence_file else self.shape

    @model_validator(mode="after")
    def _rules(self) -> Self:
        violations = []
        if self.influence_file and self.influence_pixel_m is None:
            violations.append(RuleViolation("influence_pixel_m", "", "is required with influence_file"))
        if self.shape == "file" and not self.influence_file:
            violations.append(RuleViolation("influence_file", "", "is required with shape = 'file'"))
        if self.wing_fraction and self.true_shape != "gaussian":
            text = f"belongs to shape = 'gaussian', not to '{self.true_shape}'"
            violations.append(RuleViolation("wing_fraction", self.wing_fraction, text))
        raise_violations(violations)
        return self


class TwinCamera(Section):
    """Orientation, signal and noise of a camera (e- = photo-electrons)."""

    flip: Flip = Field("none", description="true value of the flip of this camera in devices")

    photons_per_frame: float = Field(
        1e7, gt=0, le=1e12, description="signal of the whole pupil in one exposure, e-"
    )
    read_noise_e: float = Field(0.0, ge=0, le=1000, description="read noise of a pixel, e- rms")
    full_well_e: float = Field(10000.0, ge=100, le=1e7, description="signal of a pixel at full scale, e-")
    dark_e: float = Field(0.0, ge=0, le=1e5, description="dark signal of a pixel in one exposure, e-")
    excess_noise: float = Field(
        1.0, ge=1, le=1.4143, description="excess noise factor of a multiplying detector; 1: none"
    )
    background: float = Field(0.0, ge=0, le=1e5, description="constant offset, e- per pixel and frame")
    fixed_pattern: float = Field(
        0.0, ge=0, le=0.5, description="scatter of the pixel sensitivities, rms fraction"
    )


class TwinSensor(TwinCamera):
    """Wavefront-sensor camera and the true lenslet grid on it."""

    grid_offset_px: TomlArray[
        tuple[Annotated[float, Field(ge=-100, le=100)], Annotated[float, Field(ge=-100, le=100)]]
    ] = Field(
        (0.0, 0.0), description="offset of the lenslet grid from the centre of the region, (x, y) in pixels"
    )
    pitch_px: float | None = Field(
        None, ge=2, le=1000, description="true lenslet pitch, pixels; absent: as sensor.pitch_px"
    )
    clocking_deg: float = Field(
        0.0,
        ge=-10,
        le=10,
        description="rotation on the camera of the lenslet grid and of the motions of its spots, degrees "
        "from +x towards +y",
    )
    distortion: float = Field(
        0.0,
        ge=-0.05,
        le=0.05,
        description="radial distortion of the lenslet grid about its centre, proportional to the cube of the "
        "distance: displacement of a spot at half the width of the grid, fraction of that distance",
    )


Offset = TomlArray[tuple[Annotated[float, Field(ge=-20, le=20)], Annotated[float, Field(ge=-20, le=20)]]]


class TwinBeam(Section):
    """True Gaussian illumination of the pupil; the pupil itself stays where it is."""

    radius_m: Annotated[float, Field(allow_inf_nan=True)] | None = Field(
        None,
        gt=0,
        description="true 1/e^2 intensity radius of the beam, metres; inf: uniform; absent: as "
        "sensor.beam_radius_m",
    )
    centre_m: TomlArray[
        tuple[Annotated[float, Field(ge=-100, le=100)], Annotated[float, Field(ge=-100, le=100)]]
    ] = Field((0.0, 0.0), description="centre of the beam from that of the pupil, (x, y) in metres")


class TwinPyramid(Section):
    """Deviations of the pyramid and its modulator from the design."""

    centre_offsets_px: TomlArray[tuple[Offset, Offset, Offset, Offset]] = Field(
        ((0.0, 0.0), (0.0, 0.0), (0.0, 0.0), (0.0, 0.0)),
        description="offset of each pupil image from sensor.pupils_px, (x, y) in pixels",
    )
    diameter_px: float | None = Field(
        None, ge=4, le=440, description="true diameter of a pupil image, pixels; absent: as sensor.n_sub"
    )
    rooftop: float = Field(
        0.0, ge=0, le=5, description="length of the roof edge at the tip of the pyramid, lambda/D"
    )
    radius_error: float = Field(
        0.0,
        ge=-0.5,
        le=0.5,
        description="relative error of the modulation radius: motion of the beam per tilt of the modulator, "
        "fraction",
    )
    ellipse: float = Field(
        0.0, ge=-0.5, le=0.5, description="relative difference of the modulation radii in x and y, fraction"
    )
    ellipse_angle_deg: float = Field(
        0.0, ge=-180, le=180, description="rotation of the axes of the ellipse, degrees from +x towards +y"
    )
    phase: float = Field(
        0.0, ge=-60, le=60, description="error of the 90 degree phase between the modulation axes, degrees"
    )
    drift: float = Field(
        0.0, ge=0, le=5, description="amplitude of the slow drift of the modulation centre, lambda/D"
    )
    drift_time_s: float = Field(600.0, gt=0, le=1e6, description="period of the drift, seconds")
    start_s: float = Field(0.0, ge=0, le=60, description="start-up time of the modulator, seconds")


class TwinVibration(Section):
    """Tip-tilt vibration: sinusoids, one entry of each list per line."""

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
            text = f"needs one frequency for each of the {n} amplitudes, has {m}"
            raise_violations([RuleViolation("frequency_hz", list(self.frequency_hz), text)])
        return self


class TwinNcpa(Section):
    """Non-common-path aberration, in the science path only."""

    rms_m: float = Field(0.0, ge=0, le=1e-4, description="wavefront error, metres rms")
    n_modes: int = Field(15, ge=1, le=1000, description="number of low-order modes it consists of")


class TwinConfig(Section):
    """The simulated bench."""

    substeps: int = Field(
        2,
        ge=1,
        le=50,
        description="images that are averaged in an exposure, each with the turbulence of its middle and the "
        "mean position of the mirror; 1: the exposure does not blur the turbulence",
    )
    run_seed: int | None = Field(
        None,
        ge=0,
        le=2**63 - 1,
        description="seed of turbulence, noise and timing; system.seed fixes the bench itself; "
        "absent: system.seed",
    )
    paced: bool = Field(False, description="true: run in real time; false: as fast as possible")
    loss_probability: float = Field(0.0, ge=0, le=0.5, description="probability that a frame is lost")
    latency_s: float = Field(
        0.0, ge=0, le=1, description="time from sending a command to the start of the motion, seconds"
    )
    latency_jitter_s: float = Field(0.0, ge=0, le=1, description="scatter of the latency, seconds rms")
    readout_s: float = Field(
        0.0, ge=0, le=60, description="time from the end of an exposure to the arrival of its frame, seconds"
    )
    registration: TwinRegistration = Field(default_factory=TwinRegistration, description="true registration")
    drift: TwinDrift = Field(default_factory=TwinDrift, description="flexure: drift of the registration")
    seeing: TwinSeeing = Field(default_factory=TwinSeeing, description="change of the turbulence strength")
    mirror: TwinMirror = Field(default_factory=TwinMirror, description="imperfections of the mirror")
    wfs: TwinSensor = Field(default_factory=TwinSensor, description="signal and noise of the sensor camera")
    science: TwinCamera = Field(
        default_factory=TwinCamera, description="signal and noise of the science camera"
    )
    beam: TwinBeam = Field(default_factory=TwinBeam, description="true illumination of the pupil")
    pyramid: TwinPyramid = Field(
        default_factory=TwinPyramid, description="imperfections of a pyramid and its modulator"
    )
    vibration: TwinVibration = Field(default_factory=TwinVibration, description="tip-tilt vibration")
    ncpa: TwinNcpa = Field(default_factory=TwinNcpa, description="non-common-path aberration")
    atmosphere: TwinAtmosphere | None = Field(None, description="atmosphere above a telescope; absent: none")
    star: TwinStar | None = Field(None, description="star and sky; absent: signal as in twin.wfs")
    contamination: TwinContamination = Field(
        default_factory=TwinContamination, description="contamination and uneven illumination of the pupil"
    )
