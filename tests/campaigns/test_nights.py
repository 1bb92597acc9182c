"""SIGKILL to window, front end or engine at random moments of a night of operation."""

from __future__ import annotations

import json
import os
import random
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import pytest
import serving
from campaign_table import Campaign
from serving import Served, Spy, wait_for
from stand_in_bench import bench, guarded, on_metal

from escape_hw.io.fits import file as fits_file
from escape_hw.io.run_folder import find_runs, read_result
from escape_hw.remote.client import Connection
from escape_hw.remote.state import Finish, State
from escape_sim.stand_ins.bench_server import StandInBenchServer

__all__ = ["bench"]

pytestmark = [pytest.mark.campaign, pytest.mark.timeout(7200)]

SEED, KILLS = 19, 30
VICTIMS = ("window", "front end", "engine")
#: Steps of ``night.py`` that can be repeated at any moment.
STEPS = ("align", "calibrate", "gain", "poke", "record", "reload", "alarm")
#: Frames of a calibration of the night, and seconds between the start of a step and the kill, at most.
FRAMES, LONGEST_S = 800, 3.0
#: Longest wait for a window to be ready; it may have to clear a fault and to calibrate.
READY_S = 300.0
NIGHT = Path(__file__).parents[1] / "gui" / "night.py"


class NightWindow:
    """A window in a process of its own, in which an operator repeats a step of the night."""

    def __init__(self, served: Served, step: str, log: Path) -> None:
        paths = (NIGHT.parents[1], NIGHT.parent, os.environ.get("PYTHONPATH", ""))
        environment = {
            **served.environment, "QT_QPA_PLATFORM": "offscreen", "XDG_CONFIG_HOME": str(served.folder),
            "PYTHONPATH": os.pathsep.join(str(path) for path in paths if str(path)),
        }  # fmt: skip
        self._log = log
        with log.open("w") as errors:
            self.process = subprocess.Popen(
                [sys.executable, str(NIGHT), "step", step, serving.SYSTEM, str(FRAMES)],
                env=environment, stdout=subprocess.PIPE, stderr=errors, text=True,
            )  # fmt: skip
        self.said: list[dict[str, Any]] = []
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            if line.startswith("{"):
                self.said.append(json.loads(line))

    def wait_for(self, what: str) -> dict[str, Any]:
        """What the window says under this heading."""
        wait_for(
            lambda: any(one["what"] == what for one in self.said) or self.process.poll() is not None,
            f"the window says {what!r}", READY_S,
        )  # fmt: skip
        found = next((one for one in self.said if one["what"] == what), None)
        assert found is not None, f"the window ended: {self._log.read_text()[-3000:]}"
        return found

    def kill(self) -> None:
        self.process.kill()
        self.process.wait()
        self._reader.join()
        assert self.process.stdout is not None
        self.process.stdout.close()


def finished_runs(served: Served) -> list[Path]:
    """Folders of the runs that have ended."""
    runs = served.folder / "data" / "escape" / "runs"
    return [folder for folder in find_runs(runs) if (folder / "result.json").is_file()]


def problem_with_data(folders: list[Path]) -> str:
    """What is wrong with the results of runs; empty if all can be read, with their checksums."""
    for folder in folders:
        for path in read_result(folder)["products"].values():
            if not path.is_file():
                return f"{path} is missing"
            if path.suffix == ".fits":
                fits_file.read(path)
    return ""


def went_on(client: Connection, before: State) -> str:
    """What is wrong with loop and procedure after the window was killed; empty if they went on."""
    frames, run = client.state.rates.frames, before.active_run
    if run is None and before.loop.closed:
        wait_for(lambda: client.state.rates.frames > frames + 100, "the loop processes frames")
        if not client.state.loop.closed or client.state.loop.matrix != before.loop.matrix:
            return "the loop was opened"
    if run is not None:
        still = client.state.active_run
        last = client.state.last_run
        if (still is None or still.id != run.id) and (last is None or last.id != run.id):
            return f"{run.name} has vanished"
        if still is None and last is not None and last.finish is not Finish.DONE:
            return f"{run.name} {last.finish}: {last.message}"
    return "" if client.state.fault is None else client.state.fault.reason


def strike(victim: str, served: Served, client: Connection, window: NightWindow, spy: Spy) -> tuple[str, str]:
    """Kill a process; the outcome, and what is wrong with it."""
    if victim == "window":
        window.kill()
        # Requests that were sent before are still handled.
        time.sleep(1.0)
        before = client.state
        time.sleep(1.0)
        what = (
            "procedure went on"
            if before.active_run
            else "loop stayed closed"
            if before.loop.closed
            else "idle"
        )
        return what, went_on(client, before)
    if victim == "engine":
        os.kill(client.state.engine_pid, signal.SIGKILL)
        wait_for(lambda: guarded(client), "the fail-safe process has flattened the mirror")
    else:
        front = served.front
        served.kill()
        wait_for(lambda: served.front not in (0, front), "another front end")
    window.kill()
    return "mirror flat", "" if spy.last is None or spy.flat else "the mirror is not flat"


def is_told(victim: str, seen: dict[str, Any]) -> bool:
    """Whether the next window says what happened."""
    banners, notes = " ".join(seen["banners"]), " ".join(seen["notifications"])
    if victim == "engine":
        return "engine" in banners
    if victim == "front end":
        return "Startup notice" in notes
    return "No operator has control" in banners or "has not responded" in banners


def test_kills_during_a_night(
    campaign: Campaign, bench: tuple[StandInBenchServer, Spy], system: Path, tmp_path: Path
) -> None:
    server, spy = bench
    rng = random.Random(SEED)
    victims = [VICTIMS[k % len(VICTIMS)] for k in range(KILLS)]
    rng.shuffle(victims)
    with on_metal(system, server, tmp_path) as served:
        with served.connect():
            pass
        window = NightWindow(served, rng.choice(STEPS), tmp_path / "window-0.log")
        try:
            for number, victim in enumerate(victims, 1):
                step = window.wait_for("begin")["step"]
                time.sleep(rng.uniform(0, LONGEST_S))
                finished = finished_runs(served)
                with served.connect() as client:
                    outcome, problem = strike(victim, served, client, window, spy)
                window = NightWindow(served, rng.choice(STEPS), tmp_path / f"window-{number}.log")
                seen = window.wait_for("seen")
                problem = problem or problem_with_data(finished)
                if not problem and not is_told(victim, seen):
                    problem = f"the next window does not say it: {seen}"
                print(f"{number} {victim} during {step}: {problem or outcome}", flush=True)
                if problem:
                    campaign.fail(f"{victim} during {step}: {problem}")
                else:
                    campaign.count(f"{outcome} ({victim})")
        finally:
            window.kill()
    campaign.end("SIGKILL to window, front end and engine during a night in the window")
