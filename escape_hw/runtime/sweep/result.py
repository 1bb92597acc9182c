"""What a sweep found: the best of every arm, what matters, and how the arms compare on the same air."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from escape_hw.api.results import Measured, StrehlEstimate
from escape_hw.pipeline.paired_bootstrap import LEAST_PAIRS, PairedComparison, compare_pairs, statement
from escape_hw.runtime.sweep.importance import importances
from escape_hw.runtime.sweep.plan import EXPLORE, FINAL, Arm
from escape_hw.runtime.sweep.run import METRICS, Sweep, SweepRun
from escape_hw.runtime.sweep.store import Record

#: Difference in the Strehl ratio that does not matter, unless told otherwise: one percent, below what
#: vibrations do from run to run on the paper's bench.
MARGIN = 0.01


@dataclass(frozen=True, slots=True)
class BestOfArm:
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
class ArmComparison:
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
    best: dict[str, BestOfArm] = field(default_factory=dict)
    comparisons: tuple[ArmComparison, ...] = ()
    at_random: tuple[ArmComparison, ...] = ()
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

    def stage(self, stage: str, arm: str | None = None) -> list[Record]:
        """Finished loops of a stage, of one arm or all."""
        return [r for r in self.run.records if r.slot.stage == stage and (arm is None or r.slot.arm == arm)]


def conclude(sweep: Sweep, run: SweepRun, margin: float = MARGIN) -> SweepResult:
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
            best[arm.label] = _best(final)
    pairs = list(_pairs(sweep.arms))
    final_of = _by_air(r for r in run.records if r.slot.stage == FINAL)
    drawn_of = _by_air(r for r in run.records if r.slot.stage == EXPLORE and r.outcome["stable"])
    same = _same_parameters(run.records)
    return SweepResult(
        sweep, run, margin, best,
        tuple(_compared(pairs, final_of, margin)),
        tuple(_compared(pairs, drawn_of, margin)) if same else (),
        importances(run.records, sweep.arms, sweep.space, sweep.seed),
        importances(run.records, sweep.arms, sweep.space, sweep.seed, closed_only=True),
    )  # fmt: skip


def _best(final: Sequence[Record]) -> BestOfArm:
    closed = [r for r in final if r.merit > 0]
    ways = []
    for way in METRICS:
        # A loop that diverged has no image worth the name.
        values = np.array([r.outcome["strehl"][way]["value"] if r.merit > 0 else 0.0 for r in final])
        sigma = float(values.std(ddof=1) / math.sqrt(values.size)) if values.size > 1 else math.nan
        ways.append(Measured(float(values.mean()), sigma))
    return BestOfArm(final[0].values, StrehlEstimate(*ways), len(closed), len(final))


def _pairs(arms: Sequence[Arm]) -> Iterable[tuple[str, str]]:
    """Every arm against the first, and every matrix with its optical gains against itself without."""
    for arm in arms[1:]:
        yield arm.label, arms[0].label
    for arm in arms[1:]:
        for other in arms[1:]:
            if arm.matrix == other.matrix and arm.optical_gains and not other.optical_gains:
                yield arm.label, other.label
    rest = [arm.label for arm in arms[1:] if arm.optical_gains == arms[0].optical_gains]
    yield from zip(rest[1:], rest, strict=False)


def _by_air(records: Iterable[Record]) -> dict[str, dict[int, float]]:
    found: dict[str, dict[int, float]] = {}
    for record in records:
        found.setdefault(record.slot.arm, {})[record.slot.index] = record.merit
    return found


def _same_parameters(records: Sequence[Record]) -> bool:
    """Whether all arms ran the same parameters on the same air, as random ones are drawn."""
    seen: dict[int, dict[str, Any]] = {}
    for record in records:
        if (
            record.slot.stage == EXPLORE
            and seen.setdefault(record.slot.index, record.values) != record.values
        ):
            return False
    return True


def _compared(
    pairs: Sequence[tuple[str, str]], merits: dict[str, dict[int, float]], margin: float
) -> Iterable[ArmComparison]:
    for first, second in pairs:
        a, b = merits.get(first, {}), merits.get(second, {})
        common = sorted(set(a) & set(b))
        if len(common) >= LEAST_PAIRS:
            found = compare_pairs(np.array([a[n] for n in common]), np.array([b[n] for n in common]))
            yield ArmComparison(first, second, found, statement(first, second, found, margin))
