"""Complete configuration of a system: sections [system], [telescope], [basis], [loop], [calibration], [tracking], [server] and rules between sections."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, Any, Literal, Self, TypeVar, get_args

from pydantic import Field, model_validator

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
from escape_hw.config.sensor import AnySensor, PyramidSection, SensorSection
from escape_hw.config.toml_text import dump_toml
from escape_hw.config.twin import TwinConfig
from escape_hw.errors import ConfigError


class TelescopeSection(Section):
    """What stands in the light before the pupil; ``system.pupil_m`` is its diameter."""

    obscuration: float = Field(
        0.0, ge=0, le=0.95, description="diameter of the central obscuration, fraction of the pupil's"
    )
    spider_m: float = Field(0.0, ge=0, le=10, description="width of the vanes that hold it, metres")
    spiders_deg: TomlArray[tuple[Annotated[float, Field(ge=-360, le=360)], ...]] = Field(
        (), description="where each vane points from the centre, degrees from +x towards +y"
    )

    @model_validator(mode="after")
    def _rules(self) -> Self:
        if self.spiders_deg and not self.spider_m:
            raise_violations(
                [RuleViolation("spider_m", self.spider_m, "the vanes of spiders_deg need a width")]
            )
        return self


class TrackingSection(Section):
    """How ``escape track`` follows a drifting system."""

    poke: float = Field(
        0.00025,
        gt=0,
        le=0.1,
        description="pokes in the closed loop are uniform in +-poke, rms surface as fraction of full stroke",
    )
    memory_s: float = Field(
        10.0, ge=1, le=1e5, description="time in which old frames fade to 1/e in the live registration"
    )
    worth: float = Field(
        0.01,
        gt=0,
        le=1,
        description="relative change of the matrix from which on a new one is worth an exchange",
    )
    limit: float = Field(
        0.3,
        gt=0,
        le=10,
        description="largest relative change of the matrix that is exchanged without asking",
    )
    largest_shift: float = Field(
        100.0,
        gt=0,
        le=1000,
        description="shift since the start that needs a new calibration, % of a sub-aperture",
    )


class ServerSection(Section):
    """Limits of ``escape serve``; all of them make the mirror safe, but for the first."""

    lease_s: float = Field(
        5.0, ge=1.5, le=600, description="a client that may write and is silent for so long loses that right"
    )
    abandoned_s: float = Field(
        10.0, ge=0.5, le=3600, description="time after which a procedure that nobody holds is aborted"
    )
    silent_s: float = Field(
        10.0,
        ge=2,
        le=600,
        description="an engine that says nothing for so long, its mirror not flat, is ended",
    )
    no_frames_s: float = Field(2.0, ge=0.2, le=600, description="longest time without a frame in closed loop")
    saturated_share: float = Field(
        0.2, gt=0, le=1, description="share of the actuators at their limits that counts as saturated"
    )
    saturated_s: float = Field(
        1.0, ge=0.2, le=600, description="longest time with saturated actuators in closed loop"
    )
    diverging_factor: float = Field(
        4.0, gt=1, le=1000, description="growth of the residual, beside its median, that counts as diverging"
    )
    diverging_s: float = Field(1.0, ge=0.2, le=600, description="longest time with a diverging residual")


S = TypeVar("S", bound=SensorSection)

#: Largest gain of the loop: an integrator above it diverges on any bench.
MAX_GAIN = 2.0


class SystemSection(Section):
    """What the system is."""

    name: str = Field(
        pattern=r"^[a-z0-9][a-z0-9_-]*$",
        max_length=64,
        description="name, written into every product (lower case, digits, '-' and '_')",
    )
    description: str = Field("", description="one line for lists and reports")
    mode: Mode = Field("sim", description="'sim': every device is its twin; 'hardware': the real ones")
    seed: int = Field(1, ge=0, le=2**63 - 1, description="seed of every random stream")
    wavelength_m: float = Field(ge=1e-7, le=1e-4, description="wavelength of the sensor's light, metres")
    pupil_m: float = Field(gt=0, le=100, description="diameter of the pupil, metres")
    optics: Literal["fast", "oopao"] = Field(
        "fast", description="the twin's optics: 'fast', or 'oopao' for the reference"
    )


class BasisSection(Section):
    """Modal basis of the calibration."""

    kind: Literal["kl", "zonal", "zernike", "fourier", "file"] = Field(
        "kl",
        description="'kl' (Karhunen-Loeve), 'zonal' (single actuators), 'zernike', 'fourier' or 'file'",
    )
    n_modes: int = Field(ge=1, le=10000, description="number of modes")
    file: str = Field("", description="FITS file of the mode-to-command matrix, for kind = 'file'")

    @model_validator(mode="after")
    def _rules(self) -> Self:
        if self.kind == "file" and not self.file:
            raise_violations([RuleViolation("file", "", "kind = 'file' needs the name of a FITS file")])
        if self.kind != "file" and self.file:
            raise_violations(
                [RuleViolation("file", self.file, f"is not read with kind = '{self.kind}'; remove it")]
            )
        return self


class LoopSection(Section):
    """Leaky integrator."""

    gain: float = Field(0.4, gt=0, le=MAX_GAIN, description="gain of the integrator")
    leak: float = Field(0.01, ge=0, le=1, description="share of the integrator lost per frame")
    dropped_modes: int = Field(
        0, ge=0, le=10000, description="weakest eigenmodes left out of the reconstructor"
    )


class CalibrationSection(Section):
    """Defaults of the calibration procedures."""

    poke: float = Field(
        0.02,
        gt=0,
        le=1,
        description="DO-CRIME: pokes are uniform in +-poke, rms surface as fraction of full stroke",
    )
    poke_command: float = Field(
        0.1,
        gt=0,
        le=1,
        description="largest command of any actuator in the poke of one mode, fraction of full stroke",
    )
    pokes: PokePattern = Field(
        "white",
        description="DO-CRIME: 'white' pokes, 'shaped' ones that change sign more often than not, or white "
        "ones that share the same Strehl budget so that modes have 'equal-snr'",
    )
    frames: int = Field(10000, ge=1, le=100_000_000, description="DO-CRIME: number of frames")
    push_pull_poke: float = Field(
        0.01, gt=0, le=1, description="push-pull: poke of each mode, rms surface as fraction of full stroke"
    )
    push_pull_frames: int = Field(
        20, ge=1, le=1_000_000, description="push-pull: frames per push and per pull"
    )
    modulated_frames: int = Field(
        500, ge=50, le=1_000_000, description="modulation: frames per batch of modes driven at once"
    )
    whiten_order: int = Field(
        6, ge=0, le=64, description="past frames that predict the turbulence; 0: plain estimator"
    )
    lags: int = Field(5, ge=1, le=64, description="frames over which the temporal response is estimated")
    checkpoint_s: float = Field(
        5.0, gt=0, description="seconds after which a calibration keeps its state again, to be resumed from"
    )
    estimator: Estimator = Field(
        "auto",
        description="what SPRINT fits: the 'matrix' or the whitened 'telemetry'; 'auto': the telemetry",
    )
    sprint_modes: int = Field(50, ge=1, le=10000, description="SPRINT: largest number of modes used")
    modes_choice: ModesChoice = Field(
        "snr",
        description="SPRINT: which modes: 'snr' (best measured), 'first', or those that tell most of the "
        "registration, 'd-optimal' or 'a-optimal'",
    )
    solver: Solver = Field(
        "effects",
        description="SPRINT: 'effects' (with what the model does not know), 'light' (gain and registration), "
        "'frozen' (the same, derivatives of the start), 'batches' (the paper's, few modes at a time), "
        "'diagonal' (a gain for every mode)",
    )
    actuators: ActuatorModel = Field(
        "found",
        description="the pseudo-synthetic matrix has the actuators' gains and widths as SPRINT 'found' them, "
        "or all 'alike', as the drawing has them",
    )
    loss: Loss = Field(
        "squares", description="SPRINT: 'squares', or 'huber' where some sub-apertures are not to be trusted"
    )
    also: TomlArray[tuple[ExtraParameter, ...]] = Field(
        (),
        description="SPRINT: what to fit beside the registration: 'anamorphosis' (shear of the mirror), "
        "'pupil_shift' (of a pyramid's images since they were found)",
    )
    learning_rate: float = Field(1.0, gt=0, le=1, description="SPRINT: share of each step that is taken")
    model: str = Field(
        "fast", min_length=1, description="SPRINT: synthetic model (entry point in escape.models)"
    )


class SystemConfig(Section):
    """The whole configuration of a system."""

    schema_version: Literal[1] = Field(1, alias="schema", description="version of these keys")
    system: SystemSection = Field(description="what the system is")
    telescope: TelescopeSection = Field(
        default_factory=TelescopeSection, description="what stands in the light before the pupil"
    )
    sensor: AnySensor = Field(description="the wavefront sensor")
    devices: DevicesConfig = Field(description="the devices")
    basis: BasisSection = Field(description="modal basis")
    loop: LoopSection = Field(default_factory=LoopSection, description="integrator")
    calibration: CalibrationSection = Field(
        default_factory=CalibrationSection, description="defaults of the calibration procedures"
    )
    tracking: TrackingSection = Field(default_factory=TrackingSection, description="the tracker")
    server: ServerSection = Field(default_factory=ServerSection, description="limits of the server")
    twin: TwinConfig = Field(default_factory=TwinConfig, description="the simulated bench")

    @model_validator(mode="before")
    @classmethod
    def _derived(cls, document: Any) -> Any:
        """Keys that follow from others."""
        return derive_tilt_scale(document)

    @property
    def simulated(self) -> bool:
        """True when any device is to be a twin."""
        present = [device for _, device in self.devices if isinstance(device, DeviceConfig)]
        return any((d.mode or self.system.mode) == "sim" and d.sim_driver for d in present)

    def to_toml(self) -> str:
        """The whole effective configuration, defaults included, as ASCII TOML text.

        Loading the text gives an equal configuration; products carry it in their headers.
        """
        return dump_toml(self.model_dump(by_alias=True, exclude_none=True))

    def sensor_as(self, kind: type[S]) -> S:
        """The sensor's section, for code that works with one kind of sensor only.

        Raises
        ------
        ConfigError
            The system has another kind of sensor.
        """
        if not isinstance(self.sensor, kind):
            wanted = kind.model_fields["kind"].annotation
            raise ConfigError(
                f"system '{self.system.name}' has sensor.kind = '{self.sensor.kind}'; "
                f"this needs {', '.join(map(repr, get_args(wanted)))}"
            )
        return self.sensor

    @model_validator(mode="after")
    def _rules(self) -> Self:
        n_act, n_modes = self.devices.dm.n_act, self.basis.n_modes
        violations = []
        if n_modes > n_act:
            violations.append(RuleViolation("basis.n_modes", n_modes, f"the mirror has {n_act} actuators"))
        if self.loop.dropped_modes >= n_modes:
            violations.append(
                RuleViolation(
                    "loop.dropped_modes",
                    self.loop.dropped_modes,
                    f"leaves none of the {n_modes} modes; lower it",
                )
            )
        raise_violations([*violations, *self._sensor_rules()])
        return self

    def _sensor_rules(self) -> Iterator[RuleViolation]:
        """What the kind of sensor asks of the other sections."""
        twin = self.twin
        if not isinstance(self.sensor, PyramidSection):
            text = f"is not read with sensor.kind = '{self.sensor.kind}'; remove it"
            for key, value in twin.pyramid.model_dump(exclude_defaults=True).items():
                yield RuleViolation(f"twin.pyramid.{key}", value, text)
            return
        modulator, radius = self.devices.modulator, self.sensor.modulation
        if radius and modulator is None:
            text = "needs a modulator, [devices.modulator]; 0 is a pyramid without modulation"
            yield RuleViolation("sensor.modulation", radius, text)
        beam_m = None if modulator is None else modulator.beam_m
        if modulator is not None and beam_m is not None:
            tilt = self.system.wavelength_m / (2 * beam_m)
            if abs(modulator.rad_per_lambda_d / tilt - 1) > 0.05:
                text = f"a beam of {beam_m:g} m has {tilt:.3g} (wavelength / (2 beam_m)); leave one out"
                yield RuleViolation("devices.modulator.rad_per_lambda_d", modulator.rad_per_lambda_d, text)
        if modulator is not None and radius * modulator.rad_per_lambda_d > modulator.max_tilt_rad:
            largest = modulator.max_tilt_rad / modulator.rad_per_lambda_d
            yield RuleViolation("sensor.modulation", radius, f"the modulator reaches {largest:.4g} lambda/D")
        width, height = self.devices.wfs.region[2:]
        for number in self.sensor.pupils_outside(width, height):
            centre = list(self.sensor.pupils_px[number])
            text = f"the region of {width} x {height} pixels cuts this image of {self.sensor.n_sub} pixels"
            yield RuleViolation("sensor.pupils_px", centre, text)
        moved = "is for lenslets; pupil images are moved by twin.pyramid.centre_offsets_px"
        if twin.wfs.pitch_px is not None:
            yield RuleViolation("twin.wfs.pitch_px", twin.wfs.pitch_px, moved)
        if any(twin.wfs.grid_offset_px):
            yield RuleViolation("twin.wfs.grid_offset_px", list(twin.wfs.grid_offset_px), moved)
