"""XIMEA cameras (xiQ) through the vendor's libm3api."""

from __future__ import annotations

import ctypes
import logging
import math
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from escape_drivers.frame_counter import CameraClock, FrameCounter
from escape_drivers.options import read_options, require_serial
from escape_drivers.ximea_errors import NO_IMAGE, STOPPED, TIMEOUT
from escape_drivers.ximea_library import XiImage, XimeaLibrary
from escape_drivers.ximea_limits import ROUNDING, XimeaLimits, rate_refused
from escape_hw.api.camera import Camera
from escape_hw.api.frames import CameraInfo, CameraSettings, Frame, Region
from escape_hw.errors import DeviceError, DeviceLost, FrameTimeout, NotOpen, SettingRejected

if TYPE_CHECKING:
    from escape_hw.config.device_models import CameraConfig
    from escape_hw.config.models import SystemConfig

log = logging.getLogger(__name__)

#: Longest wait inside the library; ``stop`` and ``close`` come through this soon, whatever the time-out.
_SLICE_MS = 50
_FORMATS = {"RAW16": 6, "MONO16": 1}
_BINNINGS = {"binning": 0, "skipping": 1}
_TRIGGERS = {"off": 0, "rising": 1, "falling": 2}
_UNSAFE, _GPI_TRIGGER, _GPO_EXPOSURE, _ZERO_ROT = 0, 1, 4, 0
_FREE_RUN, _FRAME_RATE = 0, 1
#: Never a frame number; stays where the library is too old to fill the field.
_UNFILLED = 2**32 - 1


@dataclass(frozen=True, slots=True)
class XimeaOptions:
    """The ``[devices.wfs.options]`` of this driver.

    Parameters
    ----------
    library
        Path of ``libm3api.so.2``; empty: ``ESCAPE_XIMEA_LIBRARY``, then the system's loader.
    downsampling, downsampling_type
        Sensor pixels per pixel in each direction, and what becomes of the others.
    format
        Both carry more than 8 bits right-aligned in 16.
    newest
        Skip to the newest frame when late, as a loop wants; false: queue them.
    queue
        Frames that the library buffers.
    trigger, gpi
        Edge on that input that starts an exposure; ``"off"``: the camera keeps its own rate.
    exposure_output
        Whether output 1 is high while the camera exposes.
    zero_rot
        The sensor's readout without row overhead; ``""`` leaves it as it is.
    bandwidth_mbit
        Limit of the data rate in megabits per second; 0 leaves it as it is.
    """

    library: str = ""
    downsampling: int = 1
    downsampling_type: Literal["binning", "skipping"] = "binning"
    format: Literal["RAW16", "MONO16"] = "RAW16"
    newest: bool = True
    queue: int = 4
    trigger: Literal["off", "rising", "falling"] = "off"
    gpi: int = 1
    exposure_output: bool = False
    zero_rot: Literal["", "on", "off"] = ""
    bandwidth_mbit: int = 0

    def parameters(self, bit_depth: int) -> list[tuple[str, int]]:
        """Parameters to set after opening, in order; none of them can change while acquiring."""
        wanted = [
            ("aeag", 0),
            ("imgdataformat", _FORMATS[self.format]),
            *((f"{part}_bit_depth", bit_depth) for part in ("sensor", "output", "image_data")),
            ("downsampling_type", _BINNINGS[self.downsampling_type]),
            ("downsampling", self.downsampling),
            ("buffer_policy", _UNSAFE),
            ("buffers_queue_size", self.queue),
            ("recent_frame", int(self.newest)),
        ]
        if self.zero_rot:
            wanted += [
                ("sensor_feature_selector", _ZERO_ROT),
                ("sensor_feature_value", int(self.zero_rot == "on")),
            ]
        if self.bandwidth_mbit:
            wanted.append(("limit_bandwidth", self.bandwidth_mbit))
        if self.exposure_output:
            wanted += [("gpo_selector", 1), ("gpo_mode", _GPO_EXPOSURE)]
        if self.trigger != "off":
            wanted += [("gpi_selector", self.gpi), ("gpi_mode", _GPI_TRIGGER), ("trigger_selector", 0)]
        wanted.append(("trigger_source", _TRIGGERS[self.trigger]))
        wanted.append(("acq_timing_mode", _FRAME_RATE if self.trigger == "off" else _FREE_RUN))
        return wanted


