"""The study behind a sweep: claimed, finished and recovered trials in any storage that Optuna knows."""

from __future__ import annotations

import logging
import os
import socket
import time
import uuid
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Any, TypeVar

import optuna
from optuna.exceptions import StorageInternalError, UpdateFinishedTrialError
from optuna.trial import FrozenTrial, TrialState
from sqlalchemy import event, make_url
from sqlalchemy.exc import ArgumentError, DBAPIError

from escape_hw.errors import ConfigError, StorageError
from escape_hw.runtime.sweep.plan import EXPLORE, Arm, Slot
from escape_hw.runtime.sweep.samplers import History, SlotSampler
from escape_hw.runtime.sweep.space import Parameter, Range

log = logging.getLogger(__name__)
T = TypeVar("T")

#: Seconds after which a runner that has not been heard of counts as dead, and its trials run again.
GRACE_S = 60.0
#: Seconds between two signs of life.
BEAT_S = 5.0
#: Seconds to wait for a storage that does not answer.
PATIENCE_S = 120.0
#: Trials laid out ahead of the runners: every one costs time at each claim.
_AHEAD = 24
_FINISHED = (TrialState.COMPLETE, TrialState.PRUNED)


@dataclass(frozen=True, slots=True)
class Record:
    """A finished loop.

    Parameters
    ----------
    slot
        Its place in the plan.
    values
        Its parameters.
    outcome
        How it went, see :func:`~escape_hw.runtime.sweep.trial.outcome`.
    merit
        The Strehl ratio that is maximised; 0 for a loop that diverged.
    """

    slot: Slot
    values: dict[str, Any]
    outcome: dict[str, Any]
    merit: float


@dataclass(frozen=True, slots=True)
class Claim:
    """A trial that this runner owns until it tells its outcome."""

    trial: optuna.Trial
    slot: Slot
    values: dict[str, Any]


