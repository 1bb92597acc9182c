"""The night log of a server: notes of clients and events, kept when the front end is killed."""

from __future__ import annotations

import pytest
from serving import serving, until_idle, wait_for

from escape_hw.io.night_log import find_nights, read_night
from escape_hw.runtime.session.recordings import find_recordings


@pytest.mark.slow
def test_notes_and_events_survive_the_front_end(system, tmp_path) -> None:
    with serving(system, folder=tmp_path) as served, served.connect(control=True) as client:
        until_idle(client)
        note = client.add_note("first light")
        assert (note.kind, note.text) == ("note", "first light")
        assert note.author
        run = client.start("docrime", frames=300)
        run.wait(120)
        wait_for(lambda: any("run 1, docrime: done" in one.text for one in client.night_after(-1)), "logged")
        # A recording of some time, without the frames of the cameras.
        client.record(True, images=False, seconds=0.5)
        wait_for(lambda: bool(client.state.recording.path), "it records")
        wait_for(lambda: not client.state.recording.recording, "the recording ends by itself")
        assert client.state.recording.fault == ""
        (recording,) = find_recordings(tmp_path / "data" / "escape" / "runs")
        assert "frames" not in recording.streams
        assert recording.size == client.state.recording.size
        assert recording.description.simulated
        assert recording.description.rate_hz > 0
        (path,) = find_nights(tmp_path / "data" / "escape" / "runs")
        assert "first light" in [entry.text for entry in read_night(path)]
        front = served.front
        served.kill()
        wait_for(lambda: served.front not in (0, front), "another front end")
        with served.connect() as other:
            texts = [entry.text for entry in other.night_after(-1)]
            assert texts.index("first light") < next(
                k for k, text in enumerate(texts) if text.startswith("run 1, docrime: started (frames 300,")
            )
            assert sum(text.startswith("server started") for text in texts) == 2
            # What is published before it is connected again, it requests.
            wait_for(
                lambda: [one.text for one in client.night_after(-1)][: len(texts)] == texts, "all entries"
            )
            # Without control, and an alarm of a window.
            other.add_note("Strehl ratio below 20 %", kind="alarm")
        wait_for(lambda: any(one.kind == "alarm" for one in client.night_after(-1)), "it has the alarm")
        numbers = [entry.number for entry in client.night_after(-1)]
        assert numbers == sorted(set(numbers))
    assert read_night(path)[-1].text == "server ended, mirror flat"
    assert all(entry.simulated for entry in read_night(path))
