"""SPRINT's nominal synthetic model of a Shack-Hartmann system, fast and analytic."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.registration import Registration
from escape_hw.api.sensor import SubApertureGrid
from escape_hw.pipeline.slopes import windows
from escape_sim.geometry import PupilGeometry, actuator_positions, pitch_on_pupil, pupil_geometry
from escape_sim.influence import InfluenceFunctions
from escape_sim.shack_hartmann import field_pixels, first_pixels, lenslet_transform

if TYPE_CHECKING:
    from escape_hw.config.models import SystemConfig


def make_model(config: SystemConfig, grid: SubApertureGrid | None) -> ShackHartmannModel:
    """Entry point ``fast``; without a grid, the nominal one of the design."""
    return ShackHartmannModel(config, grid or nominal_grid(config))


def nominal_grid(config: SystemConfig) -> SubApertureGrid:
    """The design's grid, centred on the camera region, valid where the design beam is bright enough."""
    pupil = pupil_geometry(config)
    n, p = pupil.n_sub, pupil.n_pix
    flux = np.square(pupil.amplitude, dtype=float).reshape(n, p, n, p).sum(axis=(1, 3))
    flux /= np.percentile(flux[flux > 0], 95)
    valid = flux >= config.sensor.min_flux
    pitch = config.sensor.pitch_px
    width, height = config.devices.wfs.region[2:]
    origin = ((width - 1) / 2 - pitch * (n - 1) / 2, (height - 1) / 2 - pitch * (n - 1) / 2)
    references = np.zeros((int(valid.sum()), 2), np.float32)
    return SubApertureGrid(pitch, origin, valid, references, flux.astype(np.float32))


class ShackHartmannModel:
    """Small-signal slopes of a diffractive Shack-Hartmann sensor behind a Gaussian-actuator mirror.

    The centre of gravity of a spot is a smooth function of the phase on its lenslet; its first
    derivative at a flat wavefront is a fixed weight map per lenslet, so a matrix is one small
    product per sub-aperture and no frame is ever rendered.

    Parameters
    ----------
    config
        The design: sensor, mirror and beam. Its ``twin`` section is not read.
    grid
        The grid found on the camera.
    """

    name = "fast"

    def __init__(self, config: SystemConfig, grid: SubApertureGrid) -> None:
        self._pupil = pupil_geometry(config)
        if grid.valid.shape != (self._pupil.n_sub, self._pupil.n_sub):
            raise ValueError(
                f"the grid has {grid.valid.shape} lenslets, the design {self._pupil.n_sub} x {self._pupil.n_sub}"
            )
        self._positions = actuator_positions(config)
        self._pitch = pitch_on_pupil(config)
        self._coupling = config.devices.dm.coupling
        self._metres = 2 * config.devices.dm.stroke_m
        self._rows, self._columns = np.nonzero(grid.valid)
        self._weights = self._slope_weights(config, grid)

    @property
    def n_act(self) -> int:
        """Number of actuators."""
        return len(self._positions)

    @property
    def sub_aperture_m(self) -> float:
        """Size of a sub-aperture on the pupil in metres."""
        return self._pupil.sub_aperture_m

    def influence_functions(self) -> tuple[NDArray[np.float64], NDArray[np.bool_], float]:
        """Nominal influence functions for the modal basis, see :class:`SyntheticModel`."""
        # Half the sampling is ample for shapes as smooth as these.
        pupil = PupilGeometry(
            self._pupil.n_sub, self._pupil.n_pix // 2, self._pupil.sub_aperture_m,
            self._pupil.coordinates_m.reshape(-1, 2).mean(axis=1), self._pupil.amplitude[::2, ::2],
        )  # fmt: skip
        x = pupil.coordinates_m
        surfaces = self._influence(1.0).surfaces(Registration(), self.sub_aperture_m, x, x)
        r2 = x[:, None] ** 2 + x[None, :] ** 2
        radius = self._pupil.n_sub * self._pupil.sub_aperture_m / 2
        return surfaces, r2 <= radius**2, pupil.pixel_m

    def zonal_matrix(self, registration: Registration, width: float = 1.0) -> NDArray[np.float64]:
        """Slopes in pixels per unit command ``(n_slopes, n_act)``, see :class:`SyntheticModel`."""
        x = self._pupil.coordinates_m
        along_x, along_y = self._influence(width).factors(registration, self.sub_aperture_m, x, x)
        p, n = self._pupil.n_pix, self._pupil.n_sub
        gx, gy = along_x[:, :, 0].reshape(n, p, -1), along_y[:, :, 0].reshape(n, p, -1)
        out = np.zeros((2, self._rows.size, self.n_act))
        for (down, right), block in self._weights.items():
            here = gx[np.clip(self._columns + right, 0, n - 1)]
            there = gy[np.clip(self._rows + down, 0, n - 1)]
            for axis in range(2):
                out[axis] += np.einsum("kqa,kqa->ka", there, block[axis] @ here)
        return np.asarray(out.reshape(-1, self.n_act) * self._metres)

    def _influence(self, width: float) -> InfluenceFunctions:
        return InfluenceFunctions(self._positions, self._pitch, self._coupling, width)

    def _slope_weights(
        self, config: SystemConfig, grid: SubApertureGrid
    ) -> dict[tuple[int, int], NDArray[np.float64]]:
        """Derivative of each slope by the optical path on its lenslet and on the eight around it.

        With ``E(u) = sum_p A_p exp(i phi_p) F(u, p)``, light of all lenslets added as intensity and
        ``s = sum u I / sum I`` over the window,
        ``ds/dphi_p = -2 A_p Im sum_u (u - s) conj(E(u)) F(u, p) / sum I``.

        Returns
        -------
        dict
            For each (rows down, columns right) to the lenslet: ``(2, n_valid, p, p)``.
        """
        n, p = self._pupil.n_sub, self._pupil.n_pix
        width, height = config.devices.wfs.region[2:]
        boxes = windows(grid.centres_px(), grid.pitch_px, (height, width))
        lenslets = _Lenslets(self._pupil, config.sensor.spot_px, grid)
        wave = 2 * np.pi / config.system.wavelength_m
        out = {
            (down, right): np.zeros((2, len(boxes), p, p)) for down in (-1, 0, 1) for right in (-1, 0, 1)
        }
        for k, (i, j, box) in enumerate(zip(self._rows, self._columns, boxes, strict=True)):
            seen = {
                (down, right): lenslets.seen_in(box, i + down, j + right)
                for down, right in out
                if 0 <= i + down < n and 0 <= j + right < n
            }
            parts = [part for part in seen.values() if part is not None]
            total = sum(float(q.intensity.sum()) for q in parts)
            centre = [sum(float(q.intensity.sum(1 - a) @ q.at[a]) for q in parts) / total for a in (0, 1)]
            for step, q in seen.items():
                if q is not None:
                    for axis, along in enumerate((1, 0)):
                        lever = q.at[along] - centre[along]
                        field = q.field.conj() * (lever[None, :] if along == 1 else lever[:, None])
                        out[step][axis, k] = q.back_projected(field) * (wave / total)
        return out


