"""Optical gains on a pyramid twin: against the twin's truth, and what they do for the loop.

    python benchmarks/studies/loops/optical_gains.py gains --seeds 1 2 3   bias and errors against the truth
    python benchmarks/studies/loops/optical_gains.py pokes --seeds 1 2 3   Strehl ratio with and without pokes

One JSON document per seed and line. The truth is push-pull around wavefronts frozen while the loop ran.
"""

from __future__ import annotations

import argparse
import json
import time
from contextlib import closing
from typing import Any

import numpy as np

from escape_benchmarks.realisation_tables import study_parser
from escape_hw.api.pyramid import PyramidPupils
from escape_hw.api.results import CalibrationResult
from escape_hw.calibration.acquisition.pokes import (
    compute_poke_amplitudes,
    noise_gain,
    scale_to_strehl_budget,
    strehl_loss,
)
from escape_hw.calibration.optical_gain.estimator import GainMeasurementLoop
from escape_hw.calibration.optical_gain.matrix_comparison import projector, slope_weights
from escape_hw.calibration.optical_gain.smoothing import smooth_over_modes
from escape_hw.pipeline.psf.strehl import strehl
from escape_hw.runtime.session.system import System, open_system
from escape_sim.devices.true_optical_gains import WavefrontRecorder, get_simulated_bench, true_optical_gains


def make_calibrations(
    bench: System, options: argparse.Namespace
) -> tuple[CalibrationResult, CalibrationResult]:
    """ESCAPE under turbulence, and the baseline (push-pull without it) on the same geometry."""
    escape = bench.calibrate("escape", frames=options.calibration)
    baseline = bench.calibrate("push-pull", frames=options.baseline, grid=escape.grid)
    return escape, baseline


def gains(bench: System, options: argparse.Namespace) -> dict[str, Any]:
    """Gains at pokes of 0.2 % of the stroke against push-pull around the frozen wavefronts."""
    _, baseline = make_calibrations(bench, options)
    pupils, twin = baseline.grid, get_simulated_bench(bench)
    if not isinstance(pupils, PyramidPupils):
        raise SystemExit("optical gains are a pyramid's; choose another system")
    loop = GainMeasurementLoop(bench, baseline, {})
    loop.control.set_gain(bench.config.loop.gain)
    amplitude = compute_poke_amplitudes(bench, baseline.matrix.m2c, options.poke)
    with loop.closed():
        bench.run(loop.measure(400, amplitude, "settling"))
        with closing(
            WavefrontRecorder(twin, max(1, options.frames // options.wavefronts))
        ) as frozen_wavefronts:
            segment = bench.run(loop.measure(options.frames, amplitude, "gains"))
    if segment.gains is None:
        raise SystemExit(f"no gains: {segment.reason}")
    rows = projector(baseline.matrix, slope_weights(baseline.matrix))
    every = range(0, baseline.matrix.n_modes, options.every)
    true = true_optical_gains(
        twin, pupils, baseline.matrix.m2c, rows, frozen_wavefronts.wavefronts, modes=list(every)
    )[:, every]
    mean, error = true.mean(axis=0), true.std(axis=0, ddof=1) / np.sqrt(len(true))
    value, sigma = segment.gains.value[0][every], segment.gains.sigma[0][every]
    best = smooth_over_modes(segment.gains.value[0], segment.gains.sigma[0], segment.gains.common_sigma)
    weights = sigma**-2.0
    bias = float(np.average(value / mean - 1, weights=weights))
    # All modes of a wavefront are weak or strong together, so the few wavefronts' level is uncertain, too.
    level = true.mean(axis=1)
    level_sigma = float(level.std(ddof=1) / level.mean() / np.sqrt(len(level)))
    own = float(weights.sum() ** -0.5 / mean.mean())
    noise = np.hypot(sigma, error)
    return {
        "frames": segment.frames,
        "truth": [float(mean.min()), float(np.median(mean)), float(mean.max())],
        "bias": bias,
        "bias_sigma": float(np.linalg.norm([own, segment.gains.common_sigma, level_sigma])),
        "truth_level_sigma": level_sigma,
        "chi2_beside_bias": float(np.mean(np.square((value - mean * (1 + bias)) / noise))),
        "rms_error": float(np.sqrt(np.mean(np.square(value / mean - 1)))),
        "rms_error_best": float(np.sqrt(np.mean(np.square(best.best[every] / mean - 1)))),
        "rms_sigma": float(np.sqrt(np.mean(np.square(sigma / mean)))),
        "common_sigma": segment.gains.common_sigma,
        "residual_nm": segment.residual_nm,
    }


def pokes(bench: System, options: argparse.Namespace) -> dict[str, Any]:
    """Strehl ratio with the budgeted pokes, with those of 0.2 % of the stroke, and with next to none."""
    _, baseline = make_calibrations(bench, options)
    psf = bench.take_model_psf(frames=5)
    full_poke = compute_poke_amplitudes(bench, baseline.matrix.m2c, options.poke)
    loop = bench.config.loop
    delay = float(baseline.matrix.metrics.get("delay_frames", 2.0))
    optics = (
        bench.dm.info.stroke_m, bench.config.system.wavelength_m, noise_gain(loop.gain, loop.leak, delay)
    )  # fmt: skip
    # Not zero, of which no estimator takes: a thousandth, which costs nothing.
    kinds = {
        "none": 1e-3 * full_poke,
        "budget": scale_to_strehl_budget(full_poke, 0.01, *optics),
        "whole": full_poke,
    }
    document: dict[str, Any] = {name: {"predicted": strehl_loss(a, *optics)} for name, a in kinds.items()}
    for name, amplitude in kinds.items():
        # Each on a bench of its own with the same seed: the same turbulence from the first frame on.
        with open_system(options.system, seed=bench.config.system.seed, set=options.set) as fresh:
            poked = GainMeasurementLoop(fresh, baseline, {}, science=True)
            poked.control.set_gain(loop.gain)
            with poked.closed():
                segment = fresh.run(poked.measure(options.frames, amplitude, name))
        one = strehl(segment.record.science.images(), psf).peak
        document[name] |= {"strehl": [one.value, one.sigma], "poke": float(amplitude.max())}
    return document


def main() -> None:
    """Print one document for each seed."""
    parser = study_parser(__doc__, "razor-pywfs")
    parser.add_argument("what", choices=("gains", "pokes"))
    parser.add_argument("--set", nargs="*", default=[])
    parser.add_argument("--seeds", nargs="+", type=int, default=[1, 2, 3])
    parser.add_argument("--calibration", type=int, default=1500, help="frames of ESCAPE")
    parser.add_argument(
        "--baseline", type=int, default=20, help="frames of the baseline per push and per pull"
    )
    parser.add_argument("--frames", type=int, default=4000, help="frames of a measurement, at most")
    parser.add_argument("--poke", type=float, default=0.002)
    parser.add_argument("--wavefronts", type=int, default=60)
    parser.add_argument(
        "--every", type=int, default=6, help="modes from one to the next that the truth is made for"
    )
    options = parser.parse_args()
    for seed in options.seeds:
        began = time.monotonic()
        with open_system(options.system, seed=seed, set=options.set) as bench:
            document = (gains if options.what == "gains" else pokes)(bench, options)
        wall_s = round(time.monotonic() - began, 1)
        print(json.dumps({"what": options.what, "seed": seed, **document, "wall_s": wall_s}), flush=True)


if __name__ == "__main__":
    main()
