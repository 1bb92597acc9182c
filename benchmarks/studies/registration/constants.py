"""Effect of every constant that enters a prior or a stated error of SPRINT, halved and doubled.

    python benchmarks/studies/registration/constants.py --system razor-shwfs --frames 1000 --first 10000 --out docs/studies/constants
    python benchmarks/studies/registration/constants.py --system razor-pywfs --frames 1500 --first 10000 --out docs/studies/constants

Each realisation, as in ``registration_errors.py``, is measured once with DO-CRIME. Its matrix is then fitted
with the constants as they are, and again with one of them halved or doubled. Writes
``SYSTEM-constants.jsonl``, a line per realisation, and prints for every constant and factor the rms and the
largest change of the five parameters in their standard errors, the median ratio of the standard errors, and
how many fits converged. Nothing is chosen by this table.
"""  # noqa: E501

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from escape_benchmarks.realisation_tables import Line, each_realisation, realisation_numbers, study_parser
from escape_hw.api.results import RegistrationEstimate
from escape_hw.calibration.docrime.open_loop import docrime_run
from escape_hw.calibration.sprint.fit import sprint, sprint_options_from_config
from escape_hw.calibration.sprint.telemetry_fit import decorrelate_columns
from escape_hw.config.loader import load_text
from escape_hw.config.registry import model_factory
from escape_hw.config.system import SystemConfig
from escape_hw.io.provenance import get_git_state
from escape_hw.paper.sky_time import realisation_config
from escape_hw.runtime.session.system import System

FACTORS = (0.5, 2.0)
#: Keys of the configuration, by kind of sensor: prior scatter with which a fit begins, all but that of the
#: common width then being estimated from the data, and uncertainties of the sensor.
PRIORS = ("actuator_gain", "actuator_width", "actuator_position", "slope_gain", "sampling", "width")
SENSOR_KEYS = {
    "shack-hartmann": ("motion_sigma",),
    "pyramid": ("turbulence_sigma", "ellipticity_sigma", "image_position_sigma_px", "gain_trend"),
}
_SHAPE = "escape_hw.calibration.sprint.influence_shape"
_EFFECTS = "escape_hw.calibration.sprint.mixed_effects"
_ERRORS, _WEIGHTS = "escape_hw.calibration.sprint.covariance", "escape_hw.calibration.sprint.weighted_matrix"
_LENSLETS, _PYRAMID = "escape_sim.models.shack_hartmann", "escape_sim.models.pyramid"
_TURBULENCE = "escape_sim.models.pyramid_turbulence"
#: Constants by kind of sensor: module and name.
CONSTANTS = {
    "any": (
        (_SHAPE, "_PROFILE_SIGMA"), (_SHAPE, "_FOURFOLD_SIGMA"), (_SHAPE, "_EDGE_GAIN_SIGMA"),
        (_SHAPE, "_EDGE_WIDTH_SIGMA"), (_SHAPE, "_EDGE_PROFILE_SIGMA"), (_SHAPE, "_EDGE_ASYMMETRY_SIGMA"),
        (_EFFECTS, "_PSEUDO_COUNT"), (_EFFECTS, "_MIN_PRIOR_RATIO"), (_EFFECTS, "_MAX_PRIOR_RATIO"),
        (_EFFECTS, "_MEAN_STIFFNESS"), (_WEIGHTS, "_HUBER_THRESHOLD"), (_ERRORS, "_MIN_LEVEL"),
        (_ERRORS, "_N_GROUPS"), (_ERRORS, "_N_RINGS"), (_ERRORS, "_WINDOW"),
    ),
    "shack-hartmann": ((_LENSLETS, "_TILT_VARIANCE"), (_LENSLETS, "_OUTER_SCALE")),
    "pyramid": (
        (_PYRAMID, "_OUTER_SCALE"), (_PYRAMID, "_MIN_SLOPE_WEIGHT"), (_PYRAMID, "_MIN_RELATIVE_FLUX"),
        (_TURBULENCE, "_MIN_SHARE"),
    ),
}  # fmt: skip


@contextmanager
def scaled(module: str, name: str, factor: float) -> Iterator[None]:
    """A constant of a module, multiplied by a factor for the time being."""
    owner = importlib.import_module(module)
    value = getattr(owner, name)
    setattr(owner, name, type(value)(value * factor))
    try:
        yield
    finally:
        setattr(owner, name, value)


