"""GenICam cameras (USB3 Vision, GigE Vision) through Aravis: the science camera."""

from __future__ import annotations

import ctypes
import logging
from typing import TYPE_CHECKING, Any, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from escape_drivers.aravis.library import AravisLibrary, ReceivedBuffer
from escape_drivers.common.camera import BlockingCamera, split_settings
from escape_drivers.common.camera_limits import CameraLimits, ParameterRange
from escape_drivers.common.options import camera_settings, section_options
from escape_hw.api.camera import CameraSettings, Frame, Region
from escape_hw.config.section import Section
from escape_hw.errors import ConfigError, DeviceError, DeviceLost

if TYPE_CHECKING:
    from escape_hw.config.devices import CameraConfig
    from escape_hw.config.registry import DeviceContext

log = logging.getLogger(__name__)

#: Block identifiers of GigE Vision wrap from 65535 to 1; longer identifiers do not wrap.
_BLOCK_ID_RANGE = (1, 65535)
_SUCCESS = 0
_STATUS_TEXT = {
    1: "cleared", 2: "time-out", 3: "packets missing", 4: "wrong packet", 5: "wrong size", 6: "not filled",
    7: "aborted", 8: "payload not supported",
}  # fmt: skip
#: Cameras name the switch of their frame rate differently; the first that is there is used.
_RATE_SWITCHES = ("AcquisitionFrameRateEnable", "AcquisitionFrameRateEnabled")
#: What would change exposure, gain or rate behind our back, and how it is switched off.
_AUTO_FEATURES = ("ExposureAuto", "GainAuto", "AcquisitionFrameRateAuto")


class AravisOptions(Section):
    """The ``[devices.science.options]`` of this driver.

    Parameters
    ----------
    library
        Path of ``libaravis-0.8.so.0``; empty: ``ESCAPE_ARAVIS_LIBRARY``, then the system's loader.
    interface
        Interface to switch on first: ``"Fake"`` brings Aravis's own simulated camera.
    pixel_format
        Format with 16 bits per pixel, or ``Mono8`` for 8; its name as GenICam has it. ``Mono16`` may contain
        counts of fewer bits.
    shift
        Bits to shift counts right: for cameras that fill a 16-bit word from the top, 16 less ``bit_depth``.
    buffers
        Frames that may wait to be read.
    newest
        Skip to the newest frame when late; false: deliver every one.
    """

    library: str = ""
    interface: Literal["", "Fake"] = ""
    pixel_format: Literal["Mono16", "Mono14", "Mono12", "Mono10", "Mono8"] = "Mono16"
    shift: int = Field(0, ge=0, le=8)
    buffers: int = Field(8, ge=2, le=64)
    newest: bool = False

    @property
    def format_bits(self) -> int:
        """Bits per pixel in the name of the format."""
        return int(self.pixel_format.removeprefix("Mono"))

    def require_bit_depth(self, device: str, bit_depth: int) -> None:
        """Refuse a bit depth that is not that of the counts after the shift; raises ``ConfigError``."""
        name, bits = self.pixel_format, self.format_bits
        word = 8 if name == "Mono8" else 16
        if bit_depth > bits or (bit_depth < bits and name != "Mono16"):
            raise ConfigError(
                f"{device}: bit_depth is {bit_depth}, but pixel_format '{name}' has {bits} bits; "
                f"set bit_depth = {bits}, or choose another pixel_format"
            )
        if self.shift not in (0, word - bit_depth):
            raise ConfigError(
                f"{device}: bit_depth is {bit_depth}, but shift = {self.shift} leaves {word - self.shift} "
                f"of {word} bits; correct one of them"
            )


