"""Memory, descriptors and shared memory of every process of a server stay constant."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from serving import SYSTEM, Served, serving, until_idle, wait_for

from escape_hw.remote.client import Connection, connect
from escape_hw.streams.segments import segments

PORT = 25000 + os.getpid() % 4000
_PAGE = os.sysconf("SC_PAGE_SIZE")


def resources(pid: int) -> tuple[int, int, int]:
    """Resident memory in bytes, descriptors, and mappings of shared memory of a process."""
    process = Path(f"/proc/{pid}")
    resident = int((process / "statm").read_text().split()[1]) * _PAGE
    mapped = sum("/dev/shm/" in line for line in (process / "maps").read_text().splitlines())
    return resident, len(list((process / "fd").iterdir())), mapped


def slope(times: list[float], values: list[float]) -> float:
    """Median slope over all pairs of samples (Theil-Sen): single steps, such as a cache, do not count."""
    t, v = np.array(times), np.array(values)
    first, second = np.triu_indices(len(t), len(t) // 3)
    return float(np.median((v[second] - v[first]) / (t[second] - t[first])))


def work(bench: Connection, served: Served) -> None:
    """What clients do over hours: connect, look, leave, record."""
    with served.connect() as visitor, connect(f"tcp://127.0.0.1:{PORT}") as far:
        for _ in range(5):
            visitor.latest("frames")
            far.latest("frames")
            far.latest("psf")
        visitor.log_after(-1)
    bench.set_loop(gain=0.3)


#: The sensor is read, and the science camera runs unread.
IDLE = """
import sys
from escape_hw.runtime.session.system import open_system
with open_system(sys.argv[1]) as bench:
    bench.science.start()
    while True:
        bench.wfs.next_frame(1.0)
"""


@contextmanager
def idle_twin(system: Path) -> Iterator[int]:
    """A process with an idle loop on the twin; yields its number."""
    with subprocess.Popen([sys.executable, "-c", IDLE, str(system)]) as process:
        try:
            yield process.pid
            assert process.poll() is None
        finally:
            process.kill()


def soak(system: Path, folder: Path, warm_up_s: float, seconds: float, limit_bytes_per_s: float) -> None:
    """Run a closed loop with clients for some time, and check the slope of every process."""
    options = ("--set", "twin.paced=true", "--port", PORT)
    with (
        idle_twin(system) as twin,
        serving(system, *options, folder=folder) as served,
        served.connect(control=True) as bench,
    ):
        until_idle(bench)
        bench.calibrate("docrime", frames=1000)
        until_idle(bench)
        bench.close_loop("docrime-1", gain=0.3)
        wait_for(lambda: bench.state.loop.closed, "the loop is closed")
        processes = sorted({twin, served.pid, *served.engines()})
        assert len(processes) > 3
        times: list[float] = []
        shared: list[int] = []
        samples: list[list[tuple[int, int, int]]] = []
        began = time.monotonic()
        while (now := time.monotonic() - began) < warm_up_s + seconds:
            work(bench, served)
            if now > warm_up_s:
                times.append(now)
                shared.append(len(segments(SYSTEM)))
                samples.append([resources(pid) for pid in processes])
            time.sleep(min(1.0, seconds / 40))
        assert bench.state.loop.closed
        assert bench.state.fault is None
    values = np.array(samples)  # (samples, processes, resources)
    for k, pid in enumerate(processes):
        growth = slope(times, list(values[:, k, 0]))
        print(f"process {pid}: {growth:.0f} B/s, {values[0, k, 1:]} -> {values[-1, k, 1:]}")
        assert growth < limit_bytes_per_s, f"the memory of process {pid} grows by {growth:.0f} B/s"
        # Descriptors of a visitor that leaves are closed a moment later.
        for number, name in ((1, "descriptors"), (2, "shared memory")):
            early, late = (part.max() for part in np.array_split(values[:, k, number], 2))
            assert late <= early + 4, f"{name} of process {pid}: {early}, later {late}"
    assert shared[-1] <= shared[0]


@pytest.mark.slow
def test_nothing_grows_within_seconds(system: Path, tmp_path: Path) -> None:
    soak(system, tmp_path, warm_up_s=6, seconds=6, limit_bytes_per_s=500e3)


@pytest.mark.campaign
@pytest.mark.timeout(1200)
def test_nothing_grows_within_ten_minutes(system: Path, tmp_path: Path) -> None:
    soak(system, tmp_path, warm_up_s=60, seconds=600, limit_bytes_per_s=20e3)