def make_camera(name: str, config: SystemConfig, shared: dict[str, object]) -> XimeaCamera:
    """Entry point ``ximea``.

    Raises
    ------
    ConfigError
        No such device section, no serial number, or an option that this driver does not know.
    """
    section = config.devices.science if name == "science" else config.devices.wfs
    if section is None:
        section = config.devices.wfs
    require_serial(name, section)
    return XimeaCamera(name, section, read_options(XimeaOptions, name, section))


class XimeaCamera(Camera):
    """A XIMEA camera.

    Frames are copied out of the library's ring at once, so that nothing overwrites them. Losses show as
    gaps of the camera's own counter. With a trigger the frame rate is that of the edges, and the one
    configured is only stated.

    Parameters
    ----------
    name
        Key in ``[devices]``.
    section
        Serial number, sensor, region, exposure and rate to begin with.
    options
        Of this driver.
    """

    def __init__(self, name: str, section: CameraConfig, options: XimeaOptions) -> None:
        super().__init__(name)
        self._section, self._options = section, options
        self._settings = section.settings()
        self._info = CameraInfo(
            "XIMEA camera", section.serial, section.sensor_px[::-1], section.bit_depth, False
        )
        self._full_scale = self._info.full_scale
        self._library: XimeaLibrary | None = None
        self._limits: XimeaLimits | None = None
        self._fastest_hz = math.inf
        #: Held while the library waits for an image, so that nobody stops or closes it meanwhile.
        self._waiting = threading.Lock()
        self._halted, self._acquiring = True, False
        self._image = XiImage(size=ctypes.sizeof(XiImage))
        self._address = ctypes.c_void_p(ctypes.addressof(self._image))
        self._get_image: Callable[..., int] = _not_connected
        self._views: dict[int, NDArray[np.uint16]] = {}
        self._expected = (0, 0)
        self._counter, self._clock = FrameCounter(0, _UNFILLED), CameraClock()

    @property
    def info(self) -> CameraInfo:
        """Identity and fixed properties."""
        return self._info

    @property
    def settings(self) -> CameraSettings:
        """The settings in force, as read back from the camera."""
        return self._settings

    def temperature_c(self) -> float:
        """Temperature of the sensor's chip in degrees Celsius.

        Raises
        ------
        NotOpen, DeviceError
            The camera is not connected, or does not tell.
        """
        self.require_open()
        with self._waiting:
            return self._connected().real("chip_temp")

    def _open(self) -> None:
        library = self._library = XimeaLibrary(self.name, self._options.library)
        library.open(self._section.serial.strip())
        for name, value in self._options.parameters(self._section.bit_depth):
            library.set(name, value)
        _to_corner(library)
        limits = self._limits = XimeaLimits.read(library)
        sensor = (round(limits.width.high), round(limits.height.high))
        if sensor != self._section.sensor_px:
            raise DeviceError(
                self.name,
                f"is read out as {sensor[0]} x {sensor[1]} pixels, but sensor_px says {self._section.sensor_px[0]} "
                f"x {self._section.sensor_px[1]}; correct sensor_px or the option 'downsampling'",
            )
        model = library.text("device_name")
        log.info(
            "%s: %s %s, xiAPI %s", self.name, model, library.text("device_sn"), library.text("api_version")
        )
        self._info = CameraInfo(
            f"XIMEA {model} (stand-in)" if library.stand_in else f"XIMEA {model}",
            self._section.serial,
            sensor[::-1],
            self._section.bit_depth,
            simulated=library.stand_in,
        )
        self._get_image = library.c.xiGetImage
        self._settings = self._applied(self._check(self._section.settings()))

    def _close(self) -> None:
        self._halted = True
        with self._waiting:
            library, self._library, self._limits = self._library, None, None
            self._get_image = _not_connected
            self._views.clear()
            if library is None or library.handle is None:
                return
            # A reader that came in between may have started it again.
            self._stop_acquisition(library)
            try:
                library.close()
            except DeviceError as error:
                # It may have gone already.
                log.warning("while closing: %s", error)

    def _abandon(self) -> None:
        self._close()

    def _check(self, want: CameraSettings) -> CameraSettings:
        limits = self._limits
        if limits is None:
            raise NotOpen(self.name, "is not connected; call open() first")
        region = limits.region(want.region)
        gain = limits.gain_db(self.name, want.gain_db)
        longest = 1 / want.frame_rate_hz if self._options.trigger == "off" else math.inf
        answer = CameraSettings(region, limits.exposure_s(want.exposure_s, longest), want.frame_rate_hz, gain)
        now = self._settings
        as_fast = region == now.region and answer.exposure_s >= now.exposure_s
        if as_fast and want.frame_rate_hz > self._fastest_hz * (1 + ROUNDING):
            raise rate_refused(self.name, answer, self._fastest_hz)
        return answer

    def _configure(self, settings: CameraSettings) -> None:
        before = self._settings
        try:
            self._settings = self._applied(settings)
        except DeviceLost:
            raise
        except DeviceError as error:
            self._tidy(lambda: self._put_back(before), error)
            raise

    def _put_back(self, before: CameraSettings) -> None:
        self._settings = self._applied(before)

    def _applied(self, want: CameraSettings) -> CameraSettings:
        """Set the camera and read back what it made of it; its limits depend on the order."""
        library, region = self._connected(), want.region
        _to_corner(library)
        library.set("width", region.width)
        library.set("height", region.height)
        library.set("offsetX", region.x)
        library.set("offsetY", region.y)
        library.set("exposure", float(want.exposure_s * 1e6))
        library.set("gain", float(want.gain_db))
        rate = want.frame_rate_hz
        if self._options.trigger == "off":
            self._fastest_hz = library.real("framerate:max")
            if rate > self._fastest_hz * (1 + ROUNDING):
                raise rate_refused(self.name, want, self._fastest_hz)
            slowest = library.real("framerate:min")
            if rate < slowest * (1 - ROUNDING):
                raise SettingRejected(
                    self.name, f"frame_rate_hz is {rate:g}; the camera goes no slower than {slowest:g}"
                )
            library.set("framerate", float(rate))
            rate = library.real("framerate")
        return self._read_back(library, rate)

    def _read_back(self, library: XimeaLibrary, rate_hz: float) -> CameraSettings:
        limits = self._limits
        assert limits is not None
        region = Region(*(library.whole(name) for name in ("offsetX", "offsetY", "width", "height")))
        exposure_us = limits.exposure.nearest(library.real("exposure"))
        return CameraSettings(region, exposure_us * 1e-6, rate_hz, limits.gain.nearest(library.real("gain")))

    def _start(self) -> None:
        with self._waiting:
            if self._acquiring:
                return
            region = self._settings.region
            self._expected = (region.width, region.height)
            self._counter, self._clock = FrameCounter(0, _UNFILLED), CameraClock()
            self._views.clear()
            ctypes.memset(self._address, 0, ctypes.sizeof(XiImage))
            self._image.size = ctypes.sizeof(XiImage)
            self._image.acq_nframe = _UNFILLED
            self._connected().start()
            self._halted, self._acquiring = False, True

    def _stop(self) -> None:
        self._halted = True
        with self._waiting:
            if self._library is not None:
                self._stop_acquisition(self._library)

    def _stop_acquisition(self, library: XimeaLibrary) -> None:
        if not self._acquiring:
            return
        self._acquiring = False
        code = library.c.xiStopAcquisition(library.handle)
        if code not in (0, STOPPED):
            # Whatever the camera says, it is not read any more, and close() still works.
            log.warning("while stopping: %s", library.failure("xiStopAcquisition", code))

    def _next_frame(self, timeout_s: float) -> Frame:
        deadline = time.monotonic() + timeout_s
        slice_ms = min(_SLICE_MS, math.ceil(timeout_s * 1e3))
        while True:
            frame = self._take(slice_ms)
            if frame is not None:
                return frame
            left_s = deadline - time.monotonic()
            if left_s <= 0:
                break
            slice_ms = min(_SLICE_MS, math.ceil(left_s * 1e3))
        triggered = self._options.trigger != "off"
        raise FrameTimeout(
            self.name,
            f"no frame within {timeout_s:g} s; check {'the trigger and its cable' if triggered else 'cable'}, "
            f"the exposure ({self._settings.exposure_s:g} s), or allow a longer timeout",
        )

    def _poll(self) -> Frame | None:
        return self._take(0)

    def _take(self, wait_ms: int) -> Frame | None:
        """A frame, or ``None`` when there is none after so many milliseconds."""
        with self._waiting:
            if self._halted:
                raise NotOpen(self.name, "was stopped or closed while a frame was awaited")
            library = self._connected()
            code = self._get_image(library.handle, wait_ms, self._address)
            if code == 0:
                # Copied before the lock goes: the next call may overwrite the library's buffer.
                return self._copied(time.monotonic_ns())
        if code in (TIMEOUT, NO_IMAGE):
            return None
        raise library.failure("xiGetImage", code)

    def _copied(self, arrived_ns: int) -> Frame:
        image = self._image
        view = self._views.get(image.bp or 0)
        if view is None:
            view = self._view(image)
        data = view.copy()
        data.flags.writeable = False
        top = self._full_scale
        # Frames with no saturated pixel are the rule, and the maximum is quicker than counting.
        saturated = int(np.count_nonzero(data >= top)) if data.max() >= top else 0
        number = image.acq_nframe
        if number == _UNFILLED:
            number = image.nframe
        stamp_ns = image.tsSec * 1_000_000_000 + image.tsUSec * 1000
        exposed_ns = self._clock.exposed_ns(stamp_ns, arrived_ns)
        return Frame(data, self._counter.index(number), exposed_ns, arrived_ns, saturated)

    def _view(self, image: XiImage) -> NDArray[np.uint16]:
        """A look at one of the library's buffers, checked and made once; rows may be padded."""
        width, height = self._expected
        if not image.bp or (image.width, image.height) != (width, height):
            raise DeviceError(
                self.name,
                f"delivered {image.width} x {image.height} pixels for a region of {width} x {height}; "
                "is the library's version the one this driver knows (4.x, XI_IMG of 288 bytes)?",
            )
        pitch = 2 * width + image.padding_x
        bytes_ = (ctypes.c_ubyte * (pitch * height)).from_address(image.bp)
        view: NDArray[np.uint16] = np.ndarray((height, width), np.uint16, buffer=bytes_, strides=(pitch, 2))
        self._views[image.bp] = view
        return view

    def _connected(self) -> XimeaLibrary:
        if self._library is None:
            raise NotOpen(self.name, "is not connected; call open() first")
        return self._library


def _to_corner(library: XimeaLibrary) -> None:
    """Move the region to the sensor's corner, so that its size can change freely."""
    library.set("offsetX", 0)
    library.set("offsetY", 0)


def _not_connected(*arguments: Any) -> int:
    """Take the place of ``xiGetImage`` while there is none."""
    raise RuntimeError("a frame was asked of a camera that is not connected")
