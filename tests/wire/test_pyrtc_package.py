"""Files and devices of ESCAPE with pyRTC: each reads the files of the other."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from interchange_cases import FACTS, SHAPE, lenslets, pyramid, target
from pyrtc_rig import NEEDED, rig, sections, within
from small_system import SMALL

from escape_hw.api.sensor import SubApertureGrid
from escape_hw.errors import ConfigError
from escape_hw.io.interchange.pyrtc.calibration import (
    FrameSettings,
    PyrtcConfig,
    export_matrix,
    import_matrix,
)
from escape_hw.io.interchange.pyrtc.files import (
    MATRIX,
    REFERENCES,
    VALID,
    LegacyConvention,
    read_file,
    write_file,
)
from escape_hw.io.interchange.pyrtc.geometry import PyrtcLenslets, PyrtcPupils

theirs = pytest.importorskip("pyrtc.calibration", reason=NEEDED)
resolve_class_symbol = pytest.importorskip("pyrtc.component_loading").resolve_class_symbol
their_slopes = pytest.importorskip("pyrtc.slopes_process")
SlopesProcess = their_slopes.SlopesProcess
compute_slopes_shwfs_optim_numba = their_slopes.compute_slopes_shwfs_optim_numba
shwfs_subaperture_coords = their_slopes.shwfs_subaperture_coords

pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::UserWarning")


@pytest.mark.parametrize("kind", [MATRIX, VALID, REFERENCES])
def test_files_go_both_ways(tmp_path: Path, kind: str) -> None:
    data = np.random.default_rng(0).standard_normal((6, 4)).astype(np.float32)
    ours = write_file(tmp_path / "ours.npy", data, kind, {"frames": 3}, {"sigma": data})
    loaded = theirs.load_calibration(ours, kind)
    np.testing.assert_array_equal(loaded.data, data)
    assert not loaded.legacy
    theirs.save_calibration(tmp_path / "theirs.npy", data, kind, note="x")
    back = read_file(tmp_path / "theirs.npy", kind)
    np.testing.assert_array_equal(back.data, data)
    assert back.record is not None
    assert back.record["note"] == "x"


@pytest.mark.parametrize("way", ["yx", "xy", "as_is"])
def test_files_of_1x_are_converted_as_pyrtc_converts_them(way: str) -> None:
    rng = np.random.default_rng(1)
    mask = rng.random((6, 6)) > 0.3
    valid, matrix = np.vstack([mask, mask]), rng.standard_normal((2 * int(mask.sum()), 5))
    references = rng.standard_normal((12, 6)).astype(np.float32)
    for window in (7, 8):
        frame = LegacyConvention(way, window=window)
        np.testing.assert_array_equal(frame.map(valid), theirs.slope_map_from_legacy(valid, way))
        expected = theirs.shwfs_ref_slopes_from_legacy(references, way, window)
        np.testing.assert_allclose(frame.references(references), expected, atol=1e-6)
        if way == "xy":
            moved = theirs.interaction_matrix_from_legacy(matrix, way, valid)
            np.testing.assert_array_equal(frame.matrix(matrix, valid), moved)
    half = rng.random((6, 6)) > 0.3
    both, rows = np.hstack([half, half]), rng.standard_normal((2 * int(half.sum()), 5))
    for swap in (False, True):
        frame = LegacyConvention(way, pyramid=True, default_pupils=swap)
        moved = theirs.slope_map_from_legacy(both, way, "pywfs", swap_pywfs_halves=swap)
        np.testing.assert_array_equal(frame.map(both), moved)
        moved = theirs.interaction_matrix_from_legacy(rows, way, both, "pywfs", swap_pywfs_halves=swap)
        expected = frame.matrix(rows, both) if way == "xy" else rows
        np.testing.assert_array_equal(expected, moved)


def test_windows_are_those_of_its_kernel() -> None:
    """A lone bright pixel in the middle of our window has a slope of zero in its."""
    windows = PyrtcLenslets(15.54, 9, 6, (400, 400))
    image = np.zeros((400, 400), np.float32)
    at_x, at_y = windows.centres()
    for i in range(windows.n):
        for j in range(windows.n):
            if windows.windows_on_frame()[i, j]:
                # Even windows: four pixels around the middle.
                for y in (at_y[i] - 0.5, at_y[i] + 0.5):
                    for x in (at_x[j] - 0.5, at_x[j] + 0.5):
                        image[int(y), int(x)] = 100
    n, reference = windows.n, np.zeros((2 * windows.n, windows.n), np.float32)
    coords = shwfs_subaperture_coords(windows.window)
    levers = np.meshgrid(coords, coords)[0].astype(np.float32)
    found = compute_slopes_shwfs_optim_numba(
        image,
        np.zeros_like(reference),
        reference,
        np.float32(1),
        np.float32(15.54),
        levers,
        9,
        6,
        windows.window,
    )
    assert found.shape == (2 * n, n)
    np.testing.assert_allclose(found, 0, atol=1e-4)


def test_a_loop_takes_our_files_as_they_are(tmp_path: Path) -> None:
    result = lenslets()
    paths = export_matrix(tmp_path, result, FACTS)
    found = sections(paths["settings"])
    from pyrtc.hardware.synthetic_systems import SyntheticWFC
    from pyrtc.wavefront_sensor import WavefrontSensor

    with rig("files") as made:
        made.camera(WavefrontSensor, width=SHAPE[1], height=SHAPE[0])
        slopes = made.slopes(**found["slopes"])
        mirror = made.mirror(SyntheticWFC, **found["wfc"])
        loop = made.loop(conditioning=100.0, **found["loop"])
        np.testing.assert_array_equal(loop.im, result.matrix.data)
        assert slopes.signal_size == result.matrix.n_slopes
        np.testing.assert_allclose(mirror.M2C, result.matrix.m2c, rtol=1e-6)
        loop.save_im(str(tmp_path / "again.npy"))
        slopes.save_ref_slopes(str(tmp_path / "ref_slopes.npz"))
        slopes.save_valid_sub_aps(str(tmp_path / "valid_sub_aps.npz"))
    whole = tmp_path / "whole.yaml"
    whole.write_text(paths["settings"].read_text() + "wfs: {width: 400, height: 400}\n")
    back = import_matrix(PyrtcConfig.read(whole), target(result), tmp_path / "again.npy")
    np.testing.assert_array_equal(back.matrix.data, result.matrix.data)
    assert not back.matrix.sigma.any()
    assert "no standard errors" in back.notes[-1]
    assert isinstance(back.grid, SubApertureGrid)
    np.testing.assert_array_equal(back.grid.valid, result.grid.valid)


def test_a_pyramids_pixels_and_slopes_are_its_own(tmp_path: Path) -> None:
    from pyrtc.wavefront_sensor import WavefrontSensor

    from escape_hw.api.pyramid import PyramidPupils
    from escape_hw.pipeline.slopes.pyramid import slopes_of_image

    result = pyramid()
    pupils = result.grid
    assert isinstance(pupils, PyramidPupils)
    paths = export_matrix(tmp_path, result, FrameSettings((48, 48), 0.0))
    found = sections(paths["settings"])
    frame = np.random.default_rng(2).poisson(400, (48, 48)).astype(np.int32)
    with rig("pyramid") as made:
        made.camera(WavefrontSensor, width=48, height=48)
        process: Any = made.slopes(**found["slopes"])
        assert isinstance(process, SlopesProcess)
        np.testing.assert_array_equal(process.valid_sub_aps, PyrtcPupils.from_pupils(pupils).mask_of())
        theirs_now = np.array(process._process_image(frame)[0])
        loop_rows = read_file(paths["im"]).data.shape[0]
        assert loop_rows == process.signal_size
    # On the pixels that both read, apart from what the mean over other pixels scales.
    ours_map = np.zeros((2, 16, 16))
    ours_map[:, pupils.valid] = slopes_of_image(frame, pupils).reshape(2, -1)
    their_map = np.zeros((2, 16, 16))
    disk = PyrtcPupils.from_pupils(pupils).disk()
    their_map[:, disk] = theirs_now.reshape(2, -1)
    both = pupils.valid & disk
    np.testing.assert_allclose(their_map[:, both], ours_map[:, both], atol=2e-3)


def test_our_devices_run_inside_it() -> None:
    camera_class = resolve_class_symbol("escape_drivers.pyrtc_components.EscapeCamera")
    mirror_class = resolve_class_symbol("escape_drivers.pyrtc_components.EscapeMirror")
    ours = {"system": "razor-shwfs", "set": [*SMALL, "twin.paced=true"]}
    with rig("devices") as made:
        wfs = made.camera(camera_class, width=200, height=200, **ours)
        wfc = made.mirror(mirror_class, num_actuators=37, num_modes=37, **ours)
        assert wfc.layout.sum() == 37
        assert wfc.basis_actuator_positions().shape == (37, 2)
        wfs.start()
        wfc.start()
        assert within(20, lambda: wfs.image_raw.count > 5)
        assert wfs.image_raw.read().max() > 100, "the twin's spots are in pyRTC's stream"
        command = np.zeros(37, np.float32)
        command[18] = 0.05
        wfc.write(command)
        assert within(20, lambda: abs(wfc.mirror.shape[18] - 0.05) < 1e-6)
        # One value that is not finite leaves the mirror as it is.
        command[:] = np.nan
        wfc.write(command)
        assert within(20, lambda: wfc.mirror.rejected_count > 0)
        assert abs(wfc.mirror.shape[18] - 0.05) < 1e-6
    assert not wfc.mirror.is_open
    assert not wfs.camera.is_open


def test_sections_that_do_not_fit_the_system_are_refused() -> None:
    from escape_drivers.pyrtc_components import EscapeCamera, EscapeMirror

    with pytest.raises(ConfigError, match="names no system"):
        EscapeCamera({"name": "w", "width": 4, "height": 4})
    with pytest.raises(ConfigError, match="reads 400 x 400 pixels"):
        EscapeCamera({"name": "w", "width": 4, "height": 4, "system": "razor-shwfs"})
    with pytest.raises(ConfigError, match="has 97"):
        EscapeMirror({"name": "d", "num_actuators": 4, "num_modes": 4, "system": "razor-shwfs"})
