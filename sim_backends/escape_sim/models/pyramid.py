"""Fast analytic model of a modulated pyramid system, averaged over turbulence and pokes."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.pyramid import PyramidPupils, pupil_boxes
from escape_hw.api.registration import Registration
from escape_hw.calibration.modes.bases import build_basis
from escape_hw.config.sensor import PyramidSection
from escape_sim.mirror.influence_functions import SINGLE_GAUSSIAN, InfluenceFunctions
from escape_sim.mirror.mode_surfaces import (
    N_DERIVATIVES,
    Products,
    mode_derivatives,
    mode_surfaces,
    surface_nodes,
)
from escape_sim.models.base import SummingDesignModel
from escape_sim.models.pyramid_mean_phase import coarse_pixels, estimate_mean_phase, low_order_phases
from escape_sim.models.pyramid_response import PairCoherence, SlopeResponse, slope_response
from escape_sim.models.pyramid_turbulence import (
    PokePhase,
    Turbulence,
    estimate_strength,
    fit_registration_change,
    sample_distances,
    turbulence_registration_scatter,
)
from escape_sim.optics.fourier_filter import next_fast_length
from escape_sim.optics.modulation import ModulationPath
from escape_sim.optics.pupil import nominal_flux, pupil_from_images
from escape_sim.optics.pyramid import GridRegion, Prism, PyramidOptics

if TYPE_CHECKING:
    from escape_hw.config.system import SystemConfig

#: Outer scale of the turbulence in pupil diameters, as in the modal basis.
_OUTER_SCALE = 4.0
#: Pupil diameters over r0 below which turbulence does not change the response.
_NEGLIGIBLE_STRENGTH = 0.5
#: Pixels with less relative flux are vignetted or contaminated on a telescope; their squares are weighted
#: by ``_MIN_SLOPE_WEIGHT`` unless they are the majority.
_MIN_RELATIVE_FLUX = 0.85
_MIN_SLOPE_WEIGHT = 1e-3
#: Detail of influence functions on a grid, relative to Gaussians. At equal nodes the matrix of a thin plate
#: is wrong by 0.5 %, its derivatives by 4 %.
_SHARPER = 0.5
#: The same of an exponential profile. At equal nodes its matrix is wrong by 0.25 %, its derivatives by 1 to
#: 2 %; at this, by 0.007 % and 0.1 %.
_SHARPER_PROFILE = 0.7
#: Mirror shapes whose response is computed in every turbulence state. That few of them respond differently
#: outweighs the turbulence in the scalings.
_N_SHAPES = 60
#: The relevant pattern of errors of the images' relative positions: opposite shifts of the diagonal pairs mix
#: derivatives of the y slopes into the x slopes, as a registration shift does. Other patterns displace images
#: whose sum is used or whose difference does not depend on the phase.
_DIAGONALS = np.array([1.0, -1.0, -1.0, 1.0])


def nominal_pupils(config: SystemConfig) -> PyramidPupils:
    """The design's pupil images; valid where the design flux is sufficient."""
    sensor, flux = config.sensor_as(PyramidSection), nominal_flux(config)
    n, valid = sensor.n_sub, flux >= sensor.min_flux
    centres = np.array(sensor.pupils_px)
    return PyramidPupils(
        centres, float(n), pupil_boxes(centres, n), valid,
        np.zeros((int(valid.sum()), 2), np.float32), flux.astype(np.float32),
        normalisation=sensor.normalisation, modulation=sensor.modulation,
    )  # fmt: skip


