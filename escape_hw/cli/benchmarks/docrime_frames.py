"""Frames per second of a whole DO-CRIME run on the twin, against the rate of the bench it stands for."""

from __future__ import annotations

import time

from escape_hw.api.benchmark import BenchmarkRow
from escape_hw.api.procedure import run as drive
from escape_hw.bench import Bench
from escape_hw.calibration.docrime import docrime_run
from escape_hw.config.load import load_system

_SYSTEM = "razor-shwfs"
#: Frames timed, so many that finding the grid and solving weigh little; and those of the paper's LONG run.
N_FRAMES, _LONG = 3000, 100_000


def frames_row() -> BenchmarkRow:
    """Commands, turbulence, mirror, sensor, camera, slopes and estimator, as in ``escape calibrate``."""
    config = load_system(_SYSTEM)
    with Bench.from_config(config).open() as bench:
        # Compiles and fills what later runs find ready.
        drive(docrime_run(bench, frames=N_FRAMES // 2))
        start = time.perf_counter()
        taken = drive(docrime_run(bench, frames=N_FRAMES)).solution
        seconds = time.perf_counter() - start
    rate = (taken.frames + taken.lost_frames) / seconds
    note = (
        f"{N_FRAMES} frames from the grid to the matrix, noise's covariance included; "
        f"{_LONG} take {_LONG / rate:.0f} s at this rate"
    )
    peer = config.devices.wfs.frame_rate_hz
    stage = f"docrime: {_SYSTEM} DO-CRIME run, frames per second"
    return BenchmarkRow(stage, rate, peer, "the bench itself", "frame/s", "higher", note)
