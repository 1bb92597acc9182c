"""A PI controller on the network is found by its identification, and not changed."""

from __future__ import annotations

import socket
import tomllib

from escape_drivers.pi.discovery import discover
from escape_hw.api.emulator import EmulatorRequest
from escape_hw.config.registry import emulator_factory


def test_a_controller_is_found_with_lines_to_paste():
    emulator = emulator_factory("e727")(EmulatorRequest(port=0, options={"serial": "116000123"}))
    try:
        address = emulator.start().split()[1]
        (found,) = discover([address])
        (again,) = discover([address])
    finally:
        emulator.stop()
    assert (found.kind, found.driver, found.serial, found.where) == (
        "modulator", "pi-e727", "116000123", address,
    )  # fmt: skip
    section = tomllib.loads(found.toml)["devices"]["modulator"]
    assert section["serial"] == "116000123"
    assert section["wire"] == {"kind": "tcp", "host": "127.0.0.1", "port": int(address.split(":")[1])}
    assert again == found
    assert not emulator.violations


def test_a_host_without_a_controller_is_passed_over():
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        port = taken.getsockname()[1]
    assert discover([f"127.0.0.1:{port}"]) == []
