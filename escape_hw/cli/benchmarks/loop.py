"""What pokes and their estimate cost a running loop: its latency with and without them, in turns."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.benchmark import BenchmarkRow
from escape_hw.api.procedure import run as run_procedure
from escape_hw.bench import Bench
from escape_hw.calibration.background import BackgroundEstimator
from escape_hw.calibration.closed_loop import integrator_for
from escape_hw.calibration.docrime import docrime
from escape_hw.calibration.docrime_estimator import DocrimeEstimator
from escape_hw.calibration.loop_run import RunningLoop
from escape_hw.calibration.poke_patterns import RandomPokes
from escape_hw.calibration.sensor_setup import extractor, poke_amplitudes
from escape_hw.config.load import load_system

SYSTEM = "razor-shwfs"
#: Poke of the closed loop, fraction of the stroke, as in the paper.
POKE = 0.002
#: Turns of each, and the frames of a turn.
ROUNDS, FRAMES = 6, 500


def run() -> list[BenchmarkRow]:
    """All rows of the stage."""
    with Bench.from_config(load_system(SYSTEM, overrides=("twin.paced=true",))) as bench:
        poked, quiet, skipped = _latencies(bench)
    rows = []
    for name, share in (("median", 50.0), ("99th percentile", 99.0)):
        ours, peer = float(np.percentile(poked, share)), float(np.percentile(quiet, share))
        note = f"largest {poked.max():.0f} us against {quiet.max():.0f} us; {skipped} frames skipped"
        stage = f"loop: latency with pokes and estimate, {name}"
        rows.append(BenchmarkRow(stage, ours, peer, "the same loop without them", "us", "lower", note))
    return rows


def _latencies(bench: Bench) -> tuple[NDArray[np.float64], NDArray[np.float64], int]:
    """Microseconds from frame to command with and without pokes, and frames the estimate skipped."""
    closing = run_procedure(docrime(bench, frames=1000))
    matrix, grid = closing.matrix, closing.grid
    control = integrator_for(bench, matrix, grid)
    loop = RunningLoop(bench, matrix.m2c, extractor(bench, grid), control)
    pokes = RandomPokes(poke_amplitudes(bench, matrix.m2c, POKE), bench.rng)
    estimator = DocrimeEstimator(matrix.n_slopes, matrix.n_modes, correlations=False, closed=True)
    poked: list[int] = []
    quiet: list[int] = []
    try:
        with BackgroundEstimator(estimator, patient=False) as beside:
            # The first stretch compiles, closes the loop, and fits the filter.
            run_procedure(loop.run(2 * FRAMES, inject=pokes, observe=(beside,)))
            run_procedure(loop.run(2 * FRAMES, inject=pokes, observe=(beside,)))
            for _ in range(ROUNDS):
                for which, options in ((quiet, {}), (poked, {"inject": pokes, "observe": (beside,)})):
                    before = loop.record.frames
                    run_procedure(loop.run(FRAMES, **options))  # type: ignore[arg-type]
                    which += loop.record.latency[before:]
            beside.finish()
            skipped = beside.skipped
    finally:
        bench.dm.flatten()
    return np.array(poked) / 1e3, np.array(quiet) / 1e3, skipped
