"""Requests of clients, with validation, and the transfer of errors."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

import escape_hw.errors as errors
from escape_hw.config.system import MAX_GAIN
from escape_hw.errors import ConfigError
from escape_hw.io.night_log import MAX_TEXT
from escape_hw.remote.state import Arguments

#: Names of products, procedures and clients.
Name = Annotated[str, Field(min_length=1, max_length=80, pattern=r"^[\w .+@:-]+$")]
ClientId = Annotated[str, Field(min_length=8, max_length=64, pattern=r"^[0-9a-f-]+$")]
#: A loop's gain, in the range of the configuration.
Gain = Annotated[float, Field(gt=0, le=MAX_GAIN, allow_inf_nan=False)]
Share = Annotated[float, Field(ge=0, le=1, allow_inf_nan=False)]


class Request(BaseModel):
    """A request; ``client`` is the number of the sender."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    client: ClientId


def first_error(error: ValidationError) -> str:
    """Location and message of the first validation error."""
    first = error.errors(include_url=False, include_input=False)[0]
    return f"{'.'.join(map(str, first['loc'])) or 'the text'}: {first['msg']}"


class PlainRequest(Request):
    """A request without arguments.

    ``state``, ``geometry``, ``procedures``
        Answered with the documents of :mod:`escape_hw.remote.state`.
    ``heartbeat``
        Keeps the client registered and its lease valid.
    ``release_lease``
        Release the lease.
    ``goodbye``
        Release the lease and the client's place; the client closes its connection.
    ``open_loop``, ``flatten``, ``abort_procedure``
        Open the loop, and abort a procedure that works in closed loop; abort all activity; stop the running
        procedure, whose data are saved. Answered when the mirror is flat.
    ``pause_procedure``, ``resume_procedure``
        Pause the running procedure between two steps, mirror flat; resume it.
    ``clear_fault``
        Release the latched fault and open the devices again.
    ``shutdown``
        Make the mirror safe and end the server.
    """

    verb: Literal[
        "state", "geometry", "procedures", "heartbeat", "release_lease", "goodbye", "open_loop", "flatten",
        "abort_procedure", "pause_procedure", "resume_procedure", "clear_fault", "shutdown",
    ]  # fmt: skip


class RegisterClient(Request):
    """First request of a client: its name and its version of the protocol. Answered with the state.

    The verb and ``schema_version`` are the same in all versions, so that a server can refuse another
    version with a message that its client understands.
    """

    verb: Literal["hello"] = "hello"
    schema_version: int
    name: Name
    host: Name
    pid: int


class GetLog(Request):
    """Answered with the :class:`~escape_hw.remote.state.LogLine` after a number, at most ``count``."""

    verb: Literal["log"] = "log"
    after: int = -1
    count: Annotated[int, Field(ge=1, le=1000)] = 200


class GetLatestSample(Request):
    """Newest sample of a stream, for clients on another computer; answered with its bytes."""

    verb: Literal["latest_sample"] = "latest_sample"
    stream: Name
    #: Index of the sample that the client has; only a newer one is sent.
    after: int = -1


class GetNightLog(Request):
    """Answered with the first ``count`` :class:`~escape_hw.io.night_log.NightEntry` after a number."""

    verb: Literal["night_log"] = "night_log"
    after: int = -1
    count: Annotated[int, Field(ge=1, le=1000)] = 1000


class AddNote(Request):
    """Add a note of the operator, or an alarm of a window, to the night log; answered with the entry."""

    verb: Literal["add_note"] = "add_note"
    text: Annotated[str, Field(min_length=1, max_length=MAX_TEXT)]
    kind: Literal["note", "alarm"] = "note"


class AcquireLease(Request):
    """Acquire the lease; refused while another client holds it."""

    verb: Literal["acquire_lease"] = "acquire_lease"
    #: Take it from its holder; logged.
    take_over: bool = False


class ProcedureRequest(Request):
    """Plan a procedure, or start it.

    ``plan`` moves nothing and is answered with :class:`~escape_hw.remote.state.ProcedurePlan`,
    ``start_procedure`` with the number of the run.
    """

    verb: Literal["plan", "start_procedure"]
    procedure: Name
    arguments: Arguments = Field(default_factory=dict)


class LoopRequest(Request):
    """Parameters of the loop; absent ones stay."""

    gain: Gain | None = None
    leak: Share | None = None
    dropped_modes: Annotated[int, Field(ge=0, le=10000)] | None = None


class CloseLoop(LoopRequest):
    """Close the loop on a matrix until it is opened."""

    verb: Literal["close_loop"] = "close_loop"
    matrix: Name


class SetLoop(LoopRequest):
    """Change parameters of the loop, closed or not. The transition is bumpless."""

    verb: Literal["set_loop"] = "set_loop"
    matrix: Name | None = None


class LoadProduct(Request):
    """Load a FITS product; the path must be in a folder that the server may read."""

    verb: Literal["load_product"] = "load_product"
    path: Annotated[str, Field(min_length=1, max_length=4096, pattern=r"^[^\x00]+$")]
    name: Name | None = None


