"""Validation of the registration on all systems: raw tables, the page of their statistics, and its figure.

    python benchmarks/studies/registration/validation.py --out docs/studies/validation
    python benchmarks/studies/registration/validation.py --out docs/studies/validation \\
        --cases dm97-1000 dm97-50

Measures the realisations that the raw tables lack (``registration_errors.py`` has their contents), for all
cases or some of them, and then writes ``tables.md`` and ``errors.png`` from all tables that are there. May be
interrupted and run again; two runs with different cases may share the folder. On an idle core a lenslet
realisation takes ten to twenty seconds, one of a pyramid half a minute to two minutes.
"""

from __future__ import annotations

import io
from contextlib import redirect_stdout
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from registration_errors import contamination_overrides, print_table, run_realisation

from escape_benchmarks.realisation_tables import Line, each_realisation, read_lines, study_parser
from escape_hw.api.registration import PARAMETERS
from escape_hw.report.figures.style import SERIES, new_figure, style_axes

#: Realisations of a case. No constant and no method was chosen on them, and none was looked at before.
REALISATIONS = range(14000, 14020)
#: The mirror of the bundled benches until version 0.2.0.
GAUSSIAN = (
    "devices.dm.influence=gaussian", "devices.dm.coupling=0.4", "twin.mirror.shape=gaussian",
    "twin.mirror.coupling=0.43", "twin.mirror.gain_scatter=0.05", "twin.mirror.wing_fraction=0.03",
)  # fmt: skip
_THIN_PLATE = (
    "devices.dm.influence=gaussian", "devices.dm.coupling=0.4", "twin.mirror.shape=thin-plate",
    "twin.mirror.coupling=0.41", "twin.mirror.wing_fraction=0", "twin.mirror.gain_scatter=0.05",
)  # fmt: skip
#: A nominal mirror of another family than the true one.
_GAUSSIAN_NOMINAL = ("devices.dm.influence=gaussian", "devices.dm.coupling=0.4")

#: Sensors that are not built like the model.
OOPAO = ("system.optics=oopao",)


@dataclass(frozen=True)
class Case:
    """A system with a mirror and a number of frames.

    ``title`` is its heading.
    """

    title: str
    system: str
    frames: int
    overrides: tuple[str, ...] = ()
    dm97: bool = False


CASES = {
    "dm97-1000": Case("mirrors like a DM97, 1,000 frames", "razor-shwfs", 1000, dm97=True),
    "dm97-50": Case("mirrors like a DM97, 50 frames", "razor-shwfs", 50, dm97=True),
    "gaussian-1000": Case("Gaussian influence functions, 1,000 frames", "razor-shwfs", 1000, GAUSSIAN),
    "gaussian-50": Case("Gaussian influence functions, 50 frames", "razor-shwfs", 50, GAUSSIAN),
    "thin-plate-1000": Case("thin plates, 1,000 frames", "razor-shwfs", 1000, _THIN_PLATE),
    "nominal-1000": Case(
        "mirrors like a DM97, a Gaussian nominal mirror, 1,000 frames", "razor-shwfs", 1000, _GAUSSIAN_NOMINAL
    ),
    "dm97-1500": Case("mirrors like a DM97, 1,500 frames", "razor-pywfs", 1500, dm97=True),
    "oopao-1000": Case(
        "mirrors like a DM97, optics of OOPAO, 1,000 frames", "razor-shwfs", 1000, OOPAO, dm97=True
    ),
    "oopao-1500": Case(
        "mirrors like a DM97, optics of OOPAO, 1,500 frames", "razor-pywfs", 1500, OOPAO, dm97=True
    ),
    "revolt-2000": Case("as bundled, 2,000 frames", "revolt-shwfs", 2000),
    "nir-1500": Case("as bundled, 1,500 frames", "maps-nir", 1500),
    "nir-clean-1500": Case(
        "clean and evenly lit, 1,500 frames", "maps-nir", 1500, tuple(contamination_overrides(0.0))
    ),
    "nir-tenth-1500": Case(
        "a tenth of the pupil contaminated, 1,500 frames", "maps-nir", 1500,
        tuple(contamination_overrides(0.28))
    ),
    "vis-1500": Case("as bundled, 1,500 frames", "maps-vis", 1500),
}  # fmt: skip

#: Limits of the rms errors that the page claims: shift, rotation, scaling; and of what a matrix leaves, in %.
LIMITS = {
    "dm97-1000": (0.5, 0.02, 0.2), "dm97-50": (1.0, 0.04, 0.3), "dm97-1500": (4.0, 0.05, 0.4),
}  # fmt: skip
MATRIX_LIMIT = 8.0
#: Cases of which the page claims that the stated errors are neither too small nor too large.
HONEST = ("dm97-1000", "dm97-50", "nominal-1000", "gaussian-1000", "gaussian-50", "dm97-1500", "revolt-2000")


def table_path(folder: Path, name: str) -> Path:
    """The raw table of a case."""
    return folder / f"{CASES[name].system}-{name}.jsonl"


