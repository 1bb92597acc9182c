"""The Optuna study of a sweep: parameter sampling, distribution and storage of trials."""

from __future__ import annotations

import logging
import os
import socket
import time
import uuid
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Any, TypeVar

import optuna
from optuna.distributions import BaseDistribution
from optuna.exceptions import StorageInternalError, UpdateFinishedTrialError
from optuna.samplers import BaseSampler, TPESampler
from optuna.trial import FrozenTrial, TrialState, create_trial
from sqlalchemy import event, make_url
from sqlalchemy.exc import ArgumentError, DBAPIError

from escape_hw.errors import ConfigError, StorageError
from escape_hw.runtime.sweep.design import EXPLORE, MatrixVariant, Slot, draw_parameters
from escape_hw.runtime.sweep.search_space import Parameter, Range

#: The samplers by name.
SAMPLERS = ("random", "tpe")
#: Loops of each arm with drawn parameters before TPE has anything to learn from.
N_STARTUP_LOOPS = 10

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
        self._values_of_trial: dict[int, dict[str, Any]] = {}

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
        if trial.number not in self._values_of_trial:
            # Those of a trial are asked for in a row.
            self._values_of_trial = {trial.number: self._values(self._slot_of(trial))}
        return self._values_of_trial[trial.number][param_name]

    def _values(self, slot: Slot) -> dict[str, Any]:
        history = () if self._history is None else self._history(slot.arm)
        if self._history is None or min(len(history), slot.index) < N_STARTUP_LOOPS:
            return draw_parameters(self._space, self._seed, slot.index)
        distributions = {one.key: one.distribution() for one in self._space}
        seed = zlib.crc32(f"{self._seed} {slot.arm} {slot.index}".encode())
        variant_study = optuna.create_study(
            direction="maximize", sampler=TPESampler(seed=seed, multivariate=True, n_startup_trials=0)
        )
        variant_study.add_trials(
            create_trial(state=TrialState.COMPLETE, params=params, distributions=distributions, value=merit)
            for params, merit in history
        )
        return dict(variant_study.ask(distributions).params)


log = logging.getLogger(__name__)
T = TypeVar("T")

#: Seconds after which a runner that has not been heard of counts as dead, and its trials run again.
HEARTBEAT_TIMEOUT_S = 60.0
#: Seconds between two signs of life.
HEARTBEAT_S = 5.0
#: Seconds to wait for a storage that does not answer.
STORAGE_TIMEOUT_S = 120.0
#: Trials laid out ahead of the runners: every one costs time at each claim.
_QUEUE_LENGTH = 24
_FINISHED = (TrialState.COMPLETE, TrialState.PRUNED)