class PyramidModel(SummingDesignModel):
    """Small-signal slopes of a modulated pyramid with a mirror of Gaussian actuators.

    The derivatives of the slopes by the phase are computed once, at a flat wavefront or averaged over
    turbulence whose strength is estimated from the motion of the slopes, about the mean wavefront of the
    measurement. They are stored at the few nodes that interpolate a mirror surface, so a matrix under any
    registration is one product. The average matters: open-loop turbulence of 22 r0 across the pupil lowers
    the response to 0.38 (low order modes), 0.31 (middle) and 0.53 (high) of its value without turbulence.

    Parameters
    ----------
    pupils
        The pupil images measured on the camera.
    modulation
        Path of the image over the pyramid; by default a circle of the pupils' modulation radius.
    turbulence
        Pupil diameters over r0 to average over; by default estimated from the motion of the slopes.
    basis
        Modes ``(n_act, n_modes)`` that were poked; by default those of the configuration.
    phases
        The turbulence over the pupil; by default as measured.
    mean_phase
        Mean phase ``(n, n)`` in radians over the pupil; by default as measured.

    Raises
    ------
    CalibrationError
        The pupils do not fit the design.
    """

    name = "fast"

    def __init__(
        self,
        config: SystemConfig,
        pupils: PyramidPupils,
        *,
        modulation: ModulationPath | None = None,
        turbulence: float | None = None,
        basis: NDArray[np.float64] | None = None,
        phases: Turbulence | None = None,
        mean_phase: NDArray[np.float64] | None = None,
    ) -> None:
        pupil = pupil_from_images(config, pupils)
        super().__init__(config, pupil)
        self._pupils, self._modes = pupils, basis
        self._modulation = modulation or ModulationPath.circle(pupils.modulation)
        # The optical path changes by twice the surface.
        self._scale = 2 * config.devices.dm.stroke_m * 2 * np.pi / config.system.wavelength_m
        self._pokes = self._measured_pokes() if pupils.pokes else None
        self._coherence: PairCoherence | None = None
        self._phases = phases or self._build_turbulence()
        if turbulence is None:
            turbulence = estimate_strength(self.optics(), pupils, self._phases.phases(1.0), self._pokes)
        self.turbulence = turbulence if turbulence >= _NEGLIGIBLE_STRENGTH else 0.0
        if phases is None and self.turbulence and pupils.residual_tilt:
            self._phases.estimate_left(self.optics(), pupils, self.turbulence, self._pokes)
        sigma = self._gaussian.pitch_m / np.sqrt(2 * np.log(1 / self._gaussian.coupling))
        if not isinstance(self._nominal, InfluenceFunctions):
            sigma *= _SHARPER
        elif self._nominal.profile != SINGLE_GAUSSIAN:
            sigma *= _SHARPER_PROFILE
        self._nodes, self._interpolation = surface_nodes(pupil.coordinates_m, sigma)
        #: Phase ``(n, n)`` in radians about which the response is; ``None``: flat.
        self.mean_phase = mean_phase
        if mean_phase is None and self.turbulence and pupils.mean_low_orders is not None:
            self.mean_phase = self._estimate_mean_phase()
        self._executor = ThreadPoolExecutor(1, "pyramid-model")
        self._variants: list[PyramidModel] | None = None
        self._shifted_models: dict[tuple[float, float], PyramidModel] = {}
        self._turbulence_scatter: NDArray[np.float64] | None = None
        self._strength_change: NDArray[np.float64] | None = None

    @property
    def registration_systematic_error(self) -> NDArray[np.float64]:
        """Errors by images, turbulence and place of the maps, see :class:`HasSystematicError`."""
        shift = 100 * self._pupils.centre_sigma_px * self._pupil.n_sub / self._pupils.diameter_px
        parts = [
            np.array([shift, shift, 0.0, 0.0, 0.0]), self._turbulence_uncertainty(),
            self._strength_uncertainty(), super().registration_systematic_error,
        ]  # fmt: skip
        return np.asarray(np.sqrt(np.square(parts).sum(axis=0)))

    @property
    def gain_trend(self) -> float:
        """Scatter of trends of the slopes' gains, see :class:`HasGainTrend`; 0 for a static pyramid."""
        return self._config.sensor_as(PyramidSection).gain_trend if self.turbulence or self._pokes else 0.0

    @property
    def slope_weights(self) -> NDArray[np.float64]:
        """Weight of each slope, see :class:`HasSlopeWeights`: low for dim pixels on a telescope.

        Contamination covers part of a pixel and scatters light at its edges. Gain errors there would be
        mistaken for a scaling. On a bench the rim is dim by design.
        """
        lit = self._pupils.flux[self._pupils.valid] >= _MIN_RELATIVE_FLUX
        if not self._config.telescope.obscuration or 2 * lit.sum() < lit.size:
            lit = np.ones_like(lit)
        return np.tile(np.where(lit, 1.0, _MIN_SLOPE_WEIGHT), 2)

    def zonal_matrix(self, registration: Registration, width: float = 1.0) -> NDArray[np.float64]:
        """Slopes per unit command ``(n_slopes, n_act)``, see :class:`SyntheticModel`; single precision."""
        if not self._is_separable(registration):
            return self._slopes(np.moveaxis(self._surfaces(self._nodes, registration, width), 0, 2))
        products = self._factors(registration, width).terms(0, 0)
        return np.asarray(self._slopes_of_sums([products])[0])

    def modal_matrix(
        self, registration: Registration, m2c: NDArray[np.float64], width: float = 1.0
    ) -> NDArray[np.float64]:
        """Slopes per unit mode ``(n_slopes, n_modes)``, see :class:`DifferentiableModel`."""
        if not self._is_separable(registration):
            return self.zonal_matrix(registration, width) @ m2c
        return self._slopes(mode_surfaces(self._factors(registration, width), m2c))

    def modal_jacobian(
        self, registration: Registration, m2c: NDArray[np.float64], width: float = 1.0
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Modal matrix and its derivatives, see :class:`DifferentiableModel`."""
        if not isinstance(self._nominal, InfluenceFunctions):
            matrix, derivatives = self.zonal_jacobian(registration, width)
            return matrix @ m2c, derivatives @ m2c
        surfaces = mode_derivatives(self._factors(registration, width, derivatives=True), m2c)
        parts = self._slopes(surfaces.reshape(*surfaces.shape[:2], -1))
        parts = parts.reshape(-1, 1 + N_DERIVATIVES, m2c.shape[1]).transpose(1, 0, 2)
        return parts[0], parts[1:]

    def zonal_jacobian(
        self, registration: Registration, width: float = 1.0
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Zonal matrix and its derivatives, see :class:`DifferentiableModel`."""
        measured = self._measured_jacobian(self._nodes, registration, width, self._slopes)
        return self._gaussian_jacobian(registration, width) if measured is None else measured

    def with_pupil_shift(self, shift_x: float, shift_y: float) -> PyramidModel:
        """The model with shifted images under the same turbulence, see :class:`HasPupilShift`."""
        position = shift_x, shift_y
        if position not in self._shifted_models:
            shift_px = np.array(position) / 100 * self._pupils.diameter_px / self._pupil.n_sub
            pupils = replace(self._pupils, centres_px=self._pupils.centres_px + shift_px)
            self._shifted_models[position] = self._variant(pupils=pupils)
        return self._shifted_models[position]

    def variants(self) -> list[PyramidModel]:
        """Models with displaced images; unless it averages an open loop, also with other conditions.

        These are stronger turbulence and elliptic modulation. The finite number of wavefronts in an open loop
        changes the response by more than they do: a fit of them would follow it to many times their priors,
        and the registration with them. There the strength is part of the systematic error, and an ellipse
        changes nothing that matters.
        """
        if self._variants is None:
            section = self._config.sensor_as(PyramidSection)
            changes = [] if self._in_open_turbulence else self._other_conditions()
            for axis in range(2):
                centres = self._pupils.centres_px.copy()
                centres[:, axis] += section.image_position_sigma_px * _DIAGONALS
                changes.append(self._variant(pupils=replace(self._pupils, centres_px=centres)))
            self._variants = changes
        return list(self._variants)

    @property
    def _in_open_turbulence(self) -> bool:
        return bool(self.turbulence) and self._phases.stationary

    def _other_conditions(self) -> list[PyramidModel]:
        """Models with stronger turbulence, where there is any, and with elliptic modulation."""
        section, radius = self._config.sensor_as(PyramidSection), self._pupils.modulation
        models = [self._with_more_turbulence()] if self.turbulence else []
        for angle in (0.0, np.pi / 4) if radius else ():
            elliptic = ModulationPath.circle(radius, ellipse=section.ellipticity_sigma, ellipse_angle=angle)
            models.append(self._variant(modulation=elliptic))
        return models

    def _with_more_turbulence(self) -> PyramidModel:
        section = self._config.sensor_as(PyramidSection)
        return self._variant(turbulence=self.turbulence * (1 + section.turbulence_sigma))

    # ------------------------------------------------------------------ construction
    def _variant(
        self,
        *,
        pupils: PyramidPupils | None = None,
        modulation: ModulationPath | None = None,
        turbulence: float | None = None,
    ) -> PyramidModel:
        """The same model, except for what is given."""
        varied = PyramidModel(
            self._config, pupils or self._pupils, modulation=modulation or self._modulation,
            turbulence=self.turbulence if turbulence is None else turbulence, basis=self._modes,
            phases=self._phases, mean_phase=self.mean_phase,
        )  # fmt: skip
        same_pupil = np.array_equal(varied._pupil.amplitude != 0, self._pupil.amplitude != 0)
        if modulation is None and turbulence is None and same_pupil:
            # Displaced images see the same wavefronts.
            varied._coherence = self._pair_coherence()
        return varied

    def _strength_uncertainty(self) -> NDArray[np.float64]:
        """Registration error ``(5,)`` by the strength of the turbulence, where it is not fitted."""
        if not self._in_open_turbulence:
            return np.zeros(5)
        if self._strength_change is None:
            modes = self._basis()
            matrix, derivatives = self.modal_jacobian(Registration(), modes)
            stronger = self._with_more_turbulence().modal_matrix(Registration(), modes)
            terms = np.concatenate([matrix[None], derivatives[:5]])
            self._strength_change = fit_registration_change(terms, stronger)
        return self._strength_change

    def _turbulence_uncertainty(self) -> NDArray[np.float64]:
        """Registration error ``(5,)`` by the finite number of turbulence and poke states averaged."""
        if not self._pupils.n_effective or not (self.turbulence or self._pokes):
            return np.zeros(5)
        if self._turbulence_scatter is None:
            optics, x = self.optics(), self._pupil.coordinates_m
            screens = self._phases.phases(self.turbulence)[:, None]
            if self.mean_phase is not None:
                # The model knows the low orders of the mean wavefront.
                low_orders = low_order_phases(x / (self._config.system.pupil_m / 2))
                screens = self._phases.opposite_phases(self.turbulence, low_orders)
            pokes = self._pokes.phases(_N_SHAPES) if self._pokes else np.zeros((1, *screens.shape[2:]))
            modes = self._basis()
            shapes = modes @ np.random.default_rng(2).standard_normal((modes.shape[1], _N_SHAPES))
            stroke_m = 2 * self._config.devices.dm.stroke_m
            paths = np.tensordot(shapes.T, self._surfaces(x), 1) * stroke_m
            self._turbulence_scatter = turbulence_registration_scatter(
                optics, self._pupils, screens, pokes, paths, *self.modal_jacobian(Registration(), shapes)
            )
        return np.asarray(self._turbulence_scatter / np.sqrt(self._pupils.n_effective))

    def _basis(self) -> NDArray[np.float64]:
        """Modes of the calibration ``(n_act, n_modes)``."""
        if self._modes is None:
            self._modes = build_basis(
                self._config, *self.influence_functions(), self._config.devices.dm.limits.disabled
            )
        return self._modes

    def _build_turbulence(self) -> Turbulence:
        """Turbulence on this pupil, in closed loop without the modes."""
        pupil, modes = self._pupil, None
        if self._pupils.residual_tilt:
            modes = np.tensordot(self._basis().T, self.influence_functions()[0], 1)
        distances = sample_distances(len(pupil.coordinates_m), pupil.pixel_m) / self._config.system.pupil_m
        return Turbulence(_OUTER_SCALE, distances, pupil.lit, modes)

    def _measured_pokes(self) -> PokePhase:
        """Pokes of the measured rms."""
        m2c = self._basis()
        surfaces, lit, _ = self.influence_functions()
        # Pokes are uniformly distributed, with an rms of 1 / sqrt(3) of their maximum.
        max_amplitude = self._config.calibration.poke_command / np.abs(m2c).max(axis=0) / np.sqrt(3)
        return PokePhase.from_rms(
            self._pupils.pokes, max_amplitude, self._scale * np.tensordot(m2c.T, surfaces, 1), lit
        )

    def _slope_response(self, pixels: NDArray[np.bool_]) -> SlopeResponse:
        """Slopes at pixels ``(n_sub, n_sub)`` and their derivatives by the phase at the nodes."""
        pupils, pupil = self._pupils, self._pupil
        n, samples = len(pupil.coordinates_m), pupil.n_pix
        shape = self._config.devices.wfs.region[:1:-1]
        grid = next_fast_length(max(shape), samples)
        region = GridRegion(pupils.centres_px, shape, grid, samples)
        structure, pairs = None, self._pair_coherence()
        if pairs is None and self.turbulence:
            structure = self._phases.structure(self.turbulence)
        return slope_response(
            pupil.amplitude, Prism(region.shifts(n), pupil.n_sub * samples), grid * samples,
            pupils.corners_px - region.first, pixels, self._modulation, structure, pairs=pairs,
            interpolation=self._interpolation, samples=samples, local=pupils.normalisation == "local",
            phase=self.mean_phase,
        )  # fmt: skip

    def _estimate_mean_phase(self) -> NDArray[np.float64]:
        """Mean phase ``(n, n)`` during the measurement, from its mean slopes."""
        radius_m, pixels = self._config.system.pupil_m / 2, coarse_pixels(self._pupils.valid)
        return estimate_mean_phase(
            self._slope_response(pixels), pixels, self._pupils, self._nodes / radius_m,
            self._pupil.coordinates_m / radius_m,
        )  # fmt: skip

    def _pair_coherence(self) -> PairCoherence | None:
        """Coherence of all pairs of lit samples, kept; ``None`` where the phase is stationary."""
        if self._coherence is None and (structure := self._pair_structure()) is not None:
            diameter = float(self._pupil.n_sub * self._pupil.n_pix)
            self._coherence = PairCoherence(self._pupil.amplitude != 0, diameter, self._modulation, structure)
        return self._coherence

    def _pair_structure(self) -> NDArray[np.float32] | None:
        """Structure function of all pairs of lit samples; ``None`` where the phase is stationary.

        Pokes are not: modes of high order are strong at the rim of a mirror. Nor is what a loop leaves.
        """
        turbulent = self.turbulence > 0
        if self._pokes is None:
            still = not turbulent or self._phases.stationary
            return None if still else self._phases.pair_structure(self.turbulence)
        pairs = self._pokes.pair_structure()
        return pairs + self._phases.pair_structure(self.turbulence) if turbulent else pairs

    def optics(self) -> PyramidOptics:
        """Optics of the design's sensor, with the images at their measured positions."""
        return PyramidOptics(
            self._pupil.amplitude, float(self._pupil.n_sub), self._config.system.wavelength_m,
            self._pupils.centres_px, self._config.devices.wfs.region[:1:-1], self._modulation,
            samples=self._pupil.n_pix,
        )  # fmt: skip

    @cached_property
    def _response(self) -> tuple[NDArray[np.float32], NDArray[np.intp]]:
        """Derivatives of the slopes by the surface at nodes ``(n_slopes, k)``, and these nodes."""
        response = self._slope_response(self._pupils.valid).phase_derivatives
        # Nodes that are samples are dark beside the pupil.
        nodes = np.flatnonzero(response.any(axis=0))
        response = np.ascontiguousarray(response[:, nodes])
        response *= np.float32(self._scale)
        return response, nodes

    def _prepare_sensor(self) -> None:
        _ = self._response

    # ------------------------------------------------------------------ mirror
    def _coordinates(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        return self._nodes, self._nodes

    def _slopes_of_sums(self, sums: Sequence[Products]) -> NDArray[np.floating]:
        surfaces = [np.einsum("tya,txa->yxa", y, x) for x, y in sums]
        slopes = self._slopes(np.concatenate(surfaces, axis=2))
        return slopes.reshape(len(slopes), len(sums), -1).transpose(1, 0, 2)

    def _slopes(self, surfaces: NDArray[np.floating]) -> NDArray[np.float64]:
        """Slopes ``(n_slopes, k)`` of surfaces ``(m, m, k)`` at the nodes, in fractions of full stroke."""
        # For few modes reading the response from memory dominates: two threads read one half each.
        response, nodes = self._response
        surface_matrix = surfaces.reshape(-1, surfaces.shape[2])[nodes].astype(np.float32, copy=False)
        half = len(response) // 2
        second = self._executor.submit(np.matmul, response[half:], surface_matrix)
        return np.concatenate([response[:half] @ surface_matrix, second.result()]).astype(np.float64)
