"""Sections [devices.*]: mirror, cameras, phase screens, modulator and its controller."""

from __future__ import annotations

import contextlib
from typing import TYPE_CHECKING, Annotated, Any, Literal, Self

from pydantic import Field, model_validator

from escape_hw.api.camera import CameraSettings, Region
from escape_hw.api.flips import FLIPS, Flip, combine_flips, exchanges_axes, flip_order, inverse_flip
from escape_hw.api.mirror import DMInfo
from escape_hw.config import layouts
from escape_hw.config.section import (
    ORDERS,
    LayoutText,
    OrderText,
    RuleViolation,
    Section,
    TomlArray,
    raise_violations,
)
from escape_hw.safety.limits import MirrorLimits

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray


#: Frequency (Hz), amplitudes of the axes x and y relative to the request, their lags (degrees).
Correction = TomlArray[
    tuple[
        Annotated[float, Field(gt=0)],
        Annotated[float, Field(gt=0.05, lt=20)],
        Annotated[float, Field(gt=0.05, lt=20)],
        Annotated[float, Field(ge=-360, le=360)],
        Annotated[float, Field(ge=-360, le=360)],
    ]
]
AxisGain = Annotated[float, Field(ge=-10, le=10)]


def derive_tilt_scale(document: Any) -> Any:
    """Set ``devices.modulator.rad_per_lambda_d`` from ``beam_m`` if it is absent.

    For a beam of diameter D on the modulator mirror it is ``wavelength / (2 D)``: reflection doubles the
    tilt. Returns the document; nothing is done if a value is missing or invalid.
    """
    try:
        wavelength_m, modulator = document["system"]["wavelength_m"], document["devices"]["modulator"]
        if "rad_per_lambda_d" in modulator or not modulator["beam_m"] > 0:
            return document
        tilt = wavelength_m / (2 * modulator["beam_m"])
    except (KeyError, TypeError):
        # The validation reports missing and invalid keys later.
        return document
    devices = {**document["devices"], "modulator": {**modulator, "rad_per_lambda_d": tilt}}
    return {**document, "devices": devices}


class WireConfig(Section):
    """Connection of the real controller; not used by the twin."""

    kind: Literal["tcp", "serial", "usb", "emulator"] = Field(
        "tcp", description="'tcp', 'serial', 'usb', or 'emulator' for one within this process"
    )
    host: str = Field("192.168.0.10", min_length=1, description="tcp: address of the controller")
    port: int = Field(50000, ge=1, le=65535, description="tcp: port of the controller")
    serial_port: str = Field("/dev/pi_e727", min_length=1, description="serial: device file")
    baud: int = Field(115200, ge=300, le=4_000_000, description="serial: bits per second")
    usb_vendor: int = Field(0x1A72, ge=0, le=0xFFFF, description="usb: vendor id")
    usb_product: int | None = Field(
        None, ge=0, le=0xFFFF, description="usb: product id; absent: any of this vendor"
    )
    timeout_s: float = Field(1.0, gt=0, le=60, description="longest wait for a reply, seconds")
    connect_s: float = Field(3.0, gt=0, le=60, description="longest wait for a connection, seconds")


