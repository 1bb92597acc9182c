"""Sensor geometry of pyRTC (lenslet windows, pupil images) and conversion from and to ESCAPE's."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.pyramid import PyramidPupils
from escape_hw.api.sensor import SubApertureGrid
from escape_hw.errors import IncompatibleProduct


@dataclass(frozen=True, slots=True)
class PyrtcLenslets:
    """The windows of pyRTC's ``slopes`` section.

    Window ``(i, j)`` begins at row ``round(spacing i) + offset_y`` and column ``round(spacing j) +
    offset_x`` and is ``round(spacing)`` pixels wide; there are as many, each way, as such windows fit into
    the shorter side of the frame. Slopes are centres of gravity from the middle of the window.

    Parameters
    ----------
    spacing
        ``sub_ap_spacing``, pixels.
    offset_x, offset_y
        ``sub_ap_offset_x`` and ``sub_ap_offset_y``, whole pixels.
    shape
        Frame (rows, columns).
    """

    spacing: float
    offset_x: int
    offset_y: int
    shape: tuple[int, int]

    @property
    def window(self) -> int:
        """Pixels across a window."""
        return int(np.round(self.spacing))

    @property
    def n(self) -> int:
        """Windows each way."""
        return min(self.shape) // self.window

    def starts(self) -> NDArray[np.intp]:
        """First pixel of every window, less the offset ``(n,)``."""
        # The kernel multiplies in single precision and rounds halves to even.
        return np.round(np.float32(self.spacing) * np.arange(self.n)).astype(np.intp)

    def centres(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Middles of the columns (x) and rows (y) of windows in pixels, ``(n,)`` each."""
        middle = np.asarray(self.starts() + (self.window - 1) / 2, np.float64)
        return middle + self.offset_x, middle + self.offset_y

    def windows_on_frame(self) -> NDArray[np.bool_]:
        """Which windows ``(n, n)`` lie on the frame; pyRTC leaves the others at zero."""
        rows, columns = (
            (begin >= 0) & (begin + self.window <= size)
            for begin, size in (
                (self.starts() + self.offset_y, self.shape[0]),
                (self.starts() + self.offset_x, self.shape[1]),
            )
        )
        return np.outer(rows, columns)

    @classmethod
    def from_grid(cls, grid: SubApertureGrid, shape: tuple[int, int]) -> PyrtcLenslets:
        """The windows that come nearest to our grid on a frame (rows, columns).

        Raises
        ------
        IncompatibleProduct
            A valid lenslet has no window on the frame.
        """
        rows, columns = np.nonzero(grid.valid)
        windows = cls(grid.pitch_px, 0, 0, shape)
        if max(rows.max(initial=0), columns.max(initial=0)) >= windows.n:
            raise IncompatibleProduct(
                f"pyRTC reads {windows.n} x {windows.n} sub-apertures of {windows.window} pixels on a frame "
                f"of {shape[1]} x {shape[0]}; valid ones lie beyond"
            )
        at_x, at_y = windows.centres()
        wanted = grid.centres_px()
        found = cls(
            grid.pitch_px,
            round(float(np.mean(wanted[:, 0] - at_x[columns]))),
            round(float(np.mean(wanted[:, 1] - at_y[rows]))),
            shape,
        )
        if not found.windows_on_frame()[rows, columns].all():
            raise IncompatibleProduct(
                f"windows of {found.window} pixels on valid sub-apertures leave the frame of {shape[1]} x "
                f"{shape[0]}, where pyRTC gives no slope; read a larger region"
            )
        return found

    def mask_of(self, grid: SubApertureGrid) -> NDArray[np.bool_]:
        """PyRTC's mask ``(2 n, n)`` of a grid's valid lenslets."""
        rows, columns = np.nonzero(grid.valid)
        mask = np.zeros((self.n, self.n), bool)
        mask[rows, columns] = True
        return np.vstack([mask, mask])

    def references_of(self, grid: SubApertureGrid) -> NDArray[np.float32]:
        """PyRTC's reference slopes ``(2 n, n)`` of a grid."""
        rows, columns = np.nonzero(grid.valid)
        at_x, at_y = self.centres()
        spots = grid.centres_px() + grid.references_px
        out = np.zeros((2 * self.n, self.n), np.float32)
        out[rows, columns] = spots[:, 0] - at_x[columns]
        out[rows + self.n, columns] = spots[:, 1] - at_y[rows]
        return out

    def grid(
        self, mask: NDArray[np.bool_], references: NDArray[np.floating], n_sub: int
    ) -> tuple[SubApertureGrid, NDArray[np.intp], str | None]:
        """Our grid of pyRTC's geometry.

        Parameters
        ----------
        mask, references
            Valid sub-apertures and reference slopes ``(2 n, n)``, pixels.
        n_sub
            Sub-apertures across the pupil by our design; the grid is so large.

        Returns
        -------
        grid : SubApertureGrid
        rows : ndarray
            Which rows of pyRTC's signal belong to its slopes, in order.
        note : str or None
            Ambiguities of the pupil's position.

        Raises
        ------
        IncompatibleProduct
            The mask is of another size, wider than the design, or not the same for x and y.
        """
        self._require(mask, references, n_sub)
        upper = mask[: self.n]
        corner, ambiguous = _centre_box(upper, n_sub)
        rows, columns = np.nonzero(upper)
        valid = np.zeros((n_sub, n_sub), bool)
        valid[rows - corner[0], columns - corner[1]] = True
        at_x, at_y = self.centres()
        origin = (
            self.offset_x + (self.window - 1) / 2 + corner[1] * self.spacing,
            self.offset_y + (self.window - 1) / 2 + corner[0] * self.spacing,
        )
        flux = valid.astype(np.float32)
        bare = SubApertureGrid(self.spacing, origin, valid, np.zeros((len(rows), 2), np.float32), flux)
        spots = np.stack([at_x[columns] + references[rows, columns],
                          at_y[rows] + references[rows + self.n, columns]], axis=1)  # fmt: skip
        own = (spots - bare.centres_px()).astype(np.float32)
        grid = SubApertureGrid(self.spacing, origin, valid, own, flux)
        note = (
            "the mask does not determine on which side of the pupil a row of dark sub-apertures is; shifts "
            "of the registration may be off by half a sub-aperture"
        )
        return grid, np.arange(2 * len(rows)), note if ambiguous else None

    def _require(self, mask: NDArray[np.bool_], references: NDArray[np.floating], n_sub: int) -> None:
        wanted = (2 * self.n, self.n)
        for name, part in (("mask", mask), ("references", references)):
            if part.shape != wanted:
                raise IncompatibleProduct(
                    f"pyRTC's {name} has shape {part.shape}; a frame of {self.shape[1]} x {self.shape[0]} "
                    f"with windows of {self.window} pixels needs {wanted}"
                )
        if not np.array_equal(mask[: self.n], mask[self.n :]) or not mask.any():
            raise IncompatibleProduct(
                "pyRTC's mask marks other sub-apertures for x than for y, or none; ours come in pairs"
            )
        across = [int(np.ptp(np.flatnonzero(mask[: self.n].any(axis=axis)))) + 1 for axis in (0, 1)]
        if max(across) > n_sub:
            raise IncompatibleProduct(
                f"pyRTC's mask is {max(across)} sub-apertures wide; sensor.n_sub of the system is {n_sub}"
            )


