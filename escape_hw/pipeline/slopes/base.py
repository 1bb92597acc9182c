"""Base class of the slope functions of all kinds of sensors."""

from __future__ import annotations

import abc
from collections.abc import Callable
from typing import Generic

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.sensor import G


class FrameSlopes(abc.ABC, Generic[G]):
    """Slope function of a geometry on a camera region; subclasses implement ``_compute``.

    Calibrated pixels are ``max(frame * gain - offset, 0)``, with the gain one over the flat.

    Parameters
    ----------
    shape
        Region (rows, columns).
    dark
        Dark frame in counts, zeros by default.
    flat
        Relative pixel response, ones by default.
    threshold
        Level in counts above the dark frame that is subtracted.

    Raises
    ------
    ValueError
        Region, dark and flat have different shapes, or the flat is not positive.
    """

    def __init__(
        self,
        grid: G,
        shape: tuple[int, int],
        dark: NDArray[np.float32] | None,
        flat: NDArray[np.float32] | None,
        threshold: float = 0.0,
    ) -> None:
        self.grid, self.shape, self.threshold = grid, shape, float(threshold)
        self.dark = np.zeros(shape, np.float32) if dark is None else np.ascontiguousarray(dark, np.float32)
        response = np.ones(shape, np.float32) if flat is None else np.asarray(flat, np.float32)
        if self.dark.shape != shape or response.shape != shape:
            raise ValueError(
                f"dark {self.dark.shape} and flat {response.shape} must have the region's {shape}"
            )
        if not (response > 0).all():
            raise ValueError("the flat has pixels that are not positive")
        self._gain = np.ascontiguousarray(1 / response)
        self._offset = np.ascontiguousarray(self.dark * self._gain + np.float32(threshold))
        self._light = np.empty(grid.n_valid, np.float32)
        #: Subtracted from the slopes ``(n_slopes,)``; set by the subclass.
        self._zero_points = np.zeros(grid.n_slopes, np.float32)
        #: Called with the slopes of each frame.
        self.observer: Callable[[NDArray[np.float32]], object] | None = None

    @property
    def flux(self) -> NDArray[np.float32]:
        """Flux above the threshold of each valid sub-aperture in the last frame ``(n_valid,)``, in counts.

        Overwritten by the next call without a flux array of its own.
        """
        return self._light

    def __call__(
        self,
        frame: NDArray[np.uint16],
        flux: NDArray[np.float32] | None = None,
        out: NDArray[np.float32] | None = None,
    ) -> NDArray[np.float32]:
        """Slopes ``(n_slopes,)``, written into ``out``, and flux into ``flux (n_valid,)``, if given."""
        if frame.shape != self.shape:
            raise ValueError(f"frame has shape {frame.shape}; the slopes were set up for {self.shape}")
        slopes = np.empty(self.grid.n_slopes, np.float32) if out is None else out
        self._compute(frame, slopes, self._light if flux is None else flux)
        if self.observer is not None:
            self.observer(slopes)
        return slopes

    def shift_references(self, offset: NDArray[np.float32]) -> None:
        """Add an offset ``(n_slopes,)`` to the reference slopes."""
        self._zero_points += np.asarray(offset, np.float32)

    @abc.abstractmethod
    def _compute(
        self, frame: NDArray[np.uint16], slopes: NDArray[np.float32], light: NDArray[np.float32]
    ) -> None:
        """Write ``slopes (n_slopes,)`` and ``light (n_valid,)``."""
