"""Sky time: the error of the registration against the frames spent, over random plants on a twin."""

from __future__ import annotations

import multiprocessing
import signal
from collections.abc import Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.interaction_matrix import InteractionMatrix
from escape_hw.api.procedure import Procedure, Reporter, run
from escape_hw.api.registration import PARAMETERS, Registration
from escape_hw.api.synthetic_model import SyntheticModel
from escape_hw.calibration.acquisition.frames import build_interaction_matrix
from escape_hw.calibration.docrime.acquisition import AcquisitionRecord
from escape_hw.calibration.docrime.estimator import DocrimeEstimator
from escape_hw.calibration.docrime.fit import DocrimeSolution
from escape_hw.calibration.docrime.open_loop import docrime_run
from escape_hw.calibration.docrime.regression import MAX_CORRELATED_SLOPES
from escape_hw.calibration.docrime.response import filter_telemetry
from escape_hw.calibration.escape.method import escape
from escape_hw.calibration.sprint.cramer_rao_bound import compute_registration_bound
from escape_hw.calibration.sprint.fit import fit_registration, sprint
from escape_hw.calibration.sprint.telemetry_fit import decorrelate_columns, telemetry_from_frames
from escape_hw.config.devices import DeviceConfig
from escape_hw.config.loader import load_system, load_text
from escape_hw.config.system import SystemConfig
from escape_hw.errors import Aborted, CalibrationError, TooFewFrames
from escape_hw.runtime.session.system import System

#: Half ranges of the random plants, in the units of the registration.
HALF_RANGES = np.array([100.0, 100.0, 2.0, 4.0, 4.0])
#: The accuracy asked for: rms errors in the same units.
GOAL = np.array([1.0, 1.0, 0.02, 0.1, 0.1])
#: The same on a pyramid, whose sub-apertures are pixels of the pupil image.
PYRAMID_GOAL = np.array([4.0, 4.0, 0.05, 0.2, 0.2])
#: Frames at which the errors are taken.
FRAMES = (20, 50, 100, 220, 300, 500, 1000)
#: The paper's matrix, the whitened one, and the whitened frames themselves.
ESTIMATORS = ("plain", "whitened", "telemetry")
#: How long an abort may wait for its turn.
_POLL_S = 0.2


@dataclass(frozen=True, slots=True, eq=False)
class RealisationErrors:
    """Errors and stated standard errors of one plant, ``(n_estimators, n_frames, 5)``; NaN if refused.

    ``exact`` and ``hybrid`` are the Cramer-Rao bounds ``(n_frames, 5)``, see
    :class:`~escape_hw.calibration.sprint.cramer_rao_bound.CramerRaoBound`.
    """

    errors: NDArray[np.float64]
    sigmas: NDArray[np.float64]
    exact: NDArray[np.float64]
    hybrid: NDArray[np.float64]


def random_registration(number: int) -> Registration:
    """The registration of plant ``number``: uniform within :data:`HALF_RANGES`."""
    return Registration.from_array(np.random.default_rng(1000 + number).uniform(-1, 1, 5) * HALF_RANGES)


def accuracy_goal(system: str | SystemConfig) -> NDArray[np.float64]:
    """The accuracy asked for of a system's kind of sensor ``(5,)``."""
    config = load_system(system) if isinstance(system, str) else system
    return PYRAMID_GOAL if config.sensor.kind == "pyramid" else GOAL


def registration_overrides(injected: Registration) -> list[str]:
    """Overrides that plant a registration in a twin."""
    return [f"twin.registration.{name}={value!r}" for name, value in injected.to_dict().items()]


def simulated_config(
    system: str | SystemConfig, overrides: Sequence[str] = (), seed: int | None = None
) -> SystemConfig:
    """The configuration of a system with every device a twin, whatever its file says.

    Parameters
    ----------
    system
        Name or path of a system, or its configuration.
    overrides, seed
        As for :func:`~escape_hw.config.loader.load_system`.
    """
    config = load_system(system) if isinstance(system, str) else system
    overridden = [name for name, device in config.devices if isinstance(device, DeviceConfig) and device.mode]
    changes = [*(f"devices.{name}.mode=sim" for name in overridden), *overrides]
    return load_text(config.to_toml(), config.system.name, overrides=changes, seed=seed, mode="sim")


