"""Tests on real devices: file, devices, allowed changes. Never run by default.

Write ``--hardware=FILE`` for a file outside the checkout: pytest takes a separate word that is a path for
a folder of tests, and looks for its configuration there.
"""

from __future__ import annotations

import pytest

from escape_hw.config.devices import DeviceConfig
from escape_hw.config.loader import load_system
from escape_hw.errors import ConfigError


def pytest_addoption(parser: pytest.Parser) -> None:
    group = parser.getgroup("hardware", "tests on real devices")
    group.addoption("--hardware", metavar="FILE", help="system file (or name) whose real devices are tested")
    group.addoption(
        "--maxchange", type=int, default=0, choices=range(4), metavar="N",
        help="0: nothing moves or changes; 1: pokes of a percent; 2: settings; 3: full range of the limits",
    )  # fmt: skip
    group.addoption(
        "--serial", action="append", default=[], metavar="NUMBER",
        help="serial number, read from the device itself; only devices named so are touched (repeatable)",
    )  # fmt: skip


def pytest_configure(config: pytest.Config) -> None:
    system = config.getoption("--hardware")
    if system is None:
        if config.getoption("--serial"):
            raise pytest.UsageError("--serial means something only with --hardware FILE")
        return
    try:
        configuration = load_system(system, mode="hardware")
    except ConfigError as error:
        raise pytest.UsageError(f"--hardware {system}: {error}") from None
    typed = set(config.getoption("--serial"))
    chosen = [
        key
        for key, section in configuration.devices
        if isinstance(section, DeviceConfig) and section.driver and section.serial in typed
    ]
    strange = typed - {getattr(configuration.devices, key).serial for key in chosen}
    if not typed or strange:
        # The numbers in the file are not shown: whoever types one has looked at the device.
        wrong = (
            f"no device of {system} has the serial number {', '.join(sorted(strange))}; " if strange else ""
        )
        raise pytest.UsageError(
            f"{wrong}type the serial number of every device that may be touched: --serial NUMBER"
        )
    config.stash[CHOSEN] = (configuration, chosen)
    # Nothing else runs beside a device.
    config.option.markexpr = "hardware"


#: Configuration and keys in [devices] of what --hardware tests.
CHOSEN: pytest.StashKey = pytest.StashKey()
