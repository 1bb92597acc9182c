"""Commands that read products."""

from __future__ import annotations

from pathlib import Path

import fake_results as fake
import pytest

from escape_hw.io.fits.loop import save_loop
from escape_hw.io.fits.matrix import save_matrix


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
