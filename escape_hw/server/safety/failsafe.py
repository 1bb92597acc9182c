"""The fail-safe process: flattens the mirror when the engine died without a clean exit.

Started and restarted by ``server.frontend.engine_process``.
"""

from __future__ import annotations

import os
import signal
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING

from pydantic import BaseModel, ConfigDict

from escape_hw.supervision import is_alive

if TYPE_CHECKING:
    from escape_hw.config.system import SystemConfig

#: Message on the pipe before an engine ends with a flat mirror.
CLEAN_EXIT = b"clean"
#: Time for which opening the mirror is tried again; the engine's connection may still exist.
RETRY_S = 20.0
_RETRY_PERIOD_S = 0.2


class FailsafeSettings(BaseModel):
    """Settings of the fail-safe process, read from its standard input."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    #: The system's configuration, TOML.
    config_text: str
    #: Folder of the reports.
    incidents: str
    #: The engine's process, and its start time in clock ticks after boot.
    pid: int
    started: int


class IncidentReport(BaseModel):
    """Report of the fail-safe process after the death of an engine."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    at_utc: str
    system: str
    pid: int
    #: State of the mirror, for people.
    mirror: str
    #: Whether it is flat; ``None`` for a simulated mirror, which ended with its engine.
    flat: bool | None
    #: Time from the death of the engine to the report.
    seconds: float
    #: Segments of shared memory that were removed.
    segments: tuple[str, ...] = ()


def wait_for_end(descriptor: int) -> bool:
    """Wait until the engine's end of the pipe is closed; true when the engine ended cleanly."""
    received = b""
    while data := os.read(descriptor, 16):
        received += data
    return received.startswith(CLEAN_EXIT)


def make_safe(settings: FailsafeSettings) -> IncidentReport:
    """Flatten the mirror of a dead engine and remove its shared memory."""
    from escape_hw.config.loader import load_text
    from escape_hw.io.provenance import format_utc
    from escape_hw.streams.segments import remove_orphaned

    began = time.monotonic()
    config = load_text(settings.config_text)
    while is_alive(settings.pid, settings.started):
        # Only one process can open the mirror.
        time.sleep(0.01)
    flat, outcome = _flatten(config)
    removed = tuple(one.name for one in remove_orphaned(settings.pid))
    return IncidentReport(
        at_utc=format_utc(), system=config.system.name, pid=settings.pid,
        mirror=outcome, flat=flat, seconds=time.monotonic() - began, segments=removed,
    )  # fmt: skip


def _flatten(config: SystemConfig) -> tuple[bool | None, str]:
    from escape_hw.api.adaptive_secondary import AdaptiveSecondary
    from escape_hw.api.mirror import DeformableMirror
    from escape_hw.bench import build_device, resolve_mode
    from escape_hw.errors import EscapeError

    if resolve_mode(config.devices.dm, config) == "sim":
        return None, "the mirror is simulated and ended with its engine"
    deadline = time.monotonic() + RETRY_S
    while True:
        try:
            mirror = build_device("dm", config, DeformableMirror)  # type: ignore[type-abstract]
            if isinstance(mirror, AdaptiveSecondary):
                # A rested shell is safe and is not lifted; closing rests one that floats.
                mirror.lift = False
            with mirror:
                mirror.flatten()
            return True, "the mirror is flat"
        except EscapeError as error:
            if time.monotonic() > deadline:
                return False, f"the mirror could NOT be made flat: {error}"
            time.sleep(_RETRY_PERIOD_S)


def main() -> None:
    """Run the fail-safe process; ``argv`` holds the descriptor of the engine's pipe."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    settings = FailsafeSettings.model_validate_json(sys.stdin.buffer.read())
    if not wait_for_end(int(sys.argv[1])):
        report, folder = make_safe(settings), Path(settings.incidents)
        # The next start of the server shows it. Written also when the disk is nearly full.
        folder.mkdir(parents=True, exist_ok=True)
        path = folder / f"{report.system}-{report.pid}.incident.json"
        temporary = path.with_suffix(".tmp")
        temporary.write_text(report.model_dump_json(), encoding="utf-8")
        temporary.replace(path)


if __name__ == "__main__":
    main()
