"""Complete configuration of a system, its general sections, and rules between sections."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, Any, Literal, Self, TypeVar, get_args

from pydantic import Field, model_validator

from escape_hw.api.flips import exchanges_axes
from escape_hw.config.choices import (
    ActuatorModel,
    Estimator,
    ExtraParameter,
    Loss,
    ModesChoice,
    PokePattern,
    Solver,
)
from escape_hw.config.devices import DeviceConfig, DevicesConfig, Mode, derive_tilt_scale
from escape_hw.config.section import RuleViolation, Section, TomlArray, raise_violations
from escape_hw.config.sensor import AnySensor, PyramidSection, SensorSection, ShackHartmannSection
from escape_hw.config.toml_text import dump_toml
from escape_hw.config.twin import TwinConfig
from escape_hw.errors import ConfigError

#: Largest relative difference of the twin's pupil images from their nominal diameter.
_DIAMETER_RANGE = 0.1


class TelescopeSection(Section):
    """Obscuration of the telescope; the diameter of its pupil is ``system.pupil_m``."""

    obscuration: float = Field(
        0.0, ge=0, le=0.95, description="diameter of the central obscuration, fraction of the pupil diameter"
    )
    spider_m: float = Field(0.0, ge=0, le=10, description="width of the spider vanes, metres")
    spiders_deg: TomlArray[tuple[Annotated[float, Field(ge=-360, le=360)], ...]] = Field(
        (), description="direction of each vane from the centre, degrees from +x towards +y"
    )

    @model_validator(mode="after")
    def _rules(self) -> Self:
        if self.spiders_deg and not self.spider_m:
            raise_violations(
                [RuleViolation("spider_m", self.spider_m, "the vanes in spiders_deg need a width above 0")]
            )
        return self


class TrackingSection(Section):
    """Settings of ``escape track``, which follows a drifting system in closed loop."""

    poke: float = Field(
        0.00025,
        gt=0,
        le=0.1,
        description="closed-loop pokes are uniform in +-poke, rms surface as fraction of full stroke",
    )
    forgetting_time_s: float = Field(
        10.0, ge=1, le=1e5, description="time constant of forgetting (1/e) in the live registration, seconds"
    )
    exchange_threshold: float = Field(
        0.01, gt=0, le=1, description="relative change of the matrix above which an exchange is proposed"
    )
    exchange_limit: float = Field(
        0.3, gt=0, le=10, description="largest relative change of the matrix exchanged without approval"
    )
    max_shift: float = Field(
        100.0,
        gt=0,
        le=1000,
        description="shift since the start above which a new calibration is needed, % of a sub-aperture",
    )


class ServerSection(Section):
    """Limits of ``escape serve``. Exceeding any of them but ``lease_s`` makes the mirror safe.

    A run and a closed loop go on without a client in control, unless ``unattended_s`` limits it for runs.
    """

    lease_s: float = Field(
        5.0, ge=1.5, le=600, description="a client with the write lease loses it after this silence, seconds"
    )
    unattended_s: float = Field(
        0.0, ge=0, le=3600,
        description="a procedure without a client in control is aborted after this, seconds; 0: it goes on",
    )  # fmt: skip
    engine_silence_s: float = Field(
        10.0,
        ge=2,
        le=600,
        description="longest silence of the engine while something runs or the mirror is not flat, seconds",
    )
    no_frames_s: float = Field(
        2.0, ge=0.2, le=600, description="longest time without a frame in closed loop, seconds"
    )
    saturated_fraction: float = Field(
        0.2, gt=0, le=1, description="fraction of the actuators at their limits that counts as saturated"
    )
    saturated_s: float = Field(
        1.0, ge=0.2, le=600, description="longest time with saturated actuators in closed loop, seconds"
    )
    diverging_factor: float = Field(
        4.0, gt=1, le=1000, description="ratio of the residual to its median that counts as diverging"
    )
    diverging_s: float = Field(
        1.0, ge=0.2, le=600, description="longest time with a diverging residual, seconds"
    )


S = TypeVar("S", bound=SensorSection)

#: Largest gain of the loop. An integrator with a higher gain is unstable at any delay.
MAX_GAIN = 2.0


class SystemSection(Section):
    """Identity of the system."""

    name: str = Field(
        pattern=r"^[a-z0-9][a-z0-9_-]*$",
        max_length=64,
        description="name, written into every product (lower case, digits, '-' and '_')",
    )
    description: str = Field("", description="one line for lists and reports")
    mode: Mode = Field("sim", description="'sim': every device is a twin; 'hardware': real devices")
    seed: int = Field(1, ge=0, le=2**63 - 1, description="seed of all random streams")
    wavelength_m: float = Field(ge=1e-7, le=1e-4, description="wavelength of the wavefront sensor, metres")
    pupil_m: float = Field(gt=0, le=100, description="pupil diameter, metres")
    optics: Literal["fast", "oopao"] = Field(
        "fast", description="optical model of the twin: 'fast', or 'oopao' as the reference"
    )


class BasisSection(Section):
    """Modal basis of the calibration."""

    kind: Literal["kl", "zonal", "zernike", "fourier", "file"] = Field(
        "kl", description="'kl' (Karhunen-Loeve), 'zonal' (single actuators), 'zernike', 'fourier' or 'file'"
    )
    n_modes: int = Field(ge=1, le=10000, description="number of modes")
    file: str = Field("", description="FITS file of the mode-to-command matrix, for kind = 'file'")

    @model_validator(mode="after")
    def _rules(self) -> Self:
        if self.kind == "file" and not self.file:
            raise_violations([RuleViolation("file", "", "kind = 'file' needs the name of a FITS file")])
        if self.kind != "file" and self.file:
            raise_violations(
                [RuleViolation("file", self.file, f"is not used with kind = '{self.kind}'; remove it")]
            )
        return self


class LoopSection(Section):
    """Leaky integrator."""

    gain: float = Field(0.4, gt=0, le=MAX_GAIN, description="integrator gain")
    leak: float = Field(0.01, ge=0, le=1, description="fraction of the integrator lost per frame")
    dropped_modes: int = Field(
        0, ge=0, le=10000, description="number of weakest eigenmodes left out of the reconstructor"
    )


class PriorsSection(Section):
    """Differences of real instruments from their model (rms): starting values, most of them chosen.

    SPRINT fits them beside the registration and begins with these; all but that of the common width are then
    estimated from the data, between 0.05 and 3 times the value here.
    """

    actuator_gain: float = Field(
        0.1, gt=0, le=2, description="gains of single actuators, relative; choice; ALPAO DM97: 0.09 to 0.10"
    )
    actuator_width: float = Field(
        0.05, gt=0, le=1,
        description="widths of single influence functions, relative; choice; ALPAO DM97: 0.03",
    )  # fmt: skip
    actuator_position: float = Field(
        5.0, gt=0, le=100,
        description="positions of single actuators along each axis, % of a sub-aperture; choice",
    )  # fmt: skip
    slope_gain: float = Field(
        0.1, gt=0, le=2,
        description="gains of single slopes, relative: uneven light, spot size, pixels; choice",
    )  # fmt: skip
    sampling: float = Field(
        0.5, gt=0, le=50,
        description="position of a lenslet within its column or row of pixels, % of a sub-aperture; choice",
    )  # fmt: skip
    width: float = Field(
        0.2, gt=0, le=1,
        description="common width of the influence functions, relative to the nominal one; choice",
    )  # fmt: skip


class CalibrationSection(Section):
    """Defaults of the calibration procedures."""

    poke: float = Field(
        0.02, gt=0, le=1, description="DO-CRIME: uniform in +-poke, rms surface as fraction of full stroke"
    )
    poke_command: float = Field(
        0.1, gt=0, le=1, description="largest command in the poke of one mode, fraction of full stroke"
    )
    pokes: PokePattern = Field(
        "white",
        description="DO-CRIME: 'white' pokes, 'anticorrelated' pokes, which change sign more often than not, "
        "or white pokes with amplitudes per mode that give 'equal-snr' at the same loss of Strehl ratio",
    )
    frames: int = Field(10000, ge=1, le=100_000_000, description="DO-CRIME: number of frames")
    push_pull_poke: float = Field(
        0.01, gt=0, le=1, description="push-pull: poke of each mode, rms surface as fraction of full stroke"
    )
    push_pull_frames: int = Field(
        20, ge=1, le=1_000_000, description="push-pull: frames per push and per pull"
    )
    modulated_frames: int = Field(
        500, ge=50, le=1_000_000, description="modulation-demodulation: frames per batch of modes"
    )
    whiten_order: int = Field(
        6, ge=0, le=64, description="number of past frames that predict the turbulence; 0: no whitening"
    )
    lags: int = Field(5, ge=1, le=64, description="length of the estimated temporal response, frames")
    checkpoint_s: float = Field(
        5.0, gt=0, description="interval between checkpoints of a calibration, seconds"
    )
    estimator: Estimator = Field(
        "auto", description="SPRINT: fit the 'matrix' or whitened 'telemetry'; 'auto': telemetry if possible"
    )
    sprint_modes: int = Field(50, ge=1, le=10000, description="SPRINT: largest number of modes used")
    modes_choice: ModesChoice = Field(
        "snr",
        description="SPRINT: selection of modes: highest 'snr', the 'first', or the most informative on the "
        "registration by the 'd-optimal' or 'a-optimal' criterion",
    )
    solver: Solver = Field(
        "mixed-effects",
        description="SPRINT: 'mixed-effects' (errors of the model as random effects), 'registration-only' "
        "(gain and registration), 'frozen-derivatives' (registration-only with the derivatives of the "
        "starting point), 'batches' (the paper's, a few modes at a time), 'diagonal' (a gain per mode)",
    )
    actuator_model: ActuatorModel = Field(
        "fitted",
        description="actuator gains and influence widths in the pseudo-synthetic matrix: as 'fitted' by "
        "SPRINT, or 'nominal'",
    )
    loss: Loss = Field(
        "squares", description="SPRINT: least 'squares', or 'huber' where some sub-apertures are outliers"
    )
    extra_parameters: TomlArray[tuple[ExtraParameter, ...]] = Field(
        (),
        description="SPRINT: parameters fitted beside the registration: 'anamorphosis' (shear of the "
        "mirror), 'pupil_shift' (of pyramid pupil images since they were located)",
    )
    learning_rate: float = Field(1.0, gt=0, le=1, description="SPRINT: fraction of each Gauss-Newton step")
    model: str = Field(
        "fast", min_length=1, description="SPRINT: synthetic model (entry point in escape.models)"
    )
    priors: PriorsSection = Field(
        default_factory=PriorsSection, description="SPRINT: expected differences of the system from its model"
    )


class SystemConfig(Section):
    """The whole configuration of a system."""

    schema_version: Literal[1] = Field(1, alias="schema", description="version of these keys")
    system: SystemSection = Field(description="identity of the system")
    telescope: TelescopeSection = Field(
        default_factory=TelescopeSection, description="obscuration of the telescope"
    )
    sensor: AnySensor = Field(description="wavefront sensor")
    devices: DevicesConfig = Field(description="devices")
    basis: BasisSection = Field(description="modal basis")
    loop: LoopSection = Field(default_factory=LoopSection, description="integrator")
    calibration: CalibrationSection = Field(
        default_factory=CalibrationSection, description="defaults of the calibration procedures"
    )
    tracking: TrackingSection = Field(default_factory=TrackingSection, description="tracker")
    server: ServerSection = Field(default_factory=ServerSection, description="limits of the server")
    twin: TwinConfig = Field(default_factory=TwinConfig, description="simulated bench")

    @model_validator(mode="before")
    @classmethod
    def _derive_keys(cls, document: Any) -> Any:
        """Fill in keys that follow from others."""
        return derive_tilt_scale(document)

    @property
    def simulated(self) -> bool:
        """True when any device is a twin."""
        present = [device for _, device in self.devices if isinstance(device, DeviceConfig)]
        return any((d.mode or self.system.mode) == "sim" and d.sim_driver for d in present)

    def to_toml(self) -> str:
        """The effective configuration, defaults included, as ASCII TOML text.

        Loading the text gives an equal configuration. Products store it.
        """
        return dump_toml(self.model_dump(by_alias=True, exclude_none=True))

    def sensor_as(self, kind: type[S]) -> S:
        """The sensor section, for code that supports one kind of sensor only.

        Raises
        ------
        ConfigError
            The system has another kind of sensor.
        """
        if not isinstance(self.sensor, kind):
            wanted = kind.model_fields["kind"].annotation
            raise ConfigError(
                f"system '{self.system.name}' has sensor.kind = '{self.sensor.kind}'; "
                f"this operation needs {', '.join(map(repr, get_args(wanted)))}"
            )
        return self.sensor

    @model_validator(mode="after")
    def _rules(self) -> Self:
        n_act, n_modes = self.devices.dm.n_act, self.basis.n_modes
        violations = []
        if n_modes > n_act:
            violations.append(RuleViolation("basis.n_modes", n_modes, f"the mirror has {n_act} actuators"))
        if self.loop.dropped_modes >= n_modes:
            text = f"leaves none of the {n_modes} modes; lower it"
            violations.append(RuleViolation("loop.dropped_modes", self.loop.dropped_modes, text))
        raise_violations([*violations, *self._sensor_rules(), *self._twin_orientation_rules()])
        return self

    def _twin_orientation_rules(self) -> Iterator[RuleViolation]:
        """The true orientations of the twin are possible ones."""
        devices, twin = self.devices, self.twin
        for name in ("wfs", "science"):
            camera, flip = getattr(devices, name), getattr(twin, name).flip
            if camera is not None and camera.region[2] != camera.region[3] and exchanges_axes(flip):
                text = f"exchanges rows and columns; needs a square devices.{name}.region"
                yield RuleViolation(f"twin.{name}.flip", flip, text)
        try:
            devices.dm.hardware_order(twin.mirror.order)
        except ValueError as error:
            yield RuleViolation("twin.mirror.order", twin.mirror.order, str(error))

    def _region_rules(self, sensor: ShackHartmannSection) -> Iterator[RuleViolation]:
        """The region of a Shack-Hartmann sensor has room for its sub-apertures."""
        *_, width, height = region = self.devices.wfs.region
        columns, rows = sensor.least_region()
        if width < columns or height < rows:
            text = (
                f"is too small for {sensor.n_sub} sub-apertures of {sensor.pitch_px:g} pixels; "
                f"needs at least {columns} x {rows} pixels"
            )
            yield RuleViolation("devices.wfs.region", list(region), text)

    def _lenslet_rules(self) -> Iterator[RuleViolation]:
        """OOPAO's lenslets form a square grid along the pixels."""
        for key in ("clocking_deg", "distortion"):
            value = getattr(self.twin.wfs, key)
            if value and self.system.optics != "fast":
                yield RuleViolation(f"twin.wfs.{key}", value, "needs system.optics = 'fast'")

    def _sensor_rules(self) -> Iterator[RuleViolation]:
        """Rules between the sensor and the other sections."""
        twin = self.twin
        if not isinstance(self.sensor, PyramidSection):
            text = f"is not used with sensor.kind = '{self.sensor.kind}'; remove it"
            for key, value in twin.pyramid.model_dump(exclude_defaults=True).items():
                yield RuleViolation(f"twin.pyramid.{key}", value, text)
            yield from self._region_rules(self.sensor)
            yield from self._lenslet_rules()
            return
        modulator, radius = self.devices.modulator, self.sensor.modulation
        if radius and modulator is None:
            text = "needs a section [devices.modulator]; 0 is a pyramid without modulation"
            yield RuleViolation("sensor.modulation", radius, text)
        beam_m = None if modulator is None else modulator.beam_m
        if modulator is not None and beam_m is not None:
            tilt = self.system.wavelength_m / (2 * beam_m)
            if abs(modulator.rad_per_lambda_d / tilt - 1) > 0.05:
                text = f"beam_m = {beam_m:g} gives {tilt:.3g} (wavelength / (2 beam_m)); leave one out"
                yield RuleViolation("devices.modulator.rad_per_lambda_d", modulator.rad_per_lambda_d, text)
        if modulator is not None and radius * modulator.rad_per_lambda_d > modulator.max_tilt_rad:
            largest = modulator.max_tilt_rad / modulator.rad_per_lambda_d
            yield RuleViolation("sensor.modulation", radius, f"the modulator reaches {largest:.4g} lambda/D")
        width, height = self.devices.wfs.region[2:]
        for number in self.sensor.pupils_outside(width, height):
            centre = list(self.sensor.pupils_px[number])
            n = self.sensor.n_sub
            text = f"the region of {width} x {height} pixels cuts off part of this image of {n} pixels"
            yield RuleViolation("sensor.pupils_px", centre, text)
        true_px = twin.pyramid.diameter_px
        if true_px is not None and abs(true_px / self.sensor.n_sub - 1) > _DIAMETER_RANGE:
            text = f"differs from sensor.n_sub = {self.sensor.n_sub} by more than {_DIAMETER_RANGE:.0%}"
            yield RuleViolation("twin.pyramid.diameter_px", true_px, text)
        for key in ("clocking_deg", "distortion"):
            if value := getattr(twin.wfs, key):
                yield RuleViolation(f"twin.wfs.{key}", value, "applies to lenslets; remove it")
        moved = "applies to lenslets; use twin.pyramid.centre_offsets_px to move pupil images"
        if twin.wfs.pitch_px is not None:
            yield RuleViolation("twin.wfs.pitch_px", twin.wfs.pitch_px, moved)
        if any(twin.wfs.grid_offset_px):
            yield RuleViolation("twin.wfs.grid_offset_px", list(twin.wfs.grid_offset_px), moved)
