"""Modulated diffractive pyramid sensor: prism, propagation, and four pupil images on a camera.

The light is propagated by Fourier transforms or by separable matrix products.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from escape_hw.api.concurrency import helper_threads_allowed
from escape_sim.optics.base import ModulatedOptics
from escape_sim.optics.fourier_filter import FourierFilter, is_fast_length, next_fast_length
from escape_sim.optics.modulation import ModulationPath
from escape_sim.optics.shack_hartmann import pupil_field


@dataclass(frozen=True, eq=False)
class Prism:
    """Four planes that meet in edges and in one point, or in a ridge (rooftop).

    A face tilts the light on it and so shifts its image of the pupil; the tilt is the gradient of the
    face. The surface is the highest of the four planes everywhere, as in OOPAO's
    ``Pyramid.get_phase_mask``, so faces of unequal tilt meet along edges that are not quite square.

    Raises
    ------
    ValueError
        The shifts are not four finite points in their order.
    """

    #: Shift ``(4, 2)`` as (x, y) of each image in pupil samples: upper left, upper right, lower left, lower
    #: right.
    shifts: NDArray[np.float64]
    #: Pupil diameter in samples.
    diameter: float
    #: Length in lambda/D of the ridge; negative for the other diagonal.
    rooftop: float = 0.0

    def __post_init__(self) -> None:
        shifts = np.array(self.shifts, dtype=float)
        if shifts.shape != (4, 2) or not np.isfinite(shifts).all():
            raise ValueError(f"image shifts have shape {shifts.shape}; they must be finite and (4, 2)")
        ul, ur, ll, lr = shifts
        if not (max(ul[0], ll[0]) < min(ur[0], lr[0]) and max(ul[1], ur[1]) < min(ll[1], lr[1])):
            raise ValueError(
                "the four images must be in the order upper left, upper right, lower left, lower right"
            )
        object.__setattr__(self, "shifts", shifts)

    def mask(self, n_grid: int) -> NDArray[np.complex128]:
        """Transmission ``(n_grid, n_grid)``, rows along y, on the frequencies of :func:`frequencies`."""
        kx, ky = np.meshgrid(frequencies(n_grid), frequencies(n_grid))
        planes = 2 * np.pi * (self.shifts[:, :1, None] * kx + self.shifts[:, 1:, None] * ky)
        planes[[0, 3]] += self.roof_height
        return np.asarray(np.exp(-1j * planes.max(axis=0)))

    def half_distances(self, centre: float) -> tuple[float, float] | None:
        """Half the distances (x, y) of images on a rectangle around a shift of ``centre``; else None.

        Only for a rectangle is the transmission a product of symmetric factors along x and y.
        """
        signs = np.array([[-1, -1], [1, -1], [-1, 1], [1, 1]])
        half = (self.shifts - centre)[3]
        if self.rooftop or np.abs(self.shifts - centre - signs * half).max() > 1e-9:
            return None
        return float(half[0]), float(half[1])

    @property
    def roof_height(self) -> float:
        """Phase in radians by which the upper left and lower right faces are raised."""
        # With images at (+-r, +-r), two raised planes meet along a diagonal from (-k, k) to (k, -k),
        # where a third plane is as high: 4 pi r k = height. The ridge is sqrt(8) k long.
        r = np.abs(self.shifts - self.shifts.mean(axis=0)).mean()
        return float(np.sqrt(2) * np.pi * r * self.rooftop / self.diameter)


def frequencies(n_grid: int) -> NDArray[np.float64]:
    """Spatial frequencies of the focal plane in cycles per sample; the apex is between four of them."""
    return (np.arange(n_grid) - (n_grid - 1) / 2) / n_grid


# The loops over rows use local names, without which the compiler does not vectorise them.
@njit(cache=True, fastmath=True, nogil=True)
def _tilt(field, tilt_y, tilt_x, out):  # type: ignore[no-untyped-def]  # pragma: no cover
    """``out[:, :n] = tilt_y[:, None] field tilt_x``."""
    for i in range(field.shape[0]):
        source, row, factor = field[i], out[i], tilt_y[i]
        for j in range(tilt_x.size):
            row[j] = source[j] * (tilt_x[j] * factor)


@njit(cache=True, fastmath=True, nogil=True)
def _add_power(field, power):  # type: ignore[no-untyped-def]  # pragma: no cover
    """``power += |field[:, :n]|**2``."""
    for i in range(power.shape[0]):
        row, total = field[i], power[i]
        for j in range(total.size):
            total[j] += row[j].real * row[j].real + row[j].imag * row[j].imag


class FourierKernel:
    """Power of a field behind the prism, summed over modulation points, by Fourier transforms.

    ``n`` is the number of pupil samples across the field, ``n_grid`` the even side of the periodic grid,
    ``rows`` the number of output rows wanted from row 0 on. Not thread-safe: use one kernel per thread.
    """

    def __init__(self, prism: Prism, n: int, n_grid: int, rows: int) -> None:
        self.shape = (rows, n_grid)
        self._n = n
        # The tilts include the half-integer frequencies and the scale of the inverse transform.
        self._carrier = np.exp(-2j * np.pi * frequencies(n_grid)[0] * np.arange(n)) / n_grid
        self._filter = FourierFilter(prism.mask(n_grid), n, rows)

    def tilts(self, cycles: NDArray[np.float64]) -> NDArray[np.complex64]:
        """Factors ``(k, n)`` for tilts in cycles of phase per sample ``(k,)``."""
        samples = np.arange(self._n) - (self._n - 1) / 2
        return np.asarray(self._carrier * np.exp(2j * np.pi * np.outer(cycles, samples)), np.complex64)

    def add(
        self,
        field: NDArray[np.complex64],
        tilts_x: NDArray[np.complex64],
        tilts_y: NDArray[np.complex64],
        power: NDArray[np.float32],
    ) -> None:
        """Add the power of ``field (n, n)`` under each tilt to ``power``, of shape ``self.shape``."""
        for tilt_x, tilt_y in zip(tilts_x, tilts_y, strict=True):
            _tilt(field, tilt_y, tilt_x, self._filter.field)
            self._filter.run()
            _add_power(self._filter.result, power)


@njit(cache=True, fastmath=True, nogil=True)
def _fold_parity(field, tilt_y, tilt_x, out):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Parts of the tilted field that are even and odd along y and x: ``out (2, 2h, h)``.

    The first axis is the parity along x; the rows are the even part along y, then the odd part. The
    tilts are given for the second half of the samples; those of the first half are their conjugates.
    """
    h = tilt_x.size
    for i in range(h):
        upper, lower, t = field[h - 1 - i], field[h + i], tilt_y[i]
        ee, eo, oe, oo = out[0, i], out[0, h + i], out[1, i], out[1, h + i]
        for j in range(h):
            u = tilt_x[j]
            tilt, across = t * u, t * u.conjugate()
            a, b = lower[h + j] * tilt, upper[h - 1 - j] * tilt.conjugate()
            c, d = lower[h - 1 - j] * across, upper[h + j] * across.conjugate()
            ee[j] = (a + c) + (b + d)
            eo[j] = (a + c) - (b + d)
            oe[j] = (a - c) - (b - d)
            oo[j] = (a - c) + (b - d)


