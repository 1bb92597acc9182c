"""The wire and the stage of a modulator in the configuration, and one device built alone."""

from __future__ import annotations

import re

import pytest

from escape_drivers.pi.modulator import PiModulator
from escape_drivers.pi.transports import (
    EmulatedTransport,
    SerialTransport,
    TcpTransport,
    UsbTransport,
    make_transport,
)
from escape_hw.api.modulator import TipTiltModulator
from escape_hw.api.phase_screen import PhaseScreen
from escape_hw.bench import build_device
from escape_hw.config.loader import load_system, load_text
from escape_hw.config.registry import DeviceContext
from escape_hw.errors import ConfigError


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ('stage.axes=["1","1"]', "the two axes must differ"),
        ("stage.axis_gain=[1.0,0.05]", "the magnitude must be at least 0.1"),
        ("stage.min_points=100", ""),
        ('stage.correction_source="table"', "needs stage.corrections; 'recorder' measures them"),
        ("stage.corrections=[[303.0,0.01,1.0,0.0,0.0]]", "out of range"),
        ("stage.trigger_line=4", "out of range"),
        ("wire.port=0", "out of range"),
        ('wire.kind="udp"', "'tcp', 'serial', 'usb' or 'emulator'"),
        ("wire.hots=1", "did you mean 'devices.modulator.wire.host'"),
    ],
)
def test_what_makes_no_stage_is_refused(change, says):
    overrides = [f"devices.modulator.{change}"]
    if not says:
        overrides.append("devices.modulator.stage.max_points=64")
        says = "max_points is 64"
    with pytest.raises(ConfigError) as refused:
        load_system("razor-pywfs", overrides=overrides)
    assert says in str(refused.value)


def test_the_tilt_follows_from_the_beam():
    text = load_system("razor-pywfs").to_toml()
    wide = re.sub(r"rad_per_lambda_d = .*", "beam_m = 6.75e-3", text)
    modulator = load_text(wide, "bench.toml").devices.modulator
    assert modulator is not None
    # Half of lambda/D: 635 nm on 6.75 mm are 94.1 urad, and reflection doubles the tilt.
    assert modulator.rad_per_lambda_d == pytest.approx(47.04e-6, rel=1e-3)
    again = load_text(load_text(wide, "bench.toml").to_toml(), "bench.toml")
    assert again.devices.modulator == modulator
    with pytest.raises(ConfigError, match=r"beam_m = 0\.003 gives 0\.000106 .* leave one out"):
        load_system("razor-pywfs", overrides=["devices.modulator.beam_m=3e-3"])


def transport_of(config):
    section = config.devices.modulator
    return make_transport(section.wire, section.serial, section.options, DeviceContext("modulator", config))


@pytest.mark.parametrize(
    ("kind", "transport"),
    [
        ("tcp", TcpTransport),
        ("serial", SerialTransport),
        ("usb", UsbTransport),
        ("emulator", EmulatedTransport),
    ],
)
def test_the_wire_is_the_configured_one_and_connects_to_nothing(kind, transport):
    config = load_system("razor-pywfs", overrides=[f"devices.modulator.wire.kind={kind}"])
    assert config.devices.modulator is not None
    assert type(transport_of(config)) is transport


def test_options_that_are_not_read_are_refused():
    config = load_system("razor-pywfs", overrides=['devices.modulator.options={zeroed="1"}'])
    assert config.devices.modulator is not None
    with pytest.raises(
        ConfigError, match=r"devices\.modulator\.options: zeroed: read with wire\.kind = 'emulator'"
    ):
        transport_of(config)


def test_the_environment_goes_before_the_wire(monkeypatch):
    config = load_system("razor-pywfs", overrides=["devices.modulator.wire.kind=serial"])
    assert config.devices.modulator is not None
    monkeypatch.setenv("ESCAPE_E727", "127.0.0.1:4711")
    assert transport_of(config).where == "127.0.0.1:4711"
    monkeypatch.setenv("ESCAPE_E727", "here")
    with pytest.raises(ConfigError, match="ESCAPE_E727=here: write HOST:PORT"):
        transport_of(config)


def test_one_device_is_built_alone():
    config = load_system("razor-pywfs", overrides=["devices.modulator.mode=hardware"])
    stage = build_device("modulator", config, TipTiltModulator)
    assert isinstance(stage, PiModulator)
    assert not stage.is_open
    with pytest.raises(ConfigError, match="creates a PiModulator, not a PhaseScreen"):
        build_device("modulator", config, PhaseScreen)
    with pytest.raises(ConfigError, match=r"'razor-shwfs' has no driver for devices\.modulator"):
        build_device("modulator", load_system("razor-shwfs"), TipTiltModulator)
