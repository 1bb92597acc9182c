"""``escape dm``, ``camera`` and ``asm`` on twins and on an emulated mirror: effects and output."""

from __future__ import annotations

import os
import signal
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from escape_hw.api.camera import Camera
from escape_hw.api.emulator import EmulatorRequest
from escape_hw.api.procedure import run
from escape_hw.config.loader import load_system
from escape_hw.errors import DeviceLost
from escape_hw.io.fits import file as fits_file
from escape_hw.io.fits.frames import load_frames
from escape_hw.runtime.host import device_tools
from escape_hw.runtime.host.computer import Host
from escape_sim.emulators.asm.emulator import AsmEmulator, make_emulator

LINKED = ("--set", "devices.dm.mode=hardware", "--set", "devices.dm.options.reply_s=10.0")


@pytest.fixture
def asm():
    """An emulated mirror and the options that lead to it."""
    options = {"transition_speed": "1000", "hold_s": "20", "rest_s": "60"}
    made = make_emulator(EmulatorRequest(port=0, options=options))
    with made:
        port = made.start().rpartition(":")[2]
        yield made, ("maps-nir", *LINKED, "--set", f"devices.dm.options.port={port}")


# --------------------------------------------------------------------- mirror
def test_dm_verbs_have_their_documents(document):
    for verb, keys in (
        (("flat", "razor-shwfs"), {"commands"}),
        (("poke", "razor-shwfs", 48, 0.05, "--seconds", 0), {"asked", "peak", "skipped"}),
        (("wave", "razor-shwfs", "--seconds", 0.2), {"asked", "peak", "commands"}),
        (("status", "razor-shwfs"), {"model", "serial", "n_act", "limits", "stroke_m"}),
    ):
        code, found, _ = document("dm", *verb)
        # A busy computer may be late for some commands of so short a wave.
        assert code == 0 or (code == 1 and found.get("missed")), verb
        assert {"schema", "system", "simulated", "seed", "changed"} | keys <= set(found)
        assert found["command"] == f"dm {verb[0]}"
        assert found["simulated"] is True
    assert document("dm", "poke", "razor-shwfs", 48, -0.05, "--seconds", 0)[1]["peak"] == 0.05


@pytest.fixture
def nothing_opens(monkeypatch):
    """Fail when a device is about to be opened."""
    monkeypatch.setattr(
        "escape_hw.cli.context.CommandContext.open_protected",
        lambda self, device, *how: pytest.fail(f"{device} was opened"),
    )


@pytest.mark.usefixtures("nothing_opens")
@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("dm", "poke", "razor-shwfs", 97, 0.1), "actuator 97 does not exist; the mirror has 0 to 96"),
        (("dm", "poke", "razor-shwfs", 0, 0.9), "beyond its limits, which allow 0.8"),
        (("dm", "poke", "razor-shwfs", 0, "nan"), "amplitude is nan; it must be a number"),
        (("dm", "poke", "razor-shwfs", 0, 0.1, "--second", 1), "--second"),
        (("dm", "poke", "maps-nir", 260, 0.01), "disabled"),
        (("dm", "poke", "maps-nir", 0, 0.5, "--seconds", 0), "beyond its limits, which allow 0.2"),
        (("dm", "wave", "razor-shwfs", "--amplitude", 0.9), "a wave of 0.9 exceeds its limits; 0.8 does not"),
        (("camera", "settings", "razor-shwfs", "--region", "1,2,3"), "--region 1,2,3: write X,Y,"),
        (("camera", "settings", "razor-shwfs", "--region", "0,0,0,9"), "--region 0,0,0,9: width and height"),
        (
            ("camera", "settings", "razor-shwfs", "--region", "600,0,90,9"),
            "--region 600,0,90,9: does not lie on the sensor of 640 x 512",
        ),
        (("camera", "settings", "razor-shwfs", "--exposure", "nan"), "--exposure is nan; it must be"),
        (("camera", "settings", "razor-shwfs", "--exposure", -1), "--exposure is -1; it must be at least"),
        (("camera", "settings", "razor-shwfs", "--frame-rate", 0), "--frame-rate is 0; it must be at least"),
        (("camera", "settings", "razor-shwfs", "--gain", -1), "--gain is -1; it must be at least 0"),
        (("camera", "snap", "razor-shwfs", "--out", "/dev/null/a.fits"), "/dev/null: cannot be written"),
        (("modulator", "start", "razor-pywfs", "--frequency", 0), "--frequency is 0; it must be at least"),
        (("modulator", "start", "razor-pywfs", "--frequency", "nan"), "--frequency is nan; it must be"),
        (("modulator", "start", "razor-pywfs", "--radius", "inf"), "a radius of inf lambda/D tilts"),
        (("modulator", "start", "razor-pywfs", "--radius", 1000), "devices.modulator.max_tilt_rad is 0.001"),
        (("modulator", "start", "razor-pywfs", "--radius-rad", 1), "--radius-rad is 1; it must be at least"),
    ],
)
def test_what_cannot_be_is_refused_before_anything_is_opened(escape, words, message):
    code, _, err = escape(*words)
    assert code == 2
    assert message in " ".join(err.split())


