"""The plan of a procedure before it starts."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from small_system import SMALL

from escape_gui.views.procedure_form import comparison_lines, plan_lines
from escape_hw.api.procedure import run
from escape_hw.bench import Bench
from escape_hw.calibration.acquisition.pokes import RandomPokes, compute_poke_amplitudes
from escape_hw.calibration.docrime.open_loop import docrime
from escape_hw.calibration.modes.bases import build_modal_basis
from escape_hw.calibration.push_pull.modulation import modulation_demodulation
from escape_hw.config.loader import load_system
from escape_hw.io.documents import calibration_document
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


@pytest.mark.parametrize(
    ("limits", "poke"),
    [
        (("devices.dm.limits.max_slew=0.2",), 0.005),
        pytest.param(("devices.dm.limits.max_neighbour=0.25",), 0.005, marks=pytest.mark.slow),
        (("calibration.poke_command=1.0",), 0.02),
    ],
    ids=["slew", "neighbours", "stroke"],
)
def test_the_share_of_clipped_pokes_is_that_of_the_run(limits: tuple[str, ...], poke: float) -> None:
    with Bench.from_config(load_system("razor-shwfs", overrides=(*SMALL, *limits))) as bench:
        plan = ProcedurePlanner(bench).plan("docrime", {"frames": 600, "poke": poke})
        result = run(docrime(bench, frames=600, poke=poke))
    share = result.matrix.metrics["clipped_pokes"] / 600
    assert 0.02 < share < 0.98, "some pokes are clipped, not all"
    (warning,) = plan.warnings
    assert "pokes clipped" in warning
    assert float(warning.split()[1]) / 100 == pytest.approx(share, abs=0.08)
    assert calibration_document(result)["clipped_pokes"] == result.matrix.metrics["clipped_pokes"]
    assert plan.stroke <= bench.config.devices.dm.limits.max_stroke * (1 + 1e-12)


def test_the_plan_of_the_gains_says_that_their_rounds_are_an_estimate(bench: Bench) -> None:
    plan = ProcedurePlanner(bench).plan("gains", {"im": "im", "frames": 200})
    assert "several times as many" in plan.warnings[-1]


def test_the_model_psf_takes_the_time_of_the_science_camera(bench: Bench) -> None:
    plan = ProcedurePlanner(bench).plan("model-psf", {"frames": 20})
    assert bench.science is not None
    assert plan.seconds == pytest.approx(20 / bench.science.settings.frame_rate_hz, rel=0.05)


def test_frames_of_a_plan_are_those_of_its_preparation_and_of_the_result(bench: Bench) -> None:
    plan = ProcedurePlanner(bench).plan("modulated", {"frames": 300})
    result = run(modulation_demodulation(bench, frames=300))
    assert plan.preparation_frames == 200
    assert plan.frames == 200 + result.frames + result.lost_frames
    first = plan_lines(plan, simulated=True)[0]
    assert first.startswith(f"{plan.frames} sensor frames, 200 of them to prepare; ")
    measured = comparison_lines(calibration_document(result), None)[-1]
    assert measured.startswith(f"Frames measured: {result.frames}, ")


def test_a_push_pull_prepares_with_set_up_and_test_step(bench: Bench) -> None:
    plan = ProcedurePlanner(bench).plan("push-pull", {"frames": 3})
    assert plan.preparation_frames == 240
    assert plan.frames == 240 + 30 * 2 * (3 + 2)


def test_a_loop_prepares_with_the_model_psf(bench: Bench) -> None:
    planner, frames = ProcedurePlanner(bench), {"frames": 500}
    psf = planner.plan("model-psf", {"frames": 20}).frames
    plan = planner.plan("loop", {**frames, "strehl": True})
    assert (plan.frames, plan.preparation_frames) == (500 + psf, psf)
    assert planner.plan("loop", {**frames, "strehl": False}).preparation_frames == 0
