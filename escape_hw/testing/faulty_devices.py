"""Wrappers of mirrors and cameras that inject faults."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.camera import Camera, CameraSettings, Frame
from escape_hw.api.device import Device
from escape_hw.api.mirror import DeformableMirror
from escape_hw.errors import DeviceError, DeviceLost, FrameTimeout


class _Wrapper(Device):
    """Identity, clock and connection of the wrapped device, a mix-in placed before its interface."""

    inner: Any

    @property
    def info(self) -> Any:
        """Identity of the inner device."""
        return self.inner.info

    def now_ns(self) -> int:
        """Clock of the inner device."""
        return int(self.inner.now_ns())

    def _open(self) -> None:
        self.inner.open()

    def _close(self) -> None:
        self.inner.close()

    def _release_after_failed_open(self) -> None:
        self.inner.close()


class FaultyMirror(_Wrapper, DeformableMirror):
    """A wrapper of a mirror that records transfers and injects faults.

    Without faults it satisfies the contract of a mirror.

    Parameters
    ----------
    inner
        The wrapped mirror; name and limits are taken from it.
    fail_sends
        Numbers of the transfers that fail with :class:`~escape_hw.errors.DeviceError`, counted from 0 over
        the life of this object and including the ramps of ``flatten``.
    lost_from
        Number of the transfer from which all fail with :class:`~escape_hw.errors.DeviceLost`.

    Attributes
    ----------
    reached
        Every shape that reached the inner mirror, in order.
    """

    def __init__(
        self,
        inner: DeformableMirror,
        *,
        fail_sends: Collection[int] = (),
        lost_from: int | None = None,
    ) -> None:
        super().__init__(inner.name, inner.limits)
        self.inner: DeformableMirror = inner
        self.fail_sends = frozenset(fail_sends)
        self.lost_from = lost_from
        self.reached: list[NDArray[np.float64]] = []
        self.transfers = 0

    def _open(self) -> None:
        super()._open()
        if self._flat is None:
            self._flat = self.inner.flat

    def _present_shape(self) -> NDArray[np.float64]:
        return self.inner.shape

    def _send(self, command: NDArray[np.float64]) -> NDArray[np.float64] | None:
        number = self.transfers
        self.transfers += 1
        if self.lost_from is not None and number >= self.lost_from:
            raise DeviceLost(self.name, f"lost at transfer {number} (injected)")
        if number in self.fail_sends:
            raise DeviceError(self.name, f"transfer {number} failed (injected)")
        report = self.inner.send(command)
        self.reached.append(report.sent.copy())
        return report.sent if report.skipped else None


class FaultyCamera(_Wrapper, Camera):
    """A wrapper of a camera that drops, repeats and withholds frames.

    Without faults it satisfies the contract of a camera. Faults refer to frame indices of the inner camera.

    Parameters
    ----------
    inner
        The wrapped camera; the name is taken from it.
    drop
        Indices of lost frames.
    drop_every
        Frames with an index divisible by this number are lost.
    repeat
        Indices of frames that are delivered twice, as by some drivers after an overrun; ``next_frame``
        rejects the copy.
    stall_from
        Index from which every call times out.
    lost_from
        Index from which every call raises :class:`~escape_hw.errors.DeviceLost`.
    """

    def __init__(
        self,
        inner: Camera,
        *,
        drop: Collection[int] = (),
        drop_every: int | None = None,
        repeat: Collection[int] = (),
        stall_from: int | None = None,
        lost_from: int | None = None,
    ) -> None:
        super().__init__(inner.name)
        if drop_every is not None and drop_every < 2:
            raise ValueError(f"drop_every is {drop_every}; it must be at least 2")
        self.inner: Camera = inner
        self.drop = frozenset(drop)
        self.drop_every = drop_every
        self.repeat = frozenset(repeat)
        self.stall_from = stall_from
        self.lost_from = lost_from
        self._repeated: Frame | None = None

    @property
    def settings(self) -> CameraSettings:
        """Settings of the inner camera."""
        return self.inner.settings

    def _check(self, want: CameraSettings) -> CameraSettings:
        return self.inner.check(want)

    def _configure(self, settings: CameraSettings) -> None:
        self.inner.configure(settings)

    def _start(self) -> None:
        self._repeated = None
        self.inner.start()

    def _stop(self) -> None:
        self.inner.stop()

    def _next_frame(self, timeout_s: float) -> Frame:
        if self._repeated is not None:
            frame, self._repeated = self._repeated, None
            return frame
        deadline = self.now_ns() + int(timeout_s * 1e9)
        while True:
            left = (deadline - self.now_ns()) * 1e-9
            if left <= 0:
                raise FrameTimeout(self.name, f"no frame within {timeout_s:g} s")
            try:
                frame = self.inner.next_frame(left)
            except FrameTimeout:
                raise FrameTimeout(self.name, f"no frame within {timeout_s:g} s") from None
            if self.lost_from is not None and frame.index >= self.lost_from:
                raise DeviceLost(self.name, f"lost at frame {frame.index} (injected)")
            if not self._is_withheld(frame.index):
                break
        if frame.index in self.repeat:
            self._repeated = replace(frame)
        return frame

    def _is_withheld(self, index: int) -> bool:
        if self.stall_from is not None and index >= self.stall_from:
            return True
        return index in self.drop or (self.drop_every is not None and index % self.drop_every == 0)
