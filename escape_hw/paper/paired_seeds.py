"""Loops with each matrix on equal turbulence, over several twins with mirrors and turbulence of their own."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from itertools import combinations
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.procedure import Procedure, Reporter
from escape_hw.api.registration import Registration
from escape_hw.api.representation import short_repr
from escape_hw.api.results import CalibrationResult, LoopResult, RegistrationEstimate
from escape_hw.bench import Bench
from escape_hw.config.system import SystemConfig
from escape_hw.errors import Aborted, CalibrationError, ConfigError
from escape_hw.io import documents
from escape_hw.paper.experiments import Table1Result, reproduce_table1
from escape_hw.paper.frame_counts import PAIRED_LOOP_FRAMES, SEEDS
from escape_hw.pipeline.statistics import CONFIDENCE, MeanInterval, mean_interval
from escape_hw.runtime.procedures.calibration import calibrate_with_method, measured_calibration
from escape_hw.runtime.procedures.criteria import largest_pull
from escape_hw.runtime.procedures.model_psf import model_psf

#: The matrices compared, in the order of tables; differences are of a later one minus an earlier one.
MATRICES = ("push-pull", "DO-CRIME", "ESCAPE")
#: Push-pull takes about as long as SHORT: some twelve frames for the mirror to settle after each push and
#: pull, and these.
PUSH_PULL_FRAMES = 3


@dataclass(slots=True)
class SeedLoops:
    """Matrices and loops of one twin, by label.

    A matrix without a loop could not be measured, or has no gain that gives a stable loop. ``scans`` are the
    loops of the searches for the gain, ``notes`` the reasons for what is missing.
    """

    seed: int
    injected: Registration
    calibrations: dict[str, CalibrationResult] = field(default_factory=dict)
    loops: dict[str, LoopResult] = field(default_factory=dict)
    scans: dict[str, list[LoopResult]] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    __repr__ = short_repr

    @property
    def estimate(self) -> RegistrationEstimate | None:
        """The registration that ESCAPE found."""
        return self.calibrations["ESCAPE"].registration if "ESCAPE" in self.calibrations else None

    def is_stable(self, label: str) -> bool:
        """Whether the loop with a matrix is stable."""
        return label in self.loops and self.loops[label].stable

    def strehl(self, label: str) -> float:
        """Strehl ratio (peak) of the loop with a matrix; 0 if it diverged."""
        loop = self.loops.get(label)
        return loop.strehl.peak.value if loop is not None and loop.stable and loop.strehl is not None else 0.0


@dataclass(slots=True)
class PairedSeeds:
    """SHORT and LONG registration of the first twin, and the loops of all of them that were finished."""

    registrations: Table1Result
    seeds: list[SeedLoops] = field(default_factory=list)
    partial: bool = False
    __repr__ = short_repr

    def strehl(self, label: str) -> NDArray[np.float64]:
        """Strehl ratio by seed ``(n_seeds,)``; 0 where the loop diverged."""
        return np.array([one.strehl(label) for one in self.seeds])

    def difference(self, first: str, second: str) -> MeanInterval:
        """Strehl ratio of one matrix minus that of another, in percent, paired by seed."""
        return mean_interval(100 * (self.strehl(first) - self.strehl(second)))


def reproduce_revolt(
    bench: Bench,
    *,
    short: int,
    long: int,
    loop_frames: int = PAIRED_LOOP_FRAMES,
    seeds: int = SEEDS,
) -> Procedure[PairedSeeds]:
    """Registration from few and many frames, and loops with three matrices on several twins.

    The first twin is the bench; those of the next seeds have mirrors and turbulence of their own. On each,
    ESCAPE and DO-CRIME are measured from the ``short`` frames and push-pull as configured, all on the star,
    with one sensor geometry. Each matrix is used at its own best gain, found on turbulence that all share,
    and evaluated on other turbulence that all share. A matrix without a stable loop has the Strehl ratio 0.

    Parameters
    ----------
    bench
        A simulated bench that has just been opened.
    short, long
        Frames of the registrations.
    loop_frames
        Frames of each evaluated loop.
    seeds
        Number of twins.

    Raises
    ------
    TooFewFrames
        For the number of modes; nothing moved.
    ConfigError
        The bench is not simulated, or the loops are too short for a Strehl ratio; nothing moved.
    """
    config = bench.config
    _require_simulated(bench)
    _require_enough_frames(config, short, long, loop_frames)
    registrations = yield from reproduce_table1(bench, frames={"SHORT": short, "LONG": long})
    result = PairedSeeds(registrations, partial=registrations.partial)
    if result.partial:
        return result
    report = Reporter("paired loops", seeds, "seed")
    first = registrations.calibrations["SHORT"]
    try:
        for number in range(seeds):
            yield report(number)
            seed = config.system.seed + number
            known = None if number else first
            result.seeds.append((yield from _measure_seed(config, seed, short, loop_frames, known)))
    except Aborted:
        # Only finished seeds have all their loops.
        result.partial = True
    return result


def _require_simulated(bench: Bench) -> None:
    if not bench.simulated:
        raise ConfigError(
            f"'{bench.config.system.name}' has real devices; loops on equal turbulence need a simulated "
            "system (--mode sim)"
        )


def _require_enough_frames(config: SystemConfig, short: int, long: int, loop_frames: int) -> None:
    """Refuse frames that are too few for a matrix or a Strehl ratio."""
    from escape_hw.calibration.docrime.open_loop import require_enough_frames

    require_enough_frames(config.calibration, min(short, long), config.basis.n_modes)
    if loop_frames < (least := _strehl_frames(config)):
        raise ConfigError(f"loops of {loop_frames} frames give no Strehl ratio; use at least {least}")


def _strehl_frames(config: SystemConfig) -> int:
    """Fewest frames of a loop for a Strehl ratio."""
    from escape_hw.calibration.loop.runner import minimum_strehl_frames

    science = config.devices.science or config.devices.wfs
    return minimum_strehl_frames(config.devices.wfs.frame_rate_hz, science.frame_rate_hz)


def _measure_seed(
    config: SystemConfig, seed: int, short: int, loop_frames: int, known: CalibrationResult | None
) -> Procedure[SeedLoops]:
    """Matrices and loops of one twin; ``known`` is ESCAPE's calibration if it was measured already.

    Raises
    ------
    Aborted
        Stopped; what was measured is discarded.
    """
    from escape_hw.paper.sky_time import simulated_config

    twin = simulated_config(config, seed=seed)
    # The mirror is that of the twin, the turbulence another: no gain was found on it.
    evaluation = simulated_config(config, [f"twin.run_seed={seed}"], seed=seed)
    one = SeedLoops(seed, twin.twin.registration.to_registration())
    with Bench.from_config(twin) as bench:
        model = yield from model_psf(bench)
    try:
        yield from _measure_matrices(twin, short, known, one)
    except CalibrationError as error:
        one.notes.append(str(error))
    for label in MATRICES:
        if label in one.calibrations:
            yield from _close_loop(twin, evaluation, label, loop_frames, model, one)
    return one


def _measure_matrices(
    twin: SystemConfig, short: int, known: CalibrationResult | None, one: SeedLoops
) -> Procedure[None]:
    """Add the three calibrations, each from the initial state of the twin."""
    found = known
    if found is None:
        with Bench.from_config(twin) as bench:
            found = _whole((yield from calibrate_with_method(bench, "escape", frames=short)))
    one.calibrations["ESCAPE"] = found
    measured = measured_calibration(found)
    if measured is not None:
        one.calibrations["DO-CRIME"] = measured
    with Bench.from_config(twin) as bench:
        baseline = _whole((yield from calibrate_with_method(bench, "push-pull", grid=found.grid)))
    one.calibrations["push-pull"] = baseline


def _close_loop(
    twin: SystemConfig,
    evaluation: SystemConfig,
    label: str,
    loop_frames: int,
    model: NDArray[np.float32],
    one: SeedLoops,
) -> Procedure[None]:
    """Search a matrix's own best gain, and add the loop with it; none if no gain gives a stable loop."""
    from escape_hw.calibration.loop.gain_search import find_best_gain
    from escape_hw.calibration.loop.performance import close_loop

    calibration = one.calibrations[label]
    matrix, grid = calibration.matrix, calibration.grid
    try:
        with Bench.from_config(twin) as bench:
            search = yield from find_best_gain(
                bench, matrix, grid, frames=_strehl_frames(twin), model_psf=model
            )
        one.scans[label] = [_whole(run) for run in search.runs]
        with Bench.from_config(evaluation) as bench:
            loop = yield from close_loop(
                bench, matrix, grid, gain=search.gain, frames=loop_frames, model_psf=model
            )
    except CalibrationError as error:
        one.notes.append(f"{label}: {error}")
        return
    one.loops[label] = replace(_whole(loop), gain_sigma=search.sigma)


