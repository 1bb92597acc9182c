"""GenICam cameras (USB3 Vision, GigE Vision) through Aravis: the science camera."""

from __future__ import annotations

import ctypes
import logging
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from escape_drivers.aravis_library import AravisLibrary, Received
from escape_drivers.camera_limits import CameraLimits, Range
from escape_drivers.options import camera_section, read_options, require_between, require_serial
from escape_drivers.waiting_camera import WaitingCamera
from escape_hw.api.frames import CameraSettings, Frame, Region
from escape_hw.errors import DeviceError, DeviceLost, NotOpen

if TYPE_CHECKING:
    from escape_hw.config.device_models import CameraConfig
    from escape_hw.config.models import SystemConfig

log = logging.getLogger(__name__)

#: After block 65535 of GigE Vision comes 1; longer identifiers go on.
_BLOCKS = (1, 65535)
_SUCCESS = 0
_STATUS = {
    1: "cleared", 2: "time-out", 3: "packets missing", 4: "wrong packet", 5: "wrong size", 6: "not filled",
    7: "aborted", 8: "payload not supported",
}  # fmt: skip
#: Cameras name the switch of their frame rate differently; the first that is there is used.
_RATE_SWITCHES = ("AcquisitionFrameRateEnable", "AcquisitionFrameRateEnabled")
#: What would change exposure, gain or rate behind our back, and how it is switched off.
_AUTOMATICS = ("ExposureAuto", "GainAuto", "AcquisitionFrameRateAuto")


@dataclass(frozen=True, slots=True)
class AravisOptions:
    """The ``[devices.science.options]`` of this driver.

    Parameters
    ----------
    library
        Path of ``libaravis-0.8.so.0``; empty: ``ESCAPE_ARAVIS_LIBRARY``, then the system's loader.
    interface
        Interface to switch on first: ``"Fake"`` brings Aravis's own simulated camera.
    pixel_format
        Format with 16 bits per pixel, or ``Mono8`` for 8; its name as GenICam has it.
    shift
        Bits to shift counts right: for cameras that fill a 16-bit word from the top.
    buffers
        Frames that may wait to be read.
    newest
        Skip to the newest frame when late; false: deliver every one.
    """

    library: str = ""
    interface: Literal["", "Fake"] = ""
    pixel_format: Literal["Mono16", "Mono14", "Mono12", "Mono10", "Mono8"] = "Mono16"
    shift: int = 0
    buffers: int = 8
    newest: bool = False


def make_camera(name: str, config: SystemConfig, shared: dict[str, object]) -> AravisCamera:
    """Entry point ``aravis``.

    Raises
    ------
    ConfigError
        No such camera, no serial number, or an option that this driver does not know.
    """
    section = camera_section(name, config)
    require_serial(name, section)
    options = read_options(AravisOptions, name, section)
    require_between(name, options, {"shift": (0, 8), "buffers": (2, 64)})
    return AravisCamera(name, section, options)


