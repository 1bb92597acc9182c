"""Documents that a server sends to its clients: state, runs, products, geometry, procedures, log lines."""

from __future__ import annotations

import warnings
from enum import StrEnum
from typing import TYPE_CHECKING, Annotated, Any

from pydantic import BaseModel, ConfigDict, Field

from escape_hw.api.representation import table_html

#: Version of these documents and of the requests; a client of another version is refused.
SCHEMA = 2


#: Attributes of version 0.1.0 and their present names, by class.
_RENAMED = {
    "FaultState": {"way_out": "remedy"},
    "FrameCounters": {"lost": "lost_frames"},
    "MirrorState": {"clipped": "saturated_share", "flattened": "flatten_count"},
    "LatencyState": {"largest": "max"},
    "LoopState": {"modes": "n_modes"},
    "ActiveRun": {"done": "completed"},
    "Geometry": {"places_m": "positions_m"},
    "State": {
        "light": "illumination", "procedure": "active_run", "last": "last_run", "telemetry": "recording",
        "geometries": "geometry_version", "refused": "refused_requests",
    },
}  # fmt: skip


class StateDocument(BaseModel):
    """Immutable document; unknown keys are an error."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    if not TYPE_CHECKING:

        def __getattr__(self, name: str) -> Any:
            """Attributes of version 0.1.0, with a deprecation message."""
            new = _RENAMED.get(type(self).__name__, {}).get(name)
            if new is None:
                return super().__getattr__(name)
            message = f"{type(self).__name__}.{name} is now called {new}"
            warnings.warn(message, DeprecationWarning, stacklevel=2)
            return getattr(self, new)


class Phase(StrEnum):
    """Activity of the engine, the process that owns the devices."""

    STARTING = "starting"
    #: Devices open, mirror flat, frames read.
    IDLE = "idle"
    #: The loop is closed outside procedures.
    LOOP = "loop"
    #: A procedure runs, in open or closed loop.
    PROCEDURE = "procedure"
    #: Mirror made safe after a fault, which is latched until a client clears it.
    FAULT = "fault"
    STOPPED = "stopped"


class DeviceHealth(StrEnum):
    """A device's condition."""

    OK = "ok"
    #: No frame for longer than the time-out.
    STALE = "stale"
    LOST = "lost"
    FAULT = "fault"
    CLOSED = "closed"


class FaultState(StateDocument):
    """Why the mirror was made safe."""

    reason: str
    at_utc: str
    #: What the operator can do.
    remedy: str = ""


class Lease(StateDocument):
    """The client in control."""

    client: str
    name: str
    host: str
    pid: int
    since_utc: str
    #: Seconds since its last message, and until it loses control if it stays silent.
    silent_s: float = 0.0
    expires_in_s: float = 0.0


class DeviceState(StateDocument):
    """One device."""

    #: Its key in ``[devices]``: ``dm``, ``wfs``, ``science``, ``screen``, ``modulator``.
    name: str
    kind: str
    model: str
    serial: str
    simulated: bool
    health: DeviceHealth
    #: Properties for display, units in the key: ``{"temperature_c": 31.2, "frame_rate_hz": 500.0}``.
    facts: dict[str, float | str] = Field(default_factory=dict)
    message: str = ""


class FrameCounters(StateDocument):
    """Rate and number of frames."""

    frame_hz: float = 0.0
    frames: int = 0
    #: Frames that the camera lost in the present or last loop or procedure.
    lost_frames: int = 0


class Illumination(StateDocument):
    """Illumination of the sensor's camera."""

    #: Share of saturated pixels, 0 to 1.
    saturated: float = 0.0
    #: Brightest pixel as share of full scale.
    peak: float = 0.0


class MirrorState(StateDocument):
    """Commands as fraction of full stroke."""

    rms: float = 0.0
    peak: float = 0.0
    #: Share of the actuators at a limit, mean over the last second.
    saturated_share: float = 0.0
    #: Number of times that the mirror was flattened; a loop does not continue across a flattening.
    flatten_count: int = 0


class LatencyState(StateDocument):
    """Time from frame received to command sent and jitter of the frame interval, last second, in µs."""

    p50: float = 0.0
    p99: float = 0.0
    max: float = 0.0
    #: 99th percentile of the deviation of the frame interval from its median.
    jitter_p99: float = 0.0


