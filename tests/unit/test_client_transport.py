"""Endpoint of a client: requests without a reply."""

from __future__ import annotations

import json
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
import zmq

from escape_hw.errors import ClientUnknown, ServerFull, ServerGone
from escape_hw.remote.address import Endpoint
from escape_hw.remote.requests import error_to_document
from escape_hw.remote.transport import ClientTransport


def test_closing_ends_the_wait_for_a_reply(tmp_path: Path) -> None:
    endpoint = Endpoint(requests=f"ipc://{tmp_path}/requests", events=f"ipc://{tmp_path}/events")
    with zmq.Context() as context, context.socket(zmq.ROUTER) as silent, ThreadPoolExecutor(1) as pool:
        silent.bind(endpoint.requests)
        link = ClientTransport(endpoint, lambda *_: None, lambda _: None, lambda _: None)
        waiting = pool.submit(link.send_request, {"verb": "flatten"}, 60.0)
        silent.recv_multipart()
        link.close()
        with pytest.raises(ServerGone, match="connection is closed"):
            waiting.result(60)


def test_requests_that_a_server_took_with_it_do_not_wait(tmp_path: Path) -> None:
    """The server that follows does not know the client and refuses its heartbeats."""
    endpoint = Endpoint(requests=f"ipc://{tmp_path}/requests", events=f"ipc://{tmp_path}/events")
    beats = iter([None, *10 * [{"verb": "heartbeat"}]])
    with zmq.Context() as context, context.socket(zmq.ROUTER) as server, ThreadPoolExecutor(2) as pool:
        server.bind(endpoint.requests)
        link = ClientTransport(endpoint, lambda *_: None, lambda _: next(beats, None), lambda _: None)
        lost = pool.submit(link.send_request, {"verb": "plan"}, 60.0)
        client, number, _ = server.recv_multipart()
        assert number == b"1"
        heartbeat = server.recv_multipart()
        assert heartbeat[1] == b"h1"
        # Sent after the heartbeat: the server that follows will reply.
        later = pool.submit(link.send_request, {"verb": "hello"}, 60.0)
        while server.recv_multipart()[1] != b"2":
            pass
        # Without a free place, which requests for safety do not need, they are waited for.
        for error in (ServerFull("no free place"), ClientUnknown("not registered")):
            assert not lost.done()
            refusal = {"ok": False, "error": error_to_document(error)}
            server.send_multipart([client, b"h1", json.dumps(refusal).encode()])
        with pytest.raises(ServerGone, match="ended before it replied"):
            lost.result(60)
        server.send_multipart([client, b"2", json.dumps({"ok": True, "answer": 3}).encode()])
        assert later.result(60) == (3, b"", 0)
        link.close()
