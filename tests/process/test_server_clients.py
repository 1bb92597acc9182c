"""Clients that do not read, that never say goodbye, or that come in too large a number."""

from __future__ import annotations

import json
import os
import uuid
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest
import zmq
from serving import SYSTEM, Served, serving, until_idle, wait_for

from escape_hw.errors import ServerFull
from escape_hw.remote.address import resolve
from escape_hw.remote.client import Connection, connect
from escape_hw.remote.state import SCHEMA
from escape_hw.server.frontend.lease import MAX_CLIENTS

PORT = 22000 + os.getpid() % 2500


@pytest.fixture(scope="module")
def served(system: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    with serving(system, "--port", PORT, folder=tmp_path_factory.mktemp("served")) as one:
        yield one


@pytest.fixture
def bench(served: Served) -> Iterator[Connection]:
    with served.connect(control=True) as one:
        until_idle(one)
        yield one


def hello(client: str) -> bytes:
    fields = {"verb": "hello", "schema_version": SCHEMA, "name": "raw", "host": "here", "pid": 1}
    return json.dumps({**fields, "client": client}).encode()


def has_place(client: Connection) -> bool:
    try:
        return client.plan("docrime", {"frames": 500}).frames == 500
    except ServerFull:
        return False


def memory(pid: int) -> int:
    return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


@pytest.mark.parametrize("address", ["local", f"tcp://127.0.0.1:{PORT}"], ids=["local", "tcp"])
@pytest.mark.slow
def test_a_client_that_floods_and_never_reads_stops_nothing(
    served: Served, bench: Connection, address: str
) -> None:
    front, before = served.front, memory(served.front)
    wait_for(lambda: bench.latest("frames") is not None, "a frame")
    requests = resolve(SYSTEM if address == "local" else address).requests
    for _ in range(2):
        with zmq.Context() as context, ExitStack() as stack:
            for _ in range(8):
                raw = stack.enter_context(context.socket(zmq.DEALER))
                for option, value in ((zmq.LINGER, 0), (zmq.SNDHWM, 0), (zmq.RCVHWM, 1)):
                    raw.setsockopt(option, value)
                raw.connect(requests)
                client = str(uuid.uuid4())
                raw.send_multipart([b"1", hello(client)])
                document = {"verb": "latest_sample", "client": client, "stream": "frames"}
                request = json.dumps(document).encode()
                for _ in range(5_000):
                    raw.send_multipart([b"2", request])
            # Others are served meanwhile, between requests of those that do not read.
            for _ in range(50):
                assert bench.plan("docrime", {"frames": 500}).frames == 500
        # A connection that failed is found by a timer.
        wait_for(lambda: memory(front) - before < 100e6, "what waited for the clients is dropped")
    assert bench.connected
    assert served.front == front
    assert bench.plan("docrime", {"frames": 500}).frames == 500
    assert "not read" in served.log.read_text() or any("not read" in one.text for one in bench.log_after(-1))


@pytest.mark.slow
def test_clients_that_leave_free_their_places(bench: Connection) -> None:
    for _ in range(MAX_CLIENTS + 10):
        with connect(SYSTEM) as one:
            assert one.connected
    assert bench.plan("docrime", {"frames": 500}).frames == 500


@pytest.mark.slow
def test_safety_requests_work_beyond_the_limit_and_silent_clients_lose_their_places(
    bench: Connection,
) -> None:
    with zmq.Context() as context, context.socket(zmq.DEALER) as raw:
        raw.setsockopt(zmq.LINGER, 0)
        raw.connect(resolve(SYSTEM).requests)
        for _ in range(MAX_CLIENTS + 1):
            raw.send_multipart([b"1", hello(str(uuid.uuid4()))])
            assert raw.poll(10_000)
            reply = json.loads(raw.recv_multipart()[1])
        assert reply["error"]["type"] == "ServerFull"
        bench.start("docrime", frames=10_000_000)
        wait_for(lambda: bench.state.mirror.peak > 0, "pokes")
        # An own connection that never registered.
        for verb in ("abort_procedure", "open_loop", "flatten"):
            request = {"verb": verb, "client": str(uuid.uuid4())}
            raw.send_multipart([b"2", json.dumps(request).encode()])
            assert raw.poll(30_000)
            assert json.loads(raw.recv_multipart()[1])["ok"]
        wait_for(lambda: bench.state.mirror.peak == 0, "a flat mirror")
        until_idle(bench)
        run = bench.start("docrime", frames=10_000_000)
        wait_for(lambda: bench.state.mirror.peak > 0, "pokes")
        with connect(SYSTEM) as late:
            with pytest.raises(ServerFull, match="work without registration"):
                late.plan("docrime", {"frames": 500})
            late.abort()
            wait_for(lambda: run.ended is not None, "the end of the run")
            assert bench.state.mirror.peak == 0
            # The silent ones are removed.
            assert wait_for(lambda: has_place(late), "a free place") < 30


@pytest.mark.slow
def test_a_client_of_another_computer_gets_the_log_of_a_restarted_server(
    system: Path, tmp_path: Path
) -> None:
    # A server takes two ports in a row; the one of this file is on the first two.
    words, address = (system, "--port", PORT + 2), f"tcp://127.0.0.1:{PORT + 2}"
    with serving(*words, folder=tmp_path) as served, served.connect() as local:
        until_idle(local)
        with connect(address) as remote:
            until_idle(remote)
            first = remote.state.server_pid
            served.stop()
            before = remote.log_after(-1)[-1].number
            served.start()
            wait_for(lambda: remote.state.server_pid != first, "the other server")
            until_idle(remote)
            wait_for(lambda: any("devices open" in line.text for line in remote.log_after(before)), "its log")
