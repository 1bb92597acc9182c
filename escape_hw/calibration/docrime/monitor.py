"""Checks of a running DO-CRIME estimate: its checkpoint and its stopping criterion."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from numpy.typing import NDArray

from escape_hw.api.procedure import Procedure
from escape_hw.api.sensor import SensorGeometry
from escape_hw.calibration.acquisition.checkpoint import Checkpoint
from escape_hw.calibration.docrime.estimator import DocrimeEstimator
from escape_hw.calibration.docrime.fit import DocrimeSolution
from escape_hw.errors import TooFewFrames

#: A run is checked each time its number of frames has grown by this factor.
CHECK_GROWTH = 1.25

#: Procedure that returns whether a solution on a geometry is good enough to stop.
StoppingCriterion = Callable[[DocrimeSolution, SensorGeometry], Procedure[bool]]


class RunMonitor:
    """Saves the state of a run when it is time, and evaluates its stopping criterion."""

    def __init__(self, checkpoint: Checkpoint | None, criterion: StoppingCriterion | None) -> None:
        self._checkpoint, self._criterion, self._next_check = checkpoint, criterion, 0

    def is_due(self, frames: int) -> bool:
        """Whether :meth:`check` has anything to do after so many frames; fast enough for every frame."""
        criterion_due = self._criterion is not None and frames >= self._next_check
        return criterion_due or (self._checkpoint is not None and self._checkpoint.is_due())

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
        """Save the state and evaluate the criterion, as far as either is due.

        ``values``, ``arrays``: entries of the state beside the estimator's own; ``final``: the run ends here:
        save the state in any case and do not evaluate the criterion.

        Returns whether the criterion is met.
        """
        if self._checkpoint is not None and (final or self._checkpoint.is_due()):
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
