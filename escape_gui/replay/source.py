"""A run folder or product as a read-only source for panels, with its geometry."""

from __future__ import annotations

import re
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from escape_gui.replay.streams import RecordedStream, main_calibration, recorded_streams
from escape_hw.api.outlines import outlines
from escape_hw.errors import ConfigError
from escape_hw.remote.source import STREAMS, Sample
from escape_hw.remote.state import (
    Arguments,
    Finish,
    FinishedRun,
    Geometry,
    LogLine,
    LoopState,
    Phase,
    ProcedureEntry,
    ProcedurePlan,
    ProductEntry,
    State,
    StreamEntry,
)

if TYPE_CHECKING:
    from escape_hw.report.content import RunContent


def run_geometry(run: RunContent) -> Geometry:
    """The geometry of a run's main calibration; empty parts where the run tells nothing of them."""
    main = main_calibration(run)
    layout, places = run.layout, run.places_m
    seen: dict[str, object] = {}
    if main is not None:
        grid = main[1].grid
        seen = {
            "valid": _rows(grid.valid),
            "outlines_px": outlines(grid),
            "n_modes": main[1].matrix.n_modes,
        }
    return Geometry.model_validate(
        {
            **seen,
            "layout": () if layout is None else _rows(layout),
            "positions_m": () if places is None else tuple((float(x), float(y)) for x, y in places),
        }
    )


def _rows(mask: NDArray[np.bool_]) -> tuple[str, ...]:
    return tuple("".join("1" if spot else "0" for spot in row) for row in mask)


#: Why nothing can be commanded.
READ_ONLY_REASON = "This is a recording: it can be looked at, nothing in it can be moved."
_LOG_LINE = re.compile(r"(\S+ \S+) ([A-Z]+) (\S+): (.*)")


class ReplaySource:
    """What a run left behind, as a :class:`~escape_hw.remote.source.Source`.

    Parameters
    ----------
    path
        A FITS product or the folder of a run.

    Attributes
    ----------
    run
        Everything that was read.

    Raises
    ------
    ProductError
        It is no run and no product, or it is damaged.
    """

    def __init__(self, path: Path | str) -> None:
        # Reading FITS takes half a second to load, and live windows do without.
        from escape_hw.report.content import read_product, read_run

        self.path = Path(path)
        self.run: RunContent = read_run(self.path) if self.path.is_dir() else read_product(self.path)
        self._streams = recorded_streams(self.run)
        self._position = 1.0
        self._serial = 1
        self._log = _log_lines(self.run.log_text)
        self._opened_ns = time.monotonic_ns()
        self._state = self._make_state()

    @property
    def connected(self) -> bool:
        """A recording is always there."""
        return True

    @property
    def position(self) -> float:
        """How much of the run is shown, 0 to 1."""
        return self._position

    @property
    def steps(self) -> int:
        """Steps of the longest course; 1 when nothing in it has one."""
        return max((course.length for course in self._streams.values()), default=1)

    def seek(self, position: float) -> None:
        """Show the run as it was after this share of it."""
        self._position = min(1.0, max(0.0, position))
        self._serial += 1
        self._state = self._make_state()

    def latest(self, stream: str, after: int = -1) -> Sample | None:
        """See :class:`~escape_hw.remote.source.Source`."""
        course = self._streams.get(stream)
        if course is None or self._serial <= after:
            return None
        data = course.at(_step(course, self._position))
        if data is None:
            return None
        return Sample(self._serial, self._opened_ns, self._opened_ns, np.asarray(data), course.meta)

    @property
    def state(self) -> State:
        """What the run says of itself, in the words of a server."""
        return self._state

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

    def geometry(self) -> Geometry:
        """Where slopes and actuators stood."""
        return run_geometry(self.run)

    def log_after(self, number: int) -> Sequence[LogLine]:
        """The run's own log."""
        return self._log[max(0, number + 1) :]

    def procedures(self) -> Sequence[ProcedureEntry]:
        """Nothing can be started."""
        return ()

    def plan(self, procedure: str, arguments: Arguments) -> ProcedurePlan:
        """Nothing can be started.

        Raises
        ------
        ConfigError
            Always.
        """
        raise ConfigError(READ_ONLY_REASON)


def _step(course: RecordedStream, position: float) -> int:
    return max(1, min(course.length, int(np.ceil(position * course.length))))


def _loop_state(run: RunContent) -> LoopState:
    if not run.loops:
        return LoopState()
    label, loop = list(run.loops.items())[-1]
    peak = None if loop.strehl is None else loop.strehl.peak
    known = peak is not None and np.isfinite(peak.sigma)
    return LoopState(
        closed=False,
        matrix=label,
        gain=loop.gain,
        leak=loop.leak,
        dropped_modes=loop.dropped_modes,
        residual_nm=loop.residual_rms_nm,
        strehl=None if peak is None else peak.value,
        strehl_sigma=peak.sigma if peak is not None and known else None,
    )


def _products(run: RunContent) -> tuple[ProductEntry, ...]:
    """Every FITS product by name, the run's main matrix last."""
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


def _log_lines(text: str) -> tuple[LogLine, ...]:
    """Lines of ``run.log``; what follows a line without a head of its own belongs to it."""
    lines: list[dict[str, Any]] = []
    for raw in text.splitlines():
        head = _LOG_LINE.fullmatch(raw)
        if head is not None:
            at, level, logger, words = head.groups()
            lines.append({"at_utc": at.replace(",", "."), "level": level, "logger": logger, "text": words})
        elif lines:
            lines[-1]["text"] += "\n" + raw
    return tuple(LogLine(number=number, **line) for number, line in enumerate(lines))
