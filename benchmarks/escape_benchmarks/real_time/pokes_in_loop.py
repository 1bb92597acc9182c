"""What pokes and their estimate cost a running loop: its latency with and without them, in turns."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.benchmark import BenchmarkRow
from escape_hw.api.procedure import run as run_procedure
from escape_hw.bench import Bench
from escape_hw.calibration.acquisition.pokes import RandomPokes, compute_poke_amplitudes
from escape_hw.calibration.docrime.estimator import DocrimeEstimator
from escape_hw.calibration.docrime.estimator_thread import EstimatorThread
from escape_hw.calibration.docrime.open_loop import docrime
from escape_hw.calibration.loop.control import build_integrator
from escape_hw.calibration.loop.runner import RunningLoop
from escape_hw.config.loader import load_system

SYSTEM = "razor-shwfs"
#: Poke of the closed loop, fraction of the stroke, as in the paper.
POKE = 0.002
#: Turns of each, and the frames of a turn.
ROUNDS, FRAMES = 6, 500


def run() -> list[BenchmarkRow]:
    """All rows of the stage."""
    with Bench.from_config(load_system(SYSTEM, overrides=("twin.paced=true",))) as bench:
        poked, unpoked, skipped = _measure_latencies(bench)
    rows = []
    for name, share in (("median", 50.0), ("99th percentile", 99.0)):
        ours, peer = float(np.percentile(poked, share)), float(np.percentile(unpoked, share))
        note = f"largest {poked.max():.0f} us against {unpoked.max():.0f} us; {skipped} frames skipped"
        stage = f"loop: latency with pokes and estimate, {name}"
        rows.append(BenchmarkRow(stage, ours, peer, "the same loop without them", "us", "lower", note))
    return rows


def _measure_latencies(bench: Bench) -> tuple[NDArray[np.float64], NDArray[np.float64], int]:
    """Microseconds from frame to command with and without pokes, and frames the estimate skipped."""
    start_calibration = run_procedure(docrime(bench, frames=1000))
    matrix, grid = start_calibration.matrix, start_calibration.grid
    loop = RunningLoop.prepare(bench, matrix, grid, build_integrator(bench, matrix, grid))
    pokes = RandomPokes(compute_poke_amplitudes(bench, matrix.m2c, POKE), bench.rng)
    estimator = DocrimeEstimator(matrix.n_slopes, matrix.n_modes, correlations=False, closed=True)
    poked: list[int] = []
    unpoked: list[int] = []
    with loop.closed(), EstimatorThread(estimator, blocking=False) as background_estimator:
        # The first stretches compile, close the loop, and fit the filter.
        run_procedure(loop.run(2 * FRAMES, inject=pokes, observe=(background_estimator,)))
        run_procedure(loop.run(2 * FRAMES, inject=pokes, observe=(background_estimator,)))
        for _ in range(ROUNDS):
            for which, options in (
                (unpoked, {}),
                (poked, {"inject": pokes, "observe": (background_estimator,)}),
            ):
                before = loop.record.frames
                run_procedure(loop.run(FRAMES, **options))  # type: ignore[arg-type]
                which += loop.record.latency[before:]
        background_estimator.finish()
        skipped = background_estimator.skipped
    return np.array(poked) / 1e3, np.array(unpoked) / 1e3, skipped
