"""``sweep.json``: a sweep and its storage, from which it is resumed or joined by another machine."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from escape_hw.api.procedure import Procedure
from escape_hw.bench import Bench
from escape_hw.config.loader import load_text
from escape_hw.config.system import SystemConfig
from escape_hw.errors import ConfigError, ProductError
from escape_hw.io.documents import dumps
from escape_hw.io.provenance import file_sha256
from escape_hw.io.storage import write_atomic
from escape_hw.runtime.procedures.model_psf import model_psf
from escape_hw.runtime.sweep.design import METRICS, Design, MatrixVariant, Sweep, current_keys
from escape_hw.runtime.sweep.search_space import DELAY_KEY, Choices, Parameter, format_value, parse_parameter
from escape_hw.runtime.sweep.study import SAMPLERS, SweepStudy, redact_password, require_storage_url

DESCRIPTION_FILE = "sweep.json"


@dataclass(frozen=True, slots=True)
class SweepDescription:
    """A sweep, URL and name of the study with its trials, and sampler (``"random"`` or ``"tpe"``).

    ``margin`` is the largest difference in the Strehl ratio that counts as equivalent.
    """

    sweep: Sweep
    storage: str
    study: str
    sampler: str
    margin: float

    def validate(self) -> SweepDescription:
        """The same description, if it is consistent.

        Raises
        ------
        ConfigError
            It is not, a varied key does not exist, or one of its limits is out of range.
        """
        sweep, design = self.sweep, self.sweep.design
        if self.sampler not in SAMPLERS:
            raise ConfigError(f"--sampler {self.sampler}: unknown; it is one of {', '.join(SAMPLERS)}")
        if sweep.metric not in METRICS:
            raise ConfigError(f"--metric {sweep.metric}: unknown; it is one of {', '.join(METRICS)}")
        if not self.margin > 0:
            raise ConfigError(f"--margin {100 * self.margin:g}: it must be positive")
        if design.trials < len(sweep.variants):
            raise ConfigError(f"--trials {design.trials}: fewer than the {len(sweep.variants)} matrices")
        require_storage_url(self.storage)
        for one in sweep.space:
            _check_limits(sweep, one)
        return self

    def settings(self) -> dict[str, Any]:
        """The settings that must agree to resume a study."""
        sweep = self.sweep
        return {
            "config": sweep.config,
            "matrices": [[one.label, one.sha256] for one in sweep.variants],
            "parameters": [one.to_text() for one in sweep.space],
            "design": asdict(sweep.design),
            "frames": sweep.frames,
            "seed": sweep.seed,
            "metric": sweep.metric,
            "sampler": self.sampler,
        }

    def open_study(self) -> SweepStudy:
        """The study.

        Raises
        ------
        ConfigError, StorageError
            See :class:`~escape_hw.runtime.sweep.study.SweepStudy`.
        """
        return SweepStudy(
            self.sweep, self.storage, self.study, self.settings(), use_tpe=self.sampler == "tpe"
        )

    def save(self, folder: Path) -> Path:
        """Write :data:`DESCRIPTION_FILE` into a folder, without the storage's password.

        Raises
        ------
        StorageError
            It cannot be written.
        """
        sweep = self.sweep
        document = {
            **self.settings(),
            "variants": [{**asdict(one), "path": str(one.path)} for one in sweep.variants],
            "psf": sweep.psf, "simulated": sweep.simulated,
            "storage": redact_password(self.storage), "study": self.study, "margin": self.margin,
        }  # fmt: skip
        path = folder / DESCRIPTION_FILE
        write_atomic(path, (dumps(document) + "\n").encode())
        return path


def describe_sweep(
    bench: Bench,
    folder: Path,
    variants: Sequence[MatrixVariant],
    space: tuple[Parameter, ...],
    design: Design,
    *,
    frames: int,
    metric: str = "peak",
    sampler: str,
    margin: float,
    storage: str | None,
    study: str = "sweep",
) -> Procedure[SweepDescription]:
    """Describe a new sweep, and save its model PSF in the folder if all loops can share one.

    See :class:`~escape_hw.runtime.sweep.design.Sweep` and :class:`SweepDescription`; by default the storage
    is an SQLite file in the folder.

    Raises
    ------
    ConfigError
        See :meth:`SweepDescription.validate`; nothing moved.
    """
    description = new_description(
        bench.config, variants, space, design, frames=frames, metric=metric, sampler=sampler, margin=margin,
        storage=storage or f"sqlite:///{folder / 'study.db'}", study=study, simulated=bool(bench.simulated),
    )  # fmt: skip
    if any("." in one.key for one in space):
        return description
    path = folder / "model_psf.npy"
    if not path.is_file():
        np.save(path, (yield from model_psf(bench)))
    return replace(description, sweep=replace(description.sweep, psf=str(path)))


def new_description(
    config: SystemConfig,
    variants: Sequence[MatrixVariant],
    space: tuple[Parameter, ...],
    design: Design,
    *,
    frames: int,
    metric: str,
    sampler: str,
    margin: float,
    storage: str,
    study: str,
    simulated: bool,
) -> SweepDescription:
    """As :func:`describe_sweep`, without a model PSF; opens nothing."""
    sweep = Sweep(
        config.to_toml(), tuple(variants), space, design, frames, config.system.seed, metric,
        simulated=simulated,
    )  # fmt: skip
    return SweepDescription(sweep, storage, study, sampler, margin).validate()


def _check_limits(sweep: Sweep, parameter: Parameter) -> None:
    """Check a list, or both ends of a range, against the configuration's limits, before anything opens."""
    limits = parameter.values if isinstance(parameter, Choices) else (parameter.low, parameter.high)
    for value in limits:
        if parameter.key == DELAY_KEY:
            if isinstance(value, bool) or not isinstance(value, int | float) or not value >= 0:
                raise ConfigError(f"{DELAY_KEY}: {value} must be a number of frames that is not negative")
            continue
        path = parameter.key if "." in parameter.key else f"loop.{parameter.key}"
        load_text(sweep.config, "sweep", overrides=[f"{path}={format_value(value)}"])


