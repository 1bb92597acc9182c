"""Products are read back complete or refused with the failed check."""

from __future__ import annotations

import dataclasses
import errno
import math
import os
import resource
import subprocess
import sys
from datetime import UTC, datetime
from pathlib import Path

import fake_results as fake
import numpy as np
import pytest
from astropy.io import fits
from interchange_cases import pyramid

from escape_hw.api.results import Estimate
from escape_hw.errors import IncompatibleProduct, ProductError, StorageError
from escape_hw.io import provenance, storage
from escape_hw.io.fits import file as fits_file
from escape_hw.io.fits.loop import load_loop, save_loop
from escape_hw.io.fits.matrix import load_matrix, save_matrix
from escape_hw.io.provenance import Provenance

CONFIG = 'schema = 1\n[system]\nname = "razor-shwfs"  # µ\n'
ORIGIN = Provenance(
    config_text=CONFIG,
    basis="kl",
    seed=5,
    serials={"dm": "SIM97", "wfs": "SIMWFS"},
    parents={"docrime.fits": "ab" * 32},
    started=datetime(2026, 3, 1, 12, 0, tzinfo=UTC),
)


@pytest.fixture(scope="module")
def small() -> object:
    """A calibration small enough to be damaged thousands of times."""
    return fake.calibration("escape", n=6, n_modes=5)


@pytest.fixture
def saved(tmp_path, small):
    return save_matrix(tmp_path / "im.fits", dataclasses.replace(small, mean_frame=None), ORIGIN)


def test_matrix_comes_back_as_it_was(tmp_path):
    result = fake.calibration("escape")
    grid = dataclasses.replace(result.grid, numbering_offsets=((-1, 0), (0, 2)))
    result = dataclasses.replace(result, grid=grid)
    path = save_matrix(tmp_path / "new" / "im.fits", result, ORIGIN)
    product = load_matrix(path, expect_system="razor-shwfs", expect_modes=94, expect_actuators=97)
    for name in ("data", "sigma", "m2c", "valid"):
        stored, wanted = getattr(product.matrix, name), getattr(result.matrix, name)
        assert stored.dtype == wanted.dtype
        assert stored.dtype.isnative
        assert stored.flags.c_contiguous
        np.testing.assert_array_equal(stored, wanted)
    np.testing.assert_array_equal(product.result.measured.data, result.measured.data)
    assert product.result.measured.method == "docrime-whitened"
    metrics = dict(product.matrix.metrics)
    assert math.isnan(metrics.pop("lost"))
    assert metrics == {"frames": 10_000, "poke": 0.02, "delay": 2.1, "model": "fast"}
    assert isinstance(metrics["frames"], int)
    for part in dataclasses.fields(result.grid):
        stored, wanted = (getattr(grid, part.name) for grid in (product.grid, result.grid))
        assert np.any(wanted), part.name
        np.testing.assert_array_equal(stored, wanted, err_msg=part.name)
    assert product.registration.parameters() == result.registration.parameters()
    steps = [[dataclasses.asdict(step) for step in r.registration.iterations] for r in (product, result)]
    assert steps[0] == steps[1]
    assert product.registration.warnings == result.registration.warnings
    assert product.registration.extras == {}
    np.testing.assert_array_equal(product.registration.covariance, result.registration.covariance)
    mirrors = [dataclasses.asdict(r.registration.actuator_corrections) for r in (product, result)]
    np.testing.assert_equal(*mirrors)
    np.testing.assert_array_equal(product.result.response.weights, result.response.weights)
    np.testing.assert_array_equal(product.result.mean_frame, result.mean_frame)
    assert (product.result.frames, product.result.lost_frames) == (10_000, 7)
    assert product.result.sky_seconds == 20.0
    assert product.result.notes == result.notes
    assert product.config_text == CONFIG
    assert product.sha256 == provenance.file_sha256(path)


def test_what_was_fitted_beside_the_registration_comes_back(tmp_path):
    extras = {
        "anamorphosis": Estimate(1.5, 0.1, "% of the diameter"),
        "pupil_shift_x": Estimate(-3.0, 2.0, "% of a sub-aperture"),
    }
    plain = fake.calibration("escape")
    registration = dataclasses.replace(plain.registration, extras=extras)
    path = save_matrix(tmp_path / "im.fits", dataclasses.replace(plain, registration=registration), ORIGIN)
    assert load_matrix(path).registration.extras == extras


