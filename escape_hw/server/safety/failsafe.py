"""The guardian: a small process that makes the mirror safe when the engine died without a goodbye."""

from __future__ import annotations

import os
import signal
import sys
import time
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING

from pydantic import BaseModel, ConfigDict

from escape_hw.streams.segments import process_start

if TYPE_CHECKING:
    from escape_hw.config.system import SystemConfig

#: A mirror that cannot be opened (its old connection may still stand) is tried again for so long.
RETRY_S = 20.0
_RETRY_PERIOD_S = 0.2


class FailsafeSettings(BaseModel):
    """Whom a guardian watches, on its standard input.

    Parameters
    ----------
    config_text
        The system's whole configuration, TOML.
    incidents
        Folder to write down in what happened.
    pid, started
        The engine's process, and when that began in clock ticks after boot.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    config_text: str
    incidents: str
    pid: int
    started: int


class IncidentReport(BaseModel):
    """What a guardian found and did.

    Parameters
    ----------
    mirror
        What became of the mirror, for people.
    flat
        Whether it is flat; ``None``: it was a twin, which ended with its engine.
    segments
        Segments of shared memory that were cleared away.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    at_utc: str
    system: str
    pid: int
    mirror: str
    flat: bool | None
    seconds: float
    segments: tuple[str, ...] = ()


def wait_for_end(descriptor: int) -> bool:
    """Wait until the pipe's other end is closed; true when a goodbye came first."""
    received = b""
    while data := os.read(descriptor, 16):
        received += data
    return received.startswith(b"bye")


def make_safe(settings: FailsafeSettings) -> IncidentReport:
    """Flatten the mirror of an engine that is gone, and clear up after it."""
    from escape_hw.config.loader import load_text
    from escape_hw.streams.segments import remove_orphaned

    began = time.monotonic()
    config = load_text(settings.config_text)
    while process_start(settings.pid) == settings.started:
        # Only one process may hold the mirror.
        time.sleep(0.01)
    flat, words = _flatten(config)
    reaped = tuple(one.name for one in remove_orphaned(settings.pid))
    return IncidentReport(
        at_utc=datetime.now(UTC).isoformat(timespec="seconds"), system=config.system.name, pid=settings.pid,
        mirror=words, flat=flat, seconds=time.monotonic() - began, segments=reaped,
    )  # fmt: skip


def _flatten(config: SystemConfig) -> tuple[bool | None, str]:
    from escape_hw.api.adaptive_secondary import AdaptiveSecondary
    from escape_hw.api.mirror import DeformableMirror
    from escape_hw.bench import build_device, resolve_mode
    from escape_hw.errors import EscapeError

    if resolve_mode(config.devices.dm, config) == "sim":
        return None, "the mirror is a twin and ended with its engine"
    deadline = time.monotonic() + RETRY_S
    while True:
        try:
            mirror = build_device("dm", config, DeformableMirror)  # type: ignore[type-abstract]
            if isinstance(mirror, AdaptiveSecondary):
                # A shell that has gone to rest meanwhile is safe; closing flattens and rests one that floats.
                mirror.lift = False
            with mirror:
                mirror.flatten()
            return True, "the mirror is flat"
        except EscapeError as error:
            if time.monotonic() > deadline:
                return False, f"the mirror could NOT be made flat: {error}"
            time.sleep(_RETRY_PERIOD_S)


def write_report(report: IncidentReport, folder: Path) -> Path:
    """Write down what happened, for the next start to tell."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{report.system}-{report.pid}.incident.json"
    temporary = path.with_suffix(".tmp")
    temporary.write_text(report.model_dump_json(), encoding="utf-8")
    temporary.replace(path)
    return path


def main() -> None:
    """Watch the engine behind the pipe whose descriptor is the only argument."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    settings = FailsafeSettings.model_validate_json(sys.stdin.buffer.read())
    if not wait_for_end(int(sys.argv[1])):
        write_report(make_safe(settings), Path(settings.incidents))


if __name__ == "__main__":
    main()