@njit(cache=True, fastmath=True, nogil=True)
def _add_unfolded_power(parts, power):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Add the power of even plus odd parts ``(2, H, 2H)`` to all quadrants of ``power (2H, 2H)``.

    The first axis is the parity along y; the columns are the even part along x, then the odd part.
    """
    half = parts.shape[1]
    for i in range(half):
        even, odd = parts[0, i], parts[1, i]
        up, down = power[half - 1 - i], power[half + i]
        for j in range(half):
            s, d = even[j] + odd[j], even[j] - odd[j]
            t, e = even[half + j] + odd[half + j], even[half + j] - odd[half + j]
            p, q, r, m = s + t, s - t, d + e, d - e
            down[half + j] += p.real * p.real + p.imag * p.imag
            down[half - 1 - j] += q.real * q.real + q.imag * q.imag
            up[half + j] += r.real * r.real + r.imag * r.imag
            up[half - 1 - j] += m.real * m.real + m.imag * m.imag


def image_matrix(n: int, n_grid: int, shift: float) -> NDArray[np.complex128]:
    """Matrix ``(n_grid, n)`` from pupil samples to the images ``+-shift`` samples away, along one axis.

    Zero padding, Fourier transform, the factor ``exp(-2 i pi shift |k|)`` and inverse transform in one:
    ``sum_k exp(2 i pi k (u - p) - 2 i pi shift |k|) / n_grid``, with ``u`` and ``p`` from the centre.
    """
    k = frequencies(n_grid)
    u = np.arange(n_grid) - (n_grid - 1) / 2
    p = np.arange(n) - (n - 1) / 2
    to_image = np.exp(2j * np.pi * np.outer(u, k) - 2j * np.pi * shift * np.abs(k)) / n_grid
    return np.asarray(to_image @ np.exp(-2j * np.pi * np.outer(k, p)))


def _symmetric_halves(matrix: NDArray[np.complex128]) -> NDArray[np.complex64]:
    """Action of the symmetric :func:`image_matrix` on even and odd inputs: ``(2, n_grid / 2, n / 2)``."""
    rows, columns = matrix.shape[0] // 2, matrix.shape[1] // 2
    same_side, opposite_side = matrix[rows:, columns:], matrix[rows:, columns - 1 :: -1]
    return np.stack([same_side + opposite_side, same_side - opposite_side]).astype(np.complex64)


class SeparableKernel:
    """Power of a field behind the prism, summed over modulation points, by matrix products.

    With the images on a rectangle the transmission is ``m(x) m(y)`` and the propagation is
    ``A field B^T``. Both matrices are symmetric under reversal, so even and odd parts of the field
    are propagated separately with half the work. Not thread-safe: use one kernel per thread.

    ``shift_x`` and ``shift_y`` are half the distances of the images in samples; ``n`` and ``n_grid``, the
    pupil samples and the grid around whose centre the images are, are even.
    """

    def __init__(self, shift_x: float, shift_y: float, n: int, n_grid: int) -> None:
        h, half = n // 2, n_grid // 2
        self.shape = (n_grid, n_grid)
        self._n = n
        self._along_x = np.ascontiguousarray(
            _symmetric_halves(image_matrix(n, n_grid, shift_x)).transpose(0, 2, 1)
        )
        # The four sums of a fold each count a sample four times.
        self._along_y = _symmetric_halves(image_matrix(n, n_grid, shift_y)) / np.complex64(4)
        self._folded = np.empty((2, n, h), np.complex64)
        self._half = np.empty((2, n, half), np.complex64)
        self._rows = np.empty((2, h, n_grid), np.complex64)
        self._parts = np.empty((2, half, n_grid), np.complex64)

    def tilts(self, cycles: NDArray[np.float64]) -> NDArray[np.complex64]:
        """Factors ``(k, n / 2)`` for tilts in cycles of phase per sample ``(k,)``."""
        samples = np.arange(self._n // 2) + 0.5
        return np.asarray(np.exp(2j * np.pi * np.outer(cycles, samples)), np.complex64)

    def add(
        self,
        field: NDArray[np.complex64],
        tilts_x: NDArray[np.complex64],
        tilts_y: NDArray[np.complex64],
        power: NDArray[np.float32],
    ) -> None:
        """Add the power of ``field (n, n)`` under each tilt to ``power``, of shape ``self.shape``."""
        half = self.shape[0] // 2
        h = self._n // 2
        for tilt_x, tilt_y in zip(tilts_x, tilts_y, strict=True):
            _fold_parity(field, tilt_y, tilt_x, self._folded)
            np.matmul(self._folded, self._along_x, out=self._half)
            for parity in range(2):
                self._rows[:, :, parity * half : (parity + 1) * half] = self._half[parity].reshape(2, h, half)
            np.matmul(self._along_y, self._rows, out=self._parts)
            _add_unfolded_power(self._parts, power)


#: Threads that share the modulation points of a frame; fixed, so that rounding is the same everywhere.
WORKERS = 2


class PyramidOptics(ModulatedOptics):
    """Pyramid sensor: four images of the pupil on one camera.

    A camera pixel is one pupil sample, or a whole number of them. A positive slope of the optical path
    along x moves the image to +x on the pyramid, whose light goes to the right-hand images. The images
    are not mirrored. Conventions as in OOPAO's ``Pyramid``, except that a tilt of one lambda/D is one
    wave across the pupil's diameter; OOPAO's is one wave between the centres of the outermost samples.
    Not thread-safe, although it uses two threads.

    Parameters
    ----------
    amplitude
        Pupil amplitude ``(n, n)``, ``n`` even.
    diameter_px
        Diameter of a pupil image in camera pixels, which defines lambda/D.
    centres_px
        Centres ``(4, 2)`` as (x, y) of the pupil images on the region in camera pixels: upper left,
        upper right, lower left, lower right.
    shape
        Camera region (rows, columns). Light outside it is lost.
    rooftop
        Length in lambda/D of the ridge that replaces the apex; negative for the other diagonal.
    samples
        Pupil samples across a camera pixel.
    grid_px
        Side of the periodic grid in camera pixels; by default the next fast length for the region.

    Raises
    ------
    ValueError
        Amplitude, samples, grid or images are inconsistent.
    """

    def __init__(
        self,
        amplitude: NDArray[np.float32],
        diameter_px: float,
        wavelength_m: float,
        centres_px: NDArray[np.float64],
        shape: tuple[int, int],
        modulation: ModulationPath,
        *,
        rooftop: float = 0.0,
        samples: int = 1,
        grid_px: int | None = None,
    ) -> None:
        n = amplitude.shape[0]
        if amplitude.shape != (n, n) or n % 2:
            raise ValueError(f"amplitude has shape {amplitude.shape}; it must be square, of even side")
        if samples < 1 or not diameter_px > 0:
            raise ValueError(f"{samples} samples per pixel, {diameter_px} pixels; both must be positive")
        super().__init__(amplitude, shape)
        self._diameter, self.wavelength_m = diameter_px * samples, wavelength_m
        grid = next_fast_length(max(shape), samples) if grid_px is None else grid_px
        if grid * samples < n or grid * samples % 2:
            raise ValueError(
                f"a grid of {grid} pixels has {grid * samples} samples; it must have {n} or more, even"
            )
        self._region_on_camera = GridRegion(np.asarray(centres_px, dtype=float), shape, grid, samples)
        self.prism = Prism(self._region_on_camera.shifts(n), self._diameter, rooftop)
        self._kernels = self._make_kernels(n, grid * samples)
        self._field = np.empty((n, n), np.complex64)
        self._power = np.empty((WORKERS, *self._kernels[0].shape), np.float32)
        self._executor = ThreadPoolExecutor(WORKERS - 1, "pyramid") if helper_threads_allowed() else None
        self.modulation = modulation

    def _apply_modulation(self, modulation: ModulationPath) -> None:
        kernel = self._kernels[0]
        tilts_per_sample = modulation.points / self._diameter
        x, y = kernel.tilts(tilts_per_sample[:, 0]), kernel.tilts(tilts_per_sample[:, 1])
        y *= np.float32(np.sqrt(modulation.weight))
        self._tilts = [(x[k::WORKERS], y[k::WORKERS]) for k in range(WORKERS)]

    @property
    def uses_matrix_products(self) -> bool:
        """Whether the light is propagated by matrix products instead of Fourier transforms."""
        return isinstance(self._kernels[0], SeparableKernel)

    def _add_intensity(self, opd_m: NDArray[np.floating], out: NDArray[np.floating]) -> None:
        opd = np.ascontiguousarray(opd_m, dtype=np.float32)
        field = self._field.view(np.float32).reshape(-1, 2)
        pupil_field(opd.ravel(), 1 / self.wavelength_m, self.amplitude.ravel(), field)
        if self._executor is None:
            for k in range(WORKERS):
                self._propagate_share(k)
        else:
            futures = [self._executor.submit(self._propagate_share, k) for k in range(1, WORKERS)]
            self._propagate_share(0)
            for future in futures:
                future.result()
        for power in self._power:
            self._region_on_camera.add(power, out)

    def _propagate_share(self, worker: int) -> None:
        """Compute the power of one worker's modulation points."""
        power = self._power[worker]
        power.fill(0)
        self._kernels[worker].add(self._field, *self._tilts[worker], power)

    def _make_kernels(self, n: int, n_grid: int) -> list[SeparableKernel] | list[FourierKernel]:
        half_distances = self.prism.half_distances((n_grid - n) / 2)
        if half_distances is not None and _matrix_product_is_faster(n, n_grid):
            return [SeparableKernel(*half_distances, n, n_grid) for _ in range(WORKERS)]
        return [FourierKernel(self.prism, n, n_grid, self._region_on_camera.rows) for _ in range(WORKERS)]


