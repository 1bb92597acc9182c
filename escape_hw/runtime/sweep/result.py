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

from escape_hw.api.procedure import Procedure
from escape_hw.api.results import Estimate, StrehlEstimate
from escape_hw.bench import Bench
from escape_hw.pipeline.statistics import MIN_PAIRS, PairedComparison, compare_pairs, describe_comparison
from escape_hw.runtime.sweep.description import SweepDescription
from escape_hw.runtime.sweep.design import EXPLORE, FINAL, METRICS, MatrixVariant, Sweep
from escape_hw.runtime.sweep.run import SweepRun, run_sweep
from escape_hw.runtime.sweep.study import TrialRecord
from escape_hw.runtime.sweep.workers import Workers

#: Importance of a dummy parameter without effect: the share that noise gives to any parameter.
CHANCE = "chance"
#: Fewest loops for the importance of parameters.
MIN_LOOPS = 20
#: Largest difference in the Strehl ratio that counts as equivalent, by default: one percent, less than
#: vibrations cause between runs on the paper's bench.
DEFAULT_MARGIN = 0.01


@dataclass(frozen=True, slots=True)
class BestLoops:
    """A variant at its own best parameters.

    ``strehl`` is the mean over the realisations of the last stage, with its standard error over them; of the
    ``loops``, ``closed`` stayed closed.
    """

    values: dict[str, Any]
    strehl: StrehlEstimate
    closed: int
    loops: int


@dataclass(frozen=True, slots=True)
class VariantComparison:
    """Two variants on the same turbulence; ``found`` is about first minus second."""

    first: str
    second: str
    found: PairedComparison
    text: str


