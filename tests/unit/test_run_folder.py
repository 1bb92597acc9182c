"""A run's folder: created before anything moves, never over another run."""

from __future__ import annotations

import errno
import json
import logging
import os
import threading
from pathlib import Path

import pytest

from escape_hw.errors import ProductError, StorageError
from escape_hw.io import run_folder, storage
from escape_hw.io.run_folder import RunFolder, read_result


@pytest.fixture(autouse=True)
def home(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "data"))
    return tmp_path


def test_default_folder_is_dated_and_named(home):
    path = RunFolder("razor-shwfs", "calibrate-escape").path
    assert path.is_dir()
    assert home / "data" in path.parents
    assert path.name.endswith("_razor-shwfs_calibrate-escape")
    assert path.parent.name.count("-") == 2


def test_names_cannot_leave_the_folder(home):
    path = RunFolder("../../etc", "a/b c").path
    assert home / "data" in path.resolve().parents
    assert path.parent.parent == run_folder.default_runs_folder()


def test_same_name_makes_a_sibling(home):
    first = RunFolder("s", "k", home / "run")
    first.write_config("x = 1\n")
    assert RunFolder("s", "k", home / "run").path == home / "run-2"
    assert (home / "run" / "config.toml").read_text() == "x = 1\n"


def test_empty_folder_given_by_the_user_is_used(home):
    (home / "mine").mkdir()
    assert RunFolder("s", "k", home / "mine").path == home / "mine"


@pytest.mark.parametrize("out", ["", ".", "..", "/", "runs/.."])
def test_a_folder_without_a_name_is_refused(home, monkeypatch, out):
    monkeypatch.chdir(home)
    with pytest.raises(
        StorageError, match=r"'[./runs]*' \(--out\) gives .* no name; name a new one, such as .*k$"
    ):
        RunFolder("s", "k", Path(out))
    assert not list(home.iterdir())


def test_many_at_once_never_share_a_folder(home, monkeypatch):
    paths: list[Path] = []

    def make() -> None:
        folder = RunFolder("s", "k", home / "run")
        folder.write_config("")
        paths.append(folder.path)

    (home / "run").mkdir()
    (home / "run" / "occupied").touch()
    threads = [threading.Thread(target=make) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(set(paths)) == 8


def test_log_result_and_products(home):
    with RunFolder("s", "k", home / "run") as folder:
        logging.getLogger("escape_hw.somewhere").info("a remark")
        folder.add_product("im", folder.file("im.fits"))
        folder.write_result({"system": "s", "value": float("nan")})
    logging.getLogger("escape_hw.somewhere").warning("after the end")
    log = (home / "run" / "run.log").read_text()
    assert "a remark" in log
    assert "after the end" not in log
    assert json.loads((home / "run" / "result.json").read_text())["value"] is None
    moved = (home / "run").rename(home / "moved")
    assert read_result(moved)["products"] == {"im": moved / "im.fits"}


def test_defect_leaves_its_traceback_in_the_log(home):
    def defect() -> None:
        with RunFolder("s", "k", home / "run"):
            raise RuntimeError("broken")

    with pytest.raises(RuntimeError):
        defect()
    assert "Traceback" in (home / "run" / "run.log").read_text()


@pytest.mark.parametrize(
    ("out", "words"),
    [("file/run", "cannot be written"), ("file", "is a file"), ("/dev/null", "is a file")],
)
def test_impossible_place_is_refused(home, out, words):
    (home / "file").write_text("kept")
    with pytest.raises(StorageError, match=rf"(file|null): {words}.*choose another"):
        RunFolder("s", "k", home / out)
    assert (home / "file").read_text() == "kept"
    assert [one.name for one in home.iterdir()] == ["file"]


def test_read_only_place_is_refused_before_the_run(home, monkeypatch):
    def refuse(**_: object) -> None:
        raise OSError(errno.EROFS, os.strerror(errno.EROFS))

    monkeypatch.setattr(storage.tempfile, "TemporaryFile", refuse)
    with pytest.raises(StorageError, match="read-only"):
        RunFolder("s", "k", home / "run")


def test_little_space_is_refused_before_the_run(home, monkeypatch):
    usage = storage.shutil.disk_usage(home)
    monkeypatch.setattr(storage.shutil, "disk_usage", lambda folder: usage._replace(free=10_000_000))
    with pytest.raises(StorageError, match=r"10\.0 MB free"):
        RunFolder("s", "k", home / "run")


@pytest.mark.parametrize("content", [None, "", "[]", "{}", '{"products": 3}', '{"products"'])
def test_damaged_result_is_refused_by_name(home, content):
    if content is not None:
        (home / "result.json").write_text(content)
    with pytest.raises(ProductError, match=r"result\.json: "):
        read_result(home)


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EACCES, errno.EIO])
def test_messages_of_files_name_no_option_that_only_runs_have(number):
    message = str(storage.storage_error(Path("a"), OSError(number, "reason")))
    assert "a: cannot be written (reason)" in message
    assert "--out" not in message


def test_a_run_without_a_result_is_referred_to_its_log(home):
    (home / "run.log").touch()
    with pytest.raises(ProductError, match=rf"the run has no result, see {home / 'run.log'}"):
        read_result(home)


def test_numbers_of_runs_continue_those_of_the_folder(home):
    runs = home / "runs"
    for name in ("214530_small_calibrate-escape-7", "214600_other_docrime-12", "214700_small_push-pull"):
        (runs / "2026-11-21" / name).mkdir(parents=True)
    assert run_folder.last_run_number(runs, "small") == 7
    assert run_folder.last_run_number(home / "none", "small") == 0
    labels = [run_folder.run_label(folder) for folder in run_folder.find_runs(runs)]
    assert labels == ["2026-11-21 214700 push-pull", "docrime-12", "escape-7"]
