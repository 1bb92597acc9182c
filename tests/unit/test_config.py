"""Reading a system: the result, and one reference message for each kind of error."""

import math
import tomllib
from pathlib import Path

import pytest
from config_text import complaint, line_with
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from escape_hw.config.bundled import bundled_systems, bundled_text
from escape_hw.config.key_tree import all_keys, fields_of, locate_key, sections_of
from escape_hw.config.layouts import FORMS
from escape_hw.config.loader import load_system, load_text
from escape_hw.config.system import SystemConfig
from escape_hw.config.templates import starter_text
from escape_hw.errors import ConfigError

RAZOR = bundled_text("razor-shwfs")


def test_razor_holds_the_facts() -> None:
    config = load_system("razor-shwfs")
    assert config.system.wavelength_m == 635e-9
    assert config.devices.dm.n_act == 97
    assert [int(n) for n in config.devices.dm.actuator_map().sum(axis=1)] == [5, 7, 9, *[11] * 5, 9, 7, 5]
    assert config.devices.wfs.settings().region.width == 400
    assert config.devices.screen is not None
    r0 = config.devices.screen.screens_r0_m[config.devices.screen.screen]
    assert config.system.pupil_m / r0 == pytest.approx(22, abs=0.05)
    assert config.twin.registration.to_registration().to_array().tolist() == [-16, -71, -0.77, 2.9, 0]
    limits = config.devices.dm.limits.to_limits()
    assert (limits.max_stroke, limits.max_slew, limits.max_neighbour) == (0.8, 1.0, None)


def test_configuration_is_frozen() -> None:
    config = load_system("razor-shwfs")
    with pytest.raises(ValidationError, match="frozen"):
        config.loop.gain = 0.1  # type: ignore[misc]


def test_an_empty_twin_is_ideal() -> None:
    twin = load_text(RAZOR[: RAZOR.index("[twin]")]).twin
    assert twin.loss_probability == twin.latency_s == twin.mirror.gain_scatter == twin.wfs.read_noise_e == 0
    assert not twin.registration.to_registration().to_array().any()
    assert twin.mirror.coupling is None


# -- wrong files ------------------------------------------------------------------------------

