"""The front-end process; ``frontend.supervisor`` starts it, and starts it again when it dies.

Its standard input holds the settings, one line of JSON, and ends when the server has to end. Standard output
gets one line of JSON: an empty object when it listens, or ``{"error": ...}``.
"""

from __future__ import annotations

import json
import logging
import os
import signal
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict

from escape_hw.config.loader import load_text
from escape_hw.errors import EscapeError
from escape_hw.remote.address import Endpoint
from escape_hw.remote.requests import error_to_document
from escape_hw.server.frontend.front_end import FrontEnd, listening_transport
from escape_hw.supervision import watch_standard_input

log = logging.getLogger(__name__)


class FrontEndSetup(BaseModel):
    """Settings of a front end."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    #: The system's configuration, TOML.
    config_text: str
    #: Local sockets.
    local: Endpoint
    #: Address and port of TCP; ``None`` for local sockets only.
    host: str
    port: int | None
    #: Parent of the run folders, and further folders that products may be loaded from.
    runs: Path
    read_folders: tuple[Path, ...]
    #: Process of the server, which supervises this one.
    server_pid: int
    #: Number of the first log line and state: later than those of the front end before.
    first_number: int = 0


def main() -> None:
    """Run a front end."""
    # The supervisor handles Ctrl-C and the end of the terminal.
    for number in (signal.SIGINT, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    # What a library prints is no message.
    messages = os.dup(1)
    os.dup2(2, 1)

    def send(message: Mapping[str, Any]) -> None:
        os.write(messages, json.dumps(message).encode() + b"\n")

    setup = FrontEndSetup.model_validate_json(_read_line())
    stop = watch_standard_input()
    signal.signal(signal.SIGTERM, lambda *_: stop.set())
    listening = False
    try:
        with listening_transport(setup.local, setup.host, setup.port) as transport:
            front_end = FrontEnd(
                load_text(setup.config_text), transport, setup.runs, setup.read_folders, setup.server_pid,
                setup.first_number,
            )  # fmt: skip
            send({})
            listening = True
            front_end.run(stop)
    except EscapeError as error:
        if listening:
            log.critical("%s", error)
        else:
            send({"error": error_to_document(error)})
        sys.exit(1)


def _read_line() -> bytes:
    """The first line of standard input, without its buffer, which another thread reads later."""
    line = b""
    while not line.endswith(b"\n") and (byte := os.read(0, 1)):
        line += byte
    return line


if __name__ == "__main__":
    main()
