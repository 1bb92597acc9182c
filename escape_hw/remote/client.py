"""Connection to a server: state, streams, log, control."""

from __future__ import annotations

import contextlib
import logging
import os
import re
import socket
import sys
import threading
import time
import uuid
from collections import deque
from collections.abc import Mapping, Sequence
from itertools import takewhile
from pathlib import Path
from typing import Any, Self

import numpy as np

from escape_hw.deprecation import renamed_members
from escape_hw.errors import ClientUnknown, EscapeError, ServerFull, ServerGone
from escape_hw.io.night_log import NightEntry
from escape_hw.remote import requests as ask
from escape_hw.remote.address import Endpoint, resolve
from escape_hw.remote.device_requests import DeviceRequests
from escape_hw.remote.keys import client_keys, keys_hint
from escape_hw.remote.run import RemoteRun
from escape_hw.remote.source import Sample, present_stream
from escape_hw.remote.state import (
    SCHEMA,
    ActiveRun,
    Arguments,
    FinishedRun,
    Geometry,
    Lease,
    LogLine,
    Phase,
    ProcedureEntry,
    ProcedurePlan,
    ProductEntry,
    State,
)
from escape_hw.remote.transport import SLOW_TIMEOUT_S, TIMEOUT_S, ClientTransport
from escape_hw.runtime.procedures.calibration import EscapeProcedure
from escape_hw.runtime.procedures.declaration import present_names
from escape_hw.runtime.procedures.python_method import procedure_method
from escape_hw.runtime.procedures.registry import PROCEDURES
from escape_hw.streams.ring import ReaderCache

log = logging.getLogger(__name__)


def _program() -> str:
    """Default name of this client: the name of its script, or ``notebook``."""
    name = os.path.basename(sys.argv[0])
    return "notebook" if name.startswith("ipykernel") else name or "python"


#: Silence after which a server counts as disconnected; it publishes its state five times a second.
_STALE_S = 2.0
_LINES = 5000
#: Log lines in one reply, the most that a server sends.
_LINES_AT_ONCE = 1000
#: Entries of the night log that are kept: more than two nights.
_NIGHT_ENTRIES = 20_000
#: Longest wait for the reply to the last request, seconds.
_GOODBYE_S = 1.0
#: Longest wait for the state that belongs to a reply, seconds.
_EVENT_S = 10.0


