"""What the numbers mean with which a PI controller refuses a command, and what to do about it."""

from __future__ import annotations

from escape_hw.errors import DeviceError

_SERVO = "open the device anew, which switches the servos on in the right order"
_AXES = "compare devices.modulator.stage.axes with the controller's axes (SAI?, CST?)"
_RANGE = "lower the radius or the centre; the controller's own limits are TMN? and TMX?"
_OURS = "this is a defect of the driver or a firmware that differs; see the bench checklist"
_ERRORS: dict[int, tuple[str, str]] = {
    1: ("syntax error", _OURS),
    2: ("unknown command", _OURS),
    3: ("line too long", _OURS),
    5: ("the servo is off, or the axis has no reference", _SERVO),
    7: ("position out of range", _RANGE),
    8: ("velocity out of range", _OURS),
    10: (
        "stopped by a stop command",
        "see who stopped it (another program, the front panel), then start again",
    ),
    15: ("invalid axis", _AXES),
    17: ("parameter out of range", _OURS),
    22: ("axis named twice", _AXES),
    23: ("illegal axis", _AXES),
    24: ("wrong number of arguments", _OURS),
    25: ("not a number", _OURS),
    26: ("missing argument", _OURS),
    53: ("this parameter cannot be set", _OURS),
    54: ("unknown parameter", _OURS),
    56: ("wrong password", _OURS),
    57: ("record table out of range", _OURS),
    58: ("record source out of range", _AXES),
    59: ("record option out of range", _OURS),
    60: ("protected parameter: command level too low", _OURS),
    61: ("auto-zero is running", "wait until it has ended (about a minute)"),
    63: ("the controller is initialising", "wait a few seconds and open again"),
    64: ("read only", _OURS),
    66: ("voltage out of limits", "see devices.modulator.stage.auto_zero_v"),
    67: ("not enough memory for the wave", "lower devices.modulator.stage.max_points"),
    72: ("an analogue input drives the axis", "take the analogue input off the axis (parameter 0x06000500)"),
    73: ("a wave generator drives the axis", "park first: escape modulator stop"),
    75: ("no wave table is selected", _OURS),
    79: ("the servo is on", _SERVO),
    98: (
        "auto-zero failed",
        "is the platform free to move, the cable of the head plugged in, the load not too heavy?",
    ),
    400: ("wave table out of range", _OURS),
    401: ("wave table undefined", _OURS),
    402: ("unknown wave type", _OURS),
    403: ("wrong length of a wave", _OURS),
    404: ("wrong number of wave parameters", _OURS),
    405: ("wave parameter out of range", _RANGE),
    406: ("bit of WGO not supported", _OURS),
}


class Refused(DeviceError):
    """The controller refused a command; ``number`` is its error."""

    def __init__(self, device: str, number: int, command: str) -> None:
        text, way_out = _ERRORS.get(
            number, ("an error this driver does not know", "see the controller's manual")
        )
        super().__init__(device, f"refused '{command}': error {number}, {text}; {way_out}")
        self.number = number

    def __reduce__(self) -> tuple[object, ...]:
        return (_again, (self.args, self.number))


def _again(args: tuple[str, str], number: int) -> Refused:
    """The same error in another process."""
    error = Refused.__new__(Refused)
    DeviceError.__init__(error, *args)
    error.number = number
    return error