class LoopState(StateDocument):
    """The loop and its parameters."""

    closed: bool = False
    #: Name of the matrix in use, as in ``State.products``.
    matrix: str = ""
    gain: float = 0.0
    leak: float = 0.0
    dropped_modes: int = 0
    #: Number of controlled modes, without the dropped ones.
    n_modes: int = 0
    residual_nm: float = 0.0
    #: Running Strehl ratio (peak), with a science camera and a model PSF.
    strehl: float | None = None
    strehl_sigma: float | None = None


class Finish(StrEnum):
    """How a procedure ended."""

    DONE = "done"
    ABORTED = "aborted"
    FAILED = "failed"


class ActiveRun(StateDocument):
    """The run of a procedure."""

    id: int
    name: str
    arguments: dict[str, Any]
    stage: str = ""
    completed: int = 0
    total: int = 0
    unit: str = "frame"
    elapsed_s: float = 0.0
    #: Seconds left in this stage; ``None`` while unknown.
    remaining_s: float | None = None
    metrics: dict[str, float] = Field(default_factory=dict)
    paused: bool = False
    started_utc: str = ""


class FinishedRun(StateDocument):
    """A run that ended."""

    id: int
    name: str
    finish: Finish
    message: str = ""
    #: Run folder.
    folder: str = ""
    #: Path by name.
    products: dict[str, str] = Field(default_factory=dict)
    #: The run's ``result.json``.
    document: dict[str, Any] = Field(default_factory=dict)


class ProductEntry(StateDocument):
    """A product that requests may name."""

    name: str
    #: ``matrix``, ``gains``, ``psf``.
    kind: str
    path: str
    #: Method, frames and modes, in one line.
    summary: str = ""


class OffsetsState(StateDocument):
    """Offsets of the mirror and of the loop's reference slopes."""

    #: nm rms wavefront by name: ``tip``, ``tilt``, ``focus``, ``mode 12``.
    terms: dict[str, float] = Field(default_factory=dict)
    #: Whether reference slopes were measured, and whether there is a flat other than zeros.
    references: bool = False
    flat: bool = False
    #: Offsets saved on the server, by name.
    saved: tuple[str, ...] = ()


class RecordingState(StateDocument):
    """Recording of telemetry at full rate; numbers of entries."""

    recording: bool = False
    path: str = ""
    written: int = 0
    #: Entries that were not written because the disk was too slow.
    dropped: int = 0
    #: Bytes on disk.
    size: int = 0
    started_utc: str = ""
    #: Why the last recording ended without a request, such as a full disk.
    fault: str = ""


class DiskState(StateDocument):
    """Disk of the run folders."""

    folder: str = ""
    free_gb: float = 0.0


class StreamEntry(StateDocument):
    """A stream and its shared memory."""

    name: str
    segment: str
    unit: str = ""


class State(StateDocument):
    """State of a server; arrays are in its streams."""

    schema_version: int = SCHEMA
    #: Number of this document.
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
    illumination: Illumination = Illumination()
    mirror: MirrorState = MirrorState()
    latency: LatencyState = LatencyState()
    loop: LoopState = LoopState()
    active_run: ActiveRun | None = None
    last_run: FinishedRun | None = None
    products: tuple[ProductEntry, ...] = ()
    recording: RecordingState = RecordingState()
    offsets: OffsetsState = OffsetsState()
    disk: DiskState = DiskState()
    streams: tuple[StreamEntry, ...] = ()
    #: Increases whenever the sensor's geometry changes.
    geometry_version: int = 0
    #: Number of the newest entry of the night log; -1 if there is none.
    last_night_entry: int = -1
    #: Number of the newest line of the log; -1 if there is none.
    last_log_line: int = -1
    clients: int = 0
    #: Seconds since a client had control; 0 while one has it, or if none ever had it.
    unattended_for_s: float = 0.0
    #: A procedure without a client in control is aborted after this, seconds; 0: it goes on.
    unattended_limit_s: float = 0.0
    #: Messages that were refused: malformed, too large, without the lease.
    refused_requests: int = 0
    #: Findings at the start, such as a crash of the previous server or a run that can be resumed.
    notes: tuple[str, ...] = ()

    def _repr_html_(self) -> str:
        loop, running, lease, fault = self.loop, self.active_run, self.lease, self.fault
        rows: dict[str, object] = {
            "system": f"{self.system} ({'SIMULATED' if self.simulated else 'HARDWARE'})",
            "phase": self.phase.value,
        }
        if fault is not None:
            rows["FAULT"] = f"{fault.reason}. {fault.remedy}"
        if running is not None:
            rows["running"] = (
                f"{running.name}: {running.stage}, {running.completed} of {running.total} {running.unit}s"
            )
        if loop.closed:
            rows["loop"] = f"closed on {loop.matrix}, gain {loop.gain:g}, residual {loop.residual_nm:.0f} nm"
        rows["camera"] = f"{self.rates.frame_hz:.1f} Hz, {self.rates.lost_frames} frames lost"
        mirror = self.mirror
        rows["mirror"] = f"rms {100 * mirror.rms:.2f} %, peak {100 * mirror.peak:.2f} % of the stroke"
        rows["in control"] = "no client" if lease is None else f"{lease.name} on {lease.host}"
        rows["devices"] = ", ".join(f"{one.name} {one.health.value}" for one in self.devices)
        rows["server"] = f"process {self.server_pid}, ESCAPE {self.version}"
        return table_html(rows, "Server")


