"""The loop's latency, frame written to command sent, beside pyRTC's pipeline on the same frames."""

from __future__ import annotations

import numpy as np

from escape_hw.api.benchmark import BenchmarkRow
from escape_hw.cli.benchmarks.latency_loop import Case, Run, run_loop
from escape_hw.cli.benchmarks.latency_peer import run_peer
from escape_hw.cli.benchmarks.peer import ABSENT, name
from escape_hw.cli.benchmarks.pipeline import spots

#: Lenslets across, pixels each, actuators, frames per second.
CASES = ((10, 8, 97, 1000.0), (40, 8, 1200, 500.0))
#: Seconds of ours, long enough for a loss to show, and of the peer's.
SECONDS, PEER_SECONDS = 20.0, 5.0
#: Seconds of the loop with and without streams.
STREAMS_SECONDS = 5.0


def run() -> list[BenchmarkRow]:
    """All rows of the stage."""
    rows = []
    for n_sub, pitch, n_act, rate in CASES:
        case = make_case(n_sub, pitch, n_act, rate)
        # One after the other: together they would fight for the processors.
        peer = run_peer(case, PEER_SECONDS)
        rows += _rows(case, run_loop(case, SECONDS), peer)
    return rows + _streams(make_case(*CASES[0]))


def _streams(case: Case) -> list[BenchmarkRow]:
    """What it costs a loop that all it does goes to shared memory."""
    quiet, told = run_loop(case, STREAMS_SECONDS), run_loop(case, STREAMS_SECONDS, streams=True)
    rows = []
    for label, share in (("median", 50.0), ("99th percentile", 99.0)):
        ours, peer = (float(np.percentile(one.latency_us, share)) for one in (told, quiet))
        stage = f"latency: {case.n_act} actuators, all streams written, {label}"
        note = f"{told.lost} lost with, {quiet.lost} without"
        rows.append(BenchmarkRow(stage, ours, peer, "the same loop without streams", "us", "lower", note))
    return rows


def make_case(n_sub: int, pitch: int, n_act: int, rate_hz: float) -> Case:
    """Frames of spots that move, and a reconstructor of noise that keeps the mirror within its limits."""
    frames = np.stack([spots(n_sub, pitch, seed) for seed in range(8)])
    noise = np.random.default_rng(0).normal(0, 1e-4, (n_act, 2 * n_sub**2))
    return Case(n_sub, pitch, rate_hz, frames, noise.astype(np.float32))


def _rows(case: Case, ours: Run, peer: Run | None) -> list[BenchmarkRow]:
    note = (
        f"{len(ours.latency_us)} frames at {ours.rate_hz:.0f} Hz, {ours.lost} lost; {'; '.join(ours.notes)}"
    )
    note = note.removesuffix("; ")
    if peer is None:
        note += f"; {ABSENT}"
    else:
        note += f"; {'; '.join(peer.notes) or f'the peer answered {peer.rate_hz:.0f} frames per second'}"
    what = f"latency: {case.n_act} actuators, {case.rate_hz:.0f} Hz"
    shares = {"median": 50.0, "99th percentile": 99.0}
    rows = []
    for k, (label, share) in enumerate(shares.items()):
        theirs = None if peer is None or not peer.latency_us.size else float(peer.latency_us[k])
        rows.append(
            BenchmarkRow(
                f"{what}, {label}", float(np.percentile(ours.latency_us, share)), theirs,
                name("sensor, slopes, leaky integrator"), "us", "lower", note,
            )
        )  # fmt: skip
    largest, no_peer = float(ours.latency_us.max()), name("its report has none")
    rows.append(BenchmarkRow(f"{what}, largest", largest, None, no_peer, "us", "lower", note))
    return rows
