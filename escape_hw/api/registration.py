"""Registration of mirror and wavefront sensor: parameters, units and sign convention."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace

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
#: Factors to the units of streams ``(5,)``: sub-apertures, radians, fractions of the diameter.
TO_STREAM_UNITS = np.array([0.01, 0.01, np.pi / 180, 0.01, 0.01])


@dataclass(frozen=True, slots=True)
class Registration:
    """Affine registration of mirror and sensor (paper: the vector alpha, Table 1).

    Seen from the sensor, an actuator of nominal position ``(x, y)`` (x along columns, y along rows, from
    the centre of the sub-aperture grid) is at ``R(rotation) S (x, y) + (shift_x,
    shift_y)``, where ``S = R(-a) diag(1 + radial_scaling, 1 + tangential_scaling) R(a)`` with the
    anamorphosis angle a, zero unless given, and a positive rotation turns +x towards +y. Positive
    shifts mean that the mirror moved to higher columns or rows. OOPAO's ``MisRegistration`` has the
    same rotation, scalings and anamorphosis angle and the opposite sign of the shifts.

    Parameters
    ----------
    shift_x, shift_y
        In % of a sub-aperture.
    rotation
        In degrees; stored in (-180, 180], whatever multiple of 360 a fit or a caller adds.
    radial_scaling, tangential_scaling
        Scaling along x and along y, in % (OOPAO's names).
    anamorphosis_angle
        In degrees: the radial scaling acts along the direction at minus this angle from +x towards
        +y (OOPAO's sense). Arrays and tables do not contain it: SPRINT fits the scalings along x and y
        and, as an extra parameter, a shear (:meth:`with_shear`).
    """

    shift_x: float = 0.0
    shift_y: float = 0.0
    rotation: float = 0.0
    radial_scaling: float = 0.0
    tangential_scaling: float = 0.0
    anamorphosis_angle: float = 0.0

    def __post_init__(self) -> None:
        # Values within the range stay as they are, to the last bit.
        if not -180 < self.rotation <= 180:
            object.__setattr__(self, "rotation", 180 - (180 - self.rotation) % 360)

    @classmethod
    def from_array(cls, values: ArrayLike) -> Registration:
        """Registration from five numbers in the order of :data:`PARAMETERS`."""
        return cls(*(float(v) for v in np.asarray(values, dtype=float).reshape(5)))

    def to_array(self) -> NDArray[np.float64]:
        """Five numbers in the order of :data:`PARAMETERS`, ``(5,)``."""
        return np.array([getattr(self, name) for name in PARAMETERS])

    def to_dict(self) -> dict[str, float]:
        """The parameters by name; the anamorphosis angle only if it is not zero."""
        values = asdict(self)
        if not self.anamorphosis_angle:
            del values["anamorphosis_angle"]
        return values

    @property
    def scaling_matrix(self) -> NDArray[np.float64]:
        """The matrix ``S (2, 2)``."""
        angle = np.deg2rad(self.anamorphosis_angle)
        rotation_matrix = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        scaling = np.diag([1 + self.radial_scaling / 100, 1 + self.tangential_scaling / 100])
        return (
            np.asarray(rotation_matrix.T @ scaling @ rotation_matrix) if self.anamorphosis_angle else scaling
        )

    def with_shear(self, shear: float) -> Registration:
        """The registration with ``shear / 100`` added to the off-diagonal elements of ``S``.

        A symmetric ``S`` has two scalings and a shear. The result has the scalings along its principal axes,
        and their angle.

        Parameters
        ----------
        shear
            In %: half the difference of the scalings along the two diagonals.
        """
        scaling_matrix = self.scaling_matrix + np.array([[0.0, shear], [shear, 0.0]]) / 100
        # Angle of the larger principal axis from x towards y.
        axis_angle = 0.5 * np.arctan2(2 * scaling_matrix[0, 1], scaling_matrix[0, 0] - scaling_matrix[1, 1])
        mean = (scaling_matrix[0, 0] + scaling_matrix[1, 1]) / 2
        half = np.hypot((scaling_matrix[0, 0] - scaling_matrix[1, 1]) / 2, scaling_matrix[0, 1])
        return replace(
            self,
            radial_scaling=float(100 * (mean + half - 1)),
            tangential_scaling=float(100 * (mean - half - 1)),
            anamorphosis_angle=float(-np.rad2deg(axis_angle)),
        )

    @property
    def axis_scalings_and_shear(self) -> tuple[Registration, float]:
        """Registration with scalings along x and y, and shear in %: the inverse of :meth:`with_shear`."""
        scaling_matrix = 100 * (self.scaling_matrix - np.eye(2))
        axis_aligned = replace(
            self,
            radial_scaling=float(scaling_matrix[0, 0]),
            tangential_scaling=float(scaling_matrix[1, 1]),
            anamorphosis_angle=0.0,
        )
        return axis_aligned, float(scaling_matrix[0, 1])

    def largest_displacement(self, other: Registration, radius: float) -> float:
        """Largest displacement of a point of the pupil from ``other`` to this registration.

        Parameters
        ----------
        radius
            Radius of the pupil in sub-apertures.

        Returns
        -------
        float
            In % of a sub-aperture.
        """
        matrix, offset = self.affine(1.0)
        other_matrix, other_offset = other.affine(1.0)
        angles = np.linspace(0, 2 * np.pi, 64, endpoint=False)
        edge = radius * np.stack([np.cos(angles), np.sin(angles)])
        moved = (matrix - other_matrix) @ edge + (offset - other_offset)[:, None]
        return float(100 * np.hypot(*moved).max())

    def affine(self, sub_aperture_m: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Matrix ``(2, 2)`` and offset ``(2,)`` in metres of the actuator positions.

        Parameters
        ----------
        sub_aperture_m
            Size of one sub-aperture on the pupil in metres.
        """
        angle = np.deg2rad(self.rotation)
        rotation_matrix = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        return rotation_matrix @ self.scaling_matrix, np.array(
            [self.shift_x, self.shift_y]
        ) * sub_aperture_m / 100