@renamed_members(check="plan")
class Connection(DeviceRequests):
    """A connection to a server, see :func:`connect`; implements :class:`~escape_hw.remote.source.DataSource`.

    It controls the server while it holds the lease. When the server has no free place, ``open_loop``,
    ``flatten`` and ``abort`` work, and the other requests raise ``ServerFull`` until a place is free.

    Parameters
    ----------
    endpoint
        Addresses of the server.
    name
        Name of this client, for the other clients.
    keys
        Keys for a server on another computer.

    Attributes
    ----------
    client
        Number of this client, as in ``state.lease.client``.

    Raises
    ------
    ServerGone
        No reply.
    RequestRefused
        The server has another version.
    """

    def __init__(
        self, endpoint: Endpoint, name: str = "", keys: tuple[bytes, bytes, bytes] | None = None
    ) -> None:
        self.client = str(uuid.uuid4())
        self._name = name or _program()
        self._closed = self._registered = self._waits_for_place = False
        self._changed = threading.Condition()
        self._state = State()
        self._log: deque[LogLine] = deque(maxlen=_LINES)
        self._night: deque[NightEntry] = deque(maxlen=_NIGHT_ENTRIES)
        #: Number of the newest entry of the night log that the server is known to have.
        self._newest_night = -1
        #: Number of the newest line of the log that the server is known to have.
        self._newest_line = -1
        self._ended: dict[int, FinishedRun] = {}
        self._geometry: tuple[object, Geometry] | None = None
        self._procedures: tuple[ProcedureEntry, ...] | None = None
        self._readers = ReaderCache()
        self._is_local = endpoint.requests.startswith("ipc://")
        self._link = ClientTransport(endpoint, self._event, self._heartbeat, self._on_heartbeat_answer, keys)
        try:
            self._register()
        except ServerFull as error:
            # The safety requests need no place; the heartbeat takes the next free one.
            self._waits_for_place = True
            log.warning("%s", error)
        except EscapeError:
            self.close()
            raise

    def _register(self) -> None:
        answer, _, _ = self._link.send_request(self._registration(), TIMEOUT_S)
        self._registered, self._waits_for_place = True, False
        with self._changed:
            self._state = State.model_validate(answer)
        lines, _ = self._request("log", after=self._last_line, count=_LINES_AT_ONCE)
        self._add_log_lines(lines)
        self._read_night_log()

    def _add_log_lines(self, documents: Sequence[Mapping[str, Any]]) -> None:
        with self._changed:
            lines = map(LogLine.model_validate, documents)
            self._log.extend(line for line in lines if line.number > self._last_line)

    @property
    def _last_line(self) -> int:
        """Number of the last line of the log up to which none is missing."""
        return self._log[-1].number if self._log else -1

    def _read_night_log(self) -> None:
        """Read the entries of the night log that this client does not have."""
        while answer := self._request("night_log", after=self._last_night)[0]:
            self._add_night_entries(answer)

    @property
    def _last_night(self) -> int:
        """Number of the last entry of the night log up to which none is missing."""
        return self._night[-1].number if self._night else -1

    def _add_night_entries(self, documents: Sequence[Mapping[str, Any]]) -> None:
        with self._changed:
            known = {entry.number: entry for entry in self._night}
            known |= {one["number"]: NightEntry.model_validate(one) for one in documents}
            self._night = deque((known[number] for number in sorted(known)), maxlen=_NIGHT_ENTRIES)

    def _registration(self) -> Mapping[str, Any]:
        name, host = (re.sub(r"[^\w .+@:-]", "-", text)[:80] for text in (self._name, socket.gethostname()))
        hello = ask.RegisterClient(
            client=self.client, schema_version=SCHEMA, name=name, host=host, pid=os.getpid()
        )
        return hello.model_dump(mode="json")

    # ------------------------------------------------------------ life
    def close(self) -> None:
        """Release the lease and the place at the server, and close the connection; the server continues.

        A running procedure needs another client in control.
        """
        if self._closed:
            return
        connected, self._closed = self.connected, True
        if self._registered or self._waits_for_place:
            # No further heartbeat, which would register this client again.
            self._registered = self._waits_for_place = False
            if connected:
                with contextlib.suppress(EscapeError):
                    self._link.send_request({"verb": "goodbye", "client": self.client}, _GOODBYE_S)
        self._link.close()
        self._readers.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __repr__(self) -> str:
        state = self.state
        connected = "connected" if self.connected else "disconnected"
        return f"<Connection to {state.system}, {state.phase.value}, {connected}>"

    def _repr_html_(self) -> str:
        return self.state._repr_html_()

    def _heartbeat(self, refused: bool) -> Mapping[str, Any] | None:
        if self._waits_for_place:
            return self._registration()
        if not self._registered:
            return None
        # A client that was suspended for long is no longer registered.
        if refused:
            return self._registration()
        # What was published while this client was disconnected, or too slow.
        if self._newest_night > (last := self._last_night):
            return {"verb": "night_log", "client": self.client, "after": last}
        if self._newest_line > (line := self._last_line):
            return {"verb": "log", "client": self.client, "after": line, "count": _LINES_AT_ONCE}
        return {"verb": "heartbeat", "client": self.client}

    def _on_heartbeat_answer(self, answer: Any) -> None:
        if isinstance(answer, list):
            if answer and "logger" in answer[0]:
                self._add_log_lines(answer)
            else:
                self._add_night_entries(answer)
        elif isinstance(answer, dict) and not self._closed:
            self._registered, self._waits_for_place = True, False

    def _request(self, verb: str, timeout_s: float = TIMEOUT_S, **fields: Any) -> tuple[Any, bytes]:
        """Send a request; returns its answer and bytes (ConfigError: a field is out of range)."""
        request = ask.build_request(verb, client=self.client, **fields)
        document = request.model_dump(mode="json")
        try:
            answer, data, serial = self._link.send_request(document, timeout_s)
        except ClientUnknown:
            self._register()
            answer, data, serial = self._link.send_request(document, timeout_s)
        if verb in ask.STATE_CHANGING_VERBS:
            # Events and replies use different sockets: wait for the state that shows the effect.
            with self._changed:
                self._changed.wait_for(lambda: self._state.serial >= serial, _EVENT_S)
        return answer, data

    def _event(self, topic: str, document: dict[str, Any]) -> None:
        with self._changed:
            if topic == "state":
                self._state = State.model_validate(document)
                self._newest_night = max(self._newest_night, self._state.last_night_entry)
                self._newest_line = max(self._newest_line, self._state.last_log_line)
            elif topic == "log":
                line = LogLine.model_validate(document)
                self._newest_line = max(self._newest_line, line.number)
                # After a gap, the next heartbeat requests this line with those before it.
                if line.number == self._last_line + 1:
                    self._log.append(line)
            elif topic == "night":
                entry = NightEntry.model_validate(document)
                self._newest_night = max(self._newest_night, entry.number)
                # After a gap, the next heartbeat requests this entry with those before it.
                if entry.number == self._last_night + 1:
                    self._night.append(entry)
            elif topic == "progress":
                running = ActiveRun.model_validate(document)
                self._state = self._state.model_copy(update={"active_run": running})
            elif topic == "ended":
                ended = FinishedRun.model_validate(document)
                self._ended[ended.id] = ended
            self._changed.notify_all()

    # ------------------------------------------------------------ read only
    @property
    def connected(self) -> bool:
        """Whether the server has sent a message within the last seconds."""
        return not self._closed and time.monotonic() - self._link.last_message_s < _STALE_S

    @property
    def state(self) -> State:
        """The newest state."""
        return self._state

    @property
    def holds_lease(self) -> bool:
        """Whether this client has control, by the newest state."""
        lease = self._state.lease
        return lease is not None and lease.client == self.client

    def latest(self, stream: str, after: int = -1) -> Sample | None:
        """The newest entry of a stream; ``None`` when there is none newer than ``after``."""
        stream = present_stream(stream)
        if not self._is_local:
            return self._latest_over_network(stream, after)
        segment = next((one.segment for one in self._state.streams if one.name == stream), None)
        reader = self._readers.reader(stream, segment)
        return None if reader is None else reader.latest(after)

    def _latest_over_network(self, stream: str, after: int) -> Sample | None:
        try:
            head, data = self._request("latest_sample", stream=stream, after=after)
        except ServerGone:
            return None
        if head is None:
            return None
        array = np.frombuffer(data, np.dtype(head["dtype"])).reshape(head["shape"])
        return Sample(head["index"], head["exposed_ns"], head["arrived_ns"], array, head["meta"])

    def geometry(self) -> Geometry:
        """Positions of the sub-apertures and actuators; requested again when they change.

        Empty until an engine has started; the last ones while there is none.
        """
        state = self._state
        key = (state.engine_pid, state.phase is Phase.STARTING, state.geometry_version)
        known = self._geometry
        if state.engine_pid and (known is None or known[0] != key):
            try:
                answer, _ = self._request("geometry")
            except EscapeError:
                return Geometry() if known is None else known[1]
            known = self._geometry = (key, Geometry.model_validate(answer))
        return Geometry() if known is None else known[1]

    def log_after(self, number: int) -> Sequence[LogLine]:
        """Log lines with a larger number."""
        with self._changed:
            return [line for line in self._log if line.number > number]

    def night_after(self, number: int) -> Sequence[NightEntry]:
        """Entries of the night log with a larger number: notes, events and samples of the performance."""
        with self._changed:
            # New entries are at the end, and few.
            new = list(takewhile(lambda entry: entry.number > number, reversed(self._night)))
        return new[::-1]

    def add_note(self, text: str, kind: str = "note") -> NightEntry:
        """Add a note to the night log of the server; needs no control. ``kind`` is ``note`` or ``alarm``."""
        answer, _ = self._request("add_note", text=text, kind=kind)
        return NightEntry.model_validate(answer)

    def procedures(self) -> Sequence[ProcedureEntry]:
        """The procedures with their parameters."""
        if self._procedures is None:
            answer, _ = self._request("procedures", SLOW_TIMEOUT_S)
            self._procedures = tuple(ProcedureEntry.model_validate(entry) for entry in answer)
        return self._procedures

    def plan(self, procedure: str, arguments: Arguments | None = None) -> ProcedurePlan:
        """Plan a procedure: frames, seconds, largest poke, warnings. Nothing moves.

        Raises
        ------
        ConfigError
            An argument is unknown or out of range.
        """
        answer, _ = self._request("plan", SLOW_TIMEOUT_S, procedure=procedure, arguments=arguments or {})
        return ProcedurePlan.model_validate(answer)

    def wait_for(self, run: int, timeout_s: float) -> FinishedRun | None:
        """The end of a run; ``None`` when it has not ended within the time-out."""
        with self._changed:
            found = self._finished_run(run)
            if found is None:
                self._changed.wait(timeout_s)
                found = self._finished_run(run)
            return found

    def _finished_run(self, run: int) -> FinishedRun | None:
        last = self._state.last_run
        return last if last is not None and last.id == run else self._ended.get(run)

    # ------------------------------------------------------------ the lease
    def acquire(self, take_over: bool = False) -> Lease:
        """Acquire control until :meth:`release` or :meth:`close`.

        Raises
        ------
        LeaseHeld
            Another client has control.
        """
        answer, _ = self._request("acquire_lease", take_over=take_over)
        lease = Lease.model_validate(answer)
        self._set_lease(lease)
        return lease

    def release(self) -> None:
        """Release control; does nothing when the server is gone."""
        try:
            self._request("release_lease", 1.0)
        except ServerGone:
            return
        self._set_lease(None)

    def _set_lease(self, lease: Lease | None) -> None:
        """Enter the lease into the present state, before the server publishes the next one."""
        with self._changed:
            self._state = self._state.model_copy(update={"lease": lease})

    # ------------------------------------------------------------ safety
    def open_loop(self) -> None:
        """Open the loop; returns when the mirror is flat. Needs no control."""
        self._request("open_loop", SLOW_TIMEOUT_S)

    def flatten(self) -> None:
        """Abort all activity; returns when the mirror is flat. Needs no control."""
        self._request("flatten", SLOW_TIMEOUT_S)

    def abort(self) -> None:
        """Abort the procedure and save its data; returns when the mirror is flat. Needs no control."""
        self._request("abort_procedure", SLOW_TIMEOUT_S)

    # ------------------------------------------------------------ control
    def start(self, procedure: str, **arguments: float | int | bool | str | None) -> RemoteRun:
        """Start a procedure.

        Parameters
        ----------
        procedure
            Name of the procedure; :meth:`procedures` lists names and parameters.
        arguments
            Values of its parameters by name.

        Raises
        ------
        LeaseHeld
            Another client has control.
        ConfigError
            An argument is wrong.
        RequestRefused
            The server is busy.
        """
        declared = next((each for each in PROCEDURES if each.name == procedure), None)
        if declared is not None:
            arguments = present_names(declared.parameters(), arguments)
        number, _ = self._request("start_procedure", SLOW_TIMEOUT_S, procedure=procedure, arguments=arguments)
        return RemoteRun(self, int(number), procedure)

    @procedure_method(EscapeProcedure)
    def calibrate(
        self,
        method: str = "escape",
        *,
        frames: int | None = None,
        poke: float | None = None,
        snr: float | None = None,
        accuracy: float | None = None,
        closed_loop: str | None = None,
        pokes: str | None = None,
        whiten: bool | None = None,
        estimator: str | None = None,
        solver: str | None = None,
        modes_choice: str | None = None,
        loss: str | None = None,
        extra_parameters: str | None = None,
        resume: str | None = None,
        progress: bool = False,
        **arguments: float | int | bool | str | None,
    ) -> Any:
        """Calibrate and wait for the result.

        Parameters
        ----------
        method
            Name of the calibration, or of another procedure; not every method has all parameters.
        arguments
            Parameters of a procedure that is not a calibration.

        Returns
        -------
        CalibrationResult or dict
            See :meth:`RemoteRun.wait`.

        Raises
        ------
        LeaseHeld, ConfigError, RequestRefused
            See :meth:`start`.
        Aborted, CalibrationError, ServerGone
            See :meth:`RemoteRun.wait`.
        """
        declared = {
            "frames": frames, "poke": poke, "snr": snr, "accuracy": accuracy, "closed_loop": closed_loop,
            "pokes": pokes, "whiten": whiten, "estimator": estimator, "solver": solver,
            "modes_choice": modes_choice, "loss": loss, "extra_parameters": extra_parameters,
            "resume": resume,
        }  # fmt: skip
        given = {name: value for name, value in declared.items() if value is not None}
        return self.start(method, **given, **arguments).wait(progress=progress)

    def pause(self) -> None:
        """Pause the running procedure between two steps, mirror flat."""
        self._request("pause_procedure")

    def resume(self) -> None:
        """Resume a paused procedure."""
        self._request("resume_procedure")

    def close_loop(
        self,
        matrix: str,
        gain: float | None = None,
        leak: float | None = None,
        dropped_modes: int | None = None,
    ) -> None:
        """Close the loop with a matrix of ``state.products`` until it is opened."""
        self._request(
            "close_loop", SLOW_TIMEOUT_S, matrix=matrix, gain=gain, leak=leak, dropped_modes=dropped_modes
        )

    def set_loop(
        self,
        matrix: str | None = None,
        gain: float | None = None,
        leak: float | None = None,
        dropped_modes: int | None = None,
    ) -> None:
        """Change parameters of the loop, closed or not; absent ones stay."""
        self._request(
            "set_loop", SLOW_TIMEOUT_S, matrix=matrix, gain=gain, leak=leak, dropped_modes=dropped_modes
        )

    def load_product(self, path: str | Path, name: str | None = None) -> ProductEntry:
        """Load a FITS product into the server, by default under its file's name."""
        answer, _ = self._request("load_product", SLOW_TIMEOUT_S, path=str(path), name=name)
        return ProductEntry.model_validate(answer)

    def record(self, on: bool, *, images: bool = True, seconds: float | None = None) -> None:
        """Start or stop recording telemetry at full rate.

        Parameters
        ----------
        on
            Start or stop; nothing happens if it is in that state already.
        images
            Record the frames of the cameras as well, which are most of the data.
        seconds
            Stop after this time; by default when requested.
        """
        self._request("set_recording", SLOW_TIMEOUT_S, on=on, images=images, seconds=seconds)

    def clear_fault(self) -> None:
        """Release the latched fault; closed devices are opened again."""
        self._request("clear_fault", SLOW_TIMEOUT_S)

    def shutdown(self) -> None:
        """Make the mirror safe and end the server."""
        self._request("shutdown")


def connect(address: str, *, control: bool = False, take_over: bool = False, name: str = "") -> Connection:
    """Connect to a server.

    Parameters
    ----------
    address
        Name of a system that is served on this machine (``escape serve``), or ``tcp://host:port``.
    control
        Acquire control at once.
    take_over
        Take control from the client that has it; logged.
    name
        Name of this client, for the other clients; by default the program's name.

    Raises
    ------
    ServerGone
        No server answers at this address.
    LeaseHeld
        Another client has control.
    ConfigError
        The address is invalid, or a key for it is missing.
    """
    endpoint = resolve(address)
    keys = client_keys(endpoint.requests)
    try:
        connection = Connection(endpoint, name, keys)
    except ServerGone as error:
        raise ServerGone(f"{address}: {error}{keys_hint(endpoint.requests, keys)}") from None
    try:
        if control or take_over:
            connection.acquire(take_over)
    except BaseException:
        connection.close()
        raise
    return connection
