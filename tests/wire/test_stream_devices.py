"""Streams of pyRTC and of milk as cameras and mirrors: the contract, and their specific behaviour."""

from __future__ import annotations

import importlib.util
import os
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from streams import PERIOD_S, SHAPE, camera_config, create, mirror_config, published, ramp

from escape_drivers.streams import MilkMirror, PyrtcMirror
from escape_drivers.streams import camera as stream_camera
from escape_hw.bench import open_device
from escape_hw.config.loader import load_system
from escape_hw.config.registry import DeviceContext, device_factory
from escape_hw.config.system import SystemConfig
from escape_hw.errors import ConfigError, DeviceError, FrameTimeout, SettingRejected
from escape_hw.io.interchange.milk.stream import MilkStream
from escape_hw.io.interchange.pyrtc.stream import ShmemStream
from escape_hw.io.interchange.stream import Publication
from escape_hw.testing import Check, Factory, parametrize_device_checks

KINDS = ["milk", *(["pyrtc"] if importlib.util.find_spec("pyshmem") else [])]
TAG = f"escape_test_{os.getpid()}"


@cache
def configuration() -> SystemConfig:
    return load_system("razor-shwfs")


def make(kind: str, key: str, stream: str = "", **options: Any) -> Any:
    """A device on a stream, not open."""
    if key == "wfs":
        config = camera_config(configuration(), stream or f"{TAG}_camera")
        return device_factory(f"{kind}-camera", hardware=True)(
            getattr(config.devices, key), DeviceContext(key, config)
        )
    config = mirror_config(configuration(), stream or f"{TAG}_mirror", **options)
    return device_factory(f"{kind}-mirror", hardware=True)(
        getattr(config.devices, key), DeviceContext(key, config)
    )


