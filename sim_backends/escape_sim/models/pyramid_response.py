"""Derivatives of pyramid slopes by the phase, at a flat wavefront or averaged over Gaussian turbulence."""

from __future__ import annotations

from collections.abc import Iterator
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


@njit(cache=True, fastmath=True, nogil=True)
def _shifted_kernel(kernel, row, column, light, out):  # type: ignore[no-untyped-def]  # pragma: no cover
    """``out[i, j] = conj(kernel[row - i, column - j]) light[i, j]``."""
    for i in range(light.shape[0]):
        line, amplitude, target = kernel[row - i], light[i], out[i]
        for j in range(amplitude.size):
            target[j] = line[column - j].conjugate() * amplitude[j]


class ModulatedCorrelations:
    """Correlations of a modulation without turbulence: matrix products over its points.

    Correlations are means of ``conj(E(u)) f(p) / A(p)`` for the field ``E`` at a pixel and the pupil
    field ``f``. Parameters as for :func:`slope_response`; ``light`` is the pupil amplitude ``(n, n)``.
    """

    def __init__(
        self, light: NDArray[np.float32], prism: Prism, n_grid: int, modulation: ModulationPath
    ) -> None:
        n = len(light)
        at = np.arange(n) - (n - 1) / 2
        x, y = modulation.points.T[:, :, None, None] / prism.diameter
        tilts = np.exp(2j * np.pi * (y * at[:, None] + x * at))
        tilts *= np.sqrt(modulation.weights)[:, None, None]
        # The frequencies are half-integers, those of the transform integers.
        carrier = np.exp(-2j * np.pi * frequencies(n_grid)[0] * np.arange(n_grid))
        prism_filter = FourierFilter(prism.mask(n_grid) / n_grid**2, n, n_grid)
        self._fields = np.empty((n_grid, n_grid, modulation.n_points), np.complex64)
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
    """Correlations of a modulation under turbulence: one convolution with the coherence per pixel.

    ``light`` is the pupil amplitude ``(n, n)``, ``kernel`` the point response from :func:`_prism_kernel`,
    ``mean`` the :func:`coherence`, to which ``variation`` is added where the phase varies more. Not
    thread-safe.
    """

    def __init__(
        self,
        light: NDArray[np.float32],
        kernel: NDArray[np.complex64],
        mean: NDArray[np.complex128],
        variation: CoherenceVariation | None = None,
    ) -> None:
        self._filter = _convolution(mean, len(light))
        self._light, self._kernel, self._variation = light, kernel, variation
        self._variation_filter = None if variation is None else _convolution(variation.difference, len(light))

    def correlations(self, pixels: NDArray[np.intp]) -> Iterator[NDArray[np.complex64]]:
        """Yield ``n`` rows of ``n`` or more samples for each (row, column) ``u`` in ``pixels``."""
        n, filter_, variation_filter = len(self._light), self._filter, self._variation_filter
        for row, column in pixels:
            _shifted_kernel(self._kernel, n - 1 + row, n - 1 + column, self._light, filter_.field)
            filter_.run()
            result = filter_.result[:n, :n]
            if variation_filter is not None and self._variation is not None:
                # With s(p, q) = (s(p) + s(q)) / 2, half the share is on either side of the convolution.
                half_share = self._variation.half_share
                variation_filter.field[:n, :n] = filter_.field[:n, :n]
                variation_filter.run()
                result += half_share * variation_filter.result[:n, :n]
                variation_filter.field[:n, :n] *= half_share
                variation_filter.run()
                result += variation_filter.result[:n, :n]
            yield filter_.result


PixelCorrelations = ModulatedCorrelations | TurbulentCorrelations


