"""A run folder or a product as a read-only data source for the panels."""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.optical_gains import GainsResult
from escape_hw.api.registration import PARAMETERS, TO_STREAM_UNITS
from escape_hw.api.results import CalibrationResult, LoopResult, RegistrationEstimate
from escape_hw.io.night_log import NightEntry
from escape_hw.remote.source import STREAMS, Sample
from escape_hw.remote.state import (
    ActiveRun,
    Finish,
    FinishedRun,
    Geometry,
    LogLine,
    LoopState,
    Phase,
    ProcedureEntry,
    ProductEntry,
    State,
    StreamEntry,
)

if TYPE_CHECKING:
    from escape_hw.report.content import RunContent


Meta = Mapping[str, float | str]


@dataclass(frozen=True, slots=True, eq=False)
class RecordedStream:
    """Entries of a stream during a run."""

    #: Number of steps.
    length: int
    #: Returns the entry after a step, 1 to ``length``.
    at: Callable[[int], NDArray[Any]]
    #: Metadata of all entries.
    meta: Meta


def recorded_streams(run: RunContent) -> dict[str, RecordedStream]:
    """All streams for which a run has data, by name."""
    streams: dict[str, RecordedStream] = {}
    main = main_calibration(run)
    if main is not None:
        streams |= _calibration(*main)
    for label, gains in run.gains.items():
        streams |= _gains(label, gains)
    if run.loops:
        streams |= _loop(*list(run.loops.items())[-1])
    track = run.document.get("track")
    if track and track["seconds"]:
        table = _table(track)
        streams["registration_track"] = RecordedStream(len(table), lambda n: table[:n], {"stage": "tracking"})
    return streams


def main_calibration(run: RunContent) -> tuple[str, CalibrationResult] | None:
    """Label and result of a run's last calibration with a registration, else of its last calibration."""
    fitted = [item for item in run.calibrations.items() if item[1].registration is not None]
    candidates = fitted or list(run.calibrations.items())
    return candidates[-1] if candidates else None


def _constant_stream(data: NDArray[Any], meta: Meta) -> RecordedStream:
    return RecordedStream(1, lambda _: data, meta)


def _calibration(label: str, result: CalibrationResult) -> dict[str, RecordedStream]:
    matrix = result.measured or result.matrix
    meta: Meta = {"stage": label, "method": matrix.method, "frames": float(result.frames)}
    streams = {
        "valid": _constant_stream(matrix.valid, meta),
        "matrix": _constant_stream(matrix.data, meta),
        "matrix_sigma": _constant_stream(matrix.sigma, meta),
    }
    if result.mean_frame is not None:
        streams["frames"] = _constant_stream(result.mean_frame, {"stage": "mean frame"})
    if result.registration is not None:
        streams |= _sprint(result.registration)
    return streams


def _sprint(estimate: RegistrationEstimate) -> dict[str, RecordedStream]:
    steps = estimate.iterations
    if not steps:
        return {}
    path = np.array([step.registration.to_array() for step in steps]) * TO_STREAM_UNITS
    # The result differs from the last step by the corrections for model errors.
    path[-1] = estimate.registration.to_array() * TO_STREAM_UNITS
    norm = np.array([step.step_norm for step in steps])
    sigma, unknown = estimate.sigma * TO_STREAM_UNITS, np.full(len(PARAMETERS), np.nan)
    n = len(steps)
    meta: Meta = {"stage": "SPRINT"}
    return {
        "registration": RecordedStream(n, lambda k: path[:k], meta),
        "step_norm": RecordedStream(n, lambda k: norm[:k], meta),
        "registration_sigma": RecordedStream(n, lambda k: sigma if k == n else unknown, meta),
    }


