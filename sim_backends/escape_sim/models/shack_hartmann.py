"""Fast analytic model of a Shack-Hartmann system.

Derivatives of the slopes by the optical path, averaged over spot motion and turbulence, are applied to
mirror surfaces.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr, ndtri

from escape_hw.api.registration import Registration
from escape_hw.api.sensor import SubApertureGrid
from escape_hw.config.sensor import ShackHartmannSection
from escape_hw.pipeline.slopes.shack_hartmann import subaperture_windows
from escape_sim.mirror.influence_functions import InfluenceFunctions
from escape_sim.mirror.mode_surfaces import (
    MATRIX_AND_DERIVATIVE_KINDS,
    N_DERIVATIVES,
    Products,
    mode_surfaces,
)
from escape_sim.models.base import SummingDesignModel
from escape_sim.models.slope_operator import SlopeOperator
from escape_sim.optics.pupil import PupilGeometry, nominal_flux, pupil_from_lenslets
from escape_sim.optics.shack_hartmann import field_pixels, first_pixels, lenslet_transform

if TYPE_CHECKING:
    from escape_hw.config.system import SystemConfig


#: Steps (rows down, columns right) from a window to the lenslets whose light it receives.
NEIGHBOURS = tuple((down, right) for down in (-1, 0, 1) for right in (-1, 0, 1))
#: Turbulence modes within a lenslet; all others together have a thousandth of the variance.
_N_SHAPES = 14
#: Variance of a spot's motion along an axis for a lenslet as wide as r0, in (lambda / d)^2 (Fried 1975).
_TILT_VARIANCE = 0.17
#: Outer scale of the turbulence in pupil diameters.
_OUTER_SCALE = 4.0
#: Nodes of the average over spot motion, and step of their lattice: successive Fibonacci numbers.
_N_NODES, _LATTICE_STEP = 34, 21
#: Rotation, in turns, of the lattice from one window to the next: the golden ratio, so that none repeats.
_GOLDEN_TURN = (np.sqrt(5) - 1) / 2
#: Orientations of a square wavefront: quarter turns, mirrored or not.
_N_ORIENTATIONS = 8


def slope_weights(
    config: SystemConfig,
    grid: SubApertureGrid,
    pupil: PupilGeometry,
    wavefronts_m: Sequence[NDArray[np.floating]] = (),
    overlap: float = 0.0,
) -> dict[tuple[int, int], NDArray[np.float64]]:
    """Mean derivative of each slope by the optical path on its lenslet and on the eight around it.

    With ``E(u) = sum_p A_p exp(i phi_p) F(u, p)``, the intensities of all lenslets added and
    ``s = sum u I / sum I`` over the window,
    ``ds/dphi_p = -2 A_p Im sum_u (u - s) conj(E(u)) F(u, p) / sum I``.
    Pixels below the threshold are omitted from both sums, and the threshold is subtracted from the
    others. As these pixels change when the spot moves, the derivative is averaged over a Gaussian motion
    of ``grid.motion_px`` rms along each axis; otherwise it would depend on the position of each lenslet
    relative to the pixels. It is also averaged over the turbulence within a lenslet
    (:func:`lenslet_turbulence`), which lifts the wings of the spots above the threshold; without it
    scalings would be underestimated. Spots of neighbouring lenslets move independently: with the same
    motion, the threshold would always cut the sum of two wings at the same place, and scalings would again be
    underestimated (docs/studies/neighbouring-spots.md).

    With ``wavefronts_m``, optical paths ``(n, n)`` in metres over the pupil, the derivative is averaged over
    these as well: each is added to a spot motion. Pokes of a mirror with about one actuator per lenslet are
    not tilts of whole lenslets (docs/studies/lenslet-pokes.md). ``overlap`` is the mean share of the
    wavefront before during an exposure, whose light is added (:func:`exposure_parts`).

    Returns
    -------
    dict
        For each step in :data:`NEIGHBOURS`: ``(2, n_valid, p, p)`` in pixels per metre, x then y.
    """
    is_mean = grid.motion_px > 0 or len(wavefronts_m) > 0
    window_images = _WindowImages(config, grid, pupil, is_mean=is_mean)
    wave = 2 * np.pi / config.system.wavelength_m
    shifts = grid.motion_px * gaussian_lattice() if is_mean else np.zeros((1, 2))
    blur = np.zeros((len(shifts), pupil.n_pix, pupil.n_pix))
    if is_mean and grid.turbulence_px:
        blur = np.sqrt(_turbulence_strength(config, grid)) * lenslet_turbulence(pupil.n_pix)
    out = {step: np.zeros((2, grid.n_valid, pupil.n_pix, pupil.n_pix)) for step in NEIGHBOURS}
    phasors = [window_images.moved(*one) for one in zip(shifts, blur, strict=True)]
    by_step = nodes_by_step(len(shifts))
    nodes = max(len(shifts), len(wavefronts_m))
    for node in range(nodes):
        moved = {step: phasors[of_step[node % len(shifts)]] for step, of_step in by_step.items()}
        exposure = [(1.0, 1.0, moved)]
        if len(wavefronts_m):
            wavefront = wavefronts_m[node % len(wavefronts_m)]
            # The wavefront one lattice earlier is independent, and as symmetric as this one.
            before = wavefronts_m[(node - len(shifts)) % len(wavefronts_m)]
            exposure = [
                (share, weight, _neighbour_phasors(grid, pupil, wave * one, moved))
                for share, weight, one in exposure_parts(before, wavefront, overlap)
            ]
        window_images.accumulate(out, exposure, 1 / nodes)
    return {step: block * wave for step, block in out.items()}


def exposure_parts(
    before: NDArray[np.floating], now: NDArray[np.floating], overlap: float
) -> list[tuple[float, float, NDArray[np.floating]]]:
    """Parts of an exposure while a mirror goes from one poke to the next: shares, weights, wavefronts.

    ``overlap`` is the mean share of the wavefront before. A mirror that settles exponentially within the
    exposure leaves half of that in the mean square, as one does that is half-way for twice that time. The
    weights are those of the derivatives in a regression on pokes that are mixed in the same ratio.
    """
    if not overlap:
        return [(1.0, 1.0, now)]
    rest = max(0.5, overlap)
    power = (1 - overlap) ** 2 + overlap**2
    return [
        (share, share * ((1 - overlap) * (1 - r) + overlap * r) / power, now + r * (before - now))
        for share, r in ((overlap / rest, rest), (1 - overlap / rest, 0.0))
    ]


def _neighbour_phasors(
    grid: SubApertureGrid,
    pupil: PupilGeometry,
    phase: NDArray[np.floating],
    moved: Mapping[tuple[int, int], NDArray[np.complexfloating]],
) -> dict[tuple[int, int], NDArray[np.complexfloating]]:
    """Phasors ``(n_valid, p, p)`` of a phase over the pupil on the lenslets at each step from a window.

    Multiplied by the phasors ``moved`` of the same lenslets.
    """
    n, p = pupil.n_sub, pupil.n_pix
    rows, columns = np.nonzero(grid.valid)
    phasor = np.exp(1j * phase.reshape(n, p, n, p).transpose(0, 2, 1, 3)).astype(np.complex64)
    return {
        (i, j): moved[i, j] * phasor[np.clip(rows + i, 0, n - 1), np.clip(columns + j, 0, n - 1)]
        for i, j in NEIGHBOURS
    }


def gaussian_lattice() -> NDArray[np.float64]:
    """Nodes ``(n, 2)`` of equal weight for the mean over a round Gaussian of unit rms.

    The effect of pixels and threshold on a slope is periodic in pixels, and a regular grid of few nodes
    aliases it (docs/decisions/0019-fit-to-telemetry.md). In a Fibonacci lattice (Sloan & Joe 1994),
    mapped to the Gaussian along each axis, no two nodes share a coordinate. It is symmetric about 0.
    """
    i = np.arange(_N_NODES)
    paired = (i * _LATTICE_STEP + (_LATTICE_STEP - 1) // 2) % _N_NODES
    nodes = ndtri((np.stack([i, paired], axis=1) + 0.5) / _N_NODES)
    return np.asarray(nodes / nodes.std(axis=0))


def nodes_by_step(n_nodes: int) -> dict[tuple[int, int], NDArray[np.intp]]:
    """Nodes of :func:`gaussian_lattice` ``(n_nodes,)`` of the lenslet at each step, by those of the window's.

    Each neighbour has a random permutation, so that its motion is independent. The permutations of opposite
    neighbours are point reflections of each other: a chance correlation with one alone would be a bias of the
    shift. In turbulence adjacent tilts have correlations of 0.5 to 0.8; that hardly changes the response.
    """
    rng, own = np.random.default_rng(11), np.arange(n_nodes)
    out = {(0, 0): own}
    for i, j in NEIGHBOURS[: len(NEIGHBOURS) // 2]:
        order = rng.permutation(n_nodes)
        out[i, j], out[-i, -j] = order, (n_nodes - 1 - order)[::-1]
    return out


def lenslet_turbulence(samples: int) -> NDArray[np.float64]:
    """Wavefronts ``(n_nodes, samples, samples)`` in radians within a square lenslet as wide as r0.

    Kolmogorov turbulence of structure function ``6.88 (r / r0)^(5/3)`` without piston and tilt, one
    wavefront for each node of :func:`gaussian_lattice`. The modes' coefficients are uncorrelated with
    one another and with the nodes. Opposite nodes have wavefronts rotated by half a turn, so that no
    side of the lenslet is preferred. ``samples`` is the number of samples across the lenslet.
    """
    u = (np.arange(samples) - (samples - 1) / 2) / samples
    x, y = (grid.ravel() for grid in np.meshgrid(u, u))
    distance = np.hypot(x[:, None] - x, y[:, None] - y)
    tilts = np.linalg.qr(np.stack([np.ones_like(x), x, y], axis=1))[0]
    without_tilt = np.eye(x.size) - tilts @ tilts.T
    power, shapes = np.linalg.eigh(without_tilt @ (-0.5 * 6.88 * distance ** (5 / 3)) @ without_tilt)
    half = gaussian_lattice()[: _N_NODES // 2]
    coefficients = np.random.default_rng(5).standard_normal((len(half), _N_SHAPES))
    coefficients = np.linalg.qr(np.concatenate([half, coefficients], axis=1))[0][:, 2:] * np.sqrt(len(half))
    wavefronts = (coefficients * np.sqrt(power[-_N_SHAPES:])) @ shapes[:, -_N_SHAPES:].T
    first = wavefronts.reshape(-1, samples, samples)
    return np.concatenate([first, first[::-1, ::-1, ::-1]])


def _turbulence_strength(config: SystemConfig, grid: SubApertureGrid) -> float:
    """``(d / r0)^(5/3)`` of the turbulence on a lenslet, from the spot motion that it causes."""
    sensor = config.sensor_as(ShackHartmannSection)
    large = 1 - (1 / (_OUTER_SCALE * sensor.n_sub)) ** (1 / 3)
    return float((grid.turbulence_px / sensor.spot_px) ** 2 / (_TILT_VARIANCE * large))


class _WindowImages:
    """Images of a window's nine lenslets on the window's pixels, for all windows at once."""

    def __init__(
        self, config: SystemConfig, grid: SubApertureGrid, pupil: PupilGeometry, *, is_mean: bool
    ) -> None:
        sensor = config.sensor_as(ShackHartmannSection)
        n, p, spot = pupil.n_sub, pupil.n_pix, sensor.spot_px
        width, height = config.devices.wfs.region[2:]
        boxes = subaperture_windows(grid.centres_px(), grid.pitch_px, (height, width)).astype(np.intp)
        rows, columns = np.nonzero(grid.valid)
        size = int((boxes[:, 1::2] - boxes[:, ::2]).max())
        self._rows_at = boxes[:, 0, None] + np.arange(size)
        self._columns_at = boxes[:, 2, None] + np.arange(size)
        # All windows of a row start at the same pixel row, all of a column at the same pixel column.
        row_at, column_at = np.zeros((2, n, size), np.intp)
        row_at[rows], column_at[columns] = self._rows_at, self._columns_at
        in_y, in_x = self._rows_at < boxes[:, 1, None], self._columns_at < boxes[:, 3, None]
        self._inside = in_y[:, :, None] & in_x[:, None, :]
        blocks = pupil.amplitude.reshape(n, p, n, p).transpose(0, 2, 1, 3).astype(float)
        light = np.square(blocks).sum(axis=(2, 3))
        counts = sensor.threshold * (2**config.devices.wfs.bit_depth - 1)
        # Threshold and noise in units of the intensities here, relative to a bright sub-aperture.
        unit = float(np.percentile(light[light > 0], 95)) / grid.counts if grid.counts else 0.0
        self._threshold, self._noise = counts * unit, grid.pixel_noise * unit
        self._samples = (np.arange(p) - (p - 1) / 2) / p
        self._spot = spot
        angle = 2 * np.pi * _GOLDEN_TURN * np.arange(len(rows))
        # Axes of the lattice in each window (2, n_valid), and orientation of the wavefronts in it.
        self._axes = np.stack([np.cos(angle), np.sin(angle)])
        self._orientation = np.arange(len(rows)) % _N_ORIENTATIONS
        # Single precision suffices for an average over wavefronts, not for the small-signal limit.
        self._real = np.dtype(np.float32 if is_mean else np.float64)
        self._complex = np.dtype(np.complex64 if is_mean else np.complex128)
        self._blocks, self._along = {}, {}
        field = field_pixels(p, spot)
        # Windows are on the measured grid; lenslets are where the references, averaged over the run,
        # place the lattice.
        (y_first, y_pitch), (x_first, x_pitch) = _fit_lattice(grid)
        for step in NEIGHBOURS:
            i, j = rows + step[0], columns + step[1]
            exists = (i >= 0) & (i < n) & (j >= 0) & (j < n)
            i, j = np.clip(i, 0, n - 1), np.clip(j, 0, n - 1)
            self._blocks[step] = (blocks[i, j] * exists[:, None, None]).astype(self._real)
            y, x = y_first + (np.arange(n) + step[0]) * y_pitch, x_first + (np.arange(n) + step[1]) * x_pitch
            self._along[step] = (
                self._transform(y, row_at, p, field)[rows], self._transform(x, column_at, p, field)[columns],
            )  # fmt: skip

    def _transform(
        self, centre: NDArray[np.floating], at: NDArray[np.intp], p: int, field: int
    ) -> NDArray[np.complex128]:
        """Fourier matrices ``(n_valid, p, size)``, zero outside the lenslet's rendered field."""
        first = first_pixels(centre, field)
        size = at.shape[1]
        reach = (at >= first[:, None]) & (at < first[:, None] + field)
        matrix = lenslet_transform(centre, at[:, 0], p, size, self._spot) * reach[:, None, :]
        return matrix.astype(self._complex)

    def moved(self, shift: NDArray[np.float64], phase: NDArray[np.float64]) -> NDArray[np.complexfloating]:
        """Phasors ``(n_valid, p, p)`` of spots shifted by ``shift (2,)`` pixels and blurred by ``phase``.

        Every window rotates the shift, and orients the blurring ``phase``, in its own way.
        """
        (cosine, sine), (along, across) = self._axes, shift
        oriented = np.stack([np.rot90(p, turns) for p in (phase, phase.T) for turns in range(4)])
        blur = np.exp(1j * oriented).astype(self._complex)[self._orientation]
        tilt = [
            np.exp(2j * np.pi * d[:, None] * self._samples / self._spot).astype(self._complex).conj()
            for d in (sine * along + cosine * across, cosine * along - sine * across)
        ]
        return np.asarray(tilt[0][:, :, None] * tilt[1][:, None, :] * blur)

    def accumulate(
        self,
        out: dict[tuple[int, int], NDArray[np.float64]],
        exposure: Sequence[tuple[float, float, Mapping[tuple[int, int], NDArray[np.complexfloating]]]],
        share: float,
    ) -> None:
        """Add ``share`` times the derivatives for an exposure.

        It has one or several parts: their shares of the light, the weights of their derivatives, and the
        phasors ``(n_valid, p, p)`` of each neighbour.
        """
        fields = []
        image = np.zeros(self._inside.shape, self._real)
        for part, weight, phasors in exposure:
            for step in NEIGHBOURS:
                fy, fx = self._along[step]
                amplitude = self._blocks[step] * phasors[step]
                e = np.matmul(np.matmul(fy.transpose(0, 2, 1), amplitude), fx)
                image += self._real.type(part) * (e.real**2 + e.imag**2)
                fields.append((step, weight, amplitude, e))
        counted, above_threshold = self._apply_threshold(image)
        total = np.maximum(counted.sum(axis=(1, 2)), 1e-30)
        x, y = self._columns_at[:, None, :], self._rows_at[:, :, None]
        for axis, at in enumerate((x, y)):
            centroid = (counted * at).sum(axis=(1, 2)) / total
            moment_arm = (
                (at - centroid[:, None, None]) * above_threshold * (share / total)[:, None, None]
            ).astype(self._real)
            for step, weight, amplitude, e in fields:
                fy, fx = self._along[step]
                back_propagated = np.matmul(np.matmul(fy, moment_arm * e.conj()), fx.transpose(0, 2, 1))
                out[step][axis] += -2 * weight * np.imag(amplitude * back_propagated)

    def _apply_threshold(
        self, image: NDArray[np.floating]
    ) -> tuple[NDArray[np.floating], NDArray[np.floating]]:
        """Mean of what is counted in each pixel, and its derivative by the light in the pixel.

        With Gaussian noise of rms ``s``, of ``max(I - T + s n, 0)``: ``s (z Phi(z) + phi(z))`` with
        ``z = (I - T) / s``, and ``Phi(z)``.
        """
        excess = image - self._threshold
        if not self._noise:
            return np.where(self._inside, np.maximum(excess, 0.0), 0.0), self._inside & (excess > 0)
        z = excess / self._real.type(self._noise)
        above = ndtr(z)
        density = np.exp(-0.5 * z * z) / np.sqrt(2 * np.pi)
        return np.where(self._inside, self._noise * (z * above + density), 0.0), self._inside * above


