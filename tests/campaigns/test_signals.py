"""Signals and kills at random moments: the mirror ends flat, and the measured data are saved."""

from __future__ import annotations

import os
import random
import signal
import time
from pathlib import Path

import pytest
from campaign_table import Campaign
from running import Running
from serving import Spy, until_idle, wait_for
from stand_in_bench import OPTIONS, bench, guarded, on_metal, whole

from escape_hw.errors import EscapeError
from escape_hw.io.fits.matrix import load_matrix
from escape_hw.streams.segments import segments
from escape_sim.stand_ins.bench_server import StandInBenchServer

__all__ = ["bench"]

pytestmark = [pytest.mark.campaign, pytest.mark.timeout(3000)]

SEED, TRIALS, KILLS = 22, 6, 8
SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT, signal.SIGPIPE)
#: Seconds between a kill and the next one, at most.
LONGEST_S = 4.0


def check_data(folder: Path, required: bool) -> str:
    """What is wrong with the data of a stopped calibration; empty if nothing is."""
    products = list(folder.glob("*.fits"))
    if required and [path.name for path in products] != ["im.partial.fits"]:
        return f"products {[path.name for path in products]}"
    try:
        for path in products:
            load_matrix(path)
    except EscapeError as error:
        return str(error)
    return ""


@pytest.mark.parametrize("number", SIGNALS, ids=[one.name for one in SIGNALS])
def test_a_signal_to_a_calibration(
    campaign: Campaign,
    bench: tuple[StandInBenchServer, Spy],
    system: Path,
    environment: dict[str, str],
    tmp_path: Path,
    number: signal.Signals,
) -> None:
    """Half of them while it measures, half at any moment after the start."""
    server, spy = bench
    rng = random.Random(SEED + number)
    # Where no other server is listed.
    runtime = tmp_path / "runtime"
    runtime.mkdir(mode=0o700)
    options = [word for option in OPTIONS for word in ("--set", option)]
    for trial in range(TRIALS):
        out, measuring = tmp_path / f"run-{trial}", trial % 2 == 0
        words = ["calibrate", system, "--mode", "hardware", *options, "--method", "docrime"]
        spy.last = None
        running = Running(
            [*words, "--frames", 10_000_000, "--out", out, "--json"],
            {**environment, **server.environment, "XDG_RUNTIME_DIR": str(runtime)},
            fresh=True,
        )
        try:
            if measuring:
                running.wait_for("DO-CRIME")
                running.let_work(1.0)
            time.sleep(rng.uniform(0, LONGEST_S))
            # SIGPIPE ends nothing.
            numbers = (number, signal.SIGINT) if number == signal.SIGPIPE else (number,)
            ended = running.stop(*numbers, pause_s=1.0)
        finally:
            running.kill()
        # Before the first line of ESCAPE, Python ends as a signal demands.
        killed_at_start = not measuring and spy.last is None and ended.code in (-number, -signal.SIGINT)
        problem = check_data(out, required=measuring)
        if spy.last is not None and not spy.flat:
            problem = "the mirror is not flat"
        elif not killed_at_start and ended.code != 130:
            problem = f"exit code {ended.code}"
        elif not killed_at_start and any("Traceback" in one for one in ended.lines):
            problem = "traceback"
        if problem:
            campaign.fail(f"trial {trial}: {problem}: {ended.lines[-8:]}")
        else:
            campaign.count("flat, data saved" if measuring else "flat or nothing moved")
    then = ", then SIGINT" if number == signal.SIGPIPE else ""
    campaign.end(f"{number.name}{then}, to a calibration on simulated vendor libraries")


def test_kills_of_a_server(
    campaign: Campaign, bench: tuple[StandInBenchServer, Spy], system: Path, tmp_path: Path
) -> None:
    server, spy = bench
    rng = random.Random(SEED)
    with on_metal(system, server, tmp_path) as served:
        for number in range(KILLS):
            which = ("engine", "front end")[number % 2]
            with served.connect(control=True) as client:
                if client.state.fault is not None:
                    client.clear_fault()
                until_idle(client)
                client.start("docrime", frames=10_000_000)
                time.sleep(rng.uniform(0, LONGEST_S))
                engine, front = client.state.engine_pid, served.front
                if which == "engine":
                    os.kill(engine, signal.SIGKILL)
                    wait_for(lambda one=client: guarded(one), "the fail-safe process has ended")
                else:
                    served.kill()
                    wait_for(lambda old=front: served.front not in (0, old), "another front end")
            whole(tmp_path)
            if spy.last is not None and not spy.flat:
                campaign.fail(f"{which}: the mirror is not flat")
            elif segments(pid=engine):
                campaign.fail(f"{which}: shared memory is left")
            else:
                campaign.count(f"flat after the {which}")
    campaign.end("SIGKILL to engine and front end of a server that calibrates")
