"""The study of a sweep: every loop runs once, none is lost, and the storage is waited for."""

from __future__ import annotations

import pytest
from optuna.exceptions import StorageInternalError
from optuna.trial import TrialState
from sqlalchemy import text

from escape_hw.errors import CalibrationError, ConfigError, StorageError
from escape_hw.runtime.sweep import study as module
from escape_hw.runtime.sweep.design import EXPLORE, FINAL, Design, MatrixVariant, Slot, Sweep, draw_parameters
from escape_hw.runtime.sweep.search_space import default_space
from escape_hw.runtime.sweep.study import SweepStudy

VARIANTS = (MatrixVariant("push-pull", False, __file__, "a"), MatrixVariant("push-pull", True, __file__, "b"))
SPACE = default_space(30, ())
PLAN = list(Design(trials=10).exploration_slots(VARIANTS))
OUTCOME = {"strehl": None, "stable": True, "diverged": False}


@pytest.fixture
def opened(tmp_path):
    made = []

    def make(settings: str = "same", heartbeat: bool = True, **options) -> SweepStudy:
        url = f"sqlite:///{tmp_path / 'study.db'}"
        options = {"timeout_s": 5.0, **options}
        sweep = Sweep("", VARIANTS, SPACE, Design(), 100, 1, simulated=heartbeat)
        made.append(SweepStudy(sweep, url, "s", {"frames": settings}, **options))
        return made[-1]

    yield make
    for one in made:
        one.close()


def run_all(*studies: SweepStudy, plan=PLAN, merit=lambda slot, values: 0.1 + values["gain"]) -> list[Slot]:
    """Run every loop of a plan, by turns with each study."""
    done = []

    def loop(slot, values):
        done.append(slot)
        return OUTCOME, merit(slot, values)

    while any(one.enqueue_missing(plan, {}, 3)[1] for one in studies):
        for one in studies:
            one.run_next(loop)
    return done


def abandon(study: SweepStudy, silent_s: int | None) -> Slot:
    """Start a loop as a runner does that is killed; its last heartbeat was given ``silent_s`` ago."""
    study.enqueue_missing(PLAN, {}, 3)
    trial = study._study.ask()
    if silent_s is not None:
        trial.set_user_attr("host", "elsewhere:1")
        storage = study._study._storage
        storage.record_heartbeat(trial._trial_id)
        with storage._backend.engine.begin() as connection:
            past = f"datetime('now', '-{silent_s} seconds')"
            where = f"where trial_id = {trial._trial_id}"
            connection.execute(text(f"update trial_heartbeats set heartbeat = {past} {where}"))
    return Slot(**trial.user_attrs["slot"])


@pytest.mark.filterwarnings("ignore:Heartbeat of storage")
@pytest.mark.parametrize(
    ("silent_s", "heartbeat"), [(module.GRACE_PERIOD_S + 2, True), (None, False)], ids=["workers", "bench"]
)
def test_what_a_dead_runner_ran_is_run_again(opened, silent_s, heartbeat):
    slot = abandon(opened(heartbeat=heartbeat), silent_s)
    study = opened(heartbeat=heartbeat)
    assert slot in run_all(study)
    assert {record.slot for record in study.records()} == set(PLAN)
    assert not study._study.get_trials(states=(TrialState.RUNNING, TrialState.WAITING))


@pytest.mark.filterwarnings("ignore:Heartbeat of storage")
def test_what_a_live_runner_runs_is_left_to_it(opened):
    slot = abandon(opened(), 0)
    study = opened()
    assert slot not in run_all(study)
    assert study.enqueue_missing(PLAN, {}, 3) == (1, 0)


def test_two_runners_run_every_trial_once(opened):
    first, second = opened(), opened()
    assert sorted(run_all(first, second), key=str) == sorted(PLAN, key=str)
    assert {record.slot for record in first.records()} == set(PLAN)


