"""Exceptions of ESCAPE. Messages name the subject, the value, the limit and the remedy."""

from __future__ import annotations

import traceback
from collections.abc import Mapping
from os.path import basename


class EscapeError(Exception):
    """Base class of all exceptions raised by ESCAPE; ``exit_code`` is that of the command line.

    ``device`` is the name of the device that raised it, empty for other causes.
    """

    exit_code = 1
    device = ""


class ConfigError(EscapeError):
    """A configuration or command-line value is invalid; nothing was opened."""

    exit_code = 2


class DeviceError(EscapeError):
    """A device rejected a request, failed or was lost; the text begins with the name of the device."""

    exit_code = 3

    def __init__(self, device: str, message: str) -> None:
        # Both are in ``args`` so that the exception can be pickled and sent to another process.
        super().__init__(device, message)
        self.device = device

    def __str__(self) -> str:
        return f"{self.args[0]}: {self.args[1]}"


class NotOpen(DeviceError):
    """A device was used before ``open()`` or after ``close()``."""


class DeviceLost(DeviceError):
    """The connection to a device was lost (unplugged, powered off, link closed)."""


class FrameTimeout(DeviceError):
    """No frame arrived before the deadline."""


class SettingRejected(DeviceError):
    """A setting is outside the range of the device."""


class CommandRejected(DeviceError):
    """A mirror command was rejected; the last shape is kept."""


class CalibrationError(EscapeError):
    """A calibration did not give a valid result."""


class TooFewFrames(CalibrationError):
    """Too few frames to estimate the requested quantity."""


class ProductError(EscapeError):
    """A stored product is damaged, not a product of ESCAPE, or of the wrong kind."""

    exit_code = 2


class IncompatibleProduct(ProductError):
    """A product belongs to another system, sensor, basis or mode (simulation, hardware)."""


class StorageError(EscapeError):
    """A result could not be written."""


class Aborted(EscapeError):
    """The operator stopped a procedure; ``partial`` is its result so far, or ``None``.

    ``stopped_at`` has the last progress: the ``stage`` that was stopped, its steps ``done`` and in ``total``,
    and their ``unit``; empty if there was none.
    """

    exit_code = 130

    def __init__(
        self,
        message: str = "aborted by the operator",
        partial: object = None,
        stopped_at: Mapping[str, str | int] | None = None,
    ) -> None:
        super().__init__(message)
        self.partial = partial
        self.stopped_at = dict(stopped_at or {})


class LeaseHeld(EscapeError):
    """The client does not have control of the server."""


class ServerGone(EscapeError):
    """The server does not answer."""

    exit_code = 3


class RequestRefused(EscapeError):
    """The server rejects a request: malformed, not possible now, or not permitted."""

    exit_code = 2


class ClientUnknown(RequestRefused):
    """The client is not registered with the server, for example after a restart of the server."""


class ServerFull(RequestRefused):
    """The server has no free place for a client; open_loop, flatten and abort work all the same."""


def raised_at(error: BaseException) -> str:
    """Where an exception of somebody else's code was raised: `` (acme.py, line 12)``; empty if unknown."""
    frames = traceback.extract_tb(error.__traceback__)
    return f" ({basename(frames[-1].filename)}, line {frames[-1].lineno})" if frames else ""