class SweepStore:
    """The trials of one sweep.

    Several runners on several machines may share one: a trial is handed out once. A runner gives a sign
    of life every :data:`BEAT_S` seconds; what a dead one had claimed is handed out again. When the
    storage does not answer, calls wait for it up to ``patience_s``.

    Parameters
    ----------
    url
        As SQLAlchemy takes it: ``sqlite:////path/study.db``, ``postgresql+psycopg://user@host/name``.
    study
        Name of the study.
    settings
        What makes two sweeps the same; a study that was begun with others is refused.
    arms, space, seed
        What is compared, what is varied, and the seed of the draws.
    learn
        TPE instead of random parameters.
    patience_s
        Seconds to wait for a storage that does not answer.

    Raises
    ------
    ConfigError
        The study exists with other settings, or the URL means nothing.
    StorageError
        The storage does not answer.
    """

    def __init__(
        self,
        url: str,
        study: str,
        settings: Mapping[str, Any],
        arms: Sequence[Arm],
        space: Sequence[Parameter],
        seed: int,
        *,
        learn: bool = False,
        patience_s: float = PATIENCE_S,
    ) -> None:
        self.url, self.name, self._patience = url, study, patience_s
        self._arms, self._space = {arm.label: arm for arm in arms}, tuple(space)
        self._matrices = tuple(dict.fromkeys(arm.matrix for arm in arms))
        self.runner = f"{socket.gethostname()}:{os.getpid()}:{uuid.uuid4().hex[:8]}"
        self._beaten = -BEAT_S
        optuna.logging.set_verbosity(optuna.logging.WARNING)
        sampler = SlotSampler(space, seed, _slot_of, self._history if learn else None)
        self._study = self._patiently(lambda: _open(url, study, sampler))
        self._agree(dict(settings))
        self.beat()

    # ------------------------------------------------------------------ hand out and take in
    def lay_out(self, plan: Sequence[Slot], values: Mapping[tuple[str, int], Mapping[str, Any]]) -> int:
        """Put the next slots of a plan up for claiming; returns how many are neither finished nor laid out.

        Parameters
        ----------
        plan
            Every slot of a stage.
        values
            Parameters by arm and candidate, where the stage fixes them.
        """
        return self._patiently(lambda: self._lay_out(plan, values))

    def _lay_out(self, plan: Sequence[Slot], values: Mapping[tuple[str, int], Mapping[str, Any]]) -> int:
        trials = self._study.get_trials(deepcopy=False)
        alive = [t for t in trials if t.state != TrialState.FAIL and "slot" in t.user_attrs]
        present = {_slot_of(t) for t in alive}
        missing = [slot for slot in plan if slot not in present]
        waiting = sum(t.state == TrialState.WAITING for t in alive)
        if waiting > _AHEAD // 2:
            return len(missing)
        for slot in missing[: _AHEAD - waiting]:
            arm = self._arms[slot.arm]
            fixed = {"matrix": arm.matrix, "optical_gains": arm.optical_gains}
            fixed |= values.get((slot.arm, slot.candidate), {})
            self._study.enqueue_trial(fixed, user_attrs={"slot": slot.to_dict()})
        return max(0, len(missing) - (_AHEAD - waiting))

    def claim(self) -> Claim | None:
        """A trial to run, or ``None`` when none is up for claiming."""
        return self._patiently(self._claim)

    def _claim(self) -> Claim | None:
        if not self._study.get_trials(deepcopy=False, states=(TrialState.WAITING,)):
            return None
        trial = self._study.ask()
        if "slot" not in trial.user_attrs:
            # Another runner took the last one, and Optuna made a new one.
            self._study.tell(trial, state=TrialState.FAIL)
            return None
        trial.set_user_attr("runner", self.runner)
        slot = Slot(**trial.user_attrs["slot"])
        trial.suggest_categorical("matrix", self._matrices)
        trial.suggest_categorical("optical_gains", (False, True))
        values = {one.key: _suggest(trial, one) for one in self._space}
        return Claim(trial, slot, values)

    def finish(self, claim: Claim, outcome: Mapping[str, Any], merit: float | None) -> None:
        """Keep how a claimed trial went; ``merit`` is ``None`` when it diverged."""
        state = TrialState.COMPLETE if merit is not None else TrialState.PRUNED
        self._patiently(lambda: self._tell(claim, state, merit, outcome=dict(outcome)))

    def give_back(self, claim: Claim, reason: str) -> None:
        """Give up a claimed trial, so that it can be handed out again."""
        self._patiently(lambda: self._tell(claim, TrialState.FAIL, None, reason=reason))

    def _tell(self, claim: Claim, state: TrialState, merit: float | None, **remarks: Any) -> None:
        try:
            for key, value in remarks.items():
                claim.trial.set_user_attr(key, value)
        except UpdateFinishedTrialError:
            # Told before the connection broke, or given up by another runner that took this one for dead.
            return
        self._study.tell(claim.trial, merit, state=state, skip_if_finished=True)

    # ------------------------------------------------------------------ signs of life
    def beat(self) -> None:
        """Give a sign of life when it is time, and recover what dead runners had claimed."""
        if time.monotonic() - self._beaten < BEAT_S:
            return
        self._beaten = time.monotonic()
        self._patiently(self._beat)

    def _beat(self) -> None:
        self._study.set_user_attr(f"alive:{self.runner}", time.time())
        seen = {k[6:]: float(v) for k, v in self._study.user_attrs.items() if k.startswith("alive:")}
        for trial in self._study.get_trials(deepcopy=False, states=(TrialState.RUNNING,)):
            runner = trial.user_attrs.get("runner")
            if runner is None:
                began = trial.datetime_start or datetime.now()
                dead = (datetime.now() - began).total_seconds() > GRACE_S
            else:
                dead = runner != self.runner and _dead(runner, seen.get(runner, 0.0))
            if dead:
                log.warning("trial %d: its runner %s is gone; it runs again", trial.number, runner)
                self._study.tell(trial.number, state=TrialState.FAIL, skip_if_finished=True)

    # ------------------------------------------------------------------ what is known
    def running(self) -> int:
        """Trials that some runner is at."""
        return self._patiently(lambda: len(self._study.get_trials(False, (TrialState.RUNNING,))))

    def records(self) -> list[Record]:
        """Every finished loop, in the order of the plan's numbers; doubles only once."""
        found: dict[Slot, Record] = {}
        for trial in self._patiently(lambda: self._study.get_trials(deepcopy=False)):
            if trial.state in _FINISHED and "slot" in trial.user_attrs:
                slot = _slot_of(trial)
                found.setdefault(slot, self._record(trial, slot))
        return sorted(found.values(), key=lambda r: (r.slot.stage, r.slot.index, r.slot.candidate))

    def finished_in(self) -> str | None:
        """Folder with the result of all its loops, once there is one."""
        return self._patiently(lambda: self._study.user_attrs.get("finished_in"))

    def mark_finished(self, folder: str) -> None:
        """Keep where the result of all its loops lies."""
        self._patiently(lambda: self._study.set_user_attr("finished_in", folder))

    def _record(self, trial: FrozenTrial, slot: Slot) -> Record:
        values = {one.key: trial.params[one.key] for one in self._space}
        complete = trial.state == TrialState.COMPLETE and trial.value is not None
        return Record(
            slot, values, trial.user_attrs["outcome"], float(trial.value or 0.0) if complete else 0.0
        )

    def _history(self, arm: str) -> History:
        mine = [r for r in self.records() if r.slot.stage == EXPLORE and r.slot.arm == arm]
        return [(record.values, record.merit) for record in mine]

    # ------------------------------------------------------------------ the storage itself
    def _agree(self, settings: dict[str, Any]) -> None:
        known = self._patiently(lambda: self._study.user_attrs.get("settings"))
        if known is None:
            self._patiently(lambda: self._study.set_user_attr("settings", settings))
            return
        other = [key for key in settings if known.get(key) != settings[key]]
        if other:
            raise ConfigError(
                f"study '{self.name}' in {shown(self.url)} was begun with another {', '.join(other)}; "
                "take them again, or another --study or --storage"
            )

    def _patiently(self, call: Callable[[], T]) -> T:
        """A call to the storage, again and again while it does not answer."""
        deadline, pause = time.monotonic() + self._patience, 0.5
        while True:
            try:
                return call()
            except (StorageInternalError, DBAPIError) as error:
                cause = error.__cause__ if isinstance(error, StorageInternalError) else error.orig
                if time.monotonic() + pause > deadline:
                    raise StorageError(
                        f"the study's storage {shown(self.url)} does not answer for {self._patience:.0f} s "
                        f"({str(cause).strip().splitlines()[0] if str(cause) else error!r}); finished trials "
                        "are kept there: bring it up again and resume"
                    ) from error
                log.warning("the study's storage does not answer (%s); trying again", cause)
                time.sleep(pause)
                pause = min(2 * pause, 5.0)