#: what to replace, by what, the key whose line is blamed (a fragment of it), the rest of the message
WRONG = {
    "out of range": (
        "gain = 0.425",
        "gain = 3.0",
        "gain = 3.0",
        "loop.gain: 3.0  is out of range (allowed range 0 < x <= 2)",
    ),
    "negative": (
        "pitch_m = 1.5e-3",
        "pitch_m = -1.5e-3",
        "pitch_m = -1.5e-3",
        "devices.dm.pitch_m: -0.0015  is out of range (allowed range 0 < x <= 1)",
    ),
    "not a number": (
        "leak = 0.026",
        'leak = "weak"',
        "leak =",
        'loop.leak: "weak"  must be a number (allowed range 0 <= x <= 1)',
    ),
    "truth for number": (
        "leak = 0.026",
        "leak = true",
        "leak =",
        "loop.leak: true  must be a number (allowed range 0 <= x <= 1)",
    ),
    "number for truth": ("paced = false", "paced = 0", "paced =", "twin.paced: 0  must be true or false"),
    "fraction for count": (
        "dropped_modes = 14",
        "dropped_modes = 1.5",
        "dropped_modes",
        "loop.dropped_modes: 1.5  must be a whole number (allowed range 0 <= x <= 10000)",
    ),
    "number for text": (
        'serial = "SIM97"',
        "serial = 97",
        "serial = 97",
        "devices.dm.serial: 97  must be text in quotes",
    ),
    "not finite": (
        "pitch_px = 15.54",
        "pitch_px = inf",
        "pitch_px = inf",
        "sensor.pitch_px: inf  must be finite (allowed range 2 <= x <= 1000)",
    ),
    "nan where inf may be": (
        "beam_radius_m = 5.0e-3",
        "beam_radius_m = nan",
        "beam_radius_m",
        "sensor.beam_radius_m: nan  is out of range (allowed range 0 < x)",
    ),
    "misspelt key": (
        "leak = 0.026",
        "leek = 0.026",
        "leek",
        "loop.leek: 0.026  unknown key (did you mean 'loop.leak'?)",
    ),
    "key of another section": (
        "leak = 0.026",
        "poke = 0.026",
        "poke = 0.026",
        "loop.poke: 0.026  unknown key (did you mean 'calibration.poke'?)",
    ),
    "misspelt section": (
        "[twin.ncpa]",
        "[twin.npca]",
        "[twin.npca]",
        "twin.npca: {rms_m = 2e-08, n_modes = 15}  unknown key (did you mean 'twin.ncpa'?)",
    ),
    "wrong choice": (
        'mode = "sim"',
        'mode = "hardwear"',
        "hardwear",
        "system.mode: \"hardwear\"  must be 'sim' or 'hardware' (did you mean 'hardware'?)",
    ),
    "unreadable layout": (
        '"circle-11"',
        '"round"',
        '"round"',
        f"devices.dm.layout: \"round\"  layout 'round' is unknown; choose {FORMS}",
    ),
    "missing key": (
        "n_modes = 94",
        "",
        "[basis]",
        "basis.n_modes:  is missing (number of modes; allowed range 1 <= x <= 10000)",
    ),
    "item of an array": (
        "0.7e-3, 1.5e-3]",
        "0.0, 1.5e-3]",
        "screens_r0_m",
        "devices.screen.screens_r0_m[2]: 0.0  is out of range (allowed range 0 < x <= 10)",
    ),
    "array too short": (
        "region = [120, 56, 400, 400]",
        "region = [400, 400]",
        "region = [400, 400]",
        "devices.wfs.region: [400, 400]  has too few items; expected: region: x, y, width, height, pixels",
    ),
    "number for array": (
        "frequency_hz = [17.0, 43.0]",
        "frequency_hz = 17.0",
        "frequency_hz",
        "twin.vibration.frequency_hz: 17.0  must be an array",
    ),
    "region off the sensor": (
        "region = [120, 56, 400, 400]",
        "region = [300, 56, 400, 400]",
        "region = [300",
        "devices.wfs.region: [300, 56, 400, 400]  does not lie on the sensor of 640 x 512 pixels",
    ),
    "exposure too long": (
        "exposure_s = 1.9e-3",
        "exposure_s = 2.1e-3",
        "exposure_s = 2.1e-3",
        "devices.wfs.exposure_s: 0.0021  longer than a frame (0.002 s at 500 Hz)",
    ),
    "screen that is not there": (
        "screen = 1 ",
        "screen = 4 ",
        "screen = 4 ",
        "devices.screen.screen: 4  the 4 screens are numbered 0 to 3",
    ),
    "actuator that is not there": (
        "disabled = []",
        "disabled = [3, 97]",
        "disabled = [3",
        "devices.dm.limits.disabled: 97  the actuators are numbered 0 to 96",
    ),
    "lists of unequal length": (
        "frequency_hz = [17.0, 43.0]",
        "frequency_hz = [17.0]",
        "frequency_hz",
        "twin.vibration.frequency_hz: [17.0]  needs one frequency for each of the 2 amplitudes, has 1",
    ),
    "more modes than actuators": (
        "n_modes = 94",
        "n_modes = 98",
        "n_modes = 98",
        "basis.n_modes: 98  the mirror has 97 actuators",
    ),
    "no mode left": (
        "dropped_modes = 14",
        "dropped_modes = 94",
        "dropped_modes",
        "loop.dropped_modes: 94  leaves none of the 94 modes; lower it",
    ),
    "basis file without kind": (
        'kind = "kl"',
        'kind = "kl"\nfile = "modes.fits"',
        "modes.fits",
        "basis.file: \"modes.fits\"  is not used with kind = 'kl'; remove it",
    ),
    "kind without basis file": (
        'kind = "kl"',
        'kind = "file"',
        "[basis]",
        "basis.file: \"\"  kind = 'file' needs the name of a FITS file",
    ),
    "newer schema": ("schema = 1", "schema = 2", "schema = 2", "schema: 2  must be 1"),
}


