"""A data source scripted by the test, and a server that only records the requests."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from escape_hw.errors import EscapeError
from escape_hw.io.night_log import NightEntry
from escape_hw.remote.source import Sample
from escape_hw.remote.state import (
    Arguments,
    CameraPlan,
    CameraValues,
    DeviceHealth,
    DeviceState,
    DiskState,
    FaultState,
    FrameCounters,
    Geometry,
    Illumination,
    LatencyState,
    Lease,
    LogLine,
    LoopState,
    MirrorState,
    OffsetsState,
    Phase,
    PokePlan,
    ProcedureEntry,
    ProcedurePlan,
    ProductEntry,
    State,
)
from escape_hw.streams.timing import BINS, bin_of

CLIENT = "0123456789abcdef"
LEASE = Lease(client=CLIENT, name="ana", host="bench", pid=7, since_utc="2026-11-21T20:00:00")
DEVICES = (
    DeviceState(
        name="dm",
        kind="mirror",
        model="ALPAO DM97-15",
        serial="BAX123",
        simulated=True,
        health=DeviceHealth.OK,
        facts={"temperature_c": 31.2},
    ),
    DeviceState(
        name="wfs",
        kind="camera",
        model="XIMEA MQ013MG-ON",
        serial="CX0815",
        simulated=True,
        health=DeviceHealth.OK,
        facts={"frame_rate_hz": 500.0, "exposure_s": 0.0019, "temperature_c": 41.0},
    ),
    DeviceState(
        name="science",
        kind="camera",
        model="FLIR BFS-U3",
        serial="19001",
        simulated=True,
        health=DeviceHealth.OK,
    ),
)


def disc(n: int, fill: float = 1.0) -> NDArray[np.bool_]:
    """A disc of ``fill`` times the width of an ``n`` by ``n`` grid."""
    y, x = np.indices((n, n)) - (n - 1) / 2
    return np.hypot(x, y) <= fill * n / 2


def rows_of(mask: NDArray[np.bool_]) -> tuple[str, ...]:
    """A mask in the format of :class:`Geometry`."""
    return tuple("".join("1" if one else "0" for one in row) for row in mask)


def shack_hartmann(n: int = 24, pitch: float = 15.54) -> Geometry:
    """A sensor of ``n`` sub-apertures across and an 11 by 11 mirror."""
    valid = disc(n)
    rows, columns = np.nonzero(valid)
    half = 0.5 * pitch
    places = [(14 + (c + 0.5) * pitch, 14 + (r + 0.5) * pitch) for r, c in zip(rows, columns, strict=True)]
    outlines = tuple((x, y, half) for x, y in places)
    return Geometry(
        valid=rows_of(valid),
        layout=rows_of(disc(11, 1.03)),
        outlines_px=outlines,
        n_modes=94,
        stroke_m=3.5e-6,
        psf_px=2.46,
    )


def secondary() -> Geometry:
    """A pyramid and 336 actuators on rings."""
    places = []
    for ring in range(1, 11):
        count = 6 * ring + (1 if ring <= 6 else 0)
        angles = 2 * np.pi * np.arange(count) / count
        places += [(0.03 * ring * float(np.cos(a)), 0.03 * ring * float(np.sin(a))) for a in angles]
    pupils = ((45.0, 48.0, 32.0), (128.0, 46.0, 32.0), (65.0, 152.0, 32.0), (130.0, 130.0, 32.0))
    return Geometry(valid=rows_of(disc(64)), positions_m=tuple(places[:336]), outlines_px=pupils, n_modes=100)


def spots(geometry: Geometry, size: int = 400, seed: int = 0) -> NDArray[np.uint16]:
    """A frame with one spot in each sub-aperture, in counts of ten bits."""
    rng = np.random.default_rng(seed)
    y, x = np.indices((size, size)) + 0.5
    frame = rng.poisson(6.0, (size, size)).astype(float)
    for cx, cy, half in geometry.outlines_px:
        r, c = int(cy), int(cx)
        part = (slice(max(r - 6, 0), r + 7), slice(max(c - 6, 0), c + 7))
        dx, dy = rng.normal(0, 0.12 * half, 2)
        spot = np.exp(-((x[part] - cx - dx) ** 2 + (y[part] - cy - dy) ** 2) / 4.5)
        frame[part] += rng.uniform(300, 980) * spot
    return np.minimum(frame, 1023).astype(np.uint16)


def speckles(seed: int = 0, size: int = 128, strehl: float = 0.4) -> NDArray[np.float32]:
    """An image with a core, a ring and a halo, in counts."""
    rng = np.random.default_rng(seed)
    y, x = np.indices((size, size)) - size / 2
    r = np.hypot(x, y) / 2.2 + 1e-6
    core = (2 * np.sin(r) / r / (1 + r)) ** 2
    halo = np.exp(-np.hypot(x, y) / 22) * rng.gamma(3.0, 1 / 3, (size, size))
    return (6000 * (strehl * core + 0.02 * (1 - strehl) * halo) + rng.normal(3, 1, (size, size))).astype(
        np.float32
    )


def counted(*microseconds: float) -> NDArray[np.float64]:
    """Counts by bin of durations."""
    counts = np.zeros(BINS)
    for one in microseconds:
        counts[bin_of(int(one * 1000))] += 1
    return counts


@cache
def entries_of_all(geometry: Geometry, seed: int) -> Mapping[str, tuple[NDArray[Any], Mapping[str, float]]]:
    """Read-only entries of every stream that the panels read, with what is known of them; made once."""
    rng = np.random.default_rng(seed)
    n_slopes = 2 * sum(row.count("1") for row in geometry.valid)
    n_act = sum(row.count("1") for row in geometry.layout) or len(geometry.positions_m)
    slopes, commands = rng.normal(0, 0.4, n_slopes), rng.normal(0, 0.1, n_act)
    modes = rng.normal(0, 20, geometry.n_modes)
    latencies, spacing = rng.gamma(60, 5.2, 4000), rng.normal(2000, 18, 4000)
    streams: dict[str, NDArray[Any]] = {
        "frames": spots(geometry, seed=seed),
        "slopes": slopes,
        "commands": commands,
        "residual_modes": modes,
        "psf": speckles(seed),
        "model_psf": speckles(seed, strehl=1.0),
        "latency_histogram": np.stack([counted(*latencies), counted(*spacing)]),
    }
    if geometry.positions_m:
        streams["measured_positions"] = rng.normal(0, 4e-7, n_act)
    for data in streams.values():
        data.flags.writeable = False
    return {
        name: (data, {"full_scale": 1023.0} if name == "frames" else {}) for name, data in streams.items()
    }


def running(**changes: Any) -> State:
    """The state of a bench with a closed loop and this client in control."""
    values: dict[str, Any] = {
        "serial": 1,
        "server_pid": 10,
        "engine_pid": 11,
        "system": "razor-shwfs",
        "seed": 7,
        "phase": Phase.LOOP,
        "lease": LEASE,
        "devices": DEVICES,
        "rates": FrameCounters(frame_hz=500.0, frames=123456, lost_frames=2),
        "illumination": Illumination(saturated=0.0004, peak=0.97),
        "mirror": MirrorState(rms=0.082, peak=0.412, saturated_share=0.0),
        "latency": LatencyState(p50=312.0, p99=401.0, max=880.0, jitter_p99=64.0),
        "loop": LoopState(
            closed=True,
            matrix="escape",
            gain=0.425,
            leak=0.026,
            dropped_modes=14,
            n_modes=80,
            residual_nm=44.0,
            strehl=0.365,
            strehl_sigma=0.004,
        ),
        "products": (
            ProductEntry(
                name="escape", kind="matrix", path="/runs/1/im.fits", summary="ESCAPE, 1000 frames, 94 modes"
            ),
            ProductEntry(name="docrime", kind="matrix", path="/runs/1/do.fits", summary="DO-CRIME, 94 modes"),
        ),
        "disk": DiskState(folder="/runs", free_gb=512.3),
    }
    return State(**{**values, **changes})


class ScriptedSource:
    """A data source whose content is set by the test."""

    def __init__(self, state: State | None = None, geometry: Geometry | None = None) -> None:
        self.connected = True
        self.state = state or running()
        self.geometry_data = geometry or shack_hartmann()
        self.lines: list[LogLine] = []
        self.night: list[NightEntry] = []
        self.entries: tuple[ProcedureEntry, ...] = ()
        self.streams: dict[str, Sample] = {}
        self.reads = 0

    def change(self, **values: Any) -> None:
        """Change fields of the state, with the next serial number."""
        self.state = self.state.model_copy(update={**values, "serial": self.state.serial + 1})

    def fail(self, reason: str = "no frames for 0.5 s") -> None:
        """Enter the fault state."""
        fault = FaultState(reason=reason, at_utc="2026-11-21T21:00:00", remedy="look at the camera's cable")
        lost = DEVICES[1].model_copy(update={"health": DeviceHealth.LOST, "message": "unplugged"})
        loop = self.state.loop.model_copy(update={"closed": False})
        self.change(phase=Phase.FAULT, fault=fault, devices=(DEVICES[0], lost, DEVICES[2]), loop=loop)

    def push(self, stream: str, data: NDArray[Any], **meta: float | str) -> None:
        """Add an entry to a stream."""
        last = self.streams.get(stream)
        now = time.monotonic_ns()
        self.streams[stream] = Sample(0 if last is None else last.index + 1, now - 500_000, now, data, meta)

    def push_all(self, seed: int = 0) -> None:
        """Add an entry to every stream that the panels read."""
        for stream, (data, meta) in entries_of_all(self.geometry_data, seed).items():
            self.push(stream, data, **meta)
        line = LogLine(
            number=len(self.lines),
            at_utc=f"2026-11-21T21:{seed % 60:02d}:00.000",
            logger="escape_hw.server",
            level=("INFO", "WARNING", "ERROR")[seed % 3],
            text=f"message {seed}: loop gain 0.425, residual 44 nm",
        )
        self.lines.append(line)

    def latest(self, stream: str, after: int = -1) -> Sample | None:
        """The newest entry, unless it has the index ``after``."""
        self.reads += 1
        sample = self.streams.get(stream)
        return sample if sample is not None and sample.index != after else None

    def geometry(self) -> Geometry:
        """The geometry set by the test."""
        return self.geometry_data

    def log_after(self, number: int) -> Sequence[LogLine]:
        """Log lines after a number."""
        return [line for line in self.lines if line.number > number]

    def night_after(self, number: int) -> Sequence[NightEntry]:
        """Entries of the night log after a number."""
        return [entry for entry in self.night if entry.number > number]

    def procedures(self) -> Sequence[ProcedureEntry]:
        """The procedures set by the test."""
        return self.entries


class ScriptedControl:
    """Records every request; raises if ``refuse`` is set."""

    client = CLIENT

    def __init__(self) -> None:
        self.asked: list[tuple[str, Mapping[str, Any]]] = []
        self.refuse = ""

    def _note(self, verb: str, **arguments: Any) -> None:
        self.asked.append((verb, arguments))
        if self.refuse:
            raise EscapeError(self.refuse)

    @property
    def verbs(self) -> list[str]:
        """The requests, in order."""
        return [verb for verb, _ in self.asked]

    def __getattr__(self, verb: str) -> Any:
        if verb.startswith("_"):
            raise AttributeError(verb)
        return lambda *args, **kwargs: self._note(verb, **({"args": args} if args else {}), **kwargs)

    #: Settings of both cameras.
    camera = CameraValues(exposure_s=1.9e-3, frame_rate_hz=500.0, gain_db=0.0, region=(0, 0, 400, 400))
    #: Why the camera cannot be changed, and the mirror not be poked.
    refusal = ""

    def check_camera(self, camera: str, **settings: Any) -> CameraPlan:
        """What the settings would change."""
        self._note("check_camera", camera=camera, **settings)
        planned = self.camera.model_copy(update=settings)
        changes = tuple(f"{name} → {value}" for name, value in settings.items())
        return CameraPlan(
            camera=camera, current=self.camera, planned=planned, changes=changes, refusal=self.refusal
        )

    def set_camera(self, camera: str, **settings: Any) -> CameraPlan:
        """Change the settings."""
        plan = self.check_camera(camera, **settings)
        self.asked[-1] = ("set_camera", self.asked[-1][1])
        self.camera = plan.planned
        return plan

    #: Offsets, and those that are saved.
    offsets = OffsetsState(saved=("night-1",))

    def set_offsets(self, terms: Mapping[str, float] | None = None, **more: str) -> OffsetsState:
        """Set the offsets."""
        self._note("set_offsets", terms=terms, **more)
        references, flat = more.get("references"), more.get("flat")
        self.offsets = self.offsets.model_copy(
            update={
                **({} if terms is None else {"terms": dict(terms)}),
                **({} if references == "keep" else {"references": references == "present"}),
                **({} if flat == "keep" else {"flat": flat == "present"}),
            }
        )
        return self.offsets

    def save_offsets(self, name: str) -> OffsetsState:
        """Save the offsets."""
        self._note("save_offsets", name=name)
        self.offsets = self.offsets.model_copy(update={"saved": (*self.offsets.saved, name)})
        return self.offsets

    def load_offsets(self, name: str) -> OffsetsState:
        """Restore offsets."""
        self._note("load_offsets", name=name)
        self.offsets = self.offsets.model_copy(update={"terms": {"focus": 60.0, "mode 4": -20.0}})
        return self.offsets

    def check_poke(self, kind: str, number: int, amplitude: float, seconds: float) -> PokePlan:
        """What a poke would do."""
        self._note("check_poke", kind=kind, number=number, amplitude=amplitude, seconds=seconds)
        number += kind == "mode"
        return PokePlan(
            description=f"{kind} {number} at {amplitude:+g} of the stroke (+150 nm of surface)",
            peak=abs(amplitude), peak_nm=150.0, allowed=0.4, refusal=self.refusal,
        )  # fmt: skip

    #: Number of the next run.
    next_run = 3

    def start(self, procedure: str, **arguments: Any) -> SimpleNamespace:
        """A run of a procedure."""
        self._note("start", args=(procedure,), **arguments)
        return SimpleNamespace(id=self.next_run)

    def plan(self, procedure: str, arguments: Arguments) -> ProcedurePlan:
        """A plan."""
        self._note("plan", procedure=procedure, arguments=arguments)
        frames = int(arguments.get("frames") or 1000)
        return ProcedurePlan(
            name=procedure, arguments=dict(arguments), frames=frames, seconds=frames / 500, stroke=0.02
        )
