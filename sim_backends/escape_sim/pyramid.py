"""A four-sided pyramid sensor: plain reference, one point of the modulation after the other."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from escape_sim.modulation import Modulation


class PyramidOptics:
    """Optical path in metres to relative intensity on the camera."""

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
    ) -> None:
        n = amplitude.shape[0]
        period = 1 << int(np.ceil(np.log2(max(*shape, 2 * n) + 8)))
        self._x = np.arange(n) - (n - 1) / 2
        self._amplitude, self._wave = amplitude / np.sqrt(np.sum(amplitude**2.0)), 2 * np.pi / wavelength_m
        self._diameter, self.modulation, self.shape = diameter_px, modulation, shape
        u = np.arange(period) - (period - 1) / 2
        self._to_focus = np.exp(-2j * np.pi / period * np.outer(u, self._x)).astype(np.complex64) / period
        self._sides = (u < 0, u > 0)
        pixels = np.arange(max(shape))
        self._back = [
            [
                np.exp(2j * np.pi / period * np.outer(pixels[:size] - at, u[self._sides[side]])).astype(
                    np.complex64
                )
                for size, at, side in ((shape[0], centre[1], k // 2), (shape[1], centre[0], k % 2))
            ]
            for k, centre in enumerate(np.asarray(centres_px, float))
        ]

    def frame(
        self, opd_m: NDArray[np.float32], image: NDArray[np.float32] | None = None
    ) -> NDArray[np.float32]:
        """Add the intensity to ``image (rows, columns)`` and return it."""
        out = np.zeros(self.shape, np.float32) if image is None else image
        field = (self._amplitude * np.exp(1j * self._wave * opd_m)).astype(np.complex64)
        for (px, py), weight in zip(self.modulation.points, self.modulation.weights, strict=True):
            tilt_x = np.exp(2j * np.pi * px / self._diameter * self._x)
            tilt_y = np.exp(2j * np.pi * py / self._diameter * self._x)
            moved = (field * tilt_x[None, :] * tilt_y[:, None]).astype(np.complex64)
            focus = self._to_focus @ moved @ self._to_focus.T
            total = np.zeros(self.shape, np.complex64)
            for k, (rows, columns) in enumerate(self._back):
                part = focus[self._sides[k // 2]][:, self._sides[k % 2]]
                total += rows @ part @ columns.T
            out += np.float32(weight) * (total.real**2 + total.imag**2)
        return out
