"""Derivatives of pyramid slopes by the phase, in the mean over modulation and turbulence."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from escape_sim.fourier_filter import FourierFilter, good_length
from escape_sim.modulation import Modulation
from escape_sim.prism import Prism, frequencies

#: Threads that share the pixels.
_WORKERS = 2
#: Sign of each image in the x and the y slope: upper left, upper right, lower left, lower right.
_SIGNS = np.array([[-1, -1], [1, -1], [-1, 1], [1, 1]], np.float32)


@njit(cache=True, fastmath=True, nogil=True)
def _view(kernel, row, column, amplitude, out):  # type: ignore[no-untyped-def]  # pragma: no cover
    """``out[i, j] = conj(kernel[row - i, column - j]) amplitude[i, j]``."""
    for i in range(amplitude.shape[0]):
        line, light, target = kernel[row - i], amplitude[i], out[i]
        for j in range(light.size):
            target[j] = line[column - j].conjugate() * light[j]


@njit(cache=True, fastmath=True, nogil=True)
def _respond(kernel, row, column, amplitude, seen, lit, weights, x, y, total):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Add ``-2 Im(kernel seen amplitude)`` of the lit samples, by ``weights``, to ``x``, ``y``, ``total``.

    Returns the intensity of the pixel: the sum of the real part.
    """
    k = 0
    light = np.float64(0)
    for i in range(amplitude.shape[0]):
        line, field, row_light = kernel[row - i], seen[i], amplitude[i]
        for j in range(lit[i, 0], lit[i, 1]):
            value = line[column - j] * field[j] * row_light[j]
            light += value.real
            by = np.float32(-2) * value.imag
            x[k] += weights[0] * by
            y[k] += weights[1] * by
            total[k] += by
            k += 1
    return light


@dataclass(frozen=True, slots=True, eq=False)
class SlopeResponse:
    """Slopes of a flat wavefront and their derivatives by the phase.

    Parameters
    ----------
    flat
        Slopes ``(n_slopes,)``, all x then all y.
    by_phase
        Derivatives ``(n_slopes, n_lit)`` in 1 / rad, by the samples of ``lit`` in row-major order.
    lit
        Samples of the pupil that carry light ``(n, n)``.
    """

    flat: NDArray[np.float64]
    by_phase: NDArray[np.float32]
    lit: NDArray[np.bool_]


def coherence(
    n: int, diameter: float, modulation: Modulation, structure: NDArray[np.float64] | None = None
) -> NDArray[np.complex128]:
    """Mean of ``exp(i (phi(p) - phi(q)))`` over modulation and turbulence ``(2 n - 1, 2 n - 1)``.

    Parameters
    ----------
    n
        Samples across the pupil.
    diameter
        Pupil diameter in samples.
    modulation
        Path of the image over the pyramid.
    structure
        Structure function of the turbulence ``(2 n - 1, 2 n - 1)`` in square radians, at the
        distances ``p - q`` from ``-(n - 1)`` to ``n - 1`` along y and x.
    """
    steps = np.arange(1 - n, n)
    x, y = (np.exp(2j * np.pi * np.outer(steps, t) / diameter) for t in modulation.points.T)
    mean = (y * modulation.weights) @ x.T
    # A Gaussian phase: its characteristic function is all that is needed.
    return np.asarray(mean if structure is None else mean * np.exp(-0.5 * structure))


