"""Peers that are absent, silent, or stop in the middle: an error in time, with a remedy."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator

import pytest

from escape_drivers.pi.modulator import PiModulator
from escape_hw.api.modulator import Modulation
from escape_hw.config.loader import load_system
from escape_hw.config.registry import DeviceContext
from escape_hw.errors import DeviceLost

ESCAPE = (sys.executable, "-c", "from escape_hw.cli import main; main()")
CIRCLE = Modulation(1.41e-4, 303.03)
#: What the drivers here are documented to need: three time-outs; and what a busy machine may make of it.
TIMEOUT_S, LONGEST_S = 0.2, 10.0


def driver(port: int, *overrides: str) -> PiModulator:
    wire = [
        'devices.modulator.wire.host="127.0.0.1"', f"devices.modulator.wire.port={port}",
        f"devices.modulator.wire.timeout_s={TIMEOUT_S}", f"devices.modulator.wire.connect_s={TIMEOUT_S}",
    ]  # fmt: skip
    config = load_system("razor-pywfs", overrides=[*wire, *overrides])
    return PiModulator.from_section(config.devices.modulator, DeviceContext("stage", config))


def lost_in_time(call: Callable[[], object], says: str) -> None:
    began = time.monotonic()
    with pytest.raises(DeviceLost, match=says):
        call()
    assert time.monotonic() - began < LONGEST_S


@pytest.fixture
def listener() -> Iterator[socket.socket]:
    with socket.create_server(("127.0.0.1", 0), backlog=0) as listening:
        yield listening


def test_no_server_listens(listener):
    port = listener.getsockname()[1]
    listener.close()
    lost_in_time(
        driver(port).open, r"cannot connect to 127\.0\.0\.1:\d+ \(Connection refused\); .* one client"
    )


def test_packets_vanish(listener):
    # A full queue drops what asks to be let in, as a firewall does.
    port = listener.getsockname()[1]
    fillers = []
    for _ in range(4):
        filler = socket.socket()
        filler.setblocking(False)
        filler.connect_ex(("127.0.0.1", port))
        fillers.append(filler)
    try:
        lost_in_time(
            driver(port).open, r"no answer from 127\.0\.0\.1:\d+ within 0\.2 s; is the controller switched on"
        )
    finally:
        for filler in fillers:
            filler.close()


def test_a_peer_that_takes_the_call_and_does_not_reply(listener):
    stage = driver(listener.getsockname()[1])
    lost_in_time(stage.open, r"does not answer \(waited 0\.4 s\); .* Switch it off and on, then open again")
    assert not stage.is_open


def test_a_peer_that_talks_nonsense_for_ever(listener):
    import threading

    def chatter() -> None:
        other, _ = listener.accept()
        with other:
            try:
                while True:
                    other.sendall(b"\x1b[2J" * 1000)
            except OSError:
                return

    thread = threading.Thread(target=chatter, daemon=True)
    thread.start()
    lost_in_time(driver(listener.getsockname()[1]).open, r"nonsense|does not answer")
    thread.join(5)


@pytest.fixture
def emulator() -> Iterator[tuple[subprocess.Popen[str], int]]:
    """``escape emulate e727`` in a process of its own, and its port."""
    words = [*ESCAPE, "emulate", "e727", "--port", "0", "--option", "serial=SIMMOD", "--option", "zeroed=1"]
    process = subprocess.Popen(words, stderr=subprocess.PIPE, text=True)
    assert process.stderr is not None
    line = process.stderr.readline()
    assert line.startswith("e727: tcp 127.0.0.1:"), line
    yield process, int(line.rpartition(":")[2])
    process.kill()
    process.wait()
    process.stderr.close()


def test_a_peer_that_freezes_is_lost_in_time_and_found_again(emulator):
    process, port = emulator
    stage = driver(port).open()
    stage.modulate(CIRCLE)
    os.kill(process.pid, signal.SIGSTOP)
    lost_in_time(lambda: stage.modulate(CIRCLE), r"does not answer .* Switch it off and on, then open again")
    # From now on every call reports it at once.
    for call in (stage.park, stage.status, lambda: stage.modulation, lambda: stage.modulate(CIRCLE)):
        with pytest.raises(DeviceLost, match=r"does not answer"):
            call()
    with pytest.raises(DeviceLost):
        stage.close()
    assert not stage.is_open
    os.kill(process.pid, signal.SIGCONT)
    deadline = time.monotonic() + 30
    while True:
        try:
            stage.open()
            break
        except DeviceLost:
            # The old connection is noticed to be gone a moment later.
            assert time.monotonic() < deadline
            time.sleep(0.1)
    assert stage.modulation is None
    stage.modulate(CIRCLE)
    stage.close()


def test_a_peer_that_dies_is_lost_at_once(emulator):
    process, port = emulator
    stage = driver(port).open()
    stage.modulate(CIRCLE)
    process.kill()
    process.wait()
    lost_in_time(stage.park, r"connection to 127\.0\.0\.1:\d+ lost \(.*\); .* is the cable loose\?")
    with pytest.raises(DeviceLost):
        stage.close()
    lost_in_time(stage.open, r"cannot connect")