class AravisCamera(BlockingCamera[AravisLibrary]):
    """A GenICam camera.

    Parameters
    ----------
    serial
        Serial number.
    name
        Name in messages.
    **settings
        Fields of :class:`~escape_drivers.common.camera.CameraSetup` (``region``, ``exposure_s``,
        ``frame_rate_hz``, ``gain_db``, ``bit_depth``; the size of the sensor is read from the camera) and of
        :class:`AravisOptions`.

    Raises
    ------
    ConfigError
        The serial number is missing, a setting is unknown or wrong, or ``bit_depth`` does not belong to
        ``pixel_format`` and ``shift``.
    """

    def __init__(self, serial: str | int, *, name: str = "aravis", **settings: Any) -> None:
        setup, options = split_settings(name, serial, settings, AravisOptions)
        if "bit_depth" not in settings:
            bits = 16 - options.shift if options.shift else options.format_bits
            setup = setup.model_copy(update={"bit_depth": bits})
        options.require_bit_depth(name, setup.bit_depth)
        super().__init__(name, setup, "GenICam camera", _BLOCK_ID_RANGE)
        self._options = options
        self._incomplete = 0

    @classmethod
    def from_section(cls, section: CameraConfig, context: DeviceContext) -> Self:
        """The camera of a device section; raises ``ConfigError`` as the class does."""
        options = section_options(AravisOptions, context.name, section)
        return cls(**camera_settings(context.name, section), **options)

    @property
    def incomplete_frames(self) -> int:
        """Frames since ``start`` that arrived incomplete and were thrown away; they count as lost."""
        return self._incomplete

    def _open(self) -> None:
        library = self._connection = AravisLibrary(self.name, self._options.library)
        library.open(self._setup.serial, self._options.interface)
        model = (library.call("camera_get_model_name") or b"GenICam camera").decode(errors="replace")
        library.set_pixel_format(self._options.pixel_format)
        for feature in _AUTO_FEATURES:
            if library.first_available([feature]):
                library.call("camera_set_string", feature.encode(), b"Off")
        switch = library.first_available(_RATE_SWITCHES)
        if switch is not None:
            library.call("camera_set_boolean", switch.encode(), 1)
        width, height = library.get_ints("camera_get_sensor_size", 2)
        self._adopt_sensor((width, height), "to what the camera is")
        library.call("camera_set_region", 0, 0, width, height)
        self._limits = _read_limits(library)
        self._info = self._build_info(model, library.stand_in or self._options.interface == "Fake")
        self._is_stand_in = library.stand_in
        log.info("%s: %s, serial number %s", self.name, model, self._setup.serial)
        self._settings = self._apply_settings(self._check_setup())

    def _apply_settings(self, want: CameraSettings) -> CameraSettings:
        library, limits, region = self._require_connected(), self._require_limits(), want.region
        # Size and offsets limit each other: from the corner both can change.
        library.call("camera_set_region", 0, 0, region.width, region.height)
        library.call("camera_set_region", region.x, region.y, region.width, region.height)
        library.call("camera_set_exposure_time", want.exposure_s * 1e6)
        if limits.gain.high > limits.gain.low:
            library.call("camera_set_gain", want.gain_db)
        self._min_rate_hz, self._max_rate_hz = library.get_float_bounds("frame_rate")
        self._require_rate(want)
        library.call("camera_set_frame_rate", want.frame_rate_hz)
        return self._read_back(library, limits)

    def _read_back(self, library: AravisLibrary, limits: CameraLimits) -> CameraSettings:
        exposure_us = limits.exposure.nearest_valid(library.call("camera_get_exposure_time"))
        gain = library.call("camera_get_gain") if limits.gain.high > limits.gain.low else limits.gain.low
        region = Region(*library.get_ints("camera_get_region", 4))
        rate = float(library.call("camera_get_frame_rate"))
        return CameraSettings(region, exposure_us * 1e-6, rate, limits.gain.nearest_valid(gain))

    def _start_acquisition(self) -> None:
        self._incomplete = 0
        library = self._require_connected()
        try:
            library.start_stream(self._options.buffers)
        except DeviceError:
            library.stop_stream()
            raise

    def _stop_acquisition(self) -> None:
        library = self._require_connected()
        try:
            library.call("camera_stop_acquisition")
        finally:
            library.stop_stream()

    def _read_frame(self, wait_ms: int) -> Frame | None:
        library = self._require_connected()
        buffer = library.pop_buffer(wait_ms)
        while buffer is not None and self._options.newest:
            newer = library.pop_buffer(0)
            if newer is None:
                break
            library.push_buffer(buffer)
            buffer = newer
        if buffer is None:
            self._require_responding(library, wait_ms)
            return None
        try:
            return self._frame_from_buffer(library.read_buffer(buffer))
        finally:
            library.push_buffer(buffer)

    def _require_responding(self, library: AravisLibrary, wait_ms: int) -> None:
        """Check the connection of a camera that sends no frames; not called when no frame is expected."""
        if wait_ms == 0:
            return
        try:
            library.call("camera_get_exposure_time")
        except DeviceError as error:
            raise DeviceLost(
                self.name, f"does not answer any more ({error}); check cable and power, then open it again"
            ) from error

    def _frame_from_buffer(self, buffer_info: ReceivedBuffer) -> Frame | None:
        if buffer_info.status != _SUCCESS:
            self._incomplete += 1
            why = _STATUS_TEXT.get(buffer_info.status, f"status {buffer_info.status}")
            log.info("%s: frame %d thrown away: %s", self.name, buffer_info.frame_id, why)
            return None
        return self._make_frame(
            self._pixel_counts(buffer_info), buffer_info.frame_id, buffer_info.timestamp_ns
        )

    def _pixel_counts(self, buffer_info: ReceivedBuffer) -> NDArray[np.uint16]:
        """Counts in a buffer, as a view where possible."""
        region = self._settings.region
        kind: Any = np.uint8 if self._options.pixel_format == "Mono8" else np.uint16
        needed = region.width * region.height * np.dtype(kind).itemsize
        if (
            (buffer_info.width, buffer_info.height) != (region.width, region.height)
            or not buffer_info.address
            or buffer_info.size < needed
        ):
            raise DeviceError(
                self.name,
                f"delivered {buffer_info.width} x {buffer_info.height} pixels in {buffer_info.size} bytes "
                f"for a region of "
                f"{region.width} x {region.height} in {self._options.pixel_format}",
            )
        raw_bytes = (ctypes.c_ubyte * needed).from_address(buffer_info.address)
        counts = np.ndarray((buffer_info.height, buffer_info.width), kind, buffer=raw_bytes).astype(
            np.uint16, copy=False
        )
        return np.right_shift(counts, np.uint16(self._options.shift)) if self._options.shift else counts


#: Name of the entry point in version 0.1.0, which an environment installed then still has.
make_camera = AravisCamera


def _read_limits(library: AravisLibrary) -> CameraLimits:
    """Read the limits from the camera, whose region must be the whole sensor."""
    sides = ("width", "height", "x_offset", "y_offset")
    steps = [library.call(f"camera_get_{name}_increment") for name in sides]
    width, height = (library.get_ints(f"camera_get_{name}_bounds", 2) for name in ("width", "height"))
    try:
        gain = ParameterRange(*library.get_float_bounds("gain"), 0.0)
    except DeviceError as error:
        log.info("no gain: %s", error)
        gain = ParameterRange(0.0, 0.0, 0.0)
    return CameraLimits(
        ParameterRange(width[0], width[1], steps[0]),
        ParameterRange(height[0], height[1], steps[1]),
        steps[2],
        steps[3],
        ParameterRange(*library.get_float_bounds("exposure_time"), 0.0),
        gain,
    )
