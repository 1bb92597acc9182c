"""Base classes of the wavefront sensors' optics."""

from __future__ import annotations

import abc

import numpy as np
from numpy.typing import NDArray

from escape_sim.optics.modulation import ModulationPath


class SensorOptics(abc.ABC):
    """Optics of a wavefront sensor: from optical path in metres to relative intensity.

    Parameters
    ----------
    amplitude
        Pupil amplitude ``(n, n)``.
    shape
        Camera region (rows, columns).
    """

    def __init__(self, amplitude: NDArray[np.float32], shape: tuple[int, int]) -> None:
        self.amplitude = np.ascontiguousarray(amplitude, dtype=np.float32)
        self.shape = shape

    def frame(
        self, opd_m: NDArray[np.floating], image: NDArray[np.floating] | None = None
    ) -> NDArray[np.floating]:
        """Add the mean intensity ``(rows, columns)`` to ``image``, float32 zeros by default; return it.

        ``opd_m (n, n)`` is the optical path difference in metres. The intensity sums to the sum of
        ``amplitude ** 2``, except for light outside the region or the field of a lenslet.

        Raises
        ------
        ValueError
            The optical path has another shape than the pupil.
        """
        if opd_m.shape != self.amplitude.shape:
            raise ValueError(f"the optical path has shape {opd_m.shape}, the pupil {self.amplitude.shape}")
        out: NDArray[np.floating] = np.zeros(self.shape, np.float32) if image is None else image
        self._add_intensity(opd_m, out)
        return out

    @abc.abstractmethod
    def _add_intensity(self, opd_m: NDArray[np.floating], out: NDArray[np.floating]) -> None:
        """Add the mean intensity to ``out``."""


class ModulatedOptics(SensorOptics):
    """Optics of a pyramid."""

    @property
    def modulation(self) -> ModulationPath:
        """Path of the image over the pyramid; may be set between frames."""
        return self._modulation

    @modulation.setter
    def modulation(self, modulation: ModulationPath) -> None:
        self._modulation = modulation
        self._apply_modulation(modulation)

    @abc.abstractmethod
    def _apply_modulation(self, modulation: ModulationPath) -> None:
        """Compute what depends on the modulation."""
