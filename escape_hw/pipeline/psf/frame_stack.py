"""Frames of a long run in memory that does not grow with it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

#: Frames kept; more are averaged two by two.
MAX_IMAGES = 4096


class FrameStack:
    """Keeps the frames of a run, or, once they are too many, the means of 2, 4, 8 ... neighbours.

    Parameters
    ----------
    limit
        Largest number of images kept, even.
    """

    def __init__(self, limit: int = MAX_IMAGES) -> None:
        if limit < 2 or limit % 2:
            raise ValueError(f"limit is {limit}; it must be even and at least 2")
        self._limit, self._frames_per_image = limit, 1
        self._stored: list[NDArray[np.float32]] = []
        self._sum: NDArray[np.float32] | None = None
        self._n_summed = 0
        #: Frames taken, and those of them whose brightest spot was cut off.
        self.count = self.clipped = 0

    def add(self, image: NDArray[np.integer], *, clipped: bool = False) -> None:
        """Take one frame ``(rows, columns)``; ``clipped`` says that its brightest spot was cut off."""
        self.count += 1
        self.clipped += clipped
        self._sum = image.astype(np.float32) if self._sum is None else self._sum + image
        self._n_summed += 1
        if self._n_summed < self._frames_per_image:
            return
        self._stored.append(self._sum / np.float32(self._frames_per_image))
        self._sum, self._n_summed = None, 0
        if len(self._stored) == self._limit:
            self._stored = [
                (a + b) / np.float32(2) for a, b in zip(self._stored[::2], self._stored[1::2], strict=True)
            ]
            self._frames_per_image *= 2

    def images(self) -> NDArray[np.float32]:
        """What is kept ``(n, rows, columns)``, each the mean of equally many frames in their order."""
        return np.stack(self._stored) if self._stored else np.zeros((0, 0, 0), np.float32)
