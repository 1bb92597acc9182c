"""A recorded loop of the small bench, exported to AOT and milk and imported again on the command line."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import document, escape
from small_system import SMALL
from streams import published

from escape_hw.api.procedure import run
from escape_hw.bench import Bench
from escape_hw.calibration.push_pull.procedure import push_pull
from escape_hw.config.loader import load_system
from escape_hw.io.fits.matrix import load_matrix, save_matrix
from escape_hw.io.fits.telemetry import load_telemetry
from escape_hw.io.interchange.milk.stream import MilkStream
from escape_hw.io.provenance import Provenance

__all__ = ["document", "escape"]

SETS = [word for one in SMALL for word in ("--set", one)]
Command = Callable[..., tuple[int, dict[str, Any], str]]


@pytest.fixture(scope="module")
def im(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A matrix of the small bench."""
    config = load_system("razor-shwfs", overrides=SMALL)
    with Bench.from_config(config) as bench:
        assert bench.screen is not None
        bench.screen.set(inserted=False)
        result = run(push_pull(bench, frames=4))
    folder = tmp_path_factory.mktemp("im")
    return save_matrix(folder / "im.fits", result, Provenance(config.to_toml(), "kl"))


def test_a_recorded_loop_goes_to_aot_and_back(tmp_path: Path, im: Path, document: Command) -> None:
    pytest.importorskip("aotpy", reason="needs aotpy: pip install 'escape-hw[interchange]'")
    code, told, _ = document(
        "loop", "razor-shwfs", "--im", im, "--frames", 300, "--record", 200, "--no-strehl",
        "--out", tmp_path / "loop", *SETS,
    )  # fmt: skip
    assert code == 0, told
    record = load_telemetry(told["products"]["telemetry"]).result
    assert record.slopes.shape == (200, load_matrix(im).matrix.n_slopes)
    assert record.rate_hz == pytest.approx(500, rel=0.01)
    # In closed loop the next command holds what the slopes say of the last.
    assert np.abs(record.commands).max() > 1e-3
    assert not np.array_equal(record.commands[-1], np.zeros(37)), "the flat shape after the end is no answer"
    aot = tmp_path / "run.fits"
    code, told, _ = document("export", "aot", im, "--telemetry", told["products"]["telemetry"], "--out", aot)
    assert code == 0, told
    back, moves = tmp_path / "back.fits", tmp_path / "moves.fits"
    code, told, _ = document("import", "aot", aot, "razor-shwfs", "--out", back, "--telemetry", moves, *SETS)
    assert code == 0, told
    np.testing.assert_array_equal(load_matrix(back).matrix.data, load_matrix(im).matrix.data)
    np.testing.assert_array_equal(load_telemetry(moves).result.slopes, record.slopes)
    np.testing.assert_allclose(load_telemetry(moves).result.commands, record.commands, atol=1e-15)
    code, told, _ = document("show", moves)
    assert (code, told["frames"]) == (0, 200)
    code, told, _ = document("import", "aot", aot, "razor-shwfs", "--out", tmp_path / "x.fits")
    assert code == 2
    assert "has 37 actuators, that of system 'razor-shwfs' 97" in told["error"]["message"]


def test_a_matrix_goes_to_milk_and_streams_come_back(
    tmp_path: Path, im: Path, document: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MILK_SHM_DIR", str(tmp_path))
    code, told, _ = document("export", "milk", im, "razor")
    assert code == 0, told
    result = load_matrix(im).result
    wfs, dm = MilkStream.open("razor_wfs"), MilkStream.open("razor_dm")
    assert wfs.shape == (30, 24, 12)
    assert dm.shape == (30, 7, 7)
    mask = np.vstack([result.matrix.valid, result.matrix.valid])
    np.testing.assert_array_equal(wfs.latest().data[:, mask].T, result.matrix.data)
    wfs.close()
    dm.close()
    np.save(tmp_path / "array.npy", np.arange(6, dtype=np.float32).reshape(2, 3))
    assert document("export", "milk", tmp_path / "array.npy", "little")[0] == 0
    stream = MilkStream.open("little")
    with published(stream, lambda number: np.full((2, 3), number)):
        code, told, _ = document("import", "milk", "little", "--frames", 5, "--out", tmp_path / "little.npz")
    stream.close()
    assert code == 0, told
    with np.load(tmp_path / "little.npz") as found:
        assert (np.diff(found["count"]) >= 1).all()
        assert told["missed"] == np.ptp(found["count"]) + 1 - 5
        np.testing.assert_array_equal(found["data"][1:, 0, 0], found["count"][1:] - 1)
    code, told, _ = document("import", "milk", "nobody", "--out", tmp_path / "x.npz")
    assert code == 2
    assert "MILK_SHM_DIR" in told["error"]["message"]
    np.save(tmp_path / "text.npy", np.array(["a"]))
    assert document("export", "milk", tmp_path / "text.npy", "words")[0] == 2
