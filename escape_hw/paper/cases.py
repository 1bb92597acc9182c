"""The paper's results as cases: system, frames, procedure; their products, and finished runs."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from escape_hw.api.procedure import Procedure
from escape_hw.bench import Bench
from escape_hw.config.system import SystemConfig
from escape_hw.errors import ConfigError
from escape_hw.io import documents
from escape_hw.io.run_folder import RunFolder, read_result
from escape_hw.paper.experiments import (
    PAPER_REGISTRATION,
    Table1Result,
    reproduce_maps,
    reproduce_pywfs,
    reproduce_shwfs,
    reproduce_table1,
)
from escape_hw.paper.frame_counts import FRAMES
from escape_hw.paper.paired_seeds import (
    PUSH_PULL_FRAMES,
    PairedSeeds,
    paired_document,
    reproduce_revolt,
)
from escape_hw.runtime.procedures import criteria
from escape_hw.runtime.procedures.calibration import measured_calibration
from escape_hw.runtime.procedures.calibration_comparison import WITH_GAINS, CalibrationComparison
from escape_hw.runtime.procedures.products import (
    add_result,
    product_key,
    save_run,
)
from escape_hw.runtime.session.record import BenchRecord

#: Keyword of the frames of a closed loop.
_LOOP_FRAMES = "loop_frames"


@dataclass(frozen=True, slots=True)
class PaperCase:
    """One of the paper's results.

    ``kind`` is its name on the command line, ``frames`` the numbers of frames by keyword of the
    ``procedure``, which takes an open bench. ``save`` saves the result, checks its criteria and writes the
    report.
    """

    kind: str
    title: str
    system: str
    frames: dict[str, int]
    procedure: Callable[..., Procedure[Any]]
    save: Callable[[RunFolder, BenchRecord, Any, float], dict[str, Any]]
    overrides: tuple[str, ...] = ()

    def scaled_frames(self, share: float) -> dict[str, int]:
        """A share of the frames, by the procedure's keyword."""
        return {name: max(1, round(share * count)) for name, count in self.frames.items()}

    def minimum_frames(self, config: SystemConfig) -> dict[str, int]:
        """Fewest frames for a matrix and for a Strehl ratio, by the procedure's keyword."""
        from escape_hw.calibration.docrime.open_loop import minimum_frames
        from escape_hw.calibration.loop.runner import minimum_strehl_frames

        devices = config.devices
        matrix = minimum_frames(config.calibration, config.basis.n_modes)
        science_hz = devices.wfs.frame_rate_hz if devices.science is None else devices.science.frame_rate_hz
        loop = minimum_strehl_frames(devices.wfs.frame_rate_hz, science_hz)
        return {name: loop if name == _LOOP_FRAMES else matrix for name in self.frames}


# ---------------------------------------------------------------- products
def save_comparison(
    folder: RunFolder,
    record: BenchRecord,
    result: CalibrationComparison,
    wall_seconds: float,
    *,
    command: str,
    title: str,
) -> dict[str, Any]:
    """Save products, ``result.json`` and report of several calibrations of one system; returns the document.

    Raises
    ------
    StorageError
        Something cannot be written.
    """
    saved: dict[str, Path] = {}
    for label, calibration in result.calibrations.items():
        parents = [saved["DO-CRIME"]] if label == "ESCAPE" and "DO-CRIME" in saved else []
        saved[label] = add_result(folder, record, product_key(label), calibration, *parents)
    for label, loop in result.loops.items():
        # A matrix scaled by its optical gains comes from the one saved.
        add_result(folder, record, f"loop_{product_key(label)}", loop, saved[label.removesuffix(WITH_GAINS)])
    if result.gains is not None:
        others = [saved[label] for label in result.gains.comparisons]
        add_result(folder, record, "gains", result.gains, saved["ESCAPE"], *others)
    escape = result.calibrations.get("ESCAPE")
    estimate = None if escape is None else escape.registration
    checks = []
    if not result.partial:
        checks.append(criteria.sprint_converged("ESCAPE", estimate))
        if estimate is not None and record.injected is not None:
            checks.append(criteria.injected_value_recovered("ESCAPE", estimate, record.injected))
        checks += criteria.loop_criteria(result.loops)
        if result.gains is not None:
            checks.append(criteria.gains_converged(result.gains))
    labels: dict[str, Any] = {product_key(label): {"label": label} for label in result.calibrations}
    labels |= {f"loop_{product_key(label)}": {"label": label} for label in result.loops}
    labels.setdefault("escape", {}).update(measured="DO-CRIME", column="")
    return save_run(
        folder, record, command, f"{title}: {record.system}", wall_seconds,
        calibrations={k: documents.calibration_document(v) for k, v in result.calibrations.items()},
        **documents.registration_document(estimate),
        loops={label: documents.loop_document(loop) for label, loop in result.loops.items()},
        scans={k: [documents.loop_document(run) for run in runs] for k, runs in result.scans.items()},
        criteria=checks,
        labels=labels,
        partial=result.partial,
        notes=list(result.notes),
        **({"sky_time": result.sky_time} if result.sky_time else {}),
    )  # fmt: skip