@dataclass(frozen=True, slots=True)
class LoopRecord:
    """A finished loop.

    Parameters
    ----------
    slot
        Its place in the plan.
    values
        Its parameters.
    outcome
        How it went, see :func:`~escape_hw.runtime.sweep.trials.loop_outcome`.
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
    of life every :data:`HEARTBEAT_S` seconds; what a dead one had claimed is handed out again. When the
    storage does not answer, calls wait for it up to ``timeout_s``.

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
        arms: Sequence[MatrixVariant],
        space: Sequence[Parameter],
        seed: int,
        *,
        use_tpe: bool = False,
        timeout_s: float = STORAGE_TIMEOUT_S,
    ) -> None:
        self.url, self.name, self._timeout_s = url, study, timeout_s
        self._variants, self._space = {arm.label: arm for arm in arms}, tuple(space)
        self._matrices = tuple(dict.fromkeys(arm.matrix for arm in arms))
        self.runner = f"{socket.gethostname()}:{os.getpid()}:{uuid.uuid4().hex[:8]}"
        self._last_heartbeat = -HEARTBEAT_S
        optuna.logging.set_verbosity(optuna.logging.WARNING)
        sampler = SlotSampler(space, seed, _slot_of, self._history if use_tpe else None)
        self._study = self._retry_until_timeout(lambda: _open_study(url, study, sampler))
        self._check_settings(dict(settings))
        self.send_heartbeat()

    # ------------------------------------------------------------------ hand out and take in
    def enqueue_slots(self, plan: Sequence[Slot], values: Mapping[tuple[str, int], Mapping[str, Any]]) -> int:
        """Put the next slots of a plan up for claiming; returns how many are neither finished nor laid out.

        Parameters
        ----------
        plan
            Every slot of a stage.
        values
            Parameters by arm and candidate, where the stage fixes them.
        """
        return self._retry_until_timeout(lambda: self._enqueue_slots(plan, values))

    def _enqueue_slots(
        self, plan: Sequence[Slot], values: Mapping[tuple[str, int], Mapping[str, Any]]
    ) -> int:
        trials = self._study.get_trials(deepcopy=False)
        alive = [t for t in trials if t.state != TrialState.FAIL and "slot" in t.user_attrs]
        present = {_slot_of(t) for t in alive}
        missing = [slot for slot in plan if slot not in present]
        waiting = sum(t.state == TrialState.WAITING for t in alive)
        if waiting > _QUEUE_LENGTH // 2:
            return len(missing)
        for slot in missing[: _QUEUE_LENGTH - waiting]:
            arm = self._variants[slot.arm]
            fixed = {"matrix": arm.matrix, "optical_gains": arm.optical_gains}
            fixed |= values.get((slot.arm, slot.candidate), {})
            self._study.enqueue_trial(fixed, user_attrs={"slot": slot.to_dict()})
        return max(0, len(missing) - (_QUEUE_LENGTH - waiting))

    def claim(self) -> Claim | None:
        """A trial to run, or ``None`` when none is up for claiming."""
        return self._retry_until_timeout(self._claim)

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
        values = {one.key: _suggest_value(trial, one) for one in self._space}
        return Claim(trial, slot, values)

    def finish(self, claim: Claim, outcome: Mapping[str, Any], merit: float | None) -> None:
        """Keep how a claimed trial went; ``merit`` is ``None`` when it diverged."""
        state = TrialState.COMPLETE if merit is not None else TrialState.PRUNED
        self._retry_until_timeout(lambda: self._tell(claim, state, merit, outcome=dict(outcome)))

    def release(self, claim: Claim, reason: str) -> None:
        """Give up a claimed trial, so that it can be handed out again."""
        self._retry_until_timeout(lambda: self._tell(claim, TrialState.FAIL, None, reason=reason))

    def _tell(self, claim: Claim, state: TrialState, merit: float | None, **remarks: Any) -> None:
        try:
            for key, value in remarks.items():
                claim.trial.set_user_attr(key, value)
        except UpdateFinishedTrialError:
            # Told before the connection broke, or given up by another runner that took this one for dead.
            return
        self._study.tell(claim.trial, merit, state=state, skip_if_finished=True)

    # ------------------------------------------------------------------ signs of life
    def send_heartbeat(self) -> None:
        """Give a sign of life when it is time, and recover what dead runners had claimed."""
        if time.monotonic() - self._last_heartbeat < HEARTBEAT_S:
            return
        self._last_heartbeat = time.monotonic()
        self._retry_until_timeout(self._send_heartbeat)

    def _send_heartbeat(self) -> None:
        self._study.set_user_attr(f"alive:{self.runner}", time.time())
        seen = {k[6:]: float(v) for k, v in self._study.user_attrs.items() if k.startswith("alive:")}
        for trial in self._study.get_trials(deepcopy=False, states=(TrialState.RUNNING,)):
            runner = trial.user_attrs.get("runner")
            if runner is None:
                began = trial.datetime_start or datetime.now()
                dead = (datetime.now() - began).total_seconds() > HEARTBEAT_TIMEOUT_S
            else:
                dead = runner != self.runner and _is_runner_dead(runner, seen.get(runner, 0.0))
            if dead:
                log.warning("trial %d: its runner %s is gone; it runs again", trial.number, runner)
                self._study.tell(trial.number, state=TrialState.FAIL, skip_if_finished=True)

    # ------------------------------------------------------------------ what is known
    def running(self) -> int:
        """Trials that some runner is at."""
        return self._retry_until_timeout(lambda: len(self._study.get_trials(False, (TrialState.RUNNING,))))

    def records(self) -> list[LoopRecord]:
        """Every finished loop, in the order of the plan's numbers; doubles only once."""
        found: dict[Slot, LoopRecord] = {}
        for trial in self._retry_until_timeout(lambda: self._study.get_trials(deepcopy=False)):
            if trial.state in _FINISHED and "slot" in trial.user_attrs:
                slot = _slot_of(trial)
                found.setdefault(slot, self._record(trial, slot))
        return sorted(found.values(), key=lambda r: (r.slot.stage, r.slot.index, r.slot.candidate))

    def finished_in(self) -> str | None:
        """Folder with the result of all its loops, once there is one."""
        return self._retry_until_timeout(lambda: self._study.user_attrs.get("finished_in"))

    def set_result_folder(self, folder: str) -> None:
        """Keep where the result of all its loops lies."""
        self._retry_until_timeout(lambda: self._study.set_user_attr("finished_in", folder))

    def _record(self, trial: FrozenTrial, slot: Slot) -> LoopRecord:
        values = {one.key: trial.params[one.key] for one in self._space}
        complete = trial.state == TrialState.COMPLETE and trial.value is not None
        return LoopRecord(
            slot, values, trial.user_attrs["outcome"], float(trial.value or 0.0) if complete else 0.0
        )

    def _history(self, arm: str) -> History:
        records_of_variant = [r for r in self.records() if r.slot.stage == EXPLORE and r.slot.arm == arm]
        return [(record.values, record.merit) for record in records_of_variant]

    # ------------------------------------------------------------------ the storage itself
    def _check_settings(self, settings: dict[str, Any]) -> None:
        known = self._retry_until_timeout(lambda: self._study.user_attrs.get("settings"))
        if known is None:
            self._retry_until_timeout(lambda: self._study.set_user_attr("settings", settings))
            return
        other = [key for key in settings if known.get(key) != settings[key]]
        if other:
            raise ConfigError(
                f"study '{self.name}' in {redact_password(self.url)} was begun with another {', '.join(other)}; "
                "take them again, or another --study or --storage"
            )

    def _retry_until_timeout(self, call: Callable[[], T]) -> T:
        """A call to the storage, again and again while it does not answer."""
        deadline, delay_s = time.monotonic() + self._timeout_s, 0.5
        while True:
            try:
                return call()
            except (StorageInternalError, DBAPIError) as error:
                cause = error.__cause__ if isinstance(error, StorageInternalError) else error.orig
                if time.monotonic() + delay_s > deadline:
                    raise StorageError(
                        f"the study's storage {redact_password(self.url)} does not answer for {self._timeout_s:.0f} s "
                        f"({str(cause).strip().splitlines()[0] if str(cause) else error!r}); finished trials "
                        "are kept there: bring it up again and resume"
                    ) from error
                log.warning("the study's storage does not answer (%s); trying again", cause)
                time.sleep(delay_s)
                delay_s = min(2 * delay_s, 5.0)


