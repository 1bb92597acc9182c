"""Procedures as an operator asks for them: by method, with the light each of them needs."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.procedure import Procedure
from escape_hw.api.results import CalibrationResult
from escape_hw.api.sensor import SensorGeometry
from escape_hw.bench import Bench
from escape_hw.errors import ConfigError
from escape_hw.runtime.records import without_turbulence

if TYPE_CHECKING:
    from escape_hw.calibration.checkpoint import Checkpoint
    from escape_hw.calibration.stopping import Target

#: The calibration methods, by the names that the command line knows as well.
METHODS = ("push-pull", "push-pull-fast", "modulated", "docrime", "escape")
#: Those that work in closed loop as well.
CLOSED_LOOP = ("push-pull-fast", "docrime", "escape")


def calibrate_by(
    bench: Bench,
    method: str = "escape",
    *,
    frames: int | None = None,
    poke: float | None = None,
    grid: SensorGeometry | None = None,
    whiten: bool = True,
    estimator: str | None = None,
    closing: CalibrationResult | None = None,
    until: Target | None = None,
    keep: Checkpoint | None = None,
) -> Procedure[CalibrationResult]:
    """A calibration by the name of its method.

    Slow push-pull needs a source: the phase screen, where the bench moves one, is out of the beam
    meanwhile. The others take the light as it is.

    Parameters
    ----------
    bench
        An open bench.
    method
        One of :data:`METHODS`.
    frames
        Frames to measure with (push-pull: per push and per pull); as configured by default.
    poke
        Rms surface as fraction of full stroke; as configured by default.
    grid
        The sensor's grid, when it is known already.
    whiten
        False: the paper's plain estimator of ``docrime`` and ``escape``.
    estimator
        What ``escape`` fits: ``"matrix"``, ``"telemetry"`` or ``"auto"``; as configured by default.
    closing
        Measure in closed loop, with this calibration's matrix; the methods of :data:`CLOSED_LOOP`.
    until
        Stop when this is reached.
    keep
        Where the state is kept meanwhile, and what to go on with.

    Raises
    ------
    ConfigError
        No such method, or options that do not go together; nothing moved.
    TooFewFrames, CalibrationError, Aborted
        See :func:`~escape_hw.calibration.push_pull.push_pull`,
        :func:`~escape_hw.calibration.docrime.docrime`, :func:`~escape_hw.calibration.escape.escape`.
    """
    # Imported when used: these bring compilers along, and a bench opens without them.
    if method not in METHODS:
        raise ConfigError(f"calibration method '{method}' is unknown; it is one of {', '.join(METHODS)}")
    if closing is not None and method not in CLOSED_LOOP:
        raise ConfigError(f"'{method}' is for open loop; in closed loop: {', '.join(CLOSED_LOOP)}")
    if closing is not None and not whiten:
        raise ConfigError("the plain estimator is for open loop; in closed loop turbulence is whitened")
    common: dict[str, Any] = {"frames": frames, "poke": poke, "until": until, "keep": keep}
    if method == "push-pull":
        from escape_hw.calibration.push_pull import push_pull

        with without_turbulence(bench):
            return (yield from push_pull(bench, grid=grid, **common))
    if method == "modulated":
        from escape_hw.calibration.modulated import modulated

        return (yield from modulated(bench, grid=grid, **common))
    if method == "escape":
        from escape_hw.calibration.escape import escape

        return (
            yield from escape(bench, grid=grid, whiten=whiten, estimator=estimator, closing=closing, **common)
        )
    if method == "push-pull-fast":
        from escape_hw.calibration.poke_patterns import PushPullPokes

        common["pattern"] = PushPullPokes
        common["poke"] = bench.config.calibration.push_pull_poke if poke is None else poke
    if closing is not None:
        from escape_hw.calibration.docrime_closed import docrime_closed_loop

        return (yield from docrime_closed_loop(bench, closing, **common))
    from escape_hw.calibration.docrime import docrime

    return (yield from docrime(bench, grid=grid, whiten=whiten, **common))


def model_psf(bench: Bench, *, frames: int = 20) -> Procedure[NDArray[np.float32]]:
    """The PSF to measure Strehl ratios against, with the turbulence out of the beam meanwhile.

    Parameters
    ----------
    bench
        An open bench with a science camera.
    frames
        Science frames to average.

    Raises
    ------
    CalibrationError
        The system has no science camera.
    """
    from escape_hw.calibration.model_psf import measure_model_psf

    with without_turbulence(bench):
        return (yield from measure_model_psf(bench, frames=frames))
