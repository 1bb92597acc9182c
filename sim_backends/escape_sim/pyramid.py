"""Modulated diffractive pyramid sensor on a camera."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.threads import helper_threads
from escape_sim.fourier_filter import good_length, is_good
from escape_sim.modulation import Modulation
from escape_sim.prism import Prism
from escape_sim.pyramid_fourier import FourierKernel
from escape_sim.pyramid_separable import SeparableKernel
from escape_sim.shack_hartmann import pupil_field

#: Threads that share the modulation points of a frame. Fixed, so that sums are rounded alike on
#: every machine.
WORKERS = 2

Method = Literal["auto", "separable", "fourier"]


class PyramidOptics:
    """Pyramid sensor: four images of the pupil on one camera.

    A pupil sample is a camera pixel, or a whole fraction of one. A positive slope of the optical
    path along x moves the image to +x on the pyramid, and that light goes to the right-hand images.
    The images are not mirrored. Conventions as OOPAO's ``Pyramid``, except that a tilt of one
    lambda/D is one wave across the pupil's diameter; OOPAO's is one between the centres of the
    outermost samples. Not for two threads at a time, though it uses two itself.

    Parameters
    ----------
    amplitude
        Pupil amplitude ``(n, n)``, ``n`` even.
    diameter_px
        Diameter of a pupil image in camera pixels, that of lambda/D.
    wavelength_m
        Wavelength in metres.
    centres_px
        Centres ``(4, 2)`` as (x, y) of the pupil images on the region in camera pixels: upper left,
        upper right, lower left, lower right.
    shape
        Camera region (rows, columns). Light that falls beside it is lost.
    modulation
        Path of the image over the pyramid.
    rooftop
        Length of the ridge in place of the apex in lambda/D; negative for the other diagonal.
    samples
        Pupil samples across a camera pixel.
    grid_px
        Side in camera pixels of the periodic square that the light is followed on; by default the
        next good length for the region.
    method
        Matrix products (``separable``, for images on a rectangle only) or Fourier transforms; the
        faster one by default. Both give the same frames to single precision.

    Raises
    ------
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
        method: Method = "auto",
    ) -> None:
        n = amplitude.shape[0]
        if amplitude.shape != (n, n) or n % 2:
            raise ValueError(f"amplitude has shape {amplitude.shape}; it must be square, of even side")
        if samples < 1 or not diameter_px > 0:
            raise ValueError(f"{samples} samples per pixel over {diameter_px} pixels; both must be positive")
        self.shape = shape
        self.amplitude = np.ascontiguousarray(amplitude, dtype=np.float32)
        self._diameter, self.wavelength_m = diameter_px * samples, wavelength_m
        grid = good_length(max(shape), samples) if grid_px is None else grid_px
        if grid * samples < n or grid * samples % 2:
            raise ValueError(
                f"a grid of {grid} pixels has {grid * samples} samples; it needs {n} or more, evenly"
            )
        self._window = Window(np.asarray(centres_px, dtype=float), shape, grid, samples)
        self.prism = Prism(self._window.shifts(n), self._diameter, rooftop)
        self._kernels = self._make_kernels(n, grid * samples, method)
        self._field = np.empty((n, n), np.complex64)
        self._power = np.empty((WORKERS, *self._kernels[0].shape), np.float32)
        self._helpers = ThreadPoolExecutor(WORKERS - 1, "pyramid") if helper_threads() else None
        self.modulation = modulation

    @property
    def modulation(self) -> Modulation:
        """Path of the image over the pyramid; may be set between frames."""
        return self._modulation

    @modulation.setter
    def modulation(self, modulation: Modulation) -> None:
        self._modulation = modulation
        kernel = self._kernels[0]
        turns = modulation.points / self._diameter
        x, y = kernel.tilts(turns[:, 0]), kernel.tilts(turns[:, 1])
        y *= np.sqrt(modulation.weights).astype(np.float32)[:, None]
        self._tilts = [(x[k::WORKERS], y[k::WORKERS]) for k in range(WORKERS)]

    @property
    def method(self) -> Method:
        """How the light is computed."""
        return "separable" if isinstance(self._kernels[0], SeparableKernel) else "fourier"

    def frame(
        self, opd_m: NDArray[np.float32], image: NDArray[np.float32] | None = None
    ) -> NDArray[np.float32]:
        """Intensity on the camera, averaged over the modulation.

        Parameters
        ----------
        opd_m
            Optical path difference ``(n, n)`` in metres.
        image
            Where to put the result; added to, so clear it first. A new array by default.

        Returns
        -------
        ndarray of float32, ``(rows, columns)``
            Sums (but for light beside the region) to the sum of ``amplitude ** 2``.
        """
        if opd_m.shape != self.amplitude.shape:
            raise ValueError(f"the optical path has shape {opd_m.shape}, the pupil {self.amplitude.shape}")
        out = np.zeros(self.shape, np.float32) if image is None else image
        opd = np.ascontiguousarray(opd_m, dtype=np.float32)
        pupil_field(
            opd.ravel(),
            1 / self.wavelength_m,
            self.amplitude.ravel(),
            self._field.view(np.float32).reshape(-1, 2),
        )
        if self._helpers is None:
            for k in range(WORKERS):
                self._share(k)
        else:
            others = [self._helpers.submit(self._share, k) for k in range(1, WORKERS)]
            self._share(0)
            for other in others:
                other.result()
        for power in self._power:
            self._window.add(power, out)
        return out

    def _share(self, worker: int) -> None:
        """Power of one worker's modulation points."""
        power = self._power[worker]
        power.fill(0)
        self._kernels[worker].add(self._field, *self._tilts[worker], power)

    def _make_kernels(self, n: int, n_grid: int, method: Method) -> list[SeparableKernel | FourierKernel]:
        distances = self.prism.half_distances((n_grid - n) / 2)
        if method == "separable" and distances is None:
            raise ValueError(
                "the images do not stand on a rectangle around the grid's middle; use method 'fourier'"
            )
        if distances is not None and (
            method == "separable" or (method == "auto" and _products_are_faster(n, n_grid))
        ):
            return [SeparableKernel(*distances, n, n_grid) for _ in range(WORKERS)]
        rows = self._window.rows
        return [FourierKernel(self.prism, n, n_grid, rows) for _ in range(WORKERS)]


