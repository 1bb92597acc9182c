"""The sensor's section of either kind: keys required for a pyramid, and the errors without them."""

from __future__ import annotations

import pytest
from config_text import complaint, line_with

from escape_hw.api.registration import Registration
from escape_hw.config.bundled import bundled_text
from escape_hw.config.loader import load_system, load_text
from escape_hw.config.sensor import PyramidSection, ShackHartmannSection
from escape_hw.config.templates import json_schema
from escape_hw.errors import ConfigError

PYWFS = bundled_text("razor-pywfs")
SHWFS = bundled_text("razor-shwfs")


def test_razor_pywfs_holds_the_facts() -> None:
    config = load_system("razor-pywfs")
    sensor = config.sensor_as(PyramidSection)
    assert set(sensor.pupils_px) == {(45, 48), (46, 128), (152, 65), (130, 128)}
    assert (sensor.n_sub, sensor.modulation) == (64, 3.0)
    assert config.devices.wfs.region[2:] == (192, 192)
    modulator = config.devices.modulator
    assert modulator is not None
    steps = 1 / (50e-6 * modulator.frequency_hz)
    assert round(steps) == 66
    other = load_system("razor-shwfs")
    assert config.devices.dm == other.devices.dm
    assert config.devices.science == other.devices.science
    here, there = config.devices.screen, other.devices.screen
    assert here is not None
    assert there is not None
    assert here.screens_r0_m == there.screens_r0_m
    assert here.speed_m_s / there.speed_m_s == pytest.approx(303.03 / 500, rel=1e-3)
    assert config.twin.registration.to_registration() != Registration()


def test_section_without_a_kind_is_a_shack_hartmann() -> None:
    text = SHWFS.replace('kind = "shack-hartmann"\n', "")
    assert load_text(text) == load_system("razor-shwfs")
    assert load_text(text).sensor_as(ShackHartmannSection).pitch_px == 15.54


def test_sensor_of_another_kind_is_named() -> None:
    with pytest.raises(ConfigError, match=r"'razor-pywfs' has sensor.kind = 'pyramid'; .*'shack-hartmann'"):
        load_system("razor-pywfs").sensor_as(ShackHartmannSection)


#: what to replace, by what, the line that is blamed (a fragment of it), the rest of the message
WRONG = {
    "unknown kind": (
        'kind = "pyramid"',
        'kind = "piramid"',
        "piramid",
        "sensor.kind: \"piramid\"  must be 'shack-hartmann' or 'pyramid' (did you mean 'pyramid'?)",
    ),
    "key of the other kind": (
        "modulation = 3.0",
        "modulation = 3.0\npitch_px = 15.0",
        "pitch_px",
        "sensor.pitch_px: 15.0  is a key of kind = 'shack-hartmann' only",
    ),
    "misspelt key": (
        "modulation = 3.0",
        "modulaton = 3.0",
        "modulaton",
        "sensor.modulaton: 3.0  unknown key (did you mean 'sensor.modulation'?)",
    ),
    "out of range": (
        "modulation = 3.0",
        "modulation = -3.0",
        "modulation",
        "sensor.modulation: -3.0  is out of range (allowed range 0 <= x <= 50)",
    ),
    "three images": (
        ", [130.0, 128.0]]",
        "]",
        "pupils_px",
        "sensor.pupils_px: [[45.0, 48.0], [152.0, 65.0], [46.0, 128.0]]  has too few items; expected: "
        "nominal centres of the pupil images in the region, (x, y) in pixels: upper left, upper right, "
        "lower left, lower right",
    ),
    "wrong order": (
        "[45.0, 48.0], [152.0, 65.0]",
        "[152.0, 65.0], [45.0, 48.0]",
        "pupils_px",
        "sensor.pupils_px: [[152.0, 65.0], [45.0, 48.0], [46.0, 128.0], [130.0, 128.0]]  "
        "the upper right image must lie right of the upper left one",
    ),
    "overlap": (
        "[130.0, 128.0]",
        "[109.0, 128.0]",
        "pupils_px",
        "sensor.pupils_px: [[46.0, 128.0], [109.0, 128.0]]  "
        "the lower left and lower right images of 64 pixels overlap",
    ),
    "beyond the region": (
        "[130.0, 128.0]",
        "[130.0, 170.0]",
        "pupils_px",
        "sensor.pupils_px: [130.0, 170.0]  the region of 192 x 192 pixels cuts off part of this image "
        "of 64 pixels",
    ),
    "more than the modulator reaches": (
        "max_tilt_rad = 1.0e-3",
        "max_tilt_rad = 1.0e-4",
        "modulation = 3.0",
        "sensor.modulation: 3.0  the modulator reaches 2.128 lambda/D",
    ),
    "lenslets of a pyramid": (
        "[twin.pyramid] # choice",
        "grid_offset_px = [1.0, 0.0]\n[twin.pyramid] # choice",
        "grid_offset_px",
        "twin.wfs.grid_offset_px: [1.0, 0.0]  applies to lenslets; use "
        "twin.pyramid.centre_offsets_px to move pupil images",
    ),
}


@pytest.mark.parametrize("case", list(WRONG))
def test_wrong_pyramid_is_met_with_line_key_and_way_out(case: str) -> None:
    old, new, blamed, message = WRONG[case]
    assert PYWFS.count(old) == 1, "the case no longer fits the bundled file"
    text = PYWFS.replace(old, new)
    assert complaint(text) == [f"bench.toml:{line_with(text, blamed)}  {message}"]


def test_modulation_needs_a_modulator() -> None:
    start, end = PYWFS.index("[devices.modulator]"), PYWFS.index("[devices.science]")
    text = PYWFS[:start] + PYWFS[end:]
    assert complaint(text) == [
        f"bench.toml:{line_with(text, 'modulation = 3.0')}  sensor.modulation: 3.0  "
        "needs a section [devices.modulator]; 0 is a pyramid without modulation"
    ]
    assert load_text(text, overrides=["sensor.modulation=0"]).devices.modulator is None


def test_imperfections_of_a_pyramid_are_no_lenslets_business() -> None:
    (line,) = complaint(SHWFS, overrides=["twin.pyramid.ellipse=0.1"])
    assert line == (
        "--set  twin.pyramid.ellipse: 0.1  is not used with sensor.kind = 'shack-hartmann'; remove it"
    )


def test_all_mistakes_at_once() -> None:
    lines = complaint(
        PYWFS, overrides=["sensor.n_sub=3", "sensor.spot_px=1.0", "loop.gian=1", "sensor.modulation=true"]
    )
    assert len(lines) == 4
    assert any("sensor.n_sub: 3  is out of range (allowed range 4 <= x <= 400)" in line for line in lines)
    assert any("sensor.spot_px: 1.0  is a key of kind = 'shack-hartmann' only" in line for line in lines)


def test_schema_knows_both_kinds() -> None:
    names = json_schema()["$defs"]
    assert names["PyramidSection"]["properties"]["kind"]["const"] == "pyramid"
    assert names["ShackHartmannSection"]["additionalProperties"] is False
