"""Commands that read products."""

from __future__ import annotations

from pathlib import Path

import fake_results as fake
import numpy as np
import pytest

from escape_hw.api.offsets import Offsets
from escape_hw.errors import ProductError
from escape_hw.io import documents
from escape_hw.io.fits import file as fits_file
from escape_hw.io.fits.loop import save_loop
from escape_hw.io.fits.matrix import save_matrix
from escape_hw.io.fits.offsets import save_offsets
from escape_hw.io.fits.pixels import save_pixels
from escape_hw.io.run_folder import RunFolder
from escape_hw.report.content import read_product


def test_show_and_compare(escape, document, im, tmp_path):
    assert "SHA-256" in escape("show", im)[1]
    assert "SNR" in escape("show", im)[1]
    code, found, _ = document("show", im)
    assert (code, found["header"]["KIND"], found["metrics"]["poke"]) == (0, "IM", 0.02)
    psf = save_loop(tmp_path / "psf.fits", fake.loop(), "razor-shwfs", True, fake.ORIGIN)
    assert document("show", psf)[1]["strehl"]["peak"]["value"] == 0.62
    other = save_matrix(tmp_path / "b.fits", fake.calibration("push-pull"), fake.ORIGIN)
    code, found, _ = document("compare", im, other)
    assert code == 0
    assert len(found["correlation"]) == 94
    assert found["correlation"][50] > 0.99
    assert found["registration_difference"] is None
    assert set(found["optical_gain"]) == {"deviation_ratio", "projection"}
    for one in found["optical_gain"].values():
        assert len(one["value"]) == len(one["sigma"]) == 94
        assert one["value"][50] == pytest.approx(found["gain_ratio"][50], rel=0.05)
    assert "relative rms difference" in escape("compare", im, im)[1]


def test_a_model_that_does_not_fit_is_shown(escape, document, tmp_path):
    poor = save_matrix(tmp_path / "poor.fits", fake.calibration(fits=False), fake.ORIGIN)
    found = document("show", poor)[1]
    assert found["converged"]
    assert found["model_fits"] is False
    assert found["outcome"] == "converged, but the model does not fit"
    code, text, _ = escape("show", poor)
    words = " ".join(text.split())
    assert code == 0
    assert "Usable: converged, but the model does not fit (14% of the matrix" in words
    assert "the model does not fit: 14% of the matrix remain" in words
    good = save_matrix(tmp_path / "good.fits", fake.calibration(), fake.ORIGIN)
    assert document("show", good)[1]["model_fits"] is True
    assert "does not fit" not in escape("show", good)[1]


@pytest.mark.usefixtures("reports")
def test_report_is_built_again_after_the_folder_has_moved(escape, document, tmp_path):
    run = Path(
        document("calibrate", "razor-shwfs", "--method", "docrime", "--out", tmp_path / "run")[1]["folder"]
    )
    before = (run / "report.html").read_text()
    moved = run.rename(tmp_path / "moved")
    (moved / "report.html").unlink()
    code, found, _ = document("report", moved)
    assert (code, found["report"]) == (0, str(moved / "report.html"))
    # The run's log, shown in the report, has grown since; the figures are the same to the byte.
    assert (moved / "report.html").read_text().split("<h2>Origin")[0] == before.split("<h2>Origin")[0]
    again = document("show", moved)[1]
    assert again["command"] == "calibrate"
    verdict = again["verdict"]
    assert verdict["quality"] in ("good", "usable", "not usable")
    assert f"{verdict['quality'].capitalize()}: {verdict['reason']}" in escape("show", moved)[1]
    # A calibration alone has no image to draw.
    code, _, err = escape("report", moved, "--picture", tmp_path / "picture.png")
    assert code == 2
    assert "holds no matrix or no closed-loop image" in err


IMAGE = np.linspace(0.5, 1.5, 12, dtype=np.float32).reshape(3, 4)
OFFSETS = Offsets({"focus": 20.0}, np.zeros(5), np.zeros((2, 6, 7), np.float32), np.full(97, -0.02))


def write_screen(path: Path) -> Path:
    head = fits_file.primary_hdu(fits_file.KIND_SCREEN, "razor-shwfs", True, False, fake.ORIGIN)
    head.header["PANEL"] = "psf"
    fits_file.write(path, [head, fits_file.image_extension("IMAGE", IMAGE, "count")])
    return path


#: How a product without results of a calibration is written, and lines of its summary.
WITHOUT_RESULTS = {
    "DARK": (
        lambda path: save_pixels(path, "DARK", IMAGE, "razor-shwfs", True, fake.ORIGIN),
        "dark frame of 4 x 3 pixels: mean 1 counts, scatter 0.3138 counts rms, 0.5 to 1.5 counts",
    ),
    "FLAT": (
        lambda path: save_pixels(path, "FLAT", IMAGE, "razor-shwfs", True, fake.ORIGIN),
        "relative response of 4 x 3 pixels: mean 1, scatter 0.3138 rms, 0.5 to 1.5",
    ),
    "OFFSETS": (
        lambda path: save_offsets(path, OFFSETS, "razor-shwfs", True, fake.ORIGIN),
        "focus: 20 nm rms wavefront\noffset of the reference slopes: of 7 x 6 sub-apertures\n"
        "flat shape: 97 actuators, at most 0.02 of full stroke\n",
    ),
    "SCREEN": (write_screen, "exported from the panel 'psf' of the window\nIMAGE: [3, 4] count\n"),
}


@pytest.mark.parametrize("kind", WITHOUT_RESULTS)
def test_products_without_results_are_summarised_by_show_only(escape, document, tmp_path, kind):
    write, lines = WITHOUT_RESULTS[kind]
    file = write(tmp_path / "one.fits")
    code, text, _ = escape("show", file)
    assert code == 0
    assert lines in text
    assert document("show", file)[1]["header"]["KIND"] == kind
    with pytest.raises(ProductError, match=f"its kind is '{kind}', .*'escape show .*one.fits' summarises it"):
        read_product(file)
    code, _, err = escape("report", file)
    assert code == 2
    assert "a report is built of the folder of a run; 'escape show" in err


def test_a_run_of_a_few_numbers_is_shown_and_reported(escape, tmp_path):
    with RunFolder("razor-shwfs", "dark", tmp_path / "run") as run:
        path = save_pixels(run.file("dark.fits"), "DARK", IMAGE, "razor-shwfs", True, fake.ORIGIN)
        run.add_product("dark", path)
        header = documents.header_fields("dark", "razor-shwfs", True, 1)
        run.write_result({**header, "title": "Dark frame", "mean": 1.0, "scatter": 0.25})
    assert "dark frame: mean 1 counts, scatter 0.25 counts rms over the pixels" in escape("show", run.path)[1]
    code, text, _ = escape("report", run.path)
    assert (code, text.startswith("report: ")) == (0, True)
    run.write_result({**header, "title": "Dark frame", "mean": "one"})
    code, _, err = escape("show", run.path)
    assert code == 2
    assert "the result of 'dark' is damaged" in err
