"""The tracker on a bench that drifts, jumps, fails, loses its light or is stopped."""

from __future__ import annotations

import json
import threading
from dataclasses import replace

import numpy as np
import pytest
from small_bench import assert_flat, dead, small
from small_system import configuration

from escape_hw.api.registration import PARAMETERS, Registration
from escape_hw.api.results import Estimate, TemporalResponse
from escape_hw.calibration.loop.control import invert_matrix
from escape_hw.calibration.tracking.tracker import track
from escape_hw.cli import main
from escape_hw.errors import Aborted, CalibrationError, ConfigError
from escape_hw.io.fits.matrix import load_matrix, save_matrix
from escape_hw.io.provenance import Provenance
from escape_hw.pipeline.control.integrator import LeakyIntegrator
from escape_sim.mirror.surface import DriftingSurface, Flexure

JUMP = np.array([25.0, -15.0, 0.3, 0.0, 0.0])
QUIET = "twin.loss_probability=0"


@pytest.fixture(scope="module")
def start():
    """A calibration to track from."""
    with small(QUIET) as bench:
        return bench.calibrate(frames=600)


def followed(bench, start, seconds, *, at=None, do=None, **options):
    """Track, and do something to the twin once some seconds have passed."""
    twin = bench.dm.twin
    waiting = [do]

    def watch(progress):
        if progress.stage == "tracking" and at is not None and progress.done >= at and waiting:
            waiting.pop()(twin)

    options = {"response": start.response, "poke": 0.002, **options}
    procedure = track(
        bench, start.matrix, start.grid, seconds=seconds, registration=start.registration, **options
    )
    found = bench.run(procedure, observers=(watch,))
    assert_flat(bench)
    return found


def kinds(found):
    return {alarm.kind for alarm in found.alarms}


@pytest.mark.slow
def test_an_actuator_that_the_calibration_found_dead_is_no_alarm():
    with small(QUIET) as bench:
        dead(bench, 18)
        start = bench.calibrate(frames=600)
        assert start.registration.actuator_corrections.gain[18] < -0.5
        found = followed(bench, start, 6)
    assert found.stable
    assert "actuator" not in kinds(found)


def test_a_drift_is_followed_and_exchanged_without_a_transient(start, monkeypatch):
    swaps, steps = [], []
    answer, swap = LeakyIntegrator.__call__, LeakyIntegrator.set_reconstructor

    def answered(self, slopes):
        before = self.state.copy()
        after = answer(self, slopes)
        steps.append((float(np.linalg.norm(after - before)), float(np.linalg.norm(self.residual))))
        return after

    def swapped(self, matrix):
        before = self.state.copy()
        swap(self, matrix)
        np.testing.assert_array_equal(self.state, before)
        swaps.append(len(steps))

    monkeypatch.setattr(LeakyIntegrator, "__call__", answered)
    monkeypatch.setattr(LeakyIntegrator, "set_reconstructor", swapped)
    with small(QUIET, "twin.drift.rate.shift_x=1.5") as bench:
        origin = bench.dm.twin.now_s
        found = followed(bench, start, 9)
        truth = np.array([bench.dm.twin.flexure.at(origin + t).shift_x for t in found.rows["seconds"]])
    assert found.stable
    assert not found.alarms
    error = found.column("shift_x") - truth
    assert (np.abs(error) < 4 * found.column("shift_x_sigma")).all()
    assert np.abs(error[4:]).max() < 2.0
    accepted = [one for one in found.exchanges if one.accepted]
    assert len(accepted) == len(swaps) >= 2
    assert all(one.mismatch > 2 * one.mismatch_sigma for one in accepted)
    assert found.column("exchanged").sum() == len(accepted)
    command, residual = np.array(steps).T
    # The last exchange may come with the last frames.
    complete = [at for at in swaps if at + 5 <= len(command)]
    assert complete
    for at in complete:
        # The frames after an exchange are like those before it.
        before, after = slice(at - 100, at), slice(at, at + 5)
        assert command[after].max() < 1.5 * command[before].max()
        assert residual[after].max() < 1.5 * residual[before].max()


@pytest.mark.slow
def test_proposals_alone_change_nothing(start):
    with small(QUIET, "twin.drift.rate.shift_x=2.0") as bench:
        found = followed(bench, start, 5, exchange=False)
    assert found.exchanges
    assert not any(one.accepted for one in found.exchanges)
    assert not found.column("exchanged").any()
    assert found.exchanges[-1].change["shift_x"][0] > 5
    assert found.latest.matrix.method == "escape"
    np.testing.assert_array_equal(
        invert_matrix(found.latest.matrix, 4).shape, (found.latest.matrix.n_modes, start.grid.n_slopes)
    )


