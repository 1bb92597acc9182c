"""Common shape of the influence functions, fitted beside the registration.

A model gives the slopes of nominal influence functions of any width. Sums of them approximate the mirrors
that exist: a radial profile is a sum of nominal functions of several widths (an exponential of the distance,
as of membrane mirrors, is a positive sum of Gaussians: Bernstein's theorem), a four-fold term is a ring of
eight shifted functions of alternating sign, and the functions of edge actuators have shares and an outward
asymmetry of their own. All terms are linear in the slopes.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.registration import Registration
from escape_hw.api.synthetic_model import PROFILE_WIDTHS, HasActuatorPositions, HasProfile, SyntheticModel
from escape_hw.calibration.modes.derivatives import zonal_components, zonal_jacobian, zonal_sum

#: Lobes of the four-fold terms: distance in pitches, and width relative to the nominal one.
_FOURFOLD_LOBES = ((0.4, 0.35), (0.8, 0.6), (1.6, 1.0))
_N_LOBES = 8
#: Prior standard deviations of the coefficients: shares of the profile, four-fold terms, and gain, width,
#: shares and outward asymmetry (per pitch) of the edge actuators. They only regularise: measured mirrors have
#: a third of them.
_PROFILE_SIGMA, _FOURFOLD_SIGMA = 0.3, 0.05
_EDGE_GAIN_SIGMA, _EDGE_WIDTH_SIGMA, _EDGE_PROFILE_SIGMA, _EDGE_ASYMMETRY_SIGMA = 0.2, 0.1, 0.1, 0.1
#: Changes of registration, in its units, and width below which terms of a few per cent of the matrix are
#: kept, the four-fold ones and those that follow a mirror; and derivatives of terms that may be larger on a
#: mirror of another family.
KEEP_WITHIN = np.array([5.0, 5.0, 0.1, 0.2, 0.2, 0.01])
KEEP_DERIVATIVES_WITHIN = KEEP_WITHIN / 10
#: Half step of derivatives by position, in % of a sub-aperture.
_SHIFT_STEP = 2.0
#: Actuators closer than this many pitches are neighbours.
_NEIGHBOUR_DISTANCE = 1.3
#: Squared standard deviation of a Gaussian of coupling 0.4 in squared pitches: the scale of the asymmetry.
_SQUARED_WIDTH = 0.55


@dataclass(slots=True, eq=False)
class ShapedMatrix:
    """Zonal matrix of the shaped influence functions and its derivatives.

    Parameters
    ----------
    nominal, matrix
        Slopes per unit command of the nominal and of the shaped influence functions ``(n_slopes, n_act)``.
    jacobian
        Derivatives of the latter by the registration and the width ``(6, n_slopes, n_act)``.
    terms
        Derivative by each coefficient ``(n_slopes, n_act)``.
    """

    nominal: NDArray[np.float64]
    matrix: NDArray[np.float64]
    jacobian: NDArray[np.float64]
    terms: list[NDArray[np.float64]]


class InfluenceShape:
    """Terms of the common shape of a model's influence functions.

    Without the positions of the actuators (:class:`~escape_hw.api.synthetic_model.HasActuatorPositions`) only
    the radial profile is fitted.

    Parameters
    ----------
    model
        The synthetic model.
    """

    def __init__(self, model: SyntheticModel) -> None:
        self._shares = np.eye(len(PROFILE_WIDTHS))[0]
        self._model = model
        self._given: SyntheticModel | None = None
        if isinstance(model, HasProfile):
            self._model = model.component_model()
            if model.profile_shares:
                self._shares = np.array(model.profile_shares)
            else:
                # A shape that is no sum of the components: they are added to it.
                self._shares, self._given = np.zeros(len(PROFILE_WIDTHS)), model
        self._widths = PROFILE_WIDTHS[1:]
        n = len(self._widths)
        self.names = [f"profile_{width:g}" for width in self._widths]
        sigma = [_PROFILE_SIGMA] * n
        self._edge: NDArray[np.float64] | None = None
        if isinstance(model, HasActuatorPositions):
            positions = np.asarray(model.actuator_positions_m)
            distance = np.linalg.norm(positions[:, None] - positions, axis=2)
            pitch = float(np.median(np.sort(distance, axis=1)[:, 1]))
            self._edge = find_edge_actuators(positions).astype(float)
            self._pitch = 100 * pitch / model.sub_aperture_m
            centred = positions - positions.mean(axis=0)
            outward = centred / np.maximum(np.linalg.norm(centred, axis=1), 1e-9 * pitch)[:, None]
            self._outward = _SQUARED_WIDTH * self._pitch * outward.T
            self.names += [f"fourfold_{distance:g}" for distance, _ in _FOURFOLD_LOBES]
            self.names += ["edge_gain", "edge_width", *(f"edge_{name}" for name in self.names[:n])]
            self.names += [f"edge_asymmetry_{width:g}" for width in (1.0, *self._widths)]
            sigma += [_FOURFOLD_SIGMA] * len(_FOURFOLD_LOBES) + [_EDGE_GAIN_SIGMA, _EDGE_WIDTH_SIGMA]
            sigma += [_EDGE_PROFILE_SIGMA] * n + [_EDGE_ASYMMETRY_SIGMA] * (n + 1)
        self.prior_sigma = np.array(sigma)
        self._fourfold_at: NDArray[np.float64] | None = None
        self._fourfold: list[NDArray[np.float64]] = []
        self._outward_at: NDArray[np.float64] | None = None
        self._outward_kept: list[NDArray[np.float64]] = []

    @property
    def n_terms(self) -> int:
        """Number of coefficients."""
        return len(self.names)

    def linearise(
        self, registration: Registration, width: float, coefficients: NDArray[np.float64]
    ) -> ShapedMatrix:
        """The shaped zonal matrix and its derivatives.

        Parameters
        ----------
        registration, width
            As for :meth:`~escape_hw.api.synthetic_model.SyntheticModel.zonal_matrix`.
        coefficients
            Coefficient of each term ``(n_terms,)``.
        """
        n = len(self._widths)
        # The functions of the profile replace the first one.
        shares = self._shares + np.append(-coefficients[:n].sum(), coefficients[:n])
        components, jacobian = zonal_components(
            self._model, registration, width, [*zip(shares.tolist(), PROFILE_WIDTHS, strict=True)]
        )
        nominal = np.tensordot(self._shares, components, axes=1)
        if self._given is not None:
            given, by_given = zonal_jacobian(self._given, registration, width)
            nominal, jacobian = nominal + given, jacobian + by_given
        profile = [one - components[0] for one in components[1:]]
        terms = profile
        if self._edge is not None:
            terms = terms + self._fourfold_terms(registration, width)
            outward = self._outward_terms(registration, width)
            common = _add(nominal, coefficients, terms)
            terms += [self._edge * part for part in (common, width * jacobian[5], *profile, *outward)]
        return ShapedMatrix(nominal, _add(nominal, coefficients, terms), jacobian, terms)

    def matrix(
        self,
        registration: Registration,
        width: float,
        coefficients: NDArray[np.float64],
        terms: list[NDArray[np.float64]],
    ) -> NDArray[np.float64]:
        """The shaped zonal matrix alone ``(n_slopes, n_act)``.

        The four-fold terms and the derivatives in those of the edge actuators, a few per cent of the matrix,
        are taken from ``terms``, those of :meth:`linearise` nearby.
        """
        n = len(self._widths)
        weights, edge_gain = self._profile_weights(coefficients)
        kept = coefficients.copy()
        if self._edge is not None:
            first = n + len(_FOURFOLD_LOBES)
            kept[first] = 0.0
            kept[first + 2 : first + 2 + n] = 0.0
        functions = zip(weights, PROFILE_WIDTHS, strict=True)
        matrix = zonal_sum(self._model, [(w, registration, width * relative) for w, relative in functions])
        if self._given is not None:
            matrix += self._given.zonal_matrix(registration, width) * edge_gain
        for number in np.flatnonzero(kept[n:]) + n:
            is_fourfold = number < n + len(_FOURFOLD_LOBES)
            matrix += kept[number] * (edge_gain * terms[number] if is_fourfold else terms[number])
        return matrix

    def profile_matrix(
        self,
        model: SyntheticModel,
        registration: Registration,
        width: float,
        coefficients: NDArray[np.float64],
    ) -> NDArray[np.float64]:
        """Zonal matrix ``(n_slopes, n_act)`` of the radial profiles, without the terms that have a direction.

        Parameters
        ----------
        model
            The synthetic model, or one of the same mirror on another sensor.
        registration, width, coefficients
            As for :meth:`linearise`; the registration may have an anamorphosis angle.
        """
        weights, edge_gain = self._profile_weights(coefficients)
        component = model.component_model() if isinstance(model, HasProfile) else model
        matrix = np.zeros(())
        for weight, relative_width in zip(weights, PROFILE_WIDTHS, strict=True):
            if np.any(weight):
                matrix = matrix + weight * component.zonal_matrix(registration, width * relative_width)
        if self._given is not None:
            matrix = matrix + edge_gain * model.zonal_matrix(registration, width)
        return matrix

    def _profile_weights(
        self, coefficients: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64] | float]:
        """Share of each width of the profile ``(n_widths, n_act)``, and gain of the edge actuators."""
        n = len(self._widths)
        weights = coefficients[:n, None] * np.ones(self._model.n_act)
        edge_gain: NDArray[np.float64] | float = 1.0
        if self._edge is not None:
            first = n + len(_FOURFOLD_LOBES)
            edge_gain = 1 + coefficients[first] * self._edge
            edge_profile = slice(first + 2, first + 2 + n)
            weights = weights * edge_gain + coefficients[edge_profile, None] * self._edge
        # The functions of the profile replace the first one.
        weights = np.concatenate([-weights.sum(axis=0, keepdims=True), weights])
        weights += self._shares[:, None] * edge_gain
        return weights, edge_gain

    def _outward_terms(self, registration: Registration, width: float) -> list[NDArray[np.float64]]:
        """Outward asymmetries by width; those of a nearby registration are kept."""
        at = np.append(registration.to_array(), width)
        if self._outward_at is None or (np.abs(at - self._outward_at) >= KEEP_DERIVATIVES_WITHIN).any():
            self._outward_at = at
            self._outward_kept = [
                relative**2 * self._outward_derivative(registration, width * relative)
                for relative in PROFILE_WIDTHS
            ]
        return self._outward_kept

    def _outward_derivative(self, registration: Registration, width: float) -> NDArray[np.float64]:
        """Derivative by outward positions of the actuators ``(n_slopes, n_act)``, by central differences."""
        along_x, along_y = self._outward / (2 * _SHIFT_STEP)
        moved = []
        for sign in (1.0, -1.0):
            x, y = registration.shift_x + sign * _SHIFT_STEP, registration.shift_y + sign * _SHIFT_STEP
            moved.append((sign * along_x, replace(registration, shift_x=x), width))
            moved.append((sign * along_y, replace(registration, shift_y=y), width))
        return zonal_sum(self._model, moved)

    def _fourfold_terms(self, registration: Registration, width: float) -> list[NDArray[np.float64]]:
        """Lobes along the axes of the mirror less those between them; their derivatives are neglected."""
        at = np.append(registration.to_array(), width)
        if self._fourfold_at is not None and (np.abs(at - self._fourfold_at) < KEEP_WITHIN).all():
            return self._fourfold
        affine, _ = registration.affine(self._model.sub_aperture_m)
        terms = []
        for distance, relative_width in _FOURFOLD_LOBES:
            lobes = []
            for number in range(_N_LOBES):
                angle = 2 * np.pi * number / _N_LOBES
                shift = affine @ (self._pitch * distance * np.array([np.cos(angle), np.sin(angle)]))
                shifted = replace(
                    registration,
                    shift_x=registration.shift_x + float(shift[0]),
                    shift_y=registration.shift_y + float(shift[1]),
                )
                lobes.append(((-1.0) ** number, shifted, width * relative_width))
            terms.append(zonal_sum(self._model, lobes))
        self._fourfold_at, self._fourfold = at, terms
        return terms


def find_edge_actuators(positions_m: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Actuators with fewer neighbours than the median ``(n_act,)``, from positions ``(n_act, 2)``."""
    distance = np.linalg.norm(positions_m[:, None] - positions_m, axis=2)
    pitch = np.median(np.sort(distance, axis=1)[:, 1])
    neighbours = (distance < _NEIGHBOUR_DISTANCE * pitch).sum(axis=1)
    return np.asarray(neighbours < np.median(neighbours))


def _add(
    nominal: NDArray[np.float64], coefficients: NDArray[np.float64], terms: list[NDArray[np.float64]]
) -> NDArray[np.float64]:
    total = nominal.copy()
    for coefficient, term in zip(coefficients, terms, strict=False):
        total += coefficient * term
    return total
