"""Where pyRTC reads the spots of a Shack-Hartmann sensor, and our grid in those terms."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

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

    def inside(self) -> NDArray[np.bool_]:
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
    def of(cls, grid: SubApertureGrid, shape: tuple[int, int]) -> PyrtcLenslets:
        """The windows that come nearest to a grid.

        Parameters
        ----------
        grid
            Our grid.
        shape
            Frame (rows, columns).

        Raises
        ------
        IncompatibleProduct
            A valid lenslet has no window on the frame.
        """
        rows, columns = np.nonzero(grid.valid)
        probe = cls(grid.pitch_px, 0, 0, shape)
        if max(rows.max(initial=0), columns.max(initial=0)) >= probe.n:
            raise IncompatibleProduct(
                f"pyRTC reads {probe.n} x {probe.n} sub-apertures of {probe.window} pixels on a frame of "
                f"{shape[1]} x {shape[0]}; valid ones lie beyond"
            )
        at_x, at_y = probe.centres()
        wanted = grid.centres_px()
        found = cls(
            grid.pitch_px,
            round(float(np.mean(wanted[:, 0] - at_x[columns]))),
            round(float(np.mean(wanted[:, 1] - at_y[rows]))),
            shape,
        )
        if not found.inside()[rows, columns].all():
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
        mask
            Valid sub-apertures ``(2 n, n)``.
        references
            Reference slopes ``(2 n, n)``, pixels.
        n_sub
            Sub-apertures across the pupil by our design; the grid is so large.

        Returns
        -------
        grid : SubApertureGrid
        rows : ndarray
            Which rows of pyRTC's signal belong to its slopes, in order.
        note : str or None
            What is not certain about where the pupil lies.

        Raises
        ------
        IncompatibleProduct
            The mask is of another size, wider than the design, or not the same for x and y.
        """
        self._require(mask, references, n_sub)
        upper = mask[: self.n]
        corner, odd = _corner(upper, n_sub)
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
            "the mask does not tell on which side of the pupil a row of dark sub-apertures lies; shifts of "
            "the registration may be off by half a sub-aperture"
        )
        return grid, np.arange(2 * len(rows)), note if odd else None

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


def _corner(valid: NDArray[np.bool_], n_sub: int) -> tuple[tuple[int, int], bool]:
    """Row and column where a box of n_sub lies centred on a mask, and whether that is undecided."""
    corner, odd = [], False
    for axis in (1, 0):
        lit = np.flatnonzero(valid.any(axis=axis))
        spare = n_sub - (int(np.ptp(lit)) + 1)
        corner.append(int(lit[0]) - spare // 2)
        odd = odd or spare % 2 == 1
    return (corner[0], corner[1]), odd
