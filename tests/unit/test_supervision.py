"""Child processes and background threads."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time

from escape_hw.server.frontend import supervisor
from escape_hw.supervision import BackgroundThread, ChildProcess, is_alive, process_start


def test_a_suspended_child_that_does_not_end_is_killed() -> None:
    child = ChildProcess("http.server", "0", stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    started = process_start(child.pid)
    assert is_alive(child.pid, started)
    assert not is_alive(child.pid, (started or 0) - 1)
    os.kill(child.pid, signal.SIGSTOP)
    assert child.wait(0.1) is None
    assert not child.wait_or_kill(0.1)
    assert not child.running
    assert not is_alive(child.pid, started)


def test_a_child_that_ends_is_not_killed() -> None:
    child = ChildProcess("this", stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    with child.stdin, child.stdout as out:
        assert b"Zen" in out.read()
    assert child.wait_or_kill(60)
    assert child.wait() == 0


def test_a_periodic_thread_ends_when_stopped() -> None:
    calls: list[float] = []
    thread = BackgroundThread("periodic", lambda: calls.append(time.monotonic()), period_s=0.01)
    thread.start()
    while len(calls) < 3:
        time.sleep(0.01)
    thread.stop()
    assert not thread.is_alive()


def test_a_server_waits_for_its_own_processes_only() -> None:
    other = subprocess.Popen(
        [sys.executable, "-c", "import sys; sys.stdin.read(); sys.exit(7)"], stdin=subprocess.PIPE
    )
    others = supervisor._children()
    assert other.pid in others
    own = subprocess.Popen(["sleep", "0.1"])
    # It would wait for the other one until its limit.
    supervisor._reap_orphans(others)
    assert process_start(own.pid) is None
    own.returncode = 0
    other.communicate()
    assert other.returncode == 7