class GridRegion:
    """Position on a camera region ``shape`` of a square grid around pupil images ``centres_px (4, 2)``.

    The square has ``grid`` camera pixels with ``samples`` samples across each.
    """

    def __init__(
        self, centres_px: NDArray[np.float64], shape: tuple[int, int], grid: int, samples: int
    ) -> None:
        # The square is centred on the images, shifted to cover the region if it is large enough.
        first = np.round(centres_px.mean(axis=0) + 0.5 - grid / 2).astype(int)
        for axis, length in enumerate(shape[::-1]):
            if grid >= length:
                first[axis] = np.clip(first[axis], length - grid, 0)
        self._samples, self.first = samples, first
        self._centres = centres_px
        first_inside = np.maximum(first, 0)
        end_inside = np.minimum(first + grid, shape[::-1])
        self._region = tuple(slice(a, b) for a, b in zip(first_inside[::-1], end_inside[::-1], strict=True))
        self._part = tuple(
            slice(a * samples, b * samples)
            for a, b in zip((first_inside - first)[::-1], (end_inside - first)[::-1], strict=True)
        )
        self.rows = int(self._part[0].stop)

    def shifts(self, n: int) -> NDArray[np.float64]:
        """Shift ``(4, 2)`` in samples of the images from a pupil of ``n`` samples in the grid's corner."""
        centres = (self._centres - self.first + 0.5) * self._samples - 0.5
        return np.asarray(centres - (n - 1) / 2)

    def add(self, power: NDArray[np.floating], image: NDArray[np.floating]) -> None:
        """Add the part of ``power`` on the region to ``image``, samples summed to pixels."""
        part, s = power[self._part], self._samples
        if s > 1:
            rows, columns = part.shape
            part = part.reshape(rows // s, s, columns // s, s).sum(axis=(1, 3))
        image[self._region] += part


def _matrix_product_is_faster(n: int, n_grid: int) -> bool:
    """Whether matrix products are faster than transforms, from operation counts and measured rates.

    Products run at 85 Gflop/s plus 20 us for folding; transforms at 40 Gflop/s, or 17 for slow lengths,
    plus 0.8 ns per sample of the grid.
    """
    products = 4 * (n * n * n_grid + n * n_grid**2) / 85e9 + 20e-6
    rate = 40e9 if is_fast_length(n_grid) else 17e9
    transforms = (n + 3 * n_grid) * 5 * n_grid * np.log2(n_grid) / rate + 0.8e-9 * n_grid**2
    return bool(products < transforms)