def redact_password(url: str) -> str:
    """A storage's URL without its password, for messages and files."""
    try:
        return make_url(url).render_as_string(hide_password=True)
    except ArgumentError:
        return url


def _open_study(url: str, name: str, sampler: SlotSampler) -> optuna.Study:
    # A locked file is waited for; a connection that a restarted server has cut is noticed.
    options: dict[str, Any] = {"pool_pre_ping": True}
    if url.startswith("sqlite"):
        options["connect_args"] = {"timeout": 60}
    try:
        storage = optuna.storages.RDBStorage(url, engine_kwargs=options)
    except (ImportError, ValueError, ArgumentError) as error:
        raise ConfigError(
            f"--storage {redact_password(url)}: {error}; it is of the form sqlite:////path/study.db or "
            "postgresql+psycopg://user@host/database (pip install 'escape-hw[postgresql]')"
        ) from error
    if url.startswith("sqlite"):
        event.listen(storage.engine, "connect", _enable_write_ahead_log)
        storage.engine.dispose()
    return optuna.create_study(
        storage=storage, study_name=name, sampler=sampler, direction="maximize", load_if_exists=True
    )


def _enable_write_ahead_log(connection: Any, _record: object) -> None:
    """A log written ahead: a commit outlives the process at once, and costs no wait for the disk."""
    connection.execute("PRAGMA journal_mode=WAL")
    connection.execute("PRAGMA synchronous=NORMAL")


def _slot_of(trial: FrozenTrial) -> Slot:
    return Slot(**trial.user_attrs["slot"])


def _suggest_value(trial: optuna.Trial, one: Parameter) -> Any:
    if not isinstance(one, Range):
        return trial.suggest_categorical(one.key, one.values)
    if one.integer:
        return trial.suggest_int(one.key, int(one.low), int(one.high))
    return trial.suggest_float(one.key, one.low, one.high, log=one.log)


def _is_runner_dead(runner: str, seen: float) -> bool:
    """Whether a runner is gone: its process, where that can be asked, or its signs of life."""
    host, pid, _ = runner.rsplit(":", 2)
    if host == socket.gethostname():
        try:
            os.kill(int(pid), 0)
        except ProcessLookupError:
            return True
        except PermissionError:
            pass
    return time.time() - seen > HEARTBEAT_TIMEOUT_S
