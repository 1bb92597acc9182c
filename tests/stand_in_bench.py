"""A bench of simulated vendor libraries, whose mirror a test watches while processes use the real drivers."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import AbstractContextManager
from pathlib import Path

import pytest
from serving import Served, Spy, serving
from small_system import configuration

from escape_hw.io.fits.matrix import load_matrix
from escape_hw.remote.client import Connection
from escape_sim.devices.twins import shared_bench
from escape_sim.stand_ins import LIBRARIES, StandInUnavailable, build_library
from escape_sim.stand_ins.bench_server import StandInBenchServer

#: On the increments of the real camera.
REGION = "devices.wfs.region=[216,152,208,208]"
#: With a state kept often.
OPTIONS = (REGION, "calibration.checkpoint_s=0.3")


def require_libraries() -> None:
    """Skip where there is no compiler, and report it."""
    try:
        for name in LIBRARIES:
            build_library(name)
    except StandInUnavailable as reason:
        pytest.skip(str(reason))


def simulated_bench(*options: str) -> Iterator[tuple[StandInBenchServer, Spy]]:
    """The simulated bench, in this process, and what its mirror really does."""
    require_libraries()
    server = StandInBenchServer(configuration(*options))
    spy = Spy(shared_bench(server.config, server.shared))
    with server:
        yield server, spy


@pytest.fixture
def bench() -> Iterator[tuple[StandInBenchServer, Spy]]:
    """The simulated bench that the server's real drivers reach."""
    yield from simulated_bench(*OPTIONS)


def on_metal(system: Path, server: StandInBenchServer, folder: Path) -> AbstractContextManager[Served]:
    options = [word for option in OPTIONS for word in ("--set", option)]
    return serving(system, "--mode", "hardware", *options, folder=folder, more=server.environment)


def whole(folder: Path) -> None:
    """Every product that is there can be read; no temporary file is left."""
    for path in (folder / "data").rglob("*.fits"):
        load_matrix(path)


def guarded(client: Connection) -> bool:
    """Whether the fault says that the fail-safe process has flattened the mirror."""
    return client.state.fault is not None and "the mirror is flat" in client.state.fault.reason
