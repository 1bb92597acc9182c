"""The fail-safe process with an adaptive secondary.

A floating shell is rested, a rested one is not lifted.
"""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
from collections.abc import Callable
from datetime import datetime
from functools import partial
from pathlib import Path

import pytest
from asm_bench import emulator, port_of, wait_for

from escape_hw.api.adaptive_secondary import ShellState
from escape_hw.config.loader import load_system
from escape_hw.io.provenance import format_utc
from escape_hw.server.safety.failsafe import FailsafeSettings, IncidentReport, make_safe
from escape_hw.supervision import process_start

#: An engine as the fail-safe process sees it: it holds the mirror and the pipe, and commands a shape.
_ENGINE = """
import sys, time
import numpy as np
from escape_hw.config.loader import load_text
from escape_hw.bench import build_device
from escape_drivers.asm import AsmMirror
mirror = build_device("dm", load_text(open(sys.argv[1]).read()), AsmMirror).open()
shape = np.zeros(336); shape[100] = 0.01
mirror.send(shape)
print("shaped", flush=True)
sys.stdin.readline()
mirror.close()
import os
os.write(int(sys.argv[2]), b"clean")
"""


def guarded(
    tmp_path: Path, port: int, end: str, meanwhile: Callable[[], object] = lambda: None
) -> IncidentReport | None:
    """Run such an engine until it is killed or ends cleanly; returns the report of its fail-safe process.

    ``meanwhile`` runs when the engine has ended, before the fail-safe process acts.
    """
    words = [
        "devices.dm.mode=hardware", f"devices.dm.options.port={port}", "devices.dm.options.reply_s=10",
        "devices.dm.options.heartbeat_s=0.05",
    ]  # fmt: skip
    config = tmp_path / "maps.toml"
    config.write_text(load_system("maps-nir", overrides=words).to_toml())
    watched, held = os.pipe()
    with contextlib.ExitStack() as ends:
        engine = subprocess.Popen(
            [sys.executable, "-c", _ENGINE, str(config), str(held)],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, pass_fds=(held,),
        )  # fmt: skip
        ends.callback(finished, engine)
        watch = FailsafeSettings(
            config_text=config.read_text(), incidents=str(tmp_path), pid=engine.pid,
            started=process_start(engine.pid) or 0,
        )  # fmt: skip
        failsafe = subprocess.Popen(
            [sys.executable, "-m", "escape_hw.server.safety.failsafe", str(watched)],
            stdin=subprocess.PIPE, text=True, pass_fds=(watched,),
        )  # fmt: skip
        ends.callback(finished, failsafe)
        os.close(held)
        os.close(watched)
        assert engine.stdout is not None
        assert engine.stdout.readline() == "shaped\n"
        if end == "kill":
            engine.kill()
            engine.communicate()
        else:
            engine.communicate("\n", timeout=60)
        meanwhile()
        failsafe.communicate(watch.model_dump_json(), timeout=120)
        assert failsafe.returncode == 0
    found = list(tmp_path.glob("*.incident.json"))
    return IncidentReport.model_validate_json(found[0].read_bytes()) if found else None


def finished(process: subprocess.Popen[str]) -> None:
    """End a process, whatever the test came to."""
    if process.poll() is None:
        process.kill()
        process.communicate()


def test_a_floating_shell_is_flattened_and_rested(tmp_path: Path) -> None:
    with emulator(hold=60, rest=120) as made:
        incident = guarded(tmp_path, port_of(made), "kill")
        assert incident is not None
        assert incident.flat is True
        assert incident.mirror == "the mirror is flat"
        wait_for(lambda: made.controller.shell.state is ShellState.RESTED, "the shell is rested")


@pytest.mark.slow
def test_a_shell_rested_by_its_watchdog_is_not_lifted(tmp_path: Path) -> None:
    states = []
    with emulator(hold=1.0, rest=2.0) as made:
        port = port_of(made)
        step = made.controller.request_state
        made.controller.request_state = lambda wanted, now: (states.append(wanted), step(wanted, now))[1]
        shell = made.controller.shell
        at_rest = partial(wait_for, lambda: shell.state is ShellState.RESTED, "the shell is at rest")
        incident = guarded(tmp_path, port, "kill", at_rest)
        assert incident is not None
        assert incident.flat is True
        assert made.controller.shell.state is ShellState.RESTED
    lifted = states.index(ShellState.RUNNING)
    assert ShellState.RUNNING not in states[lifted + 1 :]


def test_after_a_clean_exit_it_does_nothing(tmp_path: Path) -> None:
    with emulator(hold=60, rest=120) as made:
        assert guarded(tmp_path, port_of(made), "clean exit") is None


def test_the_time_of_an_incident_is_written_as_all_others(tmp_path: Path) -> None:
    twin = load_system("razor-shwfs").to_toml()
    ended = subprocess.Popen([sys.executable, "-c", ""])
    ended.wait()
    settings = FailsafeSettings(config_text=twin, incidents=str(tmp_path), pid=ended.pid, started=0)
    at_utc = make_safe(settings).at_utc
    assert at_utc == format_utc(datetime.fromisoformat(f"{at_utc}+00:00"))