def shown(url: str) -> str:
    """A storage's URL without its password, for messages and files."""
    try:
        return make_url(url).render_as_string(hide_password=True)
    except ArgumentError:
        return url


def _open(url: str, name: str, sampler: SlotSampler) -> optuna.Study:
    # A locked file is waited for; a connection that a restarted server has cut is noticed.
    options: dict[str, Any] = {"pool_pre_ping": True}
    if url.startswith("sqlite"):
        options["connect_args"] = {"timeout": 60}
    try:
        storage = optuna.storages.RDBStorage(url, engine_kwargs=options)
    except (ImportError, ValueError, ArgumentError) as error:
        raise ConfigError(
            f"--storage {shown(url)}: {error}; it is of the form sqlite:////path/study.db or "
            "postgresql+psycopg://user@host/database (pip install 'escape-hw[postgresql]')"
        ) from error
    if url.startswith("sqlite"):
        event.listen(storage.engine, "connect", _fast_commits)
        storage.engine.dispose()
    return optuna.create_study(
        storage=storage, study_name=name, sampler=sampler, direction="maximize", load_if_exists=True
    )


def _fast_commits(connection: Any, _record: object) -> None:
    """A log written ahead: a commit outlives the process at once, and costs no wait for the disk."""
    connection.execute("PRAGMA journal_mode=WAL")
    connection.execute("PRAGMA synchronous=NORMAL")


def _slot_of(trial: FrozenTrial) -> Slot:
    return Slot(**trial.user_attrs["slot"])


def _suggest(trial: optuna.Trial, one: Parameter) -> Any:
    if not isinstance(one, Range):
        return trial.suggest_categorical(one.key, one.values)
    if one.whole:
        return trial.suggest_int(one.key, int(one.low), int(one.high))
    return trial.suggest_float(one.key, one.low, one.high, log=one.log)


def _dead(runner: str, seen: float) -> bool:
    """Whether a runner is gone: its process, where that can be asked, or its signs of life."""
    host, pid, _ = runner.rsplit(":", 2)
    if host == socket.gethostname():
        try:
            os.kill(int(pid), 0)
        except ProcessLookupError:
            return True
        except PermissionError:
            pass
    return time.time() - seen > GRACE_S
