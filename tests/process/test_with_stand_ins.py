"""``escape with-stand-ins``: a command in hardware mode, with the real drivers, on the simulated bench."""

from __future__ import annotations

import json
import os
import re
import shlex
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from running import ESCAPE
from stand_in_bench import REGION, require_libraries


@pytest.fixture(autouse=True)
def _compiled() -> None:
    require_libraries()


@pytest.mark.slow
def test_a_calibration_in_hardware_mode_on_the_simulated_bench(escape, system: Path, tmp_path: Path) -> None:
    calibrate = (
        "calibrate", system, "--mode", "hardware", "--set", REGION, "--frames", 50, "--quiet", "--json",
        "--out", tmp_path / "run",
    )  # fmt: skip
    done = escape("with-stand-ins", system, "--set", REGION, "--", "escape", *calibrate)
    document = json.loads(done.stdout)
    assert done.returncode == 0, done.stderr
    assert document["simulated"] is True
    assert document["converged"] is True
    shift = document["registration"]["shift_x"]
    assert abs(shift["value"] + 16) < 5 * shift["sigma"] < 10
    assert (tmp_path / "run" / "im.fits").is_file()


def test_the_commands_exit_code_is_passed_on(escape, system: Path) -> None:
    assert escape("with-stand-ins", system, "--", sys.executable, "-c", "raise SystemExit(3)").returncode == 3
    missing = escape("with-stand-ins", system, "--", "no-such-command")
    assert missing.returncode == 127
    # The second reason where the path has a folder that this user may not search.
    assert re.search("error: no-such-command: (No such file or directory|Permission denied)", missing.stderr)


@pytest.mark.slow
def test_a_camera_that_is_used_alone_works_with_the_options_that_its_refusal_names(
    escape, system: Path, tmp_path: Path
) -> None:
    snap = ("escape", "camera", "snap", "--driver", "ximea", "--frames", 1, "--out", tmp_path / "frames.fits")
    other = escape("with-stand-ins", system, "--", *snap, "--serial", "123")
    assert other.returncode == 3
    assert "there are: mirror 'SIM97', wfs 'SIMWFS', science 'SIMSCI'" in other.stderr
    whole = escape("with-stand-ins", system, "--", *snap, "--serial", "SIMWFS")
    assert whole.returncode == 3
    (needed,) = re.findall("used with --driver, the camera needs: (.*)", whole.stderr)
    done = escape("with-stand-ins", system, "--", *snap, "--serial", "SIMWFS", *shlex.split(needed))
    assert done.returncode == 0, done.stderr


@pytest.mark.slow
def test_without_a_command_it_prints_the_environment_and_serves_until_stopped(
    environment, system: Path
) -> None:
    with subprocess.Popen(
        [*ESCAPE, "with-stand-ins", str(system), "--set", REGION, "--json"],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment,
    ) as server:  # fmt: skip
        assert server.stdout is not None
        lines = []
        for line in server.stdout:
            lines.append(line)
            if line == "}\n":
                break
        told = json.loads("".join(lines))["environment"]
        probe = (
            "from escape_hw import open_system\n"
            f"with open_system({str(system)!r}, mode='hardware', set=[{REGION!r}]) as bench:\n"
            "    print(bench.dm.info.model, bench.wfs.next_frame(5.0).data.shape)"
        )
        done = subprocess.run(
            [sys.executable, "-c", probe],
            capture_output=True,
            text=True,
            env={**environment, **told},
            timeout=120,
        )
        server.send_signal(signal.SIGINT)
        rest, said = server.communicate(timeout=60)
    assert done.stdout == "ALPAO mirror, SDK 3.04.05.0612 (stand-in) (208, 208)\n", done.stderr
    assert rest == "", "one document, told as soon as there is something to tell"
    assert "with-stand-ins: stopped" in said
    assert server.returncode == 0
    assert not Path(told["ESCAPE_STAND_IN_BENCH"]).parent.exists()


def test_ctrl_c_is_left_to_the_command(environment, system: Path) -> None:
    waiting = (
        "import time\n"
        "try:\n    print('up', flush=True)\n    time.sleep(60)\n"
        "except KeyboardInterrupt:\n    raise SystemExit(7)"
    )
    with subprocess.Popen(
        [*ESCAPE, "with-stand-ins", str(system), "--", sys.executable, "-c", waiting],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment, start_new_session=True,
    ) as running:  # fmt: skip
        assert running.stdout is not None
        assert running.stdout.readline() == "up\n"
        os.killpg(running.pid, signal.SIGINT)
        _, said = running.communicate(timeout=60)
    assert "waiting for the command to end" in said
    assert running.returncode == 7
