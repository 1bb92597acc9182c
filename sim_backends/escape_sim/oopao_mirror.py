"""OOPAO's mirror as the design has it, under any registration."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.registration import Registration
from escape_sim.geometry import PupilGeometry, actuator_positions, pitch_on_pupil
from escape_sim.oopao_bridge import Light, mis_registration, oopao, quiet

if TYPE_CHECKING:
    from escape_hw.config.models import SystemConfig

#: Surface in metres of the push and of the pull: a thousandth of a wave, so that what is not
#: linear stays below the other differences between models.
STEP_M = 0.5e-9


class NominalMirror:
    """OOPAO's ``DeformableMirror`` for a design.

    Parameters
    ----------
    config
        The design.
    pupil
        Its sampled pupil.
    light
        Source and telescope of that pupil.
    """

    def __init__(self, config: SystemConfig, pupil: PupilGeometry, light: Light) -> None:
        n = pupil.n_sub * pupil.n_pix
        self._pupil, self._telescope, self._dm = pupil, light.telescope, config.devices.dm
        # OOPAO's mirror lays its n samples from edge to edge, its wavefront has them at pixel
        # centres: everything the mirror is told in metres must be this much larger.
        self._edge = n / (n - 1)
        self._positions = actuator_positions(config)
        self._pitch = pitch_on_pupil(config)
        self._mirrors: dict[float, Any] = {}

    @property
    def n_act(self) -> int:
        """Number of actuators."""
        return len(self._positions)

    @property
    def per_step(self) -> float:
        """Full strokes in the difference of a push and a pull of :data:`STEP_M`."""
        return self._dm.stroke_m / (2 * STEP_M)

    def influence_functions(self) -> tuple[NDArray[np.float64], NDArray[np.bool_], float]:
        """Nominal influence functions ``(n_act, n, n)``, pupil ``(n, n)`` and pixel size in metres."""
        modes = np.asarray(self._nominal(1.0).modes, dtype=float)
        lit = self._pupil.lit
        return modes.T.reshape(self.n_act, *lit.shape), lit, self._pupil.pixel_m

    def moved(self, registration: Registration, width: float) -> Any:
        """The mirror under a registration, its influence functions ``width`` times as wide."""
        shift = mis_registration(registration, self._pupil.sub_aperture_m * self._edge)
        with quiet():
            return self._nominal(width).apply_mis_registration(shift)

    def _nominal(self, width: float) -> Any:
        """OOPAO's mirror in nominal position; the few widths in use are kept."""
        if width not in self._mirrors:
            if len(self._mirrors) >= 4:
                self._mirrors.clear()
            with quiet():
                self._mirrors[width] = oopao().DeformableMirror(
                    telescope=self._telescope,
                    nSubap=self._pupil.n_sub,
                    mechCoupling=self._dm.coupling,
                    coordinates=self._positions * self._edge,
                    pitch=self._pitch * self._edge * width,
                    print_dm_properties=False,
                )
        return self._mirrors[width]
