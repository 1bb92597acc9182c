"""Commands on one device that is named by its driver, without a system file."""

from __future__ import annotations

from pathlib import Path

import pytest
from asm_bench import emulator, port_of
from astropy.io import fits
from command_line import document, escape
from driver_bench import fresh, stand_in

__all__ = ["document", "escape"]


def alpao_words() -> list[str]:
    fresh("asdk", "set serial BAX118")
    return ["--driver", "alpao", "--serial", "BAX118", "--set", f"library={stand_in('asdk').path}"]


def test_a_mirror_is_moved_by_its_driver(document) -> None:
    words = alpao_words()
    code, found, err = document("dm", "flat", *words)
    assert (code, found["system"], found["simulated"]) == (0, None, True)
    assert "this changes hardware, alpao BAX118: ramp to flat" in err
    code, found, _ = document("dm", "poke", *words, 48, -0.05, "--seconds", 0)
    assert (code, found["peak"], found["asked"]["actuator"]) == (0, 0.05, 48)
    code, found, _ = document("dm", "wave", *words, "--seconds", 0.1)
    # A busy computer may be late for some commands of so short a wave.
    assert code == 0 or (code == 1 and found["missed"])
    code, found, _ = document("dm", "status", *words, "--set", "limits.max_stroke=0.3")
    assert (found["n_act"], found["stroke_m"], found["limits"]["max_stroke"]) == (97, None, 0.3)
    assert not stand_in("asdk").violations


def test_documents_name_the_device(document) -> None:
    words = alpao_words()
    lower = [word.lower() if word == "BAX118" else word for word in words]
    for verb, rest in (("flat", []), ("poke", [48, 0.05, "--seconds", 0]), ("status", [])):
        code, found, _ = document("dm", verb, *lower, *rest)
        assert (code, found["driver"], found["serial"]) == (0, "alpao", "BAX118"), "the name of the SDK"
    # Wherever the number comes from, and if nothing was opened.
    code, found, err = document("dm", "flat", *words[:2], *words[4:], "--set", "serial=BAX118")
    assert (code, found["serial"], "this changes hardware, alpao BAX118: " in err) == (0, "BAX118", True)
    for wrong in (["--set", "polarity=2"], ["--set", "layout=square-3"]):
        code, found, _ = document("dm", "flat", *words, *wrong)
        assert (code in (2, 3), found["driver"], found["serial"]) == (True, "alpao", "BAX118")
        assert found["error"]["message"]
    code, found, _ = document("dm", "flat", "razor-shwfs")
    assert (code, found["driver"], found["serial"]) == (0, "sim-alpao", "SIM97")


def test_messages_name_the_keywords_of_a_device_used_alone(escape) -> None:
    code, _, err = escape("dm", "flat", *alpao_words(), "--set", "layout=square-3")
    assert (code, "correct layout or serial" in err, "devices." in err) == (3, True, False)
    with emulator() as made:
        where = ["--set", f"port={port_of(made)}"]
        code, _, err = escape("dm", "flat", "--driver", "asm", "--serial", "OTHER", *where)
        assert (code, "correct serial or the address" in err, "devices." in err) == (3, True, False)
        wrong = [*where, "--set", "limits.max_slew=2.0"]
        code, _, err = escape("dm", "flat", "--driver", "asm", "--serial", "SIM336", *wrong)
        assert (code, "asm: limits.max_slew is 2" in err, "devices." in err) == (3, True, False)


def test_a_mirror_of_an_unknown_arrangement_is_flattened_and_poked(escape, caplog) -> None:
    words = alpao_words()
    stand_in("asdk").script("set actuators 192")
    for verb, rest in (("flat", []), ("poke", ["191", "0.05", "--seconds", "0"]), ("status", [])):
        caplog.clear()
        code, _, err = escape("dm", verb, *words, *rest)
        assert code == 0, err
        assert "arrangement of its 192 actuators is not known" in caplog.text
    code, _, err = escape("dm", "wave", *words, "--seconds", "0.1")
    assert code == 3
    assert "a wave needs the arrangement of the 192 actuators; give it: --set layout=" in err
    assert not stand_in("asdk").violations


