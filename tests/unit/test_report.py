"""Contents of figures, and the report as one valid, self-contained page."""

from __future__ import annotations

import dataclasses
import json
import math
import re
from dataclasses import replace
from html.parser import HTMLParser

import fake_results as fake
import numpy as np
import pytest

from escape_hw.api.registration import PARAMETERS
from escape_hw.api.results import Estimate
from escape_hw.config import layouts
from escape_hw.errors import IncompatibleProduct, ProductError
from escape_hw.io import documents
from escape_hw.io.fits.gains import save_gains
from escape_hw.io.fits.loop import save_loop
from escape_hw.io.fits.matrix import save_matrix
from escape_hw.io.run_folder import RunFolder
from escape_hw.report import comparison, tables
from escape_hw.report import run_report as build
from escape_hw.report.content import RunContent, read_run
from escape_hw.report.figures import bench as figures_bench
from escape_hw.report.figures import matrix as figures_matrix
from escape_hw.report.figures import registration as figures_registration
from escape_hw.report.figures import residual as figures_residual
from escape_hw.report.figures import style
from escape_hw.report.run_report import draw_picture, write_picture, write_report

LOOPS = {
    "push-pull": fake.loop("push-pull", strehl=0.63),
    "ESCAPE": fake.loop("escape", strehl=0.62),
}


def make_run(folder, *, simulated=True, partial=False, lean=False, title="A <title> & more"):
    """A run folder with everything a report can show (or, lean, one matrix), on a small sensor."""
    with RunFolder("razor-shwfs", "test", folder) as run:
        run.write_config("# <script>alert(1)</script>\nschema = 1\n")
        for method in ("push-pull",) if lean else ("push-pull", "escape"):
            result = fake.calibration(method, n=8, n_modes=6, partial=partial)
            run.add_product(method, save_matrix(run.file(f"{method}.fits"), result))
        for label, loop in () if lean else LOOPS.items():
            loop = dataclasses.replace(loop, partial=partial)
            run.add_product(
                f"loop {label}", save_loop(run.file(f"loop-{label}.fits"), loop, "razor-shwfs", simulated)
            )
        run.write_result(
            {
                **documents.header_fields("test", "razor-shwfs", simulated, 1),
                "title": title,
                "injected": fake.INJECTED.to_dict(),
                "labels": {"escape": {"label": "ESCAPE", "measured": "DO-CRIME", "column": "SHORT"}},
                "bench": {
                    "psf_px": 2.46,
                    "full_scale": 1023,
                    "layout": ["".join("01"[int(v)] for v in row) for row in fake.layout()],
                },
                "scans": {} if lean else {k: [documents.loop_document(loop)] for k, loop in LOOPS.items()},
                "criteria": [{"text": "a met one", "met": True}, {"text": "a missed one", "met": False}],
                "sky_time": None if lean else fake.sky_time(),
            }
        )
    return run.path


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    return write_report(make_run(tmp_path_factory.mktemp("report") / "run")).read_text(encoding="utf-8")


