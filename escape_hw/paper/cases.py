"""The paper's results as cases: on which system, how, and what is kept of each."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from escape_hw.api.procedure import Procedure
from escape_hw.bench import Bench
from escape_hw.config.system import SystemConfig
from escape_hw.errors import ConfigError
from escape_hw.io.run_folder import read_result
from escape_hw.paper.experiments import (
    PAPER_REGISTRATION,
    reproduce_maps,
    reproduce_pywfs,
    reproduce_shwfs,
    reproduce_table1,
)
from escape_hw.paper.products import save_maps, save_pywfs, save_shwfs, save_table1

#: Keyword of the frames that a loop is closed for.
_LOOP_FRAMES = "loop_frames"


@dataclass(frozen=True, slots=True)
class PaperCase:
    """One of the paper's results.

    Parameters
    ----------
    kind
        Name, as the command line knows it.
    title
        What it shows.
    system
        System it runs on.
    frames
        Numbers of frames by the procedure's keyword.
    procedure
        Takes an open bench and the frames.
    keep
        Saves, judges and reports the result.
    overrides
        Of the system's configuration.
    """

    kind: str
    title: str
    system: str
    frames: dict[str, int]
    procedure: Callable[..., Procedure[Any]]
    save: Callable[..., dict[str, Any]]
    overrides: tuple[str, ...] = ()

    def scaled_frames(self, share: float) -> dict[str, int]:
        """A share of the frames, by the procedure's keyword."""
        return {name: max(1, round(share * count)) for name, count in self.frames.items()}

    def minimum_frames(self, config: SystemConfig) -> dict[str, int]:
        """Fewest frames that give its result, by the procedure's keyword: a matrix, a Strehl ratio."""
        from escape_hw.calibration.docrime.open_loop import minimum_frames
        from escape_hw.calibration.loop.runner import minimum_strehl_frames

        devices = config.devices
        matrix = minimum_frames(config.calibration, config.basis.n_modes)
        science_hz = devices.wfs.frame_rate_hz if devices.science is None else devices.science.frame_rate_hz
        loop = minimum_strehl_frames(devices.wfs.frame_rate_hz, science_hz)
        return {name: loop if name == _LOOP_FRAMES else matrix for name in self.frames}


def _table1(bench: Bench, *, short: int, long: int) -> Procedure[Any]:
    return reproduce_table1(bench, frames={"SHORT": short, "LONG": long})


CASES = {
    case.kind: case
    for case in (
        PaperCase(
            "table1", "registration from 20 seconds and from 3 minutes of data", "razor-shwfs",
            {"short": 10_000, "long": 100_000}, _table1, save_table1, PAPER_REGISTRATION,
        ),
        PaperCase(
            "shwfs", "Shack-Hartmann bench: matrices and loops", "razor-shwfs",
            {"frames": 10_000, "loop_frames": 30_000}, reproduce_shwfs, save_shwfs, PAPER_REGISTRATION,
        ),
        PaperCase(
            "pywfs", "pyramid bench: matrices, optical gains, loops with and without them", "razor-pywfs",
            {"frames": 100_000, "closed_frames": 20_000, "loop_frames": 20_000},
            reproduce_pywfs, save_pywfs,
        ),
        PaperCase(
            "maps", "telescope with a dirty mirror: matrix, simulation and loops", "maps-nir",
            {"frames": 60_000, "loop_frames": 10_000}, reproduce_maps, save_maps,
        ),
    )
}  # fmt: skip


def select_cases(kinds: Sequence[str] | None) -> list[PaperCase]:
    """The cases of these kinds, or all, in their own order.

    Raises
    ------
    ConfigError
        One is unknown.
    """
    for kind in kinds or ():
        if kind not in CASES:
            raise ConfigError(f"the paper's result '{kind}' is unknown; it is one of {', '.join(CASES)}")
    return [case for kind, case in CASES.items() if not kinds or kind in kinds]


def check_share(cases: Sequence[tuple[PaperCase, SystemConfig]], share: float) -> None:
    """Refuse a share of the frames that would end in errors after minutes, or with nothing to compare.

    Parameters
    ----------
    cases
        What is to run, and how it is configured.
    share
        Share of the frames of each.

    Raises
    ------
    ConfigError
        Too small; names the least share.
    """
    short = [
        (minimum_frames / case.frames[name], case, name, minimum_frames)
        for case, config in cases
        for name, minimum_frames in case.minimum_frames(config).items()
        if case.scaled_frames(share)[name] < minimum_frames
    ]
    if short:
        wanted, case, name, minimum_frames = max(short, key=lambda one: one[0])
        enough = math.ceil(1000 * wanted) / 1000
        raise ConfigError(
            f"--share {share:g}: too small; {case.kind} needs at least {minimum_frames} frames ({name}) and would get "
            f"{case.scaled_frames(share)[name]} of {case.frames[name]}; the least is --share {enough:g}"
        )


def request_fields(
    counts: Mapping[str, int], overrides: Sequence[str] | None, seed: int | None
) -> dict[str, Any]:
    """What a part is asked for, as its document keeps it."""
    return {**counts, "set": list(overrides or ()), "seed": seed}


def load_finished(folder: Path, kind: str, asked: Mapping[str, Any]) -> dict[str, Any] | None:
    """The document of a part that ran to its end in this folder; ``None`` when there is none.

    Raises
    ------
    ProductError
        What lies there is damaged.
    ConfigError
        It is another run, or was asked for something else.
    """
    if not (folder / "result.json").is_file():
        return None
    document = read_result(folder)
    if document.get("command") != f"reproduce {kind}":
        raise ConfigError(f"{folder} holds the run of 'escape {document.get('command')}'; take another --out")
    kept = document.get("request", asked)
    if kept != asked:
        raise ConfigError(
            f"{folder} was run with {_format_request(kept)}; asked for is {_format_request(asked)}: give the same --share, --set "
            "and --seed, or another --out"
        )
    return None if document.get("partial") else {**document, "folder": str(folder)}


def _format_request(asked: Mapping[str, Any]) -> str:
    return ", ".join(f"{key} {value}" for key, value in asked.items() if value not in (None, []))


def find_sweeps(folders: Sequence[Path]) -> dict[str, Path]:
    """Sweeps by the name that the paper's table knows them by: ``sweep-shwfs``, ``sweep-pywfs``.

    Raises
    ------
    ProductError
        One is no run folder.
    ConfigError
        One is no sweep, or of another system than the paper's.
    """
    found = {}
    for folder in folders:
        document = read_result(folder)
        system = str(document.get("system"))
        if "sweep" not in document or system not in ("razor-shwfs", "razor-pywfs"):
            raise ConfigError(f"--sweep {folder}: not a sweep of razor-shwfs or razor-pywfs")
        if document.get("partial"):
            raise ConfigError(
                f"--sweep {folder}: it was broken off; finish it (escape sweep --resume {folder} --out NEW) "
                "and give the new folder"
            )
        found[f"sweep-{system.removeprefix('razor-')}"] = folder
    return found
