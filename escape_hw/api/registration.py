"""Registration of the deformable mirror with respect to the wavefront sensor."""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

#: Order of the parameters in every array and table (paper, SPRINT section: alpha).
PARAMETERS = ("shift_x", "shift_y", "rotation", "radial_scaling", "tangential_scaling")
#: Unit of each parameter, as in the paper's Table 1.
UNITS = {
    "shift_x": "% of a sub-aperture",
    "shift_y": "% of a sub-aperture",
    "rotation": "deg",
    "radial_scaling": "% of the diameter",
    "tangential_scaling": "% of the diameter",
}
#: From these units to sub-apertures, radians and shares of the diameter, ``(5,)``: the units of streams.
TO_PLAIN = np.array([0.01, 0.01, np.pi / 180, 0.01, 0.01])


@dataclass(frozen=True, slots=True)
class Registration:
    """Affine registration of mirror and sensor (paper: the vector alpha, Table 1).

    Seen from the sensor, an actuator that nominally stands at ``(x, y)`` (x along columns, y along
    rows, from the centre of the sub-aperture grid) stands at ``R(rotation) S (x, y) + (shift_x,
    shift_y)``, where ``S = R(-a) diag(1 + radial_scaling, 1 + tangential_scaling) R(a)`` with the
    anamorphosis angle a, zero unless given, and a positive rotation turns +x towards +y. Positive
    shifts mean that the mirror moved to higher columns or rows. OOPAO's ``MisRegistration`` has the
    same rotation, scalings and anamorphosis angle and the opposite sign of the shifts.

    Parameters
    ----------
    shift_x, shift_y
        In % of a sub-aperture.
    rotation
        In degrees.
    radial_scaling, tangential_scaling
        Scaling along x and along y, in % (OOPAO's names).
    anamorphosis_angle
        In degrees: the radial scaling acts along the direction at minus this angle from +x towards
        +y (OOPAO's sense). SPRINT does not fit it, so arrays and tables leave it out.
    """

    shift_x: float = 0.0
    shift_y: float = 0.0
    rotation: float = 0.0
    radial_scaling: float = 0.0
    tangential_scaling: float = 0.0
    anamorphosis_angle: float = 0.0

    @classmethod
    def from_array(cls, values: ArrayLike) -> Registration:
        """Build from five numbers in the order of :data:`PARAMETERS`."""
        return cls(*(float(v) for v in np.asarray(values, dtype=float).reshape(5)))

    def to_array(self) -> NDArray[np.float64]:
        """Five numbers in the order of :data:`PARAMETERS`, ``(5,)``."""
        return np.array([getattr(self, name) for name in PARAMETERS])

    def to_dict(self) -> dict[str, float]:
        """The parameters by name; the anamorphosis angle only when there is one."""
        values = asdict(self)
        if not self.anamorphosis_angle:
            del values["anamorphosis_angle"]
        return values

    @property
    def stretch(self) -> NDArray[np.float64]:
        """The matrix ``S (2, 2)``."""
        angle = np.deg2rad(self.anamorphosis_angle)
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        scaling = np.diag([1 + self.radial_scaling / 100, 1 + self.tangential_scaling / 100])
        return np.asarray(turn.T @ scaling @ turn) if self.anamorphosis_angle else scaling

    def affine(self, sub_aperture_m: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Matrix ``(2, 2)`` and offset ``(2,)`` in metres that place the actuators.

        Parameters
        ----------
        sub_aperture_m
            Size of one sub-aperture on the pupil in metres.
        """
        angle = np.deg2rad(self.rotation)
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        return turn @ self.stretch, np.array([self.shift_x, self.shift_y]) * sub_aperture_m / 100