def read_description(folder: Path, storage: str | None = None) -> SweepDescription:
    """Read the description of a sweep; ``storage`` replaces the stored URL, which lacks its password.

    Raises
    ------
    ConfigError
        The storage has a password, and no URL is given.
    ProductError
        The description is missing or damaged, or a matrix is missing or has changed.
    """
    path = folder / DESCRIPTION_FILE
    try:
        document = current_keys(json.loads(path.read_text(encoding="utf-8")))
        variants = tuple(
            replace(MatrixVariant(**one), path=Path(one["path"])) for one in document["variants"]
        )
        sweep = Sweep(
            document["config"], variants, tuple(map(parse_parameter, document["parameters"])),
            Design(**document["design"]), document["frames"], document["seed"], document["metric"],
            document["psf"], document["simulated"],
        )  # fmt: skip
        url = document["storage"] if storage is None else storage
        found = SweepDescription(sweep, url, document["study"], document["sampler"], document["margin"])
    except OSError as error:
        raise ProductError(
            f"{path}: cannot be read ({error.strerror or error}); is {folder} a sweep?"
        ) from error
    except (ValueError, KeyError, TypeError) as error:
        raise ProductError(f"{path}: damaged ({error})") from error
    if ":***@" in found.storage:
        raise ConfigError(f"{path}: passwords are not stored; give the whole URL again with --storage")
    for one in variants:
        if not one.path.is_file():
            raise ProductError(f"{one.path}: missing; the sweep compares this matrix")
        if file_sha256(one.path) != one.sha256:
            raise ProductError(f"{one.path}: changed since the sweep began")
    return found
