"""Keeps what a sweep found."""

from __future__ import annotations

from typing import Any

from escape_hw.io.run_folder import RunFolder
from escape_hw.runtime.keep import finish
from escape_hw.runtime.records import BenchRecord
from escape_hw.runtime.sweep.document import sweep_document, trials_csv
from escape_hw.runtime.sweep.kept import KeptSweep
from escape_hw.runtime.sweep.result import SweepResult
from escape_hw.runtime.sweep.store import shown

TRIALS = "trials.csv"


def keep_sweep(
    folder: RunFolder, record: BenchRecord, kept: KeptSweep, result: SweepResult, wall_seconds: float
) -> dict[str, Any]:
    """Table of all loops, ``result.json`` and report of a sweep.

    The folder can be resumed from afterwards, too: its description leads to the same study.

    Returns
    -------
    dict
        The run's document; its ``criteria`` say what was met.

    Raises
    ------
    StorageError
        Something cannot be written.
    """
    kept.keep(folder.path)
    folder.add("trials", folder.write_text(TRIALS, trials_csv(result)))
    document = {
        **record.head("sweep"),
        "title": f"Matrices compared, each at its best: {record.system}",
        **sweep_document(result),
        "storage": shown(kept.storage),
        "study": kept.study,
        "sampler": kept.sampler,
        **record.tail(wall_seconds),
    }
    return finish(folder, document)
