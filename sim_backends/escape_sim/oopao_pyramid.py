"""OOPAO as the twin's pyramid optics (``system.optics = "oopao"``): slow, for reference."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from escape_sim.fourier_filter import good_length
from escape_sim.modulation import Modulation
from escape_sim.oopao_bridge import make_light, make_pyramid, oopao, quiet
from escape_sim.prism import Prism
from escape_sim.pyramid import Window

#: OOPAO's faces, numbered from the lower right on clockwise, in our order.
_FACES = (2, 3, 1, 0)


class OOPAOPyramid:
    """The interface of ``PyramidOptics`` with OOPAO doing the propagation.

    Parameters
    ----------
    amplitude, diameter_px, wavelength_m, centres_px, shape, modulation, rooftop, samples, grid_px
        As for ``PyramidOptics``. OOPAO's grid holds two pupils side by side, so ``grid_px`` is at
        least twice the pupil map's side.
    diameter_m
        Side of the pupil map in metres, for a mirror of OOPAO's; angles alone do not need it.

    Raises
    ------
    ConfigError
        OOPAO is not installed.
    ValueError
        The geometry does not fit together.
    """

    def __init__(
        self,
        amplitude: NDArray[np.float32],
        diameter_px: float,
        wavelength_m: float,
        centres_px: NDArray[np.float64],
        shape: tuple[int, int],
        modulation: Modulation,
        *,
        rooftop: float = 0.0,
        samples: int = 1,
        grid_px: int | None = None,
        diameter_m: float = 1.0,
    ) -> None:
        n = amplitude.shape[0]
        if amplitude.shape != (n, n) or n % (2 * samples):
            raise ValueError(
                f"amplitude has shape {amplitude.shape}; it must be square, with a side of "
                f"a multiple of {2 * samples} samples"
            )
        side = n // samples
        least = max(2 * side, max(shape) if grid_px is None else grid_px)
        grid = good_length(least, samples) if grid_px is None else least
        if grid % 2 or (grid_px is not None and grid != grid_px):
            raise ValueError(f"a grid of {grid_px} pixels; OOPAO needs an even number from {2 * side} on")
        self.shape = shape
        self.amplitude = np.ascontiguousarray(amplitude, dtype=np.float32)
        # OOPAO's unit of tilt is one wave between the centres of the outermost samples.
        self._unit = (n - 1) / (diameter_px * samples)
        self._window = Window(np.asarray(centres_px, dtype=float), shape, grid, 1)
        shifts = self._window.shifts(side)
        separation = (grid - 2 * side) // 4 * 2
        self.light = make_light(self.amplitude, diameter_m, wavelength_m)
        roof = Prism(shifts, diameter_px, rooftop).roof_height * np.sqrt(2) / samples
        edge = (grid - 2 * side - separation) // 2
        self.sensor = make_pyramid(self.light, side, separation, edge, roof)
        nominal = (side + separation) / 2 * np.array([[-1, -1], [1, -1], [-1, 1], [1, 1]])
        extra = (shifts - (grid - side) / 2 - nominal)[np.argsort(_FACES)]
        with quiet():
            self.sensor.apply_shift_wfs(list(extra[:, 0]), list(-extra[:, 1]))
        self.modulation = modulation

    @property
    def modulation(self) -> Modulation:
        """Path of the image over the pyramid; may be set between frames."""
        return self._modulation

    @modulation.setter
    def modulation(self, modulation: Modulation) -> None:
        self._modulation = modulation
        path = modulation.points * self._unit
        with quiet():
            self.sensor.user_modulation_path = path.tolist()
            # It divides by the number of points in the field and once more in the weighted sum.
            self.sensor.weight_vector = modulation.weights * len(path) ** 2
            self.sensor.modulation = float(np.hypot(*path.T).max())

    def frame(
        self, opd_m: NDArray[np.floating], image: NDArray[np.floating] | None = None
    ) -> NDArray[np.floating]:
        """Intensity on the camera, averaged over the modulation.

        Parameters
        ----------
        opd_m
            Optical path difference ``(n, n)`` in metres.
        image
            Where to put the result; added to, so clear it first. A new array by default.

        Returns
        -------
        ndarray, ``(rows, columns)``, float32 by default
            Sums (but for light beside the region) to the sum of ``amplitude ** 2``.
        """
        if opd_m.shape != self.amplitude.shape:
            raise ValueError(f"the optical path has shape {opd_m.shape}, the pupil {self.amplitude.shape}")
        out: NDArray[np.floating] = np.zeros(self.shape, np.float32) if image is None else image
        light = self.light
        with quiet():
            # '**' starts a new propagation; '*' alone would add to the last one.
            light.source**light.telescope * oopao().OPD_map(np.asarray(opd_m, dtype=float)) * self.sensor
            self._window.add(np.asarray(self.sensor.cam.frame) / light.unit, out)
        return out
