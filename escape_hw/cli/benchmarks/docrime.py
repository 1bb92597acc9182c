"""DO-CRIME per frame and its error, against pyRTC, on the same frames."""

from __future__ import annotations

import logging
import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.benchmark import BenchmarkRow, alternate
from escape_hw.calibration.docrime_estimator import DocrimeEstimator
from escape_hw.cli.benchmarks.peer import ABSENT, name, pyrtc

_N_MODES, _N_SLOPES, _N_FRAMES = 97, 200, 10_000
_POKE = 0.01
_NOISE = 2e-3
_SEED = 5


@dataclass(frozen=True, slots=True, eq=False)
class Run:
    """A run with a known matrix: the pokes sent, the slopes read, the truth.

    ``slopes[i]`` answers to ``pokes[i - 1]``; arrays ``(n_frames, n)``.
    """

    pokes: NDArray[np.float32]
    slopes: NDArray[np.float32]
    truth: NDArray[np.float64]

    def error(self, matrix: NDArray[np.floating]) -> float:
        """Relative error of a matrix (Frobenius norm)."""
        return float(np.linalg.norm(matrix - self.truth) / np.linalg.norm(self.truth))


def run() -> list[BenchmarkRow]:
    """All rows of the stage."""
    rows = []
    for label, turbulence in (("read noise only", 0.0), ("turbulence 17 times the pokes", 0.1)):
        data = make_run(turbulence)
        with peer_calls(data) as peer:
            rows += _compare(data, peer, label, timed=turbulence > 0)
    return rows


def _compare(
    data: Run, peer: Callable[[], NDArray[np.floating]] | None, label: str, *, timed: bool
) -> list[BenchmarkRow]:
    who, note = name("Loop.docrime_im"), "" if peer is not None else ABSENT
    size = f"{_N_MODES} modes, {_N_SLOPES} slopes, {_N_FRAMES} frames"
    error = None if peer is None else data.error(peer())
    rows = [
        BenchmarkRow(
            f"docrime: IM error, {label}", data.error(ours(data)), error, who, "1", "lower", note or size
        )
    ]
    if timed:
        ours_s, peer_s = alternate(lambda: ours(data), peer, seconds=1.0, rounds=3)
        per_frame = 1e6 / _N_FRAMES
        rows.append(
            BenchmarkRow(
                "docrime: time per frame",
                ours_s * per_frame,
                None if peer_s is None else peer_s * per_frame,
                who,
                "us",
                "lower",
                note or f"{size}, solution included",
            )
        )
    return rows


def make_run(turbulence: float) -> Run:
    """Frames of a random matrix under uniform pokes, with first-order turbulence (0.99 per frame).

    Parameters
    ----------
    turbulence
        Its rms per slope; the pokes move a slope by 0.007 rms.
    """
    # The peer draws its pokes itself, from NumPy's legacy generator: the same seed, the same draws.
    legacy = np.random.RandomState(_SEED)
    pokes = np.stack([legacy.uniform(-_POKE, _POKE, _N_MODES) for _ in range(_N_FRAMES)]).astype(np.float32)
    rng = np.random.default_rng(0)
    truth = rng.standard_normal((_N_SLOPES, _N_MODES))
    truth /= np.linalg.norm(truth, axis=0)
    slopes = rng.normal(0, _NOISE, (_N_FRAMES, _N_SLOPES))
    slopes[1:] += pokes[:-1].astype(float) @ truth.T
    kicks = rng.normal(0, turbulence * np.sqrt(1 - 0.99**2), (_N_FRAMES, _N_SLOPES))
    state = np.zeros(_N_SLOPES)
    for k in range(1, _N_FRAMES):
        state = 0.99 * state + kicks[k]
        slopes[k] += state
    return Run(pokes, slopes.astype(np.float32), truth)


def ours(data: Run) -> NDArray[np.float64]:
    """Our streaming estimator, frame by frame."""
    estimator = DocrimeEstimator(_N_SLOPES, _N_MODES)
    pokes = data.pokes.astype(np.float64)
    for k in range(_N_FRAMES):
        estimator.partial_fit(k, data.slopes[k], pokes[k])
    return estimator.solve().matrix


@contextmanager
def peer_calls(data: Run) -> Iterator[Callable[[], NDArray[np.floating]] | None]:
    """PyRTC's routine fed with the frames of a run, or ``None`` where it is not installed.

    It is told the true delay, which it cannot find out. Its streams are replaced by the arrays, so
    that only its estimator is timed.
    """
    loops, streams = pyrtc("loop"), pyrtc("streams")
    if loops is None or streams is None:
        yield None
        return
    tag = f"escape_perf_{uuid.uuid4().hex[:8]}"
    names = {"signal": f"{tag}_s", "wfc": f"{tag}_c"}
    for kind, size in (("signal", _N_SLOPES), ("wfc", _N_MODES)):
        streams.create_stream(names[kind], (size,), np.float32)
    state, level = np.random.get_state(), logging.root.manager.disable
    logging.disable(logging.ERROR)
    loop = loops.Loop(
        {
            "functions": [],
            "delay": 1,
            "poke_amp": _POKE,
            "num_iters_im": _N_FRAMES,
            "watchdog_timeout": 0,
            "input_streams": {"signal": names["signal"]},
            "output_streams": {"wfc": names["wfc"]},
        }
    )
    try:
        yield lambda: _peer(loop, data)
    finally:
        for replaced in ("read_stream", "write_stream", "flatten"):
            vars(loop).pop(replaced, None)
        loop.close()
        streams.clear_shms(list(names.values()))
        np.random.set_state(state)
        logging.disable(level)


def _peer(loop: Any, data: Run) -> NDArray[np.floating]:
    frames = iter(data.slopes)
    loop.read_stream = lambda *_, **__: next(frames)
    loop.write_stream = lambda *_, **__: None
    loop.flatten = lambda: None
    loop.docrime_buffer[:] = 0
    np.random.seed(_SEED)
    loop.docrime_im()
    return np.asarray(loop.im)