class StageConfig(Section):
    """Axes of the real stage and correction of its circle; not used by the twin."""

    axes: TomlArray[tuple[str, str]] = Field(
        ("1", "2"), description="names of the axes that move the beam along x and y"
    )
    axis_gain: TomlArray[tuple[AxisGain, AxisGain]] = Field(
        (1.0, 1.0),
        description="beam tilt per tilt of each axis, relative to normal incidence; negative: reversed, "
        "0.707: axis at 45 degrees to the beam",
    )
    auto_zero: Literal["needed", "always", "never"] = Field(
        "needed", description="auto-zero on opening, which sweeps the full range for about a minute"
    )
    auto_zero_v: float | None = Field(
        None, ge=-30, le=135, description="voltage of auto-zero, volts; absent: default of the controller"
    )
    auto_zero_s: float = Field(180.0, gt=0, le=3600, description="longest wait for auto-zero, seconds")
    settle_s: float = Field(5.0, gt=0, le=600, description="longest wait for an axis on target, seconds")
    min_points: int = Field(20, ge=4, le=1000, description="smallest number of points per turn, 50 us each")
    max_points: int = Field(4096, ge=64, le=262144, description="largest number of points of a wave table")
    correction_source: Literal["recorder", "table", "none"] = Field(
        "recorder",
        description="source of the corrections of the circle: positions recorded at every start, the table "
        "'corrections', or none",
    )
    corrections: TomlArray[tuple[Correction, ...]] = Field(
        (),
        description="frequency (hertz), amplitudes of x and y relative to the request, lags of x and y "
        "(degrees), as reported by 'escape modulator start'",
    )
    circle_tolerance: float = Field(
        0.02, gt=0, le=0.5, description="largest relative error of radius and roundness after correction"
    )
    trigger_line: int = Field(1, ge=0, le=3, description="output that triggers the camera; 0: none")
    trigger_mode: int = Field(
        4, ge=0, le=99, description="number of the controller's mode 'generator trigger'"
    )
    trigger_point: int = Field(
        1, ge=1, le=262144, description="point of the turn at the rising edge of the pulse"
    )

    @model_validator(mode="after")
    def _rules(self) -> Self:
        violations = []
        if self.axes[0] == self.axes[1]:
            violations.append(RuleViolation("axes", list(self.axes), "the two axes must differ"))
        if any(abs(gain) < 0.1 for gain in self.axis_gain):
            text = "the magnitude must be at least 0.1"
            violations.append(RuleViolation("axis_gain", list(self.axis_gain), text))
        if self.min_points > self.max_points:
            text = f"max_points is {self.max_points}"
            violations.append(RuleViolation("min_points", self.min_points, text))
        if self.correction_source == "table" and not self.corrections:
            text = "needs stage.corrections; 'recorder' measures them"
            violations.append(RuleViolation("correction_source", self.correction_source, text))
        raise_violations(violations)
        return self


Mode = Literal["sim", "hardware"]
#: Sign of a mirror.
Polarity = Literal[-1, 1]
Pixels = Annotated[int, Field(ge=0, le=16384)]
Size = Annotated[int, Field(ge=1, le=16384)]
#: Distance between actuators, and surface for a command of 1, metres.
Pitch = Annotated[float, Field(gt=0, le=1)]
Stroke = Annotated[float, Field(gt=0, le=1e-3)]
#: Width and height of a sensor; x, y, width and height of a region.
SensorSize = TomlArray[tuple[Size, Size]]
RegionNumbers = TomlArray[tuple[Pixels, Pixels, Size, Size]]
BitDepth = Annotated[int, Field(ge=8, le=16)]
ExposureTime = Annotated[float, Field(ge=1e-6, le=60)]
FrameRate = Annotated[float, Field(ge=0.01, le=20000)]
Gain = Annotated[float, Field(ge=0, le=48)]


class DeviceConfig(Section):
    """Keys of every device section: driver, twin, and which of them to use."""

    driver: str = Field(
        "", description="driver of the real device (entry point in escape.devices); empty: none"
    )
    sim_driver: str = Field("", description="twin of the device (entry point in escape.devices)")
    mode: Mode | None = Field(None, description="'sim' or 'hardware' for this device; absent: as system.mode")
    serial: str = Field("", description="serial number; a device with another one is not opened")
    options: dict[str, str | int | float | bool] = Field(
        default_factory=dict, description="settings specific to the driver"
    )


class LimitsConfig(Section):
    """Limits of every command, enforced by the guard; an absent rule is off."""

    max_stroke: float = Field(
        1.0, gt=0, le=1, description="largest magnitude of a command, fraction of full stroke"
    )
    max_slew: float | None = Field(
        None, gt=0, le=2, description="largest change from one command to the next, fraction of full stroke"
    )
    max_neighbour: float | None = Field(
        None, gt=0, le=2, description="largest difference between adjacent actuators, fraction of full stroke"
    )
    max_mean: float | None = Field(
        None, gt=0, le=1, description="largest magnitude of the mean (piston), fraction of full stroke"
    )
    max_abs_sum: float | None = Field(
        None,
        gt=0,
        le=10_000,
        description="largest sum of the magnitudes of all commands, in full strokes",
    )
    disabled: TomlArray[tuple[Annotated[int, Field(ge=0)], ...]] = Field(
        (), description="indices of the actuators that must stay at zero"
    )

    def to_limits(self) -> MirrorLimits:
        """The limits for the guard."""
        return MirrorLimits(**self.model_dump())


