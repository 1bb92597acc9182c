"""When a measurement is good enough to stop."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.matrix import InteractionMatrix
from escape_hw.api.procedure import Procedure
from escape_hw.api.sensor import SensorGeometry
from escape_hw.calibration.checkpoint import Checkpoint
from escape_hw.calibration.docrime_estimator import DocrimeEstimator
from escape_hw.calibration.docrime_solution import DocrimeSolution
from escape_hw.errors import ConfigError, TooFewFrames

#: A run looks at itself each time it has grown by this factor.
GROWTH = 1.25


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

    def snr_met(self, matrix: InteractionMatrix) -> bool:
        """Whether every mode of a measured matrix has the ratio that is asked for, if one is."""
        return self.snr is None or float(matrix.snr().min()) >= self.snr


def no_accuracy(until: Target | None) -> None:
    """Refuse to stop a measurement of a matrix by the registration behind it.

    Raises
    ------
    ConfigError
        The target asks for a registration's accuracy.
    """
    if until is not None and until.accuracy is not None:
        raise ConfigError("an accuracy is that of a registration; ask the method 'escape' for it")


#: Looks at a solution on the way; true when it will do.
Judge = Callable[[DocrimeSolution, SensorGeometry], Procedure[bool]]


class Looks:
    """What a run does with its estimate on the way: keep its state, and ask whether it will do.

    Parameters
    ----------
    keep
        Where the state goes; ``None``: nowhere.
    judge
        Tells whether a solution will do; ``None``: none does, the run goes to its end.
    """

    def __init__(self, keep: Checkpoint | None, judge: Judge | None) -> None:
        self._keep, self._judge, self._next = keep, judge, 0

    def due(self, frames: int) -> bool:
        """Whether there is anything to do after so many frames; cheap enough for every frame."""
        asked = self._judge is not None and frames >= self._next
        return asked or (self._keep is not None and self._keep.due())

    def look(
        self,
        estimator: DocrimeEstimator,
        grid: SensorGeometry,
        frames: int,
        values: Mapping[str, Any],
        arrays: Mapping[str, NDArray[Any]],
        *,
        always: bool = False,
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
        if self._keep is not None and (always or self._keep.due()):
            own_values, own_arrays = estimator.state()
            self._keep.save({**values, **own_values}, {**arrays, **own_arrays}, grid)
        if always or self._judge is None or frames < self._next or not estimator.settled:
            return False
        self._next = int(frames * GROWTH) + 1
        try:
            solution = estimator.solve()
        except TooFewFrames:
            return False
        return (yield from self._judge(solution, grid))
