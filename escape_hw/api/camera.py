"""Interface of cameras, and their frames, settings and counters."""

from __future__ import annotations

import abc
import math
from collections.abc import Callable
from dataclasses import astuple, dataclass, replace
from numbers import Real
from typing import cast, final

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.device import Device
from escape_hw.api.flips import Flip, exchanges_axes, flip_image
from escape_hw.api.representation import describe_value, short_repr
from escape_hw.deprecation import renamed_members
from escape_hw.errors import DeviceError, FrameTimeout, SettingRejected


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """One camera frame.

    Parameters
    ----------
    data
        Counts ``(rows, columns)``, uint16, read-only, not overwritten by later frames.
    index
        Frame counter of the device; a step larger than one means lost frames.
    exposed_ns, arrived_ns
        Monotonic time of the end of the exposure and of the arrival in this computer, nanoseconds.
    n_saturated
        Number of pixels at full scale.
    """

    data: NDArray[np.uint16]
    index: int
    exposed_ns: int
    arrived_ns: int
    n_saturated: int = 0
    __repr__ = short_repr


@dataclass(frozen=True, slots=True)
class Region:
    """Region read from the sensor, in pixels of the sensor as the driver counts them, before any flip."""

    x: int
    y: int
    width: int
    height: int


@dataclass(frozen=True, slots=True)
class CameraSettings:
    """Settings of a camera.

    Parameters
    ----------
    region
        Region read out.
    exposure_s
        Exposure time in seconds.
    frame_rate_hz
        Frames per second.
    gain_db
        Analogue gain in decibels.
    """

    region: Region
    exposure_s: float
    frame_rate_hz: float
    gain_db: float = 0.0


@dataclass(frozen=True, slots=True)
class CameraInfo:
    """Identity and fixed properties of a camera."""

    model: str
    serial: str
    sensor_shape: tuple[int, int]
    bit_depth: int
    simulated: bool

    @property
    def full_scale(self) -> int:
        """Highest count of a pixel."""
        return int(2**self.bit_depth - 1)


@dataclass(frozen=True, slots=True)
class FrameStatus:
    """Counters since ``start``: delivered frames, lost frames (gaps of the index), time-outs."""

    delivered: int = 0
    lost: int = 0
    timeouts: int = 0


#: Type of the counts of a frame.
_COUNTS = np.dtype(np.uint16)
#: Types of whole numbers.
_WHOLE = (int, np.integer)


def _find_fault(want: object, sensor_shape: tuple[int, int]) -> str | None:
    """Why no camera with this sensor ``(rows, columns)`` has these settings, or ``None``."""
    if not isinstance(want, CameraSettings) or not isinstance(want.region, Region):
        return f"{describe_value(want)} are no CameraSettings with a Region"
    rows, columns = sensor_shape
    region = want.region
    if not all(isinstance(v, _WHOLE) for v in astuple(region)):
        return f"region {region} must be in whole pixels"
    if (
        min(region.x, region.y) < 0
        or min(region.width, region.height) < 1
        or region.x + region.width > columns
        or region.y + region.height > rows
    ):
        return f"region {region} does not lie on the sensor of {columns} x {rows} pixels"
    for name in ("exposure_s", "frame_rate_hz"):
        value = getattr(want, name)
        if not isinstance(value, Real) or not 0 < float(value) < math.inf:
            return f"{name} is {value!r}; it must be positive and finite"
    if not isinstance(want.gain_db, Real) or not math.isfinite(want.gain_db):
        return f"gain_db is {want.gain_db!r}; it must be finite"
    return None


