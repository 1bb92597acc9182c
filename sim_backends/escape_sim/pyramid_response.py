"""Derivatives of pyramid slopes by the phase, at a flat wavefront or in the mean over turbulence."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from escape_sim.modulation import Modulation
from escape_sim.prism import Prism, frequencies
from escape_sim.pyramid_beams import Beams, Points, Turbulent, coherence

#: Threads that share the pixels.
_WORKERS = 2
#: Sign of each image in the x and the y slope: upper left, upper right, lower left, lower right.
_SIGNS = np.array([[-1, -1], [1, -1], [-1, 1], [1, 1]], np.float32)


@njit(cache=True, fastmath=True, nogil=True)
def _respond(spread, row, column, light, seen, spans, weights, x, y, total):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Add ``-2 Im(spread light seen)`` of the lit samples, by ``weights``, to ``x``, ``y``, ``total``.

    Returns the intensity of the pixel: the sum of the real part.
    """
    k = 0
    intensity = np.float64(0)
    for i in range(light.shape[0]):
        line, field, amplitude = spread[row - i], seen[i], light[i]
        power = np.float32(0)
        first, count = spans[i, 0], spans[i, 1] - spans[i, 0]
        to_x, to_y, to_total = x[k : k + count], y[k : k + count], total[k : k + count]
        for j in range(count):
            value = line[column - first - j] * field[first + j] * amplitude[first + j]
            power += value.real
            slope = np.float32(-2) * value.imag
            to_x[j] += weights[0] * slope
            to_y[j] += weights[1] * slope
            to_total[j] += slope
        intensity += power
        k += count
    return intensity


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
        Samples of the pupil between the first and the last that carry light in a row ``(n, n)``.
    """

    flat: NDArray[np.float64]
    by_phase: NDArray[np.float32]
    lit: NDArray[np.bool_]


def slope_response(
    amplitude: NDArray[np.floating],
    prism: Prism,
    n_grid: int,
    corners: NDArray[np.intp],
    valid: NDArray[np.bool_],
    modulation: Modulation,
    structure: NDArray[np.float64] | None = None,
    *,
    samples: int = 1,
    local: bool = False,
) -> SlopeResponse:
    """Derivatives of all slopes by all lit samples of the phase.

    With ``a(d)`` the spread of the prism, the field of one modulation point is ``E(u) = sum_p
    a(u - p) f(p)``, so ``dI(u)/dphi(p) = -2 Im(a(u - p) conj(E(u)) f(p))``. The mean of ``conj(E(u))
    f(p)`` over modulation points is a matrix product; over Gaussian phases it is, exactly, the
    convolution ``A(p) sum_q conj(a(u - q)) A(q) C(p - q)`` with the coherence ``C``. The
    normalisation is differentiated too; with turbulence, the mean of a quotient is taken for the
    quotient of the means.

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
    modulation
        Path of the image over the pyramid.
    structure
        Structure function ``(2 n - 1, 2 n - 1)`` in square radians of the turbulence to average
        over, at distances from ``-(n - 1)`` to ``n - 1`` samples along y and x; none by default.
    samples
        Pupil samples across a camera pixel.
    local
        Normalise by each pixel's own light instead of the mean of all.

    Raises
    ------
    ValueError
        The boxes leave the grid.
    """
    light = np.ascontiguousarray(amplitude, dtype=np.float32)
    places = np.argwhere(valid)
    at = (corners[:, None, ::-1] + places) * samples
    if at.min() < 0 or at.max() + samples > n_grid:
        raise ValueError("the pupil images leave the grid that the light is followed on")
    spans = _spans(light)
    width = int((spans[:, 1] - spans[:, 0]).sum())
    sums = _Sums(
        np.zeros((2, len(places), width), np.float32),
        np.zeros((3, len(places))),
        np.zeros((len(places) if local else _WORKERS, width), np.float32),
    )
    spread = _spread(prism, len(light), n_grid)
    beams: list[Beams]
    if structure is None:
        beams = [Points(light, prism, n_grid, modulation)] * _WORKERS
    else:
        mean = coherence(len(light), prism.diameter, modulation, structure)
        beams = [Turbulent(light, spread, mean) for _ in range(_WORKERS)]
    job = _Job(spread, light, spans, at, samples, sums)
    parts = np.array_split(np.arange(len(places)), _WORKERS)
    with ThreadPoolExecutor(_WORKERS) as pool:
        for done in [pool.submit(job.run, beams[k], part, k) for k, part in enumerate(parts)]:
            done.result()
    columns = np.arange(len(light))
    lit = (columns >= spans[:, :1]) & (columns < spans[:, 1:])
    return SlopeResponse(*sums.normalised(local), lit)


@dataclass(frozen=True, slots=True, eq=False)
class _Sums:
    """Differences of images and their derivatives, not normalised yet.

    ``by_phase (2, n_valid, n_lit)`` for x and y; ``light (3, n_valid)`` is the x difference, the y
    difference and the sum; ``total`` holds the derivative of each pixel's sum, or of all pixels' sum
    in as many parts as there are workers.
    """

    by_phase: NDArray[np.float32]
    light: NDArray[np.float64]
    total: NDArray[np.float32]

    def normalised(self, local: bool) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
        """Slopes and their derivatives; works in place."""
        n = self.light.shape[1]
        norm = self.light[2] if local else np.full(n, self.light[2].mean())
        flat = self.light[:2] / norm
        by_norm = self.total if local else self.total.sum(axis=0, keepdims=True) / np.float32(n)
        for axis in range(2):
            self.by_phase[axis] -= flat[axis].astype(np.float32)[:, None] * by_norm
            self.by_phase[axis] /= norm.astype(np.float32)[:, None]
        return flat.ravel(), self.by_phase.reshape(2 * n, -1)


@dataclass(frozen=True, slots=True, eq=False)
class _Job:
    """What all workers need to know."""

    spread: NDArray[np.complex64]
    light: NDArray[np.float32]
    spans: NDArray[np.intp]
    at: NDArray[np.intp]
    samples: int
    sums: _Sums

    def run(self, beams: Beams, pixels: NDArray[np.intp], worker: int) -> None:
        """Add up ``pixels``."""
        n, s = len(self.light), self.samples
        inner = np.stack(np.divmod(np.arange(s * s), s), axis=1)
        by_x, by_y = self.sums.by_phase
        local = len(self.sums.total) == len(by_x)
        for k in pixels:
            total = self.sums.total[k if local else worker]
            places = (self.at[:, k, None] + inner).reshape(-1, 2)
            for i, seen in enumerate(beams.seen(places)):
                row, column = places[i] + (n - 1)
                signs = _SIGNS[i // (s * s)]
                light = _respond(
                    self.spread, row, column, self.light, seen, self.spans, signs, by_x[k], by_y[k], total
                )
                self.sums.light[:, k] += signs[0] * light, signs[1] * light, light


def _spans(light: NDArray[np.float32]) -> NDArray[np.intp]:
    """First lit column of each row and the one behind its last ``(n, 2)``."""
    lit: NDArray[np.bool_] = np.asarray(light > 0)
    last = lit.shape[1] - lit[:, ::-1].argmax(axis=1)
    return np.where(lit.any(axis=1)[:, None], np.stack([lit.argmax(axis=1), last], axis=1), 0)


def _spread(prism: Prism, n: int, n_grid: int) -> NDArray[np.complex64]:
    """Field at ``u`` of a point at ``p``, for ``u - p`` from ``1 - n`` to ``n_grid - 1`` along y and x."""
    mask = np.fft.ifft2(prism.mask(n_grid))
    steps = np.arange(1 - n, n_grid)
    # The frequencies are half-integers: a period on, the field has the other sign.
    carrier = np.exp(2j * np.pi * frequencies(n_grid)[0] * steps)
    return np.asarray(mask[np.ix_(steps % n_grid, steps % n_grid)] * np.outer(carrier, carrier), np.complex64)
