"""What a second worker brings a sweep: loops per second with two against one, in turns."""

from __future__ import annotations

import tempfile
import time
from concurrent.futures import wait
from pathlib import Path

import numpy as np

from escape_hw.api.benchmark import BenchmarkRow
from escape_hw.bench import Bench
from escape_hw.config.load import load_system
from escape_hw.errors import ConfigError

#: Systems, and the frames of a loop on each.
SYSTEMS = {"razor-shwfs": 400, "razor-pywfs": 250}
#: Turns of each, and the loops of a turn.
ROUNDS, LOOPS = 3, 6


def run() -> list[BenchmarkRow]:
    """All rows of the stage; without Optuna there are none to measure."""
    from escape_hw.runtime.sweep.ask import need_optuna

    try:
        need_optuna()
    except ConfigError as error:
        return [BenchmarkRow("sweep", 0.0, None, "", "loop/s", "higher", str(error))]
    return [_row(system, frames) for system, frames in SYSTEMS.items()]


def _row(system: str, frames: int) -> BenchmarkRow:
    from escape_hw.runtime.sweep.trial import Task
    from escape_hw.runtime.sweep.workers import LocalWorkers

    with tempfile.TemporaryDirectory() as folder:
        task = _task(system, frames, Path(folder))
        values = {"gain": 0.4, "leak": 0.01, "dropped_modes": 14}
        pools = {count: LocalWorkers(count) for count in (1, 2)}
        rates: dict[int, list[float]] = {1: [], 2: []}
        try:
            for number in range(-1, ROUNDS):
                for count, pool in pools.items():
                    # Three loops share their air, as the matrices of a sweep do.
                    tasks = [
                        Task(*task, values, frames, seed // 3)
                        for seed in range(LOOPS * (number + 2), LOOPS * (number + 3))
                    ]
                    began = time.perf_counter()
                    wait([pool.submit(one) for one in tasks])
                    if number >= 0:
                        # The first turn starts and compiles.
                        rates[count].append(LOOPS / (time.perf_counter() - began))
        finally:
            for pool in pools.values():
                pool.close()
    two, one = (float(np.median(rates[count])) for count in (2, 1))
    note = f"{frames} frames each; a loop opens its twin, draws its air and closes"
    return BenchmarkRow(f"sweep: {system}", two, one, "the same with one worker", "loop/s", "higher", note)


def _task(system: str, frames: int, folder: Path) -> tuple[str, str, str, str]:
    """Configuration, matrix, its checksum, and model PSF."""
    from escape_hw.api.procedure import run as run_procedure
    from escape_hw.calibration.push_pull import push_pull
    from escape_hw.io.fits import save_matrix
    from escape_hw.io.provenance import sha256_of
    from escape_hw.runtime.procedures import model_psf
    from escape_hw.runtime.records import without_turbulence

    config = load_system(system)
    with Bench.from_config(config) as bench:
        with without_turbulence(bench):
            found = run_procedure(push_pull(bench, frames=2))
        image = run_procedure(model_psf(bench))
    matrix, psf = save_matrix(folder / "im.fits", found), folder / "psf.npy"
    np.save(psf, image)
    return config.to_toml(), str(matrix), sha256_of(matrix), str(psf)
