"""A run on a server, as its client sees it: progress, end and result."""

from __future__ import annotations

import time
from contextlib import nullcontext
from pathlib import Path
from typing import Any, Protocol

from escape_hw.api.procedure import Progress
from escape_hw.errors import Aborted, CalibrationError, ServerGone
from escape_hw.remote.source import DataSource
from escape_hw.remote.state import ActiveRun, Finish, FinishedRun

#: Silence of a server after which waiting for a run ends.
_SERVER_TIMEOUT_S = 15.0


class RunSource(DataSource, Protocol):
    """Connection to the server of a run."""

    def wait_for(self, run: int, timeout_s: float) -> FinishedRun | None:
        """The end of a run; ``None`` when it has not ended within the time-out."""
        ...


class RemoteRun:
    """A run on a server: its number ``id``, and the ``name`` of its procedure."""

    def __init__(self, connection: RunSource, id: int, name: str) -> None:
        self._connection, self.id, self.name = connection, id, name
        self._engine_pid = connection.state.engine_pid

    def __repr__(self) -> str:
        ended = self.ended
        return f"<run {self.id}: {self.name}, {'running' if ended is None else ended.finish.value}>"

    @property
    def ended(self) -> FinishedRun | None:
        """The finished run; ``None`` while it runs."""
        return self._connection.wait_for(self.id, 0.0)

    @property
    def running(self) -> ActiveRun | None:
        """Progress; ``None`` when it has ended."""
        running = self._connection.state.active_run
        return running if running is not None and running.id == self.id else None

    def wait(self, timeout_s: float | None = None, progress: bool = False) -> Any:
        """Wait for the end and load the result.

        Parameters
        ----------
        timeout_s
            Longest wait; unlimited by default.
        progress
            Show a bar with the time left, in a terminal or a notebook.

        Returns
        -------
        CalibrationResult, LoopResult, GainsResult or dict
            The procedure's result, or the run's document when it has no product that this computer can read.

        Raises
        ------
        Aborted
            The run was aborted; ``partial`` holds the data measured so far, if any.
        CalibrationError
            The run failed.
        TimeoutError
            The run continues.
        ServerGone
            The server has been silent for too long.
        """
        from escape_hw.runtime.display.console import DisplayConsole
        from escape_hw.runtime.display.progress import ProgressView

        deadline = None if timeout_s is None else time.monotonic() + timeout_s
        last_message_s = time.monotonic()
        with ProgressView(DisplayConsole()) if progress else nullcontext() as view:
            while (ended := self._connection.wait_for(self.id, 0.2)) is None:
                now = time.monotonic()
                last_message_s = now if self._connection.connected else last_message_s
                if now - last_message_s > _SERVER_TIMEOUT_S:
                    raise ServerGone(
                        f"run {self.id}: its server has been silent for {now - last_message_s:.0f} s"
                    )
                if deadline is not None and now > deadline:
                    raise TimeoutError(
                        f"run {self.id} ({self.name}) has not ended within {timeout_s:g} s; it continues"
                    )
                self._require_engine()
                if view is not None and (running := self.running) is not None:
                    view(
                        Progress(
                            running.stage, running.completed, running.total, running.unit, running.elapsed_s,
                            running.metrics,
                        )
                    )  # fmt: skip
        return self._result(ended)

    def _require_engine(self) -> None:
        """Raise when the engine has died, which ends its run without a further message."""
        state = self._connection.state
        if state.engine_pid:
            if self._engine_pid in (0, state.engine_pid):
                return
            reason = " / ".join(state.notes) or f"process {state.engine_pid} replaces it"
        elif state.fault is not None:
            reason = state.fault.reason
        else:
            return
        if self._connection.wait_for(self.id, 0.0) is None:
            raise CalibrationError(f"run {self.id} ({self.name}) ended with its engine: {reason}")

    def _result(self, ended: FinishedRun) -> Any:
        if ended.finish is Finish.FAILED:
            raise CalibrationError(f"run {self.id} ({self.name}): {ended.message}")
        result = load_result(ended)
        if ended.finish is Finish.ABORTED:
            stopped_at = ended.document.get("stopped_at")
            raise Aborted(f"run {self.id} ({self.name}): {ended.message}", result, stopped_at)
        return result


def load_result(ended: FinishedRun) -> Any:
    """Load the result of a run from its product, or its document when no product can be read here."""
    from escape_hw.io.fits.gains import load_gains
    from escape_hw.io.fits.loop import load_loop
    from escape_hw.io.fits.matrix import load_matrix

    loaders = {"gains": load_gains, "loop": load_loop, "im": load_matrix}
    for key, load in loaders.items():
        path = ended.products.get(key)
        if path is not None and Path(path).is_file():
            return load(path).result  # type: ignore[attr-defined]
    return ended.document or None
