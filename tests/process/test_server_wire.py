"""Misbehaving clients: invalid, too many or partial messages, sudden ends. The server continues."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import time
import uuid
from collections.abc import Iterator
from pathlib import Path

import pytest
import zmq
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from running import ESCAPE
from serving import SYSTEM, Served, serving, until_idle, wait_for

from escape_hw.errors import ConfigError, ServerGone
from escape_hw.remote import keys
from escape_hw.remote.address import resolve
from escape_hw.remote.client import Connection, connect
from escape_hw.remote.state import SCHEMA, Phase

#: Below those that the kernel gives to whoever asks for any.
PORT = 29000 + os.getpid() % 3500


@pytest.fixture(scope="module")
def served(system: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    folder = tmp_path_factory.mktemp("served")
    with serving(system, "--port", PORT, folder=folder) as one:
        yield one


@pytest.fixture(scope="module")
def bench(served: Served) -> Iterator[Connection]:
    with served.connect(control=True) as one:
        until_idle(one)
        yield one


@pytest.fixture
def raw(bench: Connection) -> Iterator[zmq.Socket[bytes]]:
    """A socket that may say anything."""
    with zmq.Context() as context, context.socket(zmq.DEALER) as one:
        one.setsockopt(zmq.LINGER, 0)
        one.connect(resolve(SYSTEM).requests)
        yield one


def answer(raw: zmq.Socket[bytes]) -> dict:
    assert raw.poll(30_000), "no answer"
    return json.loads(raw.recv_multipart()[-1])


@given(parts=st.lists(st.binary(max_size=300), min_size=1, max_size=5))
@settings(max_examples=100, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_garbage_is_refused_and_counted(raw: zmq.Socket[bytes], parts: list[bytes]) -> None:
    raw.send_multipart(parts)
    reply = answer(raw)
    assert reply["ok"] is False
    assert reply["error"]["type"] == "RequestRefused"


@given(
    document=st.recursive(
        st.none()
        | st.booleans()
        | st.floats()
        | st.text(max_size=10)
        | st.sampled_from(["start_procedure", "hello"]),
        lambda inner: (
            st.lists(inner, max_size=3)
            | st.dictionaries(
                st.sampled_from(["verb", "client", "procedure", "arguments", "x"]), inner, max_size=4
            )
        ),
        max_leaves=8,
    )
)
@settings(max_examples=100, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_documents_that_are_no_requests_are_refused(raw: zmq.Socket[bytes], document: object) -> None:
    raw.send_multipart([b"1", json.dumps(document).encode()])
    assert answer(raw)["ok"] is False


def test_what_is_too_large_is_refused_or_cut_off(raw: zmq.Socket[bytes], bench: Connection) -> None:
    before = bench.state.refused_requests
    raw.send_multipart([b"1", b"x" * 100_000])
    reply = answer(raw)
    assert reply["error"]["message"].endswith("100000 bytes; a request has at most 65536")
    raw.send_multipart([b"2", b"x" * 50_000_000])
    # The connection was cut; the next request comes over a new one.
    raw.send_multipart([b"3", b"{}"])
    assert answer(raw)["ok"] is False
    wait_for(lambda: bench.state.refused_requests >= before + 2, "refusals are counted")
    assert bench.state.fault is None


def test_a_client_that_is_not_registered_is_refused(raw: zmq.Socket[bytes], bench: Connection) -> None:
    request = {"verb": "acquire_lease", "client": bench.client}
    raw.send_multipart([b"1", json.dumps(request).encode()])
    assert "not registered under that client number" in answer(raw)["error"]["message"]
    hello = {
        "verb": "hello", "client": bench.client, "schema_version": SCHEMA, "name": "x", "host": "y", "pid": 1,
    }  # fmt: skip
    raw.send_multipart([b"2", json.dumps(hello).encode()])
    assert "belongs to another connection" in answer(raw)["error"]["message"]
    for version in (1, 99):
        other = {**hello, "client": "0" * 8, "schema_version": version}
        raw.send_multipart([b"3", json.dumps(other).encode()])
        assert f"the client version {version}; use the same version" in answer(raw)["error"]["message"]


def test_a_client_that_was_removed_registers_again(served: Served, bench: Connection) -> None:
    with served.connect() as late:
        # For the server, a removed number is the same as an unknown one.
        late.client = str(uuid.uuid4())
        assert late.procedures()
        wait_for(lambda: bench.state.clients >= 2, "both count")
        before = bench.state.clients
        late.client = str(uuid.uuid4())
        # It sends no request: its heartbeat alone registers it.
        wait_for(lambda: bench.state.clients > before, "it is counted")


def test_slow_and_half_messages_on_a_plain_socket_stop_nothing(bench: Connection) -> None:
    lines = []
    for opening in (b"GET / HTTP/1.1\r\n\r\n", b"\xff\0\0\0\0\0\0\0\x01\x7f", b"\xff"):
        one = socket.create_connection(("127.0.0.1", PORT))
        one.sendall(opening)
        lines.append(one)
    for _ in range(5):
        for one in lines:
            try:
                one.sendall(b"\x03")
            except OSError:
                continue  # cut off, as it should be
        assert bench.plan("docrime", {"frames": 500}).frames == 500
    for one in lines:
        one.close()


def test_a_flood_leaves_the_server_to_others(raw: zmq.Socket[bytes], bench: Connection) -> None:
    for _ in range(20_000):
        raw.send_multipart([b"1", b"nonsense"])  # replies are not read
    began = bench.state.serial
    assert bench.plan("docrime", {"frames": 500}).frames == 500
    wait_for(lambda: bench.state.serial > began + 3, "states go on")


CLIENT = """
import sys, time
from escape_hw.remote.client import connect
with connect(sys.argv[1]) as bench:
    frame, seen = -1, 0
    while True:
        sample = bench.latest("frames", frame)
        if sample is not None:
            frame, seen = sample.index, seen + 1
            if seen == 3:
                print("looking", flush=True)
        time.sleep(0.005)