class AravisCamera(WaitingCamera):
    """A GenICam camera.

    Parameters
    ----------
    name
        Key in ``[devices]``.
    section
        Serial number, sensor, region, exposure and rate to begin with.
    options
        Of this driver.
    """

    def __init__(self, name: str, section: CameraConfig, options: AravisOptions) -> None:
        super().__init__(name, section, "GenICam camera", _BLOCKS)
        self._options = options
        self._library: AravisLibrary | None = None
        self._damaged = 0

    @property
    def damaged_frames(self) -> int:
        """Frames since ``start`` that arrived incomplete and were thrown away; they count as lost."""
        return self._damaged

    def _open(self) -> None:
        library = self._library = AravisLibrary(self.name, self._options.library)
        library.open(self._section.serial.strip(), self._options.interface)
        model = (library.call("camera_get_model_name") or b"GenICam camera").decode(errors="replace")
        library.call("camera_set_pixel_format_from_string", self._options.pixel_format.encode())
        for feature in _AUTOMATICS:
            if library.first_available([feature]):
                library.call("camera_set_string", feature.encode(), b"Off")
        switch = library.first_available(_RATE_SWITCHES)
        if switch is not None:
            library.call("camera_set_boolean", switch.encode(), 1)
        width, height = library.wholes("camera_get_sensor_size", 2)
        self._require_sensor((width, height), "to what the camera is")
        library.call("camera_set_region", 0, 0, width, height)
        self._limits = _limits(library)
        self._info = self._identity(model, library.stand_in or self._options.interface == "Fake")
        log.info("%s: %s, serial number %s", self.name, model, self._section.serial)
        self._settings = self._applied(self._check(self._section.settings()))

    def _disconnect(self) -> None:
        library, self._library = self._library, None
        if library is not None:
            library.close()

    def _applied(self, want: CameraSettings) -> CameraSettings:
        library, limits, region = self._connected(), self._known_limits(), want.region
        # Size and offsets limit each other: from the corner both can change.
        library.call("camera_set_region", 0, 0, region.width, region.height)
        library.call("camera_set_region", region.x, region.y, region.width, region.height)
        library.call("camera_set_exposure_time", want.exposure_s * 1e6)
        if limits.gain.high > limits.gain.low:
            library.call("camera_set_gain", want.gain_db)
        self._slowest_hz, self._fastest_hz = library.bounds("frame_rate")
        self._require_rate(want)
        library.call("camera_set_frame_rate", want.frame_rate_hz)
        return self._read_back(library, limits)

    def _read_back(self, library: AravisLibrary, limits: CameraLimits) -> CameraSettings:
        exposure_us = limits.exposure.nearest(library.call("camera_get_exposure_time"))
        gain = library.call("camera_get_gain") if limits.gain.high > limits.gain.low else limits.gain.low
        region = Region(*library.wholes("camera_get_region", 4))
        rate = float(library.call("camera_get_frame_rate"))
        return CameraSettings(region, exposure_us * 1e-6, rate, limits.gain.nearest(gain))

    def _begin(self) -> None:
        self._damaged = 0
        library = self._connected()
        try:
            library.begin_stream(self._options.buffers)
        except DeviceError:
            library.end_stream()
            raise

    def _end(self) -> None:
        library = self._connected()
        try:
            library.call("camera_stop_acquisition")
        finally:
            library.end_stream()

    def _take(self, wait_ms: int) -> Frame | None:
        library = self._connected()
        buffer = library.pop(wait_ms)
        while buffer is not None and self._options.newest:
            newer = library.pop(0)
            if newer is None:
                break
            library.push(buffer)
            buffer = newer
        if buffer is None:
            self._require_presence(library, wait_ms)
            return None
        try:
            return self._from_buffer(library.received(buffer))
        finally:
            library.push(buffer)

    def _require_presence(self, library: AravisLibrary, wait_ms: int) -> None:
        """Find out whether a silent camera is still there; not asked when nothing was waited for."""
        if wait_ms == 0:
            return
        try:
            library.call("camera_get_exposure_time")
        except DeviceError as error:
            raise DeviceLost(
                self.name, f"does not answer any more ({error}); check cable and power, then open it again"
            ) from error

    def _from_buffer(self, got: Received) -> Frame | None:
        if got.status != _SUCCESS:
            self._damaged += 1
            why = _STATUS.get(got.status, f"status {got.status}")
            log.info("%s: frame %d thrown away: %s", self.name, got.frame_id, why)
            return None
        return self._frame(self._counts(got), got.frame_id, got.timestamp_ns)

    def _counts(self, got: Received) -> NDArray[np.uint16]:
        """Counts in a buffer; a look at it where that is possible."""
        region = self._settings.region
        kind: Any = np.uint8 if self._options.pixel_format == "Mono8" else np.uint16
        needed = region.width * region.height * np.dtype(kind).itemsize
        if (got.width, got.height) != (region.width, region.height) or not got.address or got.size < needed:
            raise DeviceError(
                self.name,
                f"delivered {got.width} x {got.height} pixels in {got.size} bytes for a region of "
                f"{region.width} x {region.height} in {self._options.pixel_format}",
            )
        held = (ctypes.c_ubyte * needed).from_address(got.address)
        counts = np.ndarray((got.height, got.width), kind, buffer=held).astype(np.uint16, copy=False)
        return np.right_shift(counts, np.uint16(self._options.shift)) if self._options.shift else counts

    def _connected(self) -> AravisLibrary:
        if self._library is None:
            raise NotOpen(self.name, "is not connected; call open() first")
        return self._library


def _limits(library: AravisLibrary) -> CameraLimits:
    """Ask the camera, whose region must be the whole sensor."""
    sides = ("width", "height", "x_offset", "y_offset")
    steps = [library.call(f"camera_get_{name}_increment") for name in sides]
    width, height = (library.wholes(f"camera_get_{name}_bounds", 2) for name in ("width", "height"))
    try:
        gain = Range(*library.bounds("gain"), 0.0)
    except DeviceError as error:
        log.info("no gain: %s", error)
        gain = Range(0.0, 0.0, 0.0)
    return CameraLimits(
        Range(width[0], width[1], steps[0]),
        Range(height[0], height[1], steps[1]),
        steps[2],
        steps[3],
        Range(*library.bounds("exposure_time"), 0.0),
        gain,
    )