def test_a_loop_that_two_runners_enqueued_runs_once(opened):
    first, second = opened(), opened()
    seen = second._study.get_trials()
    first.enqueue_missing(PLAN, {}, 10)
    second._study.get_trials = lambda *_, **__: seen
    second.enqueue_missing(PLAN, {}, 10)
    del second._study.get_trials
    assert first.enqueue_missing(PLAN, {}, 10) == (len(PLAN), 2 * len(PLAN))
    assert len(run_all(first)) == len(PLAN)
    assert first.enqueue_missing(PLAN, {}, 3) == (0, 0)


def test_a_result_that_comes_after_the_trial_was_given_up_changes_nothing(opened):
    study, runs = opened(), []

    def slow(slot, values):
        runs.append(slot)
        if len(runs) == 1:
            (running,) = study._study.get_trials(states=(TrialState.RUNNING,))
            study._study.tell(running.number, state=TrialState.FAIL)
            return OUTCOME, 9.0
        return OUTCOME, 0.1

    while study.enqueue_missing(PLAN, {}, 3)[1]:
        study.run_next(slow)
    assert len(runs) == len(PLAN) + 1
    assert {(record.slot, record.merit) for record in study.records()} == {(slot, 0.1) for slot in PLAN}


def test_a_bench_whose_study_another_one_took_over_stops(opened):
    first, second = opened(heartbeat=False), opened(heartbeat=False)
    first.enqueue_missing(PLAN, {}, 3)
    trial, _, _ = first.ask()
    second.enqueue_missing(PLAN, {}, 3)
    with pytest.raises(CalibrationError, match="one bench serves one sweep"):
        first.tell(trial, OUTCOME, 0.3)


def test_a_study_is_resumed_with_what_it_has(opened):
    one = opened(heartbeat=False)
    one.enqueue_missing(PLAN, {}, 3)
    trial, slot, values = one.ask()
    one.tell(trial, OUTCOME, 0.5)
    again = opened()
    assert [(r.slot, r.values, r.merit) for r in again.records()] == [(slot, values, 0.5)]
    assert len(run_all(again)) == len(PLAN) - 1


def test_a_loop_that_diverged_is_pruned_and_counts_with_zero(opened):
    one = opened()
    one.enqueue_missing(PLAN, {}, 3)
    one.run_next(lambda slot, values: ({**OUTCOME, "diverged": True}, None))
    (record,) = one.records()
    assert record.merit == 0.0
    assert one._study.trials[0].state == TrialState.PRUNED


def test_a_loop_that_raises_or_is_stopped_runs_again(opened):
    one = opened()
    one.enqueue_missing(PLAN, {}, 3)

    def fail(slot, values):
        raise CalibrationError("no light")

    with pytest.raises(CalibrationError, match="no light"):
        one.run_next(fail)
    assert sorted(run_all(one), key=str) == sorted(PLAN, key=str)
    bench = opened(heartbeat=False)
    plan = [Slot(EXPLORE, VARIANTS[0].label, 99)]
    bench.enqueue_missing(plan, {}, 1)
    bench.tell(bench.ask()[0], None)
    assert run_all(bench, plan=plan) == plan


def test_trials_that_version_0_1_0_enqueued_without_parameters_run_with_those_of_their_slot(opened):
    one = opened()
    for slot in PLAN[:2]:
        stored = {"stage": slot.stage, "arm": slot.variant, "index": slot.index, "candidate": 0}
        one._study.enqueue_trial({"matrix": "push-pull"}, user_attrs={"slot": stored})
    run_all(one)
    values = {record.slot.index: record.values for record in one.records()}
    assert values[0] == draw_parameters(SPACE, 1, 0)
    assert {record.slot for record in one.records()} == set(PLAN)


def test_other_settings_are_refused_by_name(opened):
    opened()
    with pytest.raises(ConfigError, match="frames"):
        opened(settings="other")


