"""What a server tells of itself: one document, the same for every screen."""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field

#: Version of the documents below; a client of another version is refused.
SCHEMA = 1


class StateDocument(BaseModel):
    """A part of the state: immutable, and nothing unknown in it."""

    model_config = ConfigDict(frozen=True, extra="forbid")


class Phase(StrEnum):
    """What the engine, the process that owns the devices, is doing."""

    STARTING = "starting"
    #: Devices open, mirror flat, frames watched.
    IDLE = "idle"
    #: The loop is closed and nothing else goes on.
    LOOP = "loop"
    #: A procedure runs, in open or closed loop.
    PROCEDURE = "procedure"
    #: Mirror made safe after a fault; latched until somebody clears it.
    FAULT = "fault"
    STOPPED = "stopped"


class DeviceHealth(StrEnum):
    """A device's condition."""

    OK = "ok"
    #: Nothing heard for longer than its period.
    STALE = "stale"
    LOST = "lost"
    FAULT = "fault"
    CLOSED = "closed"


class FaultState(StateDocument):
    """Why the mirror was made safe."""

    reason: str
    at_utc: str
    #: What the operator can do.
    way_out: str = ""


class Lease(StateDocument):
    """Who may write."""

    client: str
    name: str
    host: str
    pid: int
    since_utc: str


class DeviceState(StateDocument):
    """One device."""

    #: Its key in ``[devices]``: ``dm``, ``wfs``, ``science``, ``screen``, ``modulator``.
    name: str
    kind: str
    model: str
    serial: str
    simulated: bool
    health: DeviceHealth
    #: Worth showing, units in the key: ``{"temperature_c": 31.2, "frame_rate_hz": 500.0}``.
    facts: dict[str, float | str] = Field(default_factory=dict)
    message: str = ""


class FrameCounters(StateDocument):
    """Frames, counted."""

    frame_hz: float = 0.0
    frames: int = 0
    #: Frames the camera made and nobody got, of the loop or procedure that runs or ran last.
    lost: int = 0


class Illumination(StateDocument):
    """What the sensor's camera sees."""

    #: Share of pixels at the top of their range, 0 to 1.
    saturated: float = 0.0
    #: Brightest pixel as share of the range.
    peak: float = 0.0


class MirrorState(StateDocument):
    """Commands as fraction of full stroke."""

    rms: float = 0.0
    peak: float = 0.0
    #: Share of the actuators held at a limit, mean over the last second.
    clipped: float = 0.0
    #: How often it was flattened: no loop is the same one before and after.
    flattened: int = 0


class LatencyState(StateDocument):
    """Microseconds from a frame in hand to its command sent, and between frames, last second."""

    p50: float = 0.0
    p99: float = 0.0
    largest: float = 0.0
    #: 99th percentile of the deviation of the frames' spacing from its median.
    jitter_p99: float = 0.0


class LoopState(StateDocument):
    """The loop and its parameters."""

    closed: bool = False
    #: Name of the matrix in use, as in ``State.products``.
    matrix: str = ""
    gain: float = 0.0
    leak: float = 0.0
    dropped_modes: int = 0
    modes: int = 0
    residual_nm: float = 0.0
    #: Running Strehl ratio of the science camera by its peak, where there is one and a model PSF.
    strehl: float | None = None
    strehl_sigma: float | None = None


class Finish(StrEnum):
    """How a procedure ended."""

    DONE = "done"
    ABORTED = "aborted"
    FAILED = "failed"


class ActiveRun(StateDocument):
    """The procedure that runs."""

    id: int
    name: str
    arguments: dict[str, Any]
    stage: str = ""
    done: int = 0
    total: int = 0
    unit: str = "frame"
    elapsed_s: float = 0.0
    #: Seconds left in this stage; ``None``: not known yet.
    remaining_s: float | None = None
    metrics: dict[str, float] = Field(default_factory=dict)
    paused: bool = False
    started_utc: str = ""


class FinishedRun(StateDocument):
    """A procedure that ended."""

    id: int
    name: str
    finish: Finish
    message: str = ""
    #: Run folder.
    folder: str = ""
    #: Name -> path.
    products: dict[str, str] = Field(default_factory=dict)
    #: The run's ``result.json``.
    document: dict[str, Any] = Field(default_factory=dict)


