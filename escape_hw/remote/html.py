"""A server's state for notebooks."""

from __future__ import annotations

from html import escape

from escape_hw.remote.state import State


def state_html(state: State) -> str:
    """The state as a small table."""
    rows = {
        "system": f"{state.system} ({'simulated' if state.simulated else 'HARDWARE'})",
        "phase": state.phase.value,
    }
    body = "".join(f"<tr><th>{escape(key)}</th><td>{escape(value)}</td></tr>" for key, value in rows.items())
    return f"<table>{body}</table>"