class Window:
    """Where a square of samples lies on the camera region.

    Parameters
    ----------
    centres_px
        Centres ``(4, 2)`` of the pupil images on the region.
    shape
        Region (rows, columns).
    grid
        Side of the square in camera pixels.
    samples
        Samples across a camera pixel.
    """

    def __init__(
        self, centres_px: NDArray[np.float64], shape: tuple[int, int], grid: int, samples: int
    ) -> None:
        # The square stands around the images, and covers the region if it is large enough.
        first = np.round(centres_px.mean(axis=0) + 0.5 - grid / 2).astype(int)
        for axis, length in enumerate(shape[::-1]):
            if grid >= length:
                first[axis] = np.clip(first[axis], length - grid, 0)
        self._samples, self.first = samples, first
        self._centres = centres_px
        lo = np.maximum(first, 0)
        hi = np.minimum(first + grid, shape[::-1])
        self._region = tuple(slice(a, b) for a, b in zip(lo[::-1], hi[::-1], strict=True))
        self._part = tuple(
            slice(a * samples, b * samples)
            for a, b in zip((lo - first)[::-1], (hi - first)[::-1], strict=True)
        )
        self.rows = int(self._part[0].stop)

    def shifts(self, n: int) -> NDArray[np.float64]:
        """Shift ``(4, 2)`` in samples from a pupil of ``n`` samples at the square's corner to its images."""
        middles = (self._centres - self.first + 0.5) * self._samples - 0.5
        return np.asarray(middles - (n - 1) / 2)

    def add(self, power: NDArray[np.floating], image: NDArray[np.floating]) -> None:
        """Add the part of ``power`` that lies on the region to ``image``, samples summed to pixels."""
        part, s = power[self._part], self._samples
        if s > 1:
            rows, columns = part.shape
            part = part.reshape(rows // s, s, columns // s, s).sum(axis=(1, 3))
        image[self._region] += part


def _products_are_faster(n: int, n_grid: int) -> bool:
    """Whether matrix products beat transforms, by the operations of both and their measured rates.

    Products run at 85 Gflop/s and fold in 20 us; transforms run at 40 Gflop/s, or 17 where the length
    does not suit them, and need 0.8 ns for each sample of the grid in between.
    """
    products = 4 * (n * n * n_grid + n * n_grid**2) / 85e9 + 20e-6
    rate = 40e9 if is_good(n_grid) else 17e9
    transforms = (n + 3 * n_grid) * 5 * n_grid * np.log2(n_grid) / rate + 0.8e-9 * n_grid**2
    return bool(products < transforms)