def mirror_info(
    layout: str, pitch_m: float, stroke_m: float, model: str, serial: str, *, simulated: bool
) -> DMInfo:
    """Identity and nominal geometry of a mirror whose actuators are arranged as ``layout``."""
    return DMInfo(
        model,
        serial,
        layouts.n_actuators(layout),
        layouts.layout_map(layout) if layouts.is_on_grid(layout) else None,
        layouts.positions(layout) * pitch_m,
        stroke_m,
        simulated,
    )


def hardware_order(order: str, positions: NDArray[np.float64]) -> NDArray[np.intp] | None:
    """Number in the layout of each actuator of the hardware ``(n_act,)``; ``None``: the same.

    Parameters
    ----------
    order
        As in ``devices.dm.order``.
    positions
        Positions of the actuators in the layout ``(n_act, 2)``, pitches.

    Raises
    ------
    ValueError
        The order does not fit the layout.
    """
    import numpy as np

    if order == "none":
        return None
    for flip in FLIPS:
        if order == flip:
            return flip_order(positions, flip)
    numbers = np.array([int(number) for number in order.removeprefix("numbers:").split(",")], np.intp)
    if not np.array_equal(np.sort(numbers), np.arange(len(positions))):
        raise ValueError(f"has {numbers.size} numbers; it needs each of 0 to {len(positions) - 1} once")
    return numbers


class MirrorOrientation(Section):
    """Keys of a mirror's section that its base class applies, for a mirror that is used alone."""

    order: OrderText = "none"
    polarity: Polarity = 1


class CameraOrientation(Section):
    """As :class:`MirrorOrientation`, for a camera."""

    flip: Flip = "none"


class MirrorConfig(DeviceConfig):
    """Deformable mirror: nominal geometry and limits."""

    layout: LayoutText = Field(
        description=f"arrangement of the actuators: {layouts.FORMS}",
    )
    position_unit: Literal["pitch", "metre", "pupil-radius"] = Field(
        "pitch", description="unit of the positions in a layout 'positions:FILE', on the mirror"
    )
    order: OrderText = Field(
        "none",
        description="numbering of the actuators in the hardware: a flip that makes its map of numbers that "
        f"of the layout, or the layout's number of each: {ORDERS}",
    )
    polarity: Polarity = Field(1, description="-1: a positive command shortens the optical path")
    pitch_m: Pitch = Field(description="distance between actuators on the mirror, metres")
    pitches_across_pupil: float = Field(
        gt=0, le=200, description="actuator pitches across the diameter of the pupil"
    )
    influence: Literal["gaussian", "exponential", "thin-plate", "file"] = Field(
        "gaussian", description="nominal influence functions: gaussian, exponential, thin-plate, or file"
    )
    coupling: float = Field(
        ge=0.01, le=0.9, description="nominal influence at the adjacent actuator, fraction of the peak"
    )
    rounding: float = Field(
        0.27, gt=0, le=1, description="radius of the rounded tip of an exponential profile, pitches"
    )
    plate_rim: float = Field(
        0.6, ge=0, le=5, description="width of a thin plate beyond its outermost actuators, pitches"
    )
    influence_file: str = Field(
        "", description="FITS or .npy file with a map per actuator (n_act, n_y, n_x), for the shape file"
    )
    influence_pixel_m: float | None = Field(
        None,
        gt=0,
        le=1,
        description="pixel of influence_file on the mirror, metres; absent: from the actuators on the maps",
    )
    influence_unit: Literal["peak", "stroke", "metre", "micrometre", "nanometre"] | None = Field(
        None,
        description="unit of the maps: fraction of the median peak or of full stroke, or a length; absent: "
        "the file's BUNIT, else peak",
    )
    influence_poke: float = Field(
        1.0,
        ge=-1,
        le=1,
        description="command of each map, fraction of full stroke; negative: the maps show the opposite sign",
    )
    influence_wavefront: bool = Field(
        False, description="the maps show the reflected wavefront, twice the surface"
    )
    influence_positions: str = Field(
        "",
        description="positions of the actuators: 'layout', or a table of columns and rows on the maps (text, "
        ".npy or FITS); empty: the file's own, or found on the maps",
    )
    stroke_m: Stroke = Field(description="metres of surface at the actuator for a command of 1")
    limits: LimitsConfig = Field(default_factory=LimitsConfig, description="limits of every command")

    @property
    def n_act(self) -> int:
        """Number of actuators."""
        return layouts.n_actuators(self.layout)

    def actuator_map(self) -> NDArray[np.bool_] | None:
        """Boolean map of the grid, true where there is an actuator; ``None`` without a grid."""
        return layouts.layout_map(self.layout) if layouts.is_on_grid(self.layout) else None

    def positions(self) -> NDArray[np.float64]:
        """Actuator positions ``(n_act, 2)`` as (x, y) from the mirror's centre, in pitches."""
        in_pitches = {"pitch": 1.0, "metre": 1 / self.pitch_m, "pupil-radius": self.pitches_across_pupil / 2}
        return layouts.positions(self.layout) * in_pitches[self.position_unit]

    def hardware_order(self, order: str | None = None) -> NDArray[np.intp] | None:
        """As :func:`hardware_order`, in this layout.

        Parameters
        ----------
        order
            By default the key of the same name.
        """
        return hardware_order(self.order if order is None else order, self.positions())

    def layout_in_pitches(self) -> str:
        """The layout; a table of positions in pitches, whatever its unit."""
        if self.position_unit == "pitch":
            return self.layout
        return "points:" + ";".join(f"{x:.9g},{y:.9g}" for x, y in self.positions().tolist())

    def info(self, model: str, *, simulated: bool) -> DMInfo:
        """Identity and nominal geometry for a driver or twin."""
        layout = self.layout_in_pitches()
        return mirror_info(layout, self.pitch_m, self.stroke_m, model, self.serial, simulated=simulated)

    @model_validator(mode="after")
    def _rules(self) -> Self:
        last = self.n_act - 1
        bad = [i for i in self.limits.disabled if i > last]
        violations = [
            RuleViolation("limits.disabled", i, f"the actuators are numbered 0 to {last}") for i in bad
        ]
        if len(set(self.limits.disabled)) == self.n_act and not bad:
            text = "disables every actuator; leave at least one in service"
            violations.append(RuleViolation("limits.disabled", list(self.limits.disabled), text))
        try:
            self.hardware_order()
        except ValueError as error:
            text = f"{error}; give a table ('table:FILE')"
            violations.append(RuleViolation("order", self.order, text))
        if self.influence == "file" and not self.influence_file:
            violations.append(RuleViolation("influence_file", "", "is required with influence = 'file'"))
        if self.influence_poke == 0:
            violations.append(RuleViolation("influence_poke", 0.0, "must not be 0; it scales the maps"))
        if self.position_unit != "pitch" and not self.layout.startswith("points:"):
            text = "is the unit of a layout 'positions:FILE'; other layouts are in pitches; remove it"
            violations.append(RuleViolation("position_unit", self.position_unit, text))
        raise_violations(violations)
        return self


