"""Journal of a server on disk, from which the next server reports how the previous one ended."""

from __future__ import annotations

import json
import logging
import os
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError

from escape_hw.io.fits.run_state import STATE_FILE
from escape_hw.io.run_folder import RESULT_FILE, default_runs_folder
from escape_hw.io.storage import write_atomic
from escape_hw.remote.requests import first_error
from escape_hw.remote.state import ProductEntry
from escape_hw.server.safety.failsafe import IncidentReport
from escape_hw.streams.segments import remove_orphaned
from escape_hw.supervision import is_alive, process_start

log = logging.getLogger(__name__)
M = TypeVar("M", bound=BaseModel)
#: What an engine does not know of the one before.
RESET = (
    "gain, leak and camera settings are those of the system file again, offsets are zero, and a measured "
    "dark frame or flat has to be measured again"
)


def server_folder() -> Path:
    """Folder of the servers' logs, journals and incident reports."""
    return default_runs_folder().parent / "server"


class _JournalContent(BaseModel):
    """What a journal holds; the products are validated apart, since the rest is needed without them."""

    pid: int = 0
    started: int | None = None
    run: dict[str, Any] | None = None
    last_run_id: int = 0
    products: Any = ()


class ServerJournal:
    """Journal of a system's server; its file exists while the server runs.

    Attributes
    ----------
    last_run_id
        Number of the last run, also of a server that did not end cleanly.
    products
        Products that requests may name, also those of a server that did not end cleanly.
    """

    def __init__(self, system: str) -> None:
        self.system, self.folder = system, server_folder()
        self._path = self.folder / f"{system}.journal.json"
        self.last_run_id = 0
        self.products: tuple[ProductEntry, ...] = ()
        self._run: dict[str, Any] | None = None

    def write(self, run: dict[str, Any] | None) -> None:
        """Write the active run with its folder, or ``None``."""
        self._run = run
        if run is not None:
            self.last_run_id = int(run["id"])
        self._write()

    def write_products(self, products: tuple[ProductEntry, ...]) -> None:
        """Write the products, if they have changed."""
        if products != self.products:
            self.products = products
            self._write()

    def _write(self) -> None:
        pid = os.getpid()
        content = {
            "pid": pid, "started": process_start(pid), "run": self._run, "last_run_id": self.last_run_id,
            "products": [one.model_dump(mode="json") for one in self.products],
        }  # fmt: skip
        write_atomic(self._path, json.dumps(content).encode())

    def close(self) -> None:
        """Remove the journal: the server ended with a flat mirror."""
        self._path.unlink(missing_ok=True)

    def read_previous_end(self) -> tuple[str, ...]:
        """How the previous server and its engines ended, if not cleanly; removes their shared memory.

        An incident report is returned once.
        """
        notes = []
        if (stale := self._stale_journal()) is not None:
            self.last_run_id = stale.last_run_id
            try:
                self.products = tuple(ProductEntry.model_validate(one) for one in stale.products)
            except (TypeError, ValidationError) as error:
                log.warning("the journal is damaged, products are not offered again: %s", error)
            notes.append(f"the previous server (process {stale.pid}) did not end cleanly; {RESET}")
            if stale.run is not None:
                notes.append(_describe_run(stale.run))
        for path in sorted(self.folder.glob(f"{self.system}-*.incident.json")):
            if (report := _take_report(path)) is not None:
                notes.append(f"its engine (process {report.pid}) died at {report.at_utc}: {report.mirror}")
        if removed := remove_orphaned():
            notes.append(f"{len(removed)} segments of shared memory of dead processes were removed")
        for note in notes:
            log.warning("%s", note)
        return tuple(notes)

    def read_incident(self, pid: int) -> IncidentReport | None:
        """Report of an engine's fail-safe process; ``None`` when it left none."""
        return _take_report(self.folder / f"{self.system}-{pid}.incident.json")

    def _stale_journal(self) -> _JournalContent | None:
        stale = _read(self._path, _JournalContent)
        return None if stale is None or is_alive(stale.pid, stale.started) else stale


def _read(path: Path, model: type[M]) -> M | None:
    """Read a document; ``None`` when it does not exist, and with a warning when it is damaged."""
    try:
        return model.model_validate_json(path.read_bytes())
    except FileNotFoundError:
        return None
    except ValidationError as error:
        log.warning("%s is damaged: %s", path, first_error(error))
    except OSError as error:
        log.warning("%s cannot be read: %s", path, error.strerror or error)
    return None


def _take_report(path: Path) -> IncidentReport | None:
    """Read a report and mark it as reported."""
    report = _read(path, IncidentReport)
    if report is not None:
        try:
            path.replace(path.with_suffix(".reported"))
        except OSError as error:
            log.warning("%s is reported again at the next start: %s", path, error.strerror or error)
    return report


def _describe_run(run: dict[str, Any]) -> str:
    folder = Path(str(run.get("folder", "")))
    what = f"it was running '{run.get('name')}' (run {run.get('id')}) in {folder}"
    if (folder / RESULT_FILE).is_file():
        return f"{what}, whose result is saved"
    if (folder / STATE_FILE).is_file():
        return f"{what}, which can be resumed: start it again with resume={folder}"
    return f"{what}, which saved nothing to resume from"
