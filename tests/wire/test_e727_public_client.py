"""The maker's own client agrees with the emulator; it is no dependency, see the extra ``pi-client``."""

from __future__ import annotations

import importlib.util
import json
import subprocess
import sys

import pytest

from escape_hw.api.emulator import EmulatorRequest
from escape_sim.emulators.e727.emulator import make_emulator

if importlib.util.find_spec("pipython") is None:
    pytest.skip(
        "PIPython is not installed: pip install '.[pi-client]' (under PI's licence, read it first)",
        allow_module_level=True,
    )

#: Runs in a process of its own: the client keeps its connections in its classes for ever.
CLIENT = """
import json, sys, time
from pipython import GCSDevice, GCSError, pitools
from pipython.pidevice.interfaces.piserial import PISerial
from pipython.pidevice.interfaces.pisocket import PISocket

kind, address = sys.argv[1:]
host, _, port = address.rpartition(":")
wire = PISerial(address, 115200) if kind == "pty" else PISocket(host, int(port))
device, found = GCSDevice(gateway=wire), {}

def refused(call, *words):
    try:
        call(*words)
    except GCSError as error:
        return error.val

found["axes"] = device.axes
found["limits"] = device.qTMX(["1", "2"])
found["ready"] = bool(device.IsControllerReady())
device.SVO({"1": 1, "2": 1})
device.MOV({"1": 900.0, "2": 1000.12345679})
pitools.waitontarget(device, ["1", "2"])
found["places"] = device.qPOS(["1", "2"])
device.WAV_SIN_P(table=1, firstpoint=0, numpoints=40, append="X", center=20, amplitude=200.0, offset=900.0,
                 seglength=40)
device.WSL([1], [1])
device.WGC([1], [0])
device.WTR([0], [1], [0])
device.DRC([1], ["1"], [1])
device.WGO([1], [1])
found["turning"] = device.IsGeneratorRunning()
time.sleep(0.05)
found["points"] = device.qDRR([1], 1, 80)["NDATA"]
while device.bufstate is not True:
    time.sleep(0.01)
found["recorded"] = [min(device.bufdata[0]), max(device.bufdata[0])]
found["while turning"] = refused(device.MOV, "1", 1000.0)
device.WGO([1], [0])
found["too far"] = refused(device.MOV, "1", 5000.0)
found["stopped"] = refused(device.StopAll)
found["clock"] = device.qSPA("1", 0x0E000200)["1"][0x0E000200]
print(json.dumps(found))
"""


@pytest.mark.parametrize("kind", ["tcp", "pty"])
def test_moves_waves_recorder_and_errors(kind):
    emulator = make_emulator(EmulatorRequest(port=0, pty=kind == "pty", options={"zeroed": "1"}))
    address = emulator.start().removeprefix(f"{kind} ")
    try:
        words = [sys.executable, "-c", CLIENT, kind, address]
        done = subprocess.run(words, capture_output=True, text=True, timeout=120, check=False)
    finally:
        emulator.stop()
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert found["axes"] == ["1", "2", "3"]
    assert found["limits"] == {"1": 2000.0, "2": 2000.0}
    assert found["ready"]
    assert found["places"] == {"1": pytest.approx(900.0), "2": pytest.approx(1000.123457)}
    assert found["turning"] == {"1": True}
    assert found["points"] == 80
    assert found["recorded"] == pytest.approx([900.0, 1100.0])
    assert (found["while turning"], found["too far"], found["stopped"]) == (73, 7, 10)
    assert found["clock"] == pytest.approx(5e-5)
    assert [text.split(": ")[1].split(" (")[0] for text in emulator.violations] == ["error 73", "error 7"]
