"""The Optuna study of a sweep: which loops wait, run and are finished, in a storage that runners share."""

from __future__ import annotations

import contextlib
import functools
import itertools
import logging
import os
import socket
import threading
import time
import warnings
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from datetime import datetime
from typing import Any, Concatenate, ParamSpec, Self, TypeVar

import optuna
from optuna.exceptions import ExperimentalWarning, StorageInternalError, UpdateFinishedTrialError
from optuna.samplers import TPESampler
from optuna.trial import FrozenTrial, TrialState, create_trial
from sqlalchemy import event, make_url
from sqlalchemy.exc import ArgumentError, DBAPIError

from escape_hw.errors import CalibrationError, ConfigError, EscapeError, StorageError
from escape_hw.runtime.sweep.design import EXPLORE, Slot, Sweep, current_keys, draw_parameters
from escape_hw.runtime.sweep.search_space import Parameter, Range

log = logging.getLogger(__name__)
P = ParamSpec("P")
T = TypeVar("T")

#: The samplers by name.
SAMPLERS = ("random", "tpe")
#: Loops of each variant with drawn parameters before TPE starts.
N_STARTUP_LOOPS = 10
#: Seconds between two heartbeats of a running trial, and without one until the trial is run again.
HEARTBEAT_S, GRACE_PERIOD_S = 5, 30
#: Seconds to wait for a storage that does not answer.
STORAGE_TIMEOUT_S = 120.0
_FINISHED = (TrialState.COMPLETE, TrialState.PRUNED)

#: Runs the loop of a slot; returns its outcome and its merit, ``None`` when it diverged.
RunLoop = Callable[[Slot, dict[str, Any]], tuple[dict[str, Any], float | None]]


@dataclass(frozen=True, slots=True)
class TrialRecord:
    """A finished loop: slot, parameters, outcome, and the Strehl ratio that is maximised, 0 if it diverged.

    See :func:`~escape_hw.runtime.sweep.trials.loop_outcome`.
    """

    slot: Slot
    values: dict[str, Any]
    outcome: dict[str, Any]
    merit: float


class _SlotTaken(Exception):
    """The trial's loop is finished, or runs elsewhere, or cannot run."""


class _Storage(optuna.storages.RDBStorage):
    """Storage whose heartbeats continue after it did not answer for a while."""

    def record_heartbeat(self, trial_id: int) -> None:
        with contextlib.suppress(StorageInternalError, DBAPIError):
            super().record_heartbeat(trial_id)


def _retry_storage(
    method: Callable[Concatenate[SweepStudy, P], T],
) -> Callable[Concatenate[SweepStudy, P], T]:
    """The method, called again while the storage does not answer."""

    @functools.wraps(method)
    def call(self: SweepStudy, /, *arguments: P.args, **keywords: P.kwargs) -> T:
        return self._retry(lambda: method(self, *arguments, **keywords))

    return call