class Checker(HTMLParser):
    """Collects ids and references, and sees that every element is closed."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.ids: list[str] = []
        self.outside: list[str] = []

    def handle_starttag(self, tag, attrs):
        if tag not in ("meta", "br"):
            self.open.append(tag)
        self._note(attrs)

    def handle_startendtag(self, tag, attrs):
        self._note(attrs)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def _note(self, attrs):
        for name, value in attrs:
            if name == "id":
                self.ids.append(value)
            if name in ("src", "href", "xlink:href") and not value.startswith(("#", "data:")):
                self.outside.append(value)


def test_page_says_that_the_model_does_not_fit(tmp_path):
    result = fake.calibration(n=8, n_modes=6, fits=False)
    with RunFolder("razor-shwfs", "test", tmp_path / "run") as run:
        run.add_product("escape", save_matrix(run.file("escape.fits"), result))
        run.write_result({
            **documents.header_fields("test", "razor-shwfs", True, 1),
            **documents.calibration_document(result), "warnings": [],
        })  # fmt: skip
    text = write_report(run.path).read_text(encoding="utf-8")
    assert '<p class="verdict usable" role="status">Usable: converged, but the model does not fit' in text
    assert "<li>the model does not fit: 14% of the matrix remain</li>" in text
    assert "Residual of the fit: rms over all modes" in text


def test_every_note_is_stated_once_where_it_belongs(tmp_path):
    """Notes of a calibration are those of its measurement and those of its registration."""
    of_matrix, of_loop, of_run = "7 frames lost: 0.07 %", "the loop diverged", "no curve of error"
    result = fake.calibration(n=8, n_modes=6, fits=False)
    found = replace(result.registration, warnings=("the steps did not shrink",))
    of_registration = (*found.warnings, *found.notes)
    result = replace(result, registration=found, notes=(of_matrix, *of_registration))
    loop = replace(fake.loop(), notes=(of_loop,))
    with RunFolder("razor-shwfs", "test", tmp_path / "run") as run:
        run.add_product("escape", save_matrix(run.file("escape.fits"), result))
        run.add_product("loop", save_loop(run.file("loop.fits"), loop, "razor-shwfs", True))
        run.write_result({
            **documents.header_fields("test", "razor-shwfs", True, 1),
            "notes": [*result.notes, of_loop, of_run],
        })  # fmt: skip
    sections = write_report(run.path).read_text(encoding="utf-8").split("<h2>")
    for title, notes in {
        "Registration": of_registration,
        "Interaction matrices": (of_matrix,),
        "Closed loop": (of_loop,),
        "Notes": (of_run,),
    }.items():
        for note in notes:
            (section,) = (one for one in sections if note in one)
            assert section.startswith(title)
            assert section.count(note) == 1


def test_a_note_of_two_calibrations_is_stated_once(page):
    assert page.count("<li>push-pull and ESCAPE: 7 frames lost: 0.07 %</li>") == 1
    assert page.count("7 frames lost") == 1


@pytest.mark.parametrize("layout", [fake.layout(), None, np.ones((2, 2), dtype=bool)])
def test_residual_map_marks_the_outliers(layout):
    lenslets = fake.grid(8)
    found = fake.goodness_of_fit(lenslets.n_valid, fits=False)
    figure = figures_residual.residual_map(found, lenslets.valid, layout)
    pupil, mirror = figure.axes[:2]
    assert np.flatnonzero(pupil.collections[0].get_linewidths()).tolist() == [0, 1, 2]
    assert pupil.get_title().startswith("sub-apertures: median 1, largest")
    if layout is not None and layout.sum() == 97:
        assert np.flatnonzero(mirror.collections[0].get_linewidths()).tolist() == [23]
    else:
        assert mirror.get_xlabel() == "actuator"


def test_an_actuator_that_was_not_poked_is_not_drawn_as_a_good_fit():
    lenslets = fake.grid(8)
    found = fake.goodness_of_fit(lenslets.n_valid)
    by_actuator = np.array(found.by_actuator)
    by_actuator[5] = 0.0
    figure = figures_residual.residual_map(
        replace(found, by_actuator=by_actuator), lenslets.valid, fake.layout()
    )
    colours = figure.axes[1].collections[0].get_facecolor()
    assert colours[5][3] < 0.5
    assert (np.delete(colours, 5, axis=0)[:, 3] == 1).all()


def test_page_is_sound_and_self_contained(page):
    checker = Checker()
    checker.feed(page)
    assert checker.open == []
    assert checker.outside == []
    assert len(checker.ids) == len(set(checker.ids))
    assert "<script" not in page
    assert "@import" not in page
    used = set(re.findall(r'(?:url\(#|href="#)([^")]+)', page))
    assert used <= set(checker.ids)


def test_page_shows_everything(page):
    assert "A &lt;title&gt; &amp; more" in page
    for word in (
        "SIMULATED", "SPRINT convergence", "Stacked closed-loop PSFs", "Interaction matrices", "Sky time",
        "Residual wavefront", "last mirror command", "Mean frame of the sensor", "best gain", "a missed one",
        "α SHORT", "injected", "Signal-to-noise", "Temporal response", "Configuration",
        "&lt;script&gt;alert(1)",
        '<p class="verdict not-usable" role="status">Not usable: not met: a missed one; see the report</p>',
        "Influence functions that SPRINT has found", "Sensor and mirror", "the camera saturates at 1,023 ADU",
    ):  # fmt: skip
        assert word in page, word
    assert page.count("<figure>") == 13
    assert "ABORTED" not in page


def test_neutral_colours_follow_the_page(page):
    assert "var(--ink)" in page
    assert style.INK not in page.split("</style>", 1)[1]
    assert "prefers-color-scheme: dark" in page


@pytest.mark.slow
def test_same_run_gives_the_same_page(tmp_path):
    folder = make_run(tmp_path / "run", lean=True)
    first = write_report(folder).read_bytes()
    assert write_report(folder).read_bytes() == first


def test_hardware_and_aborted_runs_are_marked(tmp_path):
    text = write_report(make_run(tmp_path / "run", simulated=False, partial=True, lean=True)).read_text()
    assert ">HARDWARE<" in text
    assert "ABORTED BY THE OPERATOR" in text
    assert "SIMULATED" not in text


def test_damaged_product_stops_the_report(tmp_path):
    folder = make_run(tmp_path / "run")
    file = folder / "escape.fits"
    file.write_bytes(file.read_bytes()[:-2880])
    with pytest.raises(ProductError, match=r"escape\.fits"):
        write_report(folder)
    assert not (folder / "report.html").exists()


def test_mode_maps_show_every_matrix_and_mode():
    matrices = {"a": fake.matrix(n=8, n_modes=20), "b": fake.matrix(n=8, n_modes=12)}
    figure = figures_matrix.mode_maps(matrices, 8)
    cells = figure.axes[:-1]
    assert len(cells) == 16
    assert [cell.get_ylabel() for cell in cells[::2]][:2] == ["mode 1", "mode 4"]
    assert cells[-2].get_ylabel() == "mode 20"
    assert not cells[-1].images  # the second matrix has no mode 20
    rgba = cells[0].images[0].get_array()
    assert rgba.shape == (8, 17, 4)
    assert np.all(rgba[:, 8, 3] == 0)


def test_mode_maps_share_a_scale_after_normalisation():
    plain = fake.matrix(noise=0.0, n=8, n_modes=5)
    loud = dataclasses.replace(plain, data=plain.data * np.array([1, 3, 10, 0.1, 7], np.float32))
    figure = figures_matrix.mode_maps({"plain": plain, "loud": loud}, 5)
    for left, right in zip(figure.axes[0:-1:2], figure.axes[1:-1:2], strict=True):
        np.testing.assert_allclose(left.images[0].get_array(), right.images[0].get_array(), atol=0.02)


def test_empty_mode_and_missing_errors_draw():
    blank = dataclasses.replace(fake.matrix(n=8, n_modes=5), data=np.zeros((104, 5), np.float32))
    style.png(figures_matrix.mode_maps({"blank": blank}), 40)
    computed = fake.matrix("escape", noise=0.0, n=8, n_modes=5)
    style.png(figures_matrix.errors_per_mode({"ESCAPE": computed}), 40)


def test_convergence_draws_parameters_truth_and_errors():
    estimate = fake.registration()
    figure = figures_registration.convergence(estimate, fake.INJECTED)
    assert len(figure.axes) == 6
    assert figure.axes[0].get_yscale() == "log"
    for panel, name in zip(figure.axes[1:], PARAMETERS, strict=True):
        track, truth = panel.lines
        np.testing.assert_allclose(
            track.get_ydata(), [getattr(step.registration, name) for step in estimate.iterations]
        )
        assert truth.get_ydata()[0] == getattr(fake.INJECTED, name)
        assert "[" in panel.get_ylabel()


def test_a_change_of_the_model_is_a_gap_in_the_step_norm():
    estimate = fake.registration()
    steps = [
        *estimate.iterations[:2],
        replace(estimate.iterations[1], step_norm=0.0),
        *estimate.iterations[2:],
    ]
    changed = replace(estimate, iterations=tuple(steps))
    (drawn,) = figures_registration.convergence(changed).axes[0].lines
    assert np.isnan(drawn.get_ydata()[2])
    assert len(drawn.get_ydata()) == len(steps)


def test_a_report_of_optical_gains_states_its_own_frames(tmp_path):
    result = fake.gains_result()
    rescaled = fake.calibration(n=8, n_modes=6)
    with RunFolder("razor-shwfs", "gains", tmp_path / "run") as run:
        run.add_product("gains", save_gains(run.file("gains.fits"), result, "razor-shwfs", True))
        run.add_product("im", save_matrix(run.file("im.fits"), rescaled))
        run.write_result(
            {
                **documents.header_fields("gains", "razor-shwfs", True, 1),
                **documents.gains_document(result),
            }
        )
    page = write_report(run.path).read_text(encoding="utf-8")
    assert page.count(": frames</dt>") == 1
    assert f"<dd>{result.frames:,}</dd>" in page


def test_loops_without_images_or_strehl_draw():
    bare = dataclasses.replace(
        LOOPS["ESCAPE"], strehl=None, psf=None, model_psf=None, residual_nm=np.zeros(0)
    )
    style.png(figures_bench.stacked_psfs({"bare": bare}), 40)
    style.png(figures_bench.residual_strip({"bare": bare}), 40)
    only = dataclasses.replace(LOOPS["ESCAPE"], strehl=None, model_psf=None)
    style.png(figures_bench.stacked_psfs({"only": only}), 40)
    style.png(figures_bench.mirror_on_grid(np.zeros(97), fake.layout()), 40)


def test_a_mirror_without_a_grid_is_drawn_where_its_actuators_stand(tmp_path):
    places = layouts.positions("rings-336") * 0.03
    command = np.zeros(336)
    command[7] = 0.6
    figure = figures_bench.mirror_without_grid(command, places)
    style.png(figure, 40)
    (spots,) = figure.axes[0].collections
    colours = spots.get_facecolor()
    assert len(spots.get_paths()) == 336
    assert colours[7, 0] > colours[7, 2]  # a push is red
    assert colours[8, 0] == pytest.approx(colours[8, 2], abs=0.02)
    centre = spots.get_paths()[7].get_extents()
    assert (centre.x0 + centre.x1) / 2 == pytest.approx(places[7, 0])
    assert (centre.y0 + centre.y1) / 2 == pytest.approx(places[7, 1])
    run = RunContent(tmp_path, {"bench": {"layout": [], "places_m": places.tolist()}})
    assert run.layout is None
    assert run.places_m == pytest.approx(places)
    assert build._mirror_figure(run, command) is not None
    assert build._mirror_figure(run, np.zeros(5)) is None


@pytest.mark.parametrize(
    ("value", "sigma", "text"),
    [
        (-15.1834, 0.4, "−15.18 ± 0.40"),
        (-0.7652, 0.0123, "−0.765 ± 0.012"),
        (2.9, 0.052, "2.900 ± 0.052"),
        (-0.0001, 0.06, "0.000 ± 0.060"),
        (12.0, 340.0, "12 ± 340"),
        (1.5, 0.0, "1.5"),
        (math.nan, math.nan, "nan ± nan"),
        (3.0, math.inf, "3 ± inf"),
    ],
)
def test_numbers_are_rounded_to_their_error(value, sigma, text):
    assert tables.format_with_error(Estimate(value, sigma)) == text


def test_registration_table_has_the_papers_form():
    short, long = fake.registration(seed=3), fake.registration(0.3, seed=4)
    table = tables.registration_table({"SHORT": short, "LONG": long}, fake.INJECTED)
    assert table.headings[0::2] == ("Component", "Δ / σ", "Δ / σ")
    assert (table.headings[1], table.headings[3], table.headings[-1]) == ("α SHORT", "α LONG", "injected")
    assert [row[0] for row in table.rows] == [
        "Shift X [% of Sub Aperture]",
        "Shift Y [% of Sub Aperture]",
        "Rotation [deg]",
        "Radial Scaling [% of Diameter]",
        "Tangential Scaling [% of Diameter]",
    ]
    assert table.rows[1][-1] == "−71"


def test_compare_finds_gain_and_difference():
    a = fake.calibration("escape", n=8, n_modes=6)
    scaled = dataclasses.replace(a.matrix, data=a.matrix.data * np.float32(1.1))
    result = comparison.compare(a, dataclasses.replace(a, matrix=scaled))
    np.testing.assert_allclose(result.correlation, 1, rtol=1e-6)
    np.testing.assert_allclose(result.gain_ratio, 1.1, rtol=1e-5)
    np.testing.assert_allclose(result.relative_rms, 0.1, rtol=1e-4)
    assert result.total_relative_rms == pytest.approx(0.1, rel=1e-4)
    assert all(value.value == 0 and value.sigma > 0 for value in result.registration.values())


def test_compare_uses_the_common_sub_apertures():
    a = fake.calibration("push-pull", n=8, n_modes=6)
    n = a.grid.n_valid
    valid = a.matrix.valid.copy()
    valid[tuple(np.argwhere(valid)[0])] = False
    keep = np.tile(np.arange(n) > 0, 2)
    fewer = dataclasses.replace(a.matrix, data=a.matrix.data[keep], sigma=a.matrix.sigma[keep], valid=valid)
    result = comparison.compare(a, dataclasses.replace(a, matrix=fewer))
    assert result.common == n - 1
    assert result.total_relative_rms == 0


def test_compare_refuses_another_basis_or_grid():
    a = fake.calibration("escape", n=8, n_modes=6)
    other = dataclasses.replace(a, matrix=dataclasses.replace(a.matrix, m2c=a.matrix.m2c + 0.1))
    with pytest.raises(IncompatibleProduct, match="bases"):
        comparison.compare(a, other)
    with pytest.raises(IncompatibleProduct, match="grids"):
        comparison.compare(a, fake.calibration("escape", n=10, n_modes=6))


def test_documents_are_strict_json():
    text = documents.dumps(
        {"a": np.float32(1), "b": [math.inf, np.nan], "c": np.arange(2), "d": Estimate(1, 2)}
    )
    assert "NaN" not in text
    assert "Infinity" not in text
    document = documents.calibration_document(fake.calibration("escape"))
    assert document["snr"]["median"] > 0
    assert documents.calibration_document(fake.calibration("docrime"))["registration"] is None


def test_a_sensor_frame_has_a_scale_in_counts():
    frame = np.random.default_rng(1).normal(40.0, 5.0, (40, 40))
    frame[10, 10] = 900.0
    picture, bar = figures_bench.sensor_frame(frame).axes
    assert bar.get_ylabel() == "counts [ADU]"
    (image,) = picture.images
    assert np.array_equal(image.get_array(), frame), "the colours are those of counts"
    low, high = bar.get_ylim()
    assert (low, high) == pytest.approx(tuple(np.percentile(frame, (5, 99.8))))
    assert image.norm(low + 0.25 * (high - low)) == pytest.approx(0.5), "square root"
    figures_bench.sensor_frame(np.zeros((8, 8)))


def test_units_of_errors_are_those_of_slopes_and_mirror():
    lenslets = fake.calibration("docrime").matrix
    pyramid = dataclasses.replace(lenslets, slope_unit="1")
    for matrix, unit in ((lenslets, "pixel"), (pyramid, "normalised slope")):
        (_, below) = figures_matrix.errors_per_mode({"DO-CRIME": matrix}).axes
        assert below.get_ylabel() == f"standard error\n[{unit} per full stroke rms]"


def test_the_temporal_response_is_drawn_in_percent():
    response = fake.calibration("docrime").response
    axes = figures_bench.temporal_response(response).axes[0]
    assert [bar.get_height() for bar in axes.patches] == pytest.approx(list(100 * response.weights))
    assert f"{response.delay_frames:.2f} frames" in axes.get_title()


def test_psfs_are_drawn_without_their_background():
    plain = fake.loop("escape")
    offset = dataclasses.replace(plain, psf=plain.psf + np.float32(500.0))
    shown, bare = (
        np.asarray(figures_bench.stacked_psfs({"ESCAPE": loop}).axes[1].images[0].get_array())
        for loop in (offset, plain)
    )
    assert np.median(shown) < -2.0
    np.testing.assert_allclose(shown, bare, atol=0.05)


def test_frames_shared_by_two_matrices_are_stated_once(page):
    assert page.count(": frames</dt>") == 1
    assert "push-pull and ESCAPE: frames" in page


def test_picture_of_a_run(tmp_path):
    run = make_run(tmp_path / "run")
    write_picture(run, tmp_path / "picture.png")
    assert (tmp_path / "picture.png").read_bytes().startswith(b"\x89PNG")
    figure = draw_picture(read_run(run))
    texts = {text.get_text() for part in figure.subfigs for axes in part.axes for text in (axes.title,)}
    assert {"push-pull", "DO-CRIME", "ESCAPE", "model"} <= texts
    assert "SIMULATED" in figure.get_suptitle()
    with pytest.raises(ProductError, match="no closed-loop image"):
        write_picture(make_run(tmp_path / "lean", lean=True), tmp_path / "none.png")
    assert not (tmp_path / "none.png").exists()


def test_sky_time_is_printed_in_words_too(page):
    assert "rms over 20 random registrations" in page
    assert "Fewest frames that meet every goal: whitened 500, unwhitened none of these." in page


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("command", None), ("system", 3), ("criteria", [{"text": "no end"}]), ("labels", {"escape": 1}),
        ("injected", {"shift_z": 1.0}), ("injected", {"shift_x": "far"}), ("bench", []),
    ],
)  # fmt: skip
def test_a_damaged_document_is_refused(tmp_path, key, value):
    run = make_run(tmp_path / "run", lean=True)
    file = run / "result.json"
    document = json.loads(file.read_text())
    file.write_text(json.dumps({**document, key: value}))
    with pytest.raises(ProductError, match=key):
        read_run(run)
