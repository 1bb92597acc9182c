"""The sweep itself: hands trials to workers, stage by stage, and keeps what comes back."""

from __future__ import annotations

import logging
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from dataclasses import dataclass, field
from typing import Any

from escape_hw.api.brief import brief
from escape_hw.api.procedure import Procedure, Reporter
from escape_hw.bench import Bench
from escape_hw.errors import Aborted, CalibrationError
from escape_hw.runtime.sweep.choice import shortlist, winner
from escape_hw.runtime.sweep.plan import Arm, Design, Slot
from escape_hw.runtime.sweep.space import Parameter
from escape_hw.runtime.sweep.store import Claim, Record, SweepStore
from escape_hw.runtime.sweep.trial import Task, trial
from escape_hw.runtime.sweep.workers import Workers

log = logging.getLogger(__name__)

#: How long an abort may wait for its turn.
_PATIENCE_S = 0.2
#: So many workers may die of the same trial, or one after the other without any trial finished.
_DEATHS = 4

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
    arms: tuple[Arm, ...]
    space: tuple[Parameter, ...]
    design: Design
    frames: int
    seed: int
    metric: str = "peak"
    psf: str | None = None
    simulated: bool = True

    def task(self, claim: Claim) -> Task:
        """What a worker needs for a claimed trial."""
        arm = next(arm for arm in self.arms if arm.label == claim.slot.arm)
        seed = claim.slot.run_seed(self.seed) if self.simulated else None
        return Task(self.config, str(arm.path), arm.sha256, self.psf, claim.values, self.frames, seed)

    def merit(self, outcome: Mapping[str, Any]) -> float | None:
        """What is maximised; ``None`` for a loop that diverged."""
        if outcome["diverged"] or outcome["strehl"] is None:
            return None
        return float(outcome["strehl"][self.metric]["value"])


@dataclass(slots=True)
class SweepRun:
    """How far a sweep came: its loops, and the best parameters by arm."""

    records: list[Record] = field(default_factory=list)
    best: dict[str, dict[str, Any]] = field(default_factory=dict)
    partial: bool = False
    __repr__ = brief


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
    report, before = Reporter("sweep", design.total(len(arms)), "loop"), 0

    def stage(
        plan: list[Slot], values: Mapping[tuple[str, int], Mapping[str, Any]]
    ) -> Procedure[list[Record]]:
        nonlocal before
        if isinstance(runner, Bench):
            yield from _on_bench(sweep, store, runner, plan, values, report, before)
        else:
            yield from _with_workers(sweep, store, runner, plan, values, report, before)
        before += len(plan)
        return store.records()

    try:
        records = yield from stage(list(design.explored(arms)), {})
        found = _candidates(sweep, records)
        records = yield from stage(
            [s for s in design.shortlisted(arms) if (s.arm, s.candidate) in found], found
        )
        result.best = {arm.label: _winner(records, arm.label) for arm in arms}
        final = {(label, 0): values for label, values in result.best.items()}
        yield from stage(list(design.final(arms)), final)
    except Aborted:
        result.partial = True
    result.records = store.records()
    return result


def _candidates(sweep: Sweep, records: Sequence[Record]) -> dict[tuple[str, int], dict[str, Any]]:
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


def _winner(records: Sequence[Record], arm: str) -> dict[str, Any]:
    found = winner(records, arm)
    if found is None:
        raise RuntimeError(f"no heat of {arm} was run")
    return found


def _left(store: SweepStore, plan: Sequence[Slot]) -> set[Slot]:
    return set(plan) - {record.slot for record in store.records()}


