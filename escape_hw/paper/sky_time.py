"""Sky time: error of the registration against the number of frames, over random simulated registrations."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
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
from escape_hw.deprecation import renamed_text, warn_renamed
from escape_hw.errors import Aborted, CalibrationError, TooFewFrames
from escape_hw.runtime.host.processes import open_process_pool, terminate_pool
from escape_hw.runtime.session.system import System

#: Half ranges of the random registrations, in the units of the registration.
HALF_RANGES = np.array([100.0, 100.0, 2.0, 4.0, 4.0])
#: Required accuracy: rms errors in the same units.
GOAL = np.array([1.0, 1.0, 0.02, 0.1, 0.1])
#: Required accuracy on a pyramid, whose sub-apertures are pixels of the pupil image.
PYRAMID_GOAL = np.array([4.0, 4.0, 0.05, 0.2, 0.2])
#: Frames at which the errors are taken.
FRAMES = (20, 50, 100, 220, 300, 500, 1000)
#: From the paper's matrix, from the whitened matrix, and from the whitened frames.
ESTIMATORS = ("unwhitened", "whitened", "telemetry")
#: Seconds between two looks at an abort.
_POLL_S = 0.2


@dataclass(frozen=True, slots=True, eq=False)
class RealisationErrors:
    """Errors and stated standard errors of one realisation ``(n_estimators, n_frames, 5)``; NaN if refused.

    ``exact`` and ``hybrid`` are the Cramer-Rao bounds ``(n_frames, 5)``, see
    :class:`~escape_hw.calibration.sprint.cramer_rao_bound.CramerRaoBound`.
    """

    errors: NDArray[np.float64]
    sigmas: NDArray[np.float64]
    exact: NDArray[np.float64]
    hybrid: NDArray[np.float64]


def random_registration(number: int) -> Registration:
    """The registration of realisation ``number``: uniform within :data:`HALF_RANGES`."""
    return Registration.from_array(np.random.default_rng(1000 + number).uniform(-1, 1, 5) * HALF_RANGES)


def accuracy_goal(system: str | SystemConfig) -> NDArray[np.float64]:
    """Required accuracy for a system's kind of sensor ``(5,)``."""
    config = load_system(system) if isinstance(system, str) else system
    return PYRAMID_GOAL if config.sensor.kind == "pyramid" else GOAL


def registration_overrides(injected: Registration) -> list[str]:
    """Overrides that set the true registration of a simulation."""
    return [f"twin.registration.{name}={value!r}" for name, value in injected.to_dict().items()]


def simulated_config(
    system: str | SystemConfig, overrides: Sequence[str] = (), seed: int | None = None
) -> SystemConfig:
    """The configuration of a system with every device simulated.

    ``overrides`` and ``seed`` are those of :func:`~escape_hw.config.loader.load_system`.
    """
    config = load_system(system) if isinstance(system, str) else system
    overridden = [name for name, device in config.devices if isinstance(device, DeviceConfig) and device.mode]
    changes = [*(f"devices.{name}.mode=sim" for name in overridden), *overrides]
    return load_text(config.to_toml(), config.system.name, overrides=changes, seed=seed, mode="sim")


def realisation_config(
    system: str | SystemConfig, number: int, overrides: Sequence[str] = ()
) -> tuple[Registration, SystemConfig]:
    """Registration of realisation ``number``, and the simulated configuration that has it."""
    injected = random_registration(number)
    return injected, simulated_config(
        system, [*overrides, *registration_overrides(injected)], seed=number + 1
    )