class ProductEntry(StateDocument):
    """A matrix or PSF that the engine holds, by name."""

    name: str
    #: ``matrix``, ``gains``, ``psf``.
    kind: str
    path: str
    #: One line for a list: method, frames, modes.
    summary: str = ""


class RecordingState(StateDocument):
    """Recording at full rate."""

    recording: bool = False
    path: str = ""
    written: int = 0
    #: Frames that were not written because the disk was behind.
    dropped: int = 0
    #: Why the last recording ended by itself: a full disk.
    fault: str = ""


class DiskState(StateDocument):
    """Where runs go."""

    folder: str = ""
    free_gb: float = 0.0


class StreamEntry(StateDocument):
    """A stream and the shared memory it lies in."""

    name: str
    segment: str
    unit: str = ""


class State(StateDocument):
    """Everything a screen shows, but for the pictures."""

    schema_version: int = SCHEMA
    #: Counts up with every change.
    serial: int = 0
    at_utc: str = ""
    server_pid: int = 0
    engine_pid: int = 0
    version: str = ""
    system: str = ""
    simulated: bool = True
    seed: int = 0
    phase: Phase = Phase.STARTING
    fault: FaultState | None = None
    lease: Lease | None = None
    devices: tuple[DeviceState, ...] = ()
    rates: FrameCounters = FrameCounters()
    light: Illumination = Illumination()
    mirror: MirrorState = MirrorState()
    latency: LatencyState = LatencyState()
    loop: LoopState = LoopState()
    procedure: ActiveRun | None = None
    last: FinishedRun | None = None
    products: tuple[ProductEntry, ...] = ()
    telemetry: RecordingState = RecordingState()
    disk: DiskState = DiskState()
    streams: tuple[StreamEntry, ...] = ()
    #: Counts up whenever the sensor's geometry changes: time to ask for it again.
    geometries: int = 0
    clients: int = 0
    #: Messages that were no requests, or none that may be made: malformed, too large, without the lease.
    refused: int = 0
    #: What the server found when it started: a crash before, a calibration that can be resumed.
    notes: tuple[str, ...] = ()

    def _repr_html_(self) -> str:
        from escape_hw.remote.html import state_html

        return state_html(self)


class LogLine(StateDocument):
    """One line of the log."""

    number: int
    at_utc: str
    level: str
    logger: str
    text: str


class Geometry(StateDocument):
    """Where slopes and actuators stand, for maps."""

    #: Valid sub-apertures, rows of 0 and 1; slopes run through them row by row, all x and then all y.
    valid: tuple[str, ...] = ()
    #: Actuators on their grid, rows of 0 and 1; empty when they stand on none.
    layout: tuple[str, ...] = ()
    #: Places (x, y) in metres of actuators without a grid.
    places_m: tuple[tuple[float, float], ...] = ()
    #: Sub-aperture or pupil outlines on the camera: (x, y, half width) in pixels each.
    outlines_px: tuple[tuple[float, float, float], ...] = ()
    n_modes: int = 0


#: Arguments of a procedure by name.
Arguments = dict[str, Annotated[float, Field(allow_inf_nan=False)] | int | bool | str | None]


class ProcedurePlan(StateDocument):
    """Duration and poke amplitude of a procedure, computed before anything moves."""

    name: str
    arguments: dict[str, Any]
    #: Frames it will take, and seconds at the camera's rate.
    frames: int
    seconds: float
    #: Largest poke of an actuator, as fraction of full stroke.
    stroke: float
    warnings: tuple[str, ...] = ()

    def _repr_html_(self) -> str:
        from escape_hw.remote.html import plan_html

        return plan_html(self)


class ProcedureParameter(StateDocument):
    """One parameter of a procedure, with all that a form needs."""

    name: str
    #: ``int``, ``float``, ``bool``, ``choice``, ``text``, ``matrix`` (a name out of ``State.products``).
    kind: str
    default: float | int | bool | str | None = None
    unit: str = ""
    help: str = ""
    #: Words for a form; derived from the name if empty.
    label: str = ""
    choices: tuple[str, ...] = ()
    low: float | None = None
    high: float | None = None


class ProcedureEntry(StateDocument):
    """A procedure that a server offers."""

    name: str
    title: str
    help: str
    parameters: tuple[ProcedureParameter, ...] = ()

    def _repr_html_(self) -> str:
        from escape_hw.remote.html import procedure_html

        return procedure_html(self)
