"""Camera whose frames another process writes to a ring."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
from llvmlite import ir
from numba import njit, types
from numba.extending import intrinsic

from escape_hw.api.camera import Camera, CameraInfo, CameraSettings, Frame
from escape_hw.errors import DeviceLost, FrameTimeout, SettingRejected
from escape_hw.streams.ring import RingReader, Sample

#: Polls per call of :func:`wait_for_change`, about ten microseconds.
POLLS = 8000


@intrinsic
def _load_atomic(typing_context: Any, address: Any) -> Any:
    """Atomic load of a 64-bit word; a compiler would hoist an ordinary load out of the loop."""

    def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        word = ir.IntType(64)
        pointer = builder.inttoptr(arguments[0], word.as_pointer())
        return builder.load_atomic(pointer, "acquire", 8)

    return types.uint64(types.uint64), code


@njit("b1(u8, u8, u8)", cache=True, nogil=True)
def wait_for_change(address, value, n_polls):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Poll a word up to ``n_polls`` times; whether it differs from ``value``."""
    for _ in range(n_polls):
        if _load_atomic(address) != value:  # type: ignore[call-arg]
            return np.bool_(True)
    return np.bool_(False)


class RingCamera(Camera):
    """Delivers the frames of a ring in order.

    A delayed loop catches up with the waiting frames, so that telemetry has no gaps. When they fill the ring,
    it continues with the newest, and the frames in between count as lost.

    Parameters
    ----------
    name
        Its key in ``[devices]``.
    segment
        Name of the ring's segment.
    info, settings
        Properties of the camera of the writing process. The settings cannot be changed here.
    spin_s
        Time before and after the expected arrival of a frame in which it is polled for without sleeping,
        since waking up takes longer than processing a frame. 0: always sleep.
    """

    def __init__(
        self, name: str, segment: str, info: CameraInfo, settings: CameraSettings, *, spin_s: float = 0.0
    ) -> None:
        super().__init__(name)
        self._spin_s, self._last_arrival_s = spin_s, 0.0
        self._segment, self._info, self._settings = segment, info, settings
        self._reader: RingReader | None = None
        self._next_number = 0

    @property
    def info(self) -> CameraInfo:
        """Properties of the camera."""
        return self._info

    @property
    def settings(self) -> CameraSettings:
        """The settings of the writing process."""
        return self._settings

    def _open(self) -> None:
        self._reader = RingReader(self._segment)

    def _close(self) -> None:
        if self._reader is not None:
            self._reader.close()
            self._reader = None

    def _check(self, want: CameraSettings) -> CameraSettings:
        if want != self._settings:
            raise SettingRejected(self.name, "the settings belong to the process that writes the frames")
        return want

    def _configure(self, settings: CameraSettings) -> None:
        """Does nothing: ``_check`` accepts the present settings only."""

    def _start(self) -> None:
        self._ring.seek(self._ring.written)
        self._next_number = self._ring.position

    def _stop(self) -> None:
        """Does nothing: the frames belong to another process."""

    def _next_frame(self, timeout_s: float) -> Frame:
        ring, until = self._ring, time.monotonic() + timeout_s
        while True:
            if ring.written == self._next_number and not self._wait_for_entry(ring, until - time.monotonic()):
                if not ring.alive:
                    raise DeviceLost(self.name, f"the process that wrote '{self._segment}' has ended")
                raise FrameTimeout(self.name, f"no frame within {timeout_s:g} s in '{self._segment}'")
            sample = self._take_entry(ring)
            if sample is not None:
                sample.data.flags.writeable = False
                return Frame(sample.data, sample.index, sample.exposed_ns, sample.arrived_ns)

    def _wait_for_entry(self, ring: RingReader, timeout_s: float) -> bool:
        """Wait for an entry: sleep, and poll around its expected arrival."""
        if self._spin_s <= 0:
            return ring.wait(self._next_number, timeout_s)
        due = self._last_arrival_s + 1 / self._settings.frame_rate_hz
        early = due - self._spin_s - time.monotonic()
        if early > 0 and ring.wait(self._next_number, min(early, timeout_s)):
            return True
        while time.monotonic() < due + self._spin_s:
            if wait_for_change(ring.written_at, self._next_number, POLLS):
                return True
        return ring.wait(self._next_number, max(timeout_s, 0.0))

    def _take_entry(self, ring: RingReader) -> Sample | None:
        """The next entry, or the newest when the ring is nearly full."""
        if ring.written - self._next_number > ring.slots - 2:
            ring.seek(ring.written - 1)
        sample = ring.next()
        self._next_number = ring.position
        if sample is not None:
            self._last_arrival_s = sample.arrived_ns * 1e-9
        return sample

    @property
    def _ring(self) -> RingReader:
        if self._reader is None:
            raise DeviceLost(self.name, "the ring is closed")
        return self._reader
