"""Calibration files of pyRTC, written and read; see also the tests with pyRTC itself."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from interchange_cases import FACTS, SHAPE, add_frame, lenslets, pyramid, target

from escape_hw.api.pyramid import PyramidPupils
from escape_hw.api.results import CalibrationResult
from escape_hw.api.sensor import SubApertureGrid
from escape_hw.errors import ConfigError, IncompatibleProduct, ProductError
from escape_hw.io.fits.matrix import load_matrix, save_matrix
from escape_hw.io.interchange import optional_packages
from escape_hw.io.interchange.pyrtc.calibration import (
    FrameSettings,
    PyrtcConfig,
    convert_basis,
    export_matrix,
    import_matrix,
)
from escape_hw.io.interchange.pyrtc.files import (
    MATRIX,
    VALID,
    LegacyConvention,
    read_file,
    write_array,
    write_file,
)
from escape_hw.io.interchange.pyrtc.geometry import PyrtcLenslets, PyrtcPupils
from escape_hw.pipeline.slopes.pyramid import slopes_of_image

yaml = pytest.importorskip("yaml")


def there_and_back(folder: Path, result: CalibrationResult, shape: tuple[int, int]) -> CalibrationResult:
    paths = export_matrix(folder, result, FrameSettings(shape, 12.0))
    whole = folder / "whole.yaml"
    whole.write_text(add_frame(paths["settings"].read_text(), shape))
    return import_matrix(PyrtcConfig.read(whole), target(result))


def test_a_shack_hartmann_matrix_comes_back_as_it_was(tmp_path: Path) -> None:
    result = lenslets()
    back = there_and_back(tmp_path, result, SHAPE)
    np.testing.assert_array_equal(back.matrix.data, result.matrix.data)
    np.testing.assert_array_equal(back.matrix.sigma, result.matrix.sigma)
    np.testing.assert_array_equal(back.matrix.m2c, result.matrix.m2c)
    assert isinstance(back.grid, SubApertureGrid)
    assert isinstance(result.grid, SubApertureGrid)
    np.testing.assert_array_equal(back.grid.valid, result.grid.valid)
    spots = [one.centres_px() + one.references_px for one in (back.grid, result.grid)]
    np.testing.assert_allclose(spots[0], spots[1], atol=1e-5)
    assert back.matrix.method == "docrime"
    assert back.matrix.simulated, "what was simulated stays so, whatever the system is"


def test_a_pyramid_matrix_comes_back_with_dark_pixels_at_zero(tmp_path: Path) -> None:
    result = pyramid()
    back = there_and_back(tmp_path, result, (48, 48))
    assert isinstance(back.grid, PyramidPupils)
    assert isinstance(result.grid, PyramidPupils)
    disk, ours = back.grid.valid, result.grid.valid
    both = ours & disk
    assert both.sum() > 0.9 * ours.sum()
    for part in ("data", "sigma"):
        maps = [np.zeros((2, *disk.shape, 20), np.float32) for _ in range(2)]
        for image, (mask, rows) in zip(
            maps, ((disk, getattr(back.matrix, part)), (ours, getattr(result.matrix, part))), strict=True
        ):
            image[:, mask] = rows.reshape(2, -1, 20)
        np.testing.assert_array_equal(maps[0][:, both], maps[1][:, both])
        assert not maps[0][:, disk & ~ours].any()
    np.testing.assert_array_equal(back.grid.corners_px, result.grid.corners_px)


@pytest.mark.parametrize("order", [(0, 2, 1, 3), (3, 1, 2, 0), (1, 0, 3, 2), (0, 1, 2, 3)])
def test_pyramid_slopes_of_any_order_of_pupils_have_our_signs(order: tuple[int, ...]) -> None:
    result = pyramid()
    pupils = result.grid
    assert isinstance(pupils, PyramidPupils)
    centres = pupils.corners_px + 8
    images = PyrtcPupils(tuple((int(centres[k, 0]), int(centres[k, 1])) for k in order), 8)
    frame = np.random.default_rng(5).poisson(300, (48, 48))
    parts = [
        frame[y : y + 16, x : x + 16][images.disk()].astype(float)
        for x, y in (images.corners()[k] for k in range(4))
    ]
    mean = np.mean(sum(parts))
    theirs = np.concatenate([parts[0] + parts[1] - parts[2] - parts[3],
                             parts[0] + parts[2] - parts[1] - parts[3]]) / mean  # fmt: skip
    found, rows, signs = images.pupils(np.zeros((16, 32)), 16)
    np.testing.assert_allclose(theirs[rows] * signs, slopes_of_image(frame, found), atol=1e-12)


def test_pupils_across_make_no_slopes() -> None:
    images = PyrtcPupils(((8, 8), (40, 40), (40, 8), (8, 40)), 8)
    with pytest.raises(IncompatibleProduct, match="stand across"):
        images.pupils(np.zeros((16, 32)), 16)


def test_windows_are_where_pyrtc_reads_them() -> None:
    windows = PyrtcLenslets(15.54, 19, 6, SHAPE)
    assert (windows.window, windows.n) == (16, 25)
    # The window over lenslet 3 begins at round(46.62) + 19 and is 16 wide.
    assert windows.centres()[0][3] == 47 + 19 + 7.5
    assert not windows.windows_on_frame()[:, 24].any(), "it would end beyond the frame"


def test_a_grid_beyond_the_frame_is_refused() -> None:
    grid = lenslets().grid
    assert isinstance(grid, SubApertureGrid)
    with pytest.raises(IncompatibleProduct, match="read a larger region"):
        PyrtcLenslets.from_grid(grid, (385, 400))
    with pytest.raises(IncompatibleProduct, match="lie beyond"):
        PyrtcLenslets.from_grid(grid, (200, 200))


def test_a_mask_whose_place_is_undecided_is_reported() -> None:
    windows = PyrtcLenslets(8.0, 0, 0, (80, 80))
    mask = np.zeros((20, 10), bool)
    mask[1:6, 2:7] = mask[11:16, 2:7] = True
    grid, _, note = windows.grid(mask, np.zeros((20, 10)), 8)
    assert note is not None
    assert "half a sub-aperture" in note
    assert grid.n_valid == 25
    assert windows.grid(mask, np.zeros((20, 10)), 7)[2] is None


def test_other_modes_of_the_same_span() -> None:
    matrix = lenslets().matrix
    turn = np.random.default_rng(0).standard_normal((94, 5))
    other = convert_basis(matrix, matrix.m2c @ turn)
    np.testing.assert_allclose(other.data, matrix.data @ turn, rtol=1e-3, atol=1e-3)
    reason = r"not a linear combination of the matrix's 94 modes.*basis.n_modes=97"
    with pytest.raises(IncompatibleProduct, match=reason):
        convert_basis(matrix, np.eye(97))


# ------------------------------------------------------------------ files


def test_files_are_read_whatever_their_name(tmp_path: Path) -> None:
    data = np.arange(6.0).reshape(3, 2)
    for name in ("im.npy", "im", "im.npz"):
        path = write_file(tmp_path / name, data, MATRIX, {"frames": 5})
        found = read_file(path, MATRIX)
        np.testing.assert_array_equal(found.data, data)
        assert found.record is not None
        assert found.record["frames"] == 5
        assert found.record["format"] == 2


def test_damaged_and_foreign_files_are_typed_errors(tmp_path: Path) -> None:
    with pytest.raises(ProductError, match="cannot be read"):
        read_file(tmp_path / "none.npy")
    (tmp_path / "text.npy").write_text("hello")
    with pytest.raises(ProductError, match="damaged"):
        read_file(tmp_path / "text.npy")
    whole = write_file(tmp_path / "im.npz", np.zeros((4, 4)), MATRIX).read_bytes()
    for cut in (10, len(whole) // 2, len(whole) - 30):
        (tmp_path / "cut.npz").write_bytes(whole[:cut])
        with pytest.raises(ProductError):
            read_file(tmp_path / "cut.npz")
    with pytest.raises(IncompatibleProduct, match="'interaction_matrix'; 'valid_sub_aps' is needed"):
        read_file(tmp_path / "im.npz", VALID)
    record = json.dumps({"format": 3, "kind": MATRIX, "pyrtc_version": "9.9"})
    np.savez(tmp_path / "new.npz", data=np.zeros(2), pyrtc_calibration=np.array(record))
    with pytest.raises(ProductError, match=r"format 3, written by pyRTC 9.9"):
        read_file(tmp_path / "new.npz")
    np.savez(tmp_path / "two.npz", a=np.zeros(2), b=np.zeros(2))
    with pytest.raises(ProductError, match="without a record"):
        read_file(tmp_path / "two.npz")


def _old_files(folder: Path, result: CalibrationResult) -> PyrtcConfig:
    """Files as pyRTC 1.x wrote them, behind a camera adapter that transposed frames."""
    paths = export_matrix(folder, result, FACTS)
    mask = read_file(paths["valid"]).data
    n = mask.shape[1]
    # x and y, rows and columns change places; the transformation is its own inverse.
    old_mask = np.vstack([mask[n:].T, mask[:n].T])
    numbers = np.full(mask.shape, -1)
    numbers[mask] = np.arange(int(mask.sum()))
    old_numbers = np.vstack([numbers[n:].T, numbers[:n].T])
    write_array(folder / "valid_sub_aps.npz", old_mask)
    write_array(folder / "im.npz", read_file(paths["im"]).data[old_numbers[old_mask]])
    references = read_file(paths["references"]).data
    write_array(folder / "ref_slopes.npz", np.vstack([references[n:].T, references[:n].T]) - 0.5)
    whole = folder / "whole.yaml"
    whole.write_text(add_frame(paths["settings"].read_text(), SHAPE))
    return PyrtcConfig.read(whole)


def test_files_of_1x_are_read_with_a_given_orientation(tmp_path: Path) -> None:
    result = lenslets()
    config = _old_files(tmp_path, result)
    with pytest.raises(IncompatibleProduct, match="--frame-order yx"):
        import_matrix(config, target(result))
    with pytest.raises(ConfigError, match="it is one of yx, xy, as_is"):
        import_matrix(config, target(result), frame_order="zz")
    back = import_matrix(config, target(result), frame_order="xy")
    np.testing.assert_array_equal(back.matrix.data, result.matrix.data)
    np.testing.assert_array_equal(back.grid.valid, result.grid.valid)
    assert isinstance(back.grid, SubApertureGrid)
    assert isinstance(result.grid, SubApertureGrid)
    spots = [one.centres_px() + one.references_px for one in (back.grid, result.grid)]
    np.testing.assert_allclose(spots[0], spots[1], atol=1e-5)
    assert back.matrix.metrics["pyrtc_version"] == "1.x"


def test_configurations_of_1x_spell_their_keys_in_one_word(tmp_path: Path) -> None:
    result = lenslets()
    config = _old_files(tmp_path, result)
    names = {"im_file": "IMFile", "m2c_file": "m2cFile", "sub_ap_spacing": "subApSpacing",
             "sub_ap_offset_x": "subApOffsetX", "sub_ap_offset_y": "subApOffsetY",
             "valid_sub_aps_file": "validSubApsFile", "ref_slopes_file": "refSlopesFile"}  # fmt: skip
    text = config.path.read_text()
    for new, old in names.items():
        text = text.replace(f"{new}:", f"{old}:")
    config.path.write_text(text)
    old_config = PyrtcConfig.read(config.path)
    assert old_config.old
    assert not config.old
    assert old_config.slopes == config.slopes
    back = import_matrix(old_config, target(result), frame_order="xy")
    np.testing.assert_array_equal(back.matrix.data, result.matrix.data)


def test_pupils_of_1x_are_rows_and_columns(tmp_path: Path) -> None:
    result = pyramid()
    assert isinstance(result.grid, PyramidPupils)
    paths = export_matrix(tmp_path, result, FrameSettings((48, 48), 0.0))
    write_array(paths["im"], read_file(paths["im"]).data)
    write_array(paths["references"], read_file(paths["references"]).data)
    found = yaml.safe_load(paths["settings"].read_text())
    rows = [",".join(reversed(entry.split(","))) for entry in found["slopes"]["pupils"]]
    found["slopes"] |= {"pupils": rows, "pupilsRadius": found["slopes"].pop("pupils_radius")}
    whole = tmp_path / "whole.yaml"
    whole.write_text(yaml.safe_dump({**found, "wfs": {"width": 48, "height": 48}}))
    back = import_matrix(PyrtcConfig.read(whole), target(result), frame_order="yx")
    assert isinstance(back.grid, PyramidPupils)
    np.testing.assert_array_equal(back.grid.corners_px, result.grid.corners_px)


def test_even_windows_of_1x_were_half_a_pixel_off() -> None:
    zeros = np.zeros((4, 2))
    assert (LegacyConvention("yx", window=8).references(zeros) == 0.5).all()
    assert (LegacyConvention("yx", window=7).references(zeros) == 0).all()
    assert (LegacyConvention("as_is", window=8).references(zeros) == 0).all()


def test_what_does_not_fit_the_system_is_refused(tmp_path: Path) -> None:
    result = lenslets()
    paths = export_matrix(tmp_path, result, FACTS)
    whole = tmp_path / "whole.yaml"
    text = add_frame(paths["settings"].read_text(), SHAPE)
    whole.write_text(text)
    config = PyrtcConfig.read(whole)
    small = target(result)
    with pytest.raises(IncompatibleProduct, match=r"sensor\.n_sub of the system is 20"):
        import_matrix(config, type(small)("a", small.kind, 20, 97, False))
    with pytest.raises(IncompatibleProduct, match=r"\(69, 94\) belongs to system 'a'"):
        import_matrix(config, type(small)("a", small.kind, 24, 69, False))
    with pytest.raises(IncompatibleProduct, match=r"sensor\.kind = 'pyramid'"):
        import_matrix(config, type(small)("a", "pyramid", 24, 97, False))
    whole.write_text(text.replace("m2c_file: m2c.npy", "basis: {type: kl}"))
    with pytest.raises(IncompatibleProduct, match=r"name the file in wfc\.m2c_file"):
        import_matrix(PyrtcConfig.read(whole), small)
    whole.write_text("a: [1")
    with pytest.raises(ProductError, match="not YAML"):
        PyrtcConfig.read(whole)
    whole.write_text("loop: {}")
    with pytest.raises(ProductError, match="no section 'slopes'"):
        PyrtcConfig.read(whole)


def test_a_missing_package_names_the_remedy() -> None:
    with pytest.raises(ConfigError, match=r"'no_such_package'.*pip install 'escape-hw\[interchange\]'"):
        optional_packages.import_optional("no_such_package", "Reading nothing")


# ------------------------------------------------------------------ command line


def test_export_and_import_from_the_command_line(tmp_path: Path, document, monkeypatch) -> None:
    from escape_hw.config.loader import load_system
    from escape_hw.io.provenance import Provenance

    result = lenslets()
    text = load_system("razor-shwfs").to_toml()
    im = save_matrix(tmp_path / "im.fits", result, Provenance(text, "kl"))
    code, told, _ = document("export", "pyrtc", im, "--out", tmp_path / "rtc")
    assert code == 0
    assert set(told["files"]) == {"im", "valid", "references", "m2c", "settings"}
    assert told["simulated"] is True
    settings = yaml.safe_load(Path(told["files"]["settings"]).read_text())
    assert settings["slopes"]["image_noise"] == pytest.approx(0.004 * 1023)
    whole = tmp_path / "rtc" / "whole.yaml"
    whole.write_text(add_frame(Path(told["files"]["settings"]).read_text(), SHAPE))
    code, told, _ = document("import", "pyrtc", whole, "razor-shwfs", "--out", tmp_path / "back.fits")
    assert code == 0
    product = load_matrix(tmp_path / "back.fits", expect_system="razor-shwfs")
    np.testing.assert_array_equal(product.matrix.data, result.matrix.data)
    assert product.header["PARENT1"] == "whole.yaml"
    assert product.header["BASIS"] == "file"


def test_the_command_line_refuses_with_a_message(tmp_path: Path, document, im) -> None:
    code, told, _ = document("export", "pyrtc", im, "--out", tmp_path / "rtc")
    assert code == 2
    assert "calibrate again with this version" in told["error"]["message"]
    both = ("--commands", "--modes", "m2c.npy")
    assert document("export", "pyrtc", im, "--out", tmp_path / "rtc", *both)[0] == 2
    assert not (tmp_path / "rtc").exists()