class _Seen:
    """The part of one lenslet's image that falls into a window."""

    def __init__(
        self,
        amplitude: NDArray[np.float64],
        along_y: NDArray[np.complex128],
        along_x: NDArray[np.complex128],
        rows: NDArray[np.intp],
        columns: NDArray[np.intp],
    ) -> None:
        self._amplitude, self._y, self._x = amplitude, along_y, along_x
        self.at = (rows, columns)
        self.field = along_y.T @ amplitude @ along_x
        self.intensity = np.abs(self.field) ** 2

    def back_projected(self, weighted: NDArray[np.complex128]) -> NDArray[np.float64]:
        """``-2 A Im sum_u weighted(u) F(u, p)`` on the lenslet's samples ``(p, p)``."""
        return np.asarray(-2 * self._amplitude * np.imag(self._y @ weighted @ self._x.T))


class _Lenslets:
    """Images of single lenslets at a flat wavefront, for any window."""

    def __init__(self, pupil: PupilGeometry, spot_px: float, grid: SubApertureGrid) -> None:
        n, p = pupil.n_sub, pupil.n_pix
        self._amplitudes = pupil.amplitude.reshape(n, p, n, p).transpose(0, 2, 1, 3).astype(float)
        size = field_pixels(p, spot_px)
        line = np.arange(n) * grid.pitch_px
        self._axes = []
        for origin in grid.origin_px:
            first = first_pixels(origin + line, size)
            self._axes.append((first, lenslet_transform(origin + line, first, p, size, spot_px)))
        self._size = size

    def seen_in(self, box: NDArray[np.int32], row: int, column: int) -> _Seen | None:
        """What the window ``box`` sees of lenslet ``(row, column)``; None when nothing."""
        amplitude = self._amplitudes[row, column]
        (x0, fx), (y0, fy) = self._axes
        top, end = max(box[0] - y0[row], 0), min(box[1] - y0[row], self._size)
        left, right = max(box[2] - x0[column], 0), min(box[3] - x0[column], self._size)
        if not amplitude.any() or top >= end or left >= right:
            return None
        return _Seen(
            amplitude, fy[row][:, top:end], fx[column][:, left:right],
            np.arange(top, end) + y0[row], np.arange(left, right) + x0[column],
        )  # fmt: skip
