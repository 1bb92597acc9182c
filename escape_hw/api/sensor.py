"""Geometry of a wavefront sensor as found on its camera, and what turns frames into slopes with it."""

from __future__ import annotations

import abc
from dataclasses import dataclass, replace
from typing import ClassVar, Protocol, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.representation import short_repr
from escape_hw.errors import IncompatibleProduct

#: Spots move and blur by more than their centres of gravity show: what the window and the threshold
#: cut off, and the turbulence within each lenslet. Found on a twin with known optics (docs/decisions).
SPOT_MOTION_FACTOR = 1.2


class SensorGeometry(abc.ABC):
    """What procedures, products and reports need to know of a sensor, whatever its kind.

    A geometry is an immutable dataclass. A sub-aperture is the part of the pupil that one slope pair
    belongs to: a lenslet, or a pixel of a pyramid's pupil image.

    Attributes
    ----------
    kind
        As ``sensor.kind`` of the configuration calls it.
    slope_unit
        Unit of the slopes, as products state it.
    elements
        What its sub-apertures are called, in the plural.
    short_look
        What a short run under turbulence leaves in the geometry, for a note.
    valid
        Valid sub-apertures, boolean ``(n_rows, n_columns)``.
    flux
        Light of every sub-aperture relative to a bright one, ``(n_rows, n_columns)``.
    counts
        Counts per frame of a bright sub-aperture; 0 if unknown.
    background
        Level of the dark pixels in counts that was subtracted when no dark frame was at hand.
    """

    __slots__ = ()

    kind: ClassVar[str]
    slope_unit: ClassVar[str]
    elements: ClassVar[str]
    short_run_note: ClassVar[str]

    valid: NDArray[np.bool_]
    flux: NDArray[np.float32]
    counts: float
    background: float

    @property
    def n_valid(self) -> int:
        """Number of valid sub-apertures."""
        return int(self.valid.sum())

    @property
    def n_slopes(self) -> int:
        """Number of slopes: all x, then all y, over the valid sub-apertures in row-major order."""
        return 2 * self.n_valid

    @abc.abstractmethod
    def with_background(self, counts: float) -> Self:
        """The geometry with the background level that was subtracted."""

    @abc.abstractmethod
    def with_slope_statistics(
        self, rms: float, pokes: float = 0.0, n_effective: float = 0.0, persistent_fraction: float = 0.0
    ) -> Self:
        """The geometry with the motion that a measurement saw.

        Parameters
        ----------
        rms
            Rms over time of the slopes, in their unit.
        pokes
            Rms surface of the mirror's random pokes, all modes together, as fraction of full stroke.
        looks
            Independent states of the slopes that were seen; 0 if unknown.
        steady
            Share of the slopes' variance that is still there two frames later; 0 if unknown.
        """

    @abc.abstractmethod
    def with_mean_slopes(self, mean: NDArray[np.float64]) -> Self:
        """The geometry with better references, after a longer look at the turbulence.

        It was found on the first frames of a run, whose mean aberration is the turbulence's own; over
        the whole run that averages out further. Pixels and mask stay as they are, so every slope of
        the run keeps its meaning.

        Parameters
        ----------
        mean
            Mean slopes of the run ``(n_slopes,)``, against the references in force.
        """