def run_realisation(
    system: str | SystemConfig,
    number: int,
    frames: Sequence[int] = FRAMES,
    overrides: Sequence[str] = (),
    estimators: Sequence[str] = ESTIMATORS,
) -> RealisationErrors:
    """Record one run with one true registration and estimate it from the first frames.

    The estimators read frames, indices and commands; the true registration is only compared at the end.
    Without ``"whitened"`` among ``estimators`` the noise, and with it the bound, is unknown.
    """
    if "plain" in estimators:
        warn_renamed(renamed_text("the estimator 'plain'", "'unwhitened'"))
        estimators = [*estimators, "unwhitened"]
    injected, config = realisation_config(system, number, overrides)
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
            # A separate run: the sensor's geometry, too, is found from so few frames.
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

    Noise, whitening filter, registration and scatter of the random effects are estimated from the whole
    run and taken as known.
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
    realisations: int = 20,
    frames: Sequence[int] = FRAMES,
    overrides: Sequence[str] = (),
    workers: int = 2,
) -> Procedure[dict[str, Any]]:
    """Run a campaign over random registrations in parallel processes.

    Parameters
    ----------
    system
        Name or path of a system, or its configuration; it is simulated, with the overrides.
    realisations
        Number of random registrations.
    frames
        Numbers of frames at which to estimate, ascending.
    workers
        Parallel processes.

    Returns
    -------
    dict
        See :func:`summary`. When a process died, or the campaign was stopped, it covers the realisations
        finished by then, and ``note`` gives the reason.

    Raises
    ------
    CalibrationError
        A process died before any realisation was finished.
    Aborted
        Stopped before any realisation was finished.
    """
    report = Reporter("sky time", realisations, "realisation")
    done: list[RealisationErrors] = []
    note, pool = "", open_process_pool(workers, helper_threads=True)
    try:
        pending: set[Future[RealisationErrors]] = {
            pool.submit(run_realisation, system, number, tuple(frames), tuple(overrides))
            for number in range(realisations)
        }
        while pending and not note:
            completed, pending = wait(pending, timeout=_POLL_S, return_when=FIRST_COMPLETED)
            done += [future.result() for future in completed if not _worker_died(future)]
            if any(map(_worker_died, completed)):
                note = (
                    f"a process of the campaign died (killed, or out of memory) after {len(done)} of "
                    f"{realisations} realisations; try fewer processes than {workers}"
                )
            if note or report.is_due():
                # Also when a process died: a Ctrl-C that ended it is raised here.
                yield report(len(done))
    except Aborted:
        if not done:
            raise
        note = f"stopped after {len(done)} of {realisations} realisations"
    finally:
        terminate_pool(pool)
    if not done:
        raise CalibrationError(note)
    curves = summary(done, frames, accuracy_goal(system))
    return {**curves, "note": note} if note else curves


def _worker_died(future: Future[RealisationErrors]) -> bool:
    """True when the process died; an error of the realisation is raised by its result."""
    return isinstance(future.exception(), BrokenProcessPool)


def summary(
    realisations: Sequence[RealisationErrors], frames: Sequence[int], goal: NDArray[np.float64] = GOAL
) -> dict[str, Any]:
    """Rms errors, normalised chi-squared and bounds against frames, for JSON and for the report.

    ``fewest_frames`` is, by estimator, the least number of frames at which every parameter meets
    ``goal``; ``None`` where none does.
    """
    errors = np.stack([one.errors for one in realisations])
    sigmas = np.stack([one.sigmas for one in realisations])
    rms = np.sqrt(np.mean(np.square(errors), axis=0))
    met = np.isfinite(errors).all(axis=(0, 3)) & np.all(rms <= goal, axis=2)
    chi2 = np.mean(np.square(errors / sigmas), axis=0)
    exact, hybrid = (
        np.sqrt(np.mean(np.square(np.stack([getattr(one, name) for one in realisations])), axis=0))
        for name in ("exact", "hybrid")
    )

    def by_parameter(curve: NDArray[np.float64]) -> dict[str, list[float | None]]:
        return {
            p: [float(v) if np.isfinite(v) else None for v in curve[:, k]] for k, p in enumerate(PARAMETERS)
        }

    return {
        "realisations": len(realisations),
        "frames": [int(n) for n in frames],
        "estimators": {name: by_parameter(rms[e]) for e, name in enumerate(ESTIMATORS)},
        "chi2": {name: by_parameter(chi2[e]) for e, name in enumerate(ESTIMATORS)},
        "exact_bound": by_parameter(exact),
        "bound": by_parameter(hybrid),
        "goal": {p: float(goal[k]) for k, p in enumerate(PARAMETERS)},
        "fewest_frames": {
            name: min((int(n) for f, n in enumerate(frames) if met[e, f]), default=None)
            for e, name in enumerate(ESTIMATORS)
        },
    }


def table_rows(curves: dict[str, Any]) -> Iterator[tuple[str, ...]]:
    """The curves as rows of text: estimator, frames, rms errors with chi-squared in parentheses."""
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
