"""Derivatives of Shack-Hartmann slopes by the optical path on the lenslets."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from escape_hw.api.sensor import SubApertureGrid
from escape_hw.config.sensor_models import ShackHartmannSection
from escape_hw.pipeline.slopes import windows
from escape_sim.geometry import PupilGeometry
from escape_sim.shack_hartmann import field_pixels, first_pixels, lenslet_transform

if TYPE_CHECKING:
    from escape_hw.config.models import SystemConfig

#: Steps (rows down, columns right) from a window to the lenslets whose light it sees.
STEPS = tuple((down, right) for down in (-1, 0, 1) for right in (-1, 0, 1))
#: Shapes of the wavefront within a lenslet that turbulence is made of there; the rest is a thousandth.
_SHAPES = 14
#: Variance of a spot's motion along an axis for a lenslet as wide as r0, in (lambda / d)^2 (Fried 1975).
_MOTION = 0.17
#: Outer scale of the turbulence in pupil diameters.
_OUTER_SCALE = 4.0
#: Nodes of the average over spot motion, and the step of their lattice: neighbouring Fibonacci numbers.
_NODES, _STEP = 34, 21
#: Share of a full turn from one window's lattice to the next one's: the golden one, no multiple repeats.
_TURN = (np.sqrt(5) - 1) / 2
#: Ways to see a wavefront: quarter turns, mirrored or not.
_SIGHTS = 8


def slope_weights(
    config: SystemConfig, grid: SubApertureGrid, pupil: PupilGeometry
) -> dict[tuple[int, int], NDArray[np.float64]]:
    """Mean derivative of each slope by the optical path on its lenslet and on the eight around it.

    With ``E(u) = sum_p A_p exp(i phi_p) F(u, p)``, the light of all lenslets added as intensity and
    ``s = sum u I / sum I`` over the window,
    ``ds/dphi_p = -2 A_p Im sum_u (u - s) conj(E(u)) F(u, p) / sum I``.
    Pixels below the threshold drop out of both sums, and the threshold is subtracted from those
    above. Which pixels these are changes as the spot moves, so the derivative is averaged over a
    Gaussian motion of the spots of ``grid.motion_px`` rms along each axis; without the average the
    response would depend on how each lenslet happens to fall on the pixels. And it is averaged over what
    turbulence there is within a lenslet (:func:`lenslet_turbulence`), which lifts the wings of the spots
    above the threshold: without it more of them would seem cut off, and scalings come out too small.

    Parameters
    ----------
    config
        Design of sensor, camera and beam.
    grid
        The grid found on the camera.
    pupil
        The sampled pupil.

    Returns
    -------
    dict
        For each step in :data:`STEPS`: ``(2, n_valid, p, p)`` in pixels per metre, x then y.
    """
    views = _Views(config, grid, pupil)
    moves = grid.motion_px * gaussian_lattice() if grid.motion_px else np.zeros((1, 2))
    blur = np.zeros((len(moves), pupil.n_pix, pupil.n_pix))
    if grid.motion_px and grid.air_px:
        blur = np.sqrt(_strength(config, grid)) * lenslet_turbulence(pupil.n_pix)
    out = {step: np.zeros((2, grid.n_valid, pupil.n_pix, pupil.n_pix)) for step in STEPS}
    for move, phase in zip(moves, blur, strict=True):
        views.accumulate(out, move, phase, 1 / len(moves))
    wave = 2 * np.pi / config.system.wavelength_m
    return {step: block * wave for step, block in out.items()}


def gaussian_lattice() -> NDArray[np.float64]:
    """Places ``(n, 2)`` of equal weight whose mean stands for that over a round Gaussian of unit rms.

    What pixels and threshold do to a slope repeats from pixel to pixel, and a grid of few nodes that lie
    more than half a pixel apart takes the repetition for a constant: with five Gauss-Hermite nodes per
    axis the response kept a pattern of 4 %, and slopes seemed to sample the wavefront up to 2.5 % of a
    sub-aperture off. On a Fibonacci lattice (Sloan & Joe 1994), mapped to the Gaussian axis by axis, no
    two nodes share a coordinate; it is shifted so that every node has its mirror image.
    """
    i = np.arange(_NODES)
    paired = (i * _STEP + (_STEP - 1) // 2) % _NODES
    places = ndtri((np.stack([i, paired], axis=1) + 0.5) / _NODES)
    return np.asarray(places / places.std(axis=0))


def lenslet_turbulence(samples: int) -> NDArray[np.float64]:
    """Wavefronts within a square lenslet as wide as r0, without piston and tilt, in radians.

    Kolmogorov turbulence of structure function ``6.88 (r / r0)^(5/3)``, one wavefront for each place of
    :func:`gaussian_lattice`: its shapes are independent of one another and of the places, and opposite places
    have wavefronts turned by half a turn, so that on the whole no side of the lenslet is preferred.

    Parameters
    ----------
    samples
        Across the lenslet.

    Returns
    -------
    ndarray, ``(n_places, samples, samples)``
    """
    u = (np.arange(samples) - (samples - 1) / 2) / samples
    x, y = (at.ravel() for at in np.meshgrid(u, u))
    apart = np.hypot(x[:, None] - x, y[:, None] - y)
    tilts = np.linalg.qr(np.stack([np.ones_like(x), x, y], axis=1))[0]
    rest = np.eye(x.size) - tilts @ tilts.T
    power, shapes = np.linalg.eigh(rest @ (-0.5 * 6.88 * apart ** (5 / 3)) @ rest)
    half = gaussian_lattice()[: _NODES // 2]
    drawn = np.random.default_rng(5).standard_normal((len(half), _SHAPES))
    drawn = np.linalg.qr(np.concatenate([half, drawn], axis=1))[0][:, 2:] * np.sqrt(len(half))
    made = (drawn * np.sqrt(power[-_SHAPES:])) @ shapes[:, -_SHAPES:].T
    first = made.reshape(-1, samples, samples)
    return np.concatenate([first, first[::-1, ::-1, ::-1]])


def _sights(phase: NDArray[np.float64]) -> NDArray[np.float64]:
    """A wavefront ``(p, p)`` in all orientations that a square has ``(8, p, p)``; each is as likely."""
    return np.stack([np.rot90(seen, turns) for seen in (phase, phase.T) for turns in range(_SIGHTS // 2)])


def _strength(config: SystemConfig, grid: SubApertureGrid) -> float:
    """``(d / r0)^(5/3)`` of the turbulence on a lenslet, from how far the air moves its spot."""
    sensor = config.sensor_as(ShackHartmannSection)
    large = 1 - (1 / (_OUTER_SCALE * sensor.n_sub)) ** (1 / 3)
    return float((grid.air_px / sensor.spot_px) ** 2 / (_MOTION * large))


class _Views:
    """Images of a window's nine lenslets on the window's pixels, for all windows at once."""

    def __init__(self, config: SystemConfig, grid: SubApertureGrid, pupil: PupilGeometry) -> None:
        sensor = config.sensor_as(ShackHartmannSection)
        n, p, spot = pupil.n_sub, pupil.n_pix, sensor.spot_px
        width, height = config.devices.wfs.region[2:]
        boxes = windows(grid.centres_px(), grid.pitch_px, (height, width)).astype(np.intp)
        rows, columns = np.nonzero(grid.valid)
        size = int((boxes[:, 1::2] - boxes[:, ::2]).max())
        self._rows_at = boxes[:, 0, None] + np.arange(size)
        self._columns_at = boxes[:, 2, None] + np.arange(size)
        # All windows of a row begin at the same pixel row, all of a column at the same pixel column.
        row_at, column_at = np.zeros((2, n, size), np.intp)
        row_at[rows], column_at[columns] = self._rows_at, self._columns_at
        in_y, in_x = self._rows_at < boxes[:, 1, None], self._columns_at < boxes[:, 3, None]
        self._inside = in_y[:, :, None] & in_x[:, None, :]
        blocks = pupil.amplitude.reshape(n, p, n, p).transpose(0, 2, 1, 3).astype(float)
        light = np.square(blocks).sum(axis=(2, 3))
        counts = sensor.threshold * (2**config.devices.wfs.bit_depth - 1)
        # The threshold in the units of the intensities here, by the light of a bright sub-aperture.
        self._cut = counts / grid.counts * float(np.percentile(light[light > 0], 95)) if grid.counts else 0.0
        self._samples = (np.arange(p) - (p - 1) / 2) / p
        self._spot = spot
        angle = 2 * np.pi * _TURN * np.arange(len(rows))
        #: Directions of the lattice's axes in each window ``(2, n_valid)``, and how it sees the wavefronts.
        self._axes = np.stack([np.cos(angle), np.sin(angle)])
        self._sight = np.arange(len(rows)) % _SIGHTS
        # An average over motion is not worth double precision; a small-signal limit is.
        self._real = np.dtype(np.float32 if grid.motion_px else np.float64)
        self._complex = np.dtype(np.complex64 if grid.motion_px else np.complex128)
        self._blocks, self._along = {}, {}
        field = field_pixels(p, spot)
        # The windows stay on the grid as it was found; the lenslets stand where the references,
        # averaged over the whole run, put the lattice.
        (y_first, y_pitch), (x_first, x_pitch) = _lattice(grid)
        for step in STEPS:
            i, j = rows + step[0], columns + step[1]
            exists = (i >= 0) & (i < n) & (j >= 0) & (j < n)
            i, j = np.clip(i, 0, n - 1), np.clip(j, 0, n - 1)
            self._blocks[step] = (blocks[i, j] * exists[:, None, None]).astype(self._real)
            self._along[step] = tuple(
                self._transform(first + (np.arange(n) + by) * pitch, at, p, field)[number]
                for first, pitch, by, at, number in (
                    (y_first, y_pitch, step[0], row_at, rows),
                    (x_first, x_pitch, step[1], column_at, columns),
                )
            )

    def _transform(
        self, centre: NDArray[np.floating], at: NDArray[np.intp], p: int, field: int
    ) -> NDArray[np.complex128]:
        """Fourier matrices ``(n_valid, p, size)``, zero where the lenslet's image does not reach."""
        first = first_pixels(centre, field)
        size = at.shape[1]
        reach = (at >= first[:, None]) & (at < first[:, None] + field)
        matrix = lenslet_transform(centre, at[:, 0], p, size, self._spot) * reach[:, None, :]
        return matrix.astype(self._complex)

    def accumulate(
        self,
        out: dict[tuple[int, int], NDArray[np.float64]],
        move: NDArray[np.float64],
        phase: NDArray[np.float64],
        share: float,
    ) -> None:
        """Add ``share`` times the derivatives, spots moved by some pixels ``(2,)`` and blurred by a phase.

        Every window turns the move and mirrors the phase in its own way.
        """
        (cosine, sine), (along, across) = self._axes, move
        blur = np.exp(1j * _sights(phase)).astype(self._complex)[self._sight]
        tilt = [
            np.exp(2j * np.pi * d[:, None] * self._samples / self._spot).astype(self._complex).conj()
            for d in (sine * along + cosine * across, cosine * along - sine * across)
        ]
        swing = tilt[0][:, :, None] * tilt[1][:, None, :] * blur
        fields = {}
        image = np.zeros(self._inside.shape, self._real)
        for step in STEPS:
            fy, fx = self._along[step]
            amplitude = self._blocks[step] * swing
            e = np.matmul(np.matmul(fy.transpose(0, 2, 1), amplitude), fx)
            image += e.real**2 + e.imag**2
            fields[step] = (amplitude, e)
        counted = np.where(self._inside, np.maximum(image - self._cut, 0.0), 0.0)
        total = np.maximum(counted.sum(axis=(1, 2)), 1e-30)
        seen = self._inside & (image > self._cut)
        x, y = self._columns_at[:, None, :], self._rows_at[:, :, None]
        for axis, at in enumerate((x, y)):
            middle = (counted * at).sum(axis=(1, 2)) / total
            lever = ((at - middle[:, None, None]) * seen * (share / total)[:, None, None]).astype(self._real)
            for step, (amplitude, e) in fields.items():
                fy, fx = self._along[step]
                back = np.matmul(np.matmul(fy, lever * e.conj()), fx.transpose(0, 2, 1))
                out[step][axis] += -2 * np.imag(amplitude * back)


def _lattice(grid: SubApertureGrid) -> tuple[tuple[float, float], tuple[float, float]]:
    """First centre and pitch of the lenslets along rows and along columns, references included."""
    rows, columns = np.nonzero(grid.valid)
    out = []
    for axis, number in ((1, rows), (0, columns)):
        pitch, first = np.polyfit(number, grid.references_px[:, axis].astype(float), 1)
        out.append((grid.origin_px[axis] + float(first), grid.pitch_px + float(pitch)))
    return out[0], out[1]
