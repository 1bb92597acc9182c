"""Faults in the middle of a command: exit codes, one JSON document, a closed bench."""

from __future__ import annotations

import pytest
import typer

from escape_hw.cli.context import command_context
from escape_hw.errors import CalibrationError, DeviceLost


def test_device_fault_exits_3_and_closes_the_bench(document, bench, tmp_path):
    def lose(name: str) -> None:
        raise DeviceLost("wfs", "no frames any more; check the cable")

    bench.hook = lose
    code, found, err = document("calibrate", "razor-shwfs", "--out", tmp_path / "run")
    assert (code, found["error"]["type"]) == (3, "DeviceLost")
    assert "error: wfs: no frames any more" in err
    assert bench.benches[0].closed
    assert "DeviceLost" in (tmp_path / "run" / "run.log").read_text()


def test_failed_calibration_exits_1(document, bench, tmp_path):
    def fail(name: str) -> None:
        raise CalibrationError("the data cannot constrain the rotation")

    bench.hook = fail
    assert document("calibrate", "razor-shwfs", "--out", tmp_path / "run")[0] == 1


def test_too_little_memory_is_no_defect(document, bench, tmp_path):
    def fail(name: str) -> None:
        raise MemoryError("Unable to allocate 7 TiB")

    bench.hook = fail
    code, found, err = document("calibrate", "razor-shwfs", "--out", tmp_path / "run")
    assert (code, found["error"]["type"]) == (1, "MemoryError")
    assert "not enough memory (Unable to allocate 7 TiB); ask for fewer frames" in err
    assert bench.benches[0].closed


def test_defect_exits_3_with_its_traceback_in_the_log(document, bench, tmp_path):
    bench.hook = lambda name: 1 // 0
    code, found, err = document("calibrate", "razor-shwfs", "--out", tmp_path / "run")
    assert (code, found["error"]["type"]) == (3, "ZeroDivisionError")
    assert "run.log" in err
    assert "Traceback" not in err
    assert "Traceback" in (tmp_path / "run" / "run.log").read_text()


def test_the_traceback_of_a_defect_is_printed_once(capsys, caplog):
    with pytest.raises(typer.Exit) as ended, command_context("dm flat"):
        1 // 0  # noqa: B018
    assert ended.value.exit_code == 1
    assert capsys.readouterr().err.count("Traceback") == 1
    assert not caplog.records, "without a handler, Python prints them as well"


def test_disk_full_at_the_end_exits_1_after_the_mirror_is_safe(document, bench, tmp_path, monkeypatch):
    def fill(name: str) -> None:
        def full(handle: int) -> None:
            raise OSError(28, "No space left on device")

        monkeypatch.setattr("escape_hw.io.storage.os.fsync", full)

    bench.hook = fill
    code, found, _ = document("calibrate", "razor-shwfs", "--out", tmp_path / "run")
    assert (code, found["error"]["type"]) == (1, "StorageError")
    assert bench.benches[0].closed
    assert not list((tmp_path / "run").glob("*.fits"))
    assert not list((tmp_path / "run").glob(".*"))


def test_the_document_of_an_error_states_what_it_concerns(document, bench, tmp_path):
    def about(found: dict) -> tuple[object, ...]:
        return found["schema"], found["command"], found["system"], found["simulated"], found["seed"]

    def lose(name: str) -> None:
        raise DeviceLost("wfs", "no frames any more; check the cable")

    bench.hook = lose
    _, found, _ = document("calibrate", "razor-shwfs", "--out", tmp_path / "run", "--seed", 7)
    assert about(found) == (1, "calibrate", "razor-shwfs", True, 7)
    assert found["folder"] == str(tmp_path / "run")
    found = document("loop", "razor-shwfs", "--im", "absent.fits", "--mode", "hardware")[1]
    assert about(found) == (1, "loop", "razor-shwfs", False, 1)
    # Refused before it is known what the devices would be.
    found = document("calibrate", "razor-shwfs", "--set", "loop.gain=99", "--seed", 3)[1]
    assert about(found) == (1, "calibrate", "razor-shwfs", None, 3)
    assert about(document("calibrate", "razor-shwf")[1]) == (1, "calibrate", None, None, None)
    assert about(document("calibrate")[1]) == (1, "calibrate", None, None, None)
