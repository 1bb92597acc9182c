"""Real drivers on the simulated bench: the same measurements as with the twin's devices."""

from __future__ import annotations

import itertools
import os
import socket
import struct
import threading
from collections.abc import Iterator
from unittest.mock import patch

import numpy as np
import pytest
from driver_bench import stand_in
from hypothesis import given, settings
from hypothesis import strategies as st
from small_system import SMALL

from escape_hw.api.camera import Region
from escape_hw.config.loader import load_system
from escape_hw.errors import DeviceError, DeviceLost
from escape_hw.runtime.session.record import BenchRecord
from escape_hw.runtime.session.system import System
from escape_sim.stand_ins import bench_server
from escape_sim.stand_ins.bench_server import RequestKind, StandInBenchServer

#: The region lies on the increments of the real camera; the screen of the real bench is moved by hand.
JOINED = (
    *SMALL,
    "devices.wfs.region=[216,152,208,208]",
    'devices.screen.sim_driver=""',
    "twin.loss_probability=0.01",
)


@pytest.fixture
def server() -> Iterator[StandInBenchServer]:
    for name in ("asdk", "m3api", "aravis"):
        stand_in(name).clear(record=False)
    with (
        StandInBenchServer(load_system("razor-shwfs", overrides=JOINED)) as one,
        patch.dict(os.environ, one.environment),
    ):
        yield one


def system(mode: str, *more: str) -> System:
    return System.from_config(load_system("razor-shwfs", mode=mode, overrides=(*JOINED, *more)))


def test_real_drivers_calibrate_and_close_the_loop_as_the_twins_devices_do(server) -> None:
    results = {}
    for mode in ("hardware", "sim"):
        with system(mode) as bench:
            assert bench.simulated, "behind a stand-in there is no metal"
            assert BenchRecord.from_bench(bench).injected is not None, "drivers apply [twin] too"
            found = bench.calibrate("docrime", frames=300)
            run = bench.close_loop(found.matrix, found.grid, frames=60)
            results[mode] = found.matrix.data, bench.wfs.status(), run
            assert run.stable
            assert not bench.dm.shape.any()
    through_drivers, twin = results["hardware"], results["sim"]
    assert np.array_equal(through_drivers[0], twin[0]), "not one bit of the matrix depends on the way"
    assert through_drivers[1].lost == twin[1].lost
    assert server.requests[RequestKind.SEND] > 300
    for name in ("asdk", "m3api", "aravis"):
        assert not stand_in(name).violations


def test_real_drivers_obey_flips_numbering_and_polarity() -> None:
    """The bench is turned behind the stand-ins; the keys of the devices undo it for their drivers."""
    for name in ("asdk", "m3api", "aravis"):
        stand_in(name).clear(record=False)
    keys = {
        "wfs.flip": "turn-90", "science.flip": "up-down", "mirror.order": "transpose", "mirror.polarity": -1
    }  # fmt: skip
    true = [f"twin.{key}={value}" for key, value in keys.items()]
    described = [f"devices.{key}={value}".replace("mirror", "dm") for key, value in keys.items()]
    with system("sim") as bench:
        straight = bench.calibrate("docrime", frames=100).matrix.data, bench.science.next_frame().data
    turned = load_system("razor-shwfs", overrides=(*JOINED, *true))
    with (
        StandInBenchServer(turned) as server,
        patch.dict(os.environ, server.environment),
        system("hardware", *described) as bench,
    ):
        through_drivers = bench.calibrate("docrime", frames=100).matrix.data, bench.science.next_frame().data
    for one, other in zip(through_drivers, straight, strict=True):
        assert np.array_equal(one, other)


def test_the_science_camera_sees_the_same_beam(server) -> None:
    with system("hardware") as bench:
        first = bench.science.next_frame(1.0)
        for _ in range(3):
            assert bench.science.poll() is None, "its exposure takes ten frames of the sensor"
            bench.wfs.next_frame(1.0)
        assert first.data.shape == (128, 128)
        assert first.data.max() > 3 * np.median(first.data), "the light of a star, not a test picture"
        assert bench.science.next_frame(1.0).index == first.index + 1


