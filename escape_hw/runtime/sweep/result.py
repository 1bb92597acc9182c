"""Result of a sweep: best parameters, parameter importance (fANOVA), paired comparisons."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import optuna
from optuna.distributions import CategoricalDistribution, FloatDistribution
from optuna.importance import FanovaImportanceEvaluator, get_param_importances
from optuna.trial import create_trial

from escape_hw.api.results import Estimate, StrehlEstimate
from escape_hw.pipeline.statistics import MIN_PAIRS, PairedComparison, compare_pairs, describe_comparison
from escape_hw.runtime.sweep.design import EXPLORE, FINAL, MatrixVariant
from escape_hw.runtime.sweep.run import METRICS, Sweep, SweepRun
from escape_hw.runtime.sweep.search_space import Parameter
from escape_hw.runtime.sweep.study import LoopRecord

#: A parameter that does nothing: what it gets is what chance gives any.
CHANCE = "chance"
#: Fewer loops tell nothing of this.
MIN_LOOPS = 20


def importances(
    records: Sequence[LoopRecord],
    arms: Sequence[MatrixVariant],
    space: Sequence[Parameter],
    seed: int,
    *,
    closed_only: bool = False,
) -> dict[str, float]:
    """Share of each parameter in the variance of the Strehl ratio (Hutter et al. 2014, by Optuna).

    The matrix counts as a parameter like any other (paper, validation procedure). Loops that diverged
    count with a Strehl ratio of 0, or not at all.

    Parameters
    ----------
    records
        Finished loops; those of the first stage are taken.
    arms, space, seed
        Of the sweep.
    closed_only
        Leave out the loops that diverged.

    Returns
    -------
    dict
        By parameter, with :data:`CHANCE`; sums to 1. Empty for fewer than :data:`MIN_LOOPS` loops.
    """
    of = {arm.label: arm for arm in arms}
    selected = [r for r in records if r.slot.stage == EXPLORE and (r.merit > 0 or not closed_only)]
    if len(selected) < MIN_LOOPS or np.ptp([record.merit for record in selected]) == 0:
        return {}
    distributions = {one.key: one.distribution() for one in space}
    distributions["matrix"] = CategoricalDistribution(tuple(dict.fromkeys(arm.matrix for arm in arms)))
    if len({arm.optical_gains for arm in arms}) > 1:
        distributions["optical_gains"] = CategoricalDistribution((False, True))
    distributions[CHANCE] = FloatDistribution(0.0, 1.0)
    known = {name: one for name, one in distributions.items() if not one.single()}
    dummy_values = np.random.default_rng((seed, len(selected))).random(len(selected))
    study = optuna.create_study(direction="maximize")
    for record, dummy in zip(selected, dummy_values, strict=True):
        arm = of[record.slot.arm]
        values = {
            **record.values, "matrix": arm.matrix, "optical_gains": arm.optical_gains, CHANCE: float(dummy)
        }  # fmt: skip
        params = {name: values[name] for name in known}
        study.add_trial(create_trial(params=params, distributions=known, value=record.merit))
    found = get_param_importances(study, evaluator=FanovaImportanceEvaluator(seed=seed % 2**31))
    return {name: float(share) for name, share in found.items()}


#: Difference in the Strehl ratio that does not matter, unless told otherwise: one percent, below what
#: vibrations do from run to run on the paper's bench.
DEFAULT_MARGIN = 0.01


@dataclass(frozen=True, slots=True)
class BestLoops:
    """An arm at its own best parameters.

    Parameters
    ----------
    values
        The parameters.
    strehl
        Mean over the stretches of air of the last stage, with its standard error over them.
    closed, airs
        Loops that stayed closed, and all.
    """

    values: dict[str, Any]
    strehl: StrehlEstimate
    closed: int
    airs: int


@dataclass(frozen=True, slots=True)
class VariantComparison:
    """Two arms on the same air; ``found`` is about first minus second."""

    first: str
    second: str
    found: PairedComparison
    text: str


@dataclass(frozen=True, slots=True)
class SweepResult:
    """Everything a sweep found.

    ``comparisons`` are between arms at their own best parameters, ``at_random`` between arms at the same
    random ones, where both loops were stable; ``importance`` counts diverged loops with a Strehl ratio
    of 0, ``importance_closed`` leaves them out.
    """

    sweep: Sweep
    run: SweepRun
    margin: float
    best: dict[str, BestLoops] = field(default_factory=dict)
    comparisons: tuple[VariantComparison, ...] = ()
    at_random: tuple[VariantComparison, ...] = ()
    importance: dict[str, float] = field(default_factory=dict)
    importance_closed: dict[str, float] = field(default_factory=dict)

    def __repr__(self) -> str:
        arms = ", ".join(arm.label for arm in self.sweep.arms)
        state = ", PARTIAL" if self.partial else ""
        lines = [f"{type(self).__name__} of {len(self.run.records)} loops: {arms}{state}"]
        lines += [
            f"{label}: Strehl ratio {best.strehl.peak.value:.3f} ± {best.strehl.peak.sigma:.3f} at its best"
            for label, best in self.best.items()
        ]
        return f"<{chr(10).join([*lines, *(one.text for one in self.comparisons)])}>".replace("\n", "\n  ")

    @property
    def partial(self) -> bool:
        """Whether the operator stopped it."""
        return self.run.partial

    def stage(self, stage: str, arm: str | None = None) -> list[LoopRecord]:
        """Finished loops of a stage, of one arm or all."""
        return [r for r in self.run.records if r.slot.stage == stage and (arm is None or r.slot.arm == arm)]


def analyse_sweep(sweep: Sweep, run: SweepRun, margin: float = DEFAULT_MARGIN) -> SweepResult:
    """Draw the conclusions of a sweep, as far as its loops go.

    Parameters
    ----------
    sweep, run
        What was run, and what came of it.
    margin
        Difference in the Strehl ratio that does not matter.
    """
    best = {}
    for arm in sweep.arms:
        final = [r for r in run.records if r.slot.stage == FINAL and r.slot.arm == arm.label]
        if final:
            best[arm.label] = _summarise_final(final)
    pairs = list(_pairs(sweep.arms))
    final_of = _by_realisation(r for r in run.records if r.slot.stage == FINAL)
    explored_of = _by_realisation(r for r in run.records if r.slot.stage == EXPLORE and r.outcome["stable"])
    same = _same_parameters(run.records)
    return SweepResult(
        sweep, run, margin, best,
        tuple(_compare_pairs(pairs, final_of, margin)),
        tuple(_compare_pairs(pairs, explored_of, margin)) if same else (),
        importances(run.records, sweep.arms, sweep.space, sweep.seed),
        importances(run.records, sweep.arms, sweep.space, sweep.seed, closed_only=True),
    )  # fmt: skip


def _summarise_final(final: Sequence[LoopRecord]) -> BestLoops:
    closed = [r for r in final if r.merit > 0]
    strehls = []
    for way in METRICS:
        # A loop that diverged has no image worth the name.
        values = np.array([r.outcome["strehl"][way]["value"] if r.merit > 0 else 0.0 for r in final])
        sigma = float(values.std(ddof=1) / math.sqrt(values.size)) if values.size > 1 else math.nan
        strehls.append(Estimate(float(values.mean()), sigma))
    return BestLoops(final[0].values, StrehlEstimate(*strehls), len(closed), len(final))


def _pairs(arms: Sequence[MatrixVariant]) -> Iterable[tuple[str, str]]:
    """Every arm against the first, and every matrix with its optical gains against itself without."""
    for arm in arms[1:]:
        yield arm.label, arms[0].label
    for arm in arms[1:]:
        for other in arms[1:]:
            if arm.matrix == other.matrix and arm.optical_gains and not other.optical_gains:
                yield arm.label, other.label
    rest = [arm.label for arm in arms[1:] if arm.optical_gains == arms[0].optical_gains]
    yield from zip(rest[1:], rest, strict=False)


def _by_realisation(records: Iterable[LoopRecord]) -> dict[str, dict[int, float]]:
    found: dict[str, dict[int, float]] = {}
    for record in records:
        found.setdefault(record.slot.arm, {})[record.slot.index] = record.merit
    return found


def _same_parameters(records: Sequence[LoopRecord]) -> bool:
    """Whether all arms ran the same parameters on the same air, as random ones are drawn."""
    seen: dict[int, dict[str, Any]] = {}
    for record in records:
        if (
            record.slot.stage == EXPLORE
            and seen.setdefault(record.slot.index, record.values) != record.values
        ):
            return False
    return True


def _compare_pairs(
    pairs: Sequence[tuple[str, str]], merits: dict[str, dict[int, float]], margin: float
) -> Iterable[VariantComparison]:
    for first, second in pairs:
        a, b = merits.get(first, {}), merits.get(second, {})
        common = sorted(set(a) & set(b))
        if len(common) >= MIN_PAIRS:
            found = compare_pairs(np.array([a[n] for n in common]), np.array([b[n] for n in common]))
            yield VariantComparison(first, second, found, describe_comparison(first, second, found, margin))
