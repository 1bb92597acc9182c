"""The plan of a procedure before it starts."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from small_system import SMALL

from escape_hw.bench import Bench
from escape_hw.calibration.acquisition.pokes import RandomPokes, compute_poke_amplitudes
from escape_hw.calibration.modes.bases import build_modal_basis
from escape_hw.config.loader import load_system
from escape_hw.server.engine.procedures import ProcedurePlanner


@pytest.fixture(scope="module")
def bench() -> Iterator[Bench]:
    with Bench.from_config(load_system("razor-shwfs", overrides=SMALL)) as bench:
        yield bench


def commands(bench: Bench, poke: float, frames: int = 4000) -> np.ndarray:
    """Shapes that random pokes ask for ``(frames, n_act)``."""
    m2c = build_modal_basis(bench)
    pokes = RandomPokes(compute_poke_amplitudes(bench, m2c, poke), np.random.default_rng(5))
    return np.array([m2c @ pokes() for _ in range(frames)])


def test_the_stroke_is_what_random_pokes_reach(bench: Bench) -> None:
    told = ProcedurePlanner(bench).plan("docrime", {"frames": 400, "poke": 0.005})
    assert told.stroke == pytest.approx(np.abs(commands(bench, 0.005)).max(), rel=0.2)
    assert told.frames == 400
    assert told.seconds == pytest.approx(400 / bench.wfs.settings.frame_rate_hz)
    assert told.warnings == ()


def test_pokes_in_turn_reach_less_than_all_at_once(bench: Bench) -> None:
    planner, asked = ProcedurePlanner(bench), {"frames": 400, "poke": 0.005}
    assert planner.plan("push-pull-fast", asked).stroke < 0.7 * planner.plan("docrime", asked).stroke


def test_shortened_frames_are_counted_before_they_happen() -> None:
    free = (*SMALL, "calibration.poke_command=1.0")
    with Bench.from_config(load_system("razor-shwfs", overrides=free)) as bench:
        limit = bench.dm.limits.max_stroke
        # A poke of which some frames, not all, pass the limit.
        poke = 0.02 * limit / float(np.quantile(np.abs(commands(bench, 0.02)).max(axis=1), 0.85))
        share = float((np.abs(commands(bench, poke)).max(axis=1) > limit).mean())
        told = ProcedurePlanner(bench).plan("docrime", {"frames": 400, "poke": poke})
    (warning,) = told.warnings
    assert "% of the frames" in warning
    assert 0.5 * share < float(warning.split()[1]) / 100 < 2 * share
    assert told.stroke <= limit