class SlopeFunction(Protocol):
    """Takes frames, returns slopes."""

    @property
    def grid(self) -> SensorGeometry:
        """The geometry that the slopes belong to."""
        ...

    @property
    def shape(self) -> tuple[int, int]:
        """Shape of the frames it takes (rows, columns)."""
        ...

    @property
    def flux(self) -> NDArray[np.float32]:
        """Light of each valid sub-aperture in the last frame ``(n_valid,)``, in counts."""
        ...

    def __call__(
        self,
        frame: NDArray[np.uint16],
        flux: NDArray[np.float32] | None = None,
        out: NDArray[np.float32] | None = None,
    ) -> NDArray[np.float32]:
        """Slopes ``(n_slopes,)``, in ``out`` if given; ``flux (n_valid,)`` is filled when given."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class SubApertureGrid(SensorGeometry):
    """The lenslet grid of a Shack-Hartmann sensor on the camera, found from frames.

    The centre of lenslet ``(i, j)`` (row, column) lies at ``origin + (j, i) * pitch`` pixels of
    the region read, x along columns and y along rows, pixel centres at whole numbers.

    Parameters
    ----------
    pitch_px
        Lenslet pitch in camera pixels (need not be whole).
    origin_px
        Centre of lenslet (0, 0) as (x, y) in pixels.
    valid
        Valid sub-apertures, boolean ``(n_rows, n_columns)``.
    references_px
        Reference spot positions ``(n_valid, 2)`` as (x, y) relative to the lenslet centres.
    flux
        Flux of every sub-aperture relative to a bright one, ``(n_rows, n_columns)``.
    counts
        Counts per frame of a bright sub-aperture (the 95th percentile of those lit); 0 if unknown.
    motion_px
        Rms motion of the spots along an axis, in pixels, during the measurement that a model of
        this sensor is to match.
    background
        Level of the dark pixels in counts that was subtracted when no dark frame was at hand.
    air_px
        The part of ``motion_px`` that lasts from frame to frame in open loop, which is the turbulence's and
        not the pokes'; rms along an axis in pixels, 0 if unknown.
    """

    kind: ClassVar[str] = "shack-hartmann"
    slope_unit: ClassVar[str] = "pixel"
    elements: ClassVar[str] = "sub-apertures"
    short_run_note: ClassVar[str] = (
        "the references hold the mean focus of {seconds:.2g} s of turbulence, which costs Strehl ratio "
        "and which the wind does not explain; the matrix is not touched by it: close the loop on "
        "references taken over a longer time"
    )

    pitch_px: float
    origin_px: tuple[float, float]
    valid: NDArray[np.bool_]
    references_px: NDArray[np.float32]
    flux: NDArray[np.float32]
    counts: float = 0.0
    motion_px: float = 0.0
    background: float = 0.0
    turbulence_px: float = 0.0
    __repr__ = short_repr

    def centres_px(self) -> NDArray[np.float64]:
        """Centres ``(n_valid, 2)`` of the valid lenslets as (x, y) in pixels."""
        rows, columns = np.nonzero(self.valid)
        return np.stack(
            [self.origin_px[0] + columns * self.pitch_px, self.origin_px[1] + rows * self.pitch_px], axis=1
        )

    def with_background(self, counts: float) -> SubApertureGrid:
        """See :meth:`SensorGeometry.with_background`."""
        return replace(self, background=counts)

    def with_slope_statistics(
        self, rms: float, pokes: float = 0.0, n_effective: float = 0.0, persistent_fraction: float = 0.0
    ) -> SubApertureGrid:
        """See :meth:`SensorGeometry.with_slope_statistics`; the spots move more than the slopes say.

        What is known of the air stays where a measurement tells nothing of it, as in a closed loop, which
        takes away the motion of the spots but not the turbulence within a lenslet.
        """
        turbulence = (
            SPOT_MOTION_FACTOR * rms * float(np.sqrt(persistent_fraction))
            if persistent_fraction
            else self.turbulence_px
        )
        return replace(self, motion_px=SPOT_MOTION_FACTOR * rms, turbulence_px=turbulence)

    def with_mean_slopes(self, mean: NDArray[np.float64]) -> SubApertureGrid:
        """See :meth:`SensorGeometry.with_mean_slopes`: a lattice through the mean spots.

        Single spots keep no reference of their own, only shift and stretch of the whole lattice: the
        lenslets stand regularly, the mean of the turbulence does not.
        """
        spots = mean.reshape(2, -1).T
        rows, columns = np.nonzero(self.valid)
        at = np.stack([columns, rows], axis=1) - (np.array(self.valid.shape[::-1]) - 1) / 2
        weight = self.flux[self.valid].astype(float)
        shift = weight @ spots / weight.sum()
        middle = weight @ at / weight.sum()
        lever = at - middle
        stretch = float(
            (weight[:, None] * lever * (spots - shift)).sum() / (weight[:, None] * lever**2).sum()
        )
        lattice = shift + stretch * lever
        return replace(self, references_px=(self.references_px + lattice).astype(np.float32))


G = TypeVar("G", bound=SensorGeometry)


def require_kind(grid: SensorGeometry, kind: type[G]) -> G:
    """The geometry, for code that works with one kind of sensor only.

    Raises
    ------
    IncompatibleProduct
        It is of another kind.
    """
    if not isinstance(grid, kind):
        raise IncompatibleProduct(
            f"this is the geometry of a sensor of kind '{grid.kind}'; '{kind.kind}' is needed"
        )
    return grid
