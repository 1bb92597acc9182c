"""Measured geometry of a wavefront sensor on its camera, and the interface of slope computations."""

from __future__ import annotations

import abc
from dataclasses import dataclass, replace
from typing import ClassVar, Protocol, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.representation import short_repr
from escape_hw.deprecation import renamed_members
from escape_hw.errors import IncompatibleProduct


@renamed_members(with_motion="with_slope_statistics", short_look="short_run_note")
class SensorGeometry(abc.ABC):
    """Geometry of a sensor of any kind, an immutable dataclass.

    A sub-aperture is the part of the pupil of one slope pair: a lenslet, or a pixel of a pupil image.

    Attributes
    ----------
    kind
        Value of ``sensor.kind`` in the configuration.
    slope_unit
        Unit of the slopes.
    elements
        Name of the sub-apertures, plural.
    short_run_note
        Note on the error of the geometry after a short run under turbulence.
    valid
        Valid sub-apertures, boolean ``(n_rows, n_columns)``.
    flux
        Flux of every sub-aperture relative to a bright one, ``(n_rows, n_columns)``.
    counts
        Counts per frame of a bright sub-aperture; 0 if unknown.
    background
        Background level in counts that was subtracted in the absence of a dark frame.
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

    def with_background(self, counts: float) -> Self:
        """The geometry with this background level."""
        return replace(self, background=counts)  # type: ignore[type-var]  # a dataclass

    def with_pixel_noise(self, counts: float) -> Self:
        """The geometry with the rms noise of a pixel without light, if a model needs it; by default not."""
        return self

    @abc.abstractmethod
    def outlines(self) -> tuple[tuple[float, float, float], ...]:
        """Outlines of sub-apertures or pupil images on the camera: (x, y, half width) in pixels each."""

    @abc.abstractmethod
    def with_slope_statistics(
        self,
        rms: float,
        pokes: float = 0.0,
        n_effective: float = 0.0,
        persistent_fraction: float = 0.0,
        residual_tilt: float = 0.0,
        mean: NDArray[np.float64] | None = None,
    ) -> Self:
        """The geometry with the slope statistics of a measurement.

        Parameters
        ----------
        rms
            Temporal rms of the slopes, in their unit.
        pokes
            Rms surface of the random pokes, all modes, as fraction of full stroke.
        n_effective
            Number of independent realisations of the turbulence; 0 if unknown.
        persistent_fraction
            Fraction of the slope variance that is correlated over two frames; 0 if unknown.
        residual_tilt
            In closed loop: temporal rms per axis of the slopes' mean over the pupil; 0 in open loop.
        mean
            Mean slopes ``(n_slopes,)`` relative to the references; ``None`` if unknown.
        """

    @abc.abstractmethod
    def with_mean_slopes(self, mean: NDArray[np.float64]) -> Self:
        """The geometry with references from a longer average over the turbulence.

        The geometry is found on the first frames of a run and contains their mean aberration, which
        averages out over the whole run. Pixels and mask do not change.

        Parameters
        ----------
        mean
            Mean slopes of the run ``(n_slopes,)`` relative to the present references.
        """


class SlopeFunction(Protocol):
    """Computes slopes from frames."""

    @property
    def grid(self) -> SensorGeometry:
        """The geometry of the slopes."""

    @property
    def shape(self) -> tuple[int, int]:
        """Shape of the frames (rows, columns)."""

    @property
    def flux(self) -> NDArray[np.float32]:
        """Flux of each valid sub-aperture in the last frame ``(n_valid,)``, in counts."""

    def __call__(
        self,
        frame: NDArray[np.uint16],
        flux: NDArray[np.float32] | None = None,
        out: NDArray[np.float32] | None = None,
    ) -> NDArray[np.float32]:
        """Slopes ``(n_slopes,)``, in ``out`` if given; ``flux (n_valid,)`` is filled when given."""

    def shift_references(self, offset: NDArray[np.float32]) -> None:
        """Add an offset ``(n_slopes,)`` to the reference slopes."""


@renamed_members(air_px="turbulence_px")
@dataclass(frozen=True, slots=True, eq=False)
class SubApertureGrid(SensorGeometry):
    """The lenslet grid of a Shack-Hartmann sensor on the camera.

    The centre of lenslet ``(i, j)`` (row, column) is at ``origin + (j, i) * pitch`` pixels of the region,
    x along columns and y along rows, pixel centres at integers.

    Parameters
    ----------
    pitch_px
        Lenslet pitch in camera pixels; any real number.
    origin_px
        Centre of lenslet (0, 0) as (x, y) in pixels.
    valid
        Valid sub-apertures, boolean ``(n_rows, n_columns)``.
    references_px
        Reference spot positions ``(n_valid, 2)`` as (x, y) relative to the lenslet centres.
    flux
        Flux of every sub-aperture relative to a bright one, ``(n_rows, n_columns)``.
    counts
        Counts per frame of a bright sub-aperture (95th percentile of the illuminated ones); 0 if unknown.
    motion_px
        Rms spot motion per axis, in pixels, during the measurement that a model of this sensor describes.
    background
        Background level in counts that was subtracted in the absence of a dark frame.
    turbulence_px
        Part of ``motion_px`` that is correlated between frames in open loop, and therefore due to the
        turbulence and not to pokes; rms per axis in pixels, 0 if unknown.
    pokes
        Rms surface of the random pokes, all modes, as fraction of full stroke; 0 without random pokes.
    pixel_noise
        Rms noise of a pixel without light in one frame, in counts; 0 if unknown.
    numbering_offsets
        Least and largest offset, along x and along y, of the other numberings that the light does not
        exclude: with +1 along x the first column of the pupil's lenslets may be the next one. 0 if there are
        none.
    """

    kind: ClassVar[str] = "shack-hartmann"
    slope_unit: ClassVar[str] = "pixel"
    elements: ClassVar[str] = "sub-apertures"
    short_run_note: ClassVar[str] = (
        "the references contain the mean focus of {seconds:.2g} s of turbulence, which reduces the Strehl "
        "ratio; the matrix is not affected: close the loop with references averaged over a longer time"
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
    pokes: float = 0.0
    pixel_noise: float = 0.0
    numbering_offsets: tuple[tuple[int, int], tuple[int, int]] = ((0, 0), (0, 0))
    __repr__ = short_repr

    def centres_px(self) -> NDArray[np.float64]:
        """Centres ``(n_valid, 2)`` of the valid lenslets as (x, y) in pixels."""
        rows, columns = np.nonzero(self.valid)
        return np.stack(
            [self.origin_px[0] + columns * self.pitch_px, self.origin_px[1] + rows * self.pitch_px], axis=1
        )

    def with_pixel_noise(self, counts: float) -> SubApertureGrid:
        """See :meth:`SensorGeometry.with_pixel_noise`."""
        return replace(self, pixel_noise=counts)

    def outlines(self) -> tuple[tuple[float, float, float], ...]:
        """See :meth:`SensorGeometry.outlines`."""
        return tuple((float(x), float(y), self.pitch_px / 2) for x, y in self.centres_px())

    def with_slope_statistics(
        self,
        rms: float,
        pokes: float = 0.0,
        n_effective: float = 0.0,
        persistent_fraction: float = 0.0,
        residual_tilt: float = 0.0,
        mean: NDArray[np.float64] | None = None,
    ) -> SubApertureGrid:
        """See :meth:`SensorGeometry.with_slope_statistics`.

        Without a ``persistent_fraction``, as in closed loop, ``turbulence_px`` is kept: the loop removes the
        motion of the spots but not the turbulence within a lenslet.
        """
        turbulence = rms * float(np.sqrt(persistent_fraction)) if persistent_fraction else self.turbulence_px
        return replace(self, motion_px=rms, turbulence_px=turbulence, pokes=pokes)

    def with_mean_slopes(self, mean: NDArray[np.float64]) -> SubApertureGrid:
        """See :meth:`SensorGeometry.with_mean_slopes`; fits a regular lattice to the mean spots.

        Only shift and magnification of the lattice are updated, because the lenslets are regular and the
        mean turbulence is not.
        """
        spots = mean.reshape(2, -1).T
        rows, columns = np.nonzero(self.valid)
        at = np.stack([columns, rows], axis=1) - (np.array(self.valid.shape[::-1]) - 1) / 2
        weight = self.flux[self.valid].astype(float)
        shift = weight @ spots / weight.sum()
        middle = weight @ at / weight.sum()
        lever = at - middle
        magnification = float(
            (weight[:, None] * lever * (spots - shift)).sum() / (weight[:, None] * lever**2).sum()
        )
        lattice = shift + magnification * lever
        return replace(self, references_px=(self.references_px + lattice).astype(np.float32))


G = TypeVar("G", bound=SensorGeometry)


def require_kind(grid: SensorGeometry, kind: type[G]) -> G:
    """The geometry, for code that supports one kind of sensor only.

    Raises
    ------
    IncompatibleProduct
        The geometry is of another kind.
    """
    if not isinstance(grid, kind):
        raise IncompatibleProduct(
            f"this is the geometry of a sensor of kind '{grid.kind}'; '{kind.kind}' is needed"
        )
    return grid
