"""The front-end process; ``frontend.supervisor`` starts it, and starts it again when it dies.

Its standard input holds the settings, one line of JSON, and ends when the server has to end. Standard output
gets one line of JSON: ``{"listing": ...}`` when it listens, or ``{"error": ...}``.
"""

from __future__ import annotations

import json
import os
import signal
import sys
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict

from escape_hw.config.loader import load_text
from escape_hw.errors import EscapeError
from escape_hw.remote.requests import error_to_document
from escape_hw.server.frontend.front_end import Server
from escape_hw.supervision import watch_standard_input


class FrontEndSetup(BaseModel):
    """Settings of a front end."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    #: The system's configuration, TOML.
    config_text: str
    #: Address and port of TCP; ``None`` for local sockets only.
    host: str
    port: int | None
    #: Parent of the run folders, and further folders that products may be loaded from.
    runs: Path
    read_folders: tuple[Path, ...]
    #: Process of the server, which supervises this one.
    server_pid: int


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
    try:
        config = load_text(setup.config_text)
        with Server(config, setup.host, setup.port, setup.server_pid) as server:
            send({"listing": asdict(server.listing)})
            server.run(stop, setup.runs, setup.read_folders)
    except EscapeError as error:
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