@dataclass(frozen=True, slots=True)
class SweepResult:
    """Result of a sweep.

    ``comparisons`` are between variants at their own best parameters, ``at_random`` between variants at
    the same random ones, where both loops were stable; ``importance`` counts diverged loops with a Strehl
    ratio of 0, ``importance_closed`` leaves them out.
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
        labels = ", ".join(one.label for one in self.sweep.variants)
        state = ", PARTIAL" if self.partial else ""
        lines = [f"{type(self).__name__} of {len(self.run.records)} loops: {labels}{state}"]
        lines += [
            f"{label}: Strehl ratio {best.strehl.peak.value:.3f} ± {best.strehl.peak.sigma:.3f} at its best"
            for label, best in self.best.items()
        ]
        return f"<{chr(10).join([*lines, *(one.text for one in self.comparisons)])}>".replace("\n", "\n  ")

    @property
    def partial(self) -> bool:
        """Whether the operator stopped it."""
        return self.run.partial

    def stage(self, stage: str, variant: str | None = None) -> list[TrialRecord]:
        """Finished loops of a stage, of one variant or all."""
        return [
            r for r in self.run.records
            if r.slot.stage == stage and (variant is None or r.slot.variant == variant)
        ]  # fmt: skip


def analyse_sweep(sweep: Sweep, run: SweepRun, margin: float = DEFAULT_MARGIN) -> SweepResult:
    """Best parameters, comparisons and importances from the loops of a sweep.

    ``margin`` is the largest difference in the Strehl ratio that counts as equivalent.
    """
    best = {}
    for variant in sweep.variants:
        final = [r for r in run.records if (r.slot.stage, r.slot.variant) == (FINAL, variant.label)]
        if final:
            best[variant.label] = _summarise_final(final)
    explored = [r for r in run.records if r.slot.stage == EXPLORE]
    parameters: dict[int, dict[str, Any]] = {}
    # Random parameters are the same for all variants on the same turbulence, those of TPE are not.
    same = all(parameters.setdefault(r.slot.index, r.values) == r.values for r in explored)
    at_random = [r for r in explored if r.outcome["stable"]] if same else []
    return SweepResult(
        sweep, run, margin, best,
        tuple(_comparisons(sweep, [r for r in run.records if r.slot.stage == FINAL], margin)),
        tuple(_comparisons(sweep, at_random, margin)),
        importances(sweep, run.records), importances(sweep, run.records, closed_only=True),
    )  # fmt: skip


def sweep_and_analyse(description: SweepDescription, runner: Workers | Bench) -> Procedure[SweepResult]:
    """Run a sweep, see :func:`~escape_hw.runtime.sweep.run.run_sweep`, close its workers, and analyse it."""
    try:
        with description.open_study() as study:
            run = yield from run_sweep(study, runner)
    finally:
        if isinstance(runner, Workers):
            runner.close()
    return analyse_sweep(description.sweep, run, description.margin)


def _summarise_final(final: Sequence[TrialRecord]) -> BestLoops:
    strehls = []
    for metric in METRICS:
        values = np.array([r.outcome["strehl"][metric]["value"] if r.merit > 0 else 0.0 for r in final])
        sigma = float(values.std(ddof=1) / math.sqrt(values.size)) if values.size > 1 else math.nan
        strehls.append(Estimate(float(values.mean()), sigma))
    n_closed = sum(r.merit > 0 for r in final)
    return BestLoops(final[0].values, StrehlEstimate(*strehls), n_closed, len(final))


def _pairs(variants: Sequence[MatrixVariant]) -> Iterable[tuple[str, str]]:
    """Every variant and the first, every matrix with and without its optical gains, and neighbours."""
    first, *others = variants
    for one in others:
        yield one.label, first.label
    for one in others:
        for other in others:
            if one.matrix == other.matrix and one.optical_gains and not other.optical_gains:
                yield one.label, other.label
    equal = [one.label for one in others if one.optical_gains == first.optical_gains]
    yield from zip(equal[1:], equal, strict=False)


def _comparisons(sweep: Sweep, records: Iterable[TrialRecord], margin: float) -> Iterable[VariantComparison]:
    """Comparisons of the variants on their common realisations."""
    merits: dict[str, dict[int, float]] = {one.label: {} for one in sweep.variants}
    for record in records:
        merits[record.slot.variant][record.slot.index] = record.merit
    for first, second in _pairs(sweep.variants):
        a, b = merits[first], merits[second]
        common = sorted(set(a) & set(b))
        if len(common) >= MIN_PAIRS:
            found = compare_pairs(np.array([a[n] for n in common]), np.array([b[n] for n in common]))
            yield VariantComparison(first, second, found, describe_comparison(first, second, found, margin))


def importances(
    sweep: Sweep, records: Sequence[TrialRecord], *, closed_only: bool = False
) -> dict[str, float]:
    """Share of each parameter in the variance of the Strehl ratio (fANOVA, Hutter et al. 2014, by Optuna).

    The matrix counts as a parameter (paper, validation procedure). The loops of the first stage are used;
    those that diverged count with a Strehl ratio of 0, or are left out (``closed_only``).

    Returns
    -------
    dict
        By parameter, with :data:`CHANCE`; sums to 1. Empty for fewer than :data:`MIN_LOOPS` loops.
    """
    variants, seed = sweep.variants, sweep.seed
    variant_of = {one.label: one for one in variants}
    selected = [r for r in records if r.slot.stage == EXPLORE and (r.merit > 0 or not closed_only)]
    if len(selected) < MIN_LOOPS or np.ptp([record.merit for record in selected]) == 0:
        return {}
    distributions = {one.key: one.distribution() for one in sweep.space}
    distributions["matrix"] = CategoricalDistribution(tuple(dict.fromkeys(one.matrix for one in variants)))
    if len({one.optical_gains for one in variants}) > 1:
        distributions["optical_gains"] = CategoricalDistribution((False, True))
    distributions[CHANCE] = FloatDistribution(0.0, 1.0)
    known = {name: one for name, one in distributions.items() if not one.single()}
    dummy_values = np.random.default_rng((seed, len(selected))).random(len(selected))
    study = optuna.create_study(direction="maximize")
    for record, dummy in zip(selected, dummy_values, strict=True):
        variant = variant_of[record.slot.variant]
        values = {
            **record.values, "matrix": variant.matrix, "optical_gains": variant.optical_gains,
            CHANCE: float(dummy),
        }  # fmt: skip
        params = {name: values[name] for name in known}
        study.add_trial(create_trial(params=params, distributions=known, value=record.merit))
    found = get_param_importances(study, evaluator=FanovaImportanceEvaluator(seed=seed % 2**31))
    return {name: float(share) for name, share in found.items()}