class SweepStudy:
    """The trials of one sweep, one for each :class:`~escape_hw.runtime.sweep.design.Slot`.

    Several runners on several machines may share one. Optuna assigns each enqueued trial to one of them,
    records heartbeats while :meth:`run_next` runs it, and fails it when they stop, after which it is
    enqueued again with a new number: loops are identified by the slot in their user attributes. Every call
    waits up to ``timeout_s`` for a storage that does not answer. Loops have heartbeats in simulation; on
    hardware one runner uses :meth:`ask` and :meth:`tell`.

    Parameters
    ----------
    url
        SQLAlchemy's URL: ``sqlite:////path/study.db``, ``postgresql+psycopg://user@host/name``.
    settings
        Settings that must agree to resume a study.
    use_tpe
        TPE instead of random parameters.

    Raises
    ------
    ConfigError
        The study exists with other settings, or the URL is invalid.
    StorageError
        The storage does not answer.
    """

    def __init__(
        self,
        sweep: Sweep,
        url: str,
        name: str,
        settings: Mapping[str, Any],
        *,
        use_tpe: bool = False,
        timeout_s: float = STORAGE_TIMEOUT_S,
    ) -> None:
        self.sweep, self.url, self.name, self._timeout_s = sweep, url, name, timeout_s
        self._use_tpe, self._grace_s = use_tpe, GRACE_PERIOD_S if sweep.simulated else 0
        self._stopped = threading.Event()
        optuna.logging.set_verbosity(optuna.logging.ERROR)
        # Optuna announces the interface of its heartbeats as experimental, from several threads.
        warnings.filterwarnings("ignore", ".*(heartbeat|fail_stale_trials)", ExperimentalWarning)
        self._storage, self._study = self._retry(lambda: _open_study(url, name, sweep.simulated))
        try:
            self._check_settings(dict(settings))
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the connections to the storage."""
        self._storage.engine.dispose()

    def stop(self) -> None:
        """End the wait for a storage that does not answer, in every thread."""
        self._stopped.set()

    # ------------------------------------------------------------------ run loops
    @_retry_storage
    def enqueue_missing(
        self, plan: Sequence[Slot], values: Mapping[tuple[str, int], Mapping[str, Any]], n_free: int
    ) -> tuple[int, int]:
        """Enqueue the next loops of a stage; trials of runners that died count as missing.

        Loops of the first stage get random parameters, or those that TPE chooses from the finished ones.
        Later stages have them in ``values``, by variant and candidate. At most ``n_free`` trials wait in the
        queue.

        Returns
        -------
        n_unfinished, n_waiting : int
            Slots of the stage without a finished loop, and trials in the queue.
        """
        self._fail_abandoned()
        trials = [t for t in self._study.get_trials(deepcopy=False) if "slot" in t.user_attrs]
        finished = {_slot_of(t) for t in trials if t.state in _FINISHED}
        present = finished | {_slot_of(t) for t in trials if t.state != TrialState.FAIL}
        n_waiting = sum(t.state == TrialState.WAITING for t in trials)
        missing = (slot for slot in plan if slot not in present)
        for slot in itertools.islice(missing, max(0, n_free - n_waiting)):
            variant = next(one for one in self.sweep.variants if one.label == slot.variant)
            parameters = values.get((slot.variant, slot.candidate)) or self._choose_parameters(slot)
            fixed = {"matrix": variant.matrix, "optical_gains": variant.optical_gains, **parameters}
            self._study.enqueue_trial(fixed, user_attrs={"slot": asdict(slot)})
            n_waiting += 1
        return sum(slot not in finished for slot in plan), n_waiting

    def _choose_parameters(self, slot: Slot) -> dict[str, Any]:
        """Parameters of a loop of the first stage; TPE optimises each variant for itself."""
        if not self._use_tpe or slot.index < N_STARTUP_LOOPS:
            return draw_parameters(self.sweep.space, self.sweep.seed, slot.index)
        history = [r for r in self.records() if r.slot.stage == EXPLORE and r.slot.variant == slot.variant]
        if len(history) < N_STARTUP_LOOPS:
            return draw_parameters(self.sweep.space, self.sweep.seed, slot.index)
        distributions = {one.key: one.distribution() for one in self.sweep.space}
        seed = zlib.crc32(f"{self.sweep.seed} {slot.variant} {slot.index}".encode())
        tpe = TPESampler(seed=seed, multivariate=True, n_startup_trials=0)
        study = optuna.create_study(direction="maximize", sampler=tpe)
        study.add_trials(
            create_trial(params=r.values, distributions=distributions, value=r.merit) for r in history
        )
        return dict(study.ask(distributions).params)

    def _fail_abandoned(self) -> None:
        """Fail running trials whose heartbeats stopped, and those that never had any (0.1.0, hardware)."""
        optuna.storages.fail_stale_trials(self._study)
        for trial in self._study.get_trials(deepcopy=False, states=(TrialState.RUNNING,)):
            age = datetime.now() - (trial.datetime_start or datetime.min)
            if "host" not in trial.user_attrs and age.total_seconds() >= self._grace_s:
                log.warning("trial %d was abandoned; its loop runs again", trial.number)
                self._study.tell(trial.number, state=TrialState.FAIL, skip_if_finished=True)

    def run_next(self, run_loop: RunLoop) -> None:
        """Run the next trial of the queue with :meth:`optuna.Study.optimize`; returns at once without one.

        May be called from several threads. Exceptions of ``run_loop`` fail the trial and are raised.
        """
        overtaken = False

        def objective(trial: optuna.Trial) -> float:
            nonlocal overtaken
            try:
                trial.set_user_attr("host", f"{socket.gethostname()}:{os.getpid()}")
                slot, values = self._suggest(trial)
                outcome, merit = run_loop(slot, values)
                trial.set_user_attr("outcome", outcome)
            except UpdateFinishedTrialError:
                overtaken = True
                raise
            if merit is None:
                raise optuna.TrialPruned("the loop diverged")
            return merit

        def optimize() -> None:
            if not self._study.get_trials(deepcopy=False, states=(TrialState.WAITING,)):
                return
            try:
                self._study.optimize(objective, n_trials=1, catch=(_SlotTaken,))
            except ValueError:
                # The trial was failed for want of heartbeats; its loop runs again under another number.
                if not overtaken:
                    raise

        self._retry(optimize)

    def _suggest(self, trial: optuna.Trial) -> tuple[Slot, dict[str, Any]]:
        trials = self._study.get_trials(deepcopy=False)
        fixed = trials[trial.number].system_attrs.get("fixed_params", {})
        if "slot" not in trial.user_attrs or not {one.key for one in self.sweep.space} <= set(fixed):
            # Made by Optuna after another runner took the last one, or enqueued without parameters by 0.1.0.
            raise _SlotTaken
        slot = _slot_of(trials[trial.number])
        for other in trials:
            earlier = other.state == TrialState.RUNNING and other.number < trial.number
            if (
                (earlier or other.state in _FINISHED)
                and "slot" in other.user_attrs
                and _slot_of(other) == slot
            ):
                raise _SlotTaken
        matrices = tuple(dict.fromkeys(one.matrix for one in self.sweep.variants))
        trial.suggest_categorical("matrix", matrices)
        trial.suggest_categorical("optical_gains", (False, True))
        return slot, {one.key: _suggest_value(trial, one) for one in self.sweep.space}

    @_retry_storage
    def ask(self) -> tuple[optuna.Trial, Slot, dict[str, Any]] | None:
        """Take the next trial of the queue, for a procedure that cannot run within :meth:`run_next`."""
        trial = self._study.ask()
        try:
            return (trial, *self._suggest(trial))
        except _SlotTaken:
            self.tell(trial, None)
            return None

    @_retry_storage
    def tell(self, trial: optuna.Trial, outcome: dict[str, Any] | None, merit: float | None = None) -> None:
        """Store the outcome of a trial from :meth:`ask`; without one, its loop runs again.

        Raises
        ------
        CalibrationError
            Another runner uses the study.
        """
        state = TrialState.FAIL if outcome is None else TrialState.PRUNED if merit is None else None
        try:
            if outcome is not None:
                trial.set_user_attr("outcome", outcome)
        except UpdateFinishedTrialError:
            # Stored just before the connection broke, or failed by another runner.
            if self._study.get_trials(deepcopy=False)[trial.number].state == TrialState.FAIL:
                raise CalibrationError(
                    "another runner took over the study; one bench serves one sweep: end the other"
                ) from None
        self._study.tell(trial, merit, state=state, skip_if_finished=True)

    # ------------------------------------------------------------------ results
    @_retry_storage
    def records(self) -> list[TrialRecord]:
        """Every finished loop once, in the order of the design."""
        found: dict[Slot, TrialRecord] = {}
        for trial in self._study.get_trials(deepcopy=False, states=_FINISHED):
            if "slot" in trial.user_attrs:
                slot, values = _slot_of(trial), {one.key: trial.params[one.key] for one in self.sweep.space}
                merit = trial.value if trial.state == TrialState.COMPLETE else None
                found.setdefault(slot, TrialRecord(slot, values, trial.user_attrs["outcome"], merit or 0.0))
        return sorted(found.values(), key=lambda r: (r.slot.stage, r.slot.index, r.slot.candidate))

    @_retry_storage
    def result_folder(self) -> str | None:
        """Folder with the result of the complete sweep; ``None`` before there is one."""
        return self._study.user_attrs.get("finished_in")

    @_retry_storage
    def set_result_folder(self, folder: str) -> None:
        """Store the folder with the result of the complete sweep."""
        self._study.set_user_attr("finished_in", folder)

    # ------------------------------------------------------------------ storage
    @_retry_storage
    def _check_settings(self, settings: dict[str, Any]) -> None:
        known = current_keys(self._study.user_attrs.get("settings"))
        if known is None:
            self._study.set_user_attr("settings", settings)
            return
        other = [key for key in settings if known.get(key) != settings[key]]
        if other:
            raise ConfigError(
                f"study '{self.name}' in {redact_password(self.url)} has other settings: {', '.join(other)}; "
                "use the same ones, or another --study or --storage"
            )

    def _retry(self, call: Callable[[], T]) -> T:
        """Call the storage, again after growing delays while it does not answer."""
        deadline, delay_s = None, 0.5
        while True:
            try:
                return call()
            except Exception as error:
                cause = None if isinstance(error, EscapeError) else _storage_error(error)
                if cause is None:
                    raise
                deadline = time.monotonic() + self._timeout_s if deadline is None else deadline
                if time.monotonic() + delay_s > deadline or self._stopped.wait(delay_s):
                    raise StorageError(
                        f"the study's storage {redact_password(self.url)} does not answer for "
                        f"{self._timeout_s:.0f} s ({str(cause).strip().splitlines()[0]}); finished trials "
                        "are kept: resume when it is back"
                    ) from error
                delay_s = min(2 * delay_s, 5.0)


def _storage_error(error: BaseException | None) -> BaseException | None:
    """The cause of an error of the storage, also where Optuna failed later because of it; else ``None``."""
    while error is not None:
        if isinstance(error, StorageInternalError):
            return error.__cause__ or error
        if isinstance(error, DBAPIError):
            return error.orig or error
        error = error.__cause__ or error.__context__
    return None


def redact_password(url: str) -> str:
    """A storage's URL without its password."""
    try:
        return make_url(url).render_as_string(hide_password=True)
    except ArgumentError:
        return url


