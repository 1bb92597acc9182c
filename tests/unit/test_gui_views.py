"""Contents of the panels, without a window: mosaics, time series, curves, forms."""

from __future__ import annotations

import fake_results as fake
import numpy as np
import pytest

from escape_gui.views import mode_maps as mosaic
from escape_gui.views import procedure_form as form
from escape_gui.views.convergence import ConvergenceHistory, RegistrationDrift
from escape_gui.views.gain_curves import GainCurve, axis_sides, live_curve
from escape_gui.views.mode_maps import ModeStatistics, MosaicLayout, tiles
from escape_hw.api.registration import TO_STREAM_UNITS
from escape_hw.remote.state import (
    ActiveRun,
    Finish,
    FinishedRun,
    ProcedureParameter,
    ProcedurePlan,
    ProductEntry,
)


# ---------------------------------------------------------------- mosaic
@pytest.mark.parametrize("layout", [MosaicLayout((7, 5), 3, 2), MosaicLayout((12, 12), 4, 3, head=5)])
def test_every_pixel_of_every_map_is_found_again(layout):
    for place in range(layout.per_page):
        top, left = layout.corner(place)
        for part in (0, 1):
            start = left + part * (layout.shape[1] + 1)
            for row in range(layout.shape[0]):
                for column in range(layout.shape[1]):
                    found = layout.at(top + row + 0.5, start + column + 0.5)
                    assert found == (place, "xy"[part], row, column)
    assert layout.at(0.0, 0.0) is None
    assert layout.at(-5.0, layout.size[1] + 5.0) is None


def test_a_painted_page_holds_the_matrix():
    matrix = fake.matrix(n=12, n_modes=20)
    layout = mosaic.fit_layout(matrix.valid.shape, 20, (600.0, 400.0), 100.0, 12.0)
    statistics = ModeStatistics.of(matrix.data, matrix.sigma)
    values = mosaic.normalise_modes(matrix.data, statistics, weight_by_snr=False)
    np.testing.assert_allclose(np.sqrt(np.mean(values**2, axis=0)), 1.0, rtol=1e-5)
    pages = mosaic.pages(layout, 20)
    assert pages * layout.per_page >= 20
    modes = mosaic.page_modes(layout, 20, pages + 3)
    assert modes.stop == 20
    picture = mosaic.render_page(layout, matrix.valid, values, modes)
    assert picture.shape == layout.size
    for place, mode in enumerate(modes):
        top, left = layout.corner(place)
        x, _ = matrix.maps(mode)
        shown = picture[top : top + 12, left : left + 12].astype(float)
        assert (shown[~matrix.valid] == mosaic.OUTSIDE).all()
        expected = np.clip(x[matrix.valid] / statistics.rms[mode], -mosaic.LIMIT, mosaic.LIMIT)
        np.testing.assert_allclose(
            (shown[matrix.valid] - mosaic.ZERO) / 127 * mosaic.LIMIT, expected, atol=mosaic.LIMIT / 254 + 1e-6
        )
    used = np.zeros(layout.size, bool)
    for place in range(len(modes)):
        top, left = layout.corner(place)
        used[top : top + 12, left : left + 25] = True
    assert (picture[~used] == mosaic.OUTSIDE).all()


def test_fading_hides_noise_and_keeps_signal():
    rng = np.random.default_rng(0)
    sigma = np.ones((2000, 3), np.float32)
    data = rng.standard_normal((2000, 3)).astype(np.float32) * [1.0, 1.0, 1.0] + [0.0, 1.0, 30.0]
    wiener_weight = ModeStatistics.of(data, sigma).wiener_weight()
    assert wiener_weight[0] < 0.1
    assert abs(wiener_weight[1] - 0.5) < 0.05
    assert wiener_weight[2] > 0.99
    assert (ModeStatistics.of(data, None).wiener_weight() == 1).all()


def test_modes_that_were_not_measured_stay_empty():
    data = fake.matrix(n=12, n_modes=4).data.copy()
    data[:, 2] = np.nan
    values = mosaic.normalise_modes(data, ModeStatistics.of(data, np.ones_like(data)), weight_by_snr=True)
    assert (mosaic.colour_indices(values[:, 2]) == mosaic.OUTSIDE).all()
    assert (mosaic.colour_indices(values[:, 1]) != mosaic.OUTSIDE).all()


def test_the_layout_uses_the_window():
    small = mosaic.fit_layout((24, 24), 94, (400.0, 300.0), 100.0, 12.0)
    large = mosaic.fit_layout((24, 24), 94, (1600.0, 1000.0), 100.0, 12.0)
    assert small.per_page < large.per_page
    assert large.columns <= 16
    few = mosaic.fit_layout((24, 24), 3, (1600.0, 1000.0), 100.0, 12.0)
    assert few.per_page >= 3
    assert mosaic.fit_layout((24, 24), 5, (0.0, 0.0), 100.0, 12.0).per_page == 1


