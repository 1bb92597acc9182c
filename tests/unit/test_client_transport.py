"""Endpoint of a client: requests without a reply."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
import zmq

from escape_hw.errors import ServerGone
from escape_hw.remote.address import Endpoint
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