def require_storage_url(url: str) -> None:
    """Check that the URL of a storage can be read and its driver is installed; connects to nothing.

    Raises
    ------
    ConfigError
        It cannot, or it is not.
    """
    with _invalid_url_is_refused(url):
        make_url(url).get_dialect().import_dbapi()


@contextlib.contextmanager
def _invalid_url_is_refused(url: str) -> Iterator[None]:
    try:
        yield
    except (ImportError, ValueError, ArgumentError) as error:
        raise ConfigError(
            f"--storage {redact_password(url)}: {error}; it is of the form sqlite:////path/study.db or "
            "postgresql+psycopg://user@host/database (pip install 'escape-hw[postgresql]')"
        ) from error


def _open_study(url: str, name: str, heartbeat: bool) -> tuple[_Storage, optuna.Study]:
    # A locked file is waited for; a connection that a restarted server has cut is noticed.
    options: dict[str, Any] = {"pool_pre_ping": True}
    if url.startswith("sqlite"):
        options["connect_args"] = {"timeout": 60}
    with _invalid_url_is_refused(url):
        storage = _Storage(
            url, engine_kwargs=options, heartbeat_interval=HEARTBEAT_S if heartbeat else None,
            grace_period=GRACE_PERIOD_S,
        )  # fmt: skip
    if url.startswith("sqlite"):
        event.listen(storage.engine, "connect", _enable_write_ahead_log)
        storage.engine.dispose()
    try:
        return storage, optuna.create_study(
            storage=storage, study_name=name, direction="maximize", load_if_exists=True
        )
    except BaseException:
        storage.engine.dispose()
        raise


def _enable_write_ahead_log(connection: Any, _record: object) -> None:
    """Commits survive the end of the process and do not wait for the disk."""
    connection.execute("PRAGMA journal_mode=WAL")
    connection.execute("PRAGMA synchronous=NORMAL")


def _slot_of(trial: FrozenTrial) -> Slot:
    return Slot(**current_keys(trial.user_attrs["slot"]))


def _suggest_value(trial: optuna.Trial, one: Parameter) -> Any:
    if not isinstance(one, Range):
        return trial.suggest_categorical(one.key, one.values)
    if one.integer:
        return trial.suggest_int(one.key, int(one.low), int(one.high))
    return trial.suggest_float(one.key, one.low, one.high, log=one.log)
