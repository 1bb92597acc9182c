"""The client: what scripts, notebooks and screens hold in hand."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from escape_hw.errors import ServerGone
from escape_hw.remote import requests as ask
from escape_hw.remote.address import resolve
from escape_hw.remote.keys import client_keys, keys_hint
from escape_hw.remote.run import Run
from escape_hw.remote.state import Lease, Product
from escape_hw.remote.viewer import SLOW_S, Viewer


class Connection(Viewer):
    """A connection to a server, see :func:`connect`: looks and, with the right to write, acts."""

    def close(self) -> None:
        """Give the lease back and hang up; what runs goes on as long as somebody else takes it up."""
        if self.holds_lease and self.connected:
            self.release()
        super().close()

    # ------------------------------------------------------------ the lease
    def acquire(self, take_over: bool = False) -> Lease:
        """Ask for the right to write; it is held until :meth:`release` or :meth:`close`.

        Raises
        ------
        LeaseHeld
            Somebody else has it; says who.
        """
        answer, _ = self._ask(ask.made(ask.Acquire, client=self.client, take_over=take_over))
        lease = Lease.model_validate(answer)
        self._became_holder(lease)
        return lease

    def release(self) -> None:
        """Give the right to write back; does nothing when the server has gone."""
        try:
            self._ask(ask.Release(client=self.client), 1.0)
        except ServerGone:
            return
        self._became_holder(None)

    def _became_holder(self, lease: Lease | None) -> None:
        """Know it at once, not with the next state."""
        with self._changed:
            self._state = self._state.model_copy(update={"lease": lease})

    # ------------------------------------------------------------ safety
    def open_loop(self) -> None:
        """Open the loop; returns when the mirror is flat. Anybody may."""
        self._ask(ask.OpenLoop(client=self.client), SLOW_S)

    def flatten(self) -> None:
        """Abort what runs, open the loop; returns when the mirror is flat. Anybody may."""
        self._ask(ask.Flatten(client=self.client), SLOW_S)

    def abort(self) -> None:
        """Stop the procedure, keeping what it measured; returns when the mirror is flat. Anybody may."""
        self._ask(ask.Abort(client=self.client), SLOW_S)

    # ------------------------------------------------------------ to write
    def start(self, procedure: str, **arguments: float | int | bool | str | None) -> Run:
        """Start a procedure.

        Raises
        ------
        LeaseHeld
            This client may not write.
        ConfigError
            An argument is wrong.
        RequestRefused
            Something else is going on.
        """
        request = ask.made(ask.Start, client=self.client, procedure=procedure, arguments=arguments)
        number, _ = self._ask(request, SLOW_S)
        return Run(self, int(number), procedure)

    def calibrate(self, method: str = "escape", *, progress: bool = False, **arguments: Any) -> Any:
        """Calibrate and wait for the result; arguments as for :meth:`start`."""
        return self.start(method, **arguments).wait(progress=progress)

    def pause(self) -> None:
        """Halt the running procedure between two steps, mirror flat."""
        self._ask(ask.Pause(client=self.client))

    def resume(self) -> None:
        """Go on with a halted procedure."""
        self._ask(ask.Resume(client=self.client))

    def close_loop(
        self,
        matrix: str,
        gain: float | None = None,
        leak: float | None = None,
        dropped_modes: int | None = None,
    ) -> None:
        """Close the loop on a matrix that the server holds, until it is opened."""
        request = ask.made(
            ask.CloseLoop,
            client=self.client,
            matrix=matrix,
            gain=gain,
            leak=leak,
            dropped_modes=dropped_modes,
        )  # fmt: skip
        self._ask(request, SLOW_S)

    def set_loop(
        self,
        matrix: str | None = None,
        gain: float | None = None,
        leak: float | None = None,
        dropped_modes: int | None = None,
    ) -> None:
        """Other parameters for the loop, closed or not; what is absent stays."""
        request = ask.made(
            ask.SetLoop, client=self.client, matrix=matrix, gain=gain, leak=leak, dropped_modes=dropped_modes
        )
        self._ask(request, SLOW_S)

    def load_product(self, path: str | Path, name: str | None = None) -> Product:
        """Load a FITS product into the engine, under its file's name by default."""
        answer, _ = self._ask(
            ask.made(ask.LoadProduct, client=self.client, path=str(path), name=name), SLOW_S
        )
        return Product.model_validate(answer)

    def record(self, on: bool) -> None:
        """Begin or end recording telemetry at full rate."""
        self._ask(ask.made(ask.Record, client=self.client, on=on), SLOW_S)

    def clear_fault(self) -> None:
        """End a fault's latch; closed devices are opened again."""
        self._ask(ask.ClearFault(client=self.client), SLOW_S)

    def shutdown(self) -> None:
        """Make the mirror safe and end the server."""
        self._ask(ask.Shutdown(client=self.client))


def connect(address: str, *, control: bool = False, take_over: bool = False, name: str = "") -> Connection:
    """Connect to a server.

    Parameters
    ----------
    address
        Name of a system that is served on this machine (``escape serve``), or ``tcp://host:port``.
    control
        Ask for the right to write at once.
    take_over
        Take it from whoever has it; logged.
    name
        Who this is, for the other clients; the program's name by default.

    Raises
    ------
    ServerGone
        No server answers there.
    LeaseHeld
        Somebody else has the right to write.
    ConfigError
        The address means nothing, or there are no keys for it.
    """
    endpoint = resolve(address)
    keys = client_keys(endpoint.requests)
    try:
        connection = Connection(endpoint, name, keys)
    except ServerGone as error:
        raise ServerGone(f"{error}{keys_hint(endpoint.requests, keys)}") from None
    try:
        if control or take_over:
            connection.acquire(take_over)
    except BaseException:
        connection.close()
        raise
    return connection
