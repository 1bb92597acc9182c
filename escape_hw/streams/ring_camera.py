"""Camera whose frames another process writes into a ring."""

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

#: Looks between two of which the caller may see to the time: about ten microseconds.
POLLS = 8000


@intrinsic
def _load_atomic(typing_context: Any, address: Any) -> Any:
    """The word of 64 bits at an address, as it is now: a compiler would look once and believe it for ever."""

    def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        word = ir.IntType(64)
        pointer = builder.inttoptr(arguments[0], word.as_pointer())
        return builder.load_atomic(pointer, "acquire", 8)

    return types.uint64(types.uint64), code


@njit("b1(u8, u8, u8)", nogil=True)
def wait_for_change(address, value, n_polls):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Whether the word at an address differs from a value, looking so many times at most."""
    for _ in range(n_polls):
        if _load_atomic(address) != value:  # type: ignore[call-arg]
            return np.bool_(True)
    return np.bool_(False)


class RingCamera(Camera):
    """Delivers the frames of a ring in their order.

    A loop that was held up catches up with the frames that wait, so that telemetry has no gaps; when these
    fill the ring, it goes on with the newest, and those in between count as lost.

    Parameters
    ----------
    name
        Its key in ``[devices]``.
    segment
        The ring.
    info, settings
        What the writing process knows of the camera; the settings cannot be changed from here.
    spin_s
        So long before and after a frame is due it is looked for without sleeping, since to be woken takes
        longer than to answer a frame. Costs twice that share of a processor; 0: always asleep.
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
        """See the base class."""
        return self._info

    @property
    def settings(self) -> CameraSettings:
        """See the base class."""
        return self._settings

    def _open(self) -> None:
        self._reader = RingReader(self._segment)

    def _close(self) -> None:
        if self._reader is not None:
            self._reader.close()
            self._reader = None

    def _check(self, want: CameraSettings) -> CameraSettings:
        if want != self._settings:
            raise SettingRejected(self.name, "its settings belong to the process that writes its frames")
        return want

    def _configure(self, settings: CameraSettings) -> None:
        """Nothing to do: only the settings in force pass ``_check``."""

    def _start(self) -> None:
        self._ring.seek(self._ring.written)
        self._next_number = self._ring.position

    def _stop(self) -> None:
        """Nothing to do: the frames are another process's."""

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
        """Wait for an entry: asleep, and awake around the time when it is due."""
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
        """The next entry, or the newest when too many wait."""
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
            raise DeviceLost(self.name, "its ring is closed")
        return self._reader
