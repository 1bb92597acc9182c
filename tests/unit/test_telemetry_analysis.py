"""Analysis of telemetry: spectra, rejection, gains, suspicious elements; recordings on disk."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.signal import lfilter

from escape_hw.errors import ProductError, StorageError
from escape_hw.pipeline.control.integrator import gain_limit
from escape_hw.pipeline.telemetry import (
    LoopFacts,
    analyse,
    fill_lost_frames,
    optimal_gains,
    power_spectra,
    pseudo_open_loop,
    rejection,
    suspicious_actuators,
    suspicious_subapertures,
)
from escape_hw.runtime.session.recordings import (
    RecordingDescription,
    delete_recording,
    find_recordings,
    load_recording,
    write_description,
)
from escape_hw.streams.recording.block_file import (
    HEADER,
    count_entries,
    read_newest,
    read_recording,
    write_block,
)

RATE = 500.0


def closed_loop(
    turbulence: np.ndarray, gain: float, leak: float, delay: int
) -> tuple[np.ndarray, np.ndarray]:
    """Residuals, and the commands after each frame, of the leaky integrator."""
    residual, command = np.zeros_like(turbulence), np.zeros_like(turbulence)
    state = np.zeros(turbulence.shape[1])
    for k in range(len(turbulence)):
        seen = command[k - delay] if k >= delay else 0.0
        residual[k] = turbulence[k] + seen
        state = (1 - leak) * state - gain * residual[k]
        command[k] = state
    return residual, command


def coloured(rng: np.random.Generator, n: int, poles: tuple[float, ...]) -> np.ndarray:
    white = rng.standard_normal((n, len(poles)))
    return np.stack([lfilter([1.0], [1.0, -pole], white[:, k]) for k, pole in enumerate(poles)], axis=1)


def test_a_spectrum_integrates_to_the_variance():
    rng = np.random.default_rng(0)
    data = 3.0 * rng.standard_normal((20_000, 4))
    frequency, density = power_spectra(data, RATE)
    assert frequency[-1] == RATE / 2
    np.testing.assert_allclose(density.sum(axis=0) * frequency[0], 9.0, rtol=0.05)


def test_a_vibration_appears_at_its_frequency():
    time = np.arange(8192) / RATE
    frequency, density = power_spectra(np.sin(2 * np.pi * 60.0 * time)[:, None], RATE)
    assert frequency[np.argmax(density[:, 0])] == pytest.approx(60.0, abs=0.5)


@pytest.mark.parametrize(("gain", "leak", "delay"), [(0.4, 0.01, 2), (0.2, 0.0, 1), (0.3, 0.05, 3)])
def test_the_rejection_is_that_of_the_simulated_loop(gain: float, leak: float, delay: int):
    rng = np.random.default_rng(1)
    turbulence = rng.standard_normal((60_000, 4))
    residual, command = closed_loop(turbulence, gain, leak, delay)
    frequency, before = power_spectra(turbulence, RATE)
    after = power_spectra(residual, RATE)[1]
    measured = (after / before).mean(axis=1)
    expected = rejection(frequency, RATE, gain, leak, delay)
    at = frequency > 2.0
    np.testing.assert_allclose(measured[at], expected[at], rtol=0.25)
    np.testing.assert_allclose(
        pseudo_open_loop(residual, command, delay)[delay:], turbulence[delay:], atol=1e-4
    )


def test_the_optimal_gain_gives_the_smallest_residual_with_noise():
    rng = np.random.default_rng(2)
    turbulence = coloured(rng, 30_000, (0.999, 0.97, 0.8))
    noise = rng.standard_normal(turbulence.shape) * (0.1, 2.0, 3.0)
    frequency, density = power_spectra(turbulence + noise, RATE)
    best = optimal_gains(frequency, density, RATE, 0.0, 2.0)
    assert gain_limit(2.0) / 2 >= best[0] > 0.4
    assert best[0] > best[1] > best[2]
    # The wavefront error itself, without the noise of its own frame.
    errors = []
    for gain in (best[1] / 3, best[1], min(3 * best[1], 0.95)):
        measured, _ = closed_loop((turbulence + noise)[:, [1]], gain, 0.0, 2)
        errors.append(np.var(measured - noise[:, [1]]))
    assert errors[1] == min(errors)


def test_lost_frames_are_interpolated_and_too_many_are_refused():
    index = np.delete(np.arange(200), [50, 51, 120])
    filled, lost = fill_lost_frames(index, index[:, None].astype(float))
    assert lost == 3
    np.testing.assert_allclose(filled[:, 0], np.arange(200), atol=1e-4)
    with pytest.raises(ValueError, match="100 of 200 frames are missing"):
        fill_lost_frames(np.r_[0:99, 199], np.zeros((100, 1)))
    with pytest.raises(ValueError, match="3 frames are too few"):
        fill_lost_frames(np.arange(3), np.zeros((3, 1)))


def test_suspicious_elements_are_found_and_good_ones_are_not():
    rng = np.random.default_rng(3)
    commands = 0.1 * rng.standard_normal((1000, 97)) * rng.uniform(0.7, 1.4, 97)
    assert suspicious_actuators(commands) == []
    commands[:, 3], commands[:, 40], commands[:200, 50] = 0.2, commands[:, 40] * 12, 0.8
    found = {one.number: one.reason for one in suspicious_actuators(commands, 0.8)}
    assert found[3] == "does not move"
    assert "times as much" in found[40]
    reasons = [one.reason for one in suspicious_actuators(commands, 0.8) if one.number == 50]
    assert any("in 20% of the frames" in reason for reason in reasons)
    slopes = 0.3 * rng.standard_normal((1000, 200))
    assert suspicious_subapertures(slopes) == []
    slopes[:, 7] = slopes[:, 107] = 0.0
    slopes[:, 20] *= 20
    slopes[:, 130] += 3.0
    assert {one.number for one in suspicious_subapertures(slopes)} == {7, 20, 30}


def recorded(folder: Path, n: int = 2000, blocks: int = 8) -> tuple[np.ndarray, np.ndarray]:
    """A recording of three modes in closed loop; turbulence, and residual."""
    rng = np.random.default_rng(4)
    turbulence = coloured(rng, n, (0.99, 0.98, 0.97))
    residual, command = closed_loop(turbulence, 0.4, 0.01, 2)
    folder.mkdir(parents=True)
    arrived = np.arange(n) * 2_000_000
    data = {
        "slopes": (np.arange(n) + 7, arrived, residual @ rng.standard_normal((3, 40))),
        "commands": (np.arange(n), arrived + 100, command / 1000),
        "residual_modes": (np.arange(n) + 7, arrived + 200, residual),
    }
    for name, (index, at, values) in data.items():
        head = np.zeros(n, HEADER)
        head["index"], head["arrived_ns"] = index, at
        with open(folder / f"{name}.blocks", "wb", buffering=0) as file:
            for part in np.array_split(np.arange(n), blocks):
                write_block(file, head[part], values[part].astype(np.float32))
    write_description(folder, RecordingDescription("bench", True, "2026-11-22T21:00:00", RATE, 0.4, 0.01))
    return turbulence, residual


def test_a_recording_is_listed_analysed_and_deleted(tmp_path: Path):
    folder = tmp_path / "2026-11-22" / "213000_telemetry"
    turbulence, residual = recorded(folder)
    (summary,) = find_recordings(tmp_path)
    assert (summary.frames, summary.seconds) == (2000, 4.0)
    assert summary.streams == ("commands", "residual_modes", "slopes")
    assert summary.description.system == "bench"
    arrays, facts = load_recording(folder, 1024)
    assert arrays.index[-1] == 2006
    assert len(arrays.index) == 1024
    facts = LoopFacts(facts.rate_hz, facts.gain, facts.leak, 2.0, np.eye(3), 1000.0)
    analysis = analyse(arrays, facts)
    np.testing.assert_allclose(analysis.residual_rms_nm, residual[-1024:].std(axis=0), rtol=0.05)
    np.testing.assert_allclose(analysis.open_loop_rms_nm, turbulence[-1024:].std(axis=0), rtol=0.05)
    assert analysis.optimal_gain.shape == (3,)
    assert analysis.seconds == pytest.approx(2.048)
    (folder / "notes.txt").touch()
    with pytest.raises(StorageError, match=r"notes\.txt"):
        delete_recording(folder)
    (folder / "notes.txt").unlink()
    delete_recording(folder)
    assert not folder.exists()
    assert list(find_recordings(tmp_path)) == []


def test_the_newest_entries_of_a_file_that_is_being_written(tmp_path: Path):
    recorded(tmp_path / "r")
    path = tmp_path / "r" / "slopes.blocks"
    whole = read_recording(path)[0]
    with open(path, "ab") as file:
        file.write(path.read_bytes()[:3000])
    assert count_entries(path) == 2000
    newest = read_newest(path, 300)
    assert newest is not None
    np.testing.assert_array_equal(newest.data, whole.data[-300:])
    assert read_newest(path, 10**6).index.size == 2000


def test_a_file_that_is_no_recording_is_refused(tmp_path: Path):
    path = tmp_path / "slopes.blocks"
    path.write_text("no recording, but a text\n")
    with pytest.raises(ProductError, match="not a recording"):
        read_newest(path, 10)
    assert count_entries(path) == 0
    with open(path, "wb") as file:
        np.save(file, np.zeros(4))
        np.save(file, np.zeros((4, 2)))
    with pytest.raises(ProductError, match="not a recording"):
        read_newest(path, 10)
    with pytest.raises(ProductError, match="cannot be read"):
        read_newest(tmp_path / "none.blocks", 10)


@pytest.mark.parametrize("size", [0, 3, 9, 100, 300])
def test_a_recording_whose_first_block_is_being_written_has_no_entries(tmp_path: Path, size: int):
    recorded(tmp_path / "r")
    path = tmp_path / "r" / "slopes.blocks"
    path.write_bytes(path.read_bytes()[:size])
    assert read_newest(path, 10) is None


def test_an_open_loop_recording_has_spectra_of_slopes_only(tmp_path: Path):
    folder = tmp_path / "2026-11-22" / "213000_telemetry"
    recorded(folder)
    (folder / "residual_modes.blocks").unlink()
    (folder / "recording.json").unlink()
    analysis = analyse(*load_recording(folder))
    assert analysis.mode_psd.shape[1] == analysis.optimal_gain.size == 0
    assert analysis.slope_psd.size == analysis.frequency_hz.size
    (folder / "slopes.blocks").unlink()
    with pytest.raises(ProductError, match="no slopes are recorded yet"):
        load_recording(folder)
