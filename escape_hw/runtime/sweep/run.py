"""Execution of a sweep stage by stage, with the selection of parameters between the stages."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from escape_hw.api.procedure import Procedure, Reporter
from escape_hw.api.representation import short_repr
from escape_hw.bench import Bench
from escape_hw.errors import Aborted, CalibrationError
from escape_hw.runtime.sweep.design import EXPLORE, SHORTLIST, Slot, Sweep
from escape_hw.runtime.sweep.search_space import Choices, Parameter
from escape_hw.runtime.sweep.study import SweepStudy, TrialRecord
from escape_hw.runtime.sweep.trials import TrialSpec, run_closed_loop, run_trial
from escape_hw.runtime.sweep.workers import Workers

#: A loop is judged by the mean over its nearest neighbours: at most so many, and so large a share of all.
_MAX_NEIGHBOURS, _MAX_NEIGHBOUR_FRACTION = 10, 0.05
#: Seconds between two looks at an abort, and at the study when no loop ends.
_POLL_S, _REFRESH_S = 0.2, 2.0
#: Most threads that wait for workers.
_MAX_THREADS = 1024

#: Parameters by variant and candidate.
Candidates = Mapping[tuple[str, int], Mapping[str, Any]]


@dataclass(slots=True)
class SweepRun:
    """Loops of a sweep, and the best parameters by variant; ``partial`` when the operator stopped it."""

    records: list[TrialRecord] = field(default_factory=list)
    best: dict[str, dict[str, Any]] = field(default_factory=dict)
    partial: bool = False
    __repr__ = short_repr


def run_sweep(study: SweepStudy, runner: Workers | Bench) -> Procedure[SweepRun]:
    """Run the unfinished loops of a sweep: with workers in parallel, or on an open bench one after the other.

    ``partial`` of the result is true when the operator stopped it; loops finished by then are in the study.

    Raises
    ------
    CalibrationError
        No loop of a variant stayed closed, or workers die again and again.
    StorageError
        The storage does not answer.
    """
    variants, design, result = study.sweep.variants, study.sweep.design, SweepRun()
    report, n_before = Reporter("sweep", design.n_loops(len(variants)), "loop"), 0

    def run_stage(plan: list[Slot], values: Candidates) -> Procedure[list[TrialRecord]]:
        nonlocal n_before
        stage = _run_on_bench if isinstance(runner, Bench) else _run_in_parallel
        yield from stage(study, runner, plan, values, report, n_before)  # type: ignore[arg-type]
        n_before += len(plan)
        return study.records()

    try:
        records = yield from run_stage(list(design.exploration_slots(variants)), {})
        found = _candidates(study.sweep, records)
        plan = [slot for slot in design.shortlist_slots(variants) if (slot.variant, slot.candidate) in found]
        records = yield from run_stage(plan, found)
        result.best = {one.label: best_candidate(records, one.label) for one in variants}
        final = {(label, 0): values for label, values in result.best.items()}
        yield from run_stage(list(design.final_slots(variants)), final)
    except Aborted:
        result.partial = True
    result.records = study.records()
    return result


def _run_in_parallel(
    study: SweepStudy,
    workers: Workers,
    plan: Sequence[Slot],
    values: Candidates,
    report: Reporter,
    n_before: int,
) -> Procedure[None]:
    """Run a stage with workers; loops that other runners of the same study run are waited for.

    One thread for each loop waits for its worker within :meth:`optuna.Study.optimize`: workers need no
    access to the storage, and a loop whose worker dies keeps its trial.
    """

    def run_loop(slot: Slot, parameters: dict[str, Any]) -> tuple[dict[str, Any], float | None]:
        outcome = workers.run(run_trial, TrialSpec.from_slot(study.sweep, slot, parameters))
        return outcome, study.sweep.merit(outcome)

    futures: set[Future[None]] = set()
    completed: set[Future[None]] = set()
    refresh_at, n_unfinished = 0.0, len(plan)
    threads = ThreadPoolExecutor(_MAX_THREADS, "sweep")
    try:
        while True:
            if completed or time.monotonic() >= refresh_at:
                # One more than there are workers, so that the next loop starts as soon as one ends.
                n_free = workers.count + 1 - len(futures)
                n_unfinished, n_waiting = study.enqueue_missing(plan, values, n_free)
                refresh_at = time.monotonic() + _REFRESH_S
                if not n_unfinished and not n_waiting:
                    break
                for _ in range(min(n_free, n_waiting)):
                    futures.add(threads.submit(study.run_next, run_loop))
            completed, futures = wait(futures, timeout=_POLL_S, return_when=FIRST_COMPLETED)
            if not completed and not futures:
                time.sleep(_POLL_S)
            for future in completed:
                # An error ends the sweep: the same trial would raise it again.
                future.result()
            if report.is_due():
                yield report(n_before + len(plan) - n_unfinished)
    except BaseException:
        study.stop()
        workers.close()
        raise
    finally:
        threads.shutdown(cancel_futures=True)


def _run_on_bench(
    study: SweepStudy,
    bench: Bench,
    plan: Sequence[Slot],
    values: Candidates,
    report: Reporter,
    n_before: int,
) -> Procedure[None]:
    """Run a stage on the open bench, one loop after the other.

    A procedure yields its progress and can be aborted, which :meth:`optuna.Study.optimize` cannot: the
    trials are asked for and told.
    """
    while True:
        n_unfinished, n_waiting = study.enqueue_missing(plan, values, 1)
        if n_unfinished < len(plan):
            yield report(n_before + len(plan) - n_unfinished)
        if not n_unfinished and not n_waiting:
            return
        asked = study.ask()
        if asked is None:
            continue
        trial, slot, parameters = asked
        try:
            outcome = yield from run_closed_loop(bench, TrialSpec.from_slot(study.sweep, slot, parameters))
        except BaseException:
            study.tell(trial, None)
            raise
        if outcome.get("partial"):
            study.tell(trial, None)
            raise Aborted(partial=None)
        study.tell(trial, outcome, study.sweep.merit(outcome))


# ---------------------------------------------------------------- selection between the stages
def _candidates(sweep: Sweep, records: Sequence[TrialRecord]) -> dict[tuple[str, int], dict[str, Any]]:
    """Parameters of the second stage by variant and candidate."""
    found = {}
    for variant in sweep.variants:
        chosen = shortlist(records, sweep.space, variant.label, sweep.design.candidates)
        if not chosen:
            notes = {n for one in records if one.slot.variant == variant.label for n in one.outcome["notes"]}
            raise CalibrationError(
                f"no loop with the matrix {variant.label} gave a Strehl ratio "
                f"({'; '.join(sorted(notes)) or 'all diverged'}); widen the range of the gain, make the "
                "loops longer, or leave the matrix out"
            )
        found.update({(variant.label, number): values for number, values in enumerate(chosen)})
    return found


def shortlist(
    records: Sequence[TrialRecord], space: Sequence[Parameter], variant: str, count: int
) -> list[dict[str, Any]]:
    """Parameters of the ``count`` most promising loops of a variant's first stage, best first.

    Fewer where fewer loops stayed closed. Loops are ranked by the mean merit of their nearest neighbours
    among the parameters, themselves included: the Strehl ratio of a single loop also depends on its
    turbulence. Loops that diverged count with 0.
    """
    own = [r for r in records if r.slot.stage == EXPLORE and r.slot.variant == variant]
    closed = [number for number, record in enumerate(own) if record.merit > 0]
    if not closed:
        return []
    points = np.array([[unit_coordinate(one, record.values[one.key]) for one in space] for record in own])
    merits = np.array([record.merit for record in own])
    n_neighbours = max(1, min(_MAX_NEIGHBOURS, round(_MAX_NEIGHBOUR_FRACTION * len(own))))

    def neighbour_mean(number: int) -> float:
        distance = np.square(points - points[number]).sum(axis=1)
        return float(merits[np.argsort(distance, kind="stable")[:n_neighbours]].mean())

    return [own[n].values for n in sorted(closed, key=neighbour_mean, reverse=True)[:count]]


def unit_coordinate(one: Parameter, value: Any) -> float:
    """Position of a value between its limits, 0 to 1; the inverse of ``at``."""
    if isinstance(one, Choices):
        return one.values.index(value) / max(1, len(one.values) - 1)
    if one.log:
        return float(np.log(value / one.low) / np.log(one.high / one.low))
    return float((value - one.low) / (one.high - one.low))


def best_candidate(records: Sequence[TrialRecord], variant: str) -> dict[str, Any]:
    """The candidate of a variant with the highest mean merit over its replicates."""
    replicates_of: dict[int, list[TrialRecord]] = {}
    for record in records:
        if record.slot.stage == SHORTLIST and record.slot.variant == variant:
            replicates_of.setdefault(record.slot.candidate, []).append(record)
    best = max(replicates_of, key=lambda n: float(np.mean([r.merit for r in replicates_of[n]])))
    return replicates_of[best][0].values
