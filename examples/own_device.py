"""Write drivers for a mirror and a camera, run the contract suite on them, and use them.

Run it with: python examples/own_device.py
"""

import logging
import threading
import time
from typing import Any

import numpy as np
from pydantic import Field

import escape_hw
from escape_drivers.common.options import section_options
from escape_hw.config.layouts import layout_map
from escape_hw.config.options import parse_options
from escape_hw.config.section import Section
from escape_hw.errors import FrameTimeout, NotOpen, SettingRejected
from escape_hw.safety.limits import CAUTIOUS_LIMITS

logging.getLogger("escape_hw").setLevel(logging.ERROR)  # the checks provoke failures


class AcmeElectronics:
    """Stand-in for a vendor library: 14-bit channels without any limits."""

    def __init__(self, channels: int) -> None:
        self.counts = np.full(channels, 8192, np.uint16)

    def write(self, counts: np.ndarray) -> None:
        """Drive every channel."""
        self.counts = counts


class AcmeMirror(escape_hw.DeformableMirror):
    """A driver implements four members; guard, ramps, counters and errors are in the base class."""

    def __init__(
        self, serial: str, *, name: str = "acme", limits: escape_hw.MirrorLimits = CAUTIOUS_LIMITS
    ) -> None:
        super().__init__(name, limits)
        self._serial, self._layout = serial, layout_map("circle-11")
        self._electronics: AcmeElectronics | None = None

    @classmethod
    def from_section(cls, section, context) -> "AcmeMirror":
        """The mirror of a system; a package names the class in its entry points ``escape.devices``."""
        return cls(section.serial, name=context.name, limits=section.limits.to_limits())

    @property
    def info(self) -> escape_hw.DMInfo:
        """Identity and geometry."""
        rows, columns = np.nonzero(self._layout)
        positions_m = 1.5e-3 * (np.stack([columns, rows], axis=1) - (len(self._layout) - 1) / 2)
        return escape_hw.DMInfo(
            model="Acme 97", serial=self._serial, n_act=len(positions_m), layout=self._layout,
            positions_m=positions_m, stroke_m=2.0e-6, simulated=True,
        )  # fmt: skip

    def _open(self) -> None:
        self._electronics = AcmeElectronics(self.info.n_act)  # load the vendor library here

    def _close(self) -> None:
        self._electronics = None

    def _send(self, command: np.ndarray) -> None:
        # The command is float64 (n_act,), fractions of full stroke, within every limit.
        self._electronics.write(np.rint(8192 + 8191 * command).astype(np.uint16))