def save_table1(
    folder: RunFolder, record: BenchRecord, result: Table1Result, wall_seconds: float
) -> dict[str, Any]:
    """As :func:`save_comparison`, of :func:`~escape_hw.paper.experiments.reproduce_table1`."""
    labels, checks, _ = _save_registrations(folder, record, result)
    estimates = [one.registration for one in result.calibrations.values() if one.registration is not None]
    if len(estimates) == 2:
        checks += criteria.short_and_long_agree(*estimates)
    return save_run(
        folder, record, "reproduce table1",
        f"Registration from short and long runs: {record.system}", wall_seconds,
        table1={k: documents.calibration_document(v) for k, v in result.calibrations.items()},
        criteria=[] if result.partial else checks,
        labels=labels,
        partial=result.partial,
    )  # fmt: skip


def _save_registrations(
    folder: RunFolder, record: BenchRecord, result: Table1Result
) -> tuple[dict[str, dict[str, str]], list[dict[str, Any]], dict[str, Path]]:
    """Save the calibrations by column; returns labels of the products, criteria, and files by label."""
    labels: dict[str, dict[str, str]] = {}
    checks, saved = [], dict[str, Path]()
    for column, calibration in result.calibrations.items():
        estimate = calibration.registration
        # Stopped before SPRINT, only the DO-CRIME matrix exists.
        measured = calibration if estimate is None else measured_calibration(calibration)
        parents = []
        if measured is not None:
            source = f"DO-CRIME {column}"
            saved[source] = add_result(folder, record, product_key(source), measured)
            parents = [saved[source]]
            labels[product_key(source)] = {"label": source}
        if estimate is None:
            continue
        label = f"ESCAPE {column}"
        saved[label] = add_result(folder, record, product_key(label), calibration, *parents)
        labels[product_key(label)] = {"label": label, "measured": f"DO-CRIME {column}", "column": column}
        checks.append(criteria.sprint_converged(column, estimate))
        if record.injected is not None:
            checks.append(criteria.injected_value_recovered(column, estimate, record.injected))
    return labels, checks, saved


def save_paired_seeds(
    folder: RunFolder, record: BenchRecord, result: PairedSeeds, wall_seconds: float
) -> dict[str, Any]:
    """As :func:`save_comparison`, of :func:`~escape_hw.paper.paired_seeds.reproduce_revolt`.

    Matrices and loops are those of the first seed; ``paired`` has the numbers of all.
    """
    labels, checks, saved = _save_registrations(folder, record, result.registrations)
    first = result.seeds[0] if result.seeds else None
    if first is not None:
        # ESCAPE and DO-CRIME of the first seed are those of SHORT.
        saved = {label.removesuffix(" SHORT"): path for label, path in saved.items()}
        if "push-pull" in first.calibrations:
            baseline = first.calibrations["push-pull"]
            saved["push-pull"] = add_result(folder, record, "push_pull", baseline, saved["ESCAPE"])
            labels["push_pull"] = {"label": "push-pull"}
        for label, loop in first.loops.items():
            name = f"loop_{product_key(label)}"
            add_result(folder, record, name, loop, saved[label])
            labels[name] = {"label": label}
    scans = {} if first is None else first.scans
    return save_run(
        folder, record, "reproduce revolt",
        f"Registration, and loops on equal turbulence: {record.system}", wall_seconds,
        registrations={
            k: documents.calibration_document(v) for k, v in result.registrations.calibrations.items()
        },
        paired=paired_document(result),
        scans={k: [documents.loop_document(run) for run in runs] for k, runs in scans.items()},
        criteria=[] if result.partial else [*checks, *_paired_criteria(result)],
        labels=labels,
        partial=result.partial,
    )  # fmt: skip


def _paired_criteria(result: PairedSeeds) -> Iterator[dict[str, Any]]:
    """ESCAPE's registration and loop for every seed, and its Strehl ratio; the others may diverge."""
    for one in result.seeds:
        label = f"ESCAPE, seed {one.seed}"
        yield criteria.sprint_converged(label, one.estimate)
        if one.estimate is not None:
            yield criteria.injected_value_recovered(label, one.estimate, one.injected)
    unstable = [one.seed for one in result.seeds if not one.is_stable("ESCAPE")]
    yield criteria.stable_for_every_seed("ESCAPE", unstable)
    yield criteria.strehl_not_worse("ESCAPE", "DO-CRIME", result.difference("ESCAPE", "DO-CRIME"))


