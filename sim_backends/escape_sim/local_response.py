"""The twin's own response around frozen wavefronts: the truth that optical gains are judged by.

For tests and benchmarks alone; nothing that calibrates may read it.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.pyramid import PyramidPupils
from escape_hw.bench import Bench
from escape_hw.pipeline.pyramid_slopes import slopes_of_image
from escape_sim.sim_bench import SimBench

#: Poke of the push-pull in metres of optical path, rms: far below what bends the response.
_POKE_M = 2e-9


def twin_behind(bench: Bench) -> SimBench:
    """The simulated bench behind a system's twins.

    Raises
    ------
    TypeError
        Its mirror is no twin.
    """
    twin = getattr(bench.dm, "twin", None)
    if not isinstance(twin, SimBench):
        raise TypeError(f"{bench.dm.name} is no twin; only a twin's truth can be looked at")
    return twin


class FrozenWavefronts:
    """Keeps the wavefront in front of the sensor now and then while something runs.

    Parameters
    ----------
    twin
        The simulated bench; this object adds itself to its onlookers.
    every
        Frames from one wavefront kept to the next.
    """

    def __init__(self, twin: SimBench, every: int) -> None:
        self.kept: list[NDArray[np.float32]] = []
        self._twin, self._every, self._seen, self.keeping = twin, every, 0, True
        twin.onlookers.append(self)

    def __call__(self, opd: NDArray[np.float32], time_s: float) -> None:
        """Take the optical path ``(n, n)`` in metres of a frame."""
        self._seen += 1
        if self.keeping and self._seen % self._every == 0:
            self.kept.append(self._twin.sensor_path(opd, time_s))

    def close(self) -> None:
        """Look no longer."""
        self._twin.onlookers.remove(self)


def local_gains(
    twin: SimBench,
    pupils: PyramidPupils,
    m2c: NDArray[np.float64],
    rows: NDArray[np.float64],
    wavefronts: Sequence[NDArray[np.float32]],
    modes: Sequence[int] | None = None,
) -> NDArray[np.float64]:
    """Optical gains by push-pull around frozen wavefronts, without noise.

    Parameters
    ----------
    twin
        Its optics and its true mirror answer.
    pupils
        Where the pipeline takes the slopes.
    m2c
        Modes ``(n_act, n_modes)``.
    rows
        Take slopes to gains ``(n_modes, n_slopes)``
        (:func:`~escape_hw.calibration.optical_gain.projector`).
    wavefronts
        Optical paths ``(n, n)`` in metres in front of the sensor.
    modes
        Which modes; all by default.

    Returns
    -------
    ndarray, ``(n_wavefronts, n_modes)``
        NaN for modes not asked for.
    """
    chosen = range(m2c.shape[1]) if modes is None else modes
    stroke = twin.config.devices.dm.stroke_m
    size = _POKE_M / (2 * stroke)
    found = np.full((len(wavefronts), m2c.shape[1]), np.nan)
    sensor = twin.sensor()
    for mode in chosen:
        shape = twin.mirror_path(m2c[:, mode] * size)
        for k, wavefront in enumerate(wavefronts):
            up = slopes_of_image(sensor.frame(wavefront + shape), pupils)
            down = slopes_of_image(sensor.frame(wavefront - shape), pupils)
            found[k, mode] = rows[mode] @ (up - down) / (2 * size)
    return found
