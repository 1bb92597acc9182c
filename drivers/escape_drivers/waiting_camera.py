"""Cameras whose library blocks while a frame is awaited: nobody stops or closes them under a waiting call."""

from __future__ import annotations

import abc
import logging
import math
import threading
import time
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from escape_drivers.camera_limits import ROUNDING, CameraLimits
from escape_drivers.frame_counter import CameraClock, FrameCounter
from escape_hw.api.camera import Camera
from escape_hw.api.frames import CameraInfo, CameraSettings, Frame
from escape_hw.errors import DeviceError, DeviceLost, FrameTimeout, NotOpen, SettingRejected

if TYPE_CHECKING:
    from escape_hw.config.device_models import CameraConfig

log = logging.getLogger(__name__)

#: Longest wait inside a library; ``stop`` and ``close`` come through this soon, whatever the time-out.
SLICE_MS = 50


class WaitingCamera(Camera):
    """A camera read through a blocking call, which is made in short slices.

    Drivers fill in ``_begin``, ``_end``, ``_take`` and ``_disconnect`` in place of ``_start``, ``_stop``,
    ``_next_frame`` and ``_close``; none of them runs while another does.

    Parameters
    ----------
    name
        Key in ``[devices]``.
    section
        Serial number, sensor, region, exposure and rate to begin with.
    kind
        What kind of camera it is, until it tells.
    counter
        First and last number of its frame counter.
    """

    def __init__(self, name: str, section: CameraConfig, kind: str, counter: tuple[int, int]) -> None:
        super().__init__(name)
        self._section, self._settings = section, section.settings()
        self._info = self._identity(kind, stand_in=False)
        self._top = np.uint16(self._info.full_scale)
        self._mask = np.empty((0, 0), np.bool_)
        self._limits: CameraLimits | None = None
        self._slowest_hz, self._fastest_hz = 0.0, math.inf
        self._waiting = threading.Lock()
        self._halted, self._acquiring = True, False
        self._numbers = counter
        self._counter, self._clock = FrameCounter(*counter), CameraClock()

    @property
    def info(self) -> CameraInfo:
        """Identity and fixed properties."""
        return self._info

    @property
    def settings(self) -> CameraSettings:
        """The settings in force, as read back from the camera."""
        return self._settings

    @abc.abstractmethod
    def _applied(self, want: CameraSettings) -> CameraSettings:
        """Set the camera as ``_check`` found possible; read back what it made of it.

        It calls ``_require_rate`` on the way. Limits of a camera depend on the order of setting them.
        """

    @abc.abstractmethod
    def _begin(self) -> None:
        """Start acquisition."""

    @abc.abstractmethod
    def _end(self) -> None:
        """Stop acquisition of a camera that acquires."""

    @abc.abstractmethod
    def _take(self, wait_ms: int) -> Frame | None:
        """A frame, or ``None`` when there is none after so many milliseconds (0: at once)."""

    @abc.abstractmethod
    def _disconnect(self) -> None:
        """Give the camera back, if it is connected."""

    def _identity(self, model: str, stand_in: bool) -> CameraInfo:
        section = self._section
        named = f"{model} (stand-in)" if stand_in else model
        sensor = section.sensor_px[::-1]
        return CameraInfo(named, section.serial, sensor, section.bit_depth, simulated=stand_in)

    def _require_sensor(self, found: tuple[int, int], alternative: str) -> None:
        """Refuse a camera whose sensor is not the configured one (width, height)."""
        stated = self._section.sensor_px
        if found != stated:
            raise DeviceError(
                self.name,
                f"is read out as {found[0]} x {found[1]} pixels, but sensor_px says {stated[0]} x "
                f"{stated[1]}; correct sensor_px {alternative}",
            )

    def _longest_s(self, want: CameraSettings) -> float:
        """Longest exposure that fits into a frame."""
        return 1 / want.frame_rate_hz

    def _known_limits(self) -> CameraLimits:
        if self._limits is None:
            raise NotOpen(self.name, "is not connected; call open() first")
        return self._limits

    def _check(self, want: CameraSettings) -> CameraSettings:
        answer = self._known_limits().nearest(self.name, want, self._longest_s(want))
        now = self._settings
        # The camera tells its rates for the region and exposure it has; others are found out by trying.
        if answer.region == now.region and answer.exposure_s >= now.exposure_s:
            self._require_rate(answer)
        return answer

    def _require_rate(self, want: CameraSettings) -> None:
        """Refuse a rate outside the limits that the camera tells at present."""
        slowest, fastest = self._slowest_hz, self._fastest_hz
        if want.frame_rate_hz > fastest * (1 + ROUNDING):
            raise SettingRejected(
                self.name,
                f"frame_rate_hz is {want.frame_rate_hz:g}; {want.region.height} rows and an exposure of "
                f"{want.exposure_s:g} s allow at most {fastest:.1f}",
            )
        if want.frame_rate_hz < slowest * (1 - ROUNDING):
            raise SettingRejected(
                self.name,
                f"frame_rate_hz is {want.frame_rate_hz:g}; the camera goes no slower than {slowest:g}",
            )

    def _configure(self, settings: CameraSettings) -> None:
        if self._acquiring:
            raise DeviceError(
                self.name, "could not be stopped, and keeps its settings; close and open it again"
            )
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

    def _hint(self) -> str:
        """What to check when no frame comes."""
        return f"cable, the exposure ({self.settings.exposure_s:g} s)"

    def _start(self) -> None:
        with self._waiting:
            if self._acquiring:
                return
            self._counter, self._clock = FrameCounter(*self._numbers), CameraClock()
            self._begin()
            self._halted, self._acquiring = False, True

    def _stop(self) -> None:
        self._halted = True
        with self._waiting:
            self._end_if_acquiring()

    def _close(self) -> None:
        self._halted = True
        with self._waiting:
            # A reader that came in after stop() may have started it again.
            self._end_if_acquiring()
            self._acquiring = False
            self._disconnect()
            self._limits = None
            self._slowest_hz, self._fastest_hz = 0.0, math.inf

    def _abandon(self) -> None:
        self._close()

    def _end_if_acquiring(self) -> None:
        if self._acquiring:
            self._acquiring = not self._managed(self._end)

    def _managed(self, step: Callable[[], None]) -> bool:
        """Take a step of stopping or closing, which a camera that has gone cannot; false when it failed."""
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
            frame = self._taken(min(SLICE_MS, math.ceil(left_s * 1e3)))
            if frame is not None:
                return frame
            left_s = deadline - time.monotonic()
        raise FrameTimeout(
            self.name, f"no frame within {timeout_s:g} s; check {self._hint()}, or allow a longer timeout"
        )

    def _poll(self) -> Frame | None:
        return self._taken(0)

    def _taken(self, wait_ms: int) -> Frame | None:
        with self._waiting:
            if self._halted:
                raise NotOpen(self.name, "was stopped or closed while a frame was awaited")
            return self._take(wait_ms)

    def _frame(self, view: NDArray[np.uint16], number: int, stamp_ns: int) -> Frame:
        """Copy a frame out of the library's buffer, which is overwritten as soon as the lock goes."""
        arrived_ns = time.monotonic_ns()
        data = view.copy()
        data.flags.writeable = False
        # Frames with no saturated pixel are the rule, and the maximum is quicker than counting.
        saturated = self._at_the_top(data) if data.max() >= self._top else 0
        exposed_ns = self._clock.exposed_ns(stamp_ns, arrived_ns)
        return Frame(data, self._counter.index(number), exposed_ns, arrived_ns, saturated)

    def _at_the_top(self, data: NDArray[np.uint16]) -> int:
        """Number of pixels at the top of the scale."""
        if self._mask.shape != data.shape:
            self._mask = np.empty(data.shape, np.bool_)
        return int(np.count_nonzero(np.equal(data, self._top, out=self._mask)))