# ---------------------------------------------------------------- the cases
def _table1(bench: Bench, *, short: int, long: int) -> Procedure[Any]:
    return reproduce_table1(bench, frames={"SHORT": short, "LONG": long})


def _save(kind: str, title: str) -> Callable[..., dict[str, Any]]:
    return partial(save_comparison, command=f"reproduce {kind}", title=title)


CASES = {
    case.kind: case
    for case in (
        PaperCase(
            "table1", "registration from 20 seconds and from 3 minutes of data", "razor-shwfs",
            FRAMES["table1"], _table1, save_table1, PAPER_REGISTRATION,
        ),
        PaperCase(
            "shwfs", "Shack-Hartmann bench: matrices and loops", "razor-shwfs",
            FRAMES["shwfs"], reproduce_shwfs,
            _save("shwfs", "Calibration without a source"), PAPER_REGISTRATION,
        ),
        PaperCase(
            "pywfs", "pyramid bench: matrices, optical gains, loops with and without them", "razor-pywfs",
            FRAMES["pywfs"], reproduce_pywfs,
            _save("pywfs", "Calibration and optical gains without a source"),
        ),
        PaperCase(
            "maps", "telescope with a contaminated mirror: matrix, simulation and loops", "maps-nir",
            FRAMES["maps"], reproduce_maps,
            _save("maps", "Calibration on the sky, with a contaminated mirror"),
        ),
        PaperCase(
            "revolt", "telescope with a Shack-Hartmann sensor: registration and paired loops", "revolt-shwfs",
            FRAMES["revolt"], reproduce_revolt, save_paired_seeds,
            (f"calibration.push_pull_frames={PUSH_PULL_FRAMES}",),
        ),
    )
}  # fmt: skip


def select_cases(kinds: Sequence[str] | None) -> list[PaperCase]:
    """The cases of these kinds, or all, in the order of the paper.

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
    """Refuse a share of the cases' frames that is too small for a matrix or a Strehl ratio.

    Raises
    ------
    ConfigError
        Too small; names the least share.
    """
    short = [
        (minimum / case.frames[name], case, name, minimum)
        for case, config in cases
        for name, minimum in case.minimum_frames(config).items()
        if case.scaled_frames(share)[name] < minimum
    ]
    if short:
        wanted, case, name, minimum = max(short, key=lambda one: one[0])
        enough = math.ceil(1000 * wanted) / 1000
        raise ConfigError(
            f"--share {share:g}: too small; {case.kind} needs at least {minimum} frames ({name}) and would "
            f"get {case.scaled_frames(share)[name]} of {case.frames[name]}; the least is --share {enough:g}"
        )


# ---------------------------------------------------------------- finished runs
def request_fields(
    counts: Mapping[str, int], overrides: Sequence[str] | None, seed: int | None
) -> dict[str, Any]:
    """The request of a case, as its document stores it."""
    return {**counts, "set": list(overrides or ()), "seed": seed}


def load_finished(folder: Path, kind: str, request: Mapping[str, Any]) -> dict[str, Any] | None:
    """The document of a finished case in this folder; ``None`` when there is none.

    Raises
    ------
    ProductError
        The folder's document is damaged.
    ConfigError
        It is another run, or the request was another.
    """
    if not (folder / "result.json").is_file():
        return None
    document = read_result(folder)
    if document.get("command") != f"reproduce {kind}":
        raise ConfigError(
            f"{folder} holds the run of 'escape {document.get('command')}'; choose another --out"
        )
    stored = document.get("request", request)
    if stored != request:
        raise ConfigError(
            f"{folder} was run with {_format_request(stored)}; requested is {_format_request(request)}: give "
            "the same --share, --set and --seed, or another --out"
        )
    return None if document.get("partial") else {**document, "folder": str(folder)}


def _format_request(request: Mapping[str, Any]) -> str:
    return ", ".join(f"{key} {value}" for key, value in request.items() if value not in (None, []))


def find_sweeps(folders: Sequence[Path]) -> dict[str, Path]:
    """Sweeps by their name in the table of the paper's numbers: ``sweep-shwfs``, ``sweep-pywfs``.

    Raises
    ------
    ProductError
        One is no run folder.
    ConfigError
        One is no sweep, unfinished, or of another system than the paper's.
    """
    found = {}
    for folder in folders:
        document = read_result(folder)
        system = str(document.get("system"))
        if "sweep" not in document or system not in ("razor-shwfs", "razor-pywfs"):
            raise ConfigError(f"--sweep {folder}: not a sweep of razor-shwfs or razor-pywfs")
        if document.get("partial"):
            raise ConfigError(
                f"--sweep {folder}: unfinished; finish it (escape sweep --resume {folder} --out NEW) and "
                "give the new folder"
            )
        found[f"sweep-{system.removeprefix('razor-')}"] = folder
    return found
