"""Execution of a sweep stage by stage, with the selection of parameters between the stages."""

from __future__ import annotations

import logging
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.procedure import Procedure, Reporter
from escape_hw.api.representation import short_repr
from escape_hw.bench import Bench
from escape_hw.errors import Aborted, CalibrationError
from escape_hw.runtime.sweep.design import EXPLORE, SHORTLIST, Design, MatrixVariant, Slot
from escape_hw.runtime.sweep.search_space import Choices, Parameter, Range
from escape_hw.runtime.sweep.study import Claim, LoopRecord, SweepStore
from escape_hw.runtime.sweep.trials import TrialSpec, run_closed_loop
from escape_hw.runtime.sweep.workers import Workers

#: Most neighbours whose mean stands for a loop, and the share of all loops that they are at most.
_MAX_NEIGHBOURS, _MAX_NEIGHBOUR_FRACTION = 10, 0.05


def shortlist(
    records: Sequence[LoopRecord], space: Sequence[Parameter], arm: str, count: int
) -> list[dict[str, Any]]:
    """The parameters of the most promising loops of an arm's first stage, best first.

    A loop's promise is the mean merit of its nearest neighbours among the parameters, itself included:
    a single loop may owe its Strehl ratio to its air. Loops that diverged count with 0.

    Parameters
    ----------
    records
        Finished loops.
    space
        What was varied.
    arm
        Label of the arm.
    count
        How many; fewer where fewer loops stayed closed.
    """
    records_of_variant = [r for r in records if r.slot.stage == EXPLORE and r.slot.arm == arm]
    closed = [number for number, record in enumerate(records_of_variant) if record.merit > 0]
    if not closed:
        return []
    places = np.stack([_unit_point(record.values, space) for record in records_of_variant])
    merits = np.array([record.merit for record in records_of_variant])
    n_neighbours = max(1, min(_MAX_NEIGHBOURS, round(_MAX_NEIGHBOUR_FRACTION * len(records_of_variant))))
    neighbour_mean = {n: _neighbour_mean(places, merits, n, n_neighbours) for n in closed}
    order = sorted(closed, key=lambda n: neighbour_mean[n], reverse=True)
    return [records_of_variant[n].values for n in order[:count]]


def _neighbour_mean(
    places: NDArray[np.float64], merits: NDArray[np.float64], number: int, n_neighbours: int
) -> float:
    distance = np.square(places - places[number]).sum(axis=1)
    return float(merits[np.argsort(distance, kind="stable")[:n_neighbours]].mean())


def _unit_point(values: dict[str, Any], space: Sequence[Parameter]) -> NDArray[np.float64]:
    """Parameters as a point whose coordinates go from 0 to 1."""
    return np.array([unit_coordinate(one, values[one.key]) for one in space])


def unit_coordinate(one: Parameter, value: Any) -> float:
    """Where a value lies between its limits, 0 to 1; the inverse of ``at``."""
    if isinstance(one, Choices):
        return one.values.index(value) / max(1, len(one.values) - 1)
    if isinstance(one, Range) and one.log:
        return float(np.log(value / one.low) / np.log(one.high / one.low))
    return float((value - one.low) / (one.high - one.low))


def best_candidate(records: Sequence[LoopRecord], arm: str) -> dict[str, Any] | None:
    """The candidate of an arm with the highest mean merit over the heats; ``None`` without any."""
    replicates_of: dict[int, list[LoopRecord]] = {}
    for record in records:
        if record.slot.stage == SHORTLIST and record.slot.arm == arm:
            replicates_of.setdefault(record.slot.candidate, []).append(record)
    if not replicates_of:
        return None
    best = max(replicates_of, key=lambda n: float(np.mean([r.merit for r in replicates_of[n]])))
    return replicates_of[best][0].values


log = logging.getLogger(__name__)

#: How long an abort may wait for its turn.
_POLL_S = 0.2
#: So many workers may die of the same trial, or one after the other without any trial finished.
_MAX_DEATHS = 4

#: The Strehl ratios that can be maximised.
METRICS = ("peak", "otf", "encircled")


