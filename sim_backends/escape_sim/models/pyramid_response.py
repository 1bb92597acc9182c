"""Derivatives of pyramid slopes by the phase, at a flat wavefront or averaged over Gaussian turbulence."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from escape_hw.api.concurrency import limit_to_one_thread
from escape_sim.atmosphere.von_karman import lit_columns
from escape_sim.optics.fourier_filter import FourierFilter, next_fast_length
from escape_sim.optics.modulation import ModulationPath
from escape_sim.optics.pyramid import Prism, frequencies

#: Pupil field ``(n, n)``: the amplitude, complex about a wavefront that is not flat.
_Light = NDArray[np.float32] | NDArray[np.complex64]


@njit(cache=True, fastmath=True, nogil=True)
def _shifted_kernel(kernel, row, column, light, out):  # type: ignore[no-untyped-def]  # pragma: no cover
    """``out[i, j] = conj(kernel[row - i, column - j] light[i, j])``."""
    for i in range(light.shape[0]):
        line, amplitude, target = kernel[row - i], light[i], out[i]
        for j in range(amplitude.size):
            target[j] = (line[column - j] * amplitude[j]).conjugate()


class ModulatedCorrelations:
    """Correlations of a modulation without turbulence: matrix products over its points.

    Correlations are means of ``conj(E(u)) f(p) / A(p)`` for the field ``E`` at a pixel and the pupil
    field ``f``. Parameters as for :func:`slope_response`; ``light`` is the pupil field ``(n, n)``.
    """

    def __init__(self, light: _Light, prism: Prism, n_grid: int, modulation: ModulationPath) -> None:
        n = len(light)
        at = np.arange(n) - (n - 1) / 2
        x, y = modulation.points.T[:, :, None, None] / prism.diameter
        tilts = np.exp(2j * np.pi * (y * at[:, None] + x * at))
        tilts *= np.sqrt(modulation.weight)
        # The frequencies are half-integers, those of the transform integers.
        carrier = np.exp(-2j * np.pi * frequencies(n_grid)[0] * np.arange(n_grid))
        prism_filter = FourierFilter(prism.mask(n_grid) / n_grid**2, n, n_grid)
        self._fields = np.empty((n_grid, n_grid, len(modulation.points)), np.complex64)
        for k, tilt in enumerate(tilts):
            prism_filter.field[:, :n] = light * tilt * np.outer(carrier[:n], carrier[:n])
            prism_filter.run()
            self._fields[:, :, k] = prism_filter.result[:, :n_grid].conj() * np.outer(carrier, carrier)
        self._tilts = tilts.reshape(len(tilts), -1).astype(np.complex64)
        self._n = n

    def correlations(self, pixels: NDArray[np.intp]) -> Iterator[NDArray[np.complex64]]:
        """Yield ``n`` rows of ``n`` or more samples for each (row, column) ``u`` in ``pixels``."""
        fields = self._fields[pixels[:, 0], pixels[:, 1]]
        yield from (fields @ self._tilts).reshape(-1, self._n, self._n)


class TurbulentCorrelations:
    """Correlations of a modulation under stationary turbulence: one convolution with the coherence per pixel.

    ``light`` is the pupil field ``(n, n)``, ``kernel`` the point response from :func:`_prism_kernel`,
    ``mean`` the :func:`coherence`. Not thread-safe.
    """

    def __init__(self, light: _Light, kernel: NDArray[np.complex64], mean: NDArray[np.complex128]) -> None:
        self._filter = _convolution(mean, len(light))
        self._light, self._kernel = light, kernel

    def correlations(self, pixels: NDArray[np.intp]) -> Iterator[NDArray[np.complex64]]:
        """Yield ``n`` rows of ``n`` or more samples for each (row, column) ``u`` in ``pixels``."""
        n, filter_ = len(self._light), self._filter
        for row, column in pixels:
            _shifted_kernel(self._kernel, n - 1 + row, n - 1 + column, self._light, filter_.field)
            filter_.run()
            yield filter_.result


class PairCoherence:
    """Mean of ``exp(i (phi(p) - phi(q)))`` of all pairs of lit samples, for phases that are not stationary.

    Where it is real, and the pupil and the phases are symmetric about the centre, even and odd fields do not
    mix. They are multiplied separately, which is half of the work.

    Parameters
    ----------
    lit
        Lit samples ``(n, n)``; the ``k`` of them are in the order of their rows.
    diameter
        Samples across the pupil.
    modulation
        Path of the image over the pyramid.
    structure
        Structure function of the phases ``(k, k)`` in rad^2.
    """

    def __init__(
        self,
        lit: NDArray[np.bool_],
        diameter: float,
        modulation: ModulationPath,
        structure: NDArray[np.float32],
    ) -> None:
        self.rows, self.columns = np.nonzero(lit)
        at = np.stack([self.columns, self.rows], axis=1) * (2 * np.pi / diameter)
        tilts = np.exp(1j * at @ modulation.points.T) * np.sqrt(modulation.weight)
        coherence = tilts.conj() @ tilts.T
        # A circle or an ellipse is symmetric, and its coherence real.
        if np.abs(coherence.imag).max() < _NEGLIGIBLE_PART:
            coherence = coherence.real
        single = np.float32 if np.isrealobj(coherence) else np.complex64
        # Characteristic function of a Gaussian phase.
        coherence = coherence.astype(single) * np.exp(np.float32(-0.5) * structure)
        self._parts: tuple[NDArray[np.floating | np.complexfloating], ...] = (coherence,)
        half, odd = divmod(len(coherence), 2)
        is_symmetric = not odd and np.isrealobj(coherence) and np.array_equal(lit, lit[::-1, ::-1])
        if is_symmetric and np.abs(coherence - coherence[::-1, ::-1]).max() < _ROUNDING:
            within, across = coherence[:half, :half], coherence[:half, : half - 1 : -1]
            self._parts = (within + across) / 2, (within - across) / 2

    def products(self, fields: NDArray[np.complex64]) -> NDArray[np.complex64]:
        """Products ``(count, k)`` of fields ``(count, k)`` with the coherence ``(k, k)``."""
        if not np.isrealobj(self._parts[0]):
            return np.asarray(fields @ self._parts[0])
        count = len(fields)
        parts = np.concatenate([fields.real, fields.imag])
        if len(self._parts) == 1:
            parts = parts @ self._parts[0]
        else:
            half = parts.shape[1] // 2
            first, second = parts[:, :half], parts[:, : half - 1 : -1]
            even, odd = (first + second) @ self._parts[0], (first - second) @ self._parts[1]
            parts = np.concatenate([even + odd, (even - odd)[:, ::-1]], axis=1)
        return np.asarray(parts[:count] + 1j * parts[count:])


class PairwiseCorrelations:
    """Correlations of a modulation under phases that are not stationary: products with all pairs' coherence.

    ``light`` and ``kernel`` are as for :class:`TurbulentCorrelations`, ``pairs`` is the coherence of the lit
    samples.
    """

    def __init__(self, light: _Light, kernel: NDArray[np.complex64], pairs: PairCoherence) -> None:
        self._kernel, self._lit, self._pairs = kernel, light != 0, pairs
        self._light = light[self._lit].conj()

    def correlations(self, pixels: NDArray[np.intp]) -> Iterator[NDArray[np.complex64]]:
        """Yield ``n`` rows of ``n`` samples for each (row, column) ``u`` in ``pixels``."""
        n = len(self._lit)
        at = pixels[:, :, None] + (n - 1)
        fields = self._kernel[at[:, 0] - self._pairs.rows, at[:, 1] - self._pairs.columns].conj()
        result = np.zeros((n, n), np.complex64)
        for product in self._pairs.products(fields * self._light):
            result[self._lit] = product
            yield result


def _convolution(kernel: NDArray[np.complex128], n: int) -> FourierFilter:
    """Convolution of fields of ``n`` samples with a kernel ``(2 n - 1, 2 n - 1)``."""
    size = next_fast_length(2 * n - 1)
    padded = np.zeros((size, size), complex)
    steps = np.arange(1 - n, n) % size
    padded[np.ix_(steps, steps)] = kernel
    return FourierFilter(np.fft.fft2(padded) / size**2, n, n)


def coherence(
    n: int, diameter: float, modulation: ModulationPath, structure: NDArray[np.float64]
) -> NDArray[np.complex128]:
    """Mean of ``exp(i (phi(p) - phi(q)))`` over modulation and turbulence ``(2 n - 1, 2 n - 1)``.

    ``n`` and ``diameter`` are the samples across the pupil's array and across the pupil; ``structure`` is as
    for :func:`slope_response`.
    """
    steps = np.arange(1 - n, n)
    x, y = (np.exp(2j * np.pi * np.outer(steps, t) / diameter) for t in modulation.points.T)
    # Characteristic function of a Gaussian phase.
    return np.asarray((y * modulation.weight) @ x.T * np.exp(-0.5 * structure))


#: Correlations of the field at pixels with that in the pupil, of one of three kinds.
_Correlations = ModulatedCorrelations | TurbulentCorrelations | PairwiseCorrelations
#: Threads that share the pixels.
_WORKERS = 2
#: Camera pixels whose correlations are computed together: enough for an efficient matrix product.
_BLOCK = 16
#: Imaginary part of a coherence that is due to rounding; the same of its asymmetry in single precision.
_NEGLIGIBLE_PART, _ROUNDING = 1e-9, 1e-4
#: Sign of each image in the x and the y slope: upper left, upper right, lower left, lower right.
_SIGNS = np.array([[-1, -1], [1, -1], [-1, 1], [1, 1]], np.float32)


@njit(cache=True, fastmath=True, nogil=True)
def _add_pixel_response(kernel, row, column, light, correlations, spans, weights, sums):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Add ``-2 Im(kernel light correlations)``, by ``weights``, to ``sums (3, n, n)``: x, y and total.

    Returns the intensity of the pixel: the sum of the real part.
    """
    intensity = np.float64(0)
    for i in range(light.shape[0]):
        line, field, amplitude = kernel[row - i], correlations[i], light[i]
        to_x, to_y, to_total = sums[0, i], sums[1, i], sums[2, i]
        power = np.float32(0)
        for j in range(spans[i, 0], spans[i, 1]):
            value = line[column - j] * field[j] * amplitude[j]
            power += value.real
            slope = np.float32(-2) * value.imag
            to_x[j] += weights[0] * slope
            to_y[j] += weights[1] * slope
            to_total[j] += slope
        intensity += power
    return intensity


