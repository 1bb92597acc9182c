"""Base class of the synthetic models."""

from __future__ import annotations

import abc
import copy
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Self

import numpy as np
from numpy.typing import DTypeLike, NDArray

from escape_hw.api.flips import Flip
from escape_hw.api.registration import Registration
from escape_hw.api.synthetic_model import PROFILE_WIDTHS
from escape_sim.mirror.influence_functions import InfluenceFunctions
from escape_sim.mirror.mode_surfaces import (
    DERIVATIVE_KINDS,
    MATRIX_AND_DERIVATIVE_KINDS,
    N_DERIVATIVES,
    GaussianFactors,
    Products,
    combine_derivatives,
    gaussian_factors,
)
from escape_sim.mirror.nominal import gaussian_functions, nominal_influence_functions
from escape_sim.optics.pupil import PupilGeometry

if TYPE_CHECKING:
    from escape_hw.config.system import SystemConfig

#: Values of measured surfaces and their derivatives that are held in memory at once.
_BLOCK_VALUES = 2e7


class DesignModel:
    """The design's mirror on a sampled pupil; the ``twin`` section of the configuration is not read."""

    def __init__(self, config: SystemConfig, pupil: PupilGeometry) -> None:
        self._config, self._pupil = config, pupil
        self._nominal = nominal_influence_functions(config)
        self._gaussian = gaussian_functions(config)

    @property
    def n_act(self) -> int:
        """Number of actuators."""
        return self._nominal.n_act

    @property
    def actuator_positions_m(self) -> NDArray[np.float64]:
        """Nominal positions of the actuators ``(n_act, 2)`` as (x, y) on the pupil in metres."""
        return self._nominal.positions_m

    def suggest_orientation(self, flip: Flip, *, opposite: bool) -> str:
        """Keys that turn the camera or renumber the actuators, see :class:`HasOrientation`."""
        return self._config.devices.suggest_orientation(flip, opposite=opposite)

    @property
    def profile_shares(self) -> tuple[float, ...]:
        """Share of each width of the profile, see :class:`HasProfile`; none for other shapes."""
        if not isinstance(self._nominal, InfluenceFunctions):
            return ()
        shares = {width: share for share, width in self._nominal.profile}
        return tuple(shares.get(width, 0.0) for width in PROFILE_WIDTHS)

    def component_model(self) -> Self:
        """The same model with a single Gaussian, see :class:`HasProfile`."""
        self._prepare_sensor()
        single = copy.copy(self)
        single._nominal = self._gaussian  # noqa: SLF001
        return single

    def _prepare_sensor(self) -> None:
        """Compute the response of the sensor, which a copy with another mirror shares."""

    @property
    def sub_aperture_m(self) -> float:
        """Size of a sub-aperture, or of a pixel of the pupil image, on the pupil in metres."""
        return self._pupil.sub_aperture_m

    def influence_functions(self) -> tuple[NDArray[np.float64], NDArray[np.bool_], float]:
        """Nominal influence functions over the pupil, see :class:`SyntheticModel`."""
        return self._surfaces(self._pupil.coordinates_m), self._pupil.lit, self._pupil.pixel_m

    def surface_model(self, x_m: NDArray[np.float64], y_m: NDArray[np.float64]) -> SurfaceModel:
        """The same mirror on a sensor of heights, see :class:`HasSurfaces`."""
        model = SurfaceModel(self._config, self._pupil, x_m, y_m)
        model._nominal = self._nominal  # noqa: SLF001
        return model

    @property
    def registration_systematic_error(self) -> NDArray[np.float64]:
        """Error of the place of measured influence functions, see :class:`HasSystematicError`."""
        if isinstance(self._nominal, InfluenceFunctions):
            return np.zeros(5)
        percent = 100 / self.sub_aperture_m
        return self._nominal.place_sigma * [percent, percent, 1.0, 1.0, 1.0]

    def _is_separable(self, registration: Registration) -> bool:
        """Whether the surfaces are products of functions of x and y: upright Gaussians."""
        return isinstance(self._nominal, InfluenceFunctions) and not registration.anamorphosis_angle

    def _surfaces(
        self, at_m: NDArray[np.float64], registration: Registration | None = None, width: float = 1.0
    ) -> NDArray[np.float64]:
        """Influence functions ``(n_act, n, n)`` at coordinates ``(n,)`` along either axis."""
        influence = self._nominal.with_width(width)
        return influence.surfaces(registration or Registration(), self.sub_aperture_m, at_m, at_m)

    def _measured_jacobian(
        self,
        at_m: NDArray[np.float64],
        registration: Registration,
        width: float,
        slopes: Callable[[NDArray[np.floating]], NDArray[np.floating]],
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
        """Zonal matrix and derivatives of influence functions on a grid; ``None`` for Gaussians.

        ``slopes`` computes slopes ``(n_slopes, k)`` of surfaces ``(n, n, k)`` at the coordinates.
        """
        if isinstance(self._nominal, InfluenceFunctions):
            return None
        influence, n = self._nominal.with_width(width), at_m.size
        step = max(1, int(_BLOCK_VALUES / (7 * n * n)))
        parts = []
        for first in range(0, self.n_act, step):
            block = influence.jacobian(
                registration, self.sub_aperture_m, at_m, at_m, slice(first, first + step)
            )
            columns = np.ascontiguousarray(block.transpose(1, 2, 0, 3)).reshape(n, n, -1)
            parts.append(slopes(columns).reshape(-1, len(block), block.shape[3]).transpose(1, 0, 2))
        joined = np.concatenate(parts, axis=2).astype(float)
        return joined[0], joined[1:]


class SummingDesignModel(DesignModel, abc.ABC):
    """A model whose slopes are linear in surfaces at nodes, see :class:`SummingModel`."""

    _precision: DTypeLike = np.float32

    @abc.abstractmethod
    def _coordinates(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Coordinates of the nodes along x and along y in metres."""

    @abc.abstractmethod
    def _slopes_of_sums(self, sums: Sequence[Products]) -> NDArray[np.floating]:
        """Slopes per unit command ``(n, n_slopes, n_act)`` of ``n`` sums with equally many products."""

    def _factors(
        self,
        registration: Registration,
        width: float,
        dtype: DTypeLike | None = None,
        *,
        derivatives: bool = False,
    ) -> GaussianFactors:
        """Factors of Gaussian influence functions (ValueError: the nominal ones are on a grid)."""
        if not isinstance(self._nominal, InfluenceFunctions):
            raise ValueError("influence functions on a grid have no factors")
        return gaussian_factors(
            self._nominal.with_width(width), registration, self.sub_aperture_m, *self._coordinates(),
            dtype or self._precision, derivatives=derivatives,
        )  # fmt: skip

    def zonal_sum(
        self, functions: Sequence[tuple[NDArray[np.float64] | float, Registration, float]]
    ) -> NDArray[np.float64]:
        """Slopes of a sum of influence functions ``(n_slopes, n_act)``, see :class:`SummingModel`."""
        x, y = zip(
            *(self._factors(registration, width).terms(0, 0) for _, registration, width in functions),
            strict=True,
        )
        weighted = [
            part * np.asarray(factor, part.dtype) for (factor, _, _), part in zip(functions, y, strict=True)
        ]
        slopes = self._slopes_of_sums([(np.concatenate(x), np.concatenate(weighted))])
        return np.asarray(slopes[0], dtype=float)

    def zonal_components(
        self, registration: Registration, width: float, functions: Sequence[tuple[float, float]]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Functions of several widths, and derivatives of their sum, see :class:`SummingModel`."""
        each = [
            self._factors(registration, width * relative, derivatives=share != 0)
            for share, relative in functions
        ]
        matrices = np.concatenate([self._slopes_of_sums([one.terms(0, 0)]) for one in each]).astype(float)
        summed = [(share, one) for (share, _), one in zip(functions, each, strict=True) if share != 0]
        if not summed:
            return matrices, np.zeros((N_DERIVATIVES, *matrices.shape[1:]))
        # The slopes are linear in the surfaces, so only those of the sum are computed.
        sums = []
        for kinds in DERIVATIVE_KINDS:
            x, y = zip(*(one.terms(*kinds) for _, one in summed), strict=True)
            weighted = [part * part.dtype.type(share) for (share, _), part in zip(summed, y, strict=True)]
            sums.append((np.concatenate(x), np.concatenate(weighted)))
        # The logarithms of all widths change alike.
        position, log_width = summed[0][1].position, summed[0][1].log_width.copy()
        log_width[5] = 1 / width
        return matrices, combine_derivatives(position, log_width, self._slopes_of_sums(sums))

    def _gaussian_jacobian(
        self, registration: Registration, width: float
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Zonal matrix of Gaussian influence functions and its derivatives."""
        factors = self._factors(registration, width, derivatives=True)
        parts = self._slopes_of_sums([factors.terms(*kinds) for kinds in MATRIX_AND_DERIVATIVE_KINDS])
        return parts[0].astype(float), combine_derivatives(factors.position, factors.log_width, parts[1:])


class SurfaceModel(SummingDesignModel):
    """The design's mirror on a sensor of heights: its slopes are those of the grid points, row by row."""

    name = "surface"
    _precision = np.float64

    def __init__(
        self,
        config: SystemConfig,
        pupil: PupilGeometry,
        x_m: NDArray[np.float64],
        y_m: NDArray[np.float64],
    ) -> None:
        super().__init__(config, pupil)
        self._x_m, self._y_m = x_m, y_m

    def zonal_matrix(self, registration: Registration, width: float = 1.0) -> NDArray[np.float64]:
        """Heights per unit command ``(n_y * n_x, n_act)`` in fractions of full stroke."""
        influence = self._nominal.with_width(width)
        surfaces = influence.surfaces(registration, self.sub_aperture_m, self._x_m, self._y_m)
        return surfaces.reshape(len(surfaces), -1).T

    def _coordinates(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        return self._x_m, self._y_m

    def _slopes_of_sums(self, sums: Sequence[Products]) -> NDArray[np.floating]:
        return np.stack([np.einsum("tya,txa->yxa", y, x).reshape(-1, x.shape[2]) for x, y in sums])

    def variants(self) -> list[Self]:
        """No variants: heights do not depend on the sensor."""
        return []