@pytest.fixture(scope="module", autouse=True)
def _streams(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """One running camera and one mirror of each kind; frames are dated when due, however late they come."""
    began_ns = time.time_ns()

    def dated(read: Callable[..., Publication | None]) -> Callable[..., Publication | None]:
        def read_after(*words: Any) -> Publication | None:
            found = read(*words)
            return found and replace(found, written_ns=began_ns + round(found.count * PERIOD_S * 1e9))

        return read_after

    with pytest.MonkeyPatch.context() as patch:
        for one in (MilkStream, ShmemStream):
            patch.setattr(one, "read_after", dated(one.read_after))
        patch.setenv("MILK_SHM_DIR", str(tmp_path_factory.mktemp("shm")))
        made: list[Any] = []
        try:
            running = []
            for kind in KINDS:
                camera = create(kind, f"{TAG}_camera", SHAPE, "u2")
                mirror = create(kind, f"{TAG}_mirror", (97,), "f4")
                made += [camera, mirror]
                running.append(published(camera, ramp))
                running[-1].__enter__()
            yield
        finally:
            for one in running:
                one.__exit__(None, None, None)
            for stream in made:
                stream.unlink()
                stream.close()


DEVICES: dict[str, Factory] = {
    f"{kind}-{key}": partial(make, kind, key) for kind in KINDS for key in ("dm", "wfs")
}


@parametrize_device_checks(DEVICES)
def test_contract(factory: Factory, check: Check) -> None:
    check(factory)


@pytest.mark.parametrize("kind", KINDS)
def test_frames_are_those_written_and_gaps_are_counted(kind: str) -> None:
    with make(kind, "wfs") as camera:
        first = camera.next_frame(2.0)
        time.sleep(0.03)
        second = camera.next_frame(2.0)
        for frame in (first, second):
            region = camera.settings.region
            part = ramp(frame.index)[region.y : region.y + region.height, region.x : region.x + region.width]
            np.testing.assert_array_equal(frame.data, part)
        assert camera.status().lost == second.index - first.index - 1 > 0
        assert camera.info.serial == f"stream {TAG}_camera"
        assert not camera.info.simulated


@pytest.mark.parametrize("kind", KINDS)
def test_a_region_off_the_stream_is_refused(kind: str) -> None:
    width, height = SHAPE[::-1]
    region = (width - 8, 0, 16, height)
    with pytest.raises(SettingRejected, match=f"does not lie on the sensor of {width} x {height} pixels"):
        open_device(f"{kind}-camera", stream=f"{TAG}_camera", region=region)


@pytest.mark.parametrize("kind", KINDS)
def test_the_rate_is_the_streams_own(kind: str) -> None:
    with make(kind, "wfs") as camera:
        assert camera.settings.frame_rate_hz == pytest.approx(250)


@pytest.mark.parametrize("kind", KINDS)
def test_a_mirror_writes_its_commands_in_the_streams_units(kind: str) -> None:
    name = f"{TAG}_map"
    stream: Any = create(kind, name, (11, 11), "f4")
    try:
        command = np.linspace(-0.5, 0.5, 97)
        with make(kind, "dm", name, scale=2.0, simulated=True) as dm:
            before = stream.count
            dm.send(command)
            assert stream.count == before + 1
            layout = configuration().devices.dm.actuator_map()
            np.testing.assert_allclose(stream.latest().data[layout], 2 * command, rtol=1e-6)
            assert not stream.latest().data[~layout].any()
            assert dm.info.simulated
        assert not stream.latest().data.any(), "closing must leave the mirror flat"
    finally:
        stream.unlink()
        stream.close()


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("key", ["wfs", "dm"])
def test_what_does_not_fit_is_refused_by_name(kind: str, key: str) -> None:
    with pytest.raises(DeviceError, match=r"not there|cannot be opened"):
        make(kind, key, f"{TAG}_nobody").open()
    stream: Any = create(kind, f"{TAG}_odd", (7, 5), "f4")
    try:
        with pytest.raises(DeviceError, match=r"7 pixels|shape \(7, 5\)"):
            make(kind, key, f"{TAG}_odd").open()
    finally:
        stream.unlink()
        stream.close()
    with pytest.raises(ConfigError, match="names no stream"):
        make(kind, key, " ").open()


@pytest.mark.parametrize("kind", KINDS)
def test_a_silent_stream_times_out_and_states_who_to_ask(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    # The rate cannot be measured on opening, however long.
    monkeypatch.setattr(stream_camera, "_RATE_TIMEOUT_S", 0.05)
    name = f"{TAG}_silent"
    stream: Any = create(kind, name, SHAPE, "u2")
    try:
        with (
            make(kind, "wfs", name) as camera,
            pytest.raises(FrameTimeout, match=f"the program that writes the stream '{name}'"),
        ):
            camera.next_frame(0.05)
    finally:
        stream.unlink()
        stream.close()


def test_signed_and_floating_streams_become_counts(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stream_camera, "_RATE_TIMEOUT_S", 0.05)
    name = f"{TAG}_dark"
    stream = create("milk", name, SHAPE, "i4")
    try:
        frame = np.full(SHAPE, -3)
        frame[10, 20] = 5000
        config = camera_config(configuration(), name)
        config.devices.wfs.options["offset"] = 10.0
        camera: Any = device_factory("milk-camera")(config.devices.wfs, DeviceContext("wfs", config))
        with camera, published(stream, lambda _: frame):
            got = camera.next_frame(2.0)
            assert got.data[6, 12] == 1023
            assert got.n_saturated == 1
            assert (np.delete(got.data.ravel(), 6 * 32 + 12) == 7).all()
    finally:
        stream.close()


def test_the_folder_of_images_is_milks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from escape_hw.io.interchange.milk.layout import shm_folder

    monkeypatch.setenv("MILK_SHM_DIR", str(tmp_path))
    assert shm_folder() == tmp_path
    monkeypatch.setenv("MILK_SHM_DIR", str(tmp_path / "nowhere"))
    assert shm_folder() != tmp_path / "nowhere"


@pytest.mark.parametrize("kind", KINDS)
def test_a_mirror_used_alone_has_the_layout_of_a_file_or_of_the_stream(kind: str, tmp_path: Path) -> None:
    np.savetxt(tmp_path / "mask.txt", np.ones((2, 3)), fmt="%d")
    name, mirror = f"{TAG}_alone", {"milk": MilkMirror, "pyrtc": PyrtcMirror}[kind]
    alone = mirror(name)
    for n_act, rows in ((97, 11), (69, 9)):
        stream: Any = create(kind, name, (n_act,), "f4")
        try:
            with alone:
                assert alone.info.layout is not None
                assert (alone.info.n_act, len(alone.info.layout)) == (n_act, rows)
        finally:
            stream.unlink()
            stream.close()
    given = mirror(name, layout=f"mask:{tmp_path}/mask.txt")
    assert (given.info.n_act, given.info.layout.shape) == (6, (2, 3))