@pytest.mark.slow
def test_what_was_fitted_beside_the_registration_stays(start):
    extras = {"anamorphosis": Estimate(0.4, 0.1, "% of the diameter")}
    told = replace(start, registration=replace(start.registration, extras=extras))
    with small(QUIET) as bench:
        found = followed(bench, told, 2, exchange=False)
    stayed = found.latest.registration.extras
    assert set(stayed) == {"anamorphosis"}
    # The mirror has none, and small pokes tell a little of it.
    assert -0.1 < stayed["anamorphosis"].value < 0.5
    assert stayed["anamorphosis"].sigma < 0.15


@pytest.mark.slow
def test_a_matrix_without_a_registration_is_fitted_as_configured(start):
    with small(QUIET, 'calibration.extra_parameters=["anamorphosis"]') as bench:
        found = followed(bench, replace(start, registration=None), 2, exchange=False)
    assert set(found.latest.registration.extras) == {"anamorphosis"}
    assert abs(found.column("shift_x")[-1] - start.registration.registration.shift_x) < 3


@pytest.mark.slow
def test_too_large_a_change_is_not_exchanged_without_asking(start):
    with small(QUIET, "twin.drift.rate.shift_x=3.0", "tracking.exchange_limit=0.02") as bench:
        found = followed(bench, start, 5)
    assert found.exchanges
    assert not any(one.accepted for one in found.exchanges)


@pytest.mark.slow
def test_a_jump_raises_an_alarm_and_is_found_again(start):
    def jump(twin):
        there = Registration.from_array(twin.flexure.at(0.0).to_array() + JUMP)
        x = twin.pupil.coordinates_m
        moved = Flexure(there, twin.config.twin.drift)
        twin.flexure = moved
        twin._surface = DriftingSurface(twin.influence, moved, twin.pupil.sub_aperture_m, x, x)

    with small(QUIET) as bench:
        found = followed(bench, start, 13, at=6, do=jump)
        truth = bench.dm.twin.flexure.at(0.0).to_array()
    assert "jump" in kinds(found)
    assert found.alarms[0].seconds > 6
    last = np.array([found.rows[name][-1] for name in ("shift_x", "shift_y", "rotation")])
    sigma = np.array([found.rows[f"{name}_sigma"][-1] for name in ("shift_x", "shift_y", "rotation")])
    assert (np.abs(last - truth[:3]) < 5 * sigma).all()
    # Nothing was exchanged while the alarm was on.
    assert not [one for one in found.exchanges if 0 <= one.seconds - found.alarms[0].seconds <= 4]


@pytest.mark.slow
def test_a_failed_actuator_raises_an_alarm_that_no_registration_explains(start):
    def die(twin):
        send = twin.dynamics.command

        def without(time_s, shape):
            dead = shape.copy()
            dead[18] = 0.0
            send(time_s, dead)

        twin.dynamics.command = without

    with small(QUIET) as bench:
        found = followed(bench, start, 11, at=7, do=die)
    assert kinds(found) & {"misfit", "noise", "actuator"}
    assert found.alarms[0].seconds > 7


@pytest.mark.slow
@pytest.mark.parametrize(
    "more",
    [
        "twin.loss_probability=0.05",
        "twin.vibration.amplitude_rad=[4e-6,2e-6]",
        "devices.dm.limits.max_stroke=0.12",
        "devices.dm.limits.max_slew=0.03",
    ],
    ids=["lost frames", "vibration", "clipped by the stroke", "clipped by the slew"],
)
def test_faults_that_bias_nothing(start, more):
    with small(QUIET, more) as bench:
        truth = bench.dm.twin.flexure.at(0.0).to_array()
        found = followed(bench, start, 3)
    assert found.stable
    last = np.array([found.rows[name][-1] for name in PARAMETERS])
    sigma = np.array([found.rows[f"{name}_sigma"][-1] for name in PARAMETERS])
    # Twelve lenslets across five actuators: the scalings err by more than the noise.
    assert (np.abs(last - truth) < np.array([4, 4, 4, 6, 6]) * sigma).all()
    assert found.optical_gain.mean() == pytest.approx(1, abs=0.05)
    if "loss" in more:
        assert found.lost_frames == pytest.approx(found.frames * 0.05 / 0.95, rel=0.3)
        assert not found.alarms


@pytest.mark.slow
def test_a_wrong_delay_is_told_and_the_measured_one_taken(start):
    late = TemporalResponse(np.roll(start.response.weights, 1), start.response.sigma)
    with small(QUIET) as bench:
        truth = bench.dm.twin.flexure.at(0.0).to_array()
        found = followed(bench, start, 6, response=late)
    alarms = [alarm for alarm in found.alarms if alarm.kind == "delay"]
    assert len(alarms) == 1
    assert f"instead of {late.delay_frames:.2f}" in alarms[0].text
    assert found.latest.response.delay_frames == pytest.approx(start.response.delay_frames, abs=0.1)
    error = np.array([found.rows[name][-1] for name in PARAMETERS]) - truth
    assert (np.abs(error[:3]) < [3.0, 3.0, 0.15]).all()
    assert found.optical_gain.mean() == pytest.approx(1, abs=0.1)


