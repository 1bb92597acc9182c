"""How a sweep is asked for: what may be varied where, and the sweep as one call. Loads without Optuna."""

from __future__ import annotations

import importlib.util
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from escape_hw.errors import ConfigError
from escape_hw.runtime.sweep.space import DELAY, LOOP_KEYS, Parameter, default_space, parse_parameter

if TYPE_CHECKING:
    from escape_hw.config.models import SystemConfig
    from escape_hw.runtime.calibrated import Calibrated
    from escape_hw.runtime.loop_bench import LoopBench
    from escape_hw.runtime.sweep.kept import KeptSweep
    from escape_hw.runtime.sweep.result import SweepResult

#: Parts of the configuration that the matrices were measured with.
_FIXED = ("system", "sensor", "basis", "devices", "schema")


def need_optuna() -> None:
    """Say what is missing.

    Raises
    ------
    ConfigError
        Optuna or scikit-learn is not installed.
    """
    missing = [name for name in ("optuna", "sklearn") if importlib.util.find_spec(name) is None]
    if missing:
        raise ConfigError(
            "a sweep needs Optuna and scikit-learn, which are not installed: "
            "pip install 'escape-hw[sweep]' (in a clone: .venv/bin/pip install --editable '.[sweep]')"
        )


def swept_space(config: SystemConfig, texts: Sequence[str]) -> tuple[Parameter, ...]:
    """What is varied; on hardware everything within limits that a person has set.

    Parameters
    ----------
    config
        Of the system.
    texts
        See :func:`~escape_hw.runtime.sweep.space.parse_parameter`.

    Raises
    ------
    ConfigError
        A text cannot be read, a key cannot be varied, or hardware lacks limits.
    """
    given = [parse_parameter(text) for text in texts]
    for one in given:
        if "." not in one.key and one.key not in (*LOOP_KEYS, DELAY):
            known = ", ".join((*LOOP_KEYS, DELAY))
            raise ConfigError(
                f"--vary {one.key}: it is one of {known}, or a key of the configuration with its section"
            )
        if one.key.partition(".")[0] in _FIXED:
            raise ConfigError(
                f"--vary {one.key}: the matrices were measured with one; make them anew and compare sweeps"
            )
        if not config.simulated and one.key not in LOOP_KEYS:
            raise ConfigError(f"--vary {one.key}: on hardware only {', '.join(LOOP_KEYS)} can be varied")
    missing = [key for key in LOOP_KEYS if key not in {one.key for one in given}]
    if not config.simulated and missing:
        raise ConfigError(
            f"on hardware a person sets the limits of every parameter; missing: {', '.join(missing)} "
            "(--gain, --leak, --drop LOW:HIGH, or one value that stays)"
        )
    return default_space(config.basis.n_modes, given)


def require_loop_frames(config: SystemConfig, frames: int) -> None:
    """Refuse loops too short for the Strehl ratios that a sweep judges them by.

    Raises
    ------
    ConfigError
        Says how many frames are needed; or there is no science camera.
    """
    from escape_hw.calibration.loop_run import CLOSING_S, frames_for_strehl

    science = config.devices.science
    if science is None:
        raise ConfigError(f"'{config.system.name}' has no science camera to judge the loops of a sweep by")
    least = frames_for_strehl(config.devices.wfs.frame_rate_hz, science.frame_rate_hz)
    if frames < least:
        raise ConfigError(
            f"--frames {frames}: too short for Strehl ratios with errors; a loop closes in {CLOSING_S:g} s, "
            f"and then the science camera has to take some frames at {science.frame_rate_hz:g} Hz; "
            f"the least is --frames {least}"
        )


def sweep_of(
    bench: LoopBench,
    matrices: Mapping[str, Calibrated],
    folder: Path,
    vary: Sequence[str],
    asked: Mapping[str, Any],
    *,
    workers: int,
    scheduler: str | None,
    progress: bool,
) -> SweepResult:
    """A sweep with matrices in memory; see :meth:`~escape_hw.runtime.system.System.sweep`."""
    need_optuna()
    space = swept_space(bench.config, vary)
    require_loop_frames(bench.config, asked["frames"])
    from escape_hw.runtime.sweep.kept import KEPT, read_kept
    from escape_hw.runtime.sweep.result import conclude
    from escape_hw.runtime.sweep.run import run_sweep
    from escape_hw.runtime.sweep.workers import DaskWorkers, LocalWorkers

    made = _begin(bench, matrices, folder, space, asked, progress)
    if (folder / KEPT).is_file() and read_kept(folder).settings() == made.settings():
        made = read_kept(folder)
    made.keep(folder)
    if not made.sweep.simulated:
        return conclude(made.sweep, bench.run(run_sweep(made.sweep, made.store(), bench), progress=progress))
    pool = LocalWorkers(workers) if scheduler is None else DaskWorkers(scheduler)
    try:
        found = bench.run(run_sweep(made.sweep, made.store(), pool), progress=progress)
    finally:
        pool.close()
    return conclude(made.sweep, found, made.margin)


def _begin(
    bench: LoopBench,
    matrices: Mapping[str, Calibrated],
    folder: Path,
    space: tuple[Parameter, ...],
    asked: Mapping[str, Any],
    progress: bool,
) -> KeptSweep:
    import numpy as np

    from escape_hw.io.fits import load_matrix, save_matrix
    from escape_hw.io.storage import make_folder
    from escape_hw.runtime.calibrated import calibration_of
    from escape_hw.runtime.keep import key_of
    from escape_hw.runtime.sweep.kept import KeptSweep
    from escape_hw.runtime.sweep.plan import Arm, Design
    from escape_hw.runtime.sweep.run import Sweep

    folder = folder.absolute()
    make_folder(folder)
    arms = []
    for label, given in matrices.items():
        calibration = calibration_of(given)
        path = folder / f"{key_of(label)}.fits"
        # A file that holds this very matrix stays: its checksum says whether a study goes on.
        kept = load_matrix(path) if path.is_file() else None
        if kept is None or not np.array_equal(kept.matrix.data, calibration.matrix.data):
            kept = load_matrix(save_matrix(path, calibration))
        arms.append(Arm(label, False, path, kept.sha256))
    psf = None
    if all("." not in one.key for one in space):
        psf = folder / "model_psf.npy"
        if not psf.is_file():
            np.save(psf, bench.take_model_psf(progress=progress))
    sweep = Sweep(
        bench.config.to_toml(), tuple(arms), space, Design(trials=asked["trials"]), asked["frames"],
        bench.config.system.seed, "peak", None if psf is None else str(psf), bench.simulated,
    )  # fmt: skip
    storage = asked["storage"] or f"sqlite:///{folder / 'study.db'}"
    return KeptSweep(sweep, storage, "sweep", asked["sampler"], asked["margin"]).checked()
