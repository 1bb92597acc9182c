"""Saving the state of a running calibration, and resuming from a saved state."""

from __future__ import annotations

import hashlib
import logging
import math
import time
import tomllib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from escape_hw.api.sensor import SensorGeometry
from escape_hw.bench import Bench
from escape_hw.config.renamed import update_document
from escape_hw.config.system import SystemConfig
from escape_hw.errors import IncompatibleProduct, StorageError
from escape_hw.io.fits.run_state import RunState, load_state, save_state

log = logging.getLogger(__name__)

#: Differing configuration keys that an error message names.
_MAX_LISTED = 5
#: Key of a run's settings with the fingerprint of the matrix that closes the loop.
CLOSED_WITH = "closed with"
#: Names of keys in messages.
_NAMES = {"simulated": "mode (simulated or hardware)", CLOSED_WITH: "control matrix"}


class Checkpoint:
    """File in which a run saves its state, and the state from which it is resumed.

    Parameters
    ----------
    path
        File for the state.
    resume
        File with the state to resume from; ``None`` for a new run.
    request
        Plain values saved with the state: the request that started the run.
    """

    def __init__(
        self, path: Path, resume: Path | None = None, request: Mapping[str, Any] | None = None
    ) -> None:
        self.path, self._resume_path, self._request = path, resume, dict(request or {})
        self._next_save = self._period_s = math.inf
        self._identity: Mapping[str, Any] = {}
        self._bench: Bench | None = None
        self._is_failing = False

    def begin(
        self, bench: Bench, method: str, m2c: NDArray[np.float64], settings: Mapping[str, Any]
    ) -> RunState | None:
        """Register the run, and return the state to resume from if there is one.

        The random generator of the bench is set to its saved state.

        Parameters
        ----------
        method
            Name of the method.
        m2c
            Mode-to-command matrix ``(n_act, n_modes)``.
        settings
            Further plain values that must be the same when the run is resumed.

        Raises
        ------
        IncompatibleProduct
            The saved state is of another system, method, basis, configuration or setting; the message names
            the difference.
        ProductError
            The saved state cannot be read.
        """
        self._bench, self._period_s = bench, bench.config.calibration.checkpoint_s
        self._next_save = time.monotonic() + self._period_s
        self._identity = {
            "system": bench.config.system.name,
            "simulated": bench.simulated,
            "method": method,
            # Another processor or library changes the last digits.
            "basis": fingerprint(np.round(m2c, 6)),
            "settings": dict(settings),
            "configuration": bench.config.to_toml(),
        }
        if self._resume_path is None:
            return None
        state = load_state(self._resume_path)
        saved = dict(state.identity)
        if saved.get("basis") == fingerprint(np.round(m2c, 9)):
            # As version 0.1.0 wrote it.
            saved["basis"] = self._identity["basis"]
        require_same_run(self._resume_path, saved, self._identity)
        bench.rng.bit_generator.state = state.values["rng"]
        return state

    def is_due(self) -> bool:
        """Whether it is time to save the state; fast enough for every frame."""
        return time.monotonic() >= self._next_save

    def save(
        self, values: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]], grid: SensorGeometry | None
    ) -> None:
        """Save a state; one that cannot be written is logged, the previous one stays, and the run goes on."""
        if self._bench is None:
            raise RuntimeError("a checkpoint was saved before its run began")
        values = {**values, "request": self._request, "rng": self._bench.rng.bit_generator.state}
        state = RunState(self._identity, values, arrays, grid)
        try:
            save_state(self.path, state, self._bench.config.system.name, self._bench.simulated)
            self._is_failing = False
        except StorageError as error:
            if not self._is_failing:
                log.warning("the state of the run cannot be saved, and the run goes on: %s", error)
            self._is_failing = True
        self._next_save = time.monotonic() + self._period_s

    def remove(self) -> None:
        """Delete the state after the run has finished."""
        self.path.unlink(missing_ok=True)


def fingerprint(array: NDArray[Any]) -> str:
    """Hash of an array's values."""
    # Adding zero turns negative zeros, which compare equal, into positive ones.
    return hashlib.sha256(np.ascontiguousarray(array + 0.0).tobytes()).hexdigest()[:16]


def require_same_run(path: Path, saved: Mapping[str, Any], now: Mapping[str, Any]) -> None:
    """Check that a saved state is of the same run, as far as that is known; see :meth:`Checkpoint.begin`.

    ``now`` has the keys of the state's identity that are known: system, settings and configuration, and in
    full once the devices are open.

    Raises
    ------
    IncompatibleProduct
        It is of another run; the message names the difference.
    """
    old_settings = saved.get("settings") or {}
    pairs = [(key, saved.get(key), now[key]) for key in ("system", "simulated", "method") if key in now]
    pairs += [(key, old_settings.get(key), value) for key, value in now["settings"].items()]
    for key, before, value in pairs:
        if before != value:
            raise IncompatibleProduct(
                f"{path}: its {_NAMES.get(key, key)} is {before!r}, this run's is {value!r}; "
                "resume with the original settings, or start a new run"
            )
    changed = sorted(_changed_keys(path, str(saved.get("configuration", "")), now["configuration"]))
    if changed:
        more = f" and {len(changed) - _MAX_LISTED} more" if len(changed) > _MAX_LISTED else ""
        raise IncompatibleProduct(
            f"{path}: its configuration differs from this run's in {', '.join(changed[:_MAX_LISTED])}{more}; "
            "resume with the original configuration"
        )
    if "basis" in now and saved.get("basis") != now["basis"]:
        raise IncompatibleProduct(
            f"{path}: its modal basis is not this system's. Version 0.2.0 changed the Karhunen-Loeve modes "
            "of mirrors with many more actuators than modes: finish a run of 0.1.0 with that version, or "
            "start a new run"
        )


def _changed_keys(path: Path, saved: str, now: str) -> set[str]:
    """Keys whose values differ between the configuration of a state file and the present one (TOML text)."""
    document = tomllib.loads(saved)
    update_document(document)
    try:
        config = SystemConfig.model_validate(document)
    except ValidationError as error:
        raise IncompatibleProduct(
            f"{path}: its configuration is not valid in this version: {error}"
        ) from error
    a, b = dict(_flatten_keys(tomllib.loads(config.to_toml()))), dict(_flatten_keys(tomllib.loads(now)))
    return {key for key in a.keys() | b.keys() if a.get(key) != b.get(key)}


def _flatten_keys(table: Mapping[str, Any], path: str = "") -> Iterator[tuple[str, Any]]:
    for key, value in table.items():
        if isinstance(value, Mapping):
            yield from _flatten_keys(value, f"{path}{key}.")
        else:
            yield path + key, value
