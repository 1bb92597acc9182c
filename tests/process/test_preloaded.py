"""Processes that are forked for tests have what a new process has."""

from __future__ import annotations

import os
import signal
from pathlib import Path

import preloaded
import pytest


def test_streams_folder_environment_and_exit_code_are_its_own(tmp_path: Path) -> None:
    code = (
        "import os, sys\n"
        "print(os.getcwd(), dict(os.environ), sys.argv, __name__)\n"
        "print('é', file=sys.stderr)\n"
        "raise SystemExit(3)"
    )
    done = preloaded.run(["-c", code, "word"], {"ONLY": "this"}, tmp_path)
    assert done.stdout == f"{tmp_path} {{'ONLY': 'this'}} ['-c', 'word'] __main__\n"
    assert (done.stderr, done.returncode) == ("é\n", 3)


@pytest.mark.parametrize(("hang_up", "end"), [(signal.SIG_DFL, -signal.SIGHUP), (signal.SIG_IGN, 0)])
def test_a_signal_ends_it_unless_it_is_ignored(hang_up: signal.Handlers, end: int) -> None:
    before = signal.signal(signal.SIGHUP, hang_up)
    try:
        done = preloaded.run(["-c", "import os, signal; os.kill(os.getpid(), signal.SIGHUP)"])
    finally:
        signal.signal(signal.SIGHUP, before)
    assert done.returncode == end


def test_one_that_takes_too_long_is_killed() -> None:
    with pytest.raises(TimeoutError):
        preloaded.run(["-c", "import time; time.sleep(600)"], timeout_s=0.5)
    assert preloaded.run(["-c", f"import os; os.kill({os.getpid()}, 0)"]).returncode == 0
