"""The bootstrap of the optical gains: close, measure, rescale, poke less, again (paper, PyWFS section)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.gains import GainRound, GainsResult
from escape_hw.api.matrix import InteractionMatrix
from escape_hw.api.procedure import Procedure
from escape_hw.api.results import CalibrationResult
from escape_hw.bench import Bench
from escape_hw.calibration.gain_loop import GainLoop
from escape_hw.calibration.gain_rounds import Asked, Bootstrap, first_closure, rms, rounds, smooth
from escape_hw.calibration.gain_smoothing import usable
from escape_hw.calibration.optical_gain import scaled_matrix
from escape_hw.errors import Aborted, ConfigError

#: Name of the matrix that only lends its shape, among those beside.
_SHAPE = "shape"


@dataclass(frozen=True, slots=True, eq=False)
class GainsRun:
    """A bootstrap, and the matrix scaled by its gains: the one to close the loop with.

    The matrix is as it was when no round was finished.
    """

    result: GainsResult
    rescaled: CalibrationResult

    def __repr__(self) -> str:
        return f"<{type(self).__name__} {self.result!r}\n  rescaled: {self.rescaled.matrix!r}>"


def bootstrap_gains(
    bench: Bench,
    calibration: CalibrationResult,
    *,
    poke: float = 0.002,
    accuracy: float = 0.01,
    budget: float = 0.01,
    frames: int = 20000,
    gain: float | None = None,
    beside: Mapping[str, InteractionMatrix] | None = None,
    shape: InteractionMatrix | None = None,
    model_psf: NDArray[np.float32] | None = None,
) -> Procedure[GainsRun]:
    """Close the loop on a matrix of unknown scale, and scale it mode by mode to the turbulence there.

    Parameters
    ----------
    bench
        An open bench, under the turbulence that the gains are wanted for.
    calibration
        A matrix of high signal-to-noise ratio, best a pseudo-synthetic one, and its geometry.
    poke
        Last and smallest poke of each mode, rms surface as fraction of full stroke (paper: 0.001 to 0.002).
    accuracy
        Relative standard error of the gains to go on for, rms over the modes.
    budget
        Share of the Strehl ratio that the last pokes may cost; they are lowered to it.
    frames
        Frames per round at most.
    gain
        Effective gain of the loop; as configured by default.
    beside
        Other matrices by name, of the same geometry and modes, whose gains are wanted, too.
    shape
        A matrix of the same geometry and modes, of any scale, whose columns are better in closed loop
        (:func:`~escape_hw.calibration.pseudo_synthetic.at_rest`): the one that is scaled in the end, by gains
        of its own that the same frames tell. The result's gains are those of ``calibration``.
    model_psf
        With it, and with a science camera, every round tells its Strehl ratio.

    Returns
    -------
    GainsRun
        ``result.converged`` says whether to trust it. Stopped early, ``result.partial`` is true.

    Raises
    ------
    ConfigError
        A number that means nothing; nothing moved.
    IncompatibleProduct
        A matrix belongs to another mirror, grid or camera region; nothing moved.
    CalibrationError
        The loop does not close, or does not stay closed; says why.
    """
    wanted = bench.config.loop.gain if gain is None else gain
    _require_sense(poke=poke, accuracy=accuracy, budget=budget, gain=wanted)
    state, others = Bootstrap(), {**(beside or {}), **({} if shape is None else {_SHAPE: shape})}
    loop = GainLoop(bench, calibration, others, science=model_psf is not None)
    before = bench.wfs.status().lost
    try:
        loop.start()
        before = bench.wfs.status().lost
        yield from first_closure(loop, wanted, poke, state)
        yield from rounds(loop, Asked(poke, accuracy, budget, frames, model_psf), list(others), state)
    except Aborted:
        state.partial = True
        _salvage(loop, state)
    finally:
        loop.open_again()
    return _run_of(loop, calibration, shape, state, bench.wfs.status().lost - before)


def _salvage(loop: GainLoop, state: Bootstrap) -> None:
    """Keep what a round told that was aborted after enough frames; the loop is about to be opened."""
    measured = loop.so_far()
    if state.applied is None or measured is None:
        return
    found = smooth(measured)
    change = found.best / usable(state.applied) - 1
    state.rounds.append(
        GainRound(found, state.amplitude, measured.frames, rms(change), math.nan, math.nan, math.nan, False)
    )
    state.applied = found


def _require_sense(**numbers: float) -> None:
    for name, value in numbers.items():
        if not 0 < value < 1:
            raise ConfigError(f"{name} is {value}; it must lie between 0 and 1")


def _run_of(
    loop: GainLoop,
    calibration: CalibrationResult,
    shape: InteractionMatrix | None,
    state: Bootstrap,
    lost: int,
) -> GainsRun:
    rescaled, notes = calibration, list(state.notes)
    lent = state.beside.pop(_SHAPE, None)
    if state.rounds and state.applied is not None:
        scaled, gains = calibration.matrix, state.applied
        # A run that was stopped early may not have told the other's gains.
        if shape is not None and lent is not None:
            scaled, gains = shape, lent
        sigma = np.hypot(gains.best_sigma, gains.best * gains.common_sigma)
        matrix = scaled_matrix(scaled, usable(gains), sigma)
        rescaled = replace(calibration, matrix=matrix, measured=None, partial=state.partial)
        if not state.rounds[-1].reached:
            notes.append("the last round ended at its number of frames, before the accuracy asked for")
    result = GainsResult(
        calibration.matrix.method, tuple(state.rounds), tuple(state.steps), state.converged, state.gain,
        loop.frames, lost, state.beside, state.partial, tuple(notes),
    )  # fmt: skip
    return GainsRun(result, rescaled)