def _gains(label: str, result: GainsResult) -> dict[str, RecordedStream]:
    rounds = [one.gains for one in result.rounds]
    if not rounds:
        return {}
    meta: Meta = {"stage": "bootstrap", "method": result.method, "label": label}
    n = len(rounds)
    return {
        "gains": RecordedStream(n, lambda k: rounds[k - 1].value, meta),
        "gains_sigma": RecordedStream(n, lambda k: rounds[k - 1].sigma, meta),
        "gains_smooth": RecordedStream(n, lambda k: rounds[k - 1].trend, meta),
        "gains_rounds": RecordedStream(n, lambda k: np.array([one.best for one in rounds[:k]]), meta),
    }


def _loop(label: str, loop: LoopResult) -> dict[str, RecordedStream]:
    meta: Meta = {"stage": label}
    streams: dict[str, RecordedStream] = {}
    if loop.last_frame is not None:
        streams["frames"] = _constant_stream(loop.last_frame, meta)
    if loop.last_command.size:
        streams["commands"] = _constant_stream(loop.last_command, meta)
    if loop.psf is not None:
        streams["psf"] = _constant_stream(loop.psf, meta)
    if loop.model_psf is not None:
        streams["model_psf"] = _constant_stream(loop.model_psf, meta)
    residual = loop.residual_nm
    if residual.size:
        streams["residual"] = RecordedStream(residual.size, lambda k: residual[:k], meta)
    return streams


def _table(track: Mapping[str, Any]) -> NDArray[np.float64]:
    """Stream ``registration_track`` ``(n, 11)`` from the columns of the document."""
    names = ("seconds", *PARAMETERS, *(f"{name}_sigma" for name in PARAMETERS))
    table = np.array([track[name] for name in names], float).T
    table[:, 1:6] *= TO_STREAM_UNITS
    table[:, 6:11] *= TO_STREAM_UNITS
    return table


_LOG_LINE = re.compile(r"(\S+ \S+) ([A-Z]+) (\S+): (.*)")


class ReplaySource:
    """A FITS product or the folder of a run as a :class:`~escape_hw.remote.source.DataSource`.

    ProductError: the path is neither, or a file is damaged.
    """

    connected = True

    def __init__(self, path: Path | str) -> None:
        # Imported here: it takes half a second, and windows on a server do not need it.
        from escape_hw.report.content import read_product, read_run

        self.path = Path(path)
        self.run: RunContent = read_run(self.path) if self.path.is_dir() else read_product(self.path)
        self._streams = recorded_streams(self.run)
        self._geometry = _geometry_of(self.run)
        self._position = 1.0
        self._serial = 1
        self._log = _log_lines(self.run.log_text)
        self._opened_ns = time.monotonic_ns()
        #: The recorded run as the last run of a stopped server.
        self.state = self._make_state()

    @property
    def steps(self) -> int:
        """Number of steps of the longest stream; 1 if none has several."""
        return max((stream.length for stream in self._streams.values()), default=1)

    @property
    def step(self) -> int:
        """Present step of the longest stream, 1 to :attr:`steps`."""
        return self._step_of(self.steps)

    def _step_of(self, length: int) -> int:
        return max(1, min(length, int(np.ceil(self._position * length - 1e-6))))

    def seek(self, position: float) -> None:
        """Show the run as it was at a position from 0 to 1."""
        self._position = min(1.0, max(0.0, position))
        self._serial += 1
        self.state = self._make_state()

    def latest(self, stream: str, after: int = -1) -> Sample | None:
        recorded = self._streams.get(stream)
        if recorded is None or self._serial <= after:
            return None
        data = np.asarray(recorded.at(self._step_of(recorded.length)))
        return Sample(self._serial, self._opened_ns, self._opened_ns, data, recorded.meta)

    def _make_state(self) -> State:
        run, document = self.run, self.run.document
        finish = Finish.ABORTED if run.partial() else Finish.DONE
        name = str(document.get("title") or document.get("command", ""))
        return State(
            serial=self._serial,
            at_utc=str(document.get("finished_utc") or document.get("started_utc") or ""),
            version=str(document.get("software", "")),
            system=str(document.get("system") or ""),
            simulated=run.simulated,
            seed=int(document.get("seed") or 0),
            phase=Phase.STOPPED,
            loop=_loop_state(run),
            # Before the last step, the run has no result yet.
            active_run=None if self.step == self.steps else self._active_run(name),
            last_run=FinishedRun(
                id=0,
                name=name,
                finish=finish,
                folder=str(run.folder),
                products={key: str(path) for key, path in document["products"].items()},
                document={key: value for key, value in document.items() if key != "products"},
            ),
            products=_products(run),
            streams=tuple(
                StreamEntry(name=name, segment="", unit=STREAMS.get(name, "")) for name in self._streams
            ),
        )

    def _active_run(self, name: str) -> ActiveRun:
        return ActiveRun(
            id=0, name=name, arguments={}, stage="replay", completed=self.step, total=self.steps, unit="step"
        )

    def geometry(self) -> Geometry:
        return self._geometry

    def log_after(self, number: int) -> Sequence[LogLine]:
        return self._log[max(0, number + 1) :]

    def night_after(self, number: int) -> Sequence[NightEntry]:
        return ()

    def procedures(self) -> Sequence[ProcedureEntry]:
        return ()