@dataclass(frozen=True, slots=True, eq=False)
class SlopeResponse:
    """Mean slopes ``mean (n_slopes,)``, all x then all y, and their derivatives.

    ``phase_derivatives (n_slopes, m * m)`` are by the phase at the nodes, rows along y, in 1 / rad.
    """

    mean: NDArray[np.float64]
    phase_derivatives: NDArray[np.float32]


def slope_response(
    amplitude: NDArray[np.floating],
    prism: Prism,
    n_grid: int,
    corners: NDArray[np.intp],
    valid: NDArray[np.bool_],
    modulation: ModulationPath,
    structure: NDArray[np.float64] | None = None,
    *,
    pairs: PairCoherence | None = None,
    interpolation: NDArray[np.float32] | None = None,
    samples: int = 1,
    local: bool = False,
    phase: NDArray[np.float64] | None = None,
) -> SlopeResponse:
    """Compute the derivatives of all slopes by the phase.

    With ``a(d)`` the point response of the prism, the field of one modulation point is ``E(u) = sum_p
    a(u - p) f(p)``, so ``dI(u)/dphi(p) = -2 Im(a(u - p) conj(E(u)) f(p))``. The mean of ``conj(E(u))
    f(p)`` over modulation points is a matrix product; over Gaussian phases it is, exactly, ``A(p) sum_q
    conj(a(u - q)) A(q) C(p, q)`` with the coherence ``C``: a convolution if the phases are stationary. The
    normalisation is differentiated too; under turbulence the mean of a quotient is approximated by the
    quotient of the means.

    Parameters
    ----------
    amplitude
        Pupil amplitude ``(n, n)``.
    prism, n_grid
        Faces, for a pupil in the grid's corner, and side of the periodic grid in samples.
    corners
        First camera pixel ``(4, 2)`` as (x, y) of each image's box, from the grid's corner.
    valid
        Valid pixels of a box ``(m, m)``.
    modulation
        Path of the image over the pyramid.
    structure
        Structure function ``(2 n - 1, 2 n - 1)`` in rad^2 of the turbulence to average over, at
        distances from ``-(n - 1)`` to ``n - 1`` samples along y and x; none by default.
    pairs
        Coherence of the lit samples under phases that are not stationary; in place of ``structure``, and
        with ``modulation`` applied.
    interpolation
        Matrix ``(n, m)`` from the phase at nodes to the phase at samples, along either axis; by
        default the nodes are the samples.
    samples
        Pupil samples across a camera pixel.
    local
        Normalise by each pixel's own flux instead of the mean of all.
    phase
        Phase ``(n, n)`` in radians about which the slopes are differentiated; flat by default.

    Raises
    ------
    ValueError
        The boxes leave the grid.
    """
    light: _Light = np.ascontiguousarray(amplitude, dtype=np.float32)
    if phase is not None:
        light = np.ascontiguousarray(light * np.exp(1j * phase), dtype=np.complex64)
    first_samples = (corners[:, None, ::-1] + np.argwhere(valid)) * samples
    if first_samples.min() < 0 or first_samples.max() + samples > n_grid:
        raise ValueError("the pupil images leave the periodic grid; enlarge the camera region")
    kernel = _prism_kernel(prism, len(light), n_grid)
    correlations: Sequence[_Correlations]
    if pairs is not None:
        correlations = [PairwiseCorrelations(light, kernel, pairs)] * _WORKERS
    elif structure is None:
        correlations = [ModulatedCorrelations(light, prism, n_grid, modulation)] * _WORKERS
    else:
        mean = coherence(len(light), prism.diameter, modulation, structure)
        correlations = [TurbulentCorrelations(light, kernel, mean) for _ in range(_WORKERS)]
    sums = _ResponseSums(kernel, light, first_samples, samples, interpolation, local)
    parts = np.array_split(np.arange(first_samples.shape[1]), _WORKERS)
    # Each worker multiplies matrices on its own thread.
    with limit_to_one_thread(), ThreadPoolExecutor(_WORKERS) as pool:
        for future in [pool.submit(sums.add, correlations[k], part, k) for k, part in enumerate(parts)]:
            future.result()
    return sums.normalise()