def _on_bench(
    sweep: Sweep,
    store: SweepStore,
    bench: Bench,
    plan: Sequence[Slot],
    values: Mapping[tuple[str, int], Mapping[str, Any]],
    report: Reporter,
    before: int,
) -> Procedure[None]:
    """Run a stage on the open bench, one loop after the other."""
    while left := _left(store, plan):
        store.lay_out(plan, values)
        store.beat()
        claim = store.claim()
        if claim is None:
            raise CalibrationError(
                f"{len(left)} loops are claimed by another runner; one bench serves one sweep: end the other"
            )
        try:
            outcome = yield from trial(bench, sweep.task(claim))
        except BaseException as error:
            store.give_back(claim, f"{type(error).__name__}: {error}")
            raise
        if outcome.get("partial"):
            store.give_back(claim, "stopped by the operator")
            raise Aborted(partial=None)
        store.finish(claim, outcome, sweep.merit(outcome))
        yield report(before + len(plan) - len(left) + 1)


@dataclass(slots=True)
class _Flight:
    """Trials in the hands of workers."""

    of: dict[Future[dict[str, Any]], Claim] = field(default_factory=dict)
    deaths: dict[Slot, int] = field(default_factory=dict)
    in_a_row: int = 0


def _with_workers(
    sweep: Sweep,
    store: SweepStore,
    workers: Workers,
    plan: Sequence[Slot],
    values: Mapping[tuple[str, int], Mapping[str, Any]],
    report: Reporter,
    before: int,
) -> Procedure[None]:
    """Run a stage with workers; what others run on the same study is waited for."""
    flight, left = _Flight(), _left(store, plan)
    try:
        while left:
            _fill(sweep, store, workers, flight, plan, values, len(left))
            if not flight.of:
                # Others are at what is left.
                time.sleep(_PATIENCE_S)
                left = _left(store, plan)
            ended, _ = wait(flight.of, timeout=_PATIENCE_S, return_when=FIRST_COMPLETED)
            died = [future for future in ended if workers.lost(future)]
            for future in ended:
                if future not in died:
                    claim = flight.of.pop(future)
                    _land(sweep, store, claim, future)
                    left.discard(claim.slot)
                    flight.in_a_row = 0
            if died or (flight.of and workers.gone):
                _again(sweep, workers, flight)
            store.beat()
            if report.due():
                yield report(before + len(plan) - len(left))
    finally:
        _end(store, workers, flight)


def _fill(
    sweep: Sweep,
    store: SweepStore,
    workers: Workers,
    flight: _Flight,
    plan: Sequence[Slot],
    values: Mapping[tuple[str, int], Mapping[str, Any]],
    left: int,
) -> None:
    """Claim trials until every worker has one and the next waits."""
    wanted = min(workers.count + 1, left) if len(flight.of) <= workers.count else 0
    if len(flight.of) < wanted:
        store.lay_out(plan, values)
    while len(flight.of) < wanted:
        claim = store.claim()
        if claim is None:
            return
        flight.of[workers.submit(sweep.task(claim))] = claim


def _land(sweep: Sweep, store: SweepStore, claim: Claim, future: Future[dict[str, Any]]) -> None:
    """Keep what a worker found; an error of the trial ends the sweep, for it would come again."""
    error = future.exception()
    if error is not None:
        store.give_back(claim, f"{type(error).__name__}: {error}")
        raise error
    outcome = future.result()
    store.finish(claim, outcome, sweep.merit(outcome))


def _again(sweep: Sweep, workers: Workers, flight: _Flight) -> None:
    """Replace workers that died, and run again what they were at."""
    flight.in_a_row += 1
    claims = list(flight.of.values())
    for claim in claims:
        flight.deaths[claim.slot] = flight.deaths.get(claim.slot, 0) + 1
    if flight.in_a_row > _DEATHS or max(flight.deaths.values()) > _DEATHS:
        raise CalibrationError(
            "the workers of the sweep die again and again (killed, or out of memory); run fewer of them "
            "and resume: finished trials are kept"
        )
    log.warning("a worker of the sweep died; %d trials run again", len(claims))
    workers.heal()
    flight.of = {workers.submit(sweep.task(claim)): claim for claim in claims}


def _end(store: SweepStore, workers: Workers, flight: _Flight) -> None:
    """Whatever is still in the hands of workers goes back, unless it has just been finished."""
    if not flight.of:
        return
    workers.close()
    for claim in flight.of.values():
        store.give_back(claim, "the sweep ended")
