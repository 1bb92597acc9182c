"""A procedure that was started, from the client's side."""

from __future__ import annotations

import sys
import time
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any

from escape_hw.api.procedure import Progress
from escape_hw.errors import Aborted, CalibrationError, ServerGone
from escape_hw.remote.state import Ended, Finish, Running

if TYPE_CHECKING:
    from escape_hw.remote.viewer import Viewer

#: A server that was not heard of for so long does not come back with a result.
_PATIENCE_S = 15.0


class Run:
    """A run on a server.

    Parameters
    ----------
    connection
        To the server.
    id
        Its number there.
    name
        The procedure.
    """

    def __init__(self, connection: Viewer, id: int, name: str) -> None:
        self._connection, self.id, self.name = connection, id, name

    def __repr__(self) -> str:
        ended = self.ended
        return f"<run {self.id}: {self.name}, {'running' if ended is None else ended.finish.value}>"

    @property
    def ended(self) -> Ended | None:
        """How it ended; ``None`` while it runs."""
        return self._connection.wait_for(self.id, 0.0)

    @property
    def running(self) -> Running | None:
        """How far it is; ``None`` when it has ended."""
        running = self._connection.state.procedure
        return running if running is not None and running.id == self.id else None

    def wait(self, timeout_s: float | None = None, progress: bool = False) -> Any:
        """Wait for the end and load the result.

        Parameters
        ----------
        timeout_s
            Longest wait; for ever by default.
        progress
            Show a bar with the time left, in a terminal or a notebook.

        Returns
        -------
        CalibrationResult, LoopResult, GainsResult or dict
            What the procedure returns on the command line's side; the run's document where it has no
            product that this machine can read.

        Raises
        ------
        Aborted
            It was aborted; ``partial`` holds what was measured, if anything.
        CalibrationError
            It failed; the message says why.
        TimeoutError
            It goes on.
        ServerGone
            Its server was not heard of any more.
        """
        from rich.console import Console

        from escape_hw.runtime.progress import ProgressView

        deadline = None if timeout_s is None else time.monotonic() + timeout_s
        heard = time.monotonic()
        with ProgressView(Console(file=sys.stderr)) if progress else nullcontext() as view:
            while (ended := self._connection.wait_for(self.id, 0.2)) is None:
                now = time.monotonic()
                heard = now if self._connection.connected else heard
                if now - heard > _PATIENCE_S:
                    raise ServerGone(
                        f"run {self.id}: its server has not been heard of for {now - heard:.0f} s"
                    )
                if deadline is not None and now > deadline:
                    raise TimeoutError(f"run {self.id} ({self.name}) goes on")
                self._require_engine()
                if view is not None and (running := self.running) is not None:
                    view(_progress(running))
        return self._result(ended)

    def _require_engine(self) -> None:
        """A run ends with its engine, without another word."""
        state = self._connection.state
        if state.procedure is not None or state.fault is None or state.engine_pid:
            return
        if self._connection.wait_for(self.id, 0.0) is None:
            raise CalibrationError(f"run {self.id} ({self.name}) ended with its engine: {state.fault.reason}")

    def _result(self, ended: Ended) -> Any:
        if ended.finish is Finish.FAILED:
            raise CalibrationError(f"run {self.id} ({self.name}): {ended.message}")
        result = load_result(ended)
        if ended.finish is Finish.ABORTED:
            raise Aborted(f"run {self.id} ({self.name}): {ended.message}", result)
        return result


def load_result(ended: Ended) -> Any:
    """The result of a run from its product, or its document where there is none that can be read here."""
    from escape_hw.io.fits import load_matrix
    from escape_hw.io.gains import load_gains
    from escape_hw.io.psf import load_loop

    loaders = {"gains": load_gains, "loop": load_loop, "im": load_matrix}
    for key, load in loaders.items():
        path = ended.products.get(key)
        if path is not None and Path(path).is_file():
            return load(path).result  # type: ignore[attr-defined]
    return ended.document or None


def _progress(running: Running) -> Progress:
    return Progress(
        running.stage, running.done, running.total, running.unit, running.elapsed_s, running.metrics
    )