def exposure_violations(exposure_s: float, frame_rate_hz: float) -> list[RuleViolation]:
    """What is wrong with an exposure (seconds) at a frame rate (hertz)."""
    if exposure_s * frame_rate_hz <= 1:
        return []
    text = f"longer than a frame ({1 / frame_rate_hz:.4g} s at {frame_rate_hz:g} Hz)"
    return [RuleViolation("exposure_s", exposure_s, text)]


class CameraConfig(DeviceConfig):
    """A camera."""

    sensor_px: SensorSize = Field(description="width and height of the sensor after binning, pixels")
    region: RegionNumbers = Field(description="region: x, y, width, height, pixels")
    flip: Flip = Field(
        "none",
        description="how images are turned before they are used; turn-90 is from +x (columns) to +y (rows); "
        "region and sensor_px are those before",
    )
    bit_depth: BitDepth = Field(description="bits per pixel")
    exposure_s: ExposureTime = Field(description="exposure time, seconds")
    frame_rate_hz: FrameRate = Field(description="frames per second, hertz")
    gain_db: Gain = Field(0.0, description="analogue gain, decibels")
    timeout_s: float = Field(1.0, gt=0, le=120, description="longest wait for a frame, seconds")

    def settings(self) -> CameraSettings:
        """The settings for the camera."""
        return CameraSettings(Region(*self.region), self.exposure_s, self.frame_rate_hz, self.gain_db)

    @model_validator(mode="after")
    def _camera_rules(self) -> Self:
        x, y, width, height = self.region
        columns, rows = self.sensor_px
        violations = []
        if x + width > columns or y + height > rows:
            text = f"does not lie on the sensor of {columns} x {rows} pixels"
            violations.append(RuleViolation("region", list(self.region), text))
        if width != height and exchanges_axes(self.flip):
            text = f"exchanges rows and columns; needs a square region, not {width} x {height} pixels"
            violations.append(RuleViolation("flip", self.flip, text))
        raise_violations([*violations, *exposure_violations(self.exposure_s, self.frame_rate_hz)])
        return self