@renamed_members(tap="callback")
class Camera(Device):
    """A camera. ``start`` and ``stop`` may be repeated; ``next_frame`` starts it when needed.

    Drivers implement ``_open``, ``_close``, ``_check``, ``_configure``, ``_start``, ``_stop`` and
    ``_next_frame``.

    Attributes
    ----------
    callback
        Called with every frame, see :class:`~escape_hw.api.callbacks.Callbacks`.
    flip
        How frames are turned before they are delivered (``devices.wfs.flip``). Drivers deliver them as they
        are. Regions and the sensor's size are those of the driver; a flip that exchanges rows and columns
        needs a square region.
    """

    def __init__(self, name: str) -> None:
        super().__init__(name)
        self.flip: Flip = "none"
        self.callback: Callable[[Frame], object] | None = None
        self._running = False
        self._delivered = self._lost = self._timeouts = 0
        self._last_index: int | None = None
        self._frame_shape = (0, 0)

    @property
    @abc.abstractmethod
    def info(self) -> CameraInfo:
        """Identity and fixed properties; available once open."""

    @property
    @abc.abstractmethod
    def settings(self) -> CameraSettings:
        """The settings in force, as read back from the device."""

    @property
    def is_running(self) -> bool:
        """True while the camera acquires."""
        return self._running

    @final
    def check(self, want: CameraSettings) -> CameraSettings:
        """Nearest achievable settings. Changes nothing.

        Raises
        ------
        SettingRejected
            The settings are outside the range of the device; the message gives the range.
        """
        self.require_open()
        with self._driver_calls:
            self._require_valid(want)
            answer = self._check(want)
        return self._require_possible(answer)

    def _require_valid(self, want: CameraSettings) -> None:
        """Refuse settings that no camera with this sensor has, as :meth:`check`; ``info`` must be known."""
        if (fault := _find_fault(want, self.info.sensor_shape)) is not None:
            raise SettingRejected(self.name, fault)
        region = want.region
        if region.width != region.height and exchanges_axes(self.flip):
            raise SettingRejected(
                self.name, f"region {region} must be square, since flip = '{self.flip}' exchanges its sides"
            )

    def _require_possible(self, answer: object) -> CameraSettings:
        """Refuse settings of the driver that no camera with this sensor has."""
        if (fault := _find_fault(answer, self.info.sensor_shape)) is not None:
            raise self.driver_defect(f"its settings are impossible: {fault}")
        return cast(CameraSettings, answer)

    def _settings_in_force(self) -> CameraSettings:
        with self._driver_calls:
            return self._require_possible(self.settings)

    def _after_open(self) -> None:
        info = self._require_kind(self.info, CameraInfo, "info")
        sensor = self._require_kind(info.sensor_shape, tuple, "info.sensor_shape")
        if len(sensor) != 2 or not all(isinstance(n, _WHOLE) and n > 0 for n in sensor):
            raise self.driver_defect(f"info.sensor_shape is {sensor}, not (rows, columns)")
        if not isinstance(info.bit_depth, int) or not 1 <= info.bit_depth <= 16:
            raise self.driver_defect(f"info.bit_depth is {info.bit_depth!r}; counts have 1 to 16 bits")
        self._settings_in_force()

    @final
    def configure(self, want: CameraSettings) -> CameraSettings:
        """Apply settings and return those read back from the hardware. Acquisition is stopped meanwhile.

        Raises
        ------
        SettingRejected
            See :meth:`check`; the camera is unchanged.
        DeviceError
            The device failed; acquisition is stopped.
        """
        with self._lock:
            achievable = self.check(want)
            running = self._running
            self.stop()
            with self._driver_calls:
                self._configure(achievable)
            if running:
                self.start()
            return self._settings_in_force()

    @final
    def start(self) -> None:
        """Start acquisition and reset the counters; does nothing when running."""
        self.require_open()
        if not self._running:
            self._delivered = self._lost = self._timeouts = 0
            self._last_index = None
            region = self._settings_in_force().region
            self._frame_shape = (region.height, region.width)
            with self._driver_calls:
                self._start()
            self._running = True

    @final
    def stop(self) -> None:
        """Stop acquisition; does nothing when stopped."""
        if self._running:
            self._running = False
            with self._driver_calls:
                self._stop()

    @final
    def next_frame(self, timeout_s: float = 1.0) -> Frame:
        """Wait for the next frame, at most ``timeout_s`` on the device's clock; starts acquisition if needed.

        Raises
        ------
        FrameTimeout
            No frame arrived in time.
        DeviceLost
            The camera was disconnected.
        DeviceError
            The frame counter did not increase.
        """
        self.require_open()
        if not 0 < timeout_s < math.inf:
            raise SettingRejected(self.name, f"timeout_s is {timeout_s}; it must be positive and finite")
        self.start()
        try:
            with self._driver_calls:
                frame = self._next_frame(timeout_s)
        except FrameTimeout:
            self._timeouts += 1
            raise
        return self._register_frame(frame)

    @final
    def poll(self) -> Frame | None:
        """The next frame if one has arrived, else ``None``; starts acquisition when needed.

        A loop reads a slower camera this way without waiting, also while another thread configures it.
        ``None`` does not count as a time-out.
        """
        if not self._lock.acquire(blocking=False):
            return None
        try:
            self.require_open()
            self.start()
            with self._driver_calls:
                frame = self._poll()
            return None if frame is None else self._register_frame(frame)
        finally:
            self._lock.release()

    def _register_frame(self, frame: Frame) -> Frame:
        self._require_well_formed(frame)
        if self._last_index is not None:
            if frame.index <= self._last_index:
                raise DeviceError(
                    self.name,
                    f"frame index went from {self._last_index} to {frame.index}; "
                    "the counter must increase (was the camera reset?)",
                )
            self._lost += frame.index - self._last_index - 1
        self._last_index = frame.index
        self._delivered += 1
        if self.flip != "none":
            data = np.ascontiguousarray(flip_image(frame.data, self.flip))
            data.setflags(write=False)
            frame = replace(frame, data=data)
        if self.callback is not None:
            self.callback(frame)
        return frame

    def _require_well_formed(self, frame: object) -> None:
        """Refuse what a driver delivers that is no frame of the region in force."""
        if not isinstance(frame, Frame):
            raise self.driver_defect(f"delivered {describe_value(frame)} for a frame")
        data, rows_and_columns = frame.data, self._frame_shape
        if not isinstance(data, np.ndarray) or data.dtype != _COUNTS or data.shape != rows_and_columns:
            raise self.driver_defect(
                f"delivered a frame with data {describe_value(data)}, not uint16 {rows_and_columns}"
            )
        if not (
            isinstance(frame.index, _WHOLE)
            and isinstance(frame.exposed_ns, _WHOLE)
            and isinstance(frame.arrived_ns, _WHOLE)
            and isinstance(frame.n_saturated, _WHOLE)
        ):
            raise self.driver_defect(
                f"delivered a frame with index {frame.index!r}, exposed_ns {frame.exposed_ns!r}, arrived_ns "
                f"{frame.arrived_ns!r} and n_saturated {frame.n_saturated!r}; they must be whole numbers"
            )

    @property
    def last_index(self) -> int:
        """Index of the latest frame since ``start``; -1 before the first."""
        return -1 if self._last_index is None else self._last_index

    def status(self) -> FrameStatus:
        """Counters since ``start``."""
        return FrameStatus(self._delivered, self._lost, self._timeouts)

    def _before_close(self) -> None:
        self.stop()

    @abc.abstractmethod
    def _check(self, want: CameraSettings) -> CameraSettings:
        """Nearest achievable settings, or raise :class:`SettingRejected`."""

    @abc.abstractmethod
    def _configure(self, settings: CameraSettings) -> None:
        """Apply settings returned by ``_check``."""

    @abc.abstractmethod
    def _start(self) -> None:
        """Start acquisition."""

    @abc.abstractmethod
    def _stop(self) -> None:
        """Stop acquisition."""

    @abc.abstractmethod
    def _next_frame(self, timeout_s: float) -> Frame:
        """Return the next frame or raise :class:`FrameTimeout`.

        The array of the frame must not change afterwards: copy a buffer that the driver reuses.
        """

    def _poll(self) -> Frame | None:
        """Return a frame that has arrived, or ``None``; by default waits for 1 us."""
        try:
            return self._next_frame(1e-6)
        except FrameTimeout:
            return None
