"""A campaign with processes that are killed."""

from __future__ import annotations

import os
import signal
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from escape_hw.api.procedure import run
from escape_hw.config.loader import load_system
from escape_hw.errors import Aborted, CalibrationError
from escape_hw.paper import sky_time as campaign
from escape_hw.paper.sky_time import RealisationErrors, simulated_config, sky_time

FRAMES = (300,)


def realisation(system: str, number: int, frames: Any, overrides: Any) -> RealisationErrors:
    """A realisation that is finished at once or kills its process."""
    place, lasting = Path(overrides[0]), int(overrides[1])
    if number >= lasting:
        # The finished ones are on their way to the parent by then.
        while len(list(place.iterdir())) < lasting:
            pass
        os.kill(os.getpid(), signal.SIGKILL)
    if lasting == 100:
        time.sleep(0.1)
    (place / str(number)).touch()
    small = np.full((len(campaign.ESTIMATORS), len(frames), 5), 0.001)
    return RealisationErrors(small, small, small[0], small[0])


def fails(*_: Any) -> RealisationErrors:
    raise CalibrationError("no spots on the wavefront sensor")


@pytest.fixture(autouse=True)
def _stand_in(monkeypatch):
    monkeypatch.setattr(campaign, "run_realisation", realisation)


@pytest.mark.slow
def test_a_killed_process_ends_the_campaign_and_finished_realisations_are_saved(tmp_path):
    curves = run(sky_time("razor-shwfs", realisations=8, frames=FRAMES, overrides=[str(tmp_path), "3"]))
    assert 1 <= curves["realisations"] <= 3
    assert (
        f"died (killed, or out of memory) after {curves['realisations']} of 8 realisations" in curves["note"]
    )
    assert curves["fewest_frames"]["whitened"] == 300


@pytest.mark.slow
def test_a_campaign_without_a_finished_realisation_is_an_error(tmp_path):
    with pytest.raises(CalibrationError, match="after 0 of 4 realisations; try fewer processes than 2"):
        run(sky_time("razor-shwfs", realisations=4, frames=FRAMES, overrides=[str(tmp_path), "0"]))


@pytest.mark.slow
def test_a_campaign_without_accidents_has_no_note(tmp_path):
    curves = run(sky_time("razor-shwfs", realisations=5, frames=FRAMES, overrides=[str(tmp_path), "5"]))
    assert curves["realisations"] == 5
    assert "note" not in curves


@pytest.mark.slow
def test_when_stopped_it_saves_the_finished_realisations(tmp_path):
    stop = threading.Event()

    def watch(progress: Any) -> None:
        if progress.done >= 2:
            stop.set()

    slow = sky_time(
        "razor-shwfs", realisations=60, frames=FRAMES, overrides=[str(tmp_path), "100"], workers=1
    )
    with pytest.raises(Aborted) as caught:
        run(slow, observers=(watch,), abort=stop)
    curves = caught.value.partial
    assert 2 <= curves["realisations"] < 60
    assert curves["note"] == f"stopped after {curves['realisations']} of 60 realisations"


@pytest.mark.slow
def test_an_error_in_a_realisation_is_raised(monkeypatch, tmp_path):
    monkeypatch.setattr(campaign, "run_realisation", fails)
    with pytest.raises(CalibrationError, match="no spots"):
        run(sky_time("razor-shwfs", realisations=2, frames=FRAMES, overrides=[str(tmp_path), "1"]))


@pytest.mark.slow
def test_every_device_is_simulated_whatever_the_file_says():
    config = load_system("razor-shwfs", mode="hardware", overrides=["devices.dm.mode=hardware"])
    twins = simulated_config(config, ["loop.gain=0.3"], seed=5)
    assert twins.system.mode == "sim"
    assert twins.devices.dm.mode == "sim"
    assert (twins.loop.gain, twins.system.seed) == (0.3, 5)
    assert simulated_config("razor-shwfs").devices.dm.mode is None
