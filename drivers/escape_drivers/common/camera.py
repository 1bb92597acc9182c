"""Base class of cameras read through a blocking library call, with frame counter and camera clock."""

from __future__ import annotations

import abc
import logging
import math
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import astuple
from typing import Any, Generic, Protocol, Self, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import model_validator

from escape_drivers.common.camera_limits import TOLERANCE, CameraLimits
from escape_drivers.common.options import require_serial
from escape_hw.api.camera import Camera, CameraInfo, CameraSettings, Frame, Region
from escape_hw.config.devices import (
    BitDepth,
    ExposureTime,
    FrameRate,
    Gain,
    RegionNumbers,
    SensorSize,
    exposure_violations,
)
from escape_hw.config.options import parse_options
from escape_hw.config.section import Section, raise_violations
from escape_hw.errors import DeviceError, DeviceLost, FrameTimeout, NotOpen, SettingRejected


class FrameCounter:
    """Makes a rising index of a device's counter that starts over.

    Parameters
    ----------
    first, last
        After ``last`` comes ``first`` again (a 32-bit counter: 0 and 2**32 - 1; GigE Vision's short block
        identifiers: 1 and 65535). A device whose numbers exceed ``last`` does not wrap.
    """

    def __init__(self, first: int, last: int) -> None:
        self._last, self._period = last, last - first + 1
        self._last_number = 0
        self._wraps = 0

    def index(self, number: int) -> int:
        """The index of a number; one that fell by less than half a turn has not started over, and falls."""
        newest, self._last_number = self._last_number, number
        if newest - number > self._period // 2 and newest <= self._last:
            self._wraps += 1
        return number + self._wraps * self._period


