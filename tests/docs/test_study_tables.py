"""Pages of studies state what their commands print of the raw tables."""

from __future__ import annotations

import re
import shlex
import sys

import pytest
from pages import EVERY, ROOT

from escape_benchmarks.realisation_tables import read_lines
from escape_hw.runtime.session.system import System

#: Scripts that only print, if their raw table has all realisations.
SCRIPTS = (
    "capture_range", "closed_loop_response", "constants", "lenslet_pokes", "mean_wavefront",
    "neighbouring_spots", "nuisances", "registration_errors", "tracked_realisations",
)  # fmt: skip
COMMAND = re.compile(
    rf"^python (benchmarks/studies/[a-z]+/(?:{'|'.join(SCRIPTS)})\.py .*--out docs/.*)$", re.MULTILINE
)
TEXTS = [page.read_text(encoding="utf-8") for page in EVERY]
QUOTED = [(text, command) for text in TEXTS for command in COMMAND.findall(text)]
#: First realisation of a study, by the folder of its raw tables.
FIRST = {"capture": 0, "constants": 10000, "nuisances": 2000}


@pytest.mark.parametrize(("text", "command"), QUOTED, ids=[command for _, command in QUOTED])
def test_a_page_has_what_its_command_prints(text, command, capsys, monkeypatch, import_study):
    monkeypatch.setattr(System, "from_config", None)  # nothing is measured
    monkeypatch.chdir(ROOT)
    words = shlex.split(command)
    monkeypatch.setattr(sys, "argv", words)
    import_study(words[0].removeprefix("benchmarks/studies/")).main()
    assert capsys.readouterr().out.rstrip() in text


def test_every_script_is_quoted():
    assert {command.split(".py")[0].rpartition("/")[2] for _, command in QUOTED} == set(SCRIPTS)


@pytest.mark.parametrize("folder", FIRST)
def test_the_realisations_are_those_of_the_study_and_of_one_commit_for_each_system(folder):
    tables = list((ROOT / "docs" / "studies" / folder).glob("*.jsonl"))
    rows = [row for table in tables for row in read_lines(table)]
    assert min(row["realisation"] for row in rows) == FIRST[folder]
    made = {(row["asked"]["system"], row["commit"]) for row in rows}
    assert len(made) == len({system for system, _ in made})


def test_no_realisation_of_the_capture_range_is_wrong():
    (table,) = (ROOT / "docs" / "studies" / "capture").glob("*.jsonl")
    assert [row["outcome"] for row in read_lines(table)] == ["recovered"] * 100


def test_the_page_of_faint_stars_has_its_tables(capsys, import_study):
    text = (ROOT / "docs" / "studies" / "star-magnitudes.md").read_text(encoding="utf-8")
    study = import_study("loops/star_magnitudes.py")
    for folder in (ROOT / "docs" / "studies" / "star-magnitudes" / name for name in ("", "sky", "long")):
        tables = {float(path.stem.rpartition("-")[2]): read_lines(path) for path in folder.glob("*.jsonl")}
        assert tables
        study.print_table(dict(sorted(tables.items())))
        printed = capsys.readouterr().out
        assert len(tables) == printed.count("\n") - 2
        assert printed in text


def test_the_page_of_sky_time_has_its_tables(capsys, import_study):
    text = (ROOT / "docs" / "studies" / "sky-time.md").read_text(encoding="utf-8")
    study = import_study("sky_time/sky_time.py")
    tables = [read_lines(path) for path in (ROOT / "docs" / "studies" / "sky-time").glob("*.jsonl")]
    assert tables
    for rows in tables:
        study.print_table([study.errors_of_line(row) for row in rows], rows[0]["asked"]["frames"])
        assert capsys.readouterr().out in text
