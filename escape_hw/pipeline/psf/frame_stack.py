"""Frames of a long run in bounded memory."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

#: Largest number of images kept; beyond it neighbours are averaged.
MAX_IMAGES = 4096


class FrameStack:
    """Frames of a run, or the means of 2, 4, 8 ... consecutive frames once there are too many.

    ``limit``: largest number of images kept, even.

    Attributes
    ----------
    count, clipped
        Number of frames added, and of those with a saturated peak.
    """

    def __init__(self, limit: int = MAX_IMAGES) -> None:
        if limit < 2 or limit % 2:
            raise ValueError(f"limit is {limit}; it must be even and at least 2")
        self._limit, self._frames_per_image = limit, 1
        self._stored: list[NDArray[np.float32]] = []
        self._sum: NDArray[np.float32] | None = None
        self._n_summed = 0
        self.count = self.clipped = 0

    def add(self, image: NDArray[np.integer], *, clipped: bool = False) -> None:
        """Add one frame ``(rows, columns)``; ``clipped`` if its peak is saturated."""
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
        """Images ``(n, rows, columns)`` in order, each the mean of the same number of frames."""
        return np.stack(self._stored) if self._stored else np.zeros((0, 0, 0), np.float32)