def test_header_states_the_origin(saved):
    header = fits.getheader(saved)
    wanted = {
        "KIND": "IM", "SCHEMA": 1, "SYSTEM": "razor-shwfs", "METHOD": "escape", "SIMULATE": True,
        "DEVICE1": "dm", "SERIAL1": "SIM97", "PARENT1": "docrime.fits", "PARSHA1": "ab" * 32,
        "DATE-OBS": "2026-03-01T12:00:00.000", "TIMESYS": "UTC", "SEED": 5, "FINISH": "complete",
        "BASIS": "kl",
    }  # fmt: skip
    assert {key: header[key] for key in wanted} == wanted
    assert header["SOFTVER"]
    assert header["GITSTATE"]
    assert fits.getheader(saved, "IM")["BUNIT"] == "pixel"
    with fits.open(saved, checksum=True) as hdus:
        hdus.verify("exception")
        assert all("CHECKSUM" in hdu.header and "DATASUM" in hdu.header for hdu in hdus)


def test_git_state_is_unknown_outside_a_checkout(tmp_path, monkeypatch):
    copy = tmp_path / "errors.py"
    copy.write_text("")
    monkeypatch.setattr(provenance.escape_hw.errors, "__file__", str(copy))
    provenance.get_git_state.cache_clear()
    assert provenance.get_git_state() == "unknown"
    monkeypatch.setenv("PATH", "")
    provenance.get_git_state.cache_clear()
    assert provenance.get_git_state() == "unknown"
    provenance.get_git_state.cache_clear()


@pytest.mark.parametrize("value", [1.5, math.inf, 3, 2**60, True, None, "µ 'quoted' ", [1, [2.5, "x"]], ""])
def test_metrics_keep_value_and_type(tmp_path, small, value):
    matrix = dataclasses.replace(small.matrix, metrics={"a key é": value})
    product = load_matrix(save_matrix(tmp_path / "im.fits", dataclasses.replace(small, matrix=matrix)))
    back = product.matrix.metrics["a key é"]
    assert back == value
    assert type(back) is type(value)


def test_no_metrics_no_steps_no_config(tmp_path, small):
    matrix = dataclasses.replace(small.matrix, metrics={})
    estimate = dataclasses.replace(small.registration, iterations=(), actuator_corrections=None)
    result = dataclasses.replace(small, matrix=matrix, registration=estimate, notes=())
    product = load_matrix(save_matrix(tmp_path / "im.fits", result))
    assert product.matrix.metrics == {}
    assert product.registration.iterations == ()
    assert product.registration.actuator_corrections is None
    assert product.config_text == ""


def test_nan_in_the_data_is_refused(tmp_path, small):
    data = small.matrix.data.copy()
    data[0, 0] = np.nan
    result = dataclasses.replace(small, matrix=dataclasses.replace(small.matrix, data=data))
    path = save_matrix(tmp_path / "im.fits", result)
    with pytest.raises(ProductError, match="IM holds values that are not finite"):
        load_matrix(path)


def test_a_matrix_without_standard_errors_comes_back(tmp_path, small):
    """A single push and pull of each mode gives none."""
    sigma = np.full_like(small.matrix.sigma, np.nan)
    result = dataclasses.replace(small, matrix=dataclasses.replace(small.matrix, sigma=sigma))
    product = load_matrix(save_matrix(tmp_path / "im.fits", result))
    assert np.isnan(product.matrix.sigma).all()


def test_matrix_and_grid_must_belong_together(tmp_path, small):
    with pytest.raises(ValueError, match="sub-apertures"):
        save_matrix(tmp_path / "im.fits", dataclasses.replace(small, grid=fake.grid(5)))


def test_an_aborted_run_is_marked_in_name_and_header(tmp_path):
    path = save_matrix(tmp_path / "im.fits", fake.calibration("docrime", partial=True, n=6, n_modes=5))
    assert path.name == "im.partial.fits"
    assert fits.getheader(path)["FINISH"] == "aborted"
    assert load_matrix(path).result.partial
    assert not (tmp_path / "im.fits").exists()


def test_loop_comes_back_as_it_was(tmp_path):
    result = fake.loop("docrime")
    product = load_loop(save_loop(tmp_path / "psf.fits", result, "razor-shwfs", True, ORIGIN))
    for field in dataclasses.fields(result):
        stored, wanted = getattr(product.result, field.name), getattr(result, field.name)
        if isinstance(wanted, np.ndarray):
            assert stored.dtype == wanted.dtype
            np.testing.assert_array_equal(stored, wanted)
        elif dataclasses.is_dataclass(wanted):
            assert dataclasses.asdict(stored) == dataclasses.asdict(wanted)
        else:
            assert stored == wanted
    bare = dataclasses.replace(result, strehl=None, psf=None, model_psf=None, last_frame=None, partial=True)
    path = save_loop(tmp_path / "bare.fits", bare, "razor-shwfs", True)
    assert path.name == "bare.partial.fits"
    assert load_loop(path).result.strehl is None
    assert load_loop(path).result.psf is None


