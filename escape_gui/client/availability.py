"""Preconditions of requests: whether an action is available, and the reason if it is not."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from escape_hw.remote.state import Phase, State


@dataclass(frozen=True, slots=True)
class RequestContext:
    """Facts that decide whether an action is available."""

    #: Newest state.
    state: State
    #: The server responded recently.
    connected: bool
    #: The source is a server, not a recorded run.
    live: bool
    #: This client holds the lease.
    may_write: bool


#: Shown instead of a number that is not measured.
UNKNOWN_VALUE = "–"
#: Returns the reason why an action is unavailable; empty if it is available.
UnavailableReason = Callable[[RequestContext], str]


def tooltip(tip: str, reason: str) -> str:
    """Tooltip of a control, with the reason if it is unavailable."""
    return f"{tip} Not now: {reason}." if reason else tip


def is_measured(state: State) -> bool:
    """Whether a server measures the numbers of a state; without one, or in a recording, they are zero."""
    return state.server_pid != 0


def has_engine(state: State) -> bool:
    """Whether an engine runs; without one, rates, illumination and latency are not measured."""
    return is_measured(state) and state.engine_pid != 0


def has_ended(state: State) -> bool:
    """Whether the engine has died and was not started again."""
    return is_measured(state) and state.engine_pid == 0 and state.phase is Phase.FAULT


def has_frames(state: State) -> bool:
    """Whether frames have arrived, so that the illumination is known."""
    return has_engine(state) and state.rates.frames > 0


def always_available(_: RequestContext) -> str:
    """Available in every context."""
    return ""


def reason_no_request(now: RequestContext) -> str:
    """Why no request can be sent."""
    if not now.connected and not is_measured(now.state):
        return "no server found; start one with 'escape serve SYSTEM'"
    if not now.live:
        return "replay of a recorded run: no server"
    return "" if now.connected else "server not responding"


def reason_no_write(now: RequestContext) -> str:
    """Why nothing can be changed."""
    if reason := reason_no_request(now):
        return reason
    if now.may_write:
        return ""
    holder = now.state.lease
    return f"{holder.name} on {holder.host} has control" if holder else "take control first (Ctrl+L)"


def reason_no_engine(now: RequestContext) -> str:
    """Why the engine cannot answer."""
    if reason := reason_no_request(now):
        return reason
    if now.state.engine_pid:
        return ""
    fault = now.state.fault is not None
    return "the engine has ended; clear the fault to start it again" if fault else "the engine is starting"


def reason_no_change(now: RequestContext) -> str:
    """Why nothing can be changed in the engine."""
    return reason_no_write(now) or reason_no_engine(now)


def reason_no_start(now: RequestContext) -> str:
    """Why neither a procedure nor the loop can be started."""
    return reason_no_change(now) or ("clear the fault first" if now.state.fault is not None else "")


def reason_no_abort(now: RequestContext) -> str:
    """Why there is nothing to abort."""
    return reason_no_request(now) or ("" if now.state.active_run else "no procedure is running")


def reason_no_pause(now: RequestContext) -> str:
    """Why the procedure cannot be paused or resumed."""
    return reason_no_write(now) or ("" if now.state.active_run else "no procedure is running")


def reason_no_take_control(now: RequestContext) -> str:
    """Why control cannot be taken."""
    return reason_no_request(now) or ("you have control" if now.may_write else "")


def reason_no_release(now: RequestContext) -> str:
    """Why control cannot be released."""
    return reason_no_request(now) or ("" if now.may_write else "you do not have control")


def reason_no_clear_fault(now: RequestContext) -> str:
    """Why there is no fault to clear."""
    return reason_no_write(now) or ("" if now.state.phase is Phase.FAULT else "no active fault")
