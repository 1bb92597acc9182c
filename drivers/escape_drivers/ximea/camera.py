"""XIMEA cameras (xiQ) through the vendor's libm3api."""

from __future__ import annotations

import ctypes
import logging
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from escape_drivers.common.camera import BlockingCamera, split_settings
from escape_drivers.common.camera_limits import CameraLimits, ParameterRange
from escape_drivers.common.options import camera_settings, section_options
from escape_drivers.ximea.library import NO_IMAGE, TIMEOUT, XiImage, XimeaLibrary
from escape_hw.api.camera import CameraSettings, Frame, Region
from escape_hw.config.section import Section
from escape_hw.errors import DeviceError

if TYPE_CHECKING:
    from escape_hw.config.devices import CameraConfig
    from escape_hw.config.registry import DeviceContext

log = logging.getLogger(__name__)

_FORMATS = {"RAW16": 6, "MONO16": 1}
_BINNINGS = {"binning": 0, "skipping": 1}
_TRIGGERS = {"off": 0, "rising": 1, "falling": 2}
_UNSAFE, _GPI_TRIGGER, _GPO_EXPOSURE, _ZERO_ROT = 0, 1, 4, 0
_FREE_RUN, _FRAME_RATE = 0, 1
#: Not a frame number; remains when the library is too old to fill the field.
_NO_FRAME_NUMBER = 2**32 - 1


