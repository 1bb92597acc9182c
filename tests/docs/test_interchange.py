"""The page on other software: code that works on its streams, and descriptions of real matrices."""

from __future__ import annotations

import shutil
import threading
from pathlib import Path

import numpy as np
import pytest
from command_line import document, escape
from pages import ROOT, blocks_of
from shared_data import shared_data

from escape_hw.io.fits.matrix import load_matrix
from escape_hw.io.interchange.milk.stream import MilkStream

__all__ = ["document", "escape"]

PAGE = ROOT / "docs" / "interchange.md"


def test_the_first_code_works_on_streams_of_milk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MILK_SHM_DIR", str(tmp_path))
    frames, commands = MilkStream.create("wfs", (48, 64), "uint16"), MilkStream.create("dm", (97,), "float32")
    stop = threading.Event()

    def publish() -> None:
        while not stop.wait(0.005):
            frames.write(np.full((48, 64), 7, np.uint16))

    writer = threading.Thread(target=publish, daemon=True)
    writer.start()
    found: dict[str, object] = {}
    try:
        exec(blocks_of(PAGE)[0].text, found)
    finally:
        stop.set()
        writer.join(10)
    assert found["frame"].data.shape == (48, 64)  # type: ignore[attr-defined]
    assert found["shape"][48] == 0.05  # type: ignore[index]
    assert commands.count > 1
    assert not commands.latest().data.any()
    for stream in (frames, commands):
        stream.close()


@pytest.mark.parametrize(
    ("system", "matrix", "shape"), [("dm97", "20230901150923", (1330, 97)), ("irtf", "imat.12x12", (232, 36))]
)
def test_measured_matrices_are_imported_as_the_page_says(
    system, matrix, shape, document, tmp_path, monkeypatch
) -> None:
    # The copies are this user's own, whoever owns the data.
    shutil.copytree(shared_data(system), tmp_path, dirs_exist_ok=True, copy_function=shutil.copyfile)
    tmp_path.chmod(0o700)
    monkeypatch.chdir(tmp_path)
    blocks = [block for block in blocks_of(PAGE) if block.language in ("toml", "python")]
    (described,) = (one.text for one in blocks if one.text.count(f'file = "{matrix}'))
    (bench,) = (one.text for one in blocks if one.text.startswith(f"# {system}.toml"))
    (rings,) = (one.text for one in blocks if "actuators.txt" in one.text and one.language == "python")
    exec(rings, {})
    for name, text in (("matrix", described), (system, bench)):
        (tmp_path / f"{name}.toml").write_text(text)
    code, _, err = document("import", "arrays", "matrix.toml", f"{system}.toml", "--out", "im.fits")
    assert code == 0, err
    found = load_matrix("im.fits").matrix
    assert found.data.shape == shape
    assert not found.simulated