class SetRecording(Request):
    """Start or stop recording telemetry at full rate."""

    verb: Literal["set_recording"] = "set_recording"
    on: bool
    #: Record the frames of the cameras as well.
    images: bool = True
    #: Stop after this time; ``None``: when requested.
    seconds: Annotated[float, Field(gt=0, le=86_400, allow_inf_nan=False)] | None = None


Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Pixel = Annotated[int, Field(ge=0, le=100_000)]


class CameraRequest(Request):
    """Settings of a camera; absent ones stay.

    ``check_camera`` changes nothing. Both are answered with :class:`~escape_hw.remote.state.CameraPlan`.
    """

    verb: Literal["check_camera", "set_camera"]
    camera: Literal["wfs", "science"]
    exposure_s: Positive | None = None
    frame_rate_hz: Positive | None = None
    gain_db: Annotated[float, Field(allow_inf_nan=False)] | None = None
    #: x, y, width, height.
    region: tuple[Pixel, Pixel, Pixel, Pixel] | None = None


#: Longest time for which a poke is held, seconds.
LONGEST_POKE_S = 30.0


class PokeRequest(Request):
    """Poke one actuator or mode of an idle bench; the mirror returns to flat by itself.

    ``check_poke`` moves nothing. It is answered with :class:`~escape_hw.remote.state.PokePlan`, ``poke`` with
    ``null`` when the poke has begun.
    """

    verb: Literal["check_poke", "poke"]
    kind: Literal["actuator", "mode"]
    number: Annotated[int, Field(ge=0)]
    #: Command of the actuator, or of the actuator that the mode moves most, as fraction of full stroke.
    amplitude: Annotated[float, Field(ge=-1, le=1, allow_inf_nan=False)]
    seconds: Annotated[float, Field(ge=0.1, le=LONGEST_POKE_S, allow_inf_nan=False)] = 2.0


class OffsetsRequest(Request):
    """Set, save or load the offsets; answered with :class:`~escape_hw.remote.state.OffsetsState`.

    ``set_offsets``
        ``terms`` replace all terms, nm rms wavefront by name. ``references`` and ``flat``: keep them, clear
        them, or use the mean of the present slopes and the present shape of the mirror.
    ``save_offsets``, ``load_offsets``
        By ``name``.
    """

    verb: Literal["set_offsets", "save_offsets", "load_offsets"]
    terms: dict[Name, Annotated[float, Field(ge=-1e5, le=1e5, allow_inf_nan=False)]] | None = None
    references: Literal["keep", "clear", "present"] = "keep"
    flat: Literal["keep", "clear", "present"] = "keep"
    name: Name = "offsets"


AnyRequest = Annotated[
    PlainRequest | RegisterClient | GetLog | GetNightLog | AddNote | GetLatestSample | AcquireLease
    | ProcedureRequest | CloseLoop | SetLoop | LoadProduct | SetRecording | CameraRequest
    | PokeRequest | OffsetsRequest,
    Field(discriminator="verb"),
]  # fmt: skip

#: Validates requests; raises :class:`pydantic.ValidationError`.
REQUESTS: TypeAdapter[AnyRequest] = TypeAdapter(AnyRequest)


def build_request(verb: str, **fields: Any) -> AnyRequest:
    """Build a request from a caller's arguments.

    Raises
    ------
    ConfigError
        A field is of the wrong kind or out of range.
    """
    try:
        return REQUESTS.validate_python({"verb": verb, **fields})
    except ValidationError as error:
        raise ConfigError(first_error(error)) from None


#: Requests that are allowed to every connection at any time, registered or not.
SAFETY_VERBS = frozenset({"open_loop", "flatten", "abort_procedure"})
#: Requests that need the lease.
LEASE_VERBS = frozenset({
    "start_procedure", "pause_procedure", "resume_procedure", "close_loop", "set_loop", "load_product",
    "set_recording", "clear_fault", "shutdown", "set_camera", "poke",
    "set_offsets", "save_offsets", "load_offsets",
})  # fmt: skip
#: Requests that change the state.
STATE_CHANGING_VERBS = SAFETY_VERBS | LEASE_VERBS - {"shutdown"} | {"acquire_lease", "release_lease"}


#: Errors that keep their class on the wire, by name; every other one arrives as :class:`EscapeError`.
_KNOWN = {
    name: kind
    for name, kind in vars(errors).items()
    if isinstance(kind, type) and issubclass(kind, errors.EscapeError)
}


def error_to_document(error: BaseException) -> dict[str, str]:
    """Type and message of an error; an exception that is none of ESCAPE is reported as a defect."""
    if isinstance(error, errors.EscapeError):
        return {"type": type(error).__name__, "message": str(error)}
    return {
        "type": errors.EscapeError.__name__,
        "message": f"{type(error).__name__}: {error} (this is a defect of ESCAPE; the server's log has more)",
    }


def error_from_document(document: dict[str, Any]) -> errors.EscapeError:
    """The exception to raise in the client for an error of the server."""
    kind = _KNOWN.get(str(document.get("type")), errors.EscapeError)
    message = str(document.get("message", "the server gave no reason"))
    if issubclass(kind, errors.DeviceError):
        device, _, rest = message.partition(": ")
        return kind(device, rest)
    return kind(message)
