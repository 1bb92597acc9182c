"""Plan of a procedure before it starts: frames, duration, poke amplitude, warnings."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.stats import norm

from escape_hw.calibration.acquisition.pokes import compute_poke_amplitudes
from escape_hw.calibration.docrime.open_loop import minimum_frames
from escape_hw.calibration.modes.bases import build_modal_basis
from escape_hw.remote.state import Arguments, ProcedurePlan
from escape_hw.runtime.procedures.registry import find_procedure

if TYPE_CHECKING:
    from escape_hw.bench import Bench

#: Standard deviations of the sum of random pokes that some actuator reaches in a run.
_PEAK_SIGMAS = 4.0
#: Share of the frames whose pokes the limits may shorten before the plan says so.
_CLIPPED_WARNING_SHARE = 0.05


class ProcedurePlanner:
    """Plans procedures on a bench.

    Parameters
    ----------
    bench
        An open bench; nothing is moved.
    """

    def __init__(self, bench: Bench) -> None:
        self._bench = bench
        self._m2c: NDArray[np.float64] | None = None

    def plan(self, name: str, arguments: Arguments) -> ProcedurePlan:
        """The plan of a procedure; ``arguments`` are complete.

        Raises
        ------
        EscapeError
            The modal basis cannot be computed.
        """
        rate = self._bench.wfs.settings.frame_rate_hz
        procedure = find_procedure(name)
        frames, random_pokes = procedure.planned_frames(self._bench, arguments), procedure.random_pokes
        poke_per_mode = self._poke_per_mode(arguments)
        return ProcedurePlan(
            name=name, arguments=dict(arguments), frames=frames, seconds=frames / rate,
            stroke=min(_peak_command(random_pokes, poke_per_mode), self._bench.dm.limits.max_stroke),
            warnings=tuple(self._warnings(name, arguments, random_pokes, poke_per_mode)),
        )  # fmt: skip

    def _poke_per_mode(self, arguments: Arguments) -> NDArray[np.float64]:
        """Largest poke of every actuator by every mode ``(n_act, n_modes)``, fraction of full stroke."""
        poke = arguments.get("poke")
        if poke is None:
            return np.zeros((0, 0))
        if self._m2c is None:
            self._m2c = build_modal_basis(self._bench)
        return np.abs(self._m2c * compute_poke_amplitudes(self._bench, self._m2c, float(poke)))

    def _warnings(
        self, name: str, arguments: Arguments, random_pokes: bool, poke_per_mode: NDArray[np.float64]
    ) -> list[str]:
        bench, found = self._bench, []
        limit = bench.dm.limits.max_stroke
        share = _clipped_frames_bound(random_pokes, poke_per_mode, limit)
        if share > _CLIPPED_WARNING_SHARE:
            found.append(
                f"in {100 * share:.2g} % of the frames the pokes would exceed {limit:g} of the stroke; "
                "such a command is scaled down as a whole, and the estimator uses the scaled pokes"
            )
        frames = int(arguments.get("frames") or 0)
        least = minimum_frames(bench.config.calibration, bench.config.basis.n_modes)
        if name in ("docrime", "push-pull-fast") and frames < least:
            found.append(f"{frames} frames cannot constrain the modes; at least {least} are needed")
        if name == "push-pull" and bench.screen is None and not bench.simulated:
            found.append("push-pull needs a source: make sure that no turbulence is in the beam")
        if arguments.get("snr") is not None or arguments.get("accuracy") is not None:
            found.append("the run stops earlier if the target is reached")
        return found


def _command_std(poke_per_mode: NDArray[np.float64]) -> NDArray[np.float64]:
    """Standard deviation of every actuator's command when all modes are poked at once ``(n_act,)``.

    Uniform pokes of amplitude ``a`` have the standard deviation ``a / sqrt(3)``.
    """
    return np.asarray(np.sqrt(np.square(poke_per_mode).sum(axis=1) / 3), np.float64)


def _peak_command(random_pokes: bool, poke_per_mode: NDArray[np.float64]) -> float:
    """Largest command of an actuator in a run, before clipping, fraction of full stroke."""
    if not poke_per_mode.size:
        return 0.0
    if not random_pokes:
        return float(poke_per_mode.max())
    return float(np.minimum(_PEAK_SIGMAS * _command_std(poke_per_mode), poke_per_mode.sum(axis=1)).max())


def _clipped_frames_bound(random_pokes: bool, poke_per_mode: NDArray[np.float64], limit: float) -> float:
    """Upper bound of the share of frames in which an actuator exceeds the limit (union bound)."""
    if not poke_per_mode.size or _peak_command(random_pokes, poke_per_mode) <= limit:
        return 0.0
    if not random_pokes:
        return 1.0
    command_std = _command_std(poke_per_mode)
    return float(min(1.0, 2 * norm.sf(limit / command_std[command_std > 0]).sum()))