def _geometry_of(run: RunContent) -> Geometry:
    """Geometry of a run's main calibration and of its mirror; parts that were not recorded are empty."""
    main = main_calibration(run)
    parts: dict[str, object] = {}
    if main is not None:
        grid = main[1].grid
        parts |= {
            "valid": _rows(grid.valid), "outlines_px": grid.outlines(), "n_modes": main[1].matrix.n_modes,
        }  # fmt: skip
    if psf_px := run.document.get("bench", {}).get("psf_px"):
        parts["psf_px"] = float(psf_px)
    if run.layout is not None:
        parts["layout"] = _rows(run.layout)
    if run.places_m is not None:
        parts["positions_m"] = tuple((float(x), float(y)) for x, y in run.places_m)
    return Geometry.model_validate(parts)


def _rows(mask: NDArray[np.bool_]) -> tuple[str, ...]:
    return tuple("".join("1" if valid else "0" for valid in row) for row in mask)


def _loop_state(run: RunContent) -> LoopState:
    if not run.loops:
        return LoopState()
    label, loop = list(run.loops.items())[-1]
    peak = None if loop.strehl is None else loop.strehl.peak
    return LoopState(
        closed=False,
        matrix=label,
        gain=loop.gain,
        leak=loop.leak,
        dropped_modes=loop.dropped_modes,
        residual_nm=loop.residual_rms_nm,
        strehl=None if peak is None else peak.value,
        strehl_sigma=peak.sigma if peak is not None and np.isfinite(peak.sigma) else None,
    )


def _products(run: RunContent) -> tuple[ProductEntry, ...]:
    """All FITS products, the run's main matrix last."""
    main = main_calibration(run)
    products = [
        ProductEntry(name=name, kind=_kind(run, name), path=str(path))
        for name, path in run.document["products"].items()
        if path.suffix == ".fits"
    ]
    last = None if main is None else run.names.get(main[0])
    return tuple(sorted(products, key=lambda one: one.name == last))


def _kind(run: RunContent, name: str) -> str:
    from escape_hw.io.fits.gains import KIND_GAINS
    from escape_hw.io.fits.matrix import KIND_MATRIX

    return {KIND_MATRIX: "matrix", KIND_GAINS: "gains"}.get(run.kinds.get(name, ""), "psf")


def _log_lines(content: str) -> tuple[LogLine, ...]:
    """Entries of ``run.log``; a line without time and level continues the entry before."""
    lines: list[dict[str, Any]] = []
    for raw in content.splitlines():
        head = _LOG_LINE.fullmatch(raw)
        if head is not None:
            at, level, logger, text = head.groups()
            lines.append({"at_utc": at.replace(",", "."), "level": level, "logger": logger, "text": text})
        elif lines:
            lines[-1]["text"] += "\n" + raw
    return tuple(LogLine(number=number, **line) for number, line in enumerate(lines))