@pytest.mark.parametrize("case", list(WRONG))
def test_wrong_file_is_met_with_file_line_key_and_way_out(case: str) -> None:
    old, new, blamed, message = WRONG[case]
    assert RAZOR.count(old) >= 1, "the case no longer fits the bundled file"
    text = RAZOR.replace(old, new, 1)
    assert complaint(text) == [f"bench.toml:{line_with(text, blamed)}  {message}"]


def test_all_mistakes_at_once_each_with_its_own_line() -> None:
    chosen = ["misspelt key", "out of range", "missing key", "item of an array", "lists of unequal length"]
    text = RAZOR
    for case in chosen:
        text = text.replace(WRONG[case][0], WRONG[case][1], 1)
    lines = complaint(text, overrides=["sensor.n_sub=1", "loop.gian=1", "rubbish"], seed=-3)
    for case in chosen:
        assert f"bench.toml:{line_with(text, WRONG[case][2])}  {WRONG[case][3]}" in lines
    assert "--set  sensor.n_sub: 1  is out of range (allowed range 2 <= x <= 400)" in lines
    assert "--set  loop.gian: 1  unknown key (did you mean 'loop.gain'?)" in lines
    assert "--set  'rubbish' is not of the form section.key=value" in lines
    assert any(line.startswith("--seed  system.seed: -3  is out of range") for line in lines)
    assert len(lines) == len(chosen) + 4


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("schema = 1\n[loop\n", "bench.toml:2  is not valid TOML: Expected"),
        ("schema = 1\nschema = 1\n", "bench.toml:2  is not valid TOML: Cannot overwrite a value"),
        ("x = '''\n\n", "bench.toml:2  is not valid TOML: Expected"),
        ("loop.gain = \n", "bench.toml:1  is not valid TOML: Invalid value"),
    ],
)
def test_broken_toml_names_its_line(text: str, message: str) -> None:
    (line,) = complaint(text)
    assert line.startswith(message)


def test_empty_file_names_every_missing_section() -> None:
    keys = [line.split()[1] for line in complaint("")]
    assert keys == ["system:", "sensor:", "devices:", "basis:"]


def test_options_of_a_driver_are_free_but_plain() -> None:
    good = RAZOR.replace("[devices.wfs]", '[devices.dm.options]\nlibrary = "a.so"\n[devices.wfs]')
    assert load_text(good).devices.dm.options == {"library": "a.so"}
    bad = good.replace('"a.so"', "[1, 2]")
    assert complaint(bad) == [
        f"bench.toml:{line_with(bad, 'library')}  devices.dm.options.library: [1, 2]  "
        "must be text, a number, true or false"
    ]


# -- finding systems --------------------------------------------------------------------------


def test_unknown_system_gives_the_nearest() -> None:
    with pytest.raises(ConfigError, match=r"unknown system 'razor-swfs' \(did you mean 'razor-shwfs'\?"):
        load_system("razor-swfs")


def test_file_by_path(tmp_path: Path) -> None:
    file = tmp_path / "mine.toml"
    file.write_text(RAZOR, encoding="utf-8")
    assert load_system(file) == load_system(str(file)) == load_system("razor-shwfs")


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("absent.toml", None, "cannot be read (No such file or directory)"),
        ("folder.toml", "", "cannot be read (Is a directory)"),
        ("latin.toml", b"# caf\xe9\n", "is not UTF-8 text"),
    ],
)
def test_unreadable_file(tmp_path: Path, name: str, content: bytes | str | None, message: str) -> None:
    file = tmp_path / name
    if isinstance(content, bytes):
        file.write_bytes(content)
    elif content is not None:
        file.mkdir()
    with pytest.raises(ConfigError) as caught:
        load_system(file)
    assert str(caught.value).startswith(f"{file}: {message}")


# -- writing ----------------------------------------------------------------------------------


