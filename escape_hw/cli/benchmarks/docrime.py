"""DO-CRIME per frame and its error, against pyRTC, on the same frames."""

from __future__ import annotations

import logging
import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.benchmark import BenchmarkRow, alternate
from escape_hw.calibration.docrime_estimator import DocrimeEstimator
from escape_hw.cli.benchmarks.docrime_frames import frames_row
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
    size = f"{_N_MODES} modes, {_N_SLOPES} slopes, {_N_FRAMES} frames"
    who, absent = name("Loop.docrime_im"), pyrtc("loop") is None
    rows = []
    for label, spectrum in (
        ("read noise only", None),
        ("first-order turbulence", first_order),
        ("turbulence of f^-11/3", frozen_flow),
    ):
        data = make_run(spectrum)
        with peer_calls(data) as peer:
            error = None if peer is None else data.error(peer())
            note = ABSENT if absent else size + (", turbulence 17 times the pokes" if spectrum else "")
            rows.append(
                BenchmarkRow(
                    f"docrime: IM error, {label}", data.error(whole(data)), error, who, "1", "lower", note
                )
            )
            if spectrum is not first_order:
                continue
            for how, ours in (
                ("recorded", whole),
                ("as they come", streaming),
                # More than the peer finds: for SPRINT, which wants the noise's covariance between slopes.
                ("recorded, with the noise's covariance", partial(whole, correlations=True)),
                ("as they come, with the noise's covariance", partial(streaming, correlations=True)),
            ):
                ours_s, peer_s = alternate(partial(ours, data), peer, rounds=5)
                rows.append(
                    BenchmarkRow(
                        f"docrime: time per frame, {how}",
                        ours_s * 1e6 / _N_FRAMES,
                        None if peer_s is None else peer_s * 1e6 / _N_FRAMES,
                        who,
                        "us",
                        "lower",
                        ABSENT if absent else f"{size}, solution included",
                    )
                )
    return [*rows, frames_row()]


def first_order(rng: np.random.Generator) -> NDArray[np.float64]:
    """First-order turbulence of unit rms ``(n_frames, n_slopes)``: 0.99 from frame to frame."""
    out = np.zeros((_N_FRAMES, _N_SLOPES))
    kicks = rng.normal(0, np.sqrt(1 - 0.99**2), out.shape)
    for k in range(1, _N_FRAMES):
        out[k] = 0.99 * out[k - 1] + kicks[k]
    return out


def frozen_flow(rng: np.random.Generator) -> NDArray[np.float64]:
    """Turbulence of unit rms with the temporal spectrum of slopes in a frozen flow.

    Flat below 1/250 of the frame rate, falling as ``f^(-11/3)`` above (Conan et al. 1995).
    """
    f = np.fft.rfftfreq(2 * _N_FRAMES)
    amplitude = (1 + (f * 250) ** 2) ** (-11 / 12)
    white = np.fft.rfft(rng.standard_normal((2 * _N_FRAMES, _N_SLOPES)), axis=0)
    out = np.fft.irfft(white * amplitude[:, None], axis=0)[:_N_FRAMES]
    return np.asarray(out / out.std())


def make_run(turbulence: Callable[[np.random.Generator], NDArray[np.float64]] | None) -> Run:
    """Frames of a random matrix under uniform pokes, with read noise and turbulence.

    The pokes move a slope by 0.006 rms, the turbulence by 0.1.
    """
    # The peer draws its pokes itself, from NumPy's legacy generator: the same seed, the same draws.
    legacy = np.random.RandomState(_SEED)
    pokes = np.stack([legacy.uniform(-_POKE, _POKE, _N_MODES) for _ in range(_N_FRAMES)]).astype(np.float32)
    rng = np.random.default_rng(0)
    truth = rng.standard_normal((_N_SLOPES, _N_MODES))
    truth /= np.linalg.norm(truth, axis=0)
    slopes = rng.normal(0, _NOISE, (_N_FRAMES, _N_SLOPES))
    slopes[1:] += pokes[:-1].astype(float) @ truth.T
    if turbulence is not None:
        slopes += 0.1 * turbulence(rng)
    return Run(pokes, slopes.astype(np.float32), truth)


def whole(data: Run, correlations: bool = False) -> NDArray[np.float64]:
    """Our estimator on recorded frames, as the peer's routine gets them."""
    estimator = DocrimeEstimator(_N_SLOPES, _N_MODES, correlations=correlations)
    return estimator.extend(np.arange(_N_FRAMES), data.slopes, data.pokes).solve().matrix


def streaming(data: Run, correlations: bool = False) -> NDArray[np.float64]:
    """Our estimator frame by frame, beside a running camera."""
    estimator = DocrimeEstimator(_N_SLOPES, _N_MODES, correlations=correlations)
    for k, (slopes, poke) in enumerate(zip(data.slopes, data.pokes, strict=True)):
        estimator.partial_fit(k, slopes, poke)
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
