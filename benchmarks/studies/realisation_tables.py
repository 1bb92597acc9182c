"""Errors over random realisations: saved line by line, printed as the rows of a Markdown table."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

#: Values saved for a realisation: JSON numbers and nested lists, with null for what was refused.
Line = dict[str, Any]


def each_realisation(
    target: Path,
    asked: Line,
    numbers: Iterable[int],
    measure: Callable[[int], Line],
    describe: Callable[[Line], str] = lambda line: "done",
) -> list[Line]:
    """The lines of some realisations, measured unless the file has them already, a line as soon as it is
    done.

    Parameters
    ----------
    target
        File with one JSON object per line.
    asked
        What was asked for, such as frames and settings; kept in every line.
    numbers
        The realisations.
    measure
        Gives the line of a realisation.
    told
        What to print of a new line.

    Raises
    ------
    SystemExit
        The file has realisations that were asked for otherwise, which do not belong into the same table.
    """
    asked = json.loads(json.dumps(asked))
    target.parent.mkdir(parents=True, exist_ok=True)
    known = [*map(json.loads, target.read_text().splitlines())] if target.exists() else []
    if any(line["asked"] != asked for line in known):
        raise SystemExit(f"{target} has realisations that were asked for otherwise; choose another --out")
    lines = {line["realisation"]: line for line in known}
    for number in numbers:
        if number in lines:
            continue
        lines[number] = {"realisation": number, "asked": asked, **measure(number)}
        with target.open("a") as file:
            file.write(json.dumps(lines[number]) + "\n")
        print(f"realisation {number}: {describe(lines[number])}", flush=True)
    return [lines[number] for number in sorted(lines)]


def to_json(values: NDArray[np.float64]) -> Any:
    """An array as nested lists, what is not finite as None."""
    return np.where(np.isfinite(values), values.astype(object), None).tolist()


def array(values: Any) -> NDArray[np.float64]:
    """The inverse of :func:`to_json`."""
    return np.array(values, dtype=float)


def row(
    errors: NDArray[np.float64], sigmas: NDArray[np.float64], bound: NDArray[np.float64] | None = None
) -> str:
    """Cells of a table: rms error (times the bound; normalised chi-squared; mean error), by parameter.

    Parameters
    ----------
    errors, sigmas
        ``(n_realisations, 5)``.
    bound
        Rms Cramer-Rao bound ``(5,)``.
    """
    rms, chi2 = np.sqrt(np.mean(errors**2, axis=0)), np.mean(np.square(errors / sigmas), axis=0)
    cells = []
    for k, value in enumerate(rms):
        ratio = "" if bound is None else f"{value / bound[k]:.1f}; "
        cells.append(f"{value:.2g} ({ratio}{chi2[k]:.1f}; {errors[:, k].mean():+.2g})")
    return " | ".join(cells)
