"""Checks of a requested sweep, and a sweep of matrices in memory. Loads without Optuna."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from escape_hw.errors import ConfigError
from escape_hw.runtime.sweep.search_space import (
    DELAY_KEY,
    LOOP_KEYS,
    Parameter,
    default_space,
    parse_parameter,
)

if TYPE_CHECKING:
    from escape_hw.bench import Bench
    from escape_hw.config.system import SystemConfig
    from escape_hw.runtime.session.calibration_input import CalibrationLike
    from escape_hw.runtime.sweep.design import MatrixVariant
    from escape_hw.runtime.sweep.result import SweepResult

#: Sections of the configuration that the matrices were measured with.
_FIXED_SECTIONS = ("system", "sensor", "basis", "devices", "schema")


def require_optuna() -> None:
    """Check that the optional packages of a sweep are installed.

    Raises
    ------
    ConfigError
        Optuna or scikit-learn is not installed.
    """
    if any(importlib.util.find_spec(name) is None for name in ("optuna", "sklearn")):
        raise ConfigError(
            "a sweep needs Optuna and scikit-learn, which are not installed: "
            "pip install 'escape-hw[sweep]' (in a clone: .venv/bin/pip install --editable '.[sweep]')"
        )


def parse_search_space(config: SystemConfig, texts: Sequence[str]) -> tuple[Parameter, ...]:
    """The search space; on hardware, only the loop's parameters within given limits.

    For the texts see :func:`~escape_hw.runtime.sweep.search_space.parse_parameter`.

    Raises
    ------
    ConfigError
        A text cannot be read, a key cannot be varied, or hardware lacks limits.
    """
    given = [parse_parameter(text) for text in texts]
    for one in given:
        if "." not in one.key and one.key not in (*LOOP_KEYS, DELAY_KEY):
            known = ", ".join((*LOOP_KEYS, DELAY_KEY))
            raise ConfigError(
                f"--vary {one.key}: it is one of {known}, or a key of the configuration with its section"
            )
        if one.key.partition(".")[0] in _FIXED_SECTIONS:
            raise ConfigError(
                f"--vary {one.key}: the matrices were measured with one value; run a sweep for each value "
                "and compare them"
            )
        if not config.simulated and one.key not in LOOP_KEYS:
            raise ConfigError(f"--vary {one.key}: on hardware only {', '.join(LOOP_KEYS)} can be varied")
    missing = [key for key in LOOP_KEYS if key not in {one.key for one in given}]
    if not config.simulated and missing:
        raise ConfigError(
            f"on hardware the limits of every parameter must be given; missing: {', '.join(missing)} "
            "(--gain, --leak, --dropped-modes LOW:HIGH, or one value that stays)"
        )
    return default_space(config.basis.n_modes, given)


def require_loop_frames(config: SystemConfig, frames: int) -> None:
    """Refuse loops too short for Strehl ratios with errors.

    Raises
    ------
    ConfigError
        Too few frames, with the least number; or there is no science camera.
    """
    from escape_hw.calibration.loop.runner import SETTLING_S, minimum_strehl_frames

    science = config.devices.science
    if science is None:
        raise ConfigError(f"'{config.system.name}' has no science camera; a sweep maximises the Strehl ratio")
    least = minimum_strehl_frames(config.devices.wfs.frame_rate_hz, science.frame_rate_hz)
    if frames < least:
        raise ConfigError(
            f"--frames {frames}: too short for Strehl ratios with errors; a loop closes in {SETTLING_S:g} s, "
            f"and then the science camera has to take some frames at {science.frame_rate_hz:g} Hz; "
            f"the least is --frames {least}"
        )


def run_matrix_sweep(
    bench: Bench,
    run: Callable[..., Any],
    matrices: Mapping[str, CalibrationLike],
    folder: Path,
    vary: Sequence[str],
    request: Mapping[str, Any],
    *,
    workers: int,
    scheduler: str | None,
    progress: bool,
) -> SweepResult:
    """A sweep with matrices in memory; see :meth:`~escape_hw.runtime.session.system.System.sweep`."""
    require_optuna()
    space = parse_search_space(bench.config, vary)
    require_loop_frames(bench.config, request["frames"])
    from escape_hw.runtime.sweep.description import DESCRIPTION_FILE, describe_sweep, read_description
    from escape_hw.runtime.sweep.design import Design
    from escape_hw.runtime.sweep.result import sweep_and_analyse
    from escape_hw.runtime.sweep.workers import open_workers

    folder = folder.absolute()
    options = dict(request)
    variants, design = _save_matrices(matrices, folder), Design(trials=options.pop("trials"))
    description = run(describe_sweep(bench, folder, variants, space, design, **options), progress=progress)
    if (folder / DESCRIPTION_FILE).is_file():
        known = read_description(folder)
        description = known if known.settings() == description.settings() else description
    description.save(folder)
    runner = open_workers(workers, scheduler) if description.sweep.simulated else bench
    result: SweepResult = run(sweep_and_analyse(description, runner), progress=progress)
    return result


def _save_matrices(matrices: Mapping[str, CalibrationLike], folder: Path) -> list[MatrixVariant]:
    """Save matrices in memory as the variants of a sweep."""
    import numpy as np

    from escape_hw.io.fits.matrix import load_matrix, save_matrix
    from escape_hw.io.storage import make_folder
    from escape_hw.runtime.procedures.products import product_key
    from escape_hw.runtime.session.calibration_input import as_calibration
    from escape_hw.runtime.sweep.design import MatrixVariant

    make_folder(folder)
    variants = []
    for label, given in matrices.items():
        calibration = as_calibration(given)
        path = folder / f"{product_key(label)}.fits"
        # A file with this matrix is kept: a study is resumed only if the checksums agree.
        existing = load_matrix(path) if path.is_file() else None
        if existing is None or not np.array_equal(existing.matrix.data, calibration.matrix.data):
            existing = load_matrix(save_matrix(path, calibration))
        variants.append(MatrixVariant(label, False, path, existing.sha256))
    return variants