def with_key(config: SystemConfig, key: str, factor: float) -> SystemConfig:
    """The configuration with one of its numbers multiplied by a factor."""
    section, name = key.rsplit(".", 1)
    value: Any = config
    for part in section.split("."):
        value = getattr(value, part)
    return load_text(
        config.to_toml(), config.system.name, overrides=[f"{key}={factor * getattr(value, name)!r}"],
        seed=config.system.seed, mode="sim",
    )  # fmt: skip


def run_realisation(system: str, number: int, frames: int) -> Line:
    """Fits of one measurement with all constants as they are, and with each of them scaled."""
    injected, config = realisation_config(system, number)
    with System.from_config(config) as bench:
        run = bench.run(docrime_run(bench, frames=frames))
        solution, grid = run.solution, run.result.grid
        matrix = decorrelate_columns(run.result.matrix, solution.gram, solution.variance)

        def fit(settings: SystemConfig = config) -> RegistrationEstimate:
            model = model_factory(settings.calibration.model)(settings, grid)
            options = sprint_options_from_config(settings.calibration)
            return sprint(matrix, model, covariance=solution.covariance, **options)

        row: Line = {"commit": get_git_state(), "seed": config.system.seed, "fits": {}}
        row["base"] = _numbers(fit(), injected.to_array())
        keys = [f"calibration.priors.{name}" for name in PRIORS]
        keys += [f"sensor.{name}" for name in SENSOR_KEYS[config.sensor.kind]]
        for factor in FACTORS:
            for key in keys:
                changed = fit(with_key(config, key, factor))
                row["fits"][f"{key} x {factor:g}"] = _numbers(changed, injected.to_array())
            for module, name in CONSTANTS["any"] + CONSTANTS[config.sensor.kind]:
                with scaled(module, name, factor):
                    changed = fit()
                label = f"{module.rpartition('.')[2]}.{name} x {factor:g}"
                row["fits"][label] = _numbers(changed, injected.to_array())
    return row


def _numbers(estimate: RegistrationEstimate, injected: Any) -> Line:
    return {
        "error": (estimate.registration.to_array() - injected).tolist(), "sigma": estimate.sigma.tolist(),
        "converged": estimate.converged,
    }  # fmt: skip


def print_table(rows: list[Line]) -> None:
    """A Markdown table of the changes."""
    print("| constant | rms change [sigma] | largest | ratio of errors | converged |")
    print("|---|---:|---:|---:|---:|")
    base = np.array([(row["base"]["error"], row["base"]["sigma"]) for row in rows])
    for label in sorted(rows[0]["fits"]):
        fits = [row["fits"][label] for row in rows]
        here = np.array([(one["error"], one["sigma"]) for one in fits])
        change = (here[:, 0] - base[:, 0]) / base[:, 1]
        ratio = np.median(here[:, 1] / base[:, 1])
        print(
            f"| `{label.replace(' x ', '` × ')} | {np.sqrt(np.mean(change**2)):.2f} "
            f"| {np.abs(change).max():.2f} | {ratio:.2f} | {sum(one['converged'] for one in fits)} |"
        )


def fit_realisations(
    description: str | None, realisations: int, name: str, fit: Callable[[str, int, int], Line]
) -> list[Line]:
    """The lines of the realisations that the command line asks for.

    Parameters
    ----------
    description
        Text of ``--help``.
    realisations
        How many, unless the command line says.
    name
        Name of the raw table behind that of the system.
    fit
        Returns the line of a system, the number of a realisation, and frames.
    """
    parser = study_parser(description, "razor-shwfs", realisations)
    parser.add_argument("--frames", type=int, default=1000)
    options = parser.parse_args()
    return each_realisation(
        options.out / f"{options.system}{name}.jsonl",
        {"system": options.system, "frames": options.frames},
        realisation_numbers(options),
        lambda number: fit(options.system, number, options.frames),
    )


def main() -> None:
    """Fit what is missing, and print the table."""
    print_table(fit_realisations(__doc__, 6, "-constants", run_realisation))


if __name__ == "__main__":
    main()