def run_realisation(
    system: str | SystemConfig,
    number: int,
    frames: Sequence[int] = FRAMES,
    overrides: Sequence[str] = (),
    estimators: Sequence[str] = ESTIMATORS,
) -> RealisationErrors:
    """Record one run on one plant and estimate its registration from its first frames.

    The estimators get frames, indices and the commands sent; the plant is only compared at the end.
    Without ``"whitened"`` among ``estimators`` there is no bound, for the noise is not known.
    """
    injected = random_registration(number)
    config = simulated_config(system, [*overrides, *registration_overrides(injected)], seed=number + 1)
    errors = np.full((len(ESTIMATORS), len(frames), 5), np.nan)
    sigmas, bounds = errors.copy(), np.full((2, len(frames), 5), np.nan)
    with System.from_config(config) as bench:
        c = bench.config.calibration
        measured = bench.run(docrime_run(bench, frames=max(frames), record=True))
        if measured.record is None:
            raise RuntimeError("the run was not recorded")
        index, slopes, pokes = measured.record
        grid, m2c = measured.result.grid, measured.result.matrix.m2c
        model = bench.model(grid)
        for e, order in enumerate((0, c.whiten_order)):
            for f, count in enumerate(frames if ESTIMATORS[e] in estimators else ()):
                estimator = DocrimeEstimator(
                    slopes.shape[1], pokes.shape[1], order=order, lags=c.lags,
                    correlations=slopes.shape[1] <= MAX_CORRELATED_SLOPES,
                )  # fmt: skip
                try:
                    solution = estimator.extend(index[:count], slopes[:count], pokes[:count]).solve()
                    matrix = build_interaction_matrix(
                        bench, grid, m2c, solution.matrix, solution.sigma, ESTIMATORS[e]
                    )
                    found = sprint(matrix, model, modes=c.sprint_modes, covariance=solution.covariance)
                except (TooFewFrames, CalibrationError):
                    continue
                errors[e, f] = found.registration.to_array() - injected.to_array()
                sigmas[e, f] = found.sigma
                if order and count == max(frames):
                    bounds = _bounds(measured.record, c.lags, solution, matrix, model, frames)
        for f, count in enumerate(frames if ESTIMATORS[2] in estimators else ()):
            # Frames of its own: a run this short must find the sensor's geometry on them as well.
            try:
                short = bench.run(escape(bench, frames=count, estimator="telemetry")).registration
            except (TooFewFrames, CalibrationError):
                continue
            if short is not None:
                errors[2, f] = short.registration.to_array() - injected.to_array()
                sigmas[2, f] = short.sigma
    return RealisationErrors(errors, sigmas, *bounds)


def _bounds(
    record: AcquisitionRecord,
    lags: int,
    solution: DocrimeSolution,
    matrix: InteractionMatrix,
    model: SyntheticModel,
    frames: Sequence[int],
) -> NDArray[np.float64]:
    """Exact and hybrid bound ``(2, n_frames, 5)`` for the pokes of a run's first frames.

    Noise, whitening filter, registration and scatter of the random effects are those that the whole run
    tells: the bound knows them, as it must.
    """
    columns = decorrelate_columns(matrix, solution.gram, solution.variance)
    fit = run(fit_registration(columns, model, covariance=solution.covariance))
    if fit.estimate_priors is None:
        raise RuntimeError("the solver fitted no random effects")
    data = telemetry_from_frames(*record, before=solution.whitener.size + lags)
    pokes = (
        filter_telemetry(data, solution.whitener, lags).excitation(solution.response.weights).astype(float)
    )
    noise = solution.variance if solution.covariance is None else solution.covariance
    out = np.empty((2, len(frames), 5))
    for f, count in enumerate(frames):
        few = pokes[:count] - pokes[:count].mean(axis=0)
        bound = compute_registration_bound(
            matrix, few.T @ few, noise, model, fit.estimate.registration, fit.estimate_priors().priors
        )
        out[:, f] = bound.exact, bound.hybrid
    return out


