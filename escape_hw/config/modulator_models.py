"""Configuration of a real tip-tilt stage: its wire, its axes and what corrects its circle."""

from __future__ import annotations

from typing import Annotated, Any, Literal, Self

from pydantic import Field, model_validator

from escape_hw.config.section import Breach, Listed, Section, enforce

#: Frequency (Hz), amplitude of the axes x and y relative to what was asked, their lags (degrees).
Correction = Listed[
    tuple[
        Annotated[float, Field(gt=0)],
        Annotated[float, Field(gt=0.05, lt=20)],
        Annotated[float, Field(gt=0.05, lt=20)],
        Annotated[float, Field(ge=-360, le=360)],
        Annotated[float, Field(ge=-360, le=360)],
    ]
]
AxisGain = Annotated[float, Field(ge=-10, le=10)]


def with_tilt(document: Any) -> Any:
    """A document whose modulator knows its tilt per lambda/D, if it tells the size of its beam.

    Reflection doubles the tilt, and a beam of diameter D on the mirror has its lambda/D there:
    ``rad_per_lambda_d = wavelength / (2 D)``.
    """
    try:
        wavelength_m, modulator = document["system"]["wavelength_m"], document["devices"]["modulator"]
        if "rad_per_lambda_d" in modulator or not modulator["beam_m"] > 0:
            return document
        tilt = wavelength_m / (2 * modulator["beam_m"])
    except (KeyError, TypeError):
        # What is missing or of the wrong kind is reported key by key later on.
        return document
    devices = {**document["devices"], "modulator": {**modulator, "rad_per_lambda_d": tilt}}
    return {**document, "devices": devices}


class WireConfig(Section):
    """How the controller is connected; the twin has no wire."""

    kind: Literal["tcp", "serial", "usb", "emulator"] = Field(
        "tcp", description="'tcp', 'serial', 'usb', or 'emulator' for one within this process"
    )
    host: str = Field("192.168.0.10", min_length=1, description="tcp: address of the controller")
    port: int = Field(50000, ge=1, le=65535, description="tcp: port of the controller")
    serial_port: str = Field("/dev/pi_e727", min_length=1, description="serial: device file")
    baud: int = Field(115200, ge=300, le=4_000_000, description="serial: bits per second")
    usb_vendor: int = Field(0x1A72, ge=0, le=0xFFFF, description="usb: vendor's number")
    usb_product: int | None = Field(
        None, ge=0, le=0xFFFF, description="usb: product's number; absent: any of the vendor's"
    )
    timeout_s: float = Field(1.0, gt=0, le=60, description="longest wait for an answer, seconds")
    connect_s: float = Field(3.0, gt=0, le=60, description="longest wait for a connection, seconds")


class StageConfig(Section):
    """The axes of the real stage and the circle they draw; the twin has its own truth."""

    axes: Listed[tuple[str, str]] = Field(
        ("1", "2"), description="names of the axes that move the beam along x and y"
    )
    axis_gain: Listed[tuple[AxisGain, AxisGain]] = Field(
        (1.0, 1.0),
        description="beam's tilt per tilt of each axis, relative to normal incidence; negative: reversed, "
        "0.707: an axis that the beam meets at 45 degrees",
    )
    auto_zero: Literal["needed", "always", "never"] = Field(
        "needed", description="auto-zero on opening; it sweeps the full range for about a minute"
    )
    auto_zero_v: float | None = Field(
        None, ge=-30, le=135, description="voltage of auto-zero, volts; absent: the controller's own"
    )
    auto_zero_s: float = Field(180.0, gt=0, le=3600, description="longest wait for auto-zero, seconds")
    settle_s: float = Field(5.0, gt=0, le=600, description="longest wait for an axis on target, seconds")
    min_points: int = Field(
        20, ge=4, le=1000, description="fewest points of a turn; the clock's 50 us times this is the shortest"
    )
    max_points: int = Field(4096, ge=64, le=262144, description="most points of a wave table")
    correct: Literal["recorder", "table", "none"] = Field(
        "recorder",
        description="what makes the circle round: positions recorded at every start, the table of "
        "'corrections', or nothing",
    )
    corrections: Listed[tuple[Correction, ...]] = Field(
        (),
        description="frequency (hertz), amplitude of x and of y relative to what was asked, lag of x and of "
        "y (degrees), as 'escape modulator start' reports them",
    )
    round_within: float = Field(
        0.02, gt=0, le=0.5, description="largest error of radius and roundness that counts as corrected"
    )
    trigger_line: int = Field(1, ge=0, le=3, description="output that triggers the camera; 0: none")
    trigger_mode: int = Field(4, ge=0, le=99, description="the controller's number of 'generator trigger'")
    trigger_point: int = Field(1, ge=1, le=262144, description="point of the turn where the pulse rises")

    @model_validator(mode="after")
    def _rules(self) -> Self:
        breaches = []
        if self.axes[0] == self.axes[1]:
            breaches.append(Breach("axes", list(self.axes), "two different axes are needed"))
        if any(abs(gain) < 0.1 for gain in self.axis_gain):
            text = "an axis that moves the beam less than a tenth of normal makes no circle"
            breaches.append(Breach("axis_gain", list(self.axis_gain), text))
        if self.min_points > self.max_points:
            breaches.append(Breach("min_points", self.min_points, f"max_points is {self.max_points}"))
        if self.correct == "table" and not self.corrections:
            text = "needs stage.corrections; 'recorder' measures them"
            breaches.append(Breach("correct", self.correct, text))
        enforce(breaches)
        return self