@pytest.mark.parametrize("name", bundled_systems())
def test_text_of_a_bundled_system_round_trips(name: str) -> None:
    config = load_system(name)
    text = config.to_toml()
    assert text.isascii()
    assert load_text(text) == config
    assert load_text(text).to_toml() == text


finite = st.floats(allow_nan=False, allow_infinity=False)


@st.composite
def changed(draw: st.DrawFn) -> SystemConfig:
    config = load_system("razor-shwfs").model_dump(by_alias=True)
    config["system"]["description"] = draw(st.text(st.characters(codec="utf-8")))
    config["system"]["seed"] = draw(st.integers(0, 2**63 - 1))
    config["sensor"]["beam_radius_m"] = draw(st.sampled_from([math.inf, 1e-5, 3.0]) | st.floats(1e-9, 1e9))
    config["twin"]["registration"]["rotation"] = draw(st.floats(-180, 180))
    config["twin"]["mirror"]["coupling"] = draw(st.none() | st.floats(0.01, 0.9))
    config["devices"]["dm"]["limits"]["disabled"] = draw(st.lists(st.integers(0, 96)))
    config["devices"]["dm"]["mode"] = draw(st.sampled_from([None, "sim", "hardware"]))
    plain = st.text(st.characters(codec="utf-8")) | st.integers(-(2**62), 2**62) | finite | st.booleans()
    config["devices"]["wfs"]["options"] = draw(st.dictionaries(st.text(st.characters(codec="utf-8")), plain))
    config["devices"]["science"] = draw(st.sampled_from([None, config["devices"]["science"]]))
    return SystemConfig.model_validate(config)


def test_a_key_that_ends_with_a_line_end_is_quoted() -> None:
    document = load_system("razor-shwfs").model_dump(by_alias=True)
    document["devices"]["wfs"]["options"] = {"0\n": "", "a b": 1, "c": "d"}
    config = SystemConfig.model_validate(document)
    assert load_text(config.to_toml()) == config


@given(changed())
def test_text_of_any_configuration_round_trips(config: SystemConfig) -> None:
    text = config.to_toml()
    assert text.isascii()
    assert load_text(text) == config


@pytest.mark.parametrize("base", bundled_systems())
def test_starter_is_its_base_under_another_name(base: str) -> None:
    assert load_text(starter_text("bench-7", base)) == load_system(base, overrides=["system.name=bench-7"])


def test_starters_explain_every_key() -> None:
    lines = [line for base in bundled_systems() for line in starter_text("bench-7", base).splitlines()]
    for key in all_keys():
        leaf = key.rpartition(".")[2]
        at = [
            n for n, line in enumerate(lines) if line.removeprefix("# ").startswith((f"{leaf} =", f"[{key}]"))
        ]
        assert at, key
        assert all(lines[n - 1].startswith("# ") for n in at), key


def test_starter_refuses_what_is_not_a_name() -> None:
    with pytest.raises(ConfigError, match=r"--set  system\.name: \"My Bench\"  is not allowed"):
        starter_text("My Bench")


def test_every_key_has_a_description() -> None:
    def walk(section: type) -> None:
        for name, field in fields_of(section).items():
            assert field.description, name
            for inner in sections_of(field.annotation).values():
                walk(inner)

    walk(SystemConfig)
    assert "twin.registration.shift_x" in all_keys()
    assert all(locate_key(tuple(key.split("."))).field is not None for key in all_keys())


def test_schema_carries_ranges_and_refuses_unknown_keys() -> None:
    from escape_hw.config.templates import json_schema

    schema = json_schema()
    loop = schema["$defs"]["LoopSection"]
    assert loop["properties"]["gain"]["exclusiveMinimum"] == 0
    assert loop["properties"]["gain"]["maximum"] == 2
    assert loop["additionalProperties"] is False
    # A bench has no telescope, and tracks and serves as everybody does.
    assert set(schema["properties"]) == {*tomllib.loads(RAZOR), "telescope", "tracking", "server"}