@dataclass(frozen=True, slots=True)
class Sweep:
    """What is swept.

    Parameters
    ----------
    config
        The whole configuration, as TOML.
    arms, space, design
        What is compared, what is varied, and how many loops there are.
    frames
        Length of a loop.
    seed
        Of the draws and of the air.
    metric
        Which Strehl ratio is maximised; one of :data:`METRICS`.
    psf
        File of the model PSF, or ``None`` when each trial takes its own.
    simulated
        Whether each trial has twins of its own, with its own air.
    """

    config: str
    arms: tuple[MatrixVariant, ...]
    space: tuple[Parameter, ...]
    design: Design
    frames: int
    seed: int
    metric: str = "peak"
    psf: str | None = None
    simulated: bool = True

    def task(self, claim: Claim) -> TrialSpec:
        """What a worker needs for a claimed trial."""
        arm = next(arm for arm in self.arms if arm.label == claim.slot.arm)
        seed = claim.slot.run_seed(self.seed) if self.simulated else None
        return TrialSpec(self.config, str(arm.path), arm.sha256, self.psf, claim.values, self.frames, seed)

    def merit(self, outcome: Mapping[str, Any]) -> float | None:
        """What is maximised; ``None`` for a loop that diverged."""
        if outcome["diverged"] or outcome["strehl"] is None:
            return None
        return float(outcome["strehl"][self.metric]["value"])


@dataclass(slots=True)
class SweepRun:
    """How far a sweep came: its loops, and the best parameters by arm."""

    records: list[LoopRecord] = field(default_factory=list)
    best: dict[str, dict[str, Any]] = field(default_factory=dict)
    partial: bool = False
    __repr__ = short_repr


def run_sweep(sweep: Sweep, store: SweepStore, runner: Workers | Bench) -> Procedure[SweepRun]:
    """Run what is left of a sweep.

    Parameters
    ----------
    sweep
        What to run.
    store
        Where its trials are kept; what is finished there does not run again.
    runner
        Workers for twins, or the open bench itself, on which the trials run one after the other.

    Returns
    -------
    SweepRun
        ``partial`` when the operator stopped it; everything finished by then is in the store.

    Raises
    ------
    CalibrationError
        No loop of an arm stayed closed, or workers die again and again.
    StorageError
        The storage does not answer.
    """
    arms, design, result = sweep.arms, sweep.design, SweepRun()
    report, n_before = Reporter("sweep", design.n_loops(len(arms)), "loop"), 0

    def stage(
        plan: list[Slot], values: Mapping[tuple[str, int], Mapping[str, Any]]
    ) -> Procedure[list[LoopRecord]]:
        nonlocal n_before
        if isinstance(runner, Bench):
            yield from _on_bench(sweep, store, runner, plan, values, report, n_before)
        else:
            yield from _with_workers(sweep, store, runner, plan, values, report, n_before)
        n_before += len(plan)
        return store.records()

    try:
        records = yield from stage(list(design.exploration_slots(arms)), {})
        found = _candidates(sweep, records)
        records = yield from stage(
            [s for s in design.shortlist_slots(arms) if (s.arm, s.candidate) in found], found
        )
        result.best = {arm.label: _best_candidate(records, arm.label) for arm in arms}
        final = {(label, 0): values for label, values in result.best.items()}
        yield from stage(list(design.final_slots(arms)), final)
    except Aborted:
        result.partial = True
    result.records = store.records()
    return result


def _candidates(sweep: Sweep, records: Sequence[LoopRecord]) -> dict[tuple[str, int], dict[str, Any]]:
    """Parameters of the second stage by arm and candidate."""
    found = {}
    for arm in sweep.arms:
        chosen = shortlist(records, sweep.space, arm.label, sweep.design.candidates)
        if not chosen:
            said = {note for one in records if one.slot.arm == arm.label for note in one.outcome["notes"]}
            raise CalibrationError(
                f"no loop with the matrix {arm.label} gave a Strehl ratio; widen the range of the gain, make "
                f"the loops longer, or leave the matrix out ({'; '.join(sorted(said)) or 'all diverged'})"
            )
        found.update({(arm.label, number): values for number, values in enumerate(chosen)})
    return found


def _best_candidate(records: Sequence[LoopRecord], arm: str) -> dict[str, Any]:
    found = best_candidate(records, arm)
    if found is None:
        raise RuntimeError(f"no heat of {arm} was run")
    return found


def _remaining_slots(store: SweepStore, plan: Sequence[Slot]) -> set[Slot]:
    return set(plan) - {record.slot for record in store.records()}


