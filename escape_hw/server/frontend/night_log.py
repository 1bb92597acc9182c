"""The night log of a server: events from changes of the state, notes of clients, samples of performance."""

from __future__ import annotations

import statistics
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

from escape_hw.api.registration import PARAMETERS
from escape_hw.config.system import SystemConfig
from escape_hw.io.night_log import Kind, NightEntry, NightLogWriter
from escape_hw.remote.state import FinishedRun, Phase, State
from escape_hw.report.verdict import assess
from escape_hw.server.frontend.performance_sampler import PerformanceSampler
from escape_hw.version import __version__

#: Seconds between two samples.
SAMPLE_PERIOD_S = 10.0
#: Entries kept in memory: more than two nights of samples.
_MAX_ENTRIES = 20_000


class NightLog:
    """Writes the night log of a system under ``runs`` and publishes every entry.

    All methods belong to the thread of the front end.
    """

    def __init__(self, config: SystemConfig, runs: Path, publish: Callable[[NightEntry], object]) -> None:
        self._writer = NightLogWriter(runs, config.system.name, config.simulated)
        self._entries = deque(self._writer.earlier, maxlen=_MAX_ENTRIES)
        self._publish = publish
        self._sampler = PerformanceSampler(config)
        self._state = State()
        self._sums: dict[str, list[float]] = {}
        self._sampled_s = time.monotonic()

    def start(self, notes: tuple[str, ...]) -> None:
        """Log the start of the server, and its findings on the previous one; start the samples."""
        self.add("event", f"server started, ESCAPE {__version__}")
        for note in notes:
            self.add("event", note)
        self._sampler.start()

    def close(self, clean: bool) -> None:
        """Log the end of the server; ``clean``: its engine ended with a flat mirror."""
        self._sampler.stop()
        self.add(
            "event",
            "server ended, mirror flat" if clean else "server ended, but its engine did not end cleanly",
        )

    def add(
        self, kind: Kind, text: str = "", author: str = "", values: Mapping[str, float] | None = None
    ) -> NightEntry:
        """Write and publish an entry."""
        entry = self._writer.add(kind, text, author, values)
        self._entries.append(entry)
        self._publish(entry)
        return entry

    def after(self, number: int, count: int) -> list[NightEntry]:
        """The oldest ``count`` entries with a larger number."""
        found = [entry for entry in self._entries if entry.number > number]
        return found[:count]

    def update(self, state: State) -> None:
        """Log what changed since the last state, and a sample when it is due."""
        for kind, text in describe_changes(self._state, state):
            self.add(kind, text)
        self._state = state
        self._sampler.state = state
        if state.loop.closed:
            self._collect("strehl", None if state.loop.strehl is None else 100 * state.loop.strehl)
            self._collect("residual_nm", state.loop.residual_nm or None)
        if time.monotonic() - self._sampled_s > SAMPLE_PERIOD_S:
            self._sampled_s = time.monotonic()
            values = {name: statistics.fmean(each) for name, each in self._sums.items()}
            self._sums.clear()
            values |= self._sampler.take()
            if values:
                self.add("sample", values=values)

    def log_run(self, ended: FinishedRun) -> None:
        """Log the end of a run, with its verdict and the values that it measured."""
        verdict = assess(ended.document) if ended.document else None
        words = "; ".join(filter(None, (ended.message, "" if verdict is None else str(verdict))))
        folder = f" [{Path(ended.folder).name}]" if ended.folder else ""
        self.add("event", f"run {ended.id}, {ended.name}: {ended.finish.value}{folder}. {words}".rstrip(". "))
        if values := values_of_run(ended.document):
            self.add("sample", f"run {ended.id}", values=values)

    def _collect(self, name: str, value: float | None) -> None:
        if value is not None:
            self._sums.setdefault(name, []).append(value)


def values_of_run(document: Mapping[str, Any]) -> dict[str, float]:
    """Registration, median optical gain and Strehl ratio in % of a run's document."""
    values: dict[str, Any] = {}
    registration = document.get("registration")
    if isinstance(registration, Mapping) and document.get("converged", True):
        for name in PARAMETERS:
            one = registration.get(name) or {}
            values |= {name: one.get("value"), f"{name}_sigma": one.get("sigma")}
    gains = document.get("optical_gain")
    if isinstance(gains, list):
        finite = [float(gain) for gain in gains if gain is not None]
        values["optical_gain"] = statistics.median(finite) if finite else None
    strehl = document.get("strehl")
    if isinstance(strehl, Mapping):
        peak = strehl.get("peak") or {}
        values["strehl"] = None if peak.get("value") is None else 100 * peak["value"]
    return {name: float(value) for name, value in values.items() if isinstance(value, int | float)}


def describe_changes(before: State, after: State) -> Iterator[tuple[Kind, str]]:
    """Events between two states: faults, closures, settings of the loop, runs, recordings, control."""
    if after.fault is not None and after.fault != before.fault:
        yield "fault", f"FAULT: {after.fault.reason}"
    elif after.fault is None and before.fault is not None:
        yield "event", "fault cleared"
    if before.engine_pid not in (0, after.engine_pid) and after.engine_pid:
        yield "event", f"another engine: process {after.engine_pid}"
    yield from _describe_loop(before, after)
    run, last_run = after.active_run, before.active_run
    if run is not None and run.name == "poke":
        if last_run is None:
            # The stage of a poke, which is no run, is its description.
            yield "event", f"poke of {run.stage}"
    elif run is not None and (last_run is None or run.id != last_run.id):
        words = ", ".join(
            f"{key.replace('_', ' ')} {_argument_text(value)}"
            for key, value in run.arguments.items()
            if value is not None and value != ""
        )
        yield "event", f"run {run.id}, {run.name}: started" + (f" ({words})" if words else "")
    if after.recording.recording and not before.recording.recording:
        yield "event", f"recording telemetry [{Path(after.recording.path).name}]"
    elif before.recording.recording and not after.recording.recording:
        recording = after.recording
        fault = f": {recording.fault}" if recording.fault else ""
        yield "event", f"recorded {recording.written} entries, {recording.dropped} dropped{fault}"
    holder, earlier = after.lease, before.lease
    if holder is not None and (earlier is None or holder.client != earlier.client):
        yield "event", f"{holder.name} on {holder.host} has control"


def _argument_text(value: object) -> str:
    return {True: "yes", False: "no"}[value] if isinstance(value, bool) else str(value)


def _describe_loop(before: State, after: State) -> Iterator[tuple[Kind, str]]:
    """Closures outside procedures, whose own loops are part of their runs."""
    was_closed, is_closed = (one.loop.closed and one.phase is Phase.LOOP for one in (before, after))
    loop, old = after.loop, before.loop
    settings = f"gain {loop.gain:g}, leak {loop.leak:g}, {loop.dropped_modes} modes dropped"
    if is_closed and not was_closed:
        yield "event", f"loop closed on '{loop.matrix}', {settings}"
    elif was_closed and not is_closed:
        yield "event", "loop opened"
    elif is_closed and (loop.matrix, loop.gain, loop.leak, loop.dropped_modes) != (
        old.matrix, old.gain, old.leak, old.dropped_modes,
    ):  # fmt: skip
        yield "event", f"loop now on '{loop.matrix}', {settings}"