def _centre_box(valid: NDArray[np.bool_], n_sub: int) -> tuple[tuple[int, int], bool]:
    """Row and column of a box of n_sub centred on a mask, and whether they are ambiguous."""
    corner, ambiguous = [], False
    for axis in (1, 0):
        lit = np.flatnonzero(valid.any(axis=axis))
        margin = n_sub - (int(np.ptp(lit)) + 1)
        corner.append(int(lit[0]) - margin // 2)
        ambiguous = ambiguous or margin % 2 == 1
    return (corner[0], corner[1]), ambiguous


#: The order of images (numbers in :data:`~escape_hw.api.pyramid.IMAGES`) in which pyRTC's signs are ours.
_OUR_ORDER = (3, 1, 2, 0)
#: What each of our images adds to a slope: ours along x and y, and pyRTC's by the place in its list.
_OUR_SIGNS = np.array([[-1, 1, -1, 1], [-1, -1, 1, 1]])
_PYRTC_SIGNS = np.array([[1, 1, -1, -1], [1, -1, 1, -1]])


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
    def from_pupils(cls, pupils: PyramidPupils) -> PyrtcPupils:
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
            The images are not arranged two by two, or do not fit the design.
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
        order = _image_order(self.centres)
        axes, signs = _match_axes(order)
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


def _image_order(centres: Sequence[tuple[int, int]]) -> tuple[int, ...]:
    """Which of pyRTC's images is our upper left, upper right, lower left, lower right."""
    places = np.array(centres, float)
    if places.shape != (4, 2):
        raise IncompatibleProduct(f"pyRTC's configuration names {len(centres)} pupils; a pyramid makes four")
    right, lower = (places > places.mean(axis=0)).T
    numbers = (2 * lower + right).astype(int)
    if sorted(numbers) != [0, 1, 2, 3]:
        raise IncompatibleProduct(f"pyRTC's pupils {list(centres)} are not arranged two by two")
    return tuple(int(k) for k in np.argsort(numbers))


def _match_axes(order: Sequence[int]) -> tuple[list[int], NDArray[np.int8]]:
    """For our x and y: which of pyRTC's halves it is, and its sign."""
    pyrtc_signs = _PYRTC_SIGNS[:, list(order)]
    axes, signs = [], []
    for ours in _OUR_SIGNS:
        match = pyrtc_signs @ ours
        axis = int(np.argmax(np.abs(match)))
        if abs(match[axis]) != 4:
            raise IncompatibleProduct(
                "the order of pyRTC's pupils makes a slope of images that stand across; ours are x and y"
            )
        axes.append(axis)
        signs.append(int(np.sign(match[axis])))
    return axes, np.array(signs, np.int8)