class XimeaOptions(Section):
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
        Skip to the newest frame when late, as a loop needs; false: queue frames.
    queue
        Frames that the library buffers.
    trigger, gpi
        Edge on that input that starts an exposure; ``"off"``: the camera keeps its own rate.
    trigger_margin
        Share of the frame that the exposure leaves free with a trigger: for readout, and for edges that
        come a little faster than ``frame_rate_hz``. A camera that is not ready misses every other one.
    exposure_output
        Whether output 1 is high while the camera exposes.
    zero_rot
        The sensor's readout without row overhead; ``""``: unchanged.
    bandwidth_mbit
        Limit of the data rate in megabits per second; 0: unchanged.
    """

    library: str = ""
    downsampling: int = Field(1, ge=1, le=16)
    downsampling_type: Literal["binning", "skipping"] = "binning"
    format: Literal["RAW16", "MONO16"] = "RAW16"
    newest: bool = True
    queue: int = Field(4, ge=2, le=1000)
    trigger: Literal["off", "rising", "falling"] = "off"
    gpi: int = Field(1, ge=1, le=16)
    trigger_margin: float = Field(0.02, ge=0, le=0.5)
    exposure_output: bool = False
    zero_rot: Literal["", "on", "off"] = ""
    bandwidth_mbit: int = Field(0, ge=0, le=100_000)

    def sdk_parameters(self, bit_depth: int) -> list[tuple[str, int]]:
        """Parameters to set after opening, in order; none of them can change while acquiring."""
        parameters_to_set = [
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
            parameters_to_set.append(("sensor_feature_selector", _ZERO_ROT))
            parameters_to_set.append(("sensor_feature_value", int(self.zero_rot == "on")))
        if self.bandwidth_mbit:
            parameters_to_set.append(("limit_bandwidth", self.bandwidth_mbit))
        if self.exposure_output:
            parameters_to_set += [("gpo_selector", 1), ("gpo_mode", _GPO_EXPOSURE)]
        if self.trigger != "off":
            parameters_to_set += [
                ("gpi_selector", self.gpi),
                ("gpi_mode", _GPI_TRIGGER),
                ("trigger_selector", 0),
            ]
        parameters_to_set.append(("trigger_source", _TRIGGERS[self.trigger]))
        parameters_to_set.append(("acq_timing_mode", _FRAME_RATE if self.trigger == "off" else _FREE_RUN))
        return parameters_to_set


class XimeaCamera(BlockingCamera[XimeaLibrary]):
    """A XIMEA camera.

    Frames are copied out of the library's ring at once, so that nothing overwrites them. Losses show as
    gaps of the camera's own counter. With a trigger the frame rate is that of the edges, and the one
    configured is only stated.

    Parameters
    ----------
    serial
        Serial number.
    name
        Name in messages.
    **settings
        Fields of :class:`~escape_drivers.common.camera.CameraSetup` (``region``, ``exposure_s``,
        ``frame_rate_hz``, ``gain_db``, ``bit_depth``; the size of the sensor is read from the camera) and of
        :class:`XimeaOptions`.

    Raises
    ------
    ConfigError
        The serial number is missing, or a setting is unknown or wrong.
    """

    def __init__(self, serial: str | int, *, name: str = "ximea", **settings: Any) -> None:
        setup, options = split_settings(name, serial, settings, XimeaOptions)
        super().__init__(name, setup, "XIMEA camera", (0, _NO_FRAME_NUMBER))
        self._options = options
        self._image = XiImage(size=ctypes.sizeof(XiImage))
        self._address = ctypes.c_void_p(ctypes.addressof(self._image))
        self._get_image: Callable[..., int] = _raise_not_connected
        self._frame_views: dict[int, NDArray[np.uint16]] = {}
        self._expected_shape = (0, 0)

    @classmethod
    def from_section(cls, section: CameraConfig, context: DeviceContext) -> Self:
        """The camera of a device section; raises ``ConfigError`` as the class does."""
        options = section_options(XimeaOptions, context.name, section)
        return cls(**camera_settings(context.name, section), **options)

    @property
    def handle(self) -> ctypes.c_void_p:
        """The library's handle, for calls that this driver does not make; raises ``NotOpen`` when closed."""
        handle = self._require_connected().handle
        assert handle is not None
        return handle

    def temperature_c(self) -> float:
        """Temperature of the sensor's chip in degrees Celsius, if it reports it."""
        self.require_open()
        with self._read_lock:
            return self._require_connected().get_float("chip_temp")

    def _open(self) -> None:
        library = self._connection = XimeaLibrary(self.name, self._options.library)
        library.open(self._setup.serial)
        for name, value in self._options.sdk_parameters(self._setup.bit_depth):
            library.set(name, value)
        _reset_offset(library)
        limits = self._limits = _read_limits(library)
        sensor = (round(limits.width.high), round(limits.height.high))
        self._adopt_sensor(sensor, "or the option 'downsampling'")
        model, serial, version = (
            library.get_text(key) for key in ("device_name", "device_sn", "api_version")
        )
        log.info("%s: %s %s, xiAPI %s", self.name, model, serial, version)
        self._info = self._build_info(f"XIMEA {model}", library.stand_in)
        self._is_stand_in = library.stand_in
        self._get_image = library.c.xiGetImage
        self._settings = self._apply_settings(self._check_setup())

    def _disconnect(self) -> None:
        self._get_image = _raise_not_connected
        self._frame_views.clear()
        self._attempt(super()._disconnect)

    def _max_exposure_s(self, want: CameraSettings) -> float:
        """Longest exposure; with a trigger, one that leaves the camera ready for the next edge."""
        margin = 0.0 if self._options.trigger == "off" else self._options.trigger_margin
        return super()._max_exposure_s(want) * (1 - margin)

    def _apply_settings(self, want: CameraSettings) -> CameraSettings:
        library, region = self._require_connected(), want.region
        _reset_offset(library)
        library.set("width", region.width)
        library.set("height", region.height)
        library.set("offsetX", region.x)
        library.set("offsetY", region.y)
        library.set("exposure", float(want.exposure_s * 1e6))
        library.set("gain", float(want.gain_db))
        rate = want.frame_rate_hz
        if self._options.trigger == "off":
            self._min_rate_hz, self._max_rate_hz = (
                library.get_float(f"framerate:{end}") for end in ("min", "max")
            )
            self._require_rate(want)
            library.set("framerate", float(rate))
            rate = library.get_float("framerate")
        return self._read_back(library, rate)

    def _read_back(self, library: XimeaLibrary, rate_hz: float) -> CameraSettings:
        limits = self._require_limits()
        region = Region(*(library.get_int(name) for name in ("offsetX", "offsetY", "width", "height")))
        exposure_us = limits.exposure.nearest_valid(library.get_float("exposure"))
        return CameraSettings(
            region, exposure_us * 1e-6, rate_hz, limits.gain.nearest_valid(library.get_float("gain"))
        )

    def _start_acquisition(self) -> None:
        region = self._settings.region
        self._expected_shape = (region.width, region.height)
        self._frame_views.clear()
        ctypes.memset(self._address, 0, ctypes.sizeof(XiImage))
        self._image.size = ctypes.sizeof(XiImage)
        self._image.acq_nframe = _NO_FRAME_NUMBER
        self._require_connected().start()

    def _stop_acquisition(self) -> None:
        self._require_connected().stop()

    def _timeout_hint(self) -> str:
        where = "cable" if self._options.trigger == "off" else "the trigger and its cable"
        return f"{where}, the exposure ({self._settings.exposure_s:g} s)"

    def _read_frame(self, wait_ms: int) -> Frame | None:
        library = self._require_connected()
        code = self._get_image(library.handle, wait_ms, self._address)
        if code in (TIMEOUT, NO_IMAGE):
            return None
        if code != 0:
            raise library.error_for("xiGetImage", code)
        image = self._image
        view = self._frame_views.get(image.bp or 0)
        if view is None:
            view = self._frame_view(image)
        number = image.acq_nframe
        if number == _NO_FRAME_NUMBER:
            number = image.nframe
        return self._make_frame(view, number, image.tsSec * 1_000_000_000 + image.tsUSec * 1000)

    def _frame_view(self, image: XiImage) -> NDArray[np.uint16]:
        """A view of one of the library's buffers, checked and created once; rows may be padded."""
        width, height = self._expected_shape
        pitch = 2 * width + image.padding_x
        # A library that fills no size (it may not in every policy) leaves 0.
        too_short = 0 < image.bp_size < pitch * height
        if not image.bp or (image.width, image.height) != (width, height) or too_short:
            raise DeviceError(
                self.name,
                f"delivered {image.width} x {image.height} pixels in {image.bp_size} bytes for a region of "
                f"{width} x {height}; does this driver support the library's version "
                "(4.x, XI_IMG of 288 bytes)?",
            )
        bytes_ = (ctypes.c_ubyte * (pitch * height)).from_address(image.bp)
        view: NDArray[np.uint16] = np.ndarray((height, width), np.uint16, buffer=bytes_, strides=(pitch, 2))
        self._frame_views[image.bp] = view
        return view


#: Name of the entry point in version 0.1.0, which an environment installed then still has.
make_camera = XimeaCamera


def _reset_offset(library: XimeaLibrary) -> None:
    """Move the region to the sensor's corner, so that its size can change freely."""
    library.set("offsetX", 0)
    library.set("offsetY", 0)


def _read_limits(library: XimeaLibrary) -> CameraLimits:
    """Read the limits from the camera; its region must begin at the sensor's corner, which affects them."""
    width, height = (
        ParameterRange(*(library.get_int(f"{name}:{part}") for part in ("min", "max", "inc")))
        for name in ("width", "height")
    )
    exposure, gain = (
        # Single-precision increments as the decimal numbers that were meant: 0.1, not 0.10000000149.
        ParameterRange(
            *(float(f"{library.get_float(f'{name}:{part}'):.7g}") for part in ("min", "max", "inc"))
        )
        for name in ("exposure", "gain")
    )
    return CameraLimits(
        width, height, library.get_int("offsetX:inc"), library.get_int("offsetY:inc"), exposure, gain
    )


def _raise_not_connected(*arguments: Any) -> int:
    """Take the place of ``xiGetImage`` while there is none."""
    raise RuntimeError("a frame was requested from a camera that is not connected")
