"""Search for another orientation of the sensor, or sign or order of its slopes, that explains a matrix."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.flips import Flip, exchanges_axes, flip_matrix, inverse_flip
from escape_hw.api.interaction_matrix import InteractionMatrix
from escape_hw.api.synthetic_model import DifferentiableModel, HasOrientation, SyntheticModel
from escape_hw.calibration.sprint.coarse_search import weigh_low_modes
from escape_hw.calibration.sprint.least_squares import LeastSquaresFit, LeastSquaresProblem
from escape_hw.calibration.sprint.weighted_matrix import WeightedMatrix

#: Flip of the camera's images that restores them, or what is wrong with the slopes.
_Change = Flip | Literal["exchanged slopes", "reversed x slopes"]
#: What the sensor saw, by the flip that restores it.
_SEEN: dict[Flip, str] = {
    "left-right": "mirrored left to right",
    "up-down": "upside down",
    "turn-180": "turned by 180 degrees",
    "turn-90": "turned by 270 degrees",
    "turn-270": "turned by 90 degrees",
    "transpose": "transposed",
    "anti-transpose": "transposed about the other diagonal",
}
_ITERATIONS = 10
#: Standard errors of the fitted matrix by which another orientation must explain more than the described one:
#: in pure noise, the largest of some hundred starts of a search reaches about 5.
_SIGNIFICANT = 10.0
#: Fraction of the signal that it must explain. With ten modes or more the right one explains 0.76 to 0.99,
#: also with other influence functions, another pitch or dead actuators than described; wrong ones up to 0.3.
_MIN_EXPLAINED = 0.5


@dataclass(frozen=True, slots=True)
class _Candidate:
    """A change of the description, and the sum of squares that a fit explains with it."""

    change: _Change
    is_opposite: bool
    explained: float

    @property
    def is_described(self) -> bool:
        return self.change == "none" and not self.is_opposite


def find_better_orientation(
    matrix: InteractionMatrix, model: SyntheticModel, columns: NDArray[np.intp], alpha: NDArray[np.float64]
) -> str | None:
    """Find an orientation that explains a matrix, and significantly more of it than the described one.

    Gain and registration are fitted to all columns for every flip, quarter turn and transposition, for x and
    y slopes exchanged, and for one axis of the slopes reversed. The sign of the gain is the polarity. There
    are no random effects, because they may fit a mirrored pupil.

    Parameters
    ----------
    matrix, model, columns
        The measured matrix, its model, and the columns that were fitted.
    alpha
        Registration that was found with the described orientation ``(5,)``.

    Returns
    -------
    str or None
        A warning with what to set; ``None`` if no orientation is better, or if the model is not
        differentiable and so too slow.
    """
    if not isinstance(model, DifferentiableModel):
        return None
    weighted = WeightedMatrix.from_columns(matrix, columns)
    low_modes = weigh_low_modes(matrix, model, columns)
    found = list(_fit_candidates(weighted, low_modes, model, alpha))
    described = max((one.explained for one in found if one.is_described), default=0.0)
    others = [one for one in found if not one.is_described]
    most = max(one.explained for one in others)
    total, signal = float(np.square(weighted.data).sum()), weighted.signal_fraction
    # A misfit of the model counts as noise.
    noise = (total - most) / weighted.expected_noise
    significant = _SIGNIFICANT**2 * (max(noise, 1.0) if weighted.has_standard_errors else noise)
    if most < max(described + significant, _MIN_EXPLAINED * signal * total):
        return None
    # Of those that explain as much, the first is the simplest.
    best = next(one for one in others if one.explained >= most - significant)
    return (
        f"as described, the model explains {described / total:.0%} of the matrix where noise leaves "
        f"{signal:.0%} to explain; it would explain {best.explained / total:.0%} if {_describe(best, model)}"
    )


def suggest_orientation(model: SyntheticModel, flip: Flip, *, opposite: bool = False) -> str:
    """What to set so that images are turned further by ``flip``, and commands have the ``opposite`` sign."""
    if isinstance(model, HasOrientation):
        return model.suggest_orientation(flip, opposite=opposite)
    return "check the layout, the flips and the polarity"


def _describe(candidate: _Candidate, model: SyntheticModel) -> str:
    """The condition and what to set, as the end of a sentence."""
    change, is_opposite = candidate.change, candidate.is_opposite
    reversed_too = " and the polarity were reversed" * is_opposite
    if change == "reversed x slopes":
        axis = "y" if is_opposite else "x"
        return (
            f"its {axis} slopes had the other sign: check the sign of the slopes "
            f"(sensor.sign_{axis} of the description in 'escape import arrays')"
        )
    if change == "exchanged slopes":
        polarity = f", and {suggest_orientation(model, 'none', opposite=True)}" * is_opposite
        return (
            f"its x slopes were its y slopes{reversed_too}: check the order of the slopes "
            f"(matrix.slopes of the description in 'escape import arrays'){polarity}"
        )
    remedy = suggest_orientation(model, change, opposite=is_opposite)
    if change == "none":
        return f"the polarity were reversed: {remedy}"
    return f"the sensor saw the pupil {_SEEN[change]}{reversed_too}: {remedy}"


def _fit_candidates(
    weighted: WeightedMatrix,
    low_modes: WeightedMatrix,
    model: DifferentiableModel,
    alpha: NDArray[np.float64],
) -> Iterator[_Candidate]:
    """Fit every change, from zero or from where the low modes lead; none also from ``alpha (5,)``."""
    for (change, seen), (_, low_seen) in zip(_changed(weighted), _changed(low_modes), strict=True):
        problem, zero = LeastSquaresProblem(seen, model), np.zeros(5)
        low = _descend(LeastSquaresProblem(low_seen, model), zero).alpha
        start = max(zero, low, key=problem.explained_fraction)
        for one in (start, alpha) if change == "none" else (start,):
            fit = _descend(problem, one)
            yield _Candidate(change, fit.gain < 0, float(np.square(seen.data).sum()) - fit.cost)


def _descend(problem: LeastSquaresProblem, start: NDArray[np.float64]) -> LeastSquaresFit:
    *_, fit = problem.descend(start, _ITERATIONS)
    return fit


def _changed(weighted: WeightedMatrix) -> Iterator[tuple[_Change, WeightedMatrix]]:
    """The matrix, and what it would be with every change, the simplest first."""
    yield "none", weighted
    for flip in _SEEN:
        if weighted.valid.shape[0] == weighted.valid.shape[1] or not exchanges_axes(flip):
            yield flip, _reoriented(weighted, flip)
    half = len(weighted.data) // 2
    x, y = np.split(weighted.data, 2)
    yield (
        "exchanged slopes",
        replace(weighted, data=np.concatenate([y, x]), by_slope=np.roll(weighted.by_slope, half)),
    )
    yield "reversed x slopes", replace(weighted, data=np.concatenate([-x, y]))


def _reoriented(weighted: WeightedMatrix, flip: Flip) -> WeightedMatrix:
    """The matrix of a sensor with flipped images; slopes that it would not have get no weight."""
    valid = weighted.valid
    number = np.full(valid.shape, -1)
    number[valid] = np.arange(int(valid.sum()))
    middle = (np.array(valid.shape) - 1) / 2
    # Where the restored image has its content from; axes (row, column) instead of (x, y).
    rotation = flip_matrix(inverse_flip(flip))[::-1, ::-1]
    positions = np.argwhere(valid)
    target = np.rint((positions - middle) @ rotation.T + middle).astype(int)
    source = number[target[:, 0], target[:, 1]]
    n = len(positions)
    data, noise = np.zeros_like(weighted.data), np.full(2 * n, np.inf)
    # Slopes (x, y) transform as the offsets (row, column) do.
    for half, axis in ((0, 1), (1, 0)):
        along = int(np.flatnonzero(rotation.T[axis])[0])
        rows = np.flatnonzero(source >= 0)
        at = source[rows] + (1 - along) * n
        data[rows + half * n] = rotation.T[axis, along] * weighted.data[at]
        noise[rows + half * n] = weighted.by_slope[at]
    return replace(weighted, data=data, by_slope=noise)
