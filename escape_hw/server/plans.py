"""What a procedure would do: frames, seconds, stroke, found out before anything moves."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from escape_hw.calibration.demodulation import line_frequencies
from escape_hw.calibration.docrime import least_frames
from escape_hw.calibration.modulated import BAND
from escape_hw.calibration.sensor_setup import SETUP_FRAMES, modal_basis, poke_amplitudes
from escape_hw.errors import TooFewFrames
from escape_hw.remote.state import Arguments, Plan

if TYPE_CHECKING:
    from escape_hw.bench import Bench

#: Frames of the settling test before a push-pull, and those that pass between a push and its use.
_PUSH_PULL_FIRST, _SETTLING = 50, 2
#: Rounds that a bootstrap of the gains usually takes.
_ROUNDS = 3
#: Standard deviations of the sum of random pokes that some actuator reaches in a run.
_REACHED = 4.0
#: Science frames of a model PSF.
_PSF_FRAMES = 20
#: Methods that poke every mode in every frame.
_RANDOM = ("docrime", "escape", "push-pull-fast", "gains", "track")


class Planner:
    """Plans the procedures of a bench.

    Parameters
    ----------
    bench
        An open bench; it is asked for its numbers only.
    """

    def __init__(self, bench: Bench) -> None:
        self._bench = bench
        self._m2c: NDArray[np.float64] | None = None

    def plan(self, name: str, arguments: Arguments) -> Plan:
        """What the procedure would do with these arguments, all of them.

        Raises
        ------
        EscapeError
            The basis cannot be made.
        """
        rate = self._bench.wfs.settings.frame_rate_hz
        frames = self._frames(name, arguments, rate)
        stroke = self._stroke(name, arguments)
        return Plan(
            name=name, arguments=dict(arguments), frames=frames, seconds=frames / rate, stroke=stroke,
            warnings=tuple(self._warnings(name, arguments, stroke)),
        )  # fmt: skip

    def _frames(self, name: str, arguments: Arguments, rate: float) -> int:
        frames, n_modes = int(arguments.get("frames") or 0), self._bench.config.basis.n_modes
        if name == "push-pull":
            return SETUP_FRAMES + _PUSH_PULL_FIRST + 2 * n_modes * (frames + _SETTLING)
        if name == "modulated":
            try:
                at_once = line_frequencies(n_modes, frames, BAND).size
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

    def _stroke(self, name: str, arguments: Arguments) -> float:
        """Largest poke of an actuator, fraction of full stroke."""
        poke = arguments.get("poke")
        if poke is None:
            return 0.0
        if self._m2c is None:
            self._m2c = modal_basis(self._bench)
        amplitude = poke_amplitudes(self._bench, self._m2c, float(poke))
        each = np.abs(self._m2c * amplitude)
        if name not in _RANDOM:
            return float(each.max())
        # Uniform pokes of amplitude a have the standard deviation a / sqrt(3).
        usual = _REACHED * np.sqrt(np.square(each).sum(axis=1) / 3)
        return float(np.minimum(usual, each.sum(axis=1)).max())

    def _warnings(self, name: str, arguments: Arguments, stroke: float) -> list[str]:
        bench, found = self._bench, []
        limit = bench.dm.limits.max_stroke
        if stroke > limit:
            found.append(f"pokes of {stroke:.2f} of the stroke are shortened to the limit of {limit:g}")
        frames = int(arguments.get("frames") or 0)
        least = least_frames(bench.config.calibration, bench.config.basis.n_modes)
        if name in ("docrime", "push-pull-fast") and frames < least:
            found.append(f"{frames} frames cannot constrain the modes; at least {least} are needed")
        if name == "push-pull" and bench.screen is None and not bench.simulated:
            found.append("push-pull needs a source: see that no turbulence is in the beam")
        if arguments.get("snr") is not None or arguments.get("accuracy") is not None:
            found.append("it may stop earlier, when the target is reached")
        return found
