"""Registration error of a pyramid due to turbulence alone, against the number of frames.

    python benchmarks/studies/sky_time/pyramid_turbulence_limit.py --system maps-nir --frames 75 300 1500 3000

All is given except gain, registration and the model's variants: the positions of the images and the strength
of the turbulence are known, and the model is linearised at the injected registration. Frames are fitted
directly, without a matrix, by least squares with each slope's noise, as they are (unwhitened) and as
differences of neighbours (whitened). The remaining error is due to noise and to the finite number of states
of the turbulence; the third curve is the prediction of the latter: the standard deviation of one state over
the square root of the number of states. Writes
``pyramid-frames-SYSTEM.json`` and ``.png``; a realisation takes some ten seconds.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from escape_benchmarks.realisation_tables import study_parser
from escape_hw.api.pyramid import PyramidPupils
from escape_hw.api.registration import PARAMETERS
from escape_hw.api.sensor import require_kind
from escape_hw.calibration.docrime.estimator import DocrimeEstimator
from escape_hw.calibration.docrime.open_loop import docrime_run
from escape_hw.calibration.sprint.telemetry_fit import delay_rows, telemetry_from_frames
from escape_hw.config.sensor import PyramidSection
from escape_hw.paper.sky_time import accuracy_goal, realisation_config
from escape_hw.report.figures.registration import error_curves
from escape_hw.runtime.session.system import System
from escape_sim.models.pyramid import PyramidModel

NAMES = ("unwhitened", "whitened", "states of turbulence")


def fit_registration(
    terms: NDArray[np.float64], slopes: NDArray[np.float64], pokes: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Registration beside the truth ``(5,)`` by the frames' least squares, twice for the noise."""
    y, x = slopes - slopes.mean(axis=0), pokes - pokes.mean(axis=0)
    gram, cross, weight = x.T @ x, y.T @ x, np.ones(y.shape[1])
    shares = np.zeros(len(terms))
    for _ in range(2):
        weighed = terms * weight[:, None]
        normal = np.einsum("psm,qsm->pq", weighed @ gram, weighed, optimize=True)
        shares = np.linalg.solve(normal, np.einsum("psm,sm->p", weighed, cross * weight[:, None]))
        weight = 1 / (y - x @ np.tensordot(shares, terms, 1).T).std(axis=0)
    return np.asarray(shares[1:6] / shares[0])


def run_realisation(
    system: str, number: int, frames: list[int], overrides: list[str]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Errors ``(2, n_frames, 5)`` of one realisation, and the variance that the turbulence's states
    explain."""
    injected, config = realisation_config(system, number, overrides)
    with System.from_config(config) as bench:
        found = bench.run(docrime_run(bench, frames=max(frames), record=True))
    if found.record is None:
        raise RuntimeError("the run was not recorded")
    index, slopes, pokes = found.record
    lags, m2c = config.calibration.lags, found.result.matrix.m2c
    true_centres_px = np.add(
        config.sensor_as(PyramidSection).pupils_px, config.twin.pyramid.centre_offsets_px
    )
    pupils = replace(
        require_kind(found.result.grid, PyramidPupils), centres_px=true_centres_px, centre_sigma_px=0.0
    )
    model = PyramidModel(config, pupils, basis=m2c)
    matrix_here, derivatives = model.modal_jacobian(injected, m2c)
    variant_terms = [variant.modal_matrix(injected, m2c) - matrix_here for variant in model.variants()]
    terms = np.stack([matrix_here, *derivatives, *variant_terms])
    data = telemetry_from_frames(index, slopes, pokes, before=lags)
    response = DocrimeEstimator(slopes.shape[1], pokes.shape[1], lags=lags, correlations=False)
    weights = response.extend(index, slopes, pokes).solve().response.weights
    excitation = np.sum([w * delay_rows(data.pokes, lag) for lag, w in enumerate(weights)], axis=0)
    pairs = data.present[1:] & data.present[:-1]
    series = (
        (data.slopes[data.present], excitation[data.present]),
        (np.diff(data.slopes, axis=0)[pairs], np.diff(excitation, axis=0)[pairs]),
    )
    errors = np.array(
        [[fit_registration(terms, y[:n].astype(float), x[:n]) for n in frames] for y, x in series]
    )
    states = np.square(model.registration_systematic_error) * np.divide(max(frames), frames)[:, None]
    return errors, states


def main() -> None:
    """Parse, measure, write."""
    parser = study_parser(__doc__, "maps-nir")
    parser.add_argument("--realisations", type=int, default=10)
    parser.add_argument("--frames", type=int, nargs="+", default=[150, 300, 750, 1500])
    parser.add_argument("--set", dest="overrides", nargs="*", default=[])
    parser.add_argument("--curves", type=Path, help="draw what was measured before")
    options = parser.parse_args()
    if options.curves is not None:
        curves = json.loads(options.curves.read_text())
    else:
        found = []
        for number in range(options.realisations):
            found.append(run_realisation(options.system, number, sorted(options.frames), options.overrides))
            print(f"realisation {number}: {np.round(found[-1][0][:, -1], 3).tolist()}", flush=True)
        rms = np.sqrt(np.mean(np.square([errors for errors, _ in found]), axis=0))
        states = np.sqrt(np.mean([variance for _, variance in found], axis=0))
        curves = {
            "realisations": options.realisations,
            "frames": sorted(options.frames),
            "estimators": {
                name: {p: errors[:, k].tolist() for k, p in enumerate(PARAMETERS)}
                for name, errors in zip(NAMES, (*rms, states), strict=True)
            },
            "goal": dict(zip(PARAMETERS, accuracy_goal(options.system).tolist(), strict=True)),
        }
    options.out.mkdir(parents=True, exist_ok=True)
    name = f"pyramid-frames-{options.system}"
    (options.out / f"{name}.json").write_text(json.dumps(curves, indent=1) + "\n")
    error_curves(curves).savefig(options.out / f"{name}.png", dpi=110)


if __name__ == "__main__":
    main()
