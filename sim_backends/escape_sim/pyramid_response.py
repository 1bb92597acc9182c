"""Derivatives of pyramid slopes by the phase, at a flat wavefront or in the mean over turbulence."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from escape_hw.api.threads import hold_to_one_thread
from escape_sim.modulation import Modulation
from escape_sim.prism import Prism, frequencies
from escape_sim.pyramid_beams import Beams, Points, Turbulent, Uneven, coherence

#: Threads that share the pixels.
_WORKERS = 2
#: Sign of each image in the x and the y slope: upper left, upper right, lower left, lower right.
_SIGNS = np.array([[-1, -1], [1, -1], [-1, 1], [1, 1]], np.float32)


@njit(cache=True, fastmath=True, nogil=True)
def _respond(spread, row, column, light, seen, spans, weights, sums):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Add ``-2 Im(spread light seen)``, by ``weights``, to ``sums (3, n, n)``: x, y and total.

    Returns the intensity of the pixel: the sum of the real part.
    """
    intensity = np.float64(0)
    for i in range(light.shape[0]):
        line, field, amplitude = spread[row - i], seen[i], light[i]
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
class Unsteady:
    """Gaussian phases that move more in some places of the pupil than in others.

    Parameters
    ----------
    structure
        Their mean structure function ``(2 n - 1, 2 n - 1)`` in square radians.
    strength
        How much more than in the mean they move at each sample ``(n, n)``, in squares: 1 on average.
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
    by_phase
        Derivatives ``(n_slopes, m * m)`` in 1 / rad, by the phase at the nodes, rows along y.
    """

    flat: NDArray[np.float64]
    by_phase: NDArray[np.float32]