def _fit_lattice(grid: SubApertureGrid) -> tuple[tuple[float, float], tuple[float, float]]:
    """First centre and pitch of the lenslets along y and along x, fitted to the references."""
    rows, columns = np.nonzero(grid.valid)
    out = []
    for axis, number in ((1, rows), (0, columns)):
        pitch, first = np.polyfit(number, grid.references_px[:, axis].astype(float), 1)
        out.append((grid.origin_px[axis] + float(first), grid.pitch_px + float(pitch)))
    return out[0], out[1]


#: Up to this many modes, forming their surfaces is faster than the slopes of all actuators.
_MAX_DIRECT_MODES = 12
#: Actuator pitch in lenslets up to which the shapes of pokes within lenslets count
#: (docs/studies/lenslet-pokes.md).
_MAX_PITCH = 1.5
#: Random pokes for each node of the spot motion: a smaller sample would move the shift.
_N_POKES = 8
#: Changes of the registration, in its units, within which the pokes need not be computed again.
_SAME_POKES_WITHIN = np.array([0.5, 0.5, 0.05, 0.1, 0.1])


def nominal_grid(config: SystemConfig) -> SubApertureGrid:
    """The design's grid, centred on the camera region; valid where the design flux is sufficient."""
    flux, n = nominal_flux(config), config.sensor.n_sub
    section = config.sensor_as(ShackHartmannSection)
    configured, pitch = section.valid_map(), section.pitch_px
    valid = flux >= section.min_flux if configured is None else configured
    width, height = config.devices.wfs.region[2:]
    origin = ((width - 1) / 2 - pitch * (n - 1) / 2, (height - 1) / 2 - pitch * (n - 1) / 2)
    references = np.zeros((int(valid.sum()), 2), np.float32)
    return SubApertureGrid(pitch, origin, valid, references, flux.astype(np.float32), 0.0)


