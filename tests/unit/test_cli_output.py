"""Where the command line writes: standard output, standard error, the folder of the run."""

from __future__ import annotations

from pathlib import Path


def test_default_folder_is_dated_in_the_user_data(document, bench, tmp_path):
    _, found, _ = document("calibrate", "razor-shwfs", "--method", "docrime")
    folder = Path(found["folder"])
    assert tmp_path / "data" in folder.parents
    assert folder.name.endswith("razor-shwfs_calibrate-docrime")


def test_library_chatter_never_reaches_standard_output(document, bench, tmp_path):
    bench.hook = lambda name: print("chatter")
    code, _, err = document("calibrate", "razor-shwfs", "--out", tmp_path / "run")
    assert code == 0
    assert "chatter" in err


def test_quiet_shows_no_progress(escape, bench, tmp_path):
    assert (
        "docrime: " in escape("calibrate", "razor-shwfs", "--method", "docrime", "--out", tmp_path / "a")[2]
    )
    words = ("calibrate", "razor-shwfs", "--method", "docrime", "--out", tmp_path / "b", "--quiet")
    assert escape(*words)[2] == ""


def test_a_folder_that_holds_a_run_is_left_alone_and_the_other_one_named(document, bench, tmp_path):
    words = ("calibrate", "razor-shwfs", "--method", "docrime", "--out", tmp_path / "run")
    _, found, err = document(*words)
    assert (found["folder"], found["folder_asked"]) == (str(tmp_path / "run"), None)
    assert "left alone" not in err
    _, found, err = document(*words)
    assert (found["folder"], found["folder_asked"]) == (str(tmp_path / "run-2"), str(tmp_path / "run"))
    assert f"{tmp_path / 'run'} holds files already" in err
    assert str(tmp_path / "run-2") in err


def test_notes_of_a_loop_are_shown(escape, bench, im, tmp_path):
    bench.changes = {"notes": ("nobody looked through the telescope",)}
    assert "nobody looked" in escape("loop", "razor-shwfs", "--im", im, "--out", tmp_path / "run")[1]
