"""The error tree: every failure names its subject, the value, the limit and the way out."""

from __future__ import annotations


class EscapeError(Exception):
    """Root of every error this package raises on purpose."""

    exit_code = 1


class ConfigError(EscapeError):
    """A configuration or command-line value is wrong; nothing was opened."""

    exit_code = 2


class DeviceError(EscapeError):
    """A device refused, failed or vanished.

    The message starts with the device's name, so that a log line stands alone.
    """

    exit_code = 3

    def __init__(self, device: str, message: str) -> None:
        # Both stay in ``args``: that is what lets the error cross to another process.
        super().__init__(device, message)
        self.device = device

    def __str__(self) -> str:
        return f"{self.args[0]}: {self.args[1]}"


class NotOpen(DeviceError):
    """A device was used before ``open()`` or after ``close()``."""


class DeviceLost(DeviceError):
    """The device vanished (unplugged, powered off, link closed)."""


class FrameTimeout(DeviceError):
    """No frame arrived before the deadline."""


class SettingRejected(DeviceError):
    """A setting is outside what the device can do."""


class CommandRejected(DeviceError):
    """A mirror command was refused whole; the last good shape is kept."""


class CalibrationError(EscapeError):
    """A calibration could not reach a trustworthy result."""


class TooFewFrames(CalibrationError):
    """The data cannot constrain what was asked for."""


class ProductError(EscapeError):
    """A stored product is damaged, foreign or of the wrong kind."""

    exit_code = 2


class IncompatibleProduct(ProductError):
    """A product belongs to another system, sensor, basis or mode (simulated against hardware)."""


class StorageError(EscapeError):
    """A result could not be written."""


class Aborted(EscapeError):
    """The operator stopped a procedure; what was measured so far is kept."""

    exit_code = 130

    def __init__(self, message: str = "aborted by the operator", partial: object = None) -> None:
        super().__init__(message)
        self.partial = partial


class LeaseHeld(EscapeError):
    """The client does not have control of the server."""


class ServerGone(EscapeError):
    """No server answers."""

    exit_code = 3


class RequestRefused(EscapeError):
    """A server does not take a request: malformed, not now, or not from here."""

    exit_code = 2


class ClientUnknown(RequestRefused):
    """A server does not know who asks: it was started anew, or had not heard of the client for long."""
