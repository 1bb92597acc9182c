"""Streams of pyRTC and of milk as cameras."""

from __future__ import annotations

import time
from dataclasses import replace
from itertools import pairwise
from typing import TYPE_CHECKING, Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from escape_drivers.common.camera import BlockingCamera, split_settings
from escape_drivers.common.options import camera_settings, section_options
from escape_drivers.streams.source import (
    MILK,
    PYRTC,
    StreamSource,
    open_stream,
    stream_serial,
    with_stream_serial,
)
from escape_hw.api.camera import CameraInfo, CameraSettings, Frame
from escape_hw.config.section import Section
from escape_hw.errors import DeviceError, DeviceLost
from escape_hw.io.interchange.stream import Publication, Stream, StreamReadError

if TYPE_CHECKING:
    from escape_hw.config.devices import CameraConfig
    from escape_hw.config.registry import DeviceContext

#: Frames and seconds, whichever comes first, in which the rate is measured on opening.
_RATE_FRAMES, _RATE_TIMEOUT_S = 40, 1.0
#: Minimum number of frames for a rate.
_MIN_RATE_FRAMES = 5
_COUNTER_RANGE = (0, 2**63 - 1)


class StreamCameraOptions(Section):
    """The ``[devices.wfs.options]`` of these drivers.

    Parameters
    ----------
    stream
        Name of the stream.
    offset
        Counts added to every pixel, for streams that have had a dark frame subtracted.
    simulated
        The stream is filled by a simulator; results are marked as simulated.
    """

    stream: str = ""
    offset: float = 0.0
    simulated: bool = False


class StreamCamera(BlockingCamera[Stream]):
    """A camera whose frames another program acquires and publishes.

    Its numbers are those of the writes, so a write that was overwritten before it was read is a lost frame.
    Exposure and gain are reported as configured, because the stream has no metadata; the rate is measured on
    opening, while frames come. A region is cut out of the stream.

    Parameters
    ----------
    stream
        Name of the stream.
    serial
        Serial number in products; empty: the stream's name.
    name
        Name in messages.
    **settings
        Fields of :class:`~escape_drivers.common.camera.CameraSetup` and of :class:`StreamCameraOptions`.

    Raises
    ------
    ConfigError
        No stream is named or an option is wrong.
    """

    SOURCE: ClassVar[StreamSource]

    def __init__(self, stream: str, *, serial: str | int = "", name: str = "camera", **settings: Any) -> None:
        settings = {**settings, "stream": stream}
        serial = stream_serial("stream", serial, stream)
        setup, options = split_settings(name, serial, settings, StreamCameraOptions)
        super().__init__(name, setup, self.SOURCE.kind, _COUNTER_RANGE)
        self._options = options
        self._info = self._make_info(self.SOURCE.kind)
        self._last_count, self._written_ns = 0, 0

    @classmethod
    def from_section(cls, section: CameraConfig, context: DeviceContext) -> Self:
        """The camera of a device section; raises ``ConfigError`` as the class does."""
        options = section_options(StreamCameraOptions, context.name, section)
        section = with_stream_serial(context.name, section, options)
        return cls(**camera_settings(context.name, section), **options)

    def _make_info(self, kind: str) -> CameraInfo:
        return replace(self._build_info(kind, stand_in=False), simulated=self._options.simulated)

    def _open(self) -> None:
        stream = self._connection = open_stream(self.name, self.SOURCE, self._options.stream, write=False)
        if len(stream.shape) != 2:
            raise DeviceError(
                self.name, f"stream '{stream.name}' has shape {stream.shape}; a camera's frames have two axes"
            )
        self._adopt_sensor((stream.shape[1], stream.shape[0]), "to the size of the stream")
        self._info = self._make_info(f"{self.SOURCE.kind} {stream.name}")
        now = self._setup.settings(self._sensor_px)
        self._require_valid(now)
        rate = self._measure_rate(stream) or now.frame_rate_hz
        self._settings = replace(now, frame_rate_hz=rate, exposure_s=min(now.exposure_s, 1 / rate))

    def _check(self, want: CameraSettings) -> CameraSettings:
        """Any region; other settings belong to the publishing program."""
        return replace(self._settings, region=want.region)

    def _apply_settings(self, want: CameraSettings) -> CameraSettings:
        return want

    def _start_acquisition(self) -> None:
        self._last_count, self._written_ns = self._require_connected().count, 0

    def _stop_acquisition(self) -> None:
        """Nothing to stop: the publishing program continues."""

    def _timeout_hint(self) -> str:
        return f"the program that writes the stream '{self._options.stream}'"

    def _read_frame(self, wait_ms: int) -> Frame | None:
        try:
            publication = self._require_connected().read_after(self._last_count, wait_ms * 1e-3)
        except StreamReadError as error:
            raise DeviceLost(self.name, str(error)) from error
        if publication is None:
            return None
        self._last_count = publication.count
        return self._make_frame(
            self._pixel_counts(publication.data), publication.count, self._exposure_stamp_ns(publication)
        )

    def _pixel_counts(self, data: NDArray[np.generic]) -> NDArray[np.uint16]:
        """The region of an array as counts; what is below 0 or beyond the scale is cut off."""
        region = self._settings.region
        part = data[region.y : region.y + region.height, region.x : region.x + region.width]
        if part.dtype == np.uint16 and self._options.offset == 0:
            counts = part.astype(np.uint16, copy=False)
            return counts if counts.max() <= self._full_scale else np.minimum(counts, self._full_scale)
        shifted = np.asarray(part, np.float64) + self._options.offset
        return np.clip(np.rint(shifted), 0, float(self._full_scale)).astype(np.uint16)

    def _exposure_stamp_ns(self, publication: Publication) -> int:
        """When it was written; 0, for its arrival, where the writer's clock does not advance."""
        if publication.written_ns <= self._written_ns:
            return 0
        self._written_ns = publication.written_ns
        return publication.written_ns

    def _measure_rate(self, stream: Stream) -> float | None:
        """Frames per second of the stream, if it is being written."""
        deadline = time.monotonic() + _RATE_TIMEOUT_S
        seen, times = stream.count, list[tuple[int, int]]()
        while len(times) < _RATE_FRAMES and (left := deadline - time.monotonic()) > 0:
            publication = stream.read_after(seen, left)
            if publication is not None:
                seen = publication.count
                times.append((seen, publication.written_ns or time.time_ns()))
        if len(times) < _MIN_RATE_FRAMES:
            return None
        steps = [(b[1] - a[1]) / (b[0] - a[0]) for a, b in pairwise(times)]
        median_period_ns = float(np.median(steps))
        return 1e9 / median_period_ns if median_period_ns > 0 else None


class PyrtcCamera(StreamCamera):
    """A camera of pyRTC."""

    SOURCE = PYRTC


class MilkCamera(StreamCamera):
    """A camera of milk or CACAO."""

    SOURCE = MILK


#: Names of the entry points in version 0.1.0, which an environment installed then still has.
make_pyrtc_camera, make_milk_camera = PyrtcCamera, MilkCamera
