"""Two tests with pyRTC: ESCAPE's matrix closes its loop, and SPRINT improves a matrix measured by pyRTC."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import document, escape
from pyrtc_rig import Rig, rig, sections, within
from small_system import SMALL

import escape_hw
from escape_hw.api.procedure import run
from escape_hw.api.results import CalibrationResult
from escape_hw.bench import Bench
from escape_hw.calibration.push_pull.procedure import push_pull
from escape_hw.config.loader import load_system
from escape_hw.io.fits.matrix import load_matrix
from escape_hw.io.interchange.pyrtc.calibration import FrameSettings, export_matrix

__all__ = ["document", "escape"]

pytestmark = [
    pytest.mark.slow,
    pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::UserWarning"),
]

SYNTHETIC = Path(__file__).parents[2] / "examples" / "pyrtc-synthetic.toml"
#: pyRTC's synthetic sensor: counts between the spots, and pixels that they move for a slope of 1.
BACKGROUND, PIXELS = 120, 1.6
#: The twin that pyRTC calibrates: a screen of D/r0 = 4.5 that stands still. So slow that a command has
#: arrived, and its frame with it, before pyRTC looks, however busy this computer is.
TWIN = [
    *SMALL, "devices.screen.screen=3", "devices.screen.speed_m_s=0.0", "twin.paced=true",
    "devices.wfs.frame_rate_hz=60", "twin.vibration.amplitude_rad=[0.0,0.0]",
]  # fmt: skip
#: Small pokes, whose answer is not far above the sensor's noise.
POKE = 0.002


@pytest.fixture
def command(document: Callable[..., tuple[int, dict[str, Any], str]]) -> Callable[..., dict[str, Any]]:
    """Run ``escape`` with ``--json``, and check its exit code."""

    def call(*words: object, code: int = 0) -> dict[str, Any]:
        ended, told, err = document(*words)
        assert ended == code, err
        return told

    return call


def synthetic(made: Rig) -> tuple[Any, Any]:
    """pyRTC's synthetic example, its disturbance on."""
    from pyrtc.hardware.synthetic_systems import SyntheticSHWFS, SyntheticWFC

    wfs = made.camera(
        SyntheticSHWFS, width=49, height=49, sub_ap_spacing=7, sub_ap_offset_x=0, sub_ap_offset_y=0,
        num_modes=97, frame_rate_hz=300.0, disturbance_amplitude=0.3, disturbance_frequency_hz=1.2,
        disturbance_drift_hz=0.5, spot_flux=4200.0, background_level=float(BACKGROUND), read_noise=3.0,
    )  # fmt: skip
    wfs.set_dark(np.full((49, 49), BACKGROUND, np.int32))
    wfc = made.mirror(SyntheticWFC, num_actuators=97, num_modes=97)
    wfs.start()
    wfc.start()
    return wfs, wfc


def test_a_matrix_of_ours_closes_pyrtcs_loop(tmp_path: Path, command: Callable[..., dict[str, Any]]) -> None:
    with rig("proof1") as made:
        wfs, _ = synthetic(made)
        command(
            "calibrate", SYNTHETIC, "--method", "docrime", "--frames", 2000, "--out", tmp_path / "run",
            "--set", f'devices.dm.options.stream="{made.streams["wfc"]}"',
            "--set", f'devices.wfs.options.stream="{made.streams["wfs_raw"]}"',
        )  # fmt: skip
        im = tmp_path / "run" / "im.fits"
        told = command("export", "pyrtc", im, "--commands", "--out", tmp_path / "calib")
        found = sections(Path(told["files"]["settings"]))
        # The sensor shows the disturbance less the correction.
        truth = -PIXELS * wfs.response_matrix
        slopes = made.slopes(**found["slopes"])
        loop = made.loop(**{**found["loop"], "functions": ["leaky_integrator"]}, gain=0.3, leaky_gain=0.01,
                         conditioning=30.0)  # fmt: skip
        error = np.linalg.norm(loop.im - truth) / np.linalg.norm(truth)
        slopes.start()
        assert within(20, lambda: slopes._stream_object("signal").count > 10)
        before = made.rms(300)
        loop.start()
        made.rms(200)
        after = made.rms(300)
        loop.stop()
    print(f"matrix within {error:.3f} of the truth; slopes {before:.4f} px open, {after:.4f} px closed")
    assert error < 0.25
    assert after < 0.35 * before