class _Clock:
    """Time that passes only while somebody sleeps, and as ``late`` says before a command."""

    def __init__(self, late: dict[int, float]) -> None:
        self.now, self._late, self._n_sleeps = 0.0, late, 0

    def monotonic(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        self._n_sleeps += 1
        self.now += seconds + self._late.get(self._n_sleeps, 0.0)


@pytest.mark.parametrize(("late", "missed"), [({}, 0), ({1: 0.3}, 29), ({50: 1.0}, 50)])
def test_a_late_command_slows_a_wave_down_and_is_followed_by_no_burst(monkeypatch, late, missed):
    clock, times, shapes = _Clock(late), [], []
    monkeypatch.setattr(device_tools, "time", clock)
    with device_tools.ConfiguredMirror(load_system("razor-shwfs").devices.dm) as dm:
        dm.callback = lambda shape: (times.append(clock.now), shapes.append(shape))
        wave = device_tools.run_wave(dm, device_tools.wave_generator(dm, 0.5, 1.0), 1.0, 1.0)
        result = run(wave)
    assert (result.commands, result.missed) == (100 - missed, missed)
    del times[result.commands :], shapes[result.commands :]
    # One late command is followed at once; all others come a period later.
    assert np.sum(np.diff(times) < 0.99 / device_tools.WAVE_HZ) <= 1
    # Largest change of a wave of 0.5 at 1 Hz, with its rise.
    assert np.abs(np.diff(shapes, axis=0)).max() < 0.5 * (2 * np.pi + 2) / device_tools.WAVE_HZ


def test_a_wave_that_is_too_slow_says_so(document, monkeypatch):
    monkeypatch.setattr(device_tools, "time", _Clock({1: 0.1}))
    code, found, err = document("dm", "wave", "razor-shwfs", "--seconds", 0.2)
    assert (code, found["commands"], found["missed"]) == (1, 11, 9)
    assert "9 of 20 commands were not sent in 0.2 s" in " ".join(err.split())


def test_a_poke_reaches_the_mirror_and_is_removed(escape, asm):
    made, options = asm
    code, out, err = escape("dm", "poke", *options, 40, 0.03, "--seconds", 0)
    assert code == 0, err
    assert "this changes hardware, devices.dm SIM336: flat, then actuator 40 by 0.03" in err
    shapes = [np.asarray(what) for name, what in made.server.calls if name == "COMMAND"]
    poked = [shape for shape in shapes if shape.any()]
    assert len(poked) == 1
    assert np.flatnonzero(poked[0]).tolist() == [40]
    assert poked[0][40] == pytest.approx(0.03 * 1e-5)
    assert not shapes[-1].any()
    assert str(made.controller.shell.state) == "rested"
    assert "flat" in out


def test_a_shell_that_floated_floats_on(escape, asm):
    made, options = asm
    assert escape("asm", "set", *options)[0] == 0
    assert escape("dm", "flat", *options)[0] == 0
    assert str(made.controller.shell.state) == "set"


# --------------------------------------------------------------------- adaptive secondary
def test_asm_verbs_change_the_state_and_report_it(document, asm):
    made, options = asm
    code, found, _ = document("asm", "status", *options)
    assert (code, found["state"], found["changed"], found["simulated"]) == (0, "off", False, True)
    assert (found["serial"], "emulated" in found["model"]) == ("SIM336", True)
    code, found, err = document("asm", "set", *options)
    assert (code, found["before"], found["after"], found["changed"]) == (0, "off", "set", True)
    assert "this changes hardware" in err
    assert str(made.controller.shell.state) == "set"
    assert document("asm", "status", *options)[1]["gap_m"] == pytest.approx(50e-6, rel=0.01)
    assert document("asm", "set", *options)[1]["changed"] is False
    code, found, _ = document("asm", "rest", *options)
    assert (code, found["after"]) == (0, "rested")
    assert str(made.controller.shell.state) == "rested"


def test_a_fault_is_cleared_only_after_a_confirmation(document, escape, asm, monkeypatch):
    made, options = asm
    monkeypatch.setattr(sys.stdin, "isatty", lambda: False, raising=False)
    made.inject("trip")
    code, found, _ = document("asm", "set", *options)
    assert code == 3
    assert "fault latched" in found["error"]["message"]
    code, _, err = escape("asm", "clear", *options)
    assert code == 2
    assert "confirm with --yes" in err
    assert str(made.controller.shell.state) == "fault"
    code, found, _ = document("asm", "clear", *options, "--yes")
    assert (code, found["before"], found["after"]) == (0, "fault", "rested")
    assert found["fault"] == "panic (scripted)"
    code, found, _ = document("asm", "clear", *options)
    assert (code, found["changed"]) == (0, False)


def test_status_takes_no_control(escape, asm):
    made, options = asm
    with other_owner(made):
        out = escape("asm", "status", *options)[1]
        assert "emulated SIM336" in out
        assert "controlled by somebody else" in out
        code, _, err = escape("asm", "rest", *options)
        assert code == 3
        assert "somebody else controls it" in err


def other_owner(made: AsmEmulator):
    """Have another client control the mirror."""
    import socket

    from escape_drivers.asm.codec import AsmCodec
    from escape_drivers.asm.messages import Hello, Role

    client = socket.create_connection(("127.0.0.1", int(made.start().rpartition(":")[2])))
    client.sendall(AsmCodec().request(1, 1, Hello(Role.CONTROL, 0, "somebody else")))
    client.recv(1 << 16)
    return client


def test_only_an_adaptive_secondary_has_states(escape):
    code, _, err = escape("asm", "status", "razor-shwfs")
    assert code == 2
    assert "AdaptiveSecondary" in err


# --------------------------------------------------------------------- cameras
def test_snap_writes_frames_with_their_times(document, tmp_path: Path):
    file = tmp_path / "frames.fits"
    code, found, _ = document("camera", "snap", "razor-shwfs", "--frames", 3, "--out", file)
    assert code == 0
    assert (found["frames"], found["shape"], found["file"]) == (3, [400, 400], str(file))
    hdus, _ = fits_file.read(file, "FRAMES")
    assert hdus["FRAMES"].data.shape == (3, 400, 400)
    assert hdus["FRAMES"].data.max() == found["counts"]["max"]
    assert np.diff(hdus["TIMES"].data["INDEX"]).tolist() == [1, 1]
    assert hdus[0].header["SERIAL"] == "SIMWFS"
    code, _, _ = document("camera", "snap", "razor-shwfs", "--out", file)
    assert code == 2  # never overwritten


def interrupt() -> None:
    os.kill(os.getpid(), signal.SIGINT)


def interrupt_twice() -> None:
    interrupt()
    interrupt()


def lose_the_camera() -> None:
    raise DeviceLost("wfs", "unplugged")


@pytest.mark.parametrize(
    ("happening", "code", "kind"),
    [(interrupt, 130, "Aborted"), (interrupt_twice, 130, "Aborted"), (lose_the_camera, 3, "DeviceLost")],
)
@pytest.mark.parametrize("stops", [True, False])
def test_snap_saves_the_frames_before_an_interruption(
    document, tmp_path: Path, monkeypatch, happening, code, kind, stops
):
    take = Camera.next_frame

    def next_frame(self, timeout_s):
        if self.last_index == 1:
            happening()
        return take(self, timeout_s)

    monkeypatch.setattr(Camera, "next_frame", next_frame)
    monkeypatch.setattr("escape_hw.api.procedure.Reporter.PERIOD_S", 0.0)
    if not stops:
        # A camera that is gone cannot be stopped, either.
        monkeypatch.setattr(Camera, "_before_close", lambda self: lose_the_camera())
    found = document("camera", "snap", "razor-shwfs", "--frames", 50, "--out", tmp_path / "frames.fits")
    assert (found[0], found[1]["error"]["type"]) == (code, kind)
    file = tmp_path / "frames.partial.fits"
    assert (found[1]["file"], found[1]["partial"]) == (str(file), True)
    assert list(tmp_path.iterdir()) == [file]
    product = load_frames(file)
    assert len(product.result.data) == found[1]["frames"] in (2, 3)
    assert product.header["FINISH"] == "aborted"
    assert "mirror" not in found[2]


@pytest.mark.parametrize("short_of", ["memory", "disk"])
def test_a_recording_that_does_not_fit_is_refused_before_the_camera_opens(
    document, tmp_path: Path, monkeypatch, short_of
):
    monkeypatch.setattr(Camera, "open", lambda self: pytest.fail("opened"))
    if short_of == "memory":
        monkeypatch.setattr(Host, "available_memory", lambda self: 100_000_000)
    else:
        usage = SimpleNamespace(free=20_000_000)
        monkeypatch.setattr("escape_hw.io.storage.shutil.disk_usage", lambda folder: usage)
    words = ("camera", "snap", "razor-shwfs", "--frames", 100, "--out", tmp_path / "frames.fits")
    code, found, _ = document(*words)
    needed = {"memory": "--frames 100: 128 MB of memory needed, 100 MB available", "disk": "33.0 MB needed"}
    assert (code, needed[short_of] in found["error"]["message"]) == (2, True), found


def test_show_describes_the_frames_in_a_file(document, escape, tmp_path: Path):
    file = tmp_path / "frames.fits"
    taken = document("camera", "snap", "razor-shwfs", "--frames", 3, "--out", file)[1]
    code, shown, _ = document("show", file)
    assert (code, shown["system"], shown["simulated"]) == (0, "razor-shwfs", True)
    assert (shown["frames"], shown["shape"], shown["lost_frames"]) == (3, [400, 400], 0)
    assert (shown["counts"], shown["settings"]) == (taken["counts"], taken["settings"])
    assert shown["rate_hz"] == pytest.approx(500)
    assert shown["first_index"] == taken["first_index"]
    assert (shown["dark_subtracted"], shown["flat_divided"]) == (False, False)
    code, out, _ = escape("show", file)
    assert code == 0
    assert "3 frames of 400 x 400 pixels" in out
    assert "500 Hz by their times" in out
    assert "no dark subtracted" in out
    assert escape("camera", "snap", "razor-shwfs", "--out", tmp_path / "one.fits")[0] == 0
    assert document("show", tmp_path / "one.fits")[1]["rate_hz"] == 0


def test_stream_counts_what_is_lost(document):
    code, found, _ = document("camera", "stream", "razor-shwfs", "--seconds", 0.04)
    assert code == 0
    assert found["rate_hz"] == pytest.approx(500)
    assert found["status"]["lost"] == 0
    lossy = ("--seconds", 0.1, "--set", "twin.loss_probability=0.3")
    code, found, _ = document("camera", "stream", "razor-shwfs", *lossy)
    assert code == 1
    assert found["status"]["lost"] > 0
    assert found["rate_hz"] == pytest.approx(500, rel=0.01)


def test_settings_are_checked_then_set(document, escape):
    asked = ("--exposure", 0.00100049, "--region", "130,60,200,200", "--gain", 2)
    code, found, _ = document("camera", "settings", "razor-shwfs", *asked, "--check")
    assert (code, found["changed"], found["as_asked"]) == (0, False, False)
    assert found["settings"]["exposure_s"] == pytest.approx(0.0010)
    assert document("camera", "settings", "razor-shwfs", *asked)[1]["changed"] is True
    out = escape("camera", "settings", "razor-shwfs", *asked)[1]
    assert "[devices.wfs]\nregion = [130, 60, 200, 200]\nexposure_s = 0.001\n" in out
    assert escape("camera", "settings", "razor-shwfs", "--frame-rate", 1e4)[0] == 3
    code, found, _ = document("camera", "settings", "razor-shwfs", "--camera", "science")
    assert (code, found["as_asked"]) == (0, True)
