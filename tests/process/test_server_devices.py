"""Settings of the cameras and pokes of the mirror through a server on the twin."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from serving import Served, serving, until_idle, wait_for

from escape_hw.errors import CalibrationError, ConfigError, RequestRefused, SettingRejected
from escape_hw.remote.client import Connection
from escape_hw.remote.state import Phase


@pytest.fixture(scope="module")
def served(system: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    with serving(system, folder=tmp_path_factory.mktemp("devices")) as one:
        yield one


@pytest.fixture(scope="module")
def connected(served: Served) -> Iterator[Connection]:
    with served.connect(control=True) as one:
        until_idle(one)
        yield one


@pytest.fixture
def bench(connected: Connection) -> Iterator[Connection]:
    """The bench at rest before and after: a test that fails leaves nothing to the next one."""
    usual = {name: connected.check_camera(name).current for name in ("wfs", "science")}
    yield connected
    if connected.state.loop.closed:
        connected.open_loop()
    connected.abort()
    until_idle(connected)
    connected.set_offsets({}, flat="clear", references="clear")
    for name, settings in usual.items():
        if connected.check_camera(name).current != settings:
            connected.set_camera(name, exposure_s=settings.exposure_s, region=settings.region)


@pytest.fixture(scope="module")
def matrix(connected: Connection) -> str:
    run = connected.start("docrime", frames=1000)
    run.wait(120)
    return f"docrime-{run.id}"


def test_a_check_says_what_would_change_and_changes_nothing(bench: Connection) -> None:
    before = bench.check_camera("wfs")
    assert before.changes == ()
    exposure = before.current.exposure_s
    plan = bench.check_camera("wfs", exposure_s=exposure / 2)
    assert plan.changes == (f"exposure {1e3 * exposure:.6g} → {1e3 * plan.planned.exposure_s:.6g} ms",)
    assert plan.refusal == ""
    assert bench.check_camera("wfs").current == before.current
    with pytest.raises(SettingRejected, match="rows allow at most"):
        bench.check_camera("wfs", frame_rate_hz=1e6)
    with pytest.raises(ConfigError, match="exposure_s"):
        bench.check_camera("wfs", exposure_s=-1.0)


def test_a_change_is_applied_recorded_and_discards_what_no_longer_fits(bench: Connection) -> None:
    bench.start("sensor", frames=50).wait(60)
    wait_for(lambda: bench.geometry().outlines_px != (), "the sensor is found")
    before = bench.check_camera("wfs").current
    brightness = float(bench.latest("frames").data.mean())
    plan = bench.set_camera("wfs", exposure_s=before.exposure_s / 2)
    assert plan.planned.exposure_s == pytest.approx(before.exposure_s / 2, rel=0.01)
    index = bench.latest("frames").index
    wait_for(lambda: bench.latest("frames", index) is not None, "a frame")
    wait_for(lambda: bench.latest("frames").data.mean() < 0.8 * brightness, "darker frames")
    run = bench.start("sensor", frames=20)
    run.wait(60)
    config = (Path(run.ended.folder) / "config.toml").read_text()
    assert f"exposure_s = {plan.planned.exposure_s!r}"[:18] in config

    x, y, width, height = before.region
    plan = bench.set_camera("wfs", exposure_s=before.exposure_s, region=(x, y, width - 20, height - 20))
    assert any("sub-apertures are discarded" in one for one in plan.warnings)
    wait_for(lambda: bench.latest("frames").data.shape == (height - 20, width - 20), "smaller frames")
    wait_for(lambda: bench.geometry().outlines_px == (), "the sub-apertures are discarded")
    bench.set_camera("wfs", region=before.region)
    assert bench.check_camera("wfs").current == before
    assert bench.state.phase is Phase.IDLE
    assert bench.state.fault is None


def test_in_closed_loop_only_the_exposure_of_the_science_camera_changes(
    bench: Connection, matrix: str
) -> None:
    bench.close_loop(matrix, gain=0.4)
    wait_for(lambda: bench.state.loop.closed, "the loop is closed")
    with pytest.raises(RequestRefused, match="open it first"):
        bench.set_camera("wfs", gain_db=3.0)
    assert "open it first" in bench.check_camera("wfs", gain_db=3.0).refusal
    science = bench.check_camera("science").current
    assert bench.set_camera("science", exposure_s=science.exposure_s / 2).changes
    x, y, width, height = science.region
    with pytest.raises(RequestRefused, match="averages images"):
        bench.set_camera("science", region=(x, y, width - 8, height - 8))
    with pytest.raises(RequestRefused, match="the loop is closed"):
        bench.poke("actuator", 3, 0.02)
    frames = bench.state.rates.frames
    wait_for(lambda: bench.state.rates.frames > frames + 100, "the loop goes on")
    assert bench.state.loop.closed


def test_a_poke_is_checked_held_and_returns_to_flat_by_itself(bench: Connection) -> None:
    plan = bench.check_poke("actuator", 5, 0.05)
    assert plan.refusal == ""
    assert plan.description.startswith("actuator 5 at +0.05 of the stroke (")
    assert plan.peak_nm > 0
    assert bench.state.mirror.peak == 0.0
    bench.poke("actuator", 5, 0.05, seconds=1.0)
    command = bench.latest("commands").data
    assert command[5] == pytest.approx(0.05)
    assert np.count_nonzero(command) == 1
    assert bench.state.active_run is not None
    with pytest.raises(RequestRefused, match="running"):
        bench.poke("actuator", 6, 0.05)
    until_idle(bench)
    assert bench.state.mirror.peak == 0.0
    assert bench.state.active_run is None


def test_a_mode_is_poked_and_flatten_ends_the_poke(bench: Connection) -> None:
    bench.poke("mode", 2, -0.03, seconds=20.0)
    command = bench.latest("commands").data
    assert np.abs(command).max() == pytest.approx(0.03)
    assert np.count_nonzero(command) > 10
    bench.flatten()
    until_idle(bench)
    assert not bench.latest("commands").data.any()
    bench.poke("mode", 2, 0.03, seconds=20.0)
    bench.abort()
    until_idle(bench)


def test_pokes_beyond_the_mirror_are_refused(bench: Connection) -> None:
    n_act = sum(row.count("1") for row in bench.geometry().layout)
    with pytest.raises(
        RequestRefused, match=f"actuator {n_act} does not exist; the mirror has 0 to {n_act - 1}"
    ):
        bench.check_poke("actuator", n_act, 0.05)
    with pytest.raises(RequestRefused, match="the basis has"):
        bench.poke("mode", 1000, 0.05)
    with pytest.raises(ConfigError, match="amplitude"):
        bench.poke("actuator", 0, 1.5)
    plan = bench.check_poke("actuator", 0, 1.0)
    assert plan.allowed < 1
    assert "allow at most" in plan.refusal
    with pytest.raises(RequestRefused, match="allow at most"):
        bench.poke("actuator", 0, 1.0)


def test_a_dark_frame_is_measured_with_the_beam_stop_and_a_flat_needs_uniform_light(
    bench: Connection,
) -> None:
    run = bench.start("dark", frames=20)
    run.wait(60)
    assert (Path(run.ended.folder) / "dark.fits").is_file()
    assert 0 < run.ended.document["mean"] < 100
    facts = {one.name: one.facts for one in bench.state.devices}["wfs"]
    assert (facts["dark"], facts["flat"]) == ("measured", "none")
    # The spots of lenslets are no uniform light.
    with pytest.raises(CalibrationError, match="uniform light"):
        bench.start("flat", frames=20).wait(60)
    exposure = bench.check_camera("wfs").current.exposure_s
    plan = bench.set_camera("wfs", exposure_s=0.8 * exposure)
    assert plan.warnings == ("the dark frame is discarded: measure it again",)
    facts = {one.name: one.facts for one in bench.state.devices}["wfs"]
    assert facts["dark"] == "none"
    bench.set_camera("wfs", exposure_s=exposure)


def test_offsets_move_the_mirror_at_rest_and_are_saved_and_restored(bench: Connection) -> None:
    state = bench.set_offsets({"focus": 60.0, "mode 4": -20.0})
    assert state.terms == {"focus": 60.0, "mode 4": -20.0}
    assert bench.state.offsets.terms == state.terms
    focus = bench.latest("commands").data
    assert focus.any()
    bench.flatten()
    assert np.array_equal(bench.latest("commands").data, focus), "flat includes the offsets"
    with pytest.raises(RequestRefused, match="such as 'night-1'"):
        bench.save_offsets("night 1")
    assert bench.save_offsets("night-1").saved == ("night-1",)
    bench.set_offsets({})
    assert not bench.latest("commands").data.any()
    assert bench.load_offsets("night-1").terms == state.terms
    assert np.allclose(bench.latest("commands").data, focus)
    bench.set_offsets({}, flat="present")
    assert bench.state.offsets.flat
    bench.set_offsets(flat="clear")
    assert bench.state.offsets.saved == ("night-1",)
    with pytest.raises(RequestRefused, match="flat command rejected"):
        bench.set_offsets({"focus": 50_000.0})
    assert not bench.latest("commands").data.any()
    with pytest.raises(ConfigError, match="no term"):
        bench.set_offsets({"coma": 1.0})


#: Several times the turbulence of the mode that a mean of some seconds leaves.
OFFSET_NM = 500.0


def test_a_closed_loop_converges_to_the_offset(bench: Connection, matrix: str) -> None:
    bench.close_loop(matrix, gain=0.4, leak=0.0)

    def mean_command() -> np.ndarray:
        seen: dict[int, np.ndarray] = {}
        wait_for(lambda: seen.setdefault((s := bench.latest("commands")).index, s.data.copy()) is None
                 or len(seen) > 150, "commands")  # fmt: skip
        return np.mean(list(seen.values()), axis=0)

    wait_for(lambda: bench.state.loop.residual_nm > 0, "the loop is closed")
    before = mean_command()
    bench.set_offsets({"mode 3": OFFSET_NM})
    frames = bench.state.rates.frames
    wait_for(lambda: bench.state.rates.frames > frames + 400, "the loop settles")
    moved = mean_command() - before
    bench.set_offsets({})
    bench.open_loop()
    until_idle(bench)
    bench.set_offsets({"mode 3": OFFSET_NM})
    wanted = bench.latest("commands").data
    bench.set_offsets({})
    share = float(moved @ wanted / (wanted @ wanted))
    print(f"share {share:.3f}")
    assert share == pytest.approx(1.0, abs=0.35), "the mean shape of the loop has moved by the offset"


@pytest.mark.slow
def test_present_slopes_become_the_references(bench: Connection, matrix: str) -> None:
    bench.start("sensor", frames=50).wait(60)  # a change of the camera discards what an earlier test found
    assert bench.set_offsets(references="present").references
    assert bench.set_offsets(references="clear").references is False
