"""Recordings of telemetry under the folder of the runs: description, list, newest frames, deletion."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from escape_hw.errors import EscapeError, ProductError, StorageError
from escape_hw.io.fits.matrix import load_matrix
from escape_hw.io.storage import storage_error, write_atomic
from escape_hw.pipeline.telemetry import LoopFacts, LoopTelemetryArrays
from escape_hw.streams.recording.block_file import SUFFIX, Recording, count_entries, read_newest

DESCRIPTION_FILE = "recording.json"


@dataclass(frozen=True, slots=True)
class RecordingDescription:
    """Bench and loop at the start of a recording; ``matrix`` is the path of the loop's matrix.

    Frame rate in Hz, stroke in metres of surface, largest command as fraction of full stroke.
    """

    system: str = ""
    simulated: bool = True
    started_utc: str = ""
    rate_hz: float = 0.0
    gain: float = 0.0
    leak: float = 0.0
    dropped_modes: int = 0
    matrix: str = ""
    loop_closed: bool = False
    stroke_m: float = 0.0
    max_stroke: float = 1.0


def write_description(folder: Path, description: RecordingDescription) -> None:
    """Write the description (StorageError: it cannot be written)."""
    write_atomic(folder / DESCRIPTION_FILE, json.dumps(asdict(description), indent=1).encode() + b"\n")


def read_description(folder: Path) -> RecordingDescription:
    """Read the description; recordings of version 0.1.0, and damaged files, have an empty one."""
    try:
        document = json.loads((folder / DESCRIPTION_FILE).read_text(encoding="utf-8"))
        known: dict[str, type] = {
            name: type(default) for name, default in asdict(RecordingDescription()).items()
        }
        return RecordingDescription(
            **{name: known[name](value) for name, value in document.items() if name in known}
        )
    except (OSError, ValueError, TypeError, AttributeError):
        return RecordingDescription()


@dataclass(frozen=True, slots=True)
class RecordingSummary:
    """A recording on disk: folder, description, names of the streams, frames of the slopes, bytes."""

    folder: Path
    description: RecordingDescription
    streams: tuple[str, ...]
    frames: int
    size: int

    @property
    def seconds(self) -> float:
        """Duration at the frame rate; 0 if unknown."""
        rate = self.description.rate_hz
        return self.frames / rate if rate > 0 else 0.0


def find_recordings(runs: Path) -> Iterator[RecordingSummary]:
    """The recordings under the folder of the runs, the newest first."""
    for folder in sorted(runs.glob("[0-9]*-[0-9]*-[0-9]*/*_telemetry*"), reverse=True):
        files = sorted(folder.glob(f"*{SUFFIX}"))
        if files:
            yield RecordingSummary(
                folder, read_description(folder), tuple(file.stem for file in files),
                count_entries(folder / f"slopes{SUFFIX}"), sum(file.stat().st_size for file in files),
            )  # fmt: skip


def delete_recording(folder: Path) -> None:
    """Delete the files of a recording, and its folder.

    Raises
    ------
    StorageError
        The folder contains other files, or a file cannot be deleted.
    """
    files = list(folder.iterdir()) if folder.is_dir() else []
    others = [file.name for file in files if file.suffix != SUFFIX and file.name != DESCRIPTION_FILE]
    if others or not files:
        raise StorageError(f"{folder}: not deleted; it is no recording, or contains other files: {others}")
    try:
        for file in files:
            file.unlink()
        folder.rmdir()
    except OSError as error:
        raise storage_error(folder, error) from error


#: Frames of an analysis.
MAX_FRAMES = 8192
#: Frame rate of a recording without description (version 0.1.0), Hz: frequencies are per frame then.
_NO_RATE_HZ = 1.0


def load_recording(folder: Path, max_frames: int = MAX_FRAMES) -> tuple[LoopTelemetryArrays, LoopFacts]:
    """Load the newest frames of a recording, also of one that goes on.

    In closed loop only frames with a residual count. A frame has the command that was sent after its slopes.

    Raises
    ------
    ProductError
        There are no slopes, or a file is damaged.
    """
    slopes = _newest(folder, "slopes", max_frames)
    if slopes is None:
        raise ProductError(f"{folder}: no slopes are recorded yet; the sensor must have been measured before")
    # The index starts again when the camera restarts.
    restart = int(np.max(np.flatnonzero(np.diff(slopes.index) <= 0), initial=-1)) + 1
    index, arrived, data = slopes.index[restart:], slopes.arrived_ns[restart:], slopes.data[restart:]
    residual, commands = (_newest(folder, name, 2 * max_frames) for name in ("residual_modes", "commands"))
    modes = np.zeros((len(index), 0), np.float32)
    if residual is not None and residual.arrived_ns[-1] >= arrived[0]:
        recent = residual.arrived_ns >= arrived[0]
        _, at, among = np.intersect1d(index, residual.index[recent], return_indices=True)
        index, arrived, data, modes = index[at], arrived[at], data[at], residual.data[recent][among]
    sent = np.zeros((len(index), 0), np.float32)
    if commands is not None and len(index):
        after = np.searchsorted(commands.arrived_ns, arrived)
        sent = commands.data[np.minimum(after, len(commands.data) - 1)]
    arrays = LoopTelemetryArrays(index, data, sent.astype(np.float32), modes.astype(np.float32))
    return arrays, _facts(folder)


def _newest(folder: Path, stream: str, count: int) -> Recording | None:
    path = folder / f"{stream}{SUFFIX}"
    return read_newest(path, count) if path.is_file() else None


def _facts(folder: Path) -> LoopFacts:
    known = read_description(folder)
    facts = LoopFacts(
        known.rate_hz or _NO_RATE_HZ, known.gain, known.leak, nm_per_unit=2e9 * known.stroke_m,
        max_stroke=known.max_stroke,
    )  # fmt: skip
    try:
        result = load_matrix(known.matrix).result if known.matrix else None
    except EscapeError:
        result = None
    if result is None:
        return facts
    delay = facts.delay_frames if result.response is None else result.response.delay_frames
    return LoopFacts(
        facts.rate_hz, facts.gain, facts.leak, delay, result.matrix.m2c, facts.nm_per_unit, facts.max_stroke
    )
