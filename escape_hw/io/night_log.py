"""Night logs on disk: notes of the operator, events, and samples of the performance, a file per night.

A file has one JSON document per line and is complete up to its last line after a crash. A night lasts from
noon to noon in local time and has the date of its evening: ``RUNS/2026-11-22/night_razor-shwfs.jsonl``.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from escape_hw.errors import ProductError, StorageError
from escape_hw.io.provenance import format_utc
from escape_hw.io.storage import make_folder

log = logging.getLogger(__name__)

_PREFIX, _SUFFIX = "night_", ".jsonl"
#: Longest note, characters.
MAX_TEXT = 2000

Kind = Literal["note", "event", "fault", "alarm", "sample"]


class NightEntry(BaseModel):
    """One entry of a night log."""

    model_config = ConfigDict(frozen=True, extra="ignore")

    number: int
    at_utc: str
    kind: Kind
    text: str = ""
    #: Client that wrote a note.
    author: str = ""
    #: Sample: values by name, see :data:`QUANTITIES`; absent ones were not measured.
    values: dict[str, float] = Field(default_factory=dict)
    simulated: bool = False

    @property
    def time(self) -> datetime:
        """Time of the entry, UTC."""
        return datetime.fromisoformat(self.at_utc).replace(tzinfo=UTC)


#: Values of samples: label and unit. Uncertainties have the name with ``_sigma``.
QUANTITIES: dict[str, tuple[str, str]] = {
    "strehl": ("Strehl ratio", "%"),
    "residual_nm": ("Residual", "nm rms"),
    "strength": ("D / r0 at the sensor's wavelength", ""),
    "r0_m": ("r0 at 500 nm", "m"),
    "seeing": ("Seeing at 500 nm", "arcsec"),
    "shift_x": ("Shift x", "% of a sub-aperture"),
    "shift_y": ("Shift y", "% of a sub-aperture"),
    "rotation": ("Rotation", "degrees"),
    "radial_scaling": ("Radial scaling", "%"),
    "tangential_scaling": ("Tangential scaling", "%"),
    "optical_gain": ("Optical gain, median of the modes", ""),
}


def night_of(moment: datetime) -> str:
    """Date of the night of a time, ``2026-11-22``."""
    return f"{moment.astimezone() - timedelta(hours=12):%Y-%m-%d}"


def night_path(runs: Path, system: str, night: str) -> Path:
    """Path of a night's file."""
    return runs / night / f"{_PREFIX}{system}{_SUFFIX}"


def find_nights(runs: Path, system: str = "*") -> list[Path]:
    """The files of all nights of a system, or of all systems, the newest first."""
    return sorted(runs.glob(f"[0-9]*-[0-9]*-[0-9]*/{_PREFIX}{system}{_SUFFIX}"), reverse=True)


def system_of(path: Path) -> str:
    """Name of the system of a night's file."""
    return path.name.removeprefix(_PREFIX).removesuffix(_SUFFIX)


def read_night(path: Path) -> list[NightEntry]:
    """Entries of a night; damaged lines, such as the last one before a crash, are left out, and logged.

    Raises
    ------
    ProductError
        The file cannot be read.
    """
    try:
        text = path.read_text(encoding="utf-8", errors="replace")
    except OSError as error:
        raise ProductError(f"{path}: cannot be read ({error.strerror or error})") from error
    return list(_parse(path, text))


def _parse(path: Path, text: str) -> Iterator[NightEntry]:
    for number, line in enumerate(text.splitlines(), 1):
        try:
            entry = NightEntry.model_validate_json(line)
            entry.time  # noqa: B018 - a damaged time is a damaged line
            yield entry
        except (ValidationError, ValueError):
            log.warning("%s: line %d is damaged and left out", path, number)


class NightLogWriter:
    """Appends entries to the file of the present night; one thread at a time.

    A disk that cannot be written is reported once, and entries are still returned.

    Attributes
    ----------
    earlier
        Entries of tonight that an earlier server wrote.
    """

    def __init__(self, runs: Path, system: str, simulated: bool) -> None:
        self._runs, self._system, self._simulated = runs, system, simulated
        newest = next(iter(find_nights(runs, system)), None)
        entries = [] if newest is None else read_night(newest)
        tonight = newest == night_path(runs, system, night_of(datetime.now(UTC)))
        self.earlier = entries if tonight else []
        # Numbers go on from night to night: clients request what comes after the last one that they have.
        self._next = max((entry.number for entry in entries), default=-1) + 1
        self._appended, self._failed = False, False

    def add(
        self, kind: Kind, text: str = "", author: str = "", values: Mapping[str, float] | None = None
    ) -> NightEntry:
        """Write an entry with the present time and return it."""
        now = datetime.now(UTC)
        entry = NightEntry(
            number=self._next, at_utc=format_utc(now), kind=kind, text=text[:MAX_TEXT], author=author,
            values=dict(values or {}), simulated=self._simulated,
        )  # fmt: skip
        self._next += 1
        path = night_path(self._runs, self._system, night_of(now))
        try:
            self._append(path, entry.model_dump_json(exclude_defaults=True).encode() + b"\n")
            self._failed = False
        except (OSError, StorageError) as error:
            if not self._failed:
                log.error("%s: the night log cannot be written: %s", path, error)
            self._failed = True
        return entry

    def _append(self, path: Path, line: bytes) -> None:
        make_folder(path.parent)
        with open(path, "ab") as file:
            # After a crash within a line, the file does not end with a line break.
            if not self._appended and file.tell() and not path.read_bytes().endswith(b"\n"):
                line = b"\n" + line
            file.write(line)
        self._appended = True