@dataclass(frozen=True, slots=True, eq=False)
class CoherenceVariation:
    """Coherence interpolated between two: half the weight of the second, and its difference to the first.

    ``half_share`` is ``(n, n)`` and ``difference`` ``(2 n - 1, 2 n - 1)``, see :func:`coherence`.
    """

    half_share: NDArray[np.float32]
    difference: NDArray[np.complex128]


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

    Parameters
    ----------
    n, diameter
        Samples across the pupil's array, and pupil diameter in samples.
    modulation
        Path of the image over the pyramid.
    structure
        Structure function ``(2 n - 1, 2 n - 1)`` of the turbulence in rad^2, at distances ``p - q`` from
        ``-(n - 1)`` to ``n - 1`` samples along y and x.
    """
    steps = np.arange(1 - n, n)
    x, y = (np.exp(2j * np.pi * np.outer(steps, t) / diameter) for t in modulation.points.T)
    # Characteristic function of a Gaussian phase.
    return np.asarray((y * modulation.weights) @ x.T * np.exp(-0.5 * structure))


#: Threads that share the pixels.
_WORKERS = 2
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
class NonuniformPhase:
    """Gaussian phases whose variance depends on the position in the pupil.

    Parameters
    ----------
    structure
        Mean structure function ``(2 n - 1, 2 n - 1)`` in rad^2.
    strength
        Factor ``(n, n)`` on it at each sample, 1 on average.
    """

    structure: NDArray[np.float64]
    strength: NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class SlopeResponse:
    """Slopes of a flat wavefront and their derivatives by the phase.

    Parameters
    ----------
    flat
        Slopes ``(n_slopes,)``, all x then all y.
    phase_derivatives
        Derivatives ``(n_slopes, m * m)`` in 1 / rad, by the phase at the nodes, rows along y.
    """

    flat: NDArray[np.float64]
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
    nonuniform: NonuniformPhase | None = None,
    interpolation: NDArray[np.float32] | None = None,
    samples: int = 1,
    local: bool = False,
) -> SlopeResponse:
    """Compute the derivatives of all slopes by the phase.

    With ``a(d)`` the point response of the prism, the field of one modulation point is ``E(u) = sum_p
    a(u - p) f(p)``, so ``dI(u)/dphi(p) = -2 Im(a(u - p) conj(E(u)) f(p))``. The mean of ``conj(E(u))
    f(p)`` over modulation points is a matrix product; over Gaussian phases it is, exactly, the
    convolution ``A(p) sum_q conj(a(u - q)) A(q) C(p - q)`` with the coherence ``C``. The
    normalisation is differentiated too; under turbulence the mean of a quotient is approximated by the
    quotient of the means.

    Parameters
    ----------
    amplitude
        Pupil amplitude ``(n, n)``.
    prism
        Faces, for a pupil in the grid's corner.
    n_grid
        Side of the periodic grid in samples.
    corners
        First camera pixel ``(4, 2)`` as (x, y) of each image's box, from the grid's corner.
    valid
        Valid pixels of a box ``(m, m)``.
    modulation
        Path of the image over the pyramid.
    structure
        Structure function ``(2 n - 1, 2 n - 1)`` in rad^2 of the turbulence to average over, at
        distances from ``-(n - 1)`` to ``n - 1`` samples along y and x; none by default.
    nonuniform
        Further phases with position-dependent variance; requires ``structure``.
    interpolation
        Matrix ``(n, m)`` from the phase at nodes to the phase at samples, along either axis; by
        default the nodes are the samples.
    samples
        Pupil samples across a camera pixel.
    local
        Normalise by each pixel's own flux instead of the mean of all.

    Raises
    ------
    ValueError
        The boxes leave the grid.
    """
    light = np.ascontiguousarray(amplitude, dtype=np.float32)
    pixels_xy = np.argwhere(valid)
    first_samples = (corners[:, None, ::-1] + pixels_xy) * samples
    if first_samples.min() < 0 or first_samples.max() + samples > n_grid:
        raise ValueError("the pupil images leave the periodic grid; enlarge the camera region")
    m = len(light) if interpolation is None else interpolation.shape[1]
    sums = _Sums(
        np.empty((2, len(pixels_xy), m, m), np.float32),
        np.zeros((3, len(pixels_xy))),
        np.zeros((len(pixels_xy) if local else _WORKERS, m, m), np.float32),
    )
    kernel = _prism_kernel(prism, len(light), n_grid)
    correlations: list[PixelCorrelations]
    if structure is None:
        correlations = [ModulatedCorrelations(light, prism, n_grid, modulation)] * _WORKERS
    else:
        mean, variation = _mean_and_varying_coherence(
            len(light), prism.diameter, modulation, structure, nonuniform
        )
        correlations = [TurbulentCorrelations(light, kernel, mean, variation) for _ in range(_WORKERS)]
    task = _ResponseTask(kernel, light, _spans(light), first_samples, samples, interpolation, sums)
    parts = np.array_split(np.arange(len(pixels_xy)), _WORKERS)
    # Each worker multiplies matrices on its own thread.
    with limit_to_one_thread(), ThreadPoolExecutor(_WORKERS) as pool:
        for future in [pool.submit(task.run, correlations[k], part, k) for k, part in enumerate(parts)]:
            future.result()
    return sums.normalise(local)


def _mean_and_varying_coherence(
    n: int,
    diameter: float,
    modulation: ModulationPath,
    structure: NDArray[np.float64],
    nonuniform: NonuniformPhase | None,
) -> tuple[NDArray[np.complex128], CoherenceVariation | None]:
    """Coherence of the least varying quarter of the pupil, and what is added where phases vary more.

    Between two samples the strength is the mean of both, and the coherence is taken as linear in it.
    """
    if nonuniform is None:
        return coherence(n, diameter, modulation, structure), None
    low, high = np.percentile(nonuniform.strength, (25, 75))
    weak, strong = (
        coherence(n, diameter, modulation, structure + level * nonuniform.structure) for level in (low, high)
    )
    half = (nonuniform.strength - low) / (2 * max(high - low, 1e-6))
    return weak, CoherenceVariation(half.astype(np.float32), strong - weak)


@dataclass(frozen=True, slots=True, eq=False)
class _Sums:
    """Differences of images and their derivatives, not yet normalised.

    ``phase_derivatives (2, n_valid, m, m)`` for x and y; ``light (3, n_valid)`` is the x difference, the y
    difference and the sum; ``total`` holds the derivative of each pixel's sum, or of all pixels' sum
    in one part per worker.
    """

    phase_derivatives: NDArray[np.float32]
    light: NDArray[np.float64]
    total: NDArray[np.float32]

    def normalise(self, local: bool) -> SlopeResponse:
        """Slopes and their derivatives; works in place."""
        n = self.light.shape[1]
        norm = self.light[2] if local else np.full(n, self.light[2].mean())
        flat = self.light[:2] / norm
        by_norm = self.total if local else self.total.sum(axis=0, keepdims=True) / np.float32(n)
        for axis, phase_derivatives in enumerate(self.phase_derivatives):
            for k, row in enumerate(phase_derivatives):
                row -= np.float32(flat[axis, k]) * by_norm[k if local else 0]
                row /= np.float32(norm[k])
        return SlopeResponse(flat.ravel(), self.phase_derivatives.reshape(2 * n, -1))


@dataclass(frozen=True, slots=True, eq=False)
class _ResponseTask:
    """Inputs and outputs shared by the workers of :func:`slope_response`."""

    kernel: NDArray[np.complex64]
    light: NDArray[np.float32]
    spans: NDArray[np.intp]
    first_samples: NDArray[np.intp]
    samples: int
    interpolation: NDArray[np.float32] | None
    sums: _Sums

    def run(self, pixel_correlations: PixelCorrelations, pixels: NDArray[np.intp], worker: int) -> None:
        """Compute the sums of ``pixels``."""
        n, s, out = len(self.light), self.samples, self.sums
        local = len(out.total) == out.light.shape[1]
        inner = np.stack(np.divmod(np.arange(s * s), s), axis=1)
        sums = np.zeros((3, n, n), np.float32)
        for k in pixels:
            sums[: 3 if local else 2] = 0
            pixels_xy = (self.first_samples[:, k, None] + inner).reshape(-1, 2)
            for i, correlations in enumerate(pixel_correlations.correlations(pixels_xy)):
                row, column = pixels_xy[i] + (n - 1)
                signs = _SIGNS[i // (s * s)]
                light = _add_pixel_response(
                    self.kernel, row, column, self.light, correlations, self.spans, signs, sums
                )
                out.light[:, k] += signs[0] * light, signs[1] * light, light
            out.phase_derivatives[:, k] = self._to_nodes(sums[:2])
            if local:
                out.total[k] = self._to_nodes(sums[2])
        if not local:
            out.total[worker] = self._to_nodes(sums[2])

    def _to_nodes(self, by_sample: NDArray[np.float32]) -> NDArray[np.float32]:
        """Convert derivatives by the phase at samples to those by the phase at nodes."""
        if self.interpolation is None:
            return by_sample
        return np.asarray(self.interpolation.T @ (by_sample @ self.interpolation))


def _spans(light: NDArray[np.float32]) -> NDArray[np.intp]:
    """First lit column of each row and the one after the last ``(n, 2)``."""
    return np.stack(lit_columns(np.asarray(light > 0)), axis=1)


def _prism_kernel(prism: Prism, n: int, n_grid: int) -> NDArray[np.complex64]:
    """Field at ``u`` of a point at ``p``, for ``u - p`` from ``1 - n`` to ``n_grid - 1`` along y and x."""
    mask = np.fft.ifft2(prism.mask(n_grid))
    steps = np.arange(1 - n, n_grid)
    # The frequencies are half-integers: the field changes sign after a period.
    carrier = np.exp(2j * np.pi * frequencies(n_grid)[0] * steps)
    return np.asarray(mask[np.ix_(steps % n_grid, steps % n_grid)] * np.outer(carrier, carrier), np.complex64)
