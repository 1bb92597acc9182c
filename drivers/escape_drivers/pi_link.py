"""Questions and commands to a PI controller, each confirmed, over a wire that may fail."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Iterator
from typing import TypeVar

from escape_drivers import pi_gcs
from escape_drivers.pi_errors import Refused
from escape_drivers.pi_gcs import Garbled, ReplyReader
from escape_drivers.pi_transports import Transport, WireLost
from escape_hw.errors import DeviceError, DeviceLost

T = TypeVar("T")
log = logging.getLogger(__name__)

#: What every controller of this maker says of itself.
_MAKER = "Physik Instrumente"
#: A long reply may take so many times the time-out, as long as some of it comes within each.
_DRIBBLE = 10


class Unconfirmed(DeviceError):
    """A command was sent whose confirmation never came; nobody knows whether it was carried out."""


class Link:
    """One controller at the other end of a wire.

    A question whose answer is lost or nonsense is asked once more, after both ends have been brought
    together again: an identity question goes out, and everything up to its answer is thrown away. A
    dead peer is noticed within three times ``timeout_s``; from then on every call fails at once.

    Parameters
    ----------
    name
        Of the device, for messages.
    transport
        The wire.
    timeout_s
        Longest wait for an answer.
    """

    def __init__(self, name: str, transport: Transport, timeout_s: float) -> None:
        self.name, self._transport, self._timeout_s = name, transport, timeout_s
        self._reader = ReplyReader()
        self._lock = threading.RLock()
        self._dead = "not connected"
        self.identity = ""
        #: Times that the ends had to be brought together again, since connecting.
        self.recoveries = 0

    # ------------------------------------------------------------------ connection
    def open(self) -> None:
        """Connect, and learn who is there.

        Raises
        ------
        DeviceLost
            Nobody, or nobody who speaks this language.
        """
        with self._lock:
            self._reader.clear()
            self._dead, self.identity, self.recoveries = "", "", 0
            try:
                self._transport.open()
            except WireLost as error:
                raise self._lost(str(error)) from error
            self._meet()

    def close(self) -> None:
        """Disconnect."""
        with self._lock:
            self._transport.close()
            self._dead = self._dead or "disconnected"

    @property
    def alive(self) -> bool:
        """False once the peer has been lost."""
        return not self._dead

    # ------------------------------------------------------------------ exchange
    def ask(self, parse: Callable[[list[str]], T], question: str, *arguments: str | float) -> T:
        """The answer to a question, understood.

        Parameters
        ----------
        parse
            Makes something of the reply's lines; raises :class:`~escape_drivers.pi_gcs.Garbled`.
        question
            Mnemonic, such as ``POS?``.

        Raises
        ------
        Refused
            The controller does not answer that question.
        DeviceLost
            The peer is dead or gone.
        """
        with self._lock:
            return self._ask(parse, pi_gcs.line(question, *arguments))

    def ask_byte(self, number: int) -> int:
        """The mask that answers a question of a single byte, such as 9 (generators running)."""
        with self._lock:
            return self._ask(lambda reply: pi_gcs.whole(pi_gcs.single(reply), 16), bytes([number]))

    def tell(self, command: str, *arguments: str | float, again: bool = True) -> None:
        """Give a command and ask how it went.

        Parameters
        ----------
        again
            The command may be repeated when its confirmation was lost: it names a state, not a change.

        Raises
        ------
        Refused
            The controller refused it.
        Unconfirmed
            Nobody knows.
        DeviceLost
            The peer is dead or gone.
        """
        text = pi_gcs.line(command, *arguments)
        with self._lock:
            for last in (not again, True):
                try:
                    number = self._exchange(text + b"ERR?\n", _error)
                except Garbled as trouble:
                    number = self._meet(trouble)
                    if number == 0:
                        if last:
                            raise self._unconfirmed(text, trouble) from trouble
                        continue
                if number:
                    raise Refused(self.name, number, _shown(text))
                return

    def _ask(self, parse: Callable[[list[str]], T], text: bytes) -> T:
        for last in (False, True):
            try:
                return self._exchange(text, parse)
            except Garbled as trouble:
                number = self._meet(trouble)
                if number:
                    raise Refused(self.name, number, _shown(text)) from trouble
                if last:
                    raise DeviceError(
                        self.name,
                        f"'{_shown(text)}' was not answered sensibly, twice ({trouble}); see the wiring and "
                        "whether another program speaks to the controller, then open again",
                    ) from trouble
        raise AssertionError("not reached")

    def _exchange(self, text: bytes, parse: Callable[[list[str]], T]) -> T:
        """Send, and understand what comes back within the time."""
        self.require_alive()
        try:
            self._clear_away()
            self._transport.write(text)
            reply = self._receive_all()
        except WireLost as error:
            raise self._lost(str(error)) from error
        if reply is None:
            raise Garbled(f"no answer within {self._timeout_s:g} s")
        return parse(reply)

    def _clear_away(self) -> None:
        """What lies there before a question is no answer to it."""
        stale = self._transport.read(0.0)
        if stale or self._reader.pending:
            log.warning(
                "%s: %d bytes that nobody had asked for", self.name, len(stale) + self._reader.pending
            )
            self._reader.clear()

    def _receive_all(self) -> list[str] | None:
        """The next reply: its beginning within the time, the rest as long as it keeps coming."""
        last = time.monotonic() + _DRIBBLE * self._timeout_s
        while True:
            before = self._reader.pending
            reply = self._receive(min(last, time.monotonic() + self._timeout_s))
            if reply is not None or self._reader.pending == before or time.monotonic() >= last:
                return reply

    def _receive(self, deadline: float) -> list[str] | None:
        """The next complete reply; ``None`` when it does not come in time.

        What has arrived by the deadline counts, even if this thread was not let run meanwhile.
        """
        late = False
        while True:
            reply = self._reader.take()
            if reply is not None or late:
                return reply
            left = deadline - time.monotonic()
            late = left <= 0
            self._reader.feed(self._transport.read(max(left, 0.0)))

    def _replies(self, deadline: float) -> Iterator[list[str]]:
        """The replies that come in time; one that has been waiting may be late, no second one."""
        while (reply := self._receive(deadline)) is not None:
            yield reply
            if time.monotonic() > deadline:
                return

    # ------------------------------------------------------------------ recovery
    def _meet(self, trouble: Garbled | None = None) -> int:
        """Bring both ends together: throw away all that comes before the answer to an identity question.

        Returns the controller's pending error, which is hereby cleared.
        """
        self.require_alive()
        if trouble is not None:
            self.recoveries += 1
            log.warning("%s: %s; link recovered by an identity question", self.name, trouble)
        try:
            # Twice, for the answer to this question may be the one that gets lost.
            for _ in range(2):
                self._reader.clear()
                # The line feed ends whatever half a command may still lie at the other end.
                self._transport.write(b"\n*IDN?\n")
                if self._await_identity(time.monotonic() + self._timeout_s):
                    self._transport.write(b"ERR?\n")
                    number = self._await_number(time.monotonic() + self._timeout_s)
                    if number is not None:
                        return number
        except WireLost as error:
            raise self._lost(str(error)) from error
        except Garbled as error:
            raise self._lost(
                f"{self._transport.where} sends nonsense ({error}); is it a PI controller?"
            ) from error
        raise self._lost(
            f"{self._transport.where} does not answer (waited {2 * self._timeout_s:g} s); is the "
            "controller switched on and not hung up? Switch it off and on, then open again"
        )

    def _await_identity(self, deadline: float) -> bool:
        for reply in self._replies(deadline):
            if self.identity and reply[-1].endswith(self.identity):
                return True
            if not self.identity and _MAKER in reply[-1]:
                # What an unfinished reply of an earlier session left before it does not belong to it.
                self.identity = reply[-1][max(reply[-1].rfind("(c)"), 0) :].strip()
                return True
        return False

    def _await_number(self, deadline: float) -> int | None:
        """The answer to ``ERR?`` behind what still comes of the identity; ``None`` if none comes in time."""
        for reply in self._replies(deadline):
            if not reply[-1].endswith(self.identity):
                return _error(reply) if reply[-1].strip().isdigit() else None
        return None

    def require_alive(self) -> None:
        """Raise :class:`DeviceLost` once the peer has been lost."""
        if self._dead:
            raise DeviceLost(self.name, self._dead)

    def _lost(self, why: str) -> DeviceLost:
        self._dead = why
        self._transport.close()
        return DeviceLost(self.name, why)

    def _unconfirmed(self, text: bytes, trouble: Garbled) -> Unconfirmed:
        return Unconfirmed(
            self.name,
            f"'{_shown(text)}' was not confirmed ({trouble}); the link works again, but whether the "
            "command was carried out is unknown: park, then start again",
        )


def _error(reply: list[str]) -> int:
    """The number that ``ERR?`` tells."""
    return pi_gcs.whole(pi_gcs.single(reply))


def _shown(text: bytes) -> str:
    """A command as people write it, cut where it gets long."""
    if len(text) == 1:
        return f"#{text[0]}"
    shown = text.decode("ascii").splitlines()[0]
    return shown if len(shown) <= 60 else f"{shown[:57]}..."