@pytest.mark.slow
def test_a_script_tracks_what_it_calibrated(start):
    with small(QUIET) as bench:
        found = bench.track(start, seconds=2, poke=0.003, exchange=False)
        assert_flat(bench)
    assert found.poke == 0.003
    assert len(found.rows["seconds"]) == 2
    assert found.latest.registration.registration.shift_x == found.rows["shift_x"][-1]
    assert not any(one.accepted for one in found.exchanges)


def test_a_lost_star_ends_tracking_and_keeps_the_table(start):
    with small(QUIET) as bench:
        found = followed(bench, start, 9, at=2, do=lambda twin: setattr(twin, "beam_blocked", True))
    assert not found.stable
    assert kinds(found) >= {"dark"}
    assert "no light" in found.alarms[-1].text
    assert 1 <= len(found.rows["seconds"]) <= 3


@pytest.mark.slow
def test_a_loop_that_runs_away_is_opened_and_reported(start):
    def turn(twin):
        send = twin.dynamics.command
        twin.dynamics.command = lambda time_s, shape: send(time_s, -shape)

    with small(QUIET) as bench:
        found = followed(bench, start, 12, at=5, do=turn)
    assert not found.stable
    assert found.alarms[-1].kind == "diverged"
    assert found.alarms[-1].seconds > 5
    assert found.latest is not None


@pytest.mark.slow
def test_when_stopped_it_saves_its_data(start):
    stop = threading.Event()
    with small(QUIET) as bench:
        procedure = track(bench, start.matrix, start.grid, seconds=3600, registration=start.registration)
        with pytest.raises(Aborted) as caught:
            bench.run(procedure, observers=(lambda p: p.done >= 4 and stop.set(),), abort=stop)
        assert_flat(bench)
    found = caught.value.partial
    assert found.partial
    assert len(found.rows["seconds"]) >= 3
    assert found.latest is not None
    assert found.to_csv().count("\n") == len(found.rows["seconds"]) + 1


@pytest.mark.slow
def test_the_command_leaves_table_matrix_and_report(start, tmp_path, capsys):
    system, im = tmp_path / "small.toml", tmp_path / "im.fits"
    system.write_text(configuration(QUIET, "twin.drift.rate.shift_x=1.0").to_toml())
    save_matrix(im, start, Provenance(system.read_text(), "kl", 1))
    with pytest.raises(SystemExit) as ended:
        main(["track", str(system), "--im", str(im), "--seconds", "3", "--no-strehl", "--json",
              "--out", str(tmp_path / "run"), "--poke", "0.003"])  # fmt: skip
    assert not ended.value.code
    document = json.loads(capsys.readouterr().out)
    assert document["command"] == "track"
    assert document["poke"] == 0.003
    assert document["alarms"] == []
    assert set(document["registration"]) == set(PARAMETERS)
    assert len(document["track"]["seconds"]) == 3
    injected, seconds = document["injected_course"]["shift_x"], document["track"]["seconds"]
    # The drift began when the bench was switched on, so the twin's clock counts.
    np.testing.assert_allclose(np.diff(injected), np.diff(seconds), rtol=1e-6)
    assert abs(injected[-1] - document["track"]["shift_x"][-1]) < 3.0
    assert document["injected_end"]["shift_x"] == injected[-1]
    assert len(document["optical_gain"]) == start.matrix.n_modes
    lines = (tmp_path / "run" / "track.csv").read_text().splitlines()
    assert lines[0].split(",")[:2] == ["seconds", "shift_x"]
    assert len(lines) == 4
    saved = load_matrix(tmp_path / "run" / "im.fits")
    assert saved.registration.registration.shift_x == pytest.approx(float(lines[-1].split(",")[1]), abs=1e-3)
    assert "Tracking" in (tmp_path / "run" / "report.html").read_text()


def test_what_it_refuses(start):
    with small(QUIET) as bench:
        sent = bench.dm.sent_count
        for wrong in (
            {"seconds": 0.0},
            {"seconds": 5, "poke": 0.0},
            {"seconds": 5, "forgetting_time_s": -1.0},
        ):
            with pytest.raises(ConfigError, match="at least"):
                bench.run(track(bench, start.matrix, start.grid, **wrong))
        empty = np.zeros_like(start.matrix.data)
        with pytest.raises(CalibrationError):
            bench.run(track(bench, start.matrix.__class__(empty, *_rest(start.matrix)), start.grid))
        assert bench.dm.sent_count == sent


def _rest(matrix):
    return matrix.sigma, matrix.m2c, matrix.valid, matrix.system, matrix.method, True
