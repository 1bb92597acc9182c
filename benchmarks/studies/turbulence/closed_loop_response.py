"""Registration from the mean response of a pyramid in closed loop, with two models of what moves its slopes.

    python benchmarks/studies/turbulence/closed_loop_response.py --first 8000 --realisations 3 \\
        --out docs/studies/closed-loop-response

A bench is calibrated and its loop closed with a matrix scaled by its optical gains. Wavefronts at the sensor
are recorded, and the mean response around them is measured by noiseless push-pull of the twin's optics. It is
fitted with the model of a closed loop, whose turbulence is what the modes leave, and with that of an open
loop, whose turbulence is weak enough for the same motion of the slopes. Prints both errors. Some five minutes
for each realisation on an idle core.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from escape_benchmarks.realisation_tables import (
    Line,
    each_realisation,
    realisation_numbers,
    study_parser,
)
from escape_hw.api.interaction_matrix import InteractionMatrix
from escape_hw.api.pyramid import PyramidPupils
from escape_hw.api.registration import PARAMETERS
from escape_hw.api.sensor import require_kind
from escape_hw.calibration.acquisition.slope_statistics import SlopeStatistics
from escape_hw.calibration.loop.control import build_integrator
from escape_hw.calibration.loop.runner import RunningLoop
from escape_hw.calibration.sprint.fit import sprint, sprint_options_from_config
from escape_hw.paper.sky_time import realisation_config
from escape_hw.runtime.session.system import System
from escape_sim.devices.true_optical_gains import (
    WavefrontRecorder,
    get_simulated_bench,
    true_responses,
)

#: Frames of the loop before and while wavefronts are recorded, and frames from one wavefront to the next.
_SETTLING, _FRAMES, _EVERY = 600, 6000, 150
#: Standard error of the mean response relative to that of the calibration.
_NOISE = 0.5


def measure_closed_loop(
    bench: System, matrix: InteractionMatrix, pupils: PyramidPupils
) -> tuple[PyramidPupils, list[NDArray[np.float32]]]:
    """Geometry with the statistics of the loop's slopes, and wavefronts at the sensor."""
    statistics = SlopeStatistics(pupils.n_slopes)
    loop = RunningLoop.prepare(bench, matrix, pupils, build_integrator(bench, matrix, pupils))
    with loop.closed():
        bench.run(loop.run(_SETTLING))
        recorder = WavefrontRecorder(get_simulated_bench(bench), _EVERY)
        bench.run(loop.run(_FRAMES, observe=[lambda *frame: statistics.add(frame[1])]))
        recorder.close()
    return require_kind(statistics.annotate_geometry(pupils, closed=True), PyramidPupils), recorder.wavefronts


def run_realisation(system: str, number: int, frames: int) -> Line:
    """Errors of both fits, with the stated ones and the strength of the turbulence."""
    _, config = realisation_config(system, number, [])
    with System.from_config(config) as bench:
        result = bench.calibrate(frames=frames)
        scaled = bench.find_optical_gains(result, accuracy=0.05, frames=2000).rescaled_calibration
        pupils, wavefronts = measure_closed_loop(
            bench, scaled.matrix, require_kind(result.grid, PyramidPupils)
        )
        twin, m2c = get_simulated_bench(bench), result.matrix.m2c
        truth = twin.flexure.at(twin.now_s).to_array()
        columns = [true_responses(twin, pupils, mode, wavefronts).mean(axis=0) for mode in m2c.T]
        data = np.stack(columns, axis=1).astype(np.float32)
        sigma = np.full_like(data, _NOISE * np.median(result.matrix.sigma))
        matrix = replace(result.matrix, data=data, sigma=sigma)
        line: Line = {"wavefronts": len(wavefronts)}
        for name, geometry in (("closed", pupils), ("open", replace(pupils, residual_tilt=0.0))):
            model: Any = bench.model(geometry)
            found = sprint(matrix, model, **sprint_options_from_config(config.calibration))
            line[name] = {
                "error": (found.registration.to_array() - truth).tolist(),
                "sigma": np.sqrt(np.diag(found.covariance)).tolist(),
                "converged": found.converged, "gain": found.gain.value, "strength": model.turbulence,
            }  # fmt: skip
    return line


def print_table(rows: Sequence[Line]) -> None:
    """Rms error of both models, a column per parameter, with the mean strength and gain."""
    print("rms error", *PARAMETERS, "D/r0", "gain")
    for name in ("closed", "open"):
        errors = np.array([row[name]["error"] for row in rows])
        others = np.mean([[row[name]["strength"], row[name]["gain"]] for row in rows], axis=0)
        print(name, *(f"{value:.3f}" for value in [*np.sqrt(np.mean(errors**2, axis=0)), *others]))


def main() -> None:
    """Measure what the table lacks, and print the errors."""
    parser = study_parser(__doc__, "razor-pywfs", realisations=3)
    parser.add_argument("--frames", type=int, default=1500, help="of the calibration")
    options = parser.parse_args()
    print_table(
        each_realisation(
            options.out / f"{options.system}.jsonl",
            {"system": options.system, "frames": options.frames},
            realisation_numbers(options),
            lambda number: run_realisation(options.system, number, options.frames),
            lambda row: f"{np.round(row['closed']['error'], 3)} {np.round(row['open']['error'], 3)}",
        )
    )


if __name__ == "__main__":
    main()