def slope_response(
    amplitude: NDArray[np.floating],
    prism: Prism,
    n_grid: int,
    corners: NDArray[np.intp],
    valid: NDArray[np.bool_],
    modulation: Modulation,
    structure: NDArray[np.float64] | None = None,
    *,
    unsteady: Unsteady | None = None,
    carry: NDArray[np.float32] | None = None,
    samples: int = 1,
    local: bool = False,
) -> SlopeResponse:
    """Derivatives of all slopes by the phase.

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
    unsteady
        What moves beside, and not alike everywhere; ``structure`` must be given then.
    carry
        Matrix ``(n, m)`` from the phase at nodes to the phase at samples, along either axis; by
        default the nodes are the samples.
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
    m = len(light) if carry is None else carry.shape[1]
    sums = _Sums(
        np.empty((2, len(places), m, m), np.float32),
        np.zeros((3, len(places))),
        np.zeros((len(places) if local else _WORKERS, m, m), np.float32),
    )
    spread = _spread(prism, len(light), n_grid)
    beams: list[Beams]
    if structure is None:
        beams = [Points(light, prism, n_grid, modulation)] * _WORKERS
    else:
        mean, uneven = _coherences(len(light), prism.diameter, modulation, structure, unsteady)
        beams = [Turbulent(light, spread, mean, uneven) for _ in range(_WORKERS)]
    job = _Job(spread, light, _spans(light), at, samples, carry, sums)
    parts = np.array_split(np.arange(len(places)), _WORKERS)
    # The workers multiply matrices too, each for itself.
    with hold_to_one_thread(), ThreadPoolExecutor(_WORKERS) as pool:
        for done in [pool.submit(job.run, beams[k], part, k) for k, part in enumerate(parts)]:
            done.result()
    return sums.normalised(local)


def _coherences(
    n: int,
    diameter: float,
    modulation: Modulation,
    structure: NDArray[np.float64],
    unsteady: Unsteady | None,
) -> tuple[NDArray[np.complex128], Uneven | None]:
    """The coherence where phases move little, and what is added where they move more.

    Between two samples the structure function is taken for the mean one by the mean of both strengths,
    and the coherence for linear in it between the quiet and the restless quarter of the pupil.
    """
    if unsteady is None:
        return coherence(n, diameter, modulation, structure), None
    low, high = np.percentile(unsteady.strength, (25, 75))
    quiet, restless = (
        coherence(n, diameter, modulation, structure + level * unsteady.structure) for level in (low, high)
    )
    half = (unsteady.strength - low) / (2 * max(high - low, 1e-6))
    return quiet, Uneven(half.astype(np.float32), restless - quiet)


@dataclass(frozen=True, slots=True, eq=False)
class _Sums:
    """Differences of images and their derivatives, not normalised yet.

    ``by_phase (2, n_valid, m, m)`` for x and y; ``light (3, n_valid)`` is the x difference, the y
    difference and the sum; ``total`` holds the derivative of each pixel's sum, or of all pixels' sum
    in as many parts as there are workers.
    """

    by_phase: NDArray[np.float32]
    light: NDArray[np.float64]
    total: NDArray[np.float32]

    def normalised(self, local: bool) -> SlopeResponse:
        """Slopes and their derivatives; works in place."""
        n = self.light.shape[1]
        norm = self.light[2] if local else np.full(n, self.light[2].mean())
        flat = self.light[:2] / norm
        by_norm = self.total if local else self.total.sum(axis=0, keepdims=True) / np.float32(n)
        for axis, by_phase in enumerate(self.by_phase):
            for k, row in enumerate(by_phase):
                row -= np.float32(flat[axis, k]) * by_norm[k if local else 0]
                row /= np.float32(norm[k])
        return SlopeResponse(flat.ravel(), self.by_phase.reshape(2 * n, -1))


@dataclass(frozen=True, slots=True, eq=False)
class _Job:
    """What all workers need to know."""

    spread: NDArray[np.complex64]
    light: NDArray[np.float32]
    spans: NDArray[np.intp]
    at: NDArray[np.intp]
    samples: int
    carry: NDArray[np.float32] | None
    sums: _Sums

    def run(self, beams: Beams, pixels: NDArray[np.intp], worker: int) -> None:
        """Add up ``pixels``."""
        n, s, out = len(self.light), self.samples, self.sums
        local = len(out.total) == out.light.shape[1]
        inner = np.stack(np.divmod(np.arange(s * s), s), axis=1)
        sums = np.zeros((3, n, n), np.float32)
        for k in pixels:
            sums[: 3 if local else 2] = 0
            places = (self.at[:, k, None] + inner).reshape(-1, 2)
            for i, seen in enumerate(beams.seen(places)):
                row, column = places[i] + (n - 1)
                signs = _SIGNS[i // (s * s)]
                light = _respond(self.spread, row, column, self.light, seen, self.spans, signs, sums)
                out.light[:, k] += signs[0] * light, signs[1] * light, light
            out.by_phase[:, k] = self._on_nodes(sums[:2])
            if local:
                out.total[k] = self._on_nodes(sums[2])
        if not local:
            out.total[worker] = self._on_nodes(sums[2])

    def _on_nodes(self, by_sample: NDArray[np.float32]) -> NDArray[np.float32]:
        """Derivatives by the phase at nodes, of derivatives by the phase at samples."""
        if self.carry is None:
            return by_sample
        return np.asarray(self.carry.T @ (by_sample @ self.carry))


def _spans(light: NDArray[np.float32]) -> NDArray[np.intp]:
    """First lit column of each row and the one behind its last ``(n, 2)``."""
    lit: NDArray[np.bool_] = np.array(light > 0)
    last = light.shape[1] - np.flip(lit, axis=1).argmax(axis=1)
    return np.where(np.any(lit, axis=1)[:, None], np.stack([lit.argmax(axis=1), last], axis=1), 0)


def _spread(prism: Prism, n: int, n_grid: int) -> NDArray[np.complex64]:
    """Field at ``u`` of a point at ``p``, for ``u - p`` from ``1 - n`` to ``n_grid - 1`` along y and x."""
    mask = np.fft.ifft2(prism.mask(n_grid))
    steps = np.arange(1 - n, n_grid)
    # The frequencies are half-integers: a period on, the field has the other sign.
    carrier = np.exp(2j * np.pi * frequencies(n_grid)[0] * steps)
    return np.asarray(mask[np.ix_(steps % n_grid, steps % n_grid)] * np.outer(carrier, carrier), np.complex64)
