"""Gain of a second worker in a sweep: loops per second with two against one, in turns.

Cores share caches, memory and, on a virtual machine, their host; so the same turns also show the gain of a
second process for arithmetic that shares nothing.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np

from escape_hw.api.benchmark import BenchmarkRow
from escape_hw.bench import Bench
from escape_hw.config.loader import load_system
from escape_hw.errors import ConfigError

#: Systems, and the frames of a loop on each.
SYSTEMS = {"razor-shwfs": 400, "razor-pywfs": 250}
#: Turns of each, and the loops of a turn.
ROUNDS, LOOPS = 5, 8
#: Rounds of the yardstick's arithmetic.
REFERENCE_ITERATIONS = 2_000_000


def run() -> list[BenchmarkRow]:
    """All rows of the stage; without Optuna there are none to measure."""
    from escape_hw.runtime.sweep.request import require_optuna

    try:
        require_optuna()
    except ConfigError as error:
        return [BenchmarkRow("sweep", 0.0, None, "", "loop/s", "higher", str(error))]
    return [_row(system, frames) for system, frames in SYSTEMS.items()]


def _row(system: str, frames: int) -> BenchmarkRow:
    from escape_hw.runtime.sweep.trials import TrialSpec, run_trial
    from escape_hw.runtime.sweep.workers import LocalWorkers

    with tempfile.TemporaryDirectory() as folder:
        task = _task(system, Path(folder))
        values = {"gain": 0.4, "leak": 0.01, "dropped_modes": 14}
        workers = {count: LocalWorkers(count) for count in (1, 2)}
        reference_pools = {count: ProcessPoolExecutor(count, get_context("spawn")) for count in (1, 2)}
        loops: dict[int, list[float]] = {1: [], 2: []}
        reference_rates: dict[int, list[float]] = {1: [], 2: []}
        try:
            for number in range(1 + ROUNDS):
                # Each loop draws its own turbulence: workers share nothing.
                seeds = range(LOOPS * number, LOOPS * (number + 1))
                for count in (1, 2):
                    tasks = [TrialSpec(*task, values, frames, seed) for seed in seeds]
                    loops[count].append(_rate(partial(workers[count].submit, run_trial), tasks))
                    reference_rates[count].append(
                        _rate(reference_pools[count].submit, [_reference_work] * LOOPS)
                    )
        finally:
            for pool in workers.values():
                pool.close()
            for reference_pool in reference_pools.values():
                reference_pool.shutdown(cancel_futures=True)
    # The first turn starts and compiles.
    two, one, both, single = (
        float(np.median(seen[1:])) for seen in (loops[2], loops[1], reference_rates[2], reference_rates[1])
    )
    note = (
        f"{frames} frames each; a loop opens its twin, draws its turbulence and closes; "
        f"bare arithmetic gains "
        f"{both / single:.2f} times from a second process here"
    )
    return BenchmarkRow(f"sweep: {system}", two, one, "the same with one worker", "loop/s", "higher", note)


def _rate(submit: Callable[[Any], Future[Any]], work: Sequence[Any]) -> float:
    began = time.perf_counter()
    for piece in [submit(piece) for piece in work]:
        # A loop that failed is no fast one.
        piece.result()
    return len(work) / (time.perf_counter() - began)


def _reference_work() -> float:
    """Arithmetic with negligible memory access."""
    total = 0.0
    for number in range(REFERENCE_ITERATIONS):
        total += number * number
    return total


def _task(system: str, folder: Path) -> tuple[str, str, str, str]:
    """Configuration, matrix, its checksum, and model PSF."""
    from escape_hw.api.procedure import run as run_procedure
    from escape_hw.calibration.push_pull.procedure import push_pull
    from escape_hw.io.fits.matrix import save_matrix
    from escape_hw.io.provenance import file_sha256
    from escape_hw.runtime.procedures.model_psf import model_psf
    from escape_hw.runtime.session.record import without_turbulence

    config = load_system(system)
    with Bench.from_config(config) as bench:
        with without_turbulence(bench):
            found = run_procedure(push_pull(bench, frames=2))
        image = run_procedure(model_psf(bench))
    matrix, psf = save_matrix(folder / "im.fits", found), folder / "psf.npy"
    np.save(psf, image)
    return config.to_toml(), str(matrix), file_sha256(matrix), str(psf)