# ---------------------------------------------------------------- one mode
def test_one_mode_in_every_matrix():
    matrices = {
        "push-pull": fake.matrix("push-pull", n=12, n_modes=20),
        "ESCAPE": fake.matrix("escape", noise=0.0, n=12, n_modes=20),
        "short": fake.matrix("docrime", n=12, n_modes=3),
    }
    shown = {tile.title: tile for tile in tiles(matrices, 10)}
    assert list(shown) == [
        "push-pull", "ESCAPE", "ESCAPE − push-pull", "Error of push-pull", "SNR of push-pull",
    ]  # fmt: skip
    outside = ~matrices["ESCAPE"].valid
    for tile in shown.values():
        assert np.isnan(tile.maps[:, :12][outside]).all()
    a, b = (matrices[name].data[:, 10] for name in ("ESCAPE", "push-pull"))
    correlation = float(a @ b / np.sqrt((a @ a) * (b @ b)))
    assert f"correlation {correlation:.3f}" in shown["ESCAPE − push-pull"].note
    same = tiles({"one": matrices["ESCAPE"], "other": matrices["ESCAPE"]}, 0)
    assert not np.nan_to_num(same[2].maps).any()


# ---------------------------------------------------------------- SPRINT
def test_a_track_is_shown_in_the_papers_units():
    values = np.array([[1.0, -2.0, 0.5, 3.0, 0.0], [2.0, -71.0, -0.77, 2.9, 0.0]])
    course = ConvergenceHistory.of(
        values * TO_STREAM_UNITS, np.full(5, 0.1) * TO_STREAM_UNITS, np.array([0.0, 0.3]), True
    )
    np.testing.assert_allclose(course.values, values)
    np.testing.assert_allclose(course.sigma, 0.1)
    assert np.isnan(course.step_norm[0])
    assert course.step_norm[1] == 0.3
    drawn = course.normalise()
    assert np.abs(drawn.values).max() <= 1.0
    np.testing.assert_allclose(drawn.values[1], [1, -1, -1, 2.9 / 3, 0])
    np.testing.assert_allclose(drawn.sigma[:2], [0.1 / 2, 0.1 / 71])
    assert course.headline() == "converged, 2 iterations"
    assert "NOT" in ConvergenceHistory.of(values, None, None, False).headline()
    poor = ConvergenceHistory.of(values, None, None, True, False)
    assert poor.normalise().headline() == "converged, but the model does not fit, 2 iterations"
    # Read a moment apart, the streams may differ by an iteration.
    assert np.isnan(ConvergenceHistory.of(values, None, np.array([0.1, 0.2, 0.3, 0.4])[:1]).step_norm[1])
    assert ConvergenceHistory.of(values, None, np.arange(5.0)).step_norm.shape == (2,)


def test_drift_counts_from_the_first_known_value():
    track = np.zeros((4, 11))
    track[:, 0] = [0, 3600, 7200, 4 * 3600]
    track[:, 1:6] = np.outer([np.nan, 5.0, 6.0, 9.0], np.ones(5)) * TO_STREAM_UNITS
    drift = RegistrationDrift.of(track, [(7200.0, "exchange")])
    assert drift.unit == "h"
    assert drift.marks == ((2.0, "exchange"),)
    np.testing.assert_allclose(drift.since_start()[1:, 2], [0, 1, 4])
    assert RegistrationDrift.of(np.zeros((0, 11))).since_start().shape == (0, 5)


# ---------------------------------------------------------------- optical gains
def test_gains_are_on_two_axes_where_needed():
    low, high = (GainCurve.of(str(level), fake.optical_gains(level)) for level in (0.6, 1.9))
    assert axis_sides({"low": low, "high": high}) == {"low": "left", "high": "right"}
    assert axis_sides({"high": high}) == {"high": "left"}
    assert np.isnan(low.value[4])
    live = live_curve("now", np.ones(20), np.full(20, np.inf), None, np.ones((2, 20)))
    assert np.isnan(live.sigma).all()
    assert np.isnan(live.median)
    assert live.rounds.shape == (2, 20)
    assert live_curve("now", np.ones(20), np.ones(3), None, np.ones((2, 3))).rounds.shape == (0, 20)


# ---------------------------------------------------------------- forms and words
FRAMES = ProcedureParameter(name="frames", kind="int", default=1000, unit="frame", low=1, high=1e6)
SNR = ProcedureParameter(name="snr", kind="float", low=0.01)