def slope_response(
    amplitude: NDArray[np.floating],
    prism: Prism,
    n_grid: int,
    corners: NDArray[np.intp],
    valid: NDArray[np.bool_],
    mean_coherence: NDArray[np.complex128],
    *,
    samples: int = 1,
    local: bool = False,
) -> SlopeResponse:
    """Derivatives of all slopes by all lit samples of the phase.

    With ``a(d)`` the spread of the prism, the field of one modulation point is ``E(u) = sum_p
    a(u - p) f(p)``, so ``dI(u)/dphi(p) = -2 Im(a(u - p) conj(E(u)) f(p))``. Its mean over phases is
    exact: with the coherence ``C(p - q)``, ``<conj(E(u)) f(p)> = A(p) sum_q conj(a(u - q)) A(q)
    C(p - q)``, a convolution for each pixel. Normalisation is differentiated too; with turbulence,
    the mean of a quotient is taken for the quotient of the means.

    Parameters
    ----------
    amplitude
        Pupil amplitude ``(n, n)``.
    prism
        Faces, as seen from a pupil in the grid's corner.
    n_grid
        Side of the periodic grid in samples.
    corners
        First camera pixel ``(4, 2)`` as (x, y) of each image's box, counted from the grid's corner.
    valid
        Valid pixels of a box ``(m, m)``.
    mean_coherence
        From :func:`coherence`.
    samples
        Pupil samples across a camera pixel.
    local
        Normalise by each pixel's own light instead of the mean of all.
    """
    n = amplitude.shape[0]
    light = np.ascontiguousarray(amplitude, dtype=np.float32)
    places = np.argwhere(valid)
    at = (corners[:, None, ::-1] + places) * samples
    if at.min() < 0 or at.max() + samples > n_grid:
        raise ValueError("the pupil images leave the grid that the light is followed on")
    lit = np.array(
        [[row.argmax(), row.size - row[::-1].argmax()] if row.any() else [0, 0] for row in light > 0]
    )
    width = int((lit[:, 1] - lit[:, 0]).sum())
    job = _Job(_spread(prism, n, n_grid), light, lit, _transfer(mean_coherence, n), at, samples)
    slopes = np.zeros((2, len(places), width), np.float32)
    # The light of each pixel: x and y difference and sum.
    values = np.zeros((3, len(places)))
    own = np.zeros((len(places) if local else _WORKERS, width), np.float32)
    halves = np.array_split(np.arange(len(places)), _WORKERS)
    with ThreadPoolExecutor(_WORKERS) as pool:
        for done in [pool.submit(job.run, part, slopes, values, own, k) for k, part in enumerate(halves)]:
            done.result()
    raw, norm = values[:2], values[2] if local else np.full(len(places), values[2].mean())
    flat = raw / norm
    by_norm = own if local else own.sum(axis=0, keepdims=True) / np.float32(len(places))
    for axis in range(2):
        slopes[axis] -= flat[axis].astype(np.float32)[:, None] * by_norm
        slopes[axis] /= norm.astype(np.float32)[:, None]
    inside = (np.arange(n) >= lit[:, :1]) & (np.arange(n) < lit[:, 1:])
    return SlopeResponse(flat.ravel(), slopes.reshape(-1, width), inside)


@dataclass(frozen=True, slots=True, eq=False)
class _Job:
    """What each worker needs to know."""

    kernel: NDArray[np.complex64]
    light: NDArray[np.float32]
    lit: NDArray[np.intp]
    transfer: NDArray[np.complex128]
    at: NDArray[np.intp]
    samples: int

    def run(
        self,
        pixels: NDArray[np.intp],
        slopes: NDArray[np.float32],
        values: NDArray[np.float64],
        own: NDArray[np.float32],
        worker: int,
    ) -> None:
        """Fill in ``pixels``: their slopes, their light, and the derivative of their light."""
        n = self.light.shape[0]
        convolution = FourierFilter(self.transfer, n, n)
        local = len(own) == slopes.shape[1]
        for k in pixels:
            total = own[k] if local else own[worker]
            for image, weights in enumerate(_SIGNS):
                row, column = self.at[image, k]
                for i in range(self.samples**2):
                    v = n - 1 + row + i // self.samples
                    u = n - 1 + column + i % self.samples
                    _view(self.kernel, v, u, self.light, convolution.field)
                    convolution.run()
                    light = _respond(
                        self.kernel, v, u, self.light, convolution.result, self.lit, weights,
                        slopes[0, k], slopes[1, k], total,
                    )  # fmt: skip
                    values[0, k] += weights[0] * light
                    values[1, k] += weights[1] * light
                    values[2, k] += light


def _spread(prism: Prism, n: int, n_grid: int) -> NDArray[np.complex64]:
    """Field at ``u`` of a point at ``p``, for ``u - p`` from ``1 - n`` to ``n_grid - 1`` along y and x."""
    mask = np.fft.ifft2(prism.mask(n_grid))
    steps = np.arange(1 - n, n_grid)
    # The frequencies are half-integers: a period on, the field has the other sign.
    carrier = np.exp(2j * np.pi * frequencies(n_grid)[0] * steps)
    return np.asarray(mask[np.ix_(steps % n_grid, steps % n_grid)] * np.outer(carrier, carrier), np.complex64)


def _transfer(mean_coherence: NDArray[np.complex128], n: int) -> NDArray[np.complex128]:
    """Fourier transform of the coherence on the smallest good grid that holds it, scale included."""
    size = good_length(2 * n - 1)
    wide = np.zeros((size, size), complex)
    steps = np.arange(1 - n, n) % size
    wide[np.ix_(steps, steps)] = mean_coherence
    return np.asarray(np.fft.fft2(wide) / size**2)
