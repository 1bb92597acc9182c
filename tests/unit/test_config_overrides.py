"""Overrides from the command line."""

import pytest

from escape_hw.config.loader import load_system, parse_override
from escape_hw.errors import ConfigError


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("a.b=-16.0", -16.0),
        ("a.b = 3", 3),
        ("a.b=true", True),
        ("a.b=[1, 2]", [1, 2]),
        ('a.b="x = y"', "x = y"),
        ("a.b=hardware", "hardware"),
        ("a.b=192.168.0.10", "192.168.0.10"),
        ("a.b=/data/my modes.fits", "/data/my modes.fits"),
        ("a.b=inf", float("inf")),
    ],
)
def test_value_is_toml_or_a_bare_word(text: str, value: object) -> None:
    override = parse_override(text)
    assert override.path == ("a", "b")
    assert override.value == value
    assert type(override.value) is type(value)


@pytest.mark.parametrize("device", ["dm", "wfs", "science", "modulator", "screen"])
@pytest.mark.parametrize(
    "serial", ["12345678", "0118028736", "1e5", "12-34", "17A456", "0x12", "1.50", "-5", "nan"]
)
def test_a_serial_number_needs_no_quotes_and_keeps_its_zeros(device: str, serial: str) -> None:
    assert parse_override(f"devices.{device}.serial={serial}").value == serial
    assert parse_override(f'devices.{device}.serial="{serial}"').value == serial
    assert parse_override(f"serial={serial}", within=("devices", device)).value == serial


def test_a_serial_number_of_digits_reaches_the_configuration() -> None:
    config = load_system("razor-shwfs", overrides=["devices.dm.serial=00123", "devices.wfs.serial=12345678"])
    assert (config.devices.dm.serial, config.devices.wfs.serial) == ("00123", "12345678")


def test_text_keys_still_refuse_what_is_no_text() -> None:
    assert parse_override("devices.dm.serial=[1, 2]").value == [1, 2]
    assert parse_override("devices.dm.serial=12 # the second").value == 12
    # A pair of texts, and free options of a driver.
    assert parse_override("devices.modulator.stage.axes=12").value == 12
    assert parse_override("devices.wfs.options.channel=12").value == 12
    with pytest.raises(ConfigError, match=r"devices\.dm\.serial: true  must be text"):
        load_system("razor-shwfs", overrides=["devices.dm.serial=true"])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("loop.gain", "--set  'loop.gain' is not of the form section.key=value"),
        ("=3", "--set  '=3' is not of the form section.key=value"),
        ("loop..gain=3", "--set  'loop..gain=3' is not of the form section.key=value"),
        ("loop.gain=0.4x", "--set  loop.gain: 0.4x  is not a TOML value"),
        ("loop.gain=", "--set  loop.gain:   is not a TOML value"),
        ("loop.gain=1\nleak=2", "--set  loop.gain: '1\\nleak=2'  must be one value on one line"),
    ],
)
def test_unreadable_override(text: str, message: str) -> None:
    with pytest.raises(ConfigError) as caught:
        parse_override(text)
    assert str(caught.value).startswith(message)


def test_overrides_apply_in_order_and_reach_keys_the_file_leaves_out() -> None:
    config = load_system(
        "razor-shwfs",
        overrides=[
            "loop.gain=0.1",
            "loop.gain=0.2",
            "devices.dm.limits.max_neighbour=0.4",
            "devices.dm.options.sync=wait",
            "devices.wfs.mode=hardware",
            "twin.registration={shift_x = 5}",
        ],
        seed=11,
        mode="sim",
    )
    assert config.loop.gain == 0.2
    assert config.devices.dm.limits.max_neighbour == 0.4
    assert config.devices.dm.options == {"sync": "wait"}
    assert (config.devices.wfs.mode, config.system.mode, config.system.seed) == ("hardware", "sim", 11)
    assert config.twin.registration.to_registration().to_array().tolist() == [5, 0, 0, 0, 0]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("loop.gian=0.3", "--set  loop.gian: 0.3  unknown key (did you mean 'loop.gain'?)"),
        ("gain=0.3", "--set  gain: 0.3  unknown key (did you mean 'loop.gain'?)"),
        ("twin.shift_x=3", "--set  twin.shift_x: 3  unknown key (did you mean 'twin.registration.shift_x'?)"),
        ("loop.gain.x=3", "--set  loop.gain.x: 3  unknown key (did you mean 'loop.gain'?)"),
        ("loop.gain=high", '--set  loop.gain: "high"  must be a number (allowed range 0 < x <= 2)'),
        ("loop=3", "--set  loop: 3  must be a table"),
        (
            "system.optics=oopoa",
            "--set  system.optics: \"oopoa\"  must be 'fast' or 'oopao' (did you mean 'oopao'?)",
        ),
    ],
)
def test_wrong_override_names_the_key_and_the_nearest(text: str, message: str) -> None:
    with pytest.raises(ConfigError) as caught:
        load_system("razor-shwfs", overrides=[text])
    assert str(caught.value) == message


def test_mode_from_the_command_line_is_checked() -> None:
    with pytest.raises(
        ConfigError, match=r"^--mode  system\.mode: \"simulated\"  must be 'sim' or 'hardware'"
    ):
        load_system("razor-shwfs", mode="simulated")
