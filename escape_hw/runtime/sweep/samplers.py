"""Where a sweep's parameters come from: drawn by the number of the air, or learnt arm by arm (TPE)."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Sequence
from typing import Any

import optuna
from optuna.distributions import BaseDistribution
from optuna.samplers import BaseSampler, TPESampler
from optuna.trial import FrozenTrial, TrialState, create_trial

from escape_hw.runtime.sweep.plan import Slot, drawn
from escape_hw.runtime.sweep.space import Parameter

#: The samplers by name.
SAMPLERS = ("random", "tpe")
#: Loops of each arm with drawn parameters before TPE has anything to learn from.
STARTUP = 10

#: What is known of an arm: parameters and merit of its finished loops.
History = Sequence[tuple[dict[str, Any], float]]


class SlotSampler(BaseSampler):
    """Gives each trial the parameters that belong to its place in the plan.

    ``random`` draws them by the number of the air, so that every arm runs the same ones on the same air.
    ``tpe`` learns from the arm's own loops: every matrix is led to its own best parameters, none by
    another's.

    Parameters
    ----------
    space
        What is varied.
    seed
        Of the whole sweep.
    slot_of
        Place of a trial in the plan.
    history
        Finished loops of an arm; ``None``: parameters are drawn.
    """

    def __init__(
        self,
        space: Sequence[Parameter],
        seed: int,
        slot_of: Callable[[FrozenTrial], Slot],
        history: Callable[[str], History] | None,
    ) -> None:
        self._space, self._seed, self._slot_of, self._history = tuple(space), seed, slot_of, history
        self._chosen: dict[int, dict[str, Any]] = {}

    def infer_relative_search_space(
        self, study: optuna.Study, trial: FrozenTrial
    ) -> dict[str, BaseDistribution]:
        """Nothing: all parameters of a trial are chosen together when the first is asked for."""
        return {}

    def sample_relative(
        self, study: optuna.Study, trial: FrozenTrial, search_space: dict[str, BaseDistribution]
    ) -> dict[str, Any]:
        """Nothing; see :meth:`infer_relative_search_space`."""
        return {}

    def sample_independent(
        self,
        study: optuna.Study,
        trial: FrozenTrial,
        param_name: str,
        param_distribution: BaseDistribution,
    ) -> Any:
        """One parameter."""
        if trial.number not in self._chosen:
            # Those of a trial are asked for in a row.
            self._chosen = {trial.number: self._values(self._slot_of(trial))}
        return self._chosen[trial.number][param_name]

    def _values(self, slot: Slot) -> dict[str, Any]:
        history = () if self._history is None else self._history(slot.arm)
        if self._history is None or min(len(history), slot.index) < STARTUP:
            return drawn(self._space, self._seed, slot.index)
        distributions = {one.key: one.distribution() for one in self._space}
        seed = zlib.crc32(f"{self._seed} {slot.arm} {slot.index}".encode())
        learner = optuna.create_study(
            direction="maximize", sampler=TPESampler(seed=seed, multivariate=True, n_startup_trials=0)
        )
        learner.add_trials(
            create_trial(state=TrialState.COMPLETE, params=params, distributions=distributions, value=merit)
            for params, merit in history
        )
        return dict(learner.ask(distributions).params)