@pytest.mark.parametrize(
    ("words", "code", "message"),
    [
        (["poke", "0", "0.3"], 3, "with the other actuators flat (max_slew = 0.2); choose"),
        (["poke", "0", "0.6"], 3, "0.2 with the other actuators flat (actuator 0 exceeds max_stroke = 0.5"),
        (
            ["poke", "0", "0.1", "--set", "limits.max_abs_sum=0.01"],
            3,
            "allow 0.01 with the other actuators flat (the sum of magnitudes exceeds max_abs_sum = 0.01",
        ),
        (["poke", "97", "0.1"], 3, "actuator 97 does not exist; the mirror has 0 to 96"),
        (["poke", "0", "0.6"], 3, "a poke of 0.6 at actuator 0 is beyond its limits"),
        (["poke", "0", "nan"], 2, "amplitude is nan; it must be a number"),
        (["poke", "0", "1.5"], 2, "amplitude is 1.5; it must be at least -1"),
        (["flat", "--mode", "sim"], 2, "not with --driver"),
        (["flat", "--set", "serial=BAX200"], 2, "--serial BAX118 contradicts --set serial=BAX200"),
        (["flat", "--set", "limits.max_stroke=2"], 2, "alpao.limits.max_stroke: 2  is out of range"),
        (["flat", "--set", "limits=5"], 2, "alpao.limits: 5  must be MirrorLimits or a table"),
        (["flat", "--set", "trigger_in=up"], 2, "alpao.trigger_in: 'up'  must be"),
        (["flat", "razor-shwfs"], 2, "unexpected extra argument"),
    ],
)
def test_what_cannot_be_is_refused(escape, words, code, message) -> None:
    verb, *rest = words
    found, _, err = escape("dm", verb, *alpao_words(), *rest)
    assert found == code, err
    assert message in err


def test_a_serial_number_needs_a_driver(escape) -> None:
    code, _, err = escape("dm", "flat", "razor-shwfs", "--serial", "BAX118")
    assert (code, "goes with --driver" in err) == (2, True)
    code, _, err = escape("dm", "flat", "--driver", "ximea")
    wrong = "driver 'ximea' creates a XimeaCamera, not a DeformableMirror; drivers that do: alpao, asm, "
    assert (code, wrong in " ".join(err.split())) == (2, True)
    code, _, err = escape("dm", "flat")
    assert (code, "Missing argument" in err) == (2, True)


def test_a_camera_is_read_by_its_driver(document, tmp_path) -> None:
    fresh("m3api", "set serial 12345678")
    words = ["--driver", "ximea", "--serial", "12345678", "--set", f"library={stand_in('m3api').path}"]
    fast = ["--set", "frame_rate_hz=100.0", "--set", "region=[0, 0, 64, 32]"]
    code, found, _ = document("camera", "snap", *words, *fast, "--frames", 2, "--out", tmp_path / "a.fits")
    assert (code, found["shape"], found["settings"]["region"]["width"]) == (0, [32, 64], 64)
    assert (tmp_path / "a.fits").is_file()
    code, found, _ = document("camera", "settings", *words, *fast, "--exposure", 2e-3)
    assert (code, found["settings"]["exposure_s"]) == (0, pytest.approx(2e-3))
    code, found, _ = document("camera", "stream", *words, *fast, "--seconds", 0.05)
    # A busy computer may lose frames; the exit code tells.
    assert code == (1 if found["status"]["lost"] else 0)


def test_the_command_of_the_page_of_the_c_blue_one(document, tmp_path) -> None:
    fresh("aravis", "set profile c-blue-one\nset serial 17123456")
    page = (Path(__file__).parents[2] / "docs/devices/c-blue-one.md").read_text(encoding="utf-8")
    (line,) = (line for line in page.splitlines() if line.startswith("$ escape camera snap"))
    out = tmp_path / "a.fits"
    words = [*line.split()[2:], "--set", f"library={stand_in('aravis').path}", "--frames", 2, "--out", out]
    code, found, err = document(*words)
    assert (code, found["shape"]) == (0, [1104, 1604]), err
    assert fits.getdata(out).max() <= 1023
    assert not stand_in("aravis").violations


@pytest.mark.usefixtures("short_auto_zero")
def test_a_stage_is_turned_by_its_driver(document, escape) -> None:
    words = ["--driver", "pi-e727", "--serial", "0123456789", "--set", "kind=emulator"]
    circle = ["--radius-rad", 1.4e-4, "--frequency", 303.0, "--seconds", 0]
    code, found, _ = document("modulator", "start", *words, *circle)
    assert (code, found["left"], found["asked"]["radius_rad"]) == (0, "parked", 1.4e-4)
    assert document("modulator", "status", *words)[0] == 0
    code, _, err = escape("modulator", "start", *words)
    assert (code, "both are needed with --driver" in err) == (2, True)


def test_a_secondary_is_set_by_its_driver(document) -> None:
    with emulator() as made:
        words = ["--driver", "asm", "--serial", "SIM336", "--set", f"port={port_of(made)}"]
        code, found, _ = document("asm", "set", *words)
        assert (code, found["after"]) == (0, "set")
        assert document("asm", "status", *words)[1]["state"] == "set"
        assert document("dm", "poke", *words, 0, 0.02, "--seconds", 0)[0] == 0
        assert document("asm", "rest", *words)[1]["after"] == "rested"
        assert not made.violations
