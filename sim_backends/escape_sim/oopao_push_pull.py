"""What OOPAO's synthetic models share: the design's mirror, pushed and pulled in front of a sensor."""

from __future__ import annotations

import abc
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.registration import Registration
from escape_sim.geometry import PupilGeometry
from escape_sim.oopao_bridge import Light
from escape_sim.oopao_mirror import STEP_M, NominalMirror

if TYPE_CHECKING:
    from escape_hw.config.models import SystemConfig

#: Actuators propagated together; bounds the memory.
_BATCH = 16


class PushPullModel(abc.ABC):
    """Small-signal slopes as push minus pull of OOPAO's mirror.

    Parameters
    ----------
    config
        The design.
    pupil
        Its sampled pupil.
    light
        Source and telescope of that pupil.
    """

    name = "oopao"

    def __init__(self, config: SystemConfig, pupil: PupilGeometry, light: Light) -> None:
        self._pupil = pupil
        self._mirror = NominalMirror(config, pupil, light)

    @property
    def n_act(self) -> int:
        """Number of actuators."""
        return self._mirror.n_act

    @property
    def sub_aperture_m(self) -> float:
        """Size of a sub-aperture, or of a pixel of the pupil image, on the pupil in metres."""
        return self._pupil.sub_aperture_m

    def influence_functions(self) -> tuple[NDArray[np.float64], NDArray[np.bool_], float]:
        """Nominal influence functions ``(n_act, n, n)``, pupil ``(n, n)`` and pixel size in metres."""
        return self._mirror.influence_functions()

    def zonal_matrix(self, registration: Registration, width: float = 1.0) -> NDArray[np.float64]:
        """Slopes per unit command ``(n_slopes, n_act)``, all x then all y, in the sensor's slope unit.

        Parameters
        ----------
        registration
            Registration of the mirror.
        width
            Scale of the influence functions' width relative to nominal.
        """
        mirror = self._mirror.moved(registration, width)
        # The mirror reflects: a surface of STEP_M changes the path by twice that.
        pokes = np.eye(self.n_act) * 2 * STEP_M
        parts = [pokes[:, start : start + _BATCH] for start in range(0, self.n_act, _BATCH)]
        moved = [self._slopes(mirror, part) - self._slopes(mirror, -part) for part in parts]
        return np.asarray(np.concatenate(moved, axis=1) * self._mirror.per_step)

    def variants(self) -> list[Self]:
        """None: OOPAO's sensors at rest leave nothing in doubt, see :class:`SyntheticModel`."""
        return []

    @abc.abstractmethod
    def _slopes(self, mirror: Any, paths_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Slopes ``(n_slopes, n)`` of mirror shapes, optical path per actuator ``(n_act, n)``."""
