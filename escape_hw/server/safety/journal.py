"""What the server was doing, on disk, so that the next one can tell how it ended."""

from __future__ import annotations

import contextlib
import json
import logging
import os
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from escape_hw.io.fits.run_state import STATE_FILE
from escape_hw.io.run_folder import default_runs_folder
from escape_hw.io.storage import write_atomic
from escape_hw.server.safety.failsafe import IncidentReport
from escape_hw.streams.segments import process_start, remove_orphaned

log = logging.getLogger(__name__)


def server_folder() -> Path:
    """Where servers keep their logs, journals and incidents."""
    return default_runs_folder().parent / "server"


class ServerJournal:
    """The journal of a system's server; its file is there while the server is.

    Parameters
    ----------
    system
        Name of the system.
    """

    def __init__(self, system: str) -> None:
        self.system, self.folder = system, server_folder()
        self._path = self.folder / f"{system}.journal.json"

    def write(self, run: dict[str, Any] | None) -> None:
        """Note what is going on: the run with its folder, or nothing."""
        pid = os.getpid()
        content = {"pid": pid, "started": process_start(pid), "run": run}
        write_atomic(self._path, json.dumps(content).encode())

    def close(self) -> None:
        """The server ended in order."""
        self._path.unlink(missing_ok=True)

    def previous_end(self) -> tuple[str, ...]:
        """What happened to the server before this one; told once. Clears away what it left in memory."""
        notes = []
        if (stale := self._stale_journal()) is not None:
            notes.append(f"the server before (process {stale.get('pid')}) did not end in order")
            if (run := stale.get("run")) is not None:
                notes.append(_describe_run(run))
        for path in sorted(self.folder.glob(f"{self.system}-*.incident.json")):
            with contextlib.suppress(OSError, ValidationError):
                found = IncidentReport.model_validate_json(path.read_bytes())
                notes.append(f"its engine (process {found.pid}) died at {found.at_utc}: {found.mirror}")
                path.replace(path.with_suffix(".told"))
        if removed := remove_orphaned():
            notes.append(f"{len(removed)} segments of dead processes were cleared away")
        for note in notes:
            log.warning("%s", note)
        return tuple(notes)

    def incident(self, pid: int) -> IncidentReport | None:
        """What the guardian of an engine did."""
        try:
            path = self.folder / f"{self.system}-{pid}.incident.json"
            found = IncidentReport.model_validate_json(path.read_bytes())
            path.replace(path.with_suffix(".told"))
            return found
        except (OSError, ValidationError):
            return None

    def _stale_journal(self) -> dict[str, Any] | None:
        try:
            stale = json.loads(self._path.read_bytes())
        except (OSError, ValueError):
            return None
        if not isinstance(stale, dict) or process_start(int(stale.get("pid", 0))) == stale.get("started"):
            return None
        return stale


def _describe_run(run: dict[str, Any]) -> str:
    """What became of a run that was going on."""
    folder = Path(str(run.get("folder", "")))
    what = f"it was running '{run.get('name')}' (run {run.get('id')}) in {folder}"
    if (folder / "result.json").is_file():
        return f"{what}, whose result is kept"
    if (folder / STATE_FILE).is_file():
        return f"{what}, which can be resumed: start it again with resume={folder}"
    return f"{what}, which kept nothing to go on with"
