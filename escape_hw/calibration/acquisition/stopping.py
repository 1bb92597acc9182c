"""When a measurement is good enough to stop."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.interaction_matrix import InteractionMatrix
from escape_hw.api.procedure import Procedure
from escape_hw.api.sensor import SensorGeometry
from escape_hw.calibration.acquisition.checkpoint import Checkpoint
from escape_hw.calibration.docrime.estimator import DocrimeEstimator
from escape_hw.calibration.docrime.fit import DocrimeSolution
from escape_hw.errors import ConfigError, TooFewFrames

#: A run looks at itself each time it has grown by this factor.
CHECK_GROWTH = 1.25


@dataclass(frozen=True, slots=True)
class Target:
    """What is asked of a measurement; it stops when it has that, or at its number of frames.

    Parameters
    ----------
    snr
        Signal-to-noise ratio that every mode shall reach.
    accuracy
        Standard error that both shifts of the registration shall reach, % of a sub-aperture.

    Raises
    ------
    ConfigError
        Neither is given, or one is not positive.
    """

    snr: float | None = None
    accuracy: float | None = None

    def __post_init__(self) -> None:
        if self.snr is None and self.accuracy is None:
            raise ConfigError("nothing to stop at: give a signal-to-noise ratio or an accuracy")
        for name, value in (("snr", self.snr), ("accuracy", self.accuracy)):
            if value is not None and not 0 < value < np.inf:
                raise ConfigError(f"{name} is {value}; it must be positive")

    def is_snr_reached(self, matrix: InteractionMatrix) -> bool:
        """Whether every mode of a measured matrix has the ratio that is asked for, if one is."""
        return self.snr is None or float(matrix.snr().min()) >= self.snr


def reject_accuracy_target(until: Target | None) -> None:
    """Refuse to stop a measurement of a matrix by the registration behind it.

    Raises
    ------
    ConfigError
        The target asks for a registration's accuracy.
    """
    if until is not None and until.accuracy is not None:
        raise ConfigError("an accuracy is that of a registration; ask the method 'escape' for it")


#: Looks at a solution on the way; true when it will do.
StoppingCriterion = Callable[[DocrimeSolution, SensorGeometry], Procedure[bool]]


class RunMonitor:
    """What a run does with its estimate on the way: keep its state, and ask whether it will do.

    Parameters
    ----------
    keep
        Where the state goes; ``None``: nowhere.
    judge
        Tells whether a solution will do; ``None``: none does, the run goes to its end.
    """

    def __init__(self, checkpoint: Checkpoint | None, criterion: StoppingCriterion | None) -> None:
        self._checkpoint, self._criterion, self._next_check = checkpoint, criterion, 0

    def due(self, frames: int) -> bool:
        """Whether there is anything to do after so many frames; cheap enough for every frame."""
        asked = self._criterion is not None and frames >= self._next_check
        return asked or (self._checkpoint is not None and self._checkpoint.due())

    def check(
        self,
        estimator: DocrimeEstimator,
        grid: SensorGeometry,
        frames: int,
        values: Mapping[str, Any],
        arrays: Mapping[str, NDArray[Any]],
        *,
        final: bool = False,
    ) -> Procedure[bool]:
        """Do what is due.

        Parameters
        ----------
        estimator, grid
            The running estimate.
        frames
            Frames so far.
        values, arrays
            What the state holds beside the estimator's own.
        always
            Keep the state whether it is time or not, and ask nothing: the run ends here.

        Returns
        -------
        bool
            Whether the estimate will do.
        """
        if self._checkpoint is not None and (final or self._checkpoint.due()):
            own_values, own_arrays = estimator.state()
            self._checkpoint.save({**values, **own_values}, {**arrays, **own_arrays}, grid)
        if final or self._criterion is None or frames < self._next_check or not estimator.is_initialised:
            return False
        self._next_check = int(frames * CHECK_GROWTH) + 1
        try:
            solution = estimator.solve()
        except TooFewFrames:
            return False
        return (yield from self._criterion(solution, grid))