def measure(folder: Path, name: str) -> None:
    """Measure the realisations of a case that its raw table lacks."""
    case = CASES[name]
    each_realisation(
        table_path(folder, name),
        {"system": case.system, "frames": case.frames, "set": list(case.overrides), "dm97": case.dm97},
        REALISATIONS,
        lambda number: run_realisation(case.system, number, case.frames, list(case.overrides), case.dm97),
        lambda row: f"{name} {np.round(row['error'], 3).tolist()}",
    )


def measured_cases(folder: Path) -> dict[str, list[Line]]:
    """The raw tables that are there, by case, in order of the realisations."""
    tables = {name: read_lines(table_path(folder, name)) for name in CASES}
    return {name: sorted(rows, key=lambda row: row["realisation"]) for name, rows in tables.items() if rows}


def page(tables: dict[str, list[Line]]) -> str:
    """The page of the statistics."""
    lines = [
        "# Tables of the validation", "",
        "Written by `benchmarks/studies/registration/validation.py` from the raw tables in this folder "
        "([what they show](../validation.md)). Columns: shift x and y in % of a sub-aperture, rotation in "
        "degrees, radial and tangential scaling in % of the diameter. Rows: rms error, mean error and its "
        "standard error, largest error, and mean squared error over the squared standard error; *matrix*: "
        "mean of what the pseudo-synthetic matrix leaves of the noise-free one of the calm bench, in % of "
        "it; *images*: rms error of the place of the pupil images in pixels.", "",
        "![Errors in standard errors](errors.png)", "",
        "*Errors of all realisations in their standard errors, by parameter; the band is one of them.*",
    ]  # fmt: skip
    for name, rows in tables.items():
        case, printed = CASES[name], io.StringIO()
        with redirect_stdout(printed):
            print_table(rows)
        commits = ", ".join(sorted({row["commit"] for row in rows}))
        lines += [
            "", f"## `{case.system}`, {case.title}", "", f"Commit {commits}.", "", "```text",
            printed.getvalue().rstrip(), "```",
        ]  # fmt: skip
    if {"nir-tenth-1500", "nir-clean-1500"} <= tables.keys():
        lines += ["", "## Contaminated and clean pupil of `maps-nir`", "", contamination_ratio(tables)]
    return "\n".join(lines) + "\n"


def contamination_ratio(tables: dict[str, list[Line]]) -> str:
    """Ratio of the rms errors of both shifts, a tenth of the pupil contaminated over clean, in words.

    The interval is that of 10,000 resamples of the realisations (bootstrap).
    """
    dirty, clean = (
        np.square([row["error"][:2] for row in tables[name]]) for name in ("nir-tenth-1500", "nir-clean-1500")
    )
    rng = np.random.default_rng(0)
    drawn = [part[rng.integers(len(part), size=(10_000, len(part)))].mean(axis=1) for part in (dirty, clean)]
    ratio = np.sqrt(dirty.mean(axis=0) / clean.mean(axis=0))
    low, high = np.percentile(np.sqrt(drawn[0] / drawn[1]), [2.5, 97.5], axis=0)
    x, y = (f"{ratio[k]:.1f} ({low[k]:.1f} to {high[k]:.1f})" for k in range(2))
    return f"Ratio of the rms errors of the shifts, with 95 % intervals: x {x}, y {y}."


def draw(tables: dict[str, list[Line]], target: Path) -> None:
    """Errors of all realisations in their standard errors, a row of points per parameter."""
    figure = new_figure(8.0, 0.9 + 1.15 * len(tables))
    converged = [row for rows in tables.values() for row in rows if row["converged"]]
    limit = np.ceil(max(4.0, *(np.abs(np.divide(row["error"], row["sigma"])).max() for row in converged)))
    for axes, (name, rows) in zip(
        np.atleast_1d(figure.subplots(len(tables), 1)), tables.items(), strict=True
    ):
        style_axes(axes)
        for k, parameter in enumerate(PARAMETERS):
            pulls = [row["error"][k] / row["sigma"][k] for row in rows if row["converged"]]
            axes.plot(pulls, np.full(len(pulls), -k), ".", color=SERIES[0], ms=5, alpha=0.6)
            axes.text(-1.04 * limit, -k, parameter.replace("_", " "), ha="right", va="center", fontsize=7)
        axes.set(xlim=(-limit, limit), ylim=(-4.6, 0.6), yticks=[])
        axes.axvspan(-1, 1, color=SERIES[0], alpha=0.08, lw=0)
        axes.set_title(f"{CASES[name].system}, {CASES[name].title}", loc="left", fontsize=8)
    axes.set_xlabel("error [standard errors]")
    figure.savefig(target, dpi=110, facecolor="white")


def main() -> None:
    """Measure what is missing, and write page and figure."""
    parser = study_parser(__doc__)
    parser.add_argument("--cases", nargs="*", choices=CASES, default=list(CASES))
    options = parser.parse_args()
    for name in options.cases:
        measure(options.out, name)
    tables = measured_cases(options.out)
    (options.out / "tables.md").write_text(page(tables))
    draw(tables, options.out / "errors.png")


if __name__ == "__main__":
    main()
