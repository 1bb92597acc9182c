"""The night log: files that survive a crash, events from states, values of runs, seeing from streams."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest

from escape_hw.config.loader import load_system
from escape_hw.io import night_log
from escape_hw.io.night_log import NightLogWriter, find_nights, night_of, night_path, read_night, system_of
from escape_hw.pipeline.seeing import (
    FIRST_MODE,
    fried_parameter,
    noll_residual,
    seeing_arcsec,
    turbulence_strength,
    used_modes,
)
from escape_hw.remote.state import (
    ActiveRun,
    FaultState,
    Finish,
    FinishedRun,
    LoopState,
    Phase,
    RecordingState,
    State,
)
from escape_hw.server.frontend.night_log import NightLog, describe_changes, values_of_run
from escape_hw.server.frontend.performance_sampler import SeeingEstimator
from escape_hw.streams.ring import Sample


@pytest.fixture
def local_time(monkeypatch: pytest.MonkeyPatch):
    import time

    monkeypatch.setenv("TZ", "Pacific/Honolulu")
    time.tzset()
    yield
    monkeypatch.undo()
    time.tzset()


@pytest.mark.usefixtures("local_time")
def test_a_night_lasts_from_noon_to_noon_in_local_time():
    # Hawaii: UTC - 10 h.
    assert night_of(datetime(2026, 11, 22, 21, 59, tzinfo=UTC)) == "2026-11-21"
    assert night_of(datetime(2026, 11, 22, 22, 1, tzinfo=UTC)) == "2026-11-22"
    assert night_of(datetime(2026, 11, 23, 21, 59, tzinfo=UTC)) == "2026-11-22"


def test_every_entry_is_on_disk_and_a_restart_continues(tmp_path: Path):
    writer = NightLogWriter(tmp_path, "bench", simulated=True)
    writer.add("note", "clouds, µ\nfrom the west", author="ana on bench")
    writer.add("sample", values={"strehl": 41.5})
    (path,) = find_nights(tmp_path)
    assert path == night_path(tmp_path, "bench", night_of(datetime.now(UTC)))
    assert system_of(path) == "bench"
    note, sample = read_night(path)
    assert (note.text, note.author, note.simulated) == ("clouds, µ\nfrom the west", "ana on bench", True)
    assert sample.values == {"strehl": 41.5}
    later = NightLogWriter(tmp_path, "bench", simulated=True)
    assert later.earlier == [note, sample]
    assert later.add("note", "clear").number == 2


def test_numbers_go_on_when_the_server_is_started_in_the_next_night(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    NightLogWriter(tmp_path, "bench", simulated=True).add("note", "yesterday")
    monkeypatch.setattr(night_log, "night_of", lambda moment: "2126-01-01")
    writer = NightLogWriter(tmp_path, "bench", simulated=True)
    assert writer.earlier == []
    assert writer.add("note", "today").number == 1


def test_a_line_that_a_crash_cut_is_left_out_and_the_next_one_is_whole(tmp_path: Path):
    NightLogWriter(tmp_path, "bench", simulated=True).add("note", "first")
    (path,) = find_nights(tmp_path)
    with open(path, "ab") as file:
        file.write(b'{"number":1,"at_utc":"2026-11')
    writer = NightLogWriter(tmp_path, "bench", simulated=True)
    writer.add("note", "second")
    assert [entry.text for entry in read_night(path)] == ["first", "second"]


def test_a_disk_that_cannot_be_written_is_reported_once(tmp_path: Path, caplog: pytest.LogCaptureFixture):
    (tmp_path / "file").touch()
    writer = NightLogWriter(tmp_path / "file", "bench", simulated=True)
    assert [writer.add("note", text).text for text in ("a", "b")] == ["a", "b"]
    assert len([one for one in caplog.records if "cannot be written" in one.getMessage()]) == 1


CLOSED = State(
    phase=Phase.LOOP, engine_pid=5, loop=LoopState(closed=True, matrix="escape-3", gain=0.4, leak=0.01)
)
IDLE = State(phase=Phase.IDLE, engine_pid=5, loop=LoopState(matrix="escape-3", gain=0.4, leak=0.01))
POKE = ActiveRun(id=0, name="poke", arguments={}, stage="actuator 19 at +0.05 of the stroke")
RUN = ActiveRun(
    id=4, name="docrime", arguments={"frames": 1000, "snr": None, "extra_parameters": "", "sky_time": True}
)


@pytest.mark.parametrize(
    ("before", "after", "texts"),
    [
        (IDLE, IDLE, []),
        (IDLE, CLOSED, ["loop closed on 'escape-3', gain 0.4, leak 0.01, 0 modes dropped"]),
        (CLOSED, IDLE, ["loop opened"]),
        (
            CLOSED,
            CLOSED.model_copy(update={"loop": CLOSED.loop.model_copy(update={"gain": 0.5})}),
            ["loop now on 'escape-3', gain 0.5, leak 0.01, 0 modes dropped"],
        ),
        (
            IDLE,
            IDLE.model_copy(update={"active_run": POKE}),
            ["poke of actuator 19 at +0.05 of the stroke"],
        ),
        (
            IDLE,
            IDLE.model_copy(update={"active_run": RUN}),
            ["run 4, docrime: started (frames 1000, sky time yes)"],
        ),
        (
            IDLE,
            IDLE.model_copy(update={"fault": FaultState(reason="no frame", at_utc="")}),
            ["FAULT: no frame"],
        ),
        (
            IDLE.model_copy(update={"fault": FaultState(reason="no frame", at_utc="")}),
            IDLE,
            ["fault cleared"],
        ),
        (
            IDLE.model_copy(update={"recording": RecordingState(recording=True)}),
            IDLE.model_copy(update={"recording": RecordingState(written=7, dropped=1)}),
            ["recorded 7 entries, 1 dropped"],
        ),
        (IDLE, IDLE.model_copy(update={"engine_pid": 9}), ["another engine: process 9"]),
    ],
)
def test_changes_of_the_state_are_events(before: State, after: State, texts: list[str]):
    assert [text for _, text in describe_changes(before, after)] == texts


def test_the_end_of_a_run_is_logged_with_its_verdict_and_its_values(tmp_path: Path):
    published = []
    night = NightLog(load_system("razor-shwfs"), tmp_path, published.append)
    document = {
        "converged": True,
        "registration": {"shift_x": {"value": -16.2, "sigma": 0.3}},
        "optical_gain": [0.5, None, 0.7, 0.6],
        "strehl": {"peak": {"value": 0.4, "sigma": 0.01}},
        "snr": {"min": 0.4},
    }
    night.log_run(
        FinishedRun(
            id=4, name="escape", finish=Finish.DONE, folder="/runs/d/2130_escape-4", document=document
        )
    )
    event, sample = published
    assert event.text.startswith("run 4, escape: done [2130_escape-4]. Usable: SNR 0.4")
    assert sample.values == {"shift_x": -16.2, "shift_x_sigma": 0.3, "optical_gain": 0.6, "strehl": 40.0}
    assert night.after(event.number, 10) == [sample]
    assert values_of_run({**document, "converged": False, "optical_gain": None, "strehl": None}) == {}


def test_the_strength_of_kolmogorov_modes_is_found_despite_noise():
    rng = np.random.default_rng(1)
    used = used_modes(100)
    variance = np.array([noll_residual(k) - noll_residual(k + 1) for k in range(used.start, used.stop)])
    for strength in (5.0, 22.0):
        modes = rng.standard_normal((4000, 1, variance.size)) * np.sqrt(variance) * strength ** (5 / 6)
        noise = 0.3 * rng.standard_normal((4000, 2, variance.size))
        assert turbulence_strength(modes + noise, 100) == pytest.approx(strength, rel=0.03)


def test_too_few_modes_have_no_strength():
    assert used_modes(20).stop == FIRST_MODE
    with pytest.raises(ValueError, match="at least 26"):
        turbulence_strength(np.zeros((10, 2, 1)), 20)


def test_r0_and_seeing_are_given_at_500_nm():
    assert fried_parameter(22, 6.75e-3, 500e-9) == pytest.approx(0.307e-3, rel=1e-3)
    assert fried_parameter(10, 6.5, 1000e-9) == pytest.approx(0.65 / 2**1.2)
    assert seeing_arcsec(0.1) == pytest.approx(1.01, abs=0.01)


def test_frames_of_a_closed_loop_give_the_modes_of_the_turbulence():
    """The command of a frame comes after its slopes and is seen two frames later."""
    rng = np.random.default_rng(2)
    n, matrix, m2c = 40, np.linalg.qr(rng.standard_normal((60, 40)))[0], np.eye(40)
    estimator = SeeingEstimator(matrix.T, m2c, 2.0, 1.0)
    used = used_modes(n)
    truth = rng.standard_normal((100, n))
    commands = 10 * rng.standard_normal((100, n))
    slopes = []
    for k in range(100):
        seen = commands[k - 2] if k >= 2 else np.zeros(n)
        slopes.append(Sample(k, 0, 1000 * k, (matrix @ (truth[k] + seen)).astype(np.float32), {}))
    sent = [Sample(k, 0, 1000 * k + 400, commands[k], {}) for k in range(100)]
    for first in range(0, 96, 4):
        estimator.add_closed(slopes[first : first + 6], sent[first : first + 6])
    expected = np.concatenate([truth[f + 2 : f + 6, used] for f in range(0, 96, 4)])
    pairs = np.stack(estimator._pairs)
    assert len(pairs) == 3 * 24
    np.testing.assert_allclose(pairs[:3, 0], expected[:3], atol=1e-4)
    np.testing.assert_allclose(pairs[:3, 1], expected[1:4], atol=1e-4)
