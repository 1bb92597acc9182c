"""What a sweep's folder says of it, so that it can be resumed, or joined by another machine."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from escape_hw.config.loader import load_text
from escape_hw.errors import ConfigError, ProductError
from escape_hw.io.documents import dumps
from escape_hw.io.provenance import file_sha256
from escape_hw.io.storage import write_atomic
from escape_hw.runtime.sweep.design import Design, MatrixVariant
from escape_hw.runtime.sweep.run import METRICS, Sweep
from escape_hw.runtime.sweep.search_space import parse_parameter
from escape_hw.runtime.sweep.study import SAMPLERS, STORAGE_TIMEOUT_S, SweepStore, redact_password

DESCRIPTION_FILE = "sweep.json"


@dataclass(frozen=True, slots=True)
class SweepDescription:
    """A sweep and where its trials are kept.

    Parameters
    ----------
    sweep
        What is swept.
    storage, study
        URL and name of the study.
    sampler
        ``"random"`` or ``"tpe"``.
    margin
        Difference in the Strehl ratio that does not matter.
    """

    sweep: Sweep
    storage: str
    study: str
    sampler: str
    margin: float

    def validate(self) -> SweepDescription:
        """The same, if its parts go together.

        Raises
        ------
        ConfigError
            They do not, a varied key does not exist, or one of its limits is out of range.
        """
        sweep, design = self.sweep, self.sweep.design
        if self.sampler not in SAMPLERS:
            raise ConfigError(f"--sampler {self.sampler}: unknown; it is one of {', '.join(SAMPLERS)}")
        if sweep.metric not in METRICS:
            raise ConfigError(f"--metric {sweep.metric}: unknown; it is one of {', '.join(METRICS)}")
        if not self.margin > 0:
            raise ConfigError(f"--margin {100 * self.margin:g}: it must be positive")
        if design.trials < len(sweep.arms):
            raise ConfigError(f"--trials {design.trials}: fewer than the {len(sweep.arms)} matrices")
        for one in sweep.space:
            _check_limits(sweep, one.key, (one.at(0.0), one.at(1.0)))
        return self

    def settings(self) -> dict[str, Any]:
        """What must be the same for a study to be gone on with."""
        sweep = self.sweep
        return {
            "config": sweep.config,
            "matrices": [[arm.label, arm.sha256] for arm in sweep.arms],
            "parameters": [one.to_text() for one in sweep.space],
            "design": asdict(sweep.design),
            "frames": sweep.frames,
            "seed": sweep.seed,
            "metric": sweep.metric,
            "sampler": self.sampler,
        }

    def store(self, timeout_s: float = STORAGE_TIMEOUT_S) -> SweepStore:
        """The study.

        Raises
        ------
        ConfigError, StorageError
            See :class:`~escape_hw.runtime.sweep.study.SweepStore`.
        """
        sweep = self.sweep
        return SweepStore(
            self.storage, self.study, self.settings(), sweep.arms, sweep.space, sweep.seed,
            use_tpe=self.sampler == "tpe", timeout_s=timeout_s,
        )  # fmt: skip

    def save(self, folder: Path) -> Path:
        """Write it into a folder.

        Raises
        ------
        StorageError
            It cannot be written.
        """
        sweep = self.sweep
        arms = [{**asdict(arm), "path": str(arm.path)} for arm in sweep.arms]
        document = {
            **self.settings(), "arms": arms, "psf": sweep.psf, "simulated": sweep.simulated,
            "storage": redact_password(self.storage), "study": self.study, "margin": self.margin,
        }  # fmt: skip
        path = folder / DESCRIPTION_FILE
        write_atomic(path, (dumps(document) + "\n").encode())
        return path


def _check_limits(sweep: Sweep, key: str, limits: tuple[Any, Any]) -> None:
    """Refuse a range before anything opens; the configuration knows what is allowed."""
    if key == "delay":
        if limits[0] < 0:
            raise ConfigError(f"{key}: {limits[0]:g}  must not be negative")
        return
    path = key if "." in key else f"loop.{key}"
    for value in limits:
        text = str(value).lower() if isinstance(value, bool) else value
        load_text(sweep.config, "sweep", overrides=[f"{path}={text}"])


def read_description(folder: Path, storage: str | None = None) -> SweepDescription:
    """Read what :meth:`SweepDescription.keep` wrote.

    Parameters
    ----------
    folder
        Of the sweep.
    storage
        URL of the study, where the kept one will not do: passwords are never written.

    Raises
    ------
    ConfigError
        The storage has a password, and no URL is given.
    ProductError
        It is not there or damaged, or a matrix has gone or is another.
    """
    path = folder / DESCRIPTION_FILE
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
        found = _from_document(document)
    except OSError as error:
        raise ProductError(f"{path}: cannot be read ({error.strerror}); is {folder} a sweep?") from error
    except (ValueError, KeyError, TypeError) as error:
        raise ProductError(f"{path}: damaged ({error})") from error
    found = found if storage is None else replace(found, storage=storage)
    if ":***@" in found.storage:
        raise ConfigError(f"{path}: passwords are not kept; give the whole URL again with --storage")
    for arm in found.sweep.arms:
        if not arm.path.is_file():
            raise ProductError(f"{arm.path}: not there; the sweep compares this matrix")
        if file_sha256(arm.path) != arm.sha256:
            raise ProductError(f"{arm.path}: it is not the file any more that the sweep began with")
    return found


def _from_document(document: Mapping[str, Any]) -> SweepDescription:
    arms = tuple(replace(MatrixVariant(**one), path=Path(one["path"])) for one in document["arms"])
    sweep = Sweep(
        document["config"], arms, tuple(parse_parameter(text) for text in document["parameters"]),
        Design(**document["design"]), document["frames"], document["seed"], document["metric"],
        document["psf"], document["simulated"],
    )  # fmt: skip
    return SweepDescription(
        sweep, document["storage"], document["study"], document["sampler"], document["margin"]
    )