class CameraClock:
    """Puts a camera's own time stamps on this computer's monotonic clock.

    The offset is that of the frame with the shortest recent delay: it grows by 100 ppm of the time, more
    than two quartz clocks differ, and no exposure time is later than the arrival. The spacing is that of
    the camera's exposure times to the same accuracy.
    """

    _GROWTH_PPM = 100

    def __init__(self) -> None:
        self._offset: int | None = None
        self._arrived_ns = 0

    def exposed_ns(self, stamp_ns: int, arrived_ns: int) -> int:
        """When a frame was exposed, from the camera's time stamp (0: it gives none) and the arrival."""
        if stamp_ns == 0:
            return arrived_ns
        offset = arrived_ns - stamp_ns
        if self._offset is not None:
            offset = min(offset, self._offset + (arrived_ns - self._arrived_ns) * self._GROWTH_PPM // 10**6)
        self._offset, self._arrived_ns = offset, arrived_ns
        return stamp_ns + offset


log = logging.getLogger(__name__)

#: Maximum wait inside a library call; ``stop`` and ``close`` wait no longer than this.
MAX_WAIT_MS = 50


class CameraConnection(Protocol):
    """A vendor's library with one camera, or a stream."""

    def close(self) -> None:
        """Disconnect."""


C = TypeVar("C", bound=CameraConnection)
OptionsT = TypeVar("OptionsT", bound=Section)
#: Size of a sensor that the camera itself will tell.
UNKNOWN_SENSOR = (0, 0)


class CameraSetup(Section):
    """What a camera is to be set to when it opens; defaults for one that is opened without a system file.

    Ranges and rules are those of a camera's section in a system file.

    Parameters
    ----------
    serial
        Serial number.
    sensor_px
        Width and height of the sensor as read out, pixels; by default as the camera reports.
    region
        x, y, width, height, pixels; ``None``: the whole sensor.
    bit_depth
        Bits per pixel.
    exposure_s, frame_rate_hz, gain_db
        See :class:`~escape_hw.api.camera.CameraSettings`.
    """

    serial: str
    sensor_px: SensorSize = UNKNOWN_SENSOR
    region: RegionNumbers | None = None
    bit_depth: BitDepth = 10
    exposure_s: ExposureTime = 1e-3
    frame_rate_hz: FrameRate = 10.0
    gain_db: Gain = 0.0

    @model_validator(mode="after")
    def _rules(self) -> Self:
        raise_violations(exposure_violations(self.exposure_s, self.frame_rate_hz))
        return self

    def settings(self, sensor_px: tuple[int, int]) -> CameraSettings:
        """The settings for a sensor of this width and height."""
        region = Region(0, 0, *sensor_px) if self.region is None else Region(*self.region)
        return CameraSettings(region, self.exposure_s, self.frame_rate_hz, self.gain_db)


def split_settings(
    name: str, serial: str | int, settings: Mapping[str, Any], options: type[OptionsT]
) -> tuple[CameraSetup, OptionsT]:
    """Keywords of a camera's class as its setup and the options of its driver.

    Raises
    ------
    ConfigError
        A setting or an option is unknown or wrong, or the serial number is missing.
    """
    keys = CameraSetup.model_fields.keys()
    given = {key: value for key, value in settings.items() if key in keys}
    setup = parse_options(CameraSetup, name, {**given, "serial": require_serial("serial", serial)})
    rest = {key: value for key, value in settings.items() if key not in keys}
    return setup, parse_options(options, name, rest, ["name", *keys])


class BlockingCamera(Camera, Generic[C]):
    """A camera read through a blocking call, which is made in short slices.

    Drivers fill in ``_start_acquisition``, ``_stop_acquisition`` and ``_read_frame`` in place of ``_start``,
    ``_stop`` and ``_next_frame``; they exclude each other. ``_open`` sets ``_connection``.

    Parameters
    ----------
    setup
        What the camera is to be set to when it opens.
    kind
        Name of the camera until it reports its model.
    counter
        First and last number of its frame counter.
    """

    def __init__(self, name: str, setup: CameraSetup, kind: str, counter: tuple[int, int]) -> None:
        super().__init__(name)
        self._setup = setup
        self._sensor_px = setup.sensor_px
        self._settings = setup.settings(self._sensor_px)
        self._info, self._is_stand_in = self._build_info(kind, stand_in=False), False
        self._full_scale = np.uint16(self._info.full_scale)
        self._saturation_mask = np.empty((0, 0), np.bool_)
        self._connection: C | None = None
        self._limits: CameraLimits | None = None
        self._min_rate_hz, self._max_rate_hz = 0.0, math.inf
        self._read_lock = threading.Lock()
        self._stop_requested, self._acquiring = True, False
        self._counter_range = counter
        self._counter, self._clock = FrameCounter(*counter), CameraClock()

    @property
    def info(self) -> CameraInfo:
        """Identity and fixed properties."""
        return self._info

    @property
    def settings(self) -> CameraSettings:
        """The settings in force, as read back from the camera; before ``open`` those requested."""
        return self._settings

    @abc.abstractmethod
    def _apply_settings(self, want: CameraSettings) -> CameraSettings:
        """Set the camera as ``_check`` found possible; read back what it made of it.

        It calls ``_require_rate`` on the way. Limits of a camera depend on the order of setting them.
        """

    @abc.abstractmethod
    def _start_acquisition(self) -> None:
        """Start acquisition."""

    @abc.abstractmethod
    def _stop_acquisition(self) -> None:
        """Stop acquisition of a camera that acquires."""

    @abc.abstractmethod
    def _read_frame(self, wait_ms: int) -> Frame | None:
        """A frame, or ``None`` when there is none after so many milliseconds (0: at once)."""

    def _disconnect(self) -> None:
        """Give the camera back, if it is connected."""
        connection, self._connection = self._connection, None
        if connection is not None:
            connection.close()

    def _require_connected(self) -> C:
        if self._connection is None:
            raise NotOpen(self.name, "is not connected; call open() first")
        return self._connection

    @property
    def applies_twin_section(self) -> bool:
        """True with the stand-in of a vendor library, behind which is the simulated bench."""
        return self._is_stand_in

    def _build_info(self, model: str, stand_in: bool) -> CameraInfo:
        setup = self._setup
        named = f"{model} (stand-in)" if stand_in else model
        return CameraInfo(named, setup.serial, self._sensor_px[::-1], setup.bit_depth, simulated=stand_in)

    def _adopt_sensor(self, found: tuple[int, int], alternative: str) -> None:
        """Adopt the sensor size (width, height) that the camera reports; refuse one other than requested."""
        stated = self._setup.sensor_px
        self._sensor_px = found
        if stated != UNKNOWN_SENSOR and found != stated:
            raise DeviceError(
                self.name,
                f"is read out as {found[0]} x {found[1]} pixels, but sensor_px is {stated[0]} x "
                f"{stated[1]}; correct sensor_px {alternative}",
            )

    def _max_exposure_s(self, want: CameraSettings) -> float:
        """Longest exposure that fits into a frame."""
        return 1 / want.frame_rate_hz

    def _require_limits(self) -> CameraLimits:
        if self._limits is None:
            raise NotOpen(self.name, "is not connected; call open() first")
        return self._limits

    def _check_setup(self) -> CameraSettings:
        """Nearest achievable settings to open with, on the sensor that was adopted.

        Warns of a region that is not on the camera's increments.

        Raises
        ------
        SettingRejected
            As :meth:`check`, whose rules need no open camera.
        """
        want = self._setup.settings(self._sensor_px)
        self._require_valid(want)
        answer = self._check(want)
        if answer.region != want.region:
            limits = self._require_limits()
            log.warning(
                "%s: the region %s is not in the camera's steps (size %d x %d, offsets %d and %d); "
                "it reads %s",
                self.name,
                list(astuple(want.region)),
                *(limits.width.step, limits.height.step, limits.x_step, limits.y_step),
                list(astuple(answer.region)),
            )
        return answer

    def _check(self, want: CameraSettings) -> CameraSettings:
        answer = self._require_limits().nearest_valid(self.name, want, self._max_exposure_s(want))
        now = self._settings
        # The camera reports rates for its present region and exposure; others are found by trying.
        if answer.region == now.region and answer.exposure_s >= now.exposure_s:
            self._require_rate(answer)
        return answer

    def _require_rate(self, want: CameraSettings) -> None:
        """Refuse a rate outside the camera's present limits."""
        slowest, fastest = self._min_rate_hz, self._max_rate_hz
        if want.frame_rate_hz > fastest * (1 + TOLERANCE):
            raise SettingRejected(
                self.name,
                f"frame_rate_hz is {want.frame_rate_hz:g}; {want.region.height} rows and an exposure of "
                f"{want.exposure_s:g} s allow at most {fastest:.1f}",
            )
        if want.frame_rate_hz < slowest * (1 - TOLERANCE):
            raise SettingRejected(
                self.name,
                f"frame_rate_hz is {want.frame_rate_hz:g}; the camera's minimum is {slowest:g}",
            )

    def _configure(self, settings: CameraSettings) -> None:
        if self._acquiring:
            raise DeviceError(
                self.name, "could not be stopped, and keeps its settings; close and open it again"
            )
        before = self._settings
        try:
            self._settings = self._apply_settings(settings)
        except DeviceLost:
            raise
        except DeviceError as error:
            self._clean_up(lambda: setattr(self, "_settings", self._apply_settings(before)), error)
            raise

    def _timeout_hint(self) -> str:
        """What to check when no frame comes."""
        return f"cable, the exposure ({self.settings.exposure_s:g} s)"

    def _start(self) -> None:
        with self._read_lock:
            if self._acquiring:
                return
            self._counter, self._clock = FrameCounter(*self._counter_range), CameraClock()
            self._start_acquisition()
            self._stop_requested, self._acquiring = False, True

    def _stop(self) -> None:
        self._stop_requested = True
        with self._read_lock:
            self._stop_if_acquiring()

    def _close(self) -> None:
        self._stop_requested = True
        with self._read_lock:
            # A reader that came in after stop() may have started it again.
            self._stop_if_acquiring()
            self._acquiring = False
            self._disconnect()
            self._limits = None
            self._min_rate_hz, self._max_rate_hz = 0.0, math.inf

    def _release_after_failed_open(self) -> None:
        self._close()

    def _stop_if_acquiring(self) -> None:
        if self._acquiring:
            self._acquiring = not self._attempt(self._stop_acquisition)

    def _attempt(self, step: Callable[[], None]) -> bool:
        """Run a step of stopping or closing; returns false if it failed, as with a disconnected camera."""
        try:
            step()
        except DeviceError as error:
            log.warning("while stopping or closing: %s", error)
            return False
        return True

    def _next_frame(self, timeout_s: float) -> Frame:
        deadline = time.monotonic() + timeout_s
        left_s = timeout_s
        while left_s > 0:
            frame = self._read_frame_locked(min(MAX_WAIT_MS, math.ceil(left_s * 1e3)))
            if frame is not None:
                return frame
            left_s = deadline - time.monotonic()
        raise FrameTimeout(
            self.name,
            f"no frame within {timeout_s:g} s; check {self._timeout_hint()}, or allow a longer timeout",
        )

    def _poll(self) -> Frame | None:
        return self._read_frame_locked(0)

    def _read_frame_locked(self, wait_ms: int) -> Frame | None:
        with self._read_lock:
            if self._stop_requested:
                raise NotOpen(self.name, "was stopped or closed while a frame was awaited")
            return self._read_frame(wait_ms)

    def _make_frame(self, view: NDArray[np.uint16], number: int, stamp_ns: int) -> Frame:
        """Copy a frame out of the library's buffer, which is overwritten as soon as the lock goes."""
        arrived_ns = time.monotonic_ns()
        data = view.copy()
        data.flags.writeable = False
        # Frames with no saturated pixel are the rule, and the maximum is quicker than counting.
        saturated = self._count_saturated(data) if data.max() >= self._full_scale else 0
        exposed_ns = self._clock.exposed_ns(stamp_ns, arrived_ns)
        return Frame(data, self._counter.index(number), exposed_ns, arrived_ns, saturated)

    def _count_saturated(self, data: NDArray[np.uint16]) -> int:
        """Number of pixels at the top of the scale, or beyond it."""
        if self._saturation_mask.shape != data.shape:
            self._saturation_mask = np.empty(data.shape, np.bool_)
        return int(np.count_nonzero(np.greater_equal(data, self._full_scale, out=self._saturation_mask)))
