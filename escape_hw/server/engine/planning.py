"""What a procedure would do: frames, seconds, stroke, found out before anything moves."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.stats import norm

from escape_hw.calibration.acquisition.pokes import compute_poke_amplitudes
from escape_hw.calibration.acquisition.sensor_setup import SETUP_FRAMES
from escape_hw.calibration.docrime.open_loop import minimum_frames
from escape_hw.calibration.modes.bases import build_modal_basis
from escape_hw.calibration.push_pull.demodulation import choose_line_frequencies
from escape_hw.calibration.push_pull.modulation import BAND
from escape_hw.errors import TooFewFrames
from escape_hw.remote.state import Arguments, ProcedurePlan

if TYPE_CHECKING:
    from escape_hw.bench import Bench

#: Frames of the settling test before a push-pull, and those that pass between a push and its use.
_SETTLING_TEST_FRAMES, _SETTLING = 50, 2
#: Rounds that a bootstrap of the gains usually takes.
_ROUNDS = 3
#: Standard deviations of the sum of random pokes that some actuator reaches in a run.
_PEAK_SIGMAS = 4.0
#: Share of the frames whose pokes the limits may shorten before the plan says so.
_CLIPPED_WARNING_SHARE = 0.05
#: Science frames of a model PSF.
_PSF_FRAMES = 20
#: Methods that poke every mode in every frame.
_RANDOM_POKE_METHODS = ("docrime", "escape", "gains", "track")


class ProcedurePlanner:
    """Plans the procedures of a bench.

    Parameters
    ----------
    bench
        An open bench; it is asked for its numbers only.
    """

    def __init__(self, bench: Bench) -> None:
        self._bench = bench
        self._m2c: NDArray[np.float64] | None = None

    def plan(self, name: str, arguments: Arguments) -> ProcedurePlan:
        """What the procedure would do with these arguments, all of them.

        Raises
        ------
        EscapeError
            The basis cannot be made.
        """
        rate = self._bench.wfs.settings.frame_rate_hz
        frames = self._frames(name, arguments, rate)
        poke_per_mode = self._poke_per_mode(arguments)
        return ProcedurePlan(
            name=name, arguments=dict(arguments), frames=frames, seconds=frames / rate,
            stroke=min(_peak_command(name, poke_per_mode), self._bench.dm.limits.max_stroke),
            warnings=tuple(self._warnings(name, arguments, poke_per_mode)),
        )  # fmt: skip

    def _frames(self, name: str, arguments: Arguments, rate: float) -> int:
        frames, n_modes = int(arguments.get("frames") or 0), self._bench.config.basis.n_modes
        if name == "push-pull":
            return SETUP_FRAMES + _SETTLING_TEST_FRAMES + 2 * n_modes * (frames + _SETTLING)
        if name == "modulated":
            try:
                at_once = choose_line_frequencies(n_modes, frames, BAND).size
            except TooFewFrames:
                return SETUP_FRAMES + frames
            return SETUP_FRAMES + math.ceil(n_modes / at_once) * frames
        science = self._bench.science
        psf = 0
        if arguments.get("strehl") and science is not None:
            psf = math.ceil(_PSF_FRAMES * rate / science.settings.frame_rate_hz)
        if name == "gains":
            return psf + _ROUNDS * frames
        if name == "track":
            return psf + math.ceil(float(arguments.get("seconds") or 0.0) * rate)
        return psf + frames

    def _poke_per_mode(self, arguments: Arguments) -> NDArray[np.float64]:
        """Largest poke of every actuator by every mode ``(n_act, n_modes)``, fraction of full stroke."""
        poke = arguments.get("poke")
        if poke is None:
            return np.zeros((0, 0))
        if self._m2c is None:
            self._m2c = build_modal_basis(self._bench)
        return np.abs(self._m2c * compute_poke_amplitudes(self._bench, self._m2c, float(poke)))

    def _warnings(self, name: str, arguments: Arguments, poke_per_mode: NDArray[np.float64]) -> list[str]:
        bench, found = self._bench, []
        limit = bench.dm.limits.max_stroke
        share = _clipped_frames_bound(name, poke_per_mode, limit)
        if share > _CLIPPED_WARNING_SHARE:
            found.append(
                f"in {100 * share:.2g} % of the frames the pokes would pass {limit:g} of the stroke; "
                "they are shortened as a whole, which the estimate knows"
            )
        frames = int(arguments.get("frames") or 0)
        least = minimum_frames(bench.config.calibration, bench.config.basis.n_modes)
        if name in ("docrime", "push-pull-fast") and frames < least:
            found.append(f"{frames} frames cannot constrain the modes; at least {least} are needed")
        if name == "push-pull" and bench.screen is None and not bench.simulated:
            found.append("push-pull needs a source: see that no turbulence is in the beam")
        if arguments.get("snr") is not None or arguments.get("accuracy") is not None:
            found.append("it may stop earlier, when the target is reached")
        return found


def _command_std(poke_per_mode: NDArray[np.float64]) -> NDArray[np.float64]:
    """Standard deviation of every actuator's command when all modes are poked at once ``(n_act,)``.

    Uniform pokes of amplitude ``a`` have the standard deviation ``a / sqrt(3)``.
    """
    return np.asarray(np.sqrt(np.square(poke_per_mode).sum(axis=1) / 3), np.float64)


def _peak_command(name: str, poke_per_mode: NDArray[np.float64]) -> float:
    """Largest command of an actuator that a run's pokes ask for, fraction of full stroke."""
    if not poke_per_mode.size:
        return 0.0
    if name not in _RANDOM_POKE_METHODS:
        return float(poke_per_mode.max())
    return float(np.minimum(_PEAK_SIGMAS * _command_std(poke_per_mode), poke_per_mode.sum(axis=1)).max())


def _clipped_frames_bound(name: str, poke_per_mode: NDArray[np.float64], limit: float) -> float:
    """Share of the frames in which some actuator would pass the limit, at most (union bound)."""
    if not poke_per_mode.size or _peak_command(name, poke_per_mode) <= limit:
        return 0.0
    if name not in _RANDOM_POKE_METHODS:
        return 1.0
    command_std = _command_std(poke_per_mode)
    return float(min(1.0, 2 * norm.sf(limit / command_std[command_std > 0]).sum()))