def test_later_stages_fix_their_parameters(opened):
    one, seen = opened(), []
    fixed = {"gain": 0.3, "leak": 0.01, "dropped_modes": 4}
    plan = [Slot(FINAL, variant.label, 0) for variant in VARIANTS]
    one.enqueue_missing(plan, {(variant.label, 0): fixed for variant in VARIANTS}, 1)
    one.run_next(lambda slot, values: (seen.append(values) or OUTCOME, 0.1))
    assert seen == [fixed]


def test_random_parameters_depend_on_the_realisation_only(opened):
    one = opened()
    run_all(one)
    by_realisation = {}
    for record in one.records():
        assert by_realisation.setdefault(record.slot.index, record.values) == record.values
    assert len({str(values) for values in by_realisation.values()}) == 5


@pytest.mark.slow
def test_tpe_learns_from_each_variant_alone(opened):
    one = opened(use_tpe=True)

    def merit(slot, values):
        # Rises with the gain of one variant and falls with that of the other.
        gain = values["gain"] / 1.5
        return gain if slot.variant == VARIANTS[0].label else 1 - gain

    run_all(one, plan=list(Design(trials=40).exploration_slots(VARIANTS)), merit=merit)
    late = [r for r in one.records() if r.slot.index >= 14]
    high = [r.values["gain"] for r in late if r.slot.variant == VARIANTS[0].label]
    low = [r.values["gain"] for r in late if r.slot.variant == VARIANTS[1].label]
    assert sum(high) / len(high) > 2 * sum(low) / len(low)


def test_a_storage_that_does_not_answer_for_a_while_is_waited_for(opened, monkeypatch):
    one = opened()
    one.enqueue_missing(PLAN, {}, 3)
    refusals, ask = iter([StorageInternalError("gone"), StorageInternalError("gone")]), one._study.ask
    monkeypatch.setattr(one._stopped, "wait", lambda seconds: False)

    def sometimes(*arguments, **options):
        for error in refusals:
            raise error
        return ask(*arguments, **options)

    monkeypatch.setattr(one._study, "ask", sometimes)
    one.run_next(lambda slot, values: (OUTCOME, 0.1))
    assert len(one.records()) == 1


def test_a_storage_lost_while_a_loop_runs_costs_that_loop_only(opened, monkeypatch):
    """Optuna hides the storage's error behind one of its own when the outcome cannot be stored."""
    one = opened()
    one.enqueue_missing(PLAN, {}, 3)
    monkeypatch.setattr(one._stopped, "wait", lambda seconds: False)
    storage, lost = one._study._storage, []
    write, read = storage.set_trial_state_values, storage.get_trial

    def no_answer(trial_id):
        if len(lost) == 1:
            lost.append("read")
            raise StorageInternalError("gone")
        return read(trial_id)

    def write_once(trial_id, state, values=None):
        if state == TrialState.COMPLETE and not lost:
            lost.append("write")
            raise StorageInternalError("gone")
        return write(trial_id, state, values)

    monkeypatch.setattr(storage, "set_trial_state_values", write_once)
    monkeypatch.setattr(storage, "get_trial", no_answer)
    one.run_next(lambda slot, values: (OUTCOME, 0.1))
    assert lost == ["write", "read"]
    assert len(one.records()) == 1


def test_a_storage_that_stays_away_is_named(opened, monkeypatch):
    one = opened(timeout_s=0.0)

    def never(*_arguments, **_options):
        raise StorageInternalError("gone")

    monkeypatch.setattr(one._study, "get_trials", never)
    with pytest.raises(StorageError, match=r"sqlite.*does not answer.*resume"):
        one.enqueue_missing(PLAN, {}, 3)


@pytest.mark.parametrize("url", ["nonsense", "nosuchdialect://host/name"])
def test_a_wrong_url_is_a_usage_error(url):
    with pytest.raises(ConfigError, match="--storage"):
        SweepStudy(Sweep("", VARIANTS, SPACE, Design(), 100, 1), url, "s", {})