class LogLine(StateDocument):
    """One line of the log."""

    number: int
    at_utc: str
    level: str
    logger: str
    text: str


class Geometry(StateDocument):
    """Positions of the sub-apertures and actuators, for maps."""

    #: Valid sub-apertures, rows of 0 and 1; slopes follow them row by row, all x and then all y.
    valid: tuple[str, ...] = ()
    #: Actuators on a regular grid, rows of 0 and 1; empty without such a grid.
    layout: tuple[str, ...] = ()
    #: Positions (x, y) in metres of actuators without a regular grid.
    positions_m: tuple[tuple[float, float], ...] = ()
    #: Sub-aperture or pupil outlines on the camera: (x, y, half width) in pixels each.
    outlines_px: tuple[tuple[float, float, float], ...] = ()
    n_modes: int = 0
    #: Metres of surface for a command of 1, and lambda/D in pixels of the science camera; 0 if unknown.
    stroke_m: float = 0.0
    psf_px: float = 0.0


class CameraValues(StateDocument):
    """Settings of a camera."""

    exposure_s: float
    frame_rate_hz: float
    gain_db: float
    #: x, y, width, height, pixels.
    region: tuple[int, int, int, int]


class CameraPlan(StateDocument):
    """What other settings of a camera would change."""

    camera: str
    #: Settings in force, and the nearest to the requested ones that the camera can do.
    current: CameraValues
    planned: CameraValues
    #: The differences in words, and what they discard.
    changes: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    #: Why they cannot be applied now; empty if they can.
    refusal: str = ""


class PokePlan(StateDocument):
    """What a poke of one actuator or mode would do."""

    description: str
    #: Largest command of an actuator, as fraction of full stroke and in nanometres of surface; the latter is
    #: 0 where the stroke is not known.
    peak: float
    peak_nm: float = 0.0
    #: Largest amplitude that the limits of the mirror allow, and why the poke is not possible now.
    allowed: float
    refusal: str = ""


#: Arguments of a procedure by name.
Arguments = dict[str, Annotated[float, Field(allow_inf_nan=False)] | int | bool | str | None]


class ProcedurePlan(StateDocument):
    """Duration and poke amplitude of a procedure, computed before anything moves."""

    name: str
    arguments: dict[str, Any]
    #: Number of sensor frames, and seconds at the present frame rate.
    frames: int
    seconds: float
    #: Largest poke of an actuator, as fraction of full stroke.
    stroke: float
    #: Of these frames, those of the preparation, which the result does not count.
    preparation_frames: int = 0
    warnings: tuple[str, ...] = ()

    def _repr_html_(self) -> str:
        given = {key: value for key, value in self.arguments.items() if value is not None}
        rows: dict[str, object] = {
            "sensor frames": self.frames,
            "of them to prepare": self.preparation_frames,
            "at the camera's rate": f"{self.seconds:.1f} s",
            "largest poke": f"{100 * self.stroke:.3g} % of the stroke" if self.stroke else "none",
            "arguments": ", ".join(f"{key} {value}" for key, value in given.items()),
        }
        if self.warnings:
            rows["warnings"] = "; ".join(self.warnings)
        return table_html(rows, f"Plan of {self.name}")


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
        rows = {
            one.name: one.help
            + ("" if one.default is None else f" Default: {one.default} {one.unit}".rstrip())
            for one in self.parameters
        }
        return table_html(rows, f"{self.name}: {self.help}")
