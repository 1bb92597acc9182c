"""Questions and commands to a PI controller, each confirmed, over a wire that may fail."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Iterator
from typing import TypeVar

from escape_drivers.pi import gcs as pi_gcs
from escape_drivers.pi.gcs import GcsError, MalformedReply, ReplyReader
from escape_drivers.pi.transports import Transport, TransportLost
from escape_hw.errors import DeviceError, DeviceLost

T = TypeVar("T")
log = logging.getLogger(__name__)

#: Beginning of every identity of this maker.
_MANUFACTURER = "Physik Instrumente"
#: A long reply may take so many times the time-out, as long as some of it comes within each.
_MAX_REPLY_TIMEOUTS = 10


class CommandUnconfirmed(DeviceError):
    """A command was sent but not confirmed; whether it was executed is unknown."""


class GcsLink:
    """One controller at the other end of a wire.

    A question whose answer is lost or invalid is repeated once, after both ends have been brought
    together again: an identity question goes out, and everything up to its answer is thrown away. A
    dead peer is noticed within three times ``timeout_s``; from then on every call raises ``DeviceLost``.
    """

    def __init__(self, name: str, transport: Transport, timeout_s: float) -> None:
        self.name, self._transport, self._timeout_s = name, transport, timeout_s
        self._reader = ReplyReader()
        self._lock = threading.RLock()
        self._lost_reason = "not connected"
        self.identity = ""
        #: Times that the ends had to be brought together again, since connecting.
        self.recoveries = 0

    # ------------------------------------------------------------------ connection
    def open(self) -> None:
        """Connect and read the identity.

        Raises
        ------
        DeviceLost
            No device answers, or it does not speak GCS.
        """
        with self._lock:
            self._reader.clear()
            self._lost_reason, self.identity, self.recoveries = "", "", 0
            try:
                self._transport.open()
            except TransportLost as error:
                raise self._mark_lost(str(error)) from error
            self._resynchronise()

    def close(self) -> None:
        """Disconnect."""
        with self._lock:
            self._transport.close()
            self._lost_reason = self._lost_reason or "disconnected"

    @property
    def is_alive(self) -> bool:
        """False once the peer has been lost."""
        return not self._lost_reason

    # ------------------------------------------------------------------ exchange
    def query(self, parse: Callable[[list[str]], T], question: str, *arguments: str | float) -> T:
        """The answer to a question (a mnemonic such as ``POS?``) as ``parse`` reads the reply's lines.

        Raises
        ------
        GcsError
            The controller does not answer that question.
        DeviceLost
            The connection is lost.
        """
        with self._lock:
            return self._query(parse, pi_gcs.format_command(question, *arguments))

    def query_byte(self, number: int) -> int:
        """The mask that answers a question of a single byte, such as 9 (generators running)."""
        with self._lock:
            return self._query(
                lambda reply: pi_gcs.parse_int(pi_gcs.parse_single_line(reply), 16), bytes([number])
            )

    def send_command(self, command: str, *arguments: str | float, repeatable: bool = True) -> None:
        """Send a command and read the error number.

        A ``repeatable`` command names a state, not a change; it is repeated when its confirmation was lost.

        Raises
        ------
        GcsError
            The controller refused it.
        CommandUnconfirmed
            Whether the command was executed is unknown.
        DeviceLost
            The connection is lost.
        """
        text = pi_gcs.format_command(command, *arguments)
        with self._lock:
            for last in (not repeatable, True):
                try:
                    number = self._exchange(text + b"ERR?\n", pi_gcs.parse_single_int)
                except MalformedReply as cause:
                    number = self._resynchronise(cause)
                    if number == 0:
                        if last:
                            raise self._unconfirmed_error(text, cause) from cause
                        continue
                if number:
                    raise GcsError(self.name, number, _format_for_message(text))
                return

    def _query(self, parse: Callable[[list[str]], T], text: bytes) -> T:
        for last in (False, True):
            try:
                return self._exchange(text, parse)
            except MalformedReply as cause:
                number = self._resynchronise(cause)
                if number:
                    raise GcsError(self.name, number, _format_for_message(text)) from cause
                if last:
                    raise DeviceError(
                        self.name,
                        f"'{_format_for_message(text)}' got two invalid answers ({cause}); see the wiring "
                        "and whether another program uses the controller, then open it again",
                    ) from cause
        raise AssertionError("not reached")

    def _exchange(self, text: bytes, parse: Callable[[list[str]], T]) -> T:
        """Send, and understand what comes back within the time."""
        self.require_connected()
        try:
            self._discard_stale_input()
            self._transport.write(text)
            reply = self._receive_reply()
        except TransportLost as error:
            raise self._mark_lost(str(error)) from error
        if reply is None:
            raise MalformedReply(f"no answer within {self._timeout_s:g} s")
        return parse(reply)

    def _discard_stale_input(self) -> None:
        """Discard bytes received before a question."""
        stale = self._transport.read(0.0)
        if stale or self._reader.pending:
            log.warning("%s: %d unsolicited bytes discarded", self.name, len(stale) + self._reader.pending)
            self._reader.clear()

    def _receive_reply(self) -> list[str] | None:
        """The next reply: its beginning within the time, the rest as long as it keeps coming."""
        last = time.monotonic() + _MAX_REPLY_TIMEOUTS * self._timeout_s
        while True:
            before = self._reader.pending
            reply = self._receive_until(min(last, time.monotonic() + self._timeout_s))
            if reply is not None or self._reader.pending == before or time.monotonic() >= last:
                return reply

    def _receive_until(self, deadline: float) -> list[str] | None:
        """The next complete reply; ``None`` when it does not come in time.

        Bytes received by the deadline count, even if this thread did not run.
        """
        is_last = False
        while True:
            reply = self._reader.next_reply()
            if reply is not None or is_last:
                return reply
            remaining_s = deadline - time.monotonic()
            is_last = remaining_s <= 0
            self._reader.feed(self._transport.read(max(remaining_s, 0.0)))

    def _replies(self, deadline: float) -> Iterator[list[str]]:
        """The replies that come in time; one that has been waiting may be late, no second one."""
        while (reply := self._receive_until(deadline)) is not None:
            yield reply
            if time.monotonic() > deadline:
                return

    # ------------------------------------------------------------------ recovery
    def _resynchronise(self, cause: MalformedReply | None = None) -> int:
        """Bring both ends together: throw away all that comes before the answer to an identity question.

        Returns the controller's pending error, which is hereby cleared.
        """
        self.require_connected()
        if cause is not None:
            self.recoveries += 1
            log.warning("%s: %s; link recovered by an identity question", self.name, cause)
        try:
            # Twice, for the answer to this question may be the one that gets lost.
            for _ in range(2):
                self._reader.clear()
                # The line feed ends a partial command at the controller.
                self._transport.write(b"\n*IDN?\n")
                if self._await_identity(time.monotonic() + self._timeout_s):
                    self._transport.write(b"ERR?\n")
                    number = self._await_number(time.monotonic() + self._timeout_s)
                    if number is not None:
                        return number
        except TransportLost as error:
            raise self._mark_lost(str(error)) from error
        except MalformedReply as error:
            raise self._mark_lost(
                f"{self._transport.where} sends nonsense ({error}); is it a PI controller?"
            ) from error
        raise self._mark_lost(
            f"{self._transport.where} does not answer (waited {2 * self._timeout_s:g} s); is the "
            "controller switched on and not hung up? Switch it off and on, then open again"
        )

    def _await_identity(self, deadline: float) -> bool:
        for reply in self._replies(deadline):
            if self.identity and reply[-1].endswith(self.identity):
                return True
            if not self.identity and _MANUFACTURER in reply[-1]:
                # Bytes of an unfinished reply of an earlier session may precede it.
                self.identity = reply[-1][max(reply[-1].rfind("(c)"), 0) :].strip()
                return True
        return False

    def _await_number(self, deadline: float) -> int | None:
        """The answer to ``ERR?`` after remaining identity replies; ``None`` without one in time."""
        for reply in self._replies(deadline):
            if not reply[-1].endswith(self.identity):
                return pi_gcs.parse_single_int(reply) if reply[-1].strip().isdigit() else None
        return None

    def require_connected(self) -> None:
        """Raise :class:`DeviceLost` once the peer has been lost."""
        if self._lost_reason:
            raise DeviceLost(self.name, self._lost_reason)

    def _mark_lost(self, why: str) -> DeviceLost:
        self._lost_reason = why
        self._transport.close()
        return DeviceLost(self.name, why)

    def _unconfirmed_error(self, text: bytes, cause: MalformedReply) -> CommandUnconfirmed:
        return CommandUnconfirmed(
            self.name,
            f"'{_format_for_message(text)}' was not confirmed ({cause}); the link works again, but "
            "whether the command was executed is unknown: park, then start again",
        )


def _format_for_message(text: bytes) -> str:
    """A command as people write it, cut where it gets long."""
    if len(text) == 1:
        return f"#{text[0]}"
    shown = text.decode("ascii").splitlines()[0]
    return shown if len(shown) <= 60 else f"{shown[:57]}..."