def _on_bench(
    sweep: Sweep,
    store: SweepStore,
    bench: Bench,
    plan: Sequence[Slot],
    values: Mapping[tuple[str, int], Mapping[str, Any]],
    report: Reporter,
    n_before: int,
) -> Procedure[None]:
    """Run a stage on the open bench, one loop after the other."""
    while remaining := _remaining_slots(store, plan):
        store.enqueue_slots(plan, values)
        store.send_heartbeat()
        claim = store.claim()
        if claim is None:
            raise CalibrationError(
                f"{len(remaining)} loops are claimed by another runner; one bench serves one sweep: end the other"
            )
        try:
            outcome = yield from run_closed_loop(bench, sweep.task(claim))
        except BaseException as error:
            store.release(claim, f"{type(error).__name__}: {error}")
            raise
        if outcome.get("partial"):
            store.release(claim, "stopped by the operator")
            raise Aborted(partial=None)
        store.finish(claim, outcome, sweep.merit(outcome))
        yield report(n_before + len(plan) - len(remaining) + 1)


@dataclass(slots=True)
class _SubmittedTrials:
    """Trials in the hands of workers."""

    of: dict[Future[dict[str, Any]], Claim] = field(default_factory=dict)
    deaths: dict[Slot, int] = field(default_factory=dict)
    consecutive_deaths: int = 0


def _with_workers(
    sweep: Sweep,
    store: SweepStore,
    workers: Workers,
    plan: Sequence[Slot],
    values: Mapping[tuple[str, int], Mapping[str, Any]],
    report: Reporter,
    n_before: int,
) -> Procedure[None]:
    """Run a stage with workers; what others run on the same study is waited for."""
    submitted, remaining = _SubmittedTrials(), _remaining_slots(store, plan)
    try:
        while remaining:
            _submit_trials(sweep, store, workers, submitted, plan, values, len(remaining))
            if not submitted.of:
                # Others are at what is left.
                time.sleep(_POLL_S)
                remaining = _remaining_slots(store, plan)
            completed, _ = wait(submitted.of, timeout=_POLL_S, return_when=FIRST_COMPLETED)
            died = [future for future in completed if workers.is_lost(future)]
            for future in completed:
                if future not in died:
                    claim = submitted.of.pop(future)
                    _collect_outcome(sweep, store, claim, future)
                    remaining.discard(claim.slot)
                    submitted.consecutive_deaths = 0
            if died or (submitted.of and workers.is_disconnected):
                _restart_workers(sweep, workers, submitted)
            store.send_heartbeat()
            if report.due():
                yield report(n_before + len(plan) - len(remaining))
    finally:
        _release_trials(store, workers, submitted)


def _submit_trials(
    sweep: Sweep,
    store: SweepStore,
    workers: Workers,
    submitted: _SubmittedTrials,
    plan: Sequence[Slot],
    values: Mapping[tuple[str, int], Mapping[str, Any]],
    remaining: int,
) -> None:
    """Claim trials until every worker has one and the next waits."""
    wanted = min(workers.count + 1, remaining) if len(submitted.of) <= workers.count else 0
    if len(submitted.of) < wanted:
        store.enqueue_slots(plan, values)
    while len(submitted.of) < wanted:
        claim = store.claim()
        if claim is None:
            return
        submitted.of[workers.submit(sweep.task(claim))] = claim


def _collect_outcome(sweep: Sweep, store: SweepStore, claim: Claim, future: Future[dict[str, Any]]) -> None:
    """Keep what a worker found; an error of the trial ends the sweep, for it would come again."""
    error = future.exception()
    if error is not None:
        store.release(claim, f"{type(error).__name__}: {error}")
        raise error
    outcome = future.result()
    store.finish(claim, outcome, sweep.merit(outcome))


def _restart_workers(sweep: Sweep, workers: Workers, submitted: _SubmittedTrials) -> None:
    """Replace workers that died, and run again what they were at."""
    submitted.consecutive_deaths += 1
    claims = list(submitted.of.values())
    for claim in claims:
        submitted.deaths[claim.slot] = submitted.deaths.get(claim.slot, 0) + 1
    if submitted.consecutive_deaths > _MAX_DEATHS or max(submitted.deaths.values()) > _MAX_DEATHS:
        raise CalibrationError(
            "the workers of the sweep die again and again (killed, or out of memory); run fewer of them "
            "and resume: finished trials are kept"
        )
    log.warning("a worker of the sweep died; %d trials run again", len(claims))
    workers.restart()
    submitted.of = {workers.submit(sweep.task(claim)): claim for claim in claims}


def _release_trials(store: SweepStore, workers: Workers, submitted: _SubmittedTrials) -> None:
    """Whatever is still in the hands of workers goes back, unless it has just been finished."""
    if not submitted.of:
        return
    workers.close()
    for claim in submitted.of.values():
        store.release(claim, "the sweep ended")