def test_truncation_at_every_block_is_refused(saved, tmp_path):
    content = saved.read_bytes()
    cut = tmp_path / "cut.fits"
    for size in [0, 1, 100, *range(2880, len(content), 2880), len(content) - 1]:
        cut.write_bytes(content[:size])
        with pytest.raises(ProductError, match=r"cut\.fits: "):
            load_matrix(cut)


def test_truncated_file_with_a_valid_sum_is_refused(tmp_path, small):
    """Zeros add nothing to a sum: a computed matrix has no errors, and its last blocks may be all zero."""
    hdus = [
        fits_file.primary_hdu("IM", "s", True, False, ORIGIN),
        fits_file.image_extension("ZERO", np.zeros(5000, np.float32)),
    ]
    fits_file.write(tmp_path / "zero.fits", hdus)
    content = (tmp_path / "zero.fits").read_bytes()
    (tmp_path / "zero.fits").write_bytes(content[:-2880])
    with pytest.raises(ProductError, match=r"zero\.fits: "):
        fits_file.read(tmp_path / "zero.fits")


def test_lost_last_extension_is_refused(saved):
    with fits.open(saved) as hdus:
        end = hdus[-1]._header_offset
    content = saved.read_bytes()
    saved.write_bytes(content[:end])
    with pytest.raises(ProductError, match="HDUs"):
        load_matrix(saved)


def test_any_flipped_bit_is_refused(saved, tmp_path):
    """Several places in the header and the data of every HDU, each with a bit of its own."""
    content = saved.read_bytes()
    rng = np.random.default_rng(0)
    with fits.open(saved) as hdus:
        spans = [(h._header_offset, h._data_offset, h._data_offset + h._data_size) for h in hdus]
    places = []
    for head, data, end in spans:
        places += [head, head + 8, head + 85, *rng.integers(head, data, 6)]
        places += [] if end == data else [data, end - 1, *rng.integers(data, end, 3)]
    bad = tmp_path / "bad.fits"
    for place in places:
        for bit in (0, int(rng.integers(1, 8))):
            damaged = bytearray(content)
            damaged[int(place)] ^= 1 << bit
            bad.write_bytes(damaged)
            with pytest.raises(ProductError, match=r"bad\.fits: "):
                load_matrix(bad)


@pytest.mark.parametrize(
    "word", [b"CHECKSUM", b"DATASUM ", b"KIND    ", b"SCHEMA  ", b"END     ", b"NAXIS   "]
)
def test_flips_in_the_words_that_guard_are_refused(saved, word):
    content = saved.read_bytes()
    place = content.index(word)
    for byte in range(len(word)):
        damaged = bytearray(content)
        damaged[place + byte] ^= 2
        saved.write_bytes(damaged)
        with pytest.raises(ProductError):
            load_matrix(saved)


def test_missing_extension_is_named(saved):
    with fits.open(saved) as hdus:
        kept = [hdu.copy() for hdu in hdus if hdu.name != "SIGMA"]
    fits_file.write(saved, kept)
    with pytest.raises(ProductError, match="SIGMA is missing"):
        load_matrix(saved)


def test_newer_schema_is_refused(saved):
    with fits.open(saved) as hdus:
        kept = [hdu.copy() for hdu in hdus]
    kept[0].header["SCHEMA"] = 2
    fits_file.write(saved, kept)
    with pytest.raises(ProductError, match="newer version"):
        load_matrix(saved)


def test_wrong_kind_and_foreign_files(tmp_path):
    path = save_loop(tmp_path / "psf.fits", fake.loop(), "razor-shwfs", True)
    with pytest.raises(ProductError, match="kind is 'PSF'"):
        load_matrix(path)
    foreign = tmp_path / "foreign.fits"
    fits.PrimaryHDU(np.zeros((4, 4))).writeto(foreign)
    with pytest.raises(ProductError, match="no checksum"):
        load_matrix(foreign)
    fits.PrimaryHDU(np.zeros((4, 4))).writeto(foreign, checksum=True, overwrite=True)
    with pytest.raises(ProductError, match="not an ESCAPE product"):
        load_matrix(foreign)
    text = tmp_path / "text.fits"
    text.write_text("hello")
    with pytest.raises(ProductError, match="not a FITS file"):
        load_matrix(text)
    with pytest.raises(ProductError, match="cannot be read"):
        load_matrix(tmp_path / "absent.fits")
    with pytest.raises(ProductError, match="cannot be read"):
        load_matrix(tmp_path)