_Result = TypeVar("_Result", CalibrationResult, LoopResult)


def _whole(result: _Result) -> _Result:
    """The result, unless it was stopped (then raises :class:`Aborted`)."""
    if result.partial:
        raise Aborted
    return result


# ---------------------------------------------------------------- document
def paired_document(result: PairedSeeds) -> dict[str, Any]:
    """Strehl ratios by seed, their means, and the paired differences, in plain values.

    Strehl ratios and their differences are ratios; a loop that diverged has 0.
    """
    return {
        "matrices": list(MATRICES),
        "confidence": CONFIDENCE,
        "seeds": [_seed_document(one) for one in result.seeds],
        "mean": {label: result.strehl(label).mean() for label in MATRICES} if result.seeds else {},
        "differences": list(_difference_documents(result)) if len(result.seeds) > 1 else [],
    }


def _seed_document(one: SeedLoops) -> dict[str, Any]:
    estimate = one.estimate
    return {
        "seed": one.seed,
        **documents.registration_document(estimate),
        "largest_pull": None if estimate is None else largest_pull(estimate, one.injected)[0],
        "strehl": {label: one.strehl(label) for label in MATRICES},
        "stable": {label: one.is_stable(label) for label in MATRICES},
        "loops": {label: documents.loop_document(loop) for label, loop in one.loops.items()},
        "notes": one.notes,
    }


def _difference_documents(result: PairedSeeds) -> Iterator[dict[str, Any]]:
    for second, first in combinations(MATRICES, 2):
        found = result.difference(first, second)
        limits = {"mean": found.mean / 100, "low": found.low / 100, "high": found.high / 100}
        yield {"first": first, "second": second, **limits, "seeds": found.n, "text": f"{found} %"}
