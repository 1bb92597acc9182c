"""Driver and emulated adaptive secondary in processes of their own: stopped, continued, killed."""

from __future__ import annotations

import contextlib
import os
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from asm_bench import driver, emulator, port_of, wait_for

from escape_hw.api.adaptive_secondary import ShellState
from escape_hw.errors import DeviceLost

_ESCAPE = [sys.executable, "-c", "from escape_hw.cli import main; main()"]
#: A client that leads the mirror to running and then does nothing any more.
_CLIENT = """
import sys, time
from escape_hw.config.loader import load_system
from escape_hw.bench import build_device
from escape_drivers.asm import AsmMirror
words = ["devices.dm.mode=hardware", "devices.dm.options.port=" + sys.argv[1]]
mirror = build_device("dm", load_system("maps-nir", overrides=words), AsmMirror).open()
print(mirror.state, flush=True)
time.sleep(600)
"""


@contextlib.contextmanager
def ended(process: subprocess.Popen[str]) -> Iterator[subprocess.Popen[str]]:
    """A process that is gone afterwards, stopped or not."""
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


@pytest.fixture
def remote() -> Iterator[tuple[subprocess.Popen[str], int]]:
    """``escape emulate asm`` and its port."""
    options = ["transition_speed=1000", "hold_s=0.5", "rest_s=3.0"]
    words = [*_ESCAPE, "emulate", "asm", "--port", "0", *(f"--option={option}" for option in options)]
    with ended(subprocess.Popen(words, stderr=subprocess.PIPE, text=True)) as process:
        assert process.stderr is not None
        found = re.search(r"tcp 127\.0\.0\.1:(\d+)", process.stderr.readline())
        assert found is not None
        yield process, int(found[1])


@pytest.mark.slow
def test_a_stopped_peer_is_reported_in_time_and_rests_when_it_continues(
    remote: tuple[subprocess.Popen[str], int],
) -> None:
    process, port = remote
    mirror = driver(port, reply_s=0.5, heartbeat_s=0.05).open()
    process.send_signal(signal.SIGSTOP)
    stat = Path(f"/proc/{process.pid}/stat")
    wait_for(lambda: ") T " in stat.read_text(), "it has stopped")
    with pytest.raises(DeviceLost, match=r"no answer within 0\.5 s"):
        mirror.send(np.zeros(336))
    with pytest.raises(DeviceLost):
        mirror.close()
    process.send_signal(signal.SIGCONT)
    watcher = driver(port, reply_s=10.0)
    wait_for(lambda: watcher.observe_health().state is ShellState.RESTED, "it rests by itself")
    assert "watchdog" in watcher.observe_health().fault
    with watcher:
        watcher.send(np.zeros(336))
    process.send_signal(signal.SIGINT)
    process.wait(30)


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP])
@pytest.mark.slow
def test_a_client_that_ends_or_hangs_leaves_the_shell_at_rest(number: signal.Signals) -> None:
    with emulator(hold_s=0.3, rest_s=1.5) as made:
        words = [sys.executable, "-c", _CLIENT, str(port_of(made))]
        with ended(subprocess.Popen(words, stdout=subprocess.PIPE, text=True)) as client:
            assert client.stdout is not None
            assert client.stdout.readline().strip() == "running"
            os.kill(client.pid, number)
            wait_for(lambda: made.controller.shell.state is ShellState.RESTED, "the shell is rested")
            # And the mirror is free for the next.
            wait_for(lambda: made.server.owner is None, "nobody owns it")
            with driver(port_of(made), heartbeat_s=0.05) as mirror:
                assert mirror.state is ShellState.RUNNING


def test_the_command_states_what_a_client_did_wrong(remote: tuple[subprocess.Popen[str], int]) -> None:
    process, port = remote
    from asm_bench import RawClient, frame

    with RawClient(port) as client:
        client.send(frame(3, 1))
        client.reply(66)
    assert process.stderr is not None
    assert (
        "protocol violation: unnamed client: HEARTBEAT refused: HEARTBEAT before HELLO"
        in process.stderr.readline()
    )
    process.send_signal(signal.SIGINT)
    assert process.wait(30) == 1