@pytest.mark.parametrize(
    ("parameter", "text", "value"),
    [(FRAMES, "200", 200), (FRAMES, "1e3", 1000), (SNR, "", None), (SNR, "2.5", 2.5), (SNR, "–", None)],
)
def test_fields_are_understood(parameter, text, value):
    found = form.parse_value(parameter, text)
    assert found == value
    assert type(found) is type(value)


@pytest.mark.parametrize("text", ["", "many", "0", "1.5", "nan", "1e9", "−3"])
def test_wrong_fields_say_what_would_do(text):
    with pytest.raises(ValueError, match=r"^Frames: .+"):
        form.parse_value(FRAMES, text)


def test_only_what_differs_is_sent():
    assert form.non_default_arguments((FRAMES, SNR), {"frames": 1000, "snr": 3.0}) == {"snr": 3.0}


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(8.04, "8.0 s"), (252, "4:12 min"), (3723, "1:02:03"), (float("nan"), "–"), (59.99, "60.0 s")],
)
def test_lengths_of_time(seconds, text):
    assert form.format_duration(seconds) == text


def test_progress_as_text():
    run = ActiveRun(
        id=1, name="docrime", arguments={}, stage="DO-CRIME", completed=610, total=1000, remaining_s=252
    )
    assert form.progress_line(run) == "DO-CRIME: 610 of 1000 frames, 4:12 min left"
    assert form.progress_line(run.model_copy(update={"paused": True})).startswith("Paused")
    endless = run.model_copy(update={"total": 0, "remaining_s": None})
    assert form.progress_line(endless) == "DO-CRIME: 610 frames"
    assert form.worst_mode(np.array([5.0, 3.1, np.nan, np.inf])) == "worst mode 2: SNR 3.1"
    assert form.worst_mode(np.array([np.nan])) == ""
    aborted = FinishedRun(
        id=1, name="escape", finish=Finish.ABORTED, message="stopped; the data measured so far are saved"
    )
    assert form.result_line(aborted) == "Aborted: escape. stopped; the data measured so far are saved"
    failed = FinishedRun(id=1, name="escape", finish=Finish.FAILED, message="too dark")
    assert form.result_line(failed) == "Failed: escape. too dark"


def test_a_result_is_compared_with_the_one_before():
    now = {"registration": {"shift_x": {"value": 3.0, "sigma": 0.3}}, "gain": 1.02, "snr": {"min": 9.0}}
    before = {"registration": {"shift_x": {"value": 1.0, "sigma": 0.4}}, "gain": 1.0, "snr": {"min": 7.0}}
    lines = form.comparison_lines(now, before)
    assert lines[0] == "Shift x: 3.00 ± 0.30 % sub-ap. (Δ 2.00 ± 0.50)"
    assert lines[1] == "Gain of the matrix: 1.02 (before: 1)"
    assert lines[2] == "SNR of the worst mode: 9 (before: 7)"
    assert form.comparison_lines({}, None) == []


def test_results_of_every_procedure_are_stated_in_numbers():
    loop = {
        "gain": 0.4, "residual_rms_nm": 44.2, "strehl": {"peak": {"value": 0.365, "sigma": 0.004}},
        "frames": 2000, "rate_hz": 500.0, "lost_frames": 3, "simulated": True,
    }  # fmt: skip
    assert form.comparison_lines(loop, {**loop, "strehl": 0.3}) == [
        "Gain of the loop: 0.4 (before: 0.4)",
        "Residual: 44.2 nm rms (before: 44.2 nm rms)",
        "Strehl ratio: 36.5 % (before: 30.0 %)",
        "Frames measured: 2000, 4.0 s (simulated), 3 lost",
    ]
    gains = {"optical_gain": [0.5, 0.7], "exchanges": [{"accepted": True}, {}], "alarms": [{}]}
    assert form.comparison_lines(gains, None) == [
        "Optical gain: mean 0.600, 0.500 to 0.700", "Matrix exchanged: 1 of 2 proposals", "Alarms: 1",
    ]  # fmt: skip
    sensor = {"n_sub_apertures": 448, "counts": 3426.0, "background": 1.1}
    assert form.comparison_lines(sensor, None)[0] == "Sub-apertures: 448"


def test_rates_of_a_twin_are_marked():
    plan = ProcedurePlan(name="docrime", arguments={}, frames=1000, seconds=2.0, stroke=0.02)
    assert form.plan_lines(plan)[0] == "1000 sensor frames; 2.0 s at the camera's frame rate"
    simulated = form.plan_lines(plan, simulated=True)
    assert simulated[0] == "1000 sensor frames; 2.0 s at the simulated frame rate of the camera"


def test_the_newest_matrix_is_offered_first():
    kinds = (("im", "matrix"), ("psf", "psf"), ("escape-2", "matrix"))
    products = tuple(ProductEntry(name=name, kind=kind, path="/x") for name, kind in kinds)
    assert form.matrices(products) == ("escape-2", "im")