class SensorCameraConfig(CameraConfig):
    """The camera of the wavefront sensor."""

    dark_file: str = Field(
        "",
        description="dark.fits of `escape dark`, subtracted from every frame; on a star, frames beside it; "
        "absent: one level for all pixels",
    )
    flat_file: str = Field(
        "", description="flat.fits of `escape flat`, which every frame is divided by; absent: none"
    )


class ScienceConfig(CameraConfig):
    """The science camera, which records the point-spread function."""

    psf_px: float = Field(ge=0.5, le=100, description="lambda/D in camera pixels")
    model_psf: Literal["measured", "design"] = Field(
        "measured",
        description="reference of Strehl ratios: an image 'measured' without turbulence, or computed from "
        "the 'design' where the turbulence cannot be removed",
    )


#: Largest tilt of a mirror from its centre, radians.
LargestTilt = Annotated[float, Field(gt=0, le=0.1)]


class ModulatorConfig(DeviceConfig):
    """The tip-tilt stage that modulates the beam on a pyramid."""

    frequency_hz: float = Field(
        gt=0, le=5000, description="requested modulation frequency, hertz; the clock of the stage rounds it"
    )
    beam_m: float | None = Field(
        None, gt=0, le=10, description="beam diameter on the modulator mirror, metres"
    )
    rad_per_lambda_d: float = Field(
        gt=0,
        le=0.1,
        description="mirror tilt that moves the beam by 1 lambda/D on the pyramid, radians; absent: "
        "wavelength / (2 beam_m)",
    )
    max_tilt_rad: LargestTilt = Field(description="largest tilt of the mirror from its centre, radians")
    wire: WireConfig = Field(default_factory=WireConfig, description="connection of the real controller")
    stage: StageConfig = Field(default_factory=StageConfig, description="axes of the real stage")


class ScreenConfig(DeviceConfig):
    """The rotating phase screens, which provide the turbulence of a bench."""

    screens_r0_m: TomlArray[tuple[Annotated[float, Field(gt=0, le=10)], ...]] = Field(
        min_length=1, description="Fried parameter of each screen at the system's wavelength, metres"
    )
    screen: int = Field(0, ge=0, description="screen in use, counted from 0")
    speed_m_s: float = Field(
        ge=0, le=100, description="speed of the screen across the pupil, metres per second"
    )
    outer_scale_m: float = Field(
        gt=0, le=1000, description="outer scale of the turbulence in the twin, metres"
    )

    @model_validator(mode="after")
    def _rules(self) -> Self:
        n = len(self.screens_r0_m)
        if self.screen >= n:
            text = f"the {n} screens are numbered 0 to {n - 1}"
            raise_violations([RuleViolation("screen", self.screen, text)])
        return self


class DevicesConfig(Section):
    """The devices of a system."""

    dm: MirrorConfig = Field(description="deformable mirror")
    wfs: SensorCameraConfig = Field(description="camera of the wavefront sensor")
    science: ScienceConfig | None = Field(None, description="science camera; absent: none")
    screen: ScreenConfig | None = Field(None, description="phase screens; absent: none")
    modulator: ModulatorConfig | None = Field(
        None, description="tip-tilt modulator of a pyramid; absent: none"
    )

    def suggest_orientation(self, flip: Flip, *, opposite: bool) -> str:
        """Keys with which images are turned further by ``flip``, and commands have the ``opposite`` sign.

        A flip of the actuators' numbering has the same effect on a matrix as one of the camera, if the layout
        allows it; then both are named.
        """
        polarity = f"devices.dm.polarity = {-self.dm.polarity}"
        if flip == "none":
            return f"set {polarity}" if opposite else "correct the layout"
        text = f"set devices.wfs.flip = '{combine_flips(self.wfs.flip, flip)}'"
        present = next((one for one in FLIPS if one == self.dm.order), None)
        if present is None:
            text += " or, if the camera is right, correct the numbers of devices.dm.order"
        else:
            order = combine_flips(present, inverse_flip(flip))
            with contextlib.suppress(ValueError):
                self.dm.hardware_order(order)
                text += f" or, if the camera is right, devices.dm.order = '{order}'"
        return text + f", and {polarity}" * opposite
