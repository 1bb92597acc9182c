"""What the studies share: command line, lines of JSON that a later run continues, rows of Markdown tables."""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

#: Values saved for a realisation: JSON numbers and nested lists, with null for what was refused.
Line = dict[str, Any]


def study_parser(
    description: str | None, system: str | None = None, realisations: int | None = None
) -> argparse.ArgumentParser:
    """The options of most studies: ``--out``, ``--system`` with a default, and the range of realisations."""
    parser = argparse.ArgumentParser(
        description=description, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    if system is not None:
        parser.add_argument("--system", default=system)
    if realisations is not None:
        parser.add_argument("--first", type=int, default=0, help="number of the first realisation")
        parser.add_argument("--realisations", type=int, default=realisations, help="how many")
    parser.add_argument("--out", type=Path, default=Path("."), help="folder of the results")
    return parser


def realisation_numbers(options: argparse.Namespace) -> range:
    """The realisations that the options of :func:`study_parser` ask for."""
    return range(options.first, options.first + options.realisations)


def read_lines(path: Path) -> list[Any]:
    """The values of a file of JSON lines; none of a file that does not exist."""
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


def append_line(path: Path, value: Any) -> None:
    """Append a value to a file of JSON lines."""
    with path.open("a") as file:
        file.write(json.dumps(value) + "\n")


def each_realisation(
    target: Path,
    asked: Line,
    numbers: Iterable[int],
    measure: Callable[[int], Line],
    describe: Callable[[Line], str] = lambda line: "done",
) -> list[Line]:
    """The lines of some realisations; those that the file lacks are measured and appended one by one.

    Parameters
    ----------
    target
        File with one JSON object per line.
    asked
        Settings such as the frames, saved in every line.
    measure
        Returns the line of a realisation.
    describe
        What to print of a new line.

    Raises
    ------
    SystemExit
        The file has realisations with other settings.
    """
    asked = json.loads(json.dumps(asked))
    target.parent.mkdir(parents=True, exist_ok=True)
    saved = read_lines(target)
    if any(line["asked"] != asked for line in saved):
        raise SystemExit(f"{target} has realisations with other settings; choose another --out")
    lines = {line["realisation"]: line for line in saved}
    for number in numbers:
        if number not in lines:
            lines[number] = {"realisation": number, "asked": asked, **measure(number)}
            append_line(target, lines[number])
            print(f"realisation {number}: {describe(lines[number])}", flush=True)
    return [lines[number] for number in sorted(lines)]


def to_json(values: NDArray[np.float64]) -> Any:
    """An array as nested lists, what is not finite as None."""
    return np.where(np.isfinite(values), values.astype(object), np.array(None)).tolist()


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