"""


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP])
def test_a_client_that_ends_or_hangs_is_not_noticed_by_the_loop(
    served: Served, bench: Connection, number: int
) -> None:
    if not bench.state.products:
        bench.calibrate("docrime", frames=1000)
    bench.close_loop(bench.state.products[-1].name)
    with subprocess.Popen(
        [sys.executable, "-c", CLIENT, SYSTEM], env=served.environment, stdout=subprocess.PIPE
    ) as client:
        assert client.stdout is not None
        assert client.stdout.readline() == b"looking\n"
        before = bench.state.rates.frames
        client.send_signal(number)
        wait_for(lambda: bench.state.rates.frames > before + 100, "the loop goes on")
        began = time.monotonic()
        with served.connect() as again:
            again.latest("frames")
            seconds = time.monotonic() - began
        client.kill()
    assert bench.state.loop.closed
    assert bench.state.fault is None
    assert seconds < 20, "to look again takes two seconds at most on an idle machine"
    bench.open_loop()
    wait_for(lambda: bench.state.phase is Phase.IDLE, "idle")


def test_on_another_computer_the_samples_come_through_requests(bench: Connection) -> None:
    with connect(f"tcp://127.0.0.1:{PORT}") as far:
        wait_for(lambda: far.latest("frames") is not None, "a frame")
        sample = far.latest("frames")
        assert sample is not None
        assert sample.data.shape == (200, 200)
        assert sample.meta["full_scale"] == 1023
        assert far.geometry().n_modes == 30
        with pytest.raises(ConfigError):
            far.plan("nothing")
        wait_for(lambda: far.connected and far.state.serial > 1, "events")


@pytest.mark.slow
def test_without_a_server_none_is_found(served: Served, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", served.environment["XDG_RUNTIME_DIR"])
    with pytest.raises(
        ServerGone, match=r"no server of 'elsewhere' runs here .*start one with 'escape serve"
    ):
        connect("elsewhere")
    with pytest.raises(ConfigError, match="is no address"):
        connect("http://127.0.0.1:80")
    with pytest.raises(ServerGone, match=r"tcp://127\.0\.0\.1:9: no reply to 'hello'"):
        connect("tcp://127.0.0.1:9")


@pytest.fixture
def homes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[Path, Path]:
    """Key folders of the server and of the client; the latter is that of this process."""
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "client"))
    return tmp_path / "server", tmp_path / "client"


def escape_keys(home: Path, *words: str) -> dict:
    """``escape keys`` as a user with that home types it."""
    environment = {**os.environ, "XDG_CONFIG_HOME": str(home)}
    command = [*ESCAPE, "keys", *words, "--json"]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


@pytest.mark.slow
def test_with_keys_from_another_machine_and_nothing_without(
    system: Path, homes: tuple[Path, Path], tmp_path: Path
) -> None:
    running_servers, clients = homes
    port = PORT + 10
    address = f"tcp://127.0.0.2:{port}"
    server, client = (escape_keys(home, "make")["public"].encode() for home in homes)
    escape_keys(running_servers, "allow", "client", client.decode())
    more = {"XDG_CONFIG_HOME": str(running_servers)}
    with (
        serving(system, "--port", port, "--bind", "0.0.0.0", folder=tmp_path / "s", more=more) as served,
        served.connect() as local,
    ):
        until_idle(local)
        with pytest.raises(ServerGone, match=r"If it requires keys: escape keys trust 127\.0\.0\.2 KEY"):
            connect(address)
        escape_keys(clients, "trust", "127.0.0.2", server.decode())
        with connect(address, control=True) as far:
            wait_for(lambda: far.latest("frames") is not None, "a frame")
            assert far.plan("docrime", {"frames": 300}).frames == 300
            wait_for(lambda: far.state.serial > 1 and far.holds_lease, "events")
        secret = keys.own_keys().secret
        stranger = zmq.curve_keypair()
        for public, hidden, other in (
            (*stranger, server),  # a key that is not allowed
            (client, secret, stranger[0]),  # the wrong server
            (None, None, None),  # no key at all
        ):
            assert heard(address, public, hidden, other) == 0
        # Whom the operator lets in is in at once, and out again.
        escape_keys(running_servers, "allow", "stranger", stranger[0].decode())
        wait_for(lambda: heard(address, *stranger, server) > 0, "the unknown client is allowed")
        escape_keys(running_servers, "remove", "stranger")
        assert heard(address, *stranger, server) == 0
        escape_keys(running_servers, "remove", "client")
        with pytest.raises(
            ServerGone, match=r"Check that it allows this key \(there: escape keys allow NAME"
        ):
            connect(address)
        assert local.state.fault is None


def heard(address: str, public: bytes | None, secret: bytes | None, server: bytes | None) -> int:
    """Messages that a client with these keys gets in a while, asking and listening."""
    host, _, port = address.rpartition(":")
    with zmq.Context() as context:
        asking, listening = context.socket(zmq.DEALER), context.socket(zmq.SUB)
        listening.setsockopt(zmq.SUBSCRIBE, b"")
        for one, at in ((asking, address), (listening, f"{host}:{int(port) + 1}")):
            one.setsockopt(zmq.LINGER, 0)
            if public is not None:
                one.curve_publickey, one.curve_secretkey, one.curve_serverkey = public, secret, server
            one.connect(at)
        asking.send_multipart([b"1", b"{}"])
        poller = zmq.Poller()
        poller.register(asking, zmq.POLLIN)
        poller.register(listening, zmq.POLLIN)
        found = len(poller.poll(1000))
        asking.close()
        listening.close()
    return found