@pytest.mark.parametrize(
    ("expectation", "words"),
    [
        ({"expect_system": "maps-vis"}, "system is 'razor-shwfs'; 'maps-vis' is needed"),
        ({"expect_basis": "zonal"}, "basis is 'kl'"),
        ({"expect_modes": 94}, "number of modes is 5"),
        ({"expect_actuators": 277}, "number of actuators is 97"),
        ({"expect_m2c": np.zeros((97, 5))}, "basis differs"),
        ({"expect_m2c": np.zeros((97, 6))}, "shape of the basis"),
        ({"expect_sub_apertures": (24, 24)}, "grid of sub-apertures"),
        ({"expect_sensor": "pyramid"}, "kind of sensor is 'shack-hartmann'"),
        ({"allow_simulated": False}, "made in simulation"),
    ],
)
def test_matrix_of_another_system_is_refused(saved, expectation, words):
    with pytest.raises(IncompatibleProduct, match=words):
        load_matrix(saved, **expectation)


def test_matching_expectations_pass(saved, small):
    load_matrix(saved, expect_system="razor-shwfs", expect_basis="kl", expect_m2c=small.matrix.m2c)


def assert_old_one_stands(path: Path, before: bytes) -> None:
    assert path.read_bytes() == before
    assert [p.name for p in path.parent.iterdir()] == [path.name]


@pytest.mark.parametrize("call", ["write", "fsync"])
def test_full_disk_leaves_the_old_product(saved, small, monkeypatch, call):
    before = saved.read_bytes()
    real = os.write
    written = 0

    def full(handle: int, *data: bytes) -> int:
        nonlocal written
        if call == "write" and not written:
            written = real(handle, data[0][:5000])
            return written
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(storage.os, call, full)
    with pytest.raises(StorageError, match=r"im\.fits: .*No space left.*choose another folder"):
        save_matrix(saved, small)
    monkeypatch.undo()
    assert_old_one_stands(saved, before)


def test_little_space_is_refused_before_writing(saved, small, monkeypatch):
    before = saved.read_bytes()
    usage = storage.shutil.disk_usage(saved.parent)
    monkeypatch.setattr(storage.shutil, "disk_usage", lambda folder: usage._replace(free=1000))
    with pytest.raises(StorageError, match="MB free"):
        save_matrix(saved, small)
    assert_old_one_stands(saved, before)


def test_limit_set_by_the_system_leaves_the_old_product(saved, small):
    """The operating system itself refuses in the middle of the file."""
    before = saved.read_bytes()
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, hard))
    try:
        with pytest.raises(StorageError, match=r"im\.fits"):
            save_matrix(saved, small)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert_old_one_stands(saved, before)


def test_no_permission_names_the_path(small, monkeypatch, tmp_path):
    def refuse(**_: object) -> tuple[int, str]:
        raise PermissionError(errno.EACCES, "Permission denied")

    monkeypatch.setattr(storage.tempfile, "mkstemp", refuse)
    with pytest.raises(StorageError, match=r"im\.fits: .*choose another folder"):
        save_matrix(tmp_path / "im.fits", small)
    (tmp_path / "file").write_text("")
    with pytest.raises(StorageError, match="file"):
        save_matrix(tmp_path / "file" / "im.fits", small)


def test_killed_writer_leaves_the_old_product(saved):
    """A process that dies between two writes leaves no half product under the final name."""
    before = saved.read_bytes()
    script = (
        "import os, sys, pathlib\n"
        "from escape_hw.io import storage\n"
        "storage.os.fsync = lambda handle: os._exit(9)\n"
        "storage.write_atomic(pathlib.Path(sys.argv[1]), b'half')\n"
    )
    done = subprocess.run([sys.executable, "-c", script, str(saved)], env=os.environ, check=False)
    assert done.returncode == 9
    assert saved.read_bytes() == before


@pytest.mark.parametrize("known", [True, False])
def test_the_mean_wavefront_of_a_pyramid_is_read_back(tmp_path: Path, known: bool) -> None:
    result = pyramid()
    if not known:  # as in files of earlier versions
        result = dataclasses.replace(result, grid=dataclasses.replace(result.grid, mean_low_orders=None))
    back = load_matrix(save_matrix(tmp_path / "im.fits", result)).result.grid
    want = result.grid.mean_low_orders
    assert back.mean_low_orders == (pytest.approx(want) if known else None)
