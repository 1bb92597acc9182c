"""Where pyRTC reads the four images of a pyramid sensor, and our pupils in those terms."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.pyramid import PyramidPupils
from escape_hw.errors import IncompatibleProduct

#: The order of images (numbers in :data:`~escape_hw.api.pyramid.IMAGES`) in which pyRTC's signs are ours.
_OUR_ORDER = (3, 1, 2, 0)
#: What each of our images adds to a slope: ours along x and y, and pyRTC's by the place in its list.
_OURS = np.array([[-1, 1, -1, 1], [-1, -1, 1, 1]])
_THEIRS = np.array([[1, 1, -1, -1], [1, -1, 1, -1]])


@dataclass(frozen=True, slots=True)
class PyrtcPupils:
    """The images of pyRTC's ``slopes`` section.

    With ``p1`` to ``p4`` in the order of its list, pyRTC's slopes are ``(p1 + p2 - p3 - p4) / mean`` and
    ``(p1 + p3 - p2 - p4) / mean`` over all pixels of a disk, normalised by the mean of the sum of four.

    Parameters
    ----------
    centres
        ``pupils``: (x, y) of each image, whole pixels.
    radius
        ``pupils_radius``.
    obscuration
        ``central_obscuration_ratio``.
    """

    centres: tuple[tuple[int, int], ...]
    radius: int
    obscuration: float = 0.0

    @property
    def n(self) -> int:
        """Pixels across the box of an image."""
        return math.ceil(2 * self.radius)

    def disk(self) -> NDArray[np.bool_]:
        """Pixels ``(n, n)`` of an image that pyRTC reads; its samples lie ``n / (n - 1)`` apart."""
        x = np.linspace(-self.n / 2, self.n / 2, self.n)
        r2 = x[:, None] ** 2 + x**2
        hole = self.radius * self.obscuration
        return np.asarray((r2 <= self.radius**2) & ((r2 >= hole**2) | (hole <= 0)))

    def corners(self) -> NDArray[np.intp]:
        """First pixel of every box ``(4, 2)`` as (x, y)."""
        return np.array(self.centres) - self.n // 2

    @classmethod
    def of(cls, pupils: PyramidPupils) -> PyrtcPupils:
        """The images that hold ours, pixel by pixel, in an order that keeps our signs.

        Raises
        ------
        IncompatibleProduct
            pyRTC has no such sensor: boxes of an odd size, or slopes normalised pixel by pixel.
        """
        n = pupils.valid.shape[0]
        if n % 2:
            raise IncompatibleProduct(
                f"the pupil images are {n} pixels across; pyRTC takes a whole radius, so an even number"
            )
        if pupils.normalisation != "global":
            raise IncompatibleProduct(
                f"slopes are normalised '{pupils.normalisation}'; pyRTC divides by the mean of all "
                "pixels only (calibrate with sensor.normalisation=global)"
            )
        x, y = (pupils.corners_px + n // 2).T
        return cls(tuple((int(x[k]), int(y[k])) for k in _OUR_ORDER), n // 2)

    def mask_of(self) -> NDArray[np.bool_]:
        """PyRTC's mask ``(2 R, 4 R)``; it makes it itself."""
        return np.hstack([self.disk(), self.disk()])

    def references_of(self, pupils: PyramidPupils) -> NDArray[np.float32]:
        """PyRTC's reference slopes ``(2 R, 4 R)`` of pupils made by :meth:`of`."""
        out = np.zeros((2, *pupils.valid.shape), np.float32)
        out[:, pupils.valid] = pupils.references.T
        return np.hstack(list(out * self.disk()))

    def rows_of(self, pupils: PyramidPupils, part: NDArray[np.floating]) -> NDArray[np.float32]:
        """Rows of ours ``(n_slopes, ...)`` in pyRTC's order; pixels that we do not use get zeros."""
        maps = np.zeros((2, *pupils.valid.shape, *part.shape[1:]), np.float32)
        maps[:, pupils.valid] = part.reshape(2, -1, *part.shape[1:])
        return np.concatenate(list(maps[:, self.disk()]))

    def pupils(
        self, references: NDArray[np.floating], n_sub: int
    ) -> tuple[PyramidPupils, NDArray[np.intp], NDArray[np.int8]]:
        """Our pupils of pyRTC's geometry.

        Parameters
        ----------
        references
            pyRTC's reference slopes ``(2 R, 4 R)``.
        n_sub
            Pixels across an image by our design.

        Returns
        -------
        pupils : PyramidPupils
        rows : ndarray
            Which rows of pyRTC's signal belong to its slopes, in order.
        signs : ndarray
            What to multiply them by.

        Raises
        ------
        IncompatibleProduct
            The images do not stand two by two, or do not fit the design.
        """
        if references.shape != (self.n, 2 * self.n):
            raise IncompatibleProduct(
                f"pyRTC's references have shape {references.shape}; {(self.n, 2 * self.n)} belongs "
                "to its radius"
            )
        if n_sub < self.n or (n_sub - self.n) % 2:
            raise IncompatibleProduct(
                f"pyRTC's images are {self.n} pixels across, sensor.n_sub of the system is {n_sub}; it must "
                "be as large, or larger by an even number"
            )
        order = _arrangement(self.centres)
        axes, signs = _axes(order)
        margin = (n_sub - self.n) // 2
        valid = np.pad(self.disk(), margin)
        count = int(valid.sum())
        rows = np.concatenate([np.arange(count) + axis * count for axis in axes])
        spread = np.repeat(signs, count).astype(np.int8)
        flat = np.concatenate([half[self.disk()] for half in np.hsplit(references, 2)])
        corners = self.corners()[list(order)] - margin
        found = PyramidPupils(
            centres_px=np.asarray(corners + (n_sub - 1) / 2, np.float64),
            diameter_px=2.0 * self.radius,
            corners_px=corners.astype(np.intp),
            valid=valid,
            references=(flat[rows] * spread).reshape(2, -1).T.astype(np.float32),
            flux=valid.astype(np.float32),
        )
        return found, rows, spread


def _arrangement(centres: Sequence[tuple[int, int]]) -> tuple[int, ...]:
    """Which of pyRTC's images is our upper left, upper right, lower left, lower right."""
    places = np.array(centres, float)
    if places.shape != (4, 2):
        raise IncompatibleProduct(f"pyRTC's configuration names {len(centres)} pupils; a pyramid makes four")
    right, lower = (places > places.mean(axis=0)).T
    numbers = (2 * lower + right).astype(int)
    if sorted(numbers) != [0, 1, 2, 3]:
        raise IncompatibleProduct(f"pyRTC's pupils {list(centres)} do not stand two by two")
    return tuple(int(k) for k in np.argsort(numbers))


def _axes(order: Sequence[int]) -> tuple[list[int], NDArray[np.int8]]:
    """For our x and y: which of pyRTC's halves it is, and its sign."""
    theirs = _THEIRS[:, list(order)]
    axes, signs = [], []
    for ours in _OURS:
        match = theirs @ ours
        axis = int(np.argmax(np.abs(match)))
        if abs(match[axis]) != 4:
            raise IncompatibleProduct(
                "the order of pyRTC's pupils makes a slope of images that stand across; ours are x and y"
            )
        axes.append(axis)
        signs.append(int(np.sign(match[axis])))
    return axes, np.array(signs, np.int8)
