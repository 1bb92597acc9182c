"""The study behind a sweep: trials are handed out once, none is lost, none runs for ever."""

from __future__ import annotations

import pytest
from optuna.exceptions import StorageInternalError
from optuna.trial import TrialState

from escape_hw.errors import ConfigError, StorageError
from escape_hw.runtime.sweep import study as module
from escape_hw.runtime.sweep.design import EXPLORE, FINAL, Design, MatrixVariant, Slot
from escape_hw.runtime.sweep.search_space import default_space
from escape_hw.runtime.sweep.study import SweepStore

ARMS = (MatrixVariant("push-pull", False, __file__, "a"), MatrixVariant("push-pull", True, __file__, "b"))
SPACE = default_space(30, ())
PLAN = list(Design(trials=10).exploration_slots(ARMS))
OUTCOME = {"strehl": None, "stable": True, "diverged": False}


@pytest.fixture
def opened(tmp_path):
    def make(use_tpe: bool = False, settings: str = "same", timeout_s: float = 5.0) -> SweepStore:
        url = f"sqlite:///{tmp_path / 'study.db'}"
        return SweepStore(
            url, "s", {"frames": settings}, ARMS, SPACE, 1, use_tpe=use_tpe, timeout_s=timeout_s
        )

    return make


def drain(*stores: SweepStore) -> list[Slot]:
    """Claim and finish whatever is there, the stores by turns."""
    done = []
    while True:
        for one in stores:
            one.enqueue_slots(PLAN, {})
        claims = [claim for one in stores if (claim := one.claim()) is not None]
        if not claims:
            return done
        for one, claim in zip(stores, claims, strict=False):
            one.finish(claim, OUTCOME, 0.1 + claim.values["gain"])
            done.append(claim.slot)


def test_two_runners_run_every_trial_once(opened):
    first, second = opened(), opened()
    assert sorted(drain(first, second), key=str) == sorted(PLAN, key=str)
    assert {record.slot for record in first.records()} == set(PLAN)
    assert first.running() == 0


def test_a_study_goes_on_where_it_was(opened):
    one = opened()
    one.enqueue_slots(PLAN, {})
    claim = one.claim()
    one.finish(claim, OUTCOME, 0.5)
    again = opened()
    assert [(r.slot, r.values, r.merit) for r in again.records()] == [(claim.slot, claim.values, 0.5)]
    assert len(drain(again)) == len(PLAN) - 1


def test_a_loop_that_diverged_is_pruned_and_counts_as_nothing(opened):
    one = opened()
    one.enqueue_slots(PLAN, {})
    one.finish(one.claim(), {**OUTCOME, "diverged": True}, None)
    (record,) = one.records()
    assert record.merit == 0.0
    assert one._study.trials[0].state == TrialState.PRUNED


def test_what_a_dead_runner_had_runs_again(opened, monkeypatch):
    dead = opened()
    monkeypatch.setattr(dead, "runner", dead.runner.rsplit(":", 2)[0] + ":4194303:gone")
    dead.enqueue_slots(PLAN, {})
    claim = dead.claim()
    # A living runner's trial is left alone.
    other = opened()
    kept = other.claim()
    fresh = opened()
    assert fresh.running() == 1
    finished = drain(fresh)
    assert claim.slot in finished
    assert kept.slot not in finished
    other.finish(kept, OUTCOME, 0.2)
    assert {record.slot for record in fresh.records()} == set(PLAN)
    # Its word comes too late, and changes nothing.
    before = fresh.records()
    dead.finish(claim, OUTCOME, 9.0)
    assert fresh.records() == before


def test_a_silent_runner_of_another_host_is_given_up_after_its_grace(opened, monkeypatch):
    away = opened()
    monkeypatch.setattr(away, "runner", "elsewhere:1:abc")
    away._send_heartbeat()
    away.enqueue_slots(PLAN, {})
    away.claim()
    assert opened().running() == 1
    now = module.time.time() + module.HEARTBEAT_TIMEOUT_S + 1
    monkeypatch.setattr(module.time, "time", lambda: now)
    assert opened().running() == 0


def test_what_is_given_back_runs_again(opened):
    one = opened()
    one.enqueue_slots(PLAN, {})
    claim = one.claim()
    one.release(claim, "stopped")
    assert claim.slot in drain(one)


def test_other_settings_are_refused_by_name(opened):
    opened()
    with pytest.raises(ConfigError, match="frames"):
        opened(settings="other")


def test_later_stages_fix_their_parameters(opened):
    one = opened()
    values = {(arm.label, 0): {"gain": 0.3, "leak": 0.01, "dropped_modes": 4} for arm in ARMS}
    one.enqueue_slots([Slot(FINAL, arm.label, 0) for arm in ARMS], values)
    assert one.claim().values == {"gain": 0.3, "leak": 0.01, "dropped_modes": 4}


def test_random_parameters_do_not_depend_on_who_runs_what_when(opened):
    one = opened()
    drain(one)
    by_air = {}
    for record in one.records():
        assert by_air.setdefault(record.slot.index, record.values) == record.values
    assert len({str(values) for values in by_air.values()}) == 5


def test_tpe_learns_from_each_arm_alone(opened):
    one = opened(use_tpe=True)
    # Merit rises with the gain on one arm and falls with it on the other.
    plan = list(Design(trials=40).exploration_slots(ARMS))
    while True:
        one.enqueue_slots(plan, {})
        claim = one.claim()
        if claim is None:
            break
        gain = claim.values["gain"] / 1.5
        one.finish(claim, OUTCOME, gain if claim.slot.arm == ARMS[0].label else 1 - gain)
    late = [r for r in one.records() if r.slot.stage == EXPLORE and r.slot.index >= 14]
    high = [r.values["gain"] for r in late if r.slot.arm == ARMS[0].label]
    low = [r.values["gain"] for r in late if r.slot.arm == ARMS[1].label]
    assert sum(high) / len(high) > 2 * sum(low) / len(low)


def test_a_storage_that_comes_back_is_waited_for(opened, monkeypatch):
    monkeypatch.setattr(module.time, "sleep", lambda seconds: None)
    one = opened()
    one.enqueue_slots(PLAN, {})
    refusals, claim = iter([StorageInternalError("gone"), StorageInternalError("gone")]), one._claim

    def sometimes():
        for error in refusals:
            raise error
        return claim()

    monkeypatch.setattr(one, "_claim", sometimes)
    assert one.claim() is not None


def test_a_storage_that_stays_away_is_named(opened, monkeypatch):
    one = opened(timeout_s=0.0)

    def never():
        raise StorageInternalError("gone")

    monkeypatch.setattr(one, "_claim", never)
    with pytest.raises(StorageError, match=r"sqlite.*does not answer.*resume"):
        one.claim()


@pytest.mark.parametrize("url", ["nonsense", "nosuchdialect://host/name"])
def test_a_wrong_url_is_a_usage_error(url):
    with pytest.raises(ConfigError, match="--storage"):
        SweepStore(url, "s", {}, ARMS, SPACE, 1)