def test_a_wrong_serial_number_is_not_on_the_bench(server) -> None:
    overrides = (*JOINED, "devices.dm.serial=BAX118")
    with pytest.raises(DeviceError, match="error 0x24"):
        System.from_config(load_system("razor-shwfs", mode="hardware", overrides=overrides)).open()


def test_a_bench_that_goes_away_is_a_lost_device(server) -> None:
    bench = system("hardware").open()
    bench.wfs.next_frame(1.0)
    server.stop()
    with pytest.raises(DeviceLost, match="error 0x101"):
        bench.dm.send(bench.dm.flat)
    with pytest.raises(DeviceLost, match="xiGetImage"):
        bench.wfs.next_frame(1.0)
    with pytest.raises(DeviceLost):
        bench.close()
    assert not any(device.is_open for device in bench.devices)


@pytest.mark.parametrize(
    "nonsense",
    [
        b"",
        b"\x01",
        b"\xff" * 8,
        b"\x09\0\0\0\0\0\0\0",
        b"\x02\0\0\0\x08\0\0\0" + b"\0" * 8,
        b"\x01\0\0\0\x04\0\0\0abcd",
    ],
)
def test_invalid_bytes_on_the_socket_disturb_no_other_client(server, nonsense) -> None:
    with system("hardware") as bench:
        with socket.socket(socket.AF_UNIX) as stranger:
            stranger.connect(server.environment["ESCAPE_STAND_IN_BENCH"])
            stranger.sendall(nonsense)
        assert bench.wfs.next_frame(1.0).data.any()
        bench.dm.send(bench.dm.flat)
    assert threading.active_count() < 50


@settings(max_examples=50, deadline=None)
@given(
    st.lists(st.tuples(st.sampled_from(list(RequestKind)), st.binary(max_size=300)), min_size=1, max_size=5),
    st.lists(st.integers(1, 400), min_size=1),
    st.integers(0, 50),
)
def test_requests_arrive_whole_or_not_at_all(requests, cuts, missing) -> None:
    stream = b"".join(struct.pack("=II", verb, len(payload)) + payload for verb, payload in requests)
    stream = stream[: len(stream) - missing]
    near, far = socket.socketpair()
    with near, far:

        def deliver() -> None:
            at = 0
            for size in itertools.cycle(cuts):
                if at >= len(stream):
                    break
                near.sendall(stream[at : at + size])
                at += size
            near.shutdown(socket.SHUT_WR)

        sender = threading.Thread(target=deliver)
        sender.start()
        received = list(iter(lambda: bench_server._receive(far), None))
        sender.join()
    assert received == requests[: len(received)]
    whole = list(itertools.accumulate(8 + len(payload) for _, payload in requests))
    assert len(received) == sum(end <= len(stream) for end in whole)


@pytest.mark.slow
def test_a_genicam_camera_is_the_sensor_of_revolt() -> None:
    changes = (
        "basis.n_modes=20", "calibration.sprint_modes=20", "loop.dropped_modes=0", "calibration.poke=0.02",
        'devices.science.sim_driver=""',
    )  # fmt: skip
    for name in ("asdk", "aravis"):
        stand_in(name)
    config = load_system("revolt-shwfs", overrides=changes)
    with StandInBenchServer(config) as one, patch.dict(os.environ, one.environment):
        for name in ("asdk", "aravis"):
            stand_in(name).clear(record=False)
        hardware = load_system("revolt-shwfs", mode="hardware", overrides=changes)
        with System.from_config(hardware) as bench:
            assert bench.wfs.info.model.startswith("C-BLUE One")
            assert bench.wfs.settings.region == Region(626, 376, 352, 352)
            found = bench.calibrate("docrime", frames=200)
        assert found.grid.n_valid == 188
        assert not stand_in("aravis").violations
    stand_in("aravis").clear(record=False)
