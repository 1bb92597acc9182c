"""Pokes, one per frame, and the slopes that they make."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.frames import Frame
from escape_hw.api.procedure import Procedure, Reporter
from escape_hw.api.sensor import SensorGeometry, SlopeFunction, SubApertureGrid
from escape_hw.bench import Bench
from escape_hw.calibration.acquire import LightWatch, Motion, next_frame, reachable
from escape_hw.calibration.docrime_estimator import DocrimeEstimator
from escape_hw.calibration.loop_run import Injection
from escape_hw.calibration.mean_focus import MeanFocus
from escape_hw.calibration.preview import Preview
from escape_hw.calibration.sensor_kinds import kind_of
from escape_hw.calibration.sensor_setup import extractor, prepare_sensor, refined, setup_from_frames
from escape_hw.calibration.stopping import Looks
from escape_hw.errors import Aborted
from escape_hw.io.state_file import RunState

#: Seconds of turbulence over which what it leaves in the geometry averages out well enough.
_REFERENCE_S = 10.0

#: Parts of a run whose mean frames are compared.
_LOOKS = 6

Record = tuple[NDArray[np.int64], NDArray[np.float32], NDArray[np.float32]]


@dataclass(slots=True, eq=False)
class PokeSession:
    """State of a run: frames wait until the geometry is known, then become slopes at once.

    Parameters
    ----------
    bench
        An open bench, loop open.
    m2c
        Mode-to-command matrix ``(n_act, n_modes)``.
    grid
        The sensor's geometry, when it is known already; found on the first frames otherwise.
    setup_frames
        How many first frames to find it on.
    estimator
        Makes the estimator that takes the slopes, from their number; ``None``: there is none.
    keep
        Whether to keep slopes and pokes.
    looks
        What is done with the estimate on the way.
    """

    bench: Bench
    m2c: NDArray[np.float64]
    grid: SensorGeometry | None
    setup_frames: int
    make_estimator: Callable[[int], DocrimeEstimator] | None
    keep: bool = False
    looks: Looks | None = None
    mean_frame: NDArray[np.float32] | None = None
    slopes_of: SlopeFunction | None = None
    estimator: DocrimeEstimator | None = None
    motion: Motion | None = None
    focus: MeanFocus | None = None
    light: LightWatch | None = None
    waiting: list[tuple[Frame, NDArray[np.float64]]] = field(default_factory=list)
    taken: int = 0
    fed: int = 0
    shortened: int = 0
    planned: int = 0
    long_look: bool = False
    looked: dict[int, tuple[NDArray[np.float64], int]] = field(default_factory=dict)
    kept: list[tuple[int, NDArray[np.float32], NDArray[np.float64]]] = field(default_factory=list)

    def poke(self, frames: int, pokes: Injection, stage: str = "DO-CRIME") -> Procedure[bool]:
        """Send pokes, one per frame, and take the frames; the mirror ends flat.

        Parameters
        ----------
        frames
            How many, with those of the run that this one goes on with.
        pokes
            Gives the modal poke of each frame ``(n_modes,)``.
        stage
            Name of the stage in progress reports.

        Returns
        -------
        bool
            Whether the operator stopped it early; that the estimate will do is no reason to complain.
        """
        bench, to_modes = self.bench, np.linalg.pinv(self.m2c)
        self.planned = frames
        report, preview = Reporter(stage, frames), Preview(self.m2c.shape[1], lambda: self.grid)
        try:
            bench.dm.flatten()
            prepare_sensor(bench)
            try:
                for done in range(self.taken, frames):
                    frame = next_frame(bench)
                    wanted = self.m2c @ pokes()
                    allowed = reachable(bench.dm, wanted)
                    self.shortened += not np.array_equal(wanted, allowed)
                    # What was really sent, not what was asked for: a shortened poke is still a known poke.
                    self._take(frame, to_modes @ bench.dm.send(allowed).sent)
                    if self.looks is not None and self.looks.due(self.fed) and (yield from self._look_at()):
                        return False
                    if report.due():
                        yield report(done + 1, self._picture(preview), shortened=float(self.shortened))
            except Aborted:
                yield from self._look_at(last=True)
                return True
        finally:
            bench.dm.flatten()
        return False

    def _picture(self, preview: Preview) -> Mapping[str, NDArray[np.float32]] | None:
        """The matrix so far, when it is time to show it."""
        if self.estimator is None or not preview.due():
            return None
        return preview(self.estimator.preview)

    def _look_at(self, last: bool = False) -> Procedure[bool]:
        """Keep the state and judge the estimate, as far as either is due."""
        if self.looks is None or self.estimator is None or self.grid is None or self.motion is None:
            return False
        # A model of the sensor has to match how far its spots moved.
        grid = self.motion.of(self.grid)
        parts = {str(part): count for part, (_, count) in self.looked.items()}
        values = {"taken": self.taken, "fed": self.fed, "shortened": self.shortened, "looked": parts}
        arrays: dict[str, NDArray[Any]] = {"motion": self.motion.state()}
        if self.mean_frame is not None:
            arrays["mean_frame"] = self.mean_frame
        if self.focus is not None:
            arrays["focus"] = self.focus.state()
        arrays |= {f"looked.{part}": total for part, (total, _) in self.looked.items()}
        return (yield from self.looks.look(self.estimator, grid, self.fed, values, arrays, always=last))

    def restore(self, state: RunState) -> None:
        """Go on from what a run that was broken off has kept."""
        if state.grid is None:
            raise RuntimeError("a state without a geometry was kept")
        self.grid = state.grid
        self.mean_frame = state.arrays.get("mean_frame")
        self._set_up()
        if self.motion is None or self.estimator is None:
            raise RuntimeError("the sensor was never set up")
        self.taken, self.fed = int(state.values["taken"]), int(state.values["fed"])
        self.shortened = int(state.values["shortened"])
        self.motion.restore(state.arrays["motion"])
        if self.focus is not None and "focus" in state.arrays:
            self.focus.restore(state.arrays["focus"])
        self.looked = {
            int(part): (state.arrays[f"looked.{part}"], int(count))
            for part, count in state.values["looked"].items()
        }
        self.estimator.restore(state.values, state.arrays)

    def _take(self, frame: Frame, poke: NDArray[np.float64]) -> None:
        self.taken += 1
        if self.slopes_of is None:
            self.waiting.append((frame, poke))
            if self.grid is not None or len(self.waiting) >= self.setup_frames:
                self.ready()
        else:
            self._feed(frame, poke)

    def ready(self) -> None:
        """Set up the sensor, on the frames that wait if no grid was given, and work them off."""
        if self.slopes_of is not None or not self.waiting:
            return
        if self.grid is None:
            total = np.zeros(self.waiting[0][0].data.shape)
            for frame, _ in self.waiting:
                total += frame.data
            mean = (total / len(self.waiting)).astype(np.float32)
            setup = setup_from_frames(self.bench, mean)
            self.grid, self.mean_frame = setup.grid, setup.mean_frame
        self._set_up()
        for frame, poke in self.waiting:
            self._feed(frame, poke)
        self.waiting = []

    def _set_up(self) -> None:
        """Everything that needs the geometry."""
        if self.grid is None:
            raise RuntimeError("the geometry is not known")
        self.slopes_of, self.long_look = extractor(self.bench, self.grid), kind_of(self.bench).long_look
        self.motion, self.light = Motion(self.grid.n_slopes), LightWatch(self.bench.wfs.name, self.grid)
        if self.mean_frame is not None and isinstance(self.grid, SubApertureGrid):
            self.focus = MeanFocus(self.grid, self.bench.wfs.settings.frame_rate_hz)
        if self.make_estimator is not None:
            self.estimator = self.make_estimator(self.grid.n_slopes)

    def finished_grid(self) -> SensorGeometry:
        """The grid with all that the run taught about it; given references stay as they were."""
        if self.grid is None or self.motion is None:
            raise RuntimeError("the sensor was never set up")
        grid = self.motion.of(self.grid)
        if self.mean_frame is None:
            return grid
        if self.looked:
            means = [(total / count).astype(np.float32) for total, count in self.looked.values()]
            grid = refined(self.bench, grid, means)
        return self.motion.references(grid, self.focus)

    def notes(self) -> tuple[str, ...]:
        """What to know of the references before closing a loop on them."""
        seconds = self.taken / self.bench.wfs.settings.frame_rate_hz
        stands_still = self.focus is not None and self.focus.still() is not None
        if self.grid is None or self.mean_frame is None or seconds >= _REFERENCE_S or stands_still:
            return ()
        return (self.grid.short_look.format(seconds=seconds),)

    def _feed(self, frame: Frame, poke: NDArray[np.float64]) -> None:
        if self.slopes_of is None or self.motion is None or self.light is None:
            raise RuntimeError("frames were fed before the sensor was set up")
        slopes = self.slopes_of(frame.data)
        self.light(self.slopes_of.flux)
        self.motion.add(slopes, poke)
        if self.focus is not None:
            self.focus.add(slopes)
        if self.long_look:
            self._look(frame)
        self.fed += 1
        if self.estimator is not None:
            self.estimator.partial_fit(frame.index, slopes, poke)
        if self.keep:
            self.kept.append((frame.index, slopes, poke))

    def _look(self, frame: Frame) -> None:
        """Add a frame to the sum of its part of the run."""
        part = min(self.fed * _LOOKS // max(self.planned, 1), _LOOKS - 1)
        if part not in self.looked:
            self.looked[part] = frame.data.astype(np.float64), 1
            return
        total, count = self.looked[part]
        total += frame.data
        self.looked[part] = total, count + 1

    def record(self) -> Record | None:
        """Frame indices ``(n,)``, slopes ``(n, n_slopes)`` and pokes ``(n, n_modes)``, if they were kept."""
        if not self.kept:
            return None
        index, slopes, pokes = zip(*self.kept, strict=True)
        return np.array(index, np.int64), np.stack(slopes), np.stack(pokes).astype(np.float32)