class ShackHartmannModel(SummingDesignModel):
    """Small-signal slopes of a diffractive Shack-Hartmann sensor with a mirror of Gaussian actuators.

    The centre of gravity of a spot is a smooth function of the phase on its lenslet. Its derivative is
    a fixed weight map per lenslet, so a matrix needs one small product per sub-aperture and no frames.
    ``grid`` is the one measured on the camera; ``wavefronts_m`` are those of :func:`slope_weights`.

    Raises
    ------
    ValueError
        The grid does not fit the design.
    """

    name = "fast"

    def __init__(
        self,
        config: SystemConfig,
        grid: SubApertureGrid,
        wavefronts_m: Sequence[NDArray[np.floating]] = (),
        overlap: float = 0.0,
    ) -> None:
        super().__init__(config, pupil_from_lenslets(config, grid))
        if grid.valid.shape != (self._pupil.n_sub, self._pupil.n_sub):
            raise ValueError(
                f"the grid has {grid.valid.shape} lenslets, "
                f"the design {self._pupil.n_sub} x {self._pupil.n_sub}"
            )
        self._opd_per_command_m = 2 * config.devices.dm.stroke_m
        self._grid = grid
        self._variants: list[ShackHartmannModel] | None = None
        self._wavefronts_m, self._overlap = tuple(wavefronts_m), overlap
        self._around_pokes: tuple[Registration, ShackHartmannModel] | None = None

    @cached_property
    def _slopes(self) -> SlopeOperator:
        """Slopes of wavefronts; the modal basis, for which models are made too, needs none."""
        weights = slope_weights(self._config, self._grid, self._pupil, self._wavefronts_m, self._overlap)
        return SlopeOperator(weights, self._grid.valid, self._pupil.sub_aperture_m)

    def _prepare_sensor(self) -> None:
        _ = self._slopes

    def influence_functions(self) -> tuple[NDArray[np.float64], NDArray[np.bool_], float]:
        """Nominal influence functions for the modal basis, see :class:`SyntheticModel`."""
        # Half the sampling suffices for shapes as smooth as these.
        pupil = PupilGeometry(
            self._pupil.n_sub, self._pupil.n_pix // 2, self._pupil.sub_aperture_m,
            self._pupil.coordinates_m.reshape(-1, 2).mean(axis=1), self._pupil.amplitude[::2, ::2],
        )  # fmt: skip
        x = pupil.coordinates_m
        r2 = x[:, None] ** 2 + x[None, :] ** 2
        radius = self._pupil.n_sub * self._pupil.sub_aperture_m / 2
        return self._surfaces(x), r2 <= radius**2, pupil.pixel_m

    def zonal_matrix(self, registration: Registration, width: float = 1.0) -> NDArray[np.float64]:
        """Slopes in pixels per unit command ``(n_slopes, n_act)``, see :class:`SyntheticModel`."""
        if not self._is_separable(registration):
            surfaces = np.moveaxis(self._surfaces(self._slopes.nodes_m, registration, width), 0, 2).copy()
            return np.asarray(self._slopes.slopes(surfaces) * self._opd_per_command_m)
        products = self._factors(registration, width, np.float64).terms(0, 0)
        return np.asarray(self._slopes.sums_of_products([products])[0] * self._opd_per_command_m)

    def zonal_jacobian(
        self, registration: Registration, width: float = 1.0
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Zonal matrix and its derivatives, see :class:`DifferentiableModel`; single precision."""
        measured = self._measured_jacobian(
            self._slopes.nodes_m, registration, width,
            lambda surfaces: self._slopes.slopes(surfaces) * np.float32(self._opd_per_command_m),
        )  # fmt: skip
        return self._gaussian_jacobian(registration, width) if measured is None else measured

    def _coordinates(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        return self._slopes.nodes_m, self._slopes.nodes_m

    def _slopes_of_sums(self, sums: Sequence[Products]) -> NDArray[np.floating]:
        return self._slopes.sums_of_products(sums) * np.float32(self._opd_per_command_m)

    def modal_matrix(
        self, registration: Registration, m2c: NDArray[np.float64], width: float = 1.0
    ) -> NDArray[np.float64]:
        """Slopes per unit mode ``(n_slopes, n_modes)``, see :class:`DifferentiableModel`."""
        if not self._is_separable(registration):
            return self.zonal_matrix(registration, width) @ m2c
        factors = self._factors(registration, width)
        if m2c.shape[1] <= _MAX_DIRECT_MODES:
            return np.asarray(
                self._slopes.slopes(mode_surfaces(factors, m2c)) * self._opd_per_command_m, dtype=float
            )
        zonal = self._slopes.sums_of_products([factors.terms(0, 0)])[0]
        return np.asarray(zonal @ (m2c * self._opd_per_command_m))

    def modal_jacobian(
        self, registration: Registration, m2c: NDArray[np.float64], width: float = 1.0
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Modal matrix and its derivatives, see :class:`DifferentiableModel`; single precision."""
        if not isinstance(self._nominal, InfluenceFunctions):
            matrix, derivatives = self.zonal_jacobian(registration, width)
            return matrix @ m2c, derivatives @ m2c
        factors = self._factors(registration, width, derivatives=True)
        parts = self._slopes.sums_of_products(
            [factors.terms(*kinds) for kinds in MATRIX_AND_DERIVATIVE_KINDS]
        )
        modes = (m2c * self._opd_per_command_m).astype(np.float32)
        out = np.zeros((N_DERIVATIVES, parts.shape[1], m2c.shape[1]))
        for p in range(N_DERIVATIVES):
            for part, share in zip(parts[1:3], factors.position[p], strict=True):
                if share.any():
                    out[p] += part @ (share[:, None] * modes)
        for part, shares in zip(parts[3:], factors.log_width.T, strict=True):
            by_width = part @ modes
            for p in np.flatnonzero(shares).tolist():
                out[p] += by_width * shares[p]
        return np.asarray(parts[0] @ modes, dtype=float), out

    @property
    def numbering_offsets(self) -> tuple[tuple[int, int], tuple[int, int]]:
        """Competing numberings of the lenslets, see :class:`HasNumberingOffsets`."""
        return self._grid.numbering_offsets

    def variants(self) -> list[ShackHartmannModel]:
        """The model with motion and pokes larger by the motion's uncertainty, see :class:`SyntheticModel`."""
        if self._variants is None:
            larger = 1 + self._config.sensor_as(ShackHartmannSection).motion_sigma
            grid = replace(self._grid, motion_px=self._grid.motion_px * larger)
            wavefronts = [larger * one for one in self._wavefronts_m]
            varied = ShackHartmannModel(self._config, grid, wavefronts, self._overlap)
            self._variants = [varied] if grid.motion_px or wavefronts else []
        return list(self._variants)

    def around_pokes(
        self, registration: Registration, m2c: NDArray[np.float64], overlap: float
    ) -> ShackHartmannModel | None:
        """The model around random pokes, see :class:`HasPokeResponse`.

        The pokes are drawn with equal amplitudes of all modes and the measured rms; the rest of the measured
        motion of the spots, at least that of turbulence, is tilts.
        """
        grid, n_modes = self._grid, m2c.shape[1]
        if not grid.pokes or self._gaussian.pitch_m > _MAX_PITCH * self.sub_aperture_m:
            return None
        if self._around_pokes is not None:
            place, model = self._around_pokes
            if (np.abs(registration.to_array() - place.to_array()) < _SAME_POKES_WITHIN).all():
                return model
        half = m2c @ np.random.default_rng(3).uniform(-1, 1, (n_modes, _N_POKES * _N_NODES // 2))
        surfaces = self._surfaces(self._pupil.coordinates_m, registration)
        # The scale of the modes does not matter.
        lit = np.tensordot(half.T, surfaces[:, self._pupil.lit], 1)
        half *= grid.pokes / lit.std()
        # Opposite nodes of the spot motion have opposite pokes.
        blocks = half.reshape(len(half), _N_POKES, -1)
        pokes = np.concatenate([blocks, -blocks[:, :, ::-1]], axis=2).reshape(len(half), -1)
        mean_square = (1 - overlap) ** 2 + overlap**2
        poke_variance = mean_square * float(self.modal_matrix(registration, half).var())
        rest = max(grid.turbulence_px, float(np.sqrt(max(0.0, grid.motion_px**2 - poke_variance))))
        paths = np.tensordot(pokes.T * self._opd_per_command_m, surfaces, 1)
        model = ShackHartmannModel(
            self._config, replace(grid, motion_px=rest, pokes=0.0), tuple(paths), overlap
        )
        self._around_pokes = registration, model
        return model
