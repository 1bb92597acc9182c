"""Optical gains on disk, in documents, tables and figures."""

from __future__ import annotations

from dataclasses import replace

import fake_results as fake
import numpy as np
import pytest

from escape_hw.api.optical_gains import OpticalGains
from escape_hw.errors import ProductError
from escape_hw.io.documents import dumps, gains_document
from escape_hw.io.fits.gains import load_gains, save_gains
from escape_hw.io.fits.loop import load_loop
from escape_hw.report.figures import gains as figures_gains
from escape_hw.report.tables import rounds_table

N = 20


def same(one: OpticalGains, other: OpticalGains) -> None:
    for name in ("value", "sigma", "trend", "trend_sigma", "best", "best_sigma"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
    assert one.common_sigma == other.common_sigma


def test_a_product_gives_back_everything(tmp_path):
    made = fake.gains_result()
    path = save_gains(tmp_path / "gains.fits", made, "razor-pywfs", True, fake.ORIGIN)
    product = load_gains(path)
    found = product.result
    assert product.header["KIND"] == "OG"
    assert product.header["SIMULATE"]
    for one, other in zip(found.rounds, made.rounds, strict=True):
        same(one.gains, other.gains)
        assert repr(replace(one, gains=other.gains)) == repr(other)
    same(found.comparisons["DO-CRIME"], made.comparisons["DO-CRIME"])
    assert repr(found.closure) == repr(made.closure)
    for name in ("method", "converged", "loop_gain", "frames", "lost_frames", "partial", "notes"):
        assert getattr(found, name) == getattr(made, name), name


def test_an_aborted_bootstrap_without_a_round_is_saved_under_a_marked_name(tmp_path):
    made = replace(fake.gains_result(), rounds=(), comparisons={}, converged=False, partial=True)
    path = save_gains(tmp_path / "gains.fits", made, "razor-pywfs", True)
    assert path.name == "gains.partial.fits"
    found = load_gains(path).result
    assert found.partial
    assert found.gains is None
    assert len(found.closure) == 2


def test_another_kind_and_damage_are_refused(tmp_path):
    path = save_gains(tmp_path / "gains.fits", fake.gains_result(), "razor-pywfs", True)
    with pytest.raises(ProductError, match="its kind is 'OG'"):
        load_loop(path)
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)
    with pytest.raises(ProductError, match="damaged"):
        load_gains(path)


def test_the_document_has_the_documented_fields():
    document = gains_document(fake.gains_result())
    assert len(document["optical_gain"]) == len(document["sigma"]) == N
    assert document["converged"] is True
    assert [one["poke"] for one in document["rounds"]] == [0.004, 0.0004]
    assert document["rounds"][1]["strehl"]["peak"]["value"] == 0.3
    assert set(document["beside"]) == {"DO-CRIME"}
    assert dumps(document)
    nothing = gains_document(replace(fake.gains_result(), rounds=()))
    assert nothing["optical_gain"] is None
    assert nothing["rounds"] == []


def test_gains_on_both_sides_of_one_get_an_axis_each():
    both = figures_gains.optical_gains(fake.gains_result())
    assert len(both.axes) == 2
    labels = [text.get_text() for text in both.axes[0].get_legend().get_texts()]
    assert labels == ["ESCAPE (left)", "DO-CRIME (right)"]
    alone = figures_gains.optical_gains(replace(fake.gains_result(), comparisons={}))
    assert len(alone.axes) == 1
    # The mode without a measurement has no point.
    assert len(alone.axes[0].containers[0].lines[0].get_xdata()) == N - 1


def test_the_bootstrap_is_drawn_and_tabled_with_and_without_rounds():
    for one in (fake.gains_result(), replace(fake.gains_result(), rounds=())):
        figure = figures_gains.bootstrap(one)
        assert len(figure.axes[0].lines[0].get_xdata()) == 2
        assert len(rounds_table(one).rows) == len(one.rounds)
    row = rounds_table(fake.gains_result()).rows[1]
    assert row[1:3] == ("0.04", "9000")
    assert row[-1] == "30.0 ± 1.0"


def test_the_product_is_shown(escape, document, tmp_path):
    path = save_gains(tmp_path / "gains.fits", fake.gains_result(), "razor-pywfs", True)
    code, found, _ = document("show", path)
    assert code == 0
    assert found["converged"] is True
    assert len(found["optical_gain"]) == N
    assert "30.0 ± 1.0" in escape("show", path)[1]