class AcmeSensor:
    """Stand-in for a vendor library: a sensor of 640 x 512 pixels, with a register for each setting."""

    def __init__(self, black_level: int) -> None:
        self.registers = {"x": 0, "y": 0, "width": 640, "height": 512, "exposure_us": 1000, "period_us": 2000}
        self._black_level, self._stopped = black_level, threading.Event()

    def start(self) -> None:
        """Acquire from now on."""
        self._stopped.clear()
        self._start_ns, self._number = time.monotonic_ns(), 0

    def stop(self) -> None:
        """End the acquisition, and a wait."""
        self._stopped.set()

    def wait(self, timeout_s: float) -> tuple[int, int, np.ndarray] | None:
        """Number, end of exposure (ns) and counts of the newest frame that was not read; ``None``: none."""
        period_ns = 1000 * self.registers["period_us"]
        end_ns = time.monotonic_ns() + round(timeout_s * 1e9)
        number = max(self._number + 1, (time.monotonic_ns() - self._start_ns) // period_ns)
        due_ns = self._start_ns + number * period_ns
        while (left_ns := min(due_ns, end_ns) - time.monotonic_ns()) > 0:
            if self._stopped.wait(left_ns * 1e-9):
                return None
        if due_ns > end_ns:
            return None
        self._number = number
        shape = self.registers["height"], self.registers["width"]
        return number, due_ns, np.full(shape, self._black_level + number % 16, np.uint16)


class AcmeOptions(Section):
    """Keys of ``[devices.science.options]`` for this driver; others, and other types, are refused."""

    black_level: int = Field(16, ge=0, le=255)


class AcmeCamera(escape_hw.Camera):
    """A driver implements nine members and reports the settings that it reads back."""

    def __init__(
        self, serial: str, *, name: str = "acme-camera", region: tuple[int, int, int, int] = (0, 0, 640, 512),
        exposure_s: float = 1e-3, frame_rate_hz: float = 200.0, **options: Any,
    ) -> None:  # fmt: skip
        super().__init__(name)
        self._info = escape_hw.CameraInfo("Acme 640", serial, (512, 640), 12, simulated=True)
        self._settings = escape_hw.CameraSettings(escape_hw.Region(*region), exposure_s, frame_rate_hz)
        self._options = parse_options(AcmeOptions, name, options)
        self._sensor: AcmeSensor | None = None

    @classmethod
    def from_section(cls, section, context) -> "AcmeCamera":
        """The camera of a system; every key of its section is an attribute."""
        return cls(
            section.serial, name=context.name, region=section.region, exposure_s=section.exposure_s,
            frame_rate_hz=section.frame_rate_hz, **section_options(AcmeOptions, context.name, section),
        )  # fmt: skip

    @property
    def info(self) -> escape_hw.CameraInfo:
        """Identity and size of the sensor."""
        return self._info

    @property
    def settings(self) -> escape_hw.CameraSettings:
        """The settings that were read back."""
        return self._settings

    def _open(self) -> None:
        self._sensor = AcmeSensor(self._options.black_level)  # load the vendor library here
        self._require_valid(self._settings)
        self._configure(self._check(self._settings))

    def _close(self) -> None:
        self._sensor = None

    def _check(self, want: escape_hw.CameraSettings) -> escape_hw.CameraSettings:
        # The base class has refused regions off the sensor. This one is read in steps of 8 pixels, its times
        # are whole microseconds, and it has no gain.
        at = want.region
        left, top = -(-at.x // 8) * 8, -(-at.y // 8) * 8
        width, height = (at.x + at.width - left) // 8 * 8, (at.y + at.height - top) // 8 * 8
        if min(width, height) < 8:
            raise SettingRejected(self.name, f"region {at} contains no block of 8 x 8 pixels; enlarge it")
        period_us = round(1e6 / want.frame_rate_hz)
        if period_us < 2000:
            raise SettingRejected(
                self.name, f"frame_rate_hz is {want.frame_rate_hz:g}; it must be at most 500"
            )
        exposure_us = max(1, min(round(want.exposure_s * 1e6), period_us))
        region = escape_hw.Region(left, top, width, height)
        return escape_hw.CameraSettings(region, exposure_us * 1e-6, 1e6 / period_us)

    def _configure(self, settings: escape_hw.CameraSettings) -> None:
        at, there = settings.region, self._sensor.registers
        there.update(x=at.x, y=at.y, width=at.width, height=at.height)
        there.update(
            exposure_us=round(settings.exposure_s * 1e6), period_us=round(1e6 / settings.frame_rate_hz)
        )
        region = escape_hw.Region(*(there[key] for key in ("x", "y", "width", "height")))
        self._settings = escape_hw.CameraSettings(
            region, there["exposure_us"] * 1e-6, 1e6 / there["period_us"]
        )

    def _start(self) -> None:
        self._sensor.start()

    def _stop(self) -> None:
        self._sensor.stop()

    def _next_frame(self, timeout_s: float) -> escape_hw.Frame:
        found = self._sensor.wait(timeout_s)
        if found is None and not self.is_running:
            raise NotOpen(self.name, "was stopped or closed while a frame was awaited")
        if found is None:
            raise FrameTimeout(self.name, f"no frame within {timeout_s:g} s; allow a longer timeout")
        number, exposed_ns, counts = found  # copy them where the library uses its buffer again
        counts.flags.writeable = False
        saturated = int(np.count_nonzero(counts == self._info.full_scale))
        return escape_hw.Frame(counts, number, exposed_ns, self.now_ns(), saturated)


if __name__ == "__main__":
    # Level 1 moves by at most a percent, for the first test of a real mirror; level 3 uses the full range
    # within the limits.
    for make in (lambda: AcmeMirror("A-0001"), lambda: AcmeCamera("A-0002")):
        for result in escape_hw.testing.run_checks(make, max_level=3):
            print(f"{result.outcome:>8}  {result.check}  {result.message}".rstrip())

    # Alone, by the names of their drivers.
    escape_hw.register_device("acme", AcmeMirror)
    escape_hw.register_device("acme-camera", AcmeCamera)
    with escape_hw.open_device("acme-camera", serial="A-0002", black_level=100) as camera:
        frame = camera.next_frame(timeout_s=1.0)
        print(f"{camera.info.model}: frame of {frame.data.shape}, darkest pixel {frame.data.min()}")
    with escape_hw.open_device("acme", serial="A-0001") as dm:
        shape = dm.flat
        shape[48] = 0.05
        print(dm.send(shape).guard)

    # In a system, so that a configuration or --set can name them. These devices are not in the simulated
    # beam; see docs/devices/add-a-driver.md.
    changes = [
        "devices.dm.sim_driver=acme",
        "devices.science.sim_driver=acme-camera",
        "devices.science.options.black_level=50",
    ]
    with escape_hw.open_system("razor-shwfs", set=changes) as bench:
        report = bench.dm.send(np.full(bench.dm.info.n_act, 0.9))
        print(f"{bench.dm.info.model}: requested 0.9, sent {report.sent.max():.3f}; {report.guard}")
        frame = bench.science.next_frame(timeout_s=1.0)
        print(f"{bench.science.info.model} as {bench.science.name}: darkest pixel {frame.data.min()}")
