"""What decides whether an action is possible now, and the words for why it is not."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from escape_hw.remote.state import Phase, State


@dataclass(frozen=True, slots=True)
class RequestContext:
    """What decides whether an action is possible now.

    Parameters
    ----------
    state
        Newest state.
    connected
        The other side was heard of lately.
    live
        Requests can be made at all: no replay.
    may_write
        The lease is ours.
    """

    state: State
    connected: bool
    live: bool
    may_write: bool


#: What stands for a number that nobody knows.
UNKNOWN_VALUE = "–"


def is_measured(state: State) -> bool:
    """Whether a server measures the state's numbers; a recording, or no word yet, leaves them at zero."""
    return state.server_pid != 0


def has_frames(state: State) -> bool:
    """Whether frames have come, so that what is said of the light is true."""
    return is_measured(state) and state.rates.frames > 0


#: Says why an action is impossible now; empty when it is possible.
UnavailableReason = Callable[[RequestContext], str]


def always_available(_: RequestContext) -> str:
    """Nothing is in the way."""
    return ""


def reason_no_request(now: RequestContext) -> str:
    """Why no request can be made at all."""
    if not now.connected and not is_measured(now.state):
        return "no server was found yet; start one with 'escape serve SYSTEM'"
    if not now.live:
        return "a finished run is replayed, there is no server to ask"
    return "" if now.connected else "the server does not answer"


def reason_no_write(now: RequestContext) -> str:
    """Why nothing can be changed."""
    if reason := reason_no_request(now):
        return reason
    if now.may_write:
        return ""
    holder = now.state.lease
    return f"{holder.name} on {holder.host} has control" if holder else "take control first (Ctrl+L)"


def reason_no_abort(now: RequestContext) -> str:
    """Why there is nothing to abort."""
    return reason_no_request(now) or ("" if now.state.active_run else "no procedure runs")


def reason_no_pause(now: RequestContext) -> str:
    """Why the procedure cannot be halted or continued."""
    return reason_no_write(now) or ("" if now.state.active_run else "no procedure runs")


def reason_no_take_control(now: RequestContext) -> str:
    """Why control cannot be taken."""
    return reason_no_request(now) or ("you have control" if now.may_write else "")


def reason_no_release(now: RequestContext) -> str:
    """Why control cannot be given back."""
    return reason_no_request(now) or ("" if now.may_write else "you do not have control")


def reason_no_clear_fault(now: RequestContext) -> str:
    """Why there is no fault to clear."""
    return reason_no_write(now) or ("" if now.state.phase is Phase.FAULT else "there is no fault")
