"""Errors on the wire: what an exception becomes, and which exception it becomes again."""

from __future__ import annotations

from typing import Any

from escape_hw import errors

#: The errors that keep their class across the wire, by name; whatever else is raised arrives as the root.
_KNOWN = {
    name: kind
    for name, kind in vars(errors).items()
    if isinstance(kind, type) and issubclass(kind, errors.EscapeError)
}


def to_wire(error: BaseException) -> dict[str, str]:
    """Type and message of an error; one that is not ESCAPE's own is called a defect."""
    if isinstance(error, errors.EscapeError):
        return {"type": type(error).__name__, "message": str(error)}
    return {
        "type": errors.EscapeError.__name__,
        "message": f"{type(error).__name__}: {error} (this is a defect of ESCAPE; the server's log has more)",
    }


def from_wire(document: dict[str, Any]) -> errors.EscapeError:
    """The exception to raise here for an error that was raised there."""
    kind = _KNOWN.get(str(document.get("type")), errors.EscapeError)
    message = str(document.get("message", "the server gave no reason"))
    if issubclass(kind, errors.DeviceError):
        device, _, rest = message.partition(": ")
        return kind(device, rest)
    return kind(message)
