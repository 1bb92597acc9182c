"""Light of the pupil that reaches a pixel of a pyramid sensor: means over modulation and turbulence."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numba import njit
from numpy.typing import NDArray

from escape_sim.fourier_filter import FourierFilter, good_length
from escape_sim.modulation import Modulation
from escape_sim.prism import Prism, frequencies


@njit(cache=True, fastmath=True, nogil=True)
def _view(spread, row, column, light, out):  # type: ignore[no-untyped-def]  # pragma: no cover
    """``out[i, j] = conj(spread[row - i, column - j]) light[i, j]``."""
    for i in range(light.shape[0]):
        line, amplitude, target = spread[row - i], light[i], out[i]
        for j in range(amplitude.size):
            target[j] = line[column - j].conjugate() * amplitude[j]


class Beams(Protocol):
    """Means of ``conj(E(u)) f(p) / A(p)`` for the field ``E`` of a pixel and the pupil's ``f``."""

    def seen(self, places: NDArray[np.intp]) -> Iterator[NDArray[np.complex64]]:
        """For each (row, column) ``u`` in turn: rows of ``n`` or more samples, ``n`` of them."""
        ...


class Points:
    """Beams of a modulation without turbulence: one for each point, summed by matrix products.

    Parameters
    ----------
    light
        Pupil amplitude ``(n, n)``.
    prism
        Faces, as seen from a pupil in the grid's corner.
    n_grid
        Side of the periodic grid in samples.
    modulation
        Path of the image over the pyramid.
    """

    def __init__(self, light: NDArray[np.float32], prism: Prism, n_grid: int, modulation: Modulation) -> None:
        n = len(light)
        at = np.arange(n) - (n - 1) / 2
        turns = modulation.points / prism.diameter
        tilts = np.exp(2j * np.pi * (turns[:, 1, None, None] * at[:, None] + turns[:, 0, None, None] * at))
        tilts *= np.sqrt(modulation.weights)[:, None, None]
        # The frequencies are half-integers; the transform's are not.
        carrier = np.exp(-2j * np.pi * frequencies(n_grid)[0] * np.arange(n_grid))
        through = FourierFilter(prism.mask(n_grid) / n_grid**2, n, n_grid)
        self._fields = np.empty((n_grid, n_grid, modulation.n_points), np.complex64)
        for k, tilt in enumerate(tilts):
            through.field[:, :n] = light * tilt * np.outer(carrier[:n], carrier[:n])
            through.run()
            self._fields[:, :, k] = through.result[:, :n_grid].conj() * np.outer(carrier, carrier)
        self._tilts = tilts.reshape(len(tilts), -1).astype(np.complex64)
        self._n = n

    def seen(self, places: NDArray[np.intp]) -> Iterator[NDArray[np.complex64]]:
        """See :class:`Beams`."""
        fields = self._fields[places[:, 0], places[:, 1]]
        yield from (fields @ self._tilts).reshape(-1, self._n, self._n)


class Turbulent:
    """Beams of a modulation under turbulence: a convolution with their coherence for each pixel.

    Not for two threads at a time.

    Parameters
    ----------
    light
        Pupil amplitude ``(n, n)``.
    spread
        Field at ``u`` of a point at ``p``, for ``u - p`` from ``1 - n`` on along y and x.
    mean
        From :func:`coherence`.
    uneven
        What to add where the phase moves more than in ``mean``, if anywhere.
    """

    def __init__(
        self,
        light: NDArray[np.float32],
        spread: NDArray[np.complex64],
        mean: NDArray[np.complex128],
        uneven: Uneven | None = None,
    ) -> None:
        self._filter = _convolution(mean, len(light))
        self._light, self._spread, self._uneven = light, spread, uneven
        self._more = None if uneven is None else _convolution(uneven.difference, len(light))

    def seen(self, places: NDArray[np.intp]) -> Iterator[NDArray[np.complex64]]:
        """See :class:`Beams`."""
        n, filter_, more = len(self._light), self._filter, self._more
        for row, column in places:
            _view(self._spread, n - 1 + row, n - 1 + column, self._light, filter_.field)
            filter_.run()
            result = filter_.result[:n, :n]
            if more is not None and self._uneven is not None:
                # With s(p, q) = (s(p) + s(q)) / 2 one half belongs to either side of the convolution.
                half = self._uneven.half
                more.field[:n, :n] = filter_.field[:n, :n]
                more.run()
                result += half * more.result[:n, :n]
                more.field[:n, :n] *= half
                more.run()
                result += more.result[:n, :n]
            yield filter_.result


@dataclass(frozen=True, slots=True, eq=False)
class Uneven:
    """A coherence that changes from place to place, linearly between two.

    Parameters
    ----------
    half
        Half the share ``(n, n)`` of the way from the first to the second.
    difference
        The second less the first ``(2 n - 1, 2 n - 1)``, see :func:`coherence`.
    """

    half: NDArray[np.float32]
    difference: NDArray[np.complex128]


def _convolution(kernel: NDArray[np.complex128], n: int) -> FourierFilter:
    """The convolution of fields of ``n`` samples with a kernel ``(2 n - 1, 2 n - 1)``."""
    size = good_length(2 * n - 1)
    wide = np.zeros((size, size), complex)
    steps = np.arange(1 - n, n) % size
    wide[np.ix_(steps, steps)] = kernel
    return FourierFilter(np.fft.fft2(wide) / size**2, n, n)


def coherence(
    n: int, diameter: float, modulation: Modulation, structure: NDArray[np.float64]
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
        Structure function ``(2 n - 1, 2 n - 1)`` of the turbulence in square radians, at distances
        ``p - q`` from ``-(n - 1)`` to ``n - 1`` samples along y and x.
    """
    steps = np.arange(1 - n, n)
    x, y = (np.exp(2j * np.pi * np.outer(steps, t) / diameter) for t in modulation.points.T)
    # A Gaussian phase: its characteristic function is all that is needed.
    return np.asarray((y * modulation.weights) @ x.T * np.exp(-0.5 * structure))
