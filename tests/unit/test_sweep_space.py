"""Search space of a sweep: its text form, the draws, and errors before anything opens."""

from __future__ import annotations

import numpy as np
import pytest
from small_system import configuration

from escape_hw.errors import ConfigError
from escape_hw.runtime.sweep.design import EXPLORE, Design, MatrixVariant, Slot, draw_parameters
from escape_hw.runtime.sweep.run import shortlist, unit_coordinate
from escape_hw.runtime.sweep.search_space import (
    Choices,
    Range,
    config_overrides,
    default_space,
    parse_parameter,
)
from escape_hw.runtime.sweep.study import TrialRecord
from escape_hw.runtime.sweep.trials import TrialSpec

VARIANTS = [MatrixVariant(name, False, __file__, "") for name in ("A", "B", "C")]


@pytest.mark.parametrize(
    ("text", "want"),
    [
        ("gain=0.1:1", Range("gain", 0.1, 1.0)),
        ("gain=0.05:1.5:log", Range("gain", 0.05, 1.5, log=True)),
        ("dropped_modes=0:30", Range("dropped_modes", 0, 30, integer=True)),
        ("twin.latency_s=0:4e-3", Range("twin.latency_s", 0.0, 4e-3)),
        ("delay=0:2", Range("delay", 0.0, 2.0)),
        ("devices.screen.screen=0,1,3", Choices("devices.screen.screen", (0, 1, 3))),
        ("system.optics=fast,oopao", Choices("system.optics", ("fast", "oopao"))),
        ("gain=0.4", Choices("gain", (0.4,))),
    ],
)
def test_parameters_are_read_from_text_and_written(text, want):
    assert parse_parameter(text) == want
    assert parse_parameter(want.to_text()) == want


@pytest.mark.parametrize("text", ["gain", "=0:1", "gain=1:0.1", "leak=0:1:log", "gain=a:b", "gain=0:inf"])
def test_what_cannot_be_read_is_refused(text):
    with pytest.raises(ConfigError):
        parse_parameter(text)


def test_given_ranges_replace_the_default_ones_and_extend_them():
    space = default_space(30, [parse_parameter("gain=0.4"), parse_parameter("twin.latency_s=0:1e-3")])
    assert [one.key for one in space] == ["gain", "leak", "dropped_modes", "twin.latency_s"]
    assert space[0].at(0.7) == 0.4
    with pytest.raises(ConfigError, match="twice"):
        default_space(30, [parse_parameter("gain=0.4"), parse_parameter("gain=0.5")])


@pytest.mark.parametrize(
    "one", [Range("a", 0.05, 1.5, log=True), Range("a", 1.0, 3.0), Range("a", 0, 9, integer=True)]
)
def test_draws_fill_the_range(one):
    values = [one.at(share) for share in np.linspace(0, 1, 101)]
    assert min(values) == pytest.approx(one.low)
    assert max(values) == pytest.approx(one.high)
    assert unit_coordinate(one, values[50]) == pytest.approx(0.5, abs=0.06)


def test_all_variants_draw_the_same_parameters_on_the_same_turbulence():
    space = default_space(30, [])
    slots = list(Design(trials=9).exploration_slots(VARIANTS))
    assert [(slot.variant, slot.index) for slot in slots[:4]] == [("A", 0), ("B", 0), ("C", 0), ("A", 1)]
    assert draw_parameters(space, 1, slots[0].index) == draw_parameters(space, 1, slots[2].index)
    assert draw_parameters(space, 1, 0) != draw_parameters(space, 1, 1)
    assert draw_parameters(space, 1, 0) != draw_parameters(space, 2, 0)


def test_no_two_stages_share_their_turbulence():
    design = Design(trials=6)
    stages = (
        design.exploration_slots(VARIANTS),
        design.shortlist_slots(VARIANTS),
        design.final_slots(VARIANTS),
    )
    seeds = [{slot.run_seed(7) for slot in stage} for stage in stages]
    assert len(seeds[0] | seeds[1] | seeds[2]) == sum(map(len, seeds))
    assert (
        design.n_loops(3)
        == sum(len(list(s)) for s in (design.exploration_slots(VARIANTS), design.final_slots(VARIANTS))) + 36
    )


def test_a_single_good_loop_is_not_shortlisted_before_a_good_neighbourhood():
    space = (Range("gain", 0.0, 1.0),)
    rng = np.random.default_rng(1)
    records = []
    for number, gain in enumerate(np.linspace(0, 1, 200)):
        merit = 0.4 - (gain - 0.6) ** 2 + rng.normal(0, 0.02)
        records.append(TrialRecord(Slot(EXPLORE, "A", number), {"gain": float(gain)}, {}, float(merit)))
    lucky = TrialRecord(Slot(EXPLORE, "A", 999), {"gain": 0.02}, {}, 0.9)
    found = shortlist([*records, lucky], space, "A", 4)
    assert len(found) == 4
    assert all(abs(one["gain"] - 0.6) < 0.15 for one in found)


def test_diverged_loops_are_never_shortlisted():
    space = (Range("gain", 0.0, 1.0),)
    records = [TrialRecord(Slot(EXPLORE, "A", n), {"gain": n / 10}, {}, 0.0) for n in range(10)]
    assert shortlist(records, space, "A", 4) == []


def test_a_task_changes_what_is_varied_and_the_turbulence_but_not_the_bench():
    config = configuration()
    values = {"gain": 0.3, "leak": 0.01, "dropped_modes": 2, "delay": 1.5, "twin.wfs.read_noise_e": 12.0}
    task = TrialSpec(config.to_toml(), "x.fits", "", None, values, 100, 17)
    made = task.build_config()
    assert made.twin.wfs.read_noise_e == 12.0
    assert made.twin.run_seed == 17
    assert made.system.seed == config.system.seed
    assert made.twin.latency_s == pytest.approx(config.twin.latency_s + 1.5 / 500.0)
    assert config_overrides(values) == ("twin.wfs.read_noise_e=12.0",)
