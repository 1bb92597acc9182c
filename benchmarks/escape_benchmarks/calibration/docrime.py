"""DO-CRIME: time per frame and error against pyRTC on the same frames.

Frames per second of a whole run on the twin.
"""

from __future__ import annotations

import logging
import time
import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from escape_benchmarks.peers.pyrtcao import NOT_INSTALLED, import_pyrtc, peer_name
from escape_benchmarks.rows import time_row
from escape_hw.api.benchmark import BenchmarkRow, time_alternately
from escape_hw.api.procedure import run as drive
from escape_hw.bench import Bench
from escape_hw.calibration.docrime.estimator import DocrimeEstimator
from escape_hw.calibration.docrime.open_loop import docrime_run
from escape_hw.config.loader import load_system

_SYSTEM = "razor-shwfs"
#: Frames timed, so many that finding the grid and solving weigh little; and those of the paper's LONG run.
N_FRAMES, _LONG = 3000, 100_000


def frames_row() -> BenchmarkRow:
    """Commands, turbulence, mirror, sensor, camera, slopes and estimator, as in ``escape calibrate``."""
    config = load_system(_SYSTEM)
    with Bench.from_config(config).open() as bench:
        # Compiles and fills what later runs find ready.
        drive(docrime_run(bench, frames=N_FRAMES // 2))
        start = time.perf_counter()
        taken = drive(docrime_run(bench, frames=N_FRAMES)).solution
        seconds = time.perf_counter() - start
    rate = (taken.frames + taken.lost_frames) / seconds
    note = (
        f"{N_FRAMES} frames from the grid to the matrix, noise's covariance included; "
        f"{_LONG} take {_LONG / rate:.0f} s at this rate"
    )
    peer = config.devices.wfs.frame_rate_hz
    stage = f"docrime: {_SYSTEM} DO-CRIME run, frames per second"
    return BenchmarkRow(stage, rate, peer, "the bench itself", "frame/s", "higher", note)


_N_MODES, _N_SLOPES, _N_FRAMES = 97, 200, 10_000
_POKE = 0.01
_NOISE = 2e-3
_SEED = 5


@dataclass(frozen=True, slots=True, eq=False)
class SyntheticRun:
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
    peer_label, absent = peer_name("Loop.docrime_im"), import_pyrtc("loop") is None
    rows = []
    for label, spectrum in (
        ("read noise only", None),
        ("first-order turbulence", first_order_turbulence),
        ("turbulence of f^-11/3", frozen_flow_turbulence),
    ):
        data = simulate_run(spectrum)
        with pyrtc_docrime(data) as peer:
            error = None if peer is None else data.error(peer())
            note = NOT_INSTALLED if absent else size + (", turbulence 17 times the pokes" if spectrum else "")
            ours = data.error(estimate_recorded(data))
            rows.append(
                BenchmarkRow(f"docrime: IM error, {label}", ours, error, peer_label, "1", "lower", note)
            )
            if spectrum is not first_order_turbulence:
                continue
            note = NOT_INSTALLED if absent else f"{size}, solution included"
            for how, estimate in (
                ("recorded", estimate_recorded),
                ("as they come", estimate_streaming),
                # More than the peer finds: for SPRINT, which wants the noise's covariance between slopes.
                ("recorded, with the noise's covariance", partial(estimate_recorded, correlations=True)),
                ("as they come, with the noise's covariance", partial(estimate_streaming, correlations=True)),
            ):
                ours_s, peer_s = time_alternately(partial(estimate, data), peer, rounds=5)
                times = ours_s / _N_FRAMES, None if peer_s is None else peer_s / _N_FRAMES
                rows.append(time_row(f"docrime: time per frame, {how}", times, peer_label, "us", note))
    return [*rows, frames_row()]


def first_order_turbulence(rng: np.random.Generator) -> NDArray[np.float64]:
    """First-order turbulence of unit rms ``(n_frames, n_slopes)``: 0.99 from frame to frame."""
    out = np.zeros((_N_FRAMES, _N_SLOPES))
    innovations = rng.normal(0, np.sqrt(1 - 0.99**2), out.shape)
    for k in range(1, _N_FRAMES):
        out[k] = 0.99 * out[k - 1] + innovations[k]
    return out


def frozen_flow_turbulence(rng: np.random.Generator) -> NDArray[np.float64]:
    """Turbulence of unit rms with the temporal spectrum of slopes in a frozen flow.

    Flat below 1/250 of the frame rate, falling as ``f^(-11/3)`` above (Conan et al. 1995).
    """
    f = np.fft.rfftfreq(2 * _N_FRAMES)
    amplitude = (1 + (f * 250) ** 2) ** (-11 / 12)
    white = np.fft.rfft(rng.standard_normal((2 * _N_FRAMES, _N_SLOPES)), axis=0)
    out = np.fft.irfft(white * amplitude[:, None], axis=0)[:_N_FRAMES]
    return np.asarray(out / out.std())


def simulate_run(turbulence: Callable[[np.random.Generator], NDArray[np.float64]] | None) -> SyntheticRun:
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
    return SyntheticRun(pokes, slopes.astype(np.float32), truth)


def estimate_recorded(data: SyntheticRun, correlations: bool = False) -> NDArray[np.float64]:
    """Our estimator on recorded frames, as the peer's routine gets them."""
    estimator = DocrimeEstimator(_N_SLOPES, _N_MODES, correlations=correlations)
    return estimator.extend(np.arange(_N_FRAMES), data.slopes, data.pokes).solve().matrix


def estimate_streaming(data: SyntheticRun, correlations: bool = False) -> NDArray[np.float64]:
    """Our estimator frame by frame, beside a running camera."""
    estimator = DocrimeEstimator(_N_SLOPES, _N_MODES, correlations=correlations)
    for k, (slopes, poke) in enumerate(zip(data.slopes, data.pokes, strict=True)):
        estimator.partial_fit(k, slopes, poke)
    return estimator.solve().matrix


@contextmanager
def pyrtc_docrime(data: SyntheticRun) -> Iterator[Callable[[], NDArray[np.floating]] | None]:
    """PyRTC's routine fed with the frames of a run, or ``None`` where it is not installed.

    It is told the true delay, which it cannot find out. Its streams are replaced by the arrays, so
    that only its estimator is timed.
    """
    loops, streams = import_pyrtc("loop"), import_pyrtc("streams")
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


def _peer(loop: Any, data: SyntheticRun) -> NDArray[np.floating]:
    frames = iter(data.slopes)
    loop.read_stream = lambda *_, **__: next(frames)
    loop.write_stream = lambda *_, **__: None
    loop.flatten = lambda: None
    loop.docrime_buffer[:] = 0
    np.random.seed(_SEED)
    loop.docrime_im()
    return np.asarray(loop.im)
