"""Frame numbers and times of a camera, as this computer counts them."""

from __future__ import annotations


class FrameCounter:
    """Makes a rising index of a device's counter that starts over.

    Parameters
    ----------
    first, last
        After ``last`` comes ``first`` again (a 32-bit counter: 0 and 2**32 - 1; GigE Vision's short block
        identifiers: 1 and 65535). A device whose numbers go beyond ``last`` never starts over.
    """

    def __init__(self, first: int, last: int) -> None:
        self._last, self._cycle = last, last - first + 1
        self._newest = 0
        self._turns = 0

    def index(self, number: int) -> int:
        """The index of a number; one that fell by less than half a turn has not started over, and falls."""
        newest, self._newest = self._newest, number
        if newest - number > self._cycle // 2 and newest <= self._last:
            self._turns += 1
        return number + self._turns * self._cycle


class CameraClock:
    """Puts a camera's own time stamps on this computer's monotonic clock.

    Spacing comes from the camera, which knows when it exposed. The offset is that of the frame that came
    through quickest so far, counted from ``start``: so no frame is said to be exposed after it arrived.
    """

    def __init__(self) -> None:
        self._offset: int | None = None

    def exposed_ns(self, stamp_ns: int, arrived_ns: int) -> int:
        """When a frame was exposed.

        Parameters
        ----------
        stamp_ns
            The camera's time stamp; 0: it gives none.
        arrived_ns
            Monotonic time of its arrival.
        """
        if stamp_ns == 0:
            return arrived_ns
        offset = arrived_ns - stamp_ns
        if self._offset is None or offset < self._offset:
            self._offset = offset
        return stamp_ns + self._offset
