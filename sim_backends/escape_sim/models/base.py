"""Base class of the synthetic models."""

from __future__ import annotations

import copy
from dataclasses import replace
from typing import TYPE_CHECKING, Self

import numpy as np
from numpy.typing import DTypeLike, NDArray

from escape_hw.api.registration import Registration
from escape_hw.api.synthetic_model import PROFILE_WIDTHS
from escape_sim.mirror.influence_functions import SINGLE_GAUSSIAN, nominal_influence_functions
from escape_sim.mirror.mode_surfaces import GaussianFactors, gaussian_factors
from escape_sim.optics.pupil import PupilGeometry

if TYPE_CHECKING:
    from escape_hw.config.system import SystemConfig


class DesignModel:
    """The design's mirror on a sampled pupil; the ``twin`` section of the configuration is not read."""

    def __init__(self, config: SystemConfig, pupil: PupilGeometry) -> None:
        self._config, self._pupil = config, pupil
        self._nominal = nominal_influence_functions(config)

    @property
    def n_act(self) -> int:
        """Number of actuators."""
        return self._nominal.n_act

    @property
    def actuator_positions_m(self) -> NDArray[np.float64]:
        """Nominal positions of the actuators ``(n_act, 2)`` as (x, y) on the pupil in metres."""
        return self._nominal.positions_m

    @property
    def profile_shares(self) -> tuple[float, ...]:
        """Share of each width of the profile, see :class:`HasProfile`."""
        shares = {width: share for share, width in self._nominal.profile}
        return tuple(shares.get(width, 0.0) for width in PROFILE_WIDTHS)

    def component_model(self) -> Self:
        """The same model with a single Gaussian, see :class:`HasProfile`."""
        single = copy.copy(self)
        single._nominal = replace(self._nominal, profile=SINGLE_GAUSSIAN)  # noqa: SLF001
        return single

    @property
    def sub_aperture_m(self) -> float:
        """Size of a sub-aperture, or of a pixel of the pupil image, on the pupil in metres."""
        return self._pupil.sub_aperture_m

    def _surfaces(
        self, at_m: NDArray[np.float64], registration: Registration | None = None, width: float = 1.0
    ) -> NDArray[np.float64]:
        """Influence functions ``(n_act, n, n)`` at coordinates ``(n,)`` along either axis."""
        influence = replace(self._nominal, width=width)
        return influence.surfaces(registration or Registration(), self.sub_aperture_m, at_m, at_m)

    def _factors(
        self,
        at_m: NDArray[np.float64],
        registration: Registration,
        width: float,
        dtype: DTypeLike = np.float32,
        *,
        derivatives: bool = False,
    ) -> GaussianFactors:
        influence = replace(self._nominal, width=width)
        return gaussian_factors(
            influence, registration, self.sub_aperture_m, at_m, at_m, dtype, derivatives=derivatives
        )
