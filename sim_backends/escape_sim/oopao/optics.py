"""OOPAO as the twin's Shack-Hartmann and pyramid optics; resampling of its images to camera pixels."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from escape_hw.pipeline.slopes.shack_hartmann import subaperture_windows
from escape_sim.oopao.library import make_lenslets, make_pyramid, make_source, suppress_output
from escape_sim.optics.base import ModulatedOptics
from escape_sim.optics.fourier_filter import next_fast_length
from escape_sim.optics.modulation import ModulationPath
from escape_sim.optics.pyramid import GridRegion, Prism
from escape_sim.optics.shack_hartmann import LensletOptics, field_pixels, first_pixels

if TYPE_CHECKING:
    from escape_hw.api.sensor import SubApertureGrid


#: OOPAO's pixels per lambda/d: critical sampling of an intensity.
SAMPLING = 2


def trigonometric_interpolation(at: NDArray[np.float64], period: int) -> NDArray[np.float64]:
    """Matrix ``(*at.shape, period)`` that interpolates a band-limited periodic signal at ``at``.

    An image of ``period / 2`` pupil samples has frequencies below ``period / 2`` only, so the
    interpolation of ``period`` samples (an even number) is exact.
    """
    top = period // 2 - 1
    phase = 2 * np.pi / period * (at[..., None] - np.arange(period))
    harmonics = np.arange(1, top + 1)
    return np.asarray((1 + 2 * np.cos(phase[..., None] * harmonics).sum(axis=-1)) / period)


def camera_pixel_matrix(offset_px: NDArray[np.float64], n_pix: int, spot_px: float) -> NDArray[np.float64]:
    """Matrix from OOPAO's samples of a lenslet's image to camera pixels, along one axis.

    ``offset_px`` are pixels relative to the lenslet's centre. The matrix ``(*offset_px.shape, SAMPLING *
    n_pix)`` is normalised so that a whole field contains the light of the lenslet.
    """
    period = SAMPLING * n_pix
    at = (period - 1) / 2 + offset_px * SAMPLING / spot_px
    return trigonometric_interpolation(at, period) * SAMPLING / spot_px


@dataclass(frozen=True, slots=True, eq=False)
class WindowMoments:
    """Weights of OOPAO's samples of one lenslet in each window's sums."""

    #: Index of the lenslet among the lit ones ``(n_valid,)``; arbitrary where the weights are 0.
    lenslet: NDArray[np.intp]
    #: Weights ``(n_valid, samples, 2)`` for the window's sum and its first moment about its own lenslet's
    #: centre, along either axis.
    along_x: NDArray[np.float64]
    along_y: NDArray[np.float64]


def window_moments(
    grid: SubApertureGrid, lit: NDArray[np.bool_], shape: tuple[int, int], n_pix: int, spot_px: float
) -> list[WindowMoments]:
    """Weights of every valid window for its own lenslet and the eight around it.

    ``lit (n_sub, n_sub)`` are the lit lenslets, in whose order OOPAO returns images; other parameters as for
    :class:`LensletOptics`.
    """
    n_sub = lit.shape[0]
    number = np.where(lit, np.cumsum(lit).reshape(lit.shape) - 1, -1)
    rows, columns = np.nonzero(grid.valid)
    top, end, left, right = subaperture_windows(grid.centres_px(), grid.pitch_px, shape).T

    def along(
        origin: float,
        own_index: NDArray[np.intp],
        low: NDArray[np.int32],
        high: NDArray[np.int32],
        offset: int,
    ) -> NDArray[np.float64]:
        centres = np.asarray(origin + np.arange(n_sub) * grid.pitch_px, dtype=np.float64)
        other = np.clip(own_index + offset, 0, n_sub - 1)
        size = field_pixels(n_pix, spot_px)
        first = first_pixels(centres, size)[other]
        pixels = low[:, None] + np.arange(int((high - low).max()))
        matrix = camera_pixel_matrix(pixels - centres[other, None], n_pix, spot_px)
        visible = (pixels < high[:, None]) & (pixels >= first[:, None]) & (pixels < first[:, None] + size)
        matrix[~visible] = 0.0
        moment_arm = (pixels - centres[own_index, None])[..., None]
        return np.stack([matrix.sum(axis=1), (moment_arm * matrix).sum(axis=1)], axis=2)

    out = []
    for down in (-1, 0, 1):
        for aside in (-1, 0, 1):
            i, j = rows + down, columns + aside
            inside = (i >= 0) & (i < n_sub) & (j >= 0) & (j < n_sub)
            lenslet = np.where(inside, number[np.clip(i, 0, n_sub - 1), np.clip(j, 0, n_sub - 1)], -1)
            x = along(grid.origin_px[0], columns, left, right, aside)
            y = along(grid.origin_px[1], rows, top, end, down)
            x[lenslet < 0] = 0.0
            out.append(WindowMoments(np.maximum(lenslet, 0), x, y))
    return out


class OOPAOShackHartmann(LensletOptics):
    """Shack-Hartmann optics by OOPAO's propagation; parameters of :class:`LensletOptics`.

    OOPAO's detector has a whole number of pixels per lenslet and of pixels per lambda/d, unlike the
    bench's camera. OOPAO therefore computes each lenslet at two pixels per lambda/d over its full field,
    which exact trigonometric interpolation resamples to the camera's pixels.

    Raises
    ------
    ConfigError
        OOPAO is not installed.
    ValueError
        The amplitude has another shape, ``n_pix`` is odd, or a lit lenslet is outside the region.
    """

    def _prepare(self, wavelength_m: float, spot_px: float) -> None:
        if self._n_pix % 2:
            raise ValueError(
                f"{self._n_pix} samples per lenslet; OOPAO centres its spots on even numbers only"
            )
        # Only angles matter, so the size of the pupil is arbitrary: one metre per lenslet.
        self._light = make_source(self.amplitude, float(self._n_sub), wavelength_m)
        self._sensor = make_lenslets(self._light, self._n_sub, SAMPLING * self._n_pix)
        self._lit_lenslets = np.argwhere(self._sensor.sh_data["src_0"].valid_subapertures)
        self._to_x, self._to_y = (
            camera_pixel_matrix(
                first[:, None] + np.arange(self._size) - centres[:, None], self._n_pix, spot_px
            )
            for centres, first in ((self._x, self._x0), (self._y, self._y0))
        )

    def _add_intensity(self, opd_m: NDArray[np.floating], out: NDArray[np.floating]) -> None:
        light, size = self._light, self._size
        light.propagate(opd_m, self._sensor)
        spots = np.asarray(self._sensor.maps_intensity) / light.photons_per_unit
        for (i, j), spot in zip(self._lit_lenslets, spots, strict=True):
            box = out[self._y0[i] : self._y0[i] + size, self._x0[j] : self._x0[j] + size]
            # OOPAO's image of a lenslet has x along its rows.
            box += self._to_y[i] @ spot.T @ self._to_x[j].T


#: OOPAO's faces, numbered clockwise from the lower right, in the order of this package.
_FACES = (2, 3, 1, 0)


class OOPAOPyramid(ModulatedOptics):
    """Pyramid optics by OOPAO's propagation.

    Parameters
    ----------
    amplitude, diameter_px, wavelength_m, centres_px, shape, modulation, rooftop, samples, grid_px
        As for :class:`PyramidOptics`. OOPAO's grid contains two pupils side by side, so ``grid_px`` is at
        least twice the pupil map's side.
    diameter_m
        Side of the pupil map in metres, needed for OOPAO's mirrors only.

    Raises
    ------
    ConfigError
        OOPAO is not installed.
    ValueError
        Amplitude, samples or grid are inconsistent.
    """

    def __init__(
        self,
        amplitude: NDArray[np.float32],
        diameter_px: float,
        wavelength_m: float,
        centres_px: NDArray[np.float64],
        shape: tuple[int, int],
        modulation: ModulationPath,
        *,
        rooftop: float = 0.0,
        samples: int = 1,
        grid_px: int | None = None,
        diameter_m: float = 1.0,
    ) -> None:
        n = amplitude.shape[0]
        if amplitude.shape != (n, n) or n % (2 * samples):
            raise ValueError(
                f"amplitude has shape {amplitude.shape}; it must be square, with a side of "
                f"a multiple of {2 * samples} samples"
            )
        side = n // samples
        min_grid = max(2 * side, max(shape) if grid_px is None else grid_px)
        grid = next_fast_length(min_grid, samples) if grid_px is None else min_grid
        if grid % 2 or (grid_px is not None and grid != grid_px):
            raise ValueError(f"a grid of {grid_px} pixels; OOPAO needs an even number, at least {2 * side}")
        super().__init__(amplitude, shape)
        # OOPAO's unit of tilt is one wave between the centres of the outermost samples.
        self._unit = (n - 1) / (diameter_px * samples)
        self._region_on_camera = GridRegion(np.asarray(centres_px, dtype=float), shape, grid, 1)
        shifts = self._region_on_camera.shifts(side)
        separation = (grid - 2 * side) // 4 * 2
        self.light = make_source(self.amplitude, diameter_m, wavelength_m)
        roof = Prism(shifts, diameter_px, rooftop).roof_height * np.sqrt(2) / samples
        edge = (grid - 2 * side - separation) // 2
        self.sensor = make_pyramid(self.light, side, separation, edge, roof)
        nominal = (side + separation) / 2 * np.array([[-1, -1], [1, -1], [-1, 1], [1, 1]])
        image_offsets = (shifts - (grid - side) / 2 - nominal)[np.argsort(_FACES)]
        with suppress_output():
            self.sensor.apply_shift_wfs(list(image_offsets[:, 0]), list(-image_offsets[:, 1]))
        self.modulation = modulation

    def _apply_modulation(self, modulation: ModulationPath) -> None:
        tilts = modulation.points * self._unit
        with suppress_output():
            self.sensor.user_modulation_path = tilts.tolist()
            # OOPAO divides by the number of points in the field and again in the weighted sum.
            self.sensor.weight_vector = np.full(len(tilts), modulation.weight * len(tilts) ** 2)
            self.sensor.modulation = float(np.hypot(*tilts.T).max())

    def _add_intensity(self, opd_m: NDArray[np.floating], out: NDArray[np.floating]) -> None:
        self.light.propagate(opd_m, self.sensor)
        self._region_on_camera.add(np.asarray(self.sensor.cam.frame) / self.light.photons_per_unit, out)