def measured_by_pyrtc(folder: Path, geometry: CalibrationResult, seed: int) -> Path:
    """pyRTC's push-pull through turbulence on our twin; returns its configuration."""
    from escape_drivers import pyrtc_components
    from escape_drivers.pyrtc_components import EscapeCamera, EscapeMirror

    pyrtc_components._benches.clear()
    paths = export_matrix(folder, geometry, FrameSettings((200, 200), 12.0))
    found = sections(paths["settings"])
    ours = {"system": "razor-shwfs", "set": [*TWIN, f"system.seed={seed}"]}
    with rig("proof2") as made:
        wfs = made.camera(EscapeCamera, width=200, height=200, **ours)
        # What our geometry found between the spots, so that pyRTC's threshold means the same.
        wfs.set_dark(np.full((200, 200), round(geometry.grid.background), np.int32))
        slopes = made.slopes(**found["slopes"])
        mirror = made.mirror(EscapeMirror, **found["wfc"], **ours)
        loop = made.loop(poke_amp=POKE, num_iters_im=4, im_settle_frames=4, im_round_trip_check=False)
        for part in (wfs, slopes, mirror):
            part.start()
        assert within(30, lambda: slopes._stream_object("signal").count > 10)
        loop.compute_im()
        loop.save_im(str(paths["im"]))
    whole = folder / "pyrtc.yaml"
    whole.write_text(paths["settings"].read_text() + "wfs: {width: 200, height: 200}\n")
    return whole


def shape_error(found: np.ndarray, truth: np.ndarray) -> float:
    """Relative error of a matrix, but for a common scale, which a loop's gain takes up."""
    scale = float(np.vdot(found, truth) / np.vdot(found, found))
    return float(np.linalg.norm(scale * found - truth) / np.linalg.norm(truth))


@pytest.mark.parametrize("seed", [1, 2])
def test_a_matrix_measured_by_pyrtc_is_improved_by_sprint(
    tmp_path: Path, command: Callable[..., dict[str, Any]], seed: int
) -> None:
    overrides = [*TWIN, f"system.seed={seed}"]
    with Bench.from_config(load_system("razor-shwfs", overrides=[*overrides, "twin.paced=false"])) as bench:
        assert bench.screen is not None
        bench.screen.set(inserted=False)
        calm = run(push_pull(bench, frames=20))
    config = measured_by_pyrtc(tmp_path, calm, seed)
    sets = [word for one in overrides for word in ("--set", one)]
    command("import", "pyrtc", config, "razor-shwfs", "--out", tmp_path / "im.fits", *sets)
    # pyRTC states no standard errors: that the rest is turbulence and not a misfit cannot be known.
    told = command(
        "sprint", "razor-shwfs", "--im", tmp_path / "im.fits", "--out", tmp_path / "run", *sets, code=1
    )
    assert "remain beyond its noise" in told["warnings"][0]
    errors = {
        name: shape_error(load_matrix(told["products"][name]).matrix.data, calm.matrix.data)
        for name in ("im", "escape")
    }
    found = {name: value["value"] for name, value in told["registration"].items()}
    print(f"pyRTC's push-pull {errors['im']:.3f}, SPRINT's matrix {errors['escape']:.3f}; {found}")
    assert errors["escape"] < 0.5 * errors["im"]
    injected = escape_hw.load_system("razor-shwfs").twin.registration
    assert abs(found["shift_x"] - injected.shift_x) < 15
    assert abs(found["shift_y"] - injected.shift_y) < 15
