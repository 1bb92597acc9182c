"""Loading of vendors' libraries, and the rows of ``escape perf`` for the drivers."""

from __future__ import annotations

import math
import subprocess
import sys

import pytest
from driver_bench import PARTS, stand_in

from escape_benchmarks.drivers import vendor_libraries as drivers
from escape_sim.stand_ins import StandInUnavailable


@pytest.mark.parametrize(("driver", "key"), [(driver, key) for driver, (key, _) in PARTS.items()])
def test_nothing_is_loaded_before_open(driver: str, key: str) -> None:
    code = (
        "import sys, ctypes\n"
        "ctypes.CDLL = lambda *a, **k: sys.exit('a library was loaded')\n"
        "from escape_hw.config.loader import load_system\n"
        "from escape_hw.config.registry import DeviceContext, device_factory\n"
        "config = load_system('razor-shwfs', mode='hardware')\n"
        f"make = device_factory({driver!r}, hardware=True)\n"
        f"print(make(config.devices.{key}, DeviceContext({key!r}, config)).is_open)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert done.stdout == "False\n", done.stderr


def test_every_driver_is_compared_with_the_direct_call(monkeypatch: pytest.MonkeyPatch) -> None:
    stand_in("asdk"), stand_in("m3api")
    monkeypatch.setattr(
        drivers, "time_alternately", lambda ours, peer, seconds: (ours(), peer()) and (3e-6, 2e-6)
    )
    rows = drivers.run()
    assert len(rows) == 4
    for row in rows:
        assert (row.ours, row.peer, row.unit) == (3.0, 2.0, "us")
        assert row.note.startswith("+1.00 us; in C")
        assert math.isfinite(float(row.note.split()[-2]))


def test_without_a_compiler_the_stage_gives_the_reason(monkeypatch: pytest.MonkeyPatch) -> None:
    def none(name: str) -> None:
        raise StandInUnavailable("no C compiler found")

    monkeypatch.setattr(drivers, "StandIn", none)
    (row,) = drivers.run()
    assert row.peer is None
    assert row.note == "no C compiler found"