class _ResponseSums:
    """Differences of the images and their derivatives, summed by the workers of :func:`slope_response`."""

    def __init__(
        self,
        kernel: NDArray[np.complex64],
        light: _Light,
        first_samples: NDArray[np.intp],
        samples: int,
        interpolation: NDArray[np.float32] | None,
        local: bool,
    ) -> None:
        self._kernel, self._light, self._first_samples = kernel, light, first_samples
        self._samples, self._interpolation, self._local = samples, interpolation, local
        # First lit column of each row and the one after the last.
        self._spans = np.stack(lit_columns(np.asarray(light != 0)), axis=1)
        m, n_valid = len(light) if interpolation is None else interpolation.shape[1], first_samples.shape[1]
        self._derivatives = np.empty((2, n_valid, m, m), np.float32)
        # Difference along x, along y, and sum of each pixel's four images.
        self._power = np.zeros((3, n_valid))
        # Derivative of each pixel's sum, or of all pixels' sum in one part per worker.
        self._total = np.zeros((n_valid if local else _WORKERS, m, m), np.float32)

    def add(
        self,
        pixel_correlations: _Correlations,
        pixels: NDArray[np.intp],
        worker: int,
    ) -> None:
        """Compute the sums of ``pixels``."""
        n, s = len(self._light), self._samples
        inner = np.stack(np.divmod(np.arange(s * s), s), axis=1)
        sums = np.zeros((3, n, n), np.float32)
        for block in np.array_split(pixels, max(1, len(pixels) // _BLOCK)):
            at = np.moveaxis(self._first_samples[:, block, None] + inner, 0, 1).reshape(len(block), -1, 2)
            correlations = pixel_correlations.correlations(at.reshape(-1, 2))
            for k, positions in zip(block, at + (n - 1), strict=True):
                self._add_pixel(k, positions, correlations, sums)
        if not self._local:
            self._total[worker] = self._to_nodes(sums[2])

    def _add_pixel(
        self,
        k: int,
        positions: NDArray[np.intp],
        correlations: Iterator[NDArray[np.complex64]],
        sums: NDArray[np.float32],
    ) -> None:
        """Compute the sums of pixel ``k`` from the next correlations, those at ``positions (4 s^2, 2)``."""
        sums[: 3 if self._local else 2] = 0
        for i, (row, column) in enumerate(positions):
            signs = _SIGNS[i // self._samples**2]
            power = _add_pixel_response(
                self._kernel, row, column, self._light, next(correlations), self._spans, signs, sums
            )
            self._power[:, k] += signs[0] * power, signs[1] * power, power
        self._derivatives[:, k] = self._to_nodes(sums[:2])
        if self._local:
            self._total[k] = self._to_nodes(sums[2])

    def normalise(self) -> SlopeResponse:
        """Slopes and their derivatives; works in place."""
        n = self._power.shape[1]
        norm = self._power[2] if self._local else np.full(n, self._power[2].mean())
        flat = self._power[:2] / norm
        by_norm = self._total if self._local else self._total.sum(axis=0, keepdims=True) / np.float32(n)
        for axis, derivatives in enumerate(self._derivatives):
            for k, row in enumerate(derivatives):
                row -= np.float32(flat[axis, k]) * by_norm[k if self._local else 0]
                row /= np.float32(norm[k])
        return SlopeResponse(flat.ravel(), self._derivatives.reshape(2 * n, -1))

    def _to_nodes(self, by_sample: NDArray[np.float32]) -> NDArray[np.float32]:
        """Convert derivatives by the phase at samples to those by the phase at nodes."""
        if self._interpolation is None:
            return by_sample
        return np.asarray(self._interpolation.T @ (by_sample @ self._interpolation))


def _prism_kernel(prism: Prism, n: int, n_grid: int) -> NDArray[np.complex64]:
    """Field at ``u`` of a point at ``p``, for ``u - p`` from ``1 - n`` to ``n_grid - 1`` along y and x."""
    mask = np.fft.ifft2(prism.mask(n_grid))
    steps = np.arange(1 - n, n_grid)
    # The frequencies are half-integers: the field changes sign after a period.
    carrier = np.exp(2j * np.pi * frequencies(n_grid)[0] * steps)
    return np.asarray(mask[np.ix_(steps % n_grid, steps % n_grid)] * np.outer(carrier, carrier), np.complex64)