def sky_time(
    system: str | SystemConfig,
    *,
    plants: int = 20,
    frames: Sequence[int] = FRAMES,
    overrides: Sequence[str] = (),
    workers: int = 2,
) -> Procedure[dict[str, Any]]:
    """Run a campaign over random plants in parallel processes.

    Parameters
    ----------
    system
        Name or path of a system, or its configuration; its twins are used.
    plants
        How many random plants.
    frames
        Numbers of frames at which to take the errors, rising.
    overrides
        Configuration overrides, ``section.key=value`` each.
    workers
        Parallel processes.

    Returns
    -------
    dict
        See :func:`summary`. When a process died, or the campaign was stopped, it is about the plants
        that were finished by then, and ``note`` says so.

    Raises
    ------
    CalibrationError
        A process died before any plant was finished.
    Aborted
        Stopped before any plant was finished.
    """
    report = Reporter("sky time", plants, "plant")
    done: list[RealisationErrors] = []
    context = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(workers, mp_context=context, initializer=_ignore_interrupts)
    try:
        left: set[Future[RealisationErrors]] = {
            pool.submit(run_realisation, system, number, tuple(frames), tuple(overrides))
            for number in range(plants)
        }
        while left:
            ended, left = wait(left, timeout=_POLL_S, return_when=FIRST_COMPLETED)
            done += [future.result() for future in ended if not _worker_died(future)]
            died = any(map(_worker_died, ended))
            if died or report.due():
                # Also when a process died: whoever pressed Ctrl-C meant to stop, and is heard here.
                yield report(len(done))
            if died:
                # What ended at the same time has been taken already; the others never will.
                break
    except Aborted:
        if not done:
            raise
        return {
            **summary(done, frames, accuracy_goal(system)),
            "note": f"stopped after {len(done)} of {plants} plants",
        }
    finally:
        _terminate(pool)
    curves = summary(done, frames, accuracy_goal(system)) if done else None
    if len(done) == plants and curves is not None:
        return curves
    lost = (
        f"a process of the campaign died (killed, or out of memory) after {len(done)} of {plants} plants; "
        f"try fewer processes than {workers}"
    )
    if curves is None:
        raise CalibrationError(lost)
    return {**curves, "note": lost}


def _worker_died(future: Future[RealisationErrors]) -> bool:
    """True when the process died; errors inside a plant are raised by its result."""
    return isinstance(future.exception(), BrokenProcessPool)


def _ignore_interrupts() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _terminate(pool: ProcessPoolExecutor) -> None:
    """End the processes at once: nobody wants what they are at any more."""
    # Python 3.14 has a method for it.
    workers = list((getattr(pool, "_processes", None) or {}).values())
    pool.shutdown(wait=False, cancel_futures=True)
    for worker in workers:
        worker.terminate()


def summary(
    plants: Sequence[RealisationErrors], frames: Sequence[int], goal: NDArray[np.float64] = GOAL
) -> dict[str, Any]:
    """Rms errors, normalised chi-squared and bound against frames, ready for JSON and for the report.

    ``fewest_frames`` is, per estimator, the least number of frames at which every parameter meets
    ``goal``; ``None`` where none does.
    """
    errors = np.stack([p.errors for p in plants])
    sigmas = np.stack([p.sigmas for p in plants])
    met = np.isfinite(errors).all(axis=(0, 3)) & np.all(np.sqrt(np.mean(errors**2, axis=0)) <= goal, axis=2)
    rms = np.sqrt(np.mean(np.square(errors), axis=0))
    chi2 = np.mean(np.square(errors / sigmas), axis=0)
    exact, hybrid = (
        np.sqrt(np.mean(np.square(np.stack([getattr(p, name) for p in plants])), axis=0))
        for name in ("exact", "hybrid")
    )
    fewest: dict[str, int | None] = {}
    for e, name in enumerate(ESTIMATORS):
        enough = [int(n) for f, n in enumerate(frames) if met[e, f]]
        fewest[name] = min(enough) if enough else None
    return {
        "plants": len(plants),
        "frames": [int(n) for n in frames],
        "estimators": {
            name: {p: _finite_or_none(rms[e, :, k]) for k, p in enumerate(PARAMETERS)}
            for e, name in enumerate(ESTIMATORS)
        },
        "chi2": {
            name: {p: _finite_or_none(chi2[e, :, k]) for k, p in enumerate(PARAMETERS)}
            for e, name in enumerate(ESTIMATORS)
        },
        "exact_bound": {p: _finite_or_none(exact[:, k]) for k, p in enumerate(PARAMETERS)},
        "bound": {p: _finite_or_none(hybrid[:, k]) for k, p in enumerate(PARAMETERS)},
        "goal": {p: float(goal[k]) for k, p in enumerate(PARAMETERS)},
        "fewest_frames": fewest,
    }


def _finite_or_none(values: NDArray[np.float64]) -> list[float | None]:
    return [float(v) if np.isfinite(v) else None for v in values]


def table_rows(curves: dict[str, Any]) -> Iterator[tuple[str, ...]]:
    """The curves as rows of text: estimator, frames, rms errors, and chi-squared in brackets."""
    for name, by_parameter in curves["estimators"].items():
        for i, count in enumerate(curves["frames"]):
            cells = []
            for p in PARAMETERS:
                error, chi2 = by_parameter[p][i], curves["chi2"][name][p][i]
                cells.append("refused" if error is None else f"{error:.3g} ({chi2:.2g})")
            yield (name, str(count), *cells)
    for i, count in enumerate(curves["frames"]):
        for name in ("exact_bound", "bound"):
            found = (curves[name][p][i] for p in PARAMETERS)
            cells = ["unknown" if value is None else f"{value:.3g}" for value in found]
            yield (name.replace("_", " "), str(count), *cells)
