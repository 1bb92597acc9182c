"""A run folder or a product as a data source for panels."""

from __future__ import annotations

import shutil

import numpy as np
import pytest
import recorded_run

from escape_gui.client.product_library import ProductLibrary
from escape_gui.replay.source import ReplaySource
from escape_hw.api.registration import TO_STREAM_UNITS
from escape_hw.errors import ProductError
from escape_hw.remote.source import STREAMS
from escape_hw.remote.state import Phase, ProductEntry


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return recorded_run.make_run(tmp_path_factory.mktemp("recorded") / "run")


@pytest.fixture
def library():
    library = ProductLibrary()
    yield library
    library.close()


def read_all(library):
    while not all(one.done() for one in library._futures.values()):
        pass
    return library.loaded


def test_a_run_fills_the_streams(folder):
    source = ReplaySource(folder)
    truth = recorded_run.calibration("escape")
    held = {entry.name for entry in source.state.streams}
    assert held <= set(STREAMS)
    assert {"matrix", "valid", "registration", "gains", "psf", "model_psf", "commands"} <= held
    np.testing.assert_array_equal(source.latest("matrix").data, truth.measured.data)
    np.testing.assert_array_equal(source.latest("valid").data, truth.grid.valid)
    last = source.latest("registration").data[-1] / TO_STREAM_UNITS
    np.testing.assert_allclose(last, truth.registration.registration.to_array())
    np.testing.assert_allclose(
        source.latest("registration_sigma").data / TO_STREAM_UNITS, truth.registration.sigma
    )
    assert source.latest("gains_rounds").data.shape == (2, recorded_run.N_MODES)
    assert source.latest("slopes") is None
    geometry = source.geometry()
    assert len(geometry.outlines_px) == truth.grid.n_valid
    assert len(geometry.layout) == 11
    state = source.state
    assert (state.system, state.simulated, state.phase) == ("razor-shwfs", True, Phase.STOPPED)
    assert state.last_run.document["converged"] is True
    assert [one.name for one in state.products][-1] == "escape"
    assert any("product escape" in line.text for line in source.log_after(-1))
    assert source.log_after(10_000) == ()


def test_a_run_goes_by_step_by_step(folder):
    source = ReplaySource(folder)
    seen = source.latest("registration").index
    assert source.latest("registration", seen) is None
    source.seek(0.5)
    half = source.latest("registration", seen)
    assert len(half.data) == 9
    assert np.isnan(source.latest("registration_sigma").data).all()
    assert len(source.latest("gains_rounds").data) == 1
    assert len(source.latest("registration_track").data) == 25
    source.seek(-3)
    assert len(source.latest("registration").data) == 1
    source.seek(7)
    assert len(source.latest("registration", half.index).data) == source.latest("step_norm").data.size == 18


def test_a_single_product_is_a_run_of_its_own(folder):
    source = ReplaySource(folder / "escape.fits")
    assert source.state.last_run.document["method"] == "escape"
    assert source.latest("registration") is not None
    assert ReplaySource(folder / "gains.fits").latest("gains").data.shape == (recorded_run.N_MODES,)
    assert ReplaySource(folder / "loop.fits").state.loop.strehl == pytest.approx(0.62)


def test_nothing_can_be_started(folder):
    source = ReplaySource(folder)
    assert source.procedures() == ()


def test_what_is_no_run_is_refused(folder, tmp_path):
    with pytest.raises(ProductError, match=r"result\.json"):
        ReplaySource(tmp_path)
    broken = tmp_path / "im.fits"
    broken.write_bytes((folder / "escape.fits").read_bytes()[:-2880])
    with pytest.raises(ProductError, match=r"im\.fits"):
        ReplaySource(broken)


def test_the_library_reads_each_matrix_once(folder, library):
    source = ReplaySource(folder)
    library.request(source.state.products)
    loaded = read_all(library)
    assert list(loaded.matrices) == ["push-pull", "DO-CRIME", "ESCAPE"]
    assert list(loaded.gains) == ["ESCAPE", "DO-CRIME"]
    library.request(source.state.products)
    assert library.loaded is loaded


def test_the_library_reports_what_it_cannot_read(folder, library, tmp_path, caplog):
    damaged = tmp_path / "bad.fits"
    shutil.copy(folder / "escape.fits", damaged)
    damaged.write_bytes(damaged.read_bytes()[:-2880])
    names = (("good", folder / "push_pull.fits"), ("bad", damaged), ("gone", tmp_path / "no.fits"))
    library.request(tuple(ProductEntry(name=name, kind="matrix", path=str(path)) for name, path in names))
    loaded = read_all(library)
    assert list(loaded.matrices) == ["push-pull"]
    assert [record.levelname for record in caplog.records] == ["ERROR", "ERROR"]
    assert "bad.fits" in caplog.text
    assert "no.fits" in caplog.text


def test_a_product_written_again_is_read_again(folder, library, tmp_path):
    path = tmp_path / "im.fits"
    shutil.copy(folder / "push_pull.fits", path)
    product = (ProductEntry(name="im", kind="matrix", path=str(path)),)
    library.request(product)
    assert list(read_all(library).matrices) == ["push-pull"]
    path.unlink()
    shutil.copyfile(folder / "docrime_whitened.fits", path)
    library.request(product)
    assert list(read_all(library).matrices) == ["DO-CRIME"]
