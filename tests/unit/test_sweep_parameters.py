"""Search space by system; a sweep on an open bench, as on hardware; results of synthetic loops."""

from __future__ import annotations

import importlib.util

import numpy as np
import pytest
from small_system import SMALL, configuration
from synthetic_sweep import SWEPT, synthetic_run

import escape_hw
from escape_hw.api.procedure import run
from escape_hw.config.loader import load_system
from escape_hw.errors import ConfigError
from escape_hw.io.provenance import file_sha256
from escape_hw.runtime.sweep.description import SweepDescription, read_description
from escape_hw.runtime.sweep.design import Design, MatrixVariant, Sweep
from escape_hw.runtime.sweep.products import criteria, sweep_document, trials_csv
from escape_hw.runtime.sweep.request import parse_search_space, require_loop_frames, require_optuna
from escape_hw.runtime.sweep.result import analyse_sweep
from escape_hw.runtime.sweep.run import run_sweep
from escape_hw.runtime.sweep.search_space import default_space, parse_parameter


def test_hardware_needs_limits_for_every_parameter():
    config = load_system("razor-shwfs", mode="hardware")
    with pytest.raises(ConfigError, match="leak, dropped_modes"):
        parse_search_space(config, ["gain=0.1:0.5"])
    limits = ["gain=0.1:0.5", "leak=0.01:0.05", "dropped_modes=10:20"]
    assert [one.to_text() for one in parse_search_space(config, limits)] == limits
    for text in ("twin.latency_s=0:1e-3", "delay=0:1", "calibration.poke=0.01:0.02"):
        with pytest.raises(ConfigError, match="on hardware only"):
            parse_search_space(config, [*limits, text])


@pytest.mark.parametrize("text", ["gian=0:1", "sensor.threshold=0:1", "basis.n_modes=10:20"])
def test_what_cannot_be_varied_is_said(text):
    with pytest.raises(ConfigError, match="--vary"):
        parse_search_space(configuration(), [text])


@pytest.mark.parametrize(("system", "least"), [("razor-shwfs", 270), ("razor-pywfs", 162)])
def test_loops_too_short_for_a_strehl_ratio_are_refused_before_anything_opens(escape, system, least):
    require_loop_frames(load_system(system), least)
    with pytest.raises(ConfigError, match=f"--frames {least - 1}: .* the least is --frames {least}"):
        require_loop_frames(load_system(system), least - 1)
    code, _, err = escape("sweep", system, "--frames", least - 1, "--trials", 4)
    assert code == 2
    assert f"the least is --frames {least}" in err


@pytest.mark.parametrize(("system", "matrices"), [("razor-shwfs", 3), ("razor-pywfs", 6)])
def test_fewer_trials_than_matrices_are_refused_before_these_are_measured(escape, system, matrices):
    code, _, err = escape("sweep", system, "--trials", matrices - 1)
    assert code == 2
    assert f"--trials {matrices - 1}: fewer than the {matrices} matrices" in " ".join(err.split())


@pytest.mark.slow
def test_the_least_loop_has_a_strehl_ratio_with_an_error():
    with escape_hw.open_system("razor-shwfs", set=SMALL) as bench:
        found, psf = bench.calibrate("push-pull"), bench.take_model_psf()
        run = bench.close_loop(found, frames=270, model_psf=psf)
    assert np.isfinite(run.strehl.peak.sigma)


def test_without_a_science_camera_there_is_nothing_to_judge_by():
    config = configuration()
    bare = config.model_copy(update={"devices": config.devices.model_copy(update={"science": None})})
    with pytest.raises(ConfigError, match="no science camera"):
        require_loop_frames(bare, 400)


def test_ranges_beyond_the_configurations_are_refused():
    for text in ("gain=0.1:9", "leak=0:2", "dropped_modes=0:30", "twin.loss_probability=0:0.9", "twin.x=0:1"):
        variant = MatrixVariant("A", False, __file__, "")
        space = default_space(30, [parse_parameter(text)])
        swept = Sweep(configuration().to_toml(), (variant,), space, Design(), 100, 1)
        with pytest.raises(ConfigError, match=text.partition("=")[0]):
            SweepDescription(swept, "sqlite://", "s", "random", 0.01).validate()


def test_passwords_are_not_written(tmp_path):
    (tmp_path / "im.fits").write_bytes(b"")
    path = tmp_path / "im.fits"
    variant = MatrixVariant("A", False, path, file_sha256(path))
    space = default_space(30, [parse_parameter("gain=0.1:1")])
    swept = Sweep(configuration().to_toml(), (variant,), space, Design(), 100, 1)
    url = "postgresql+psycopg://me:secret@host/sweeps"
    assert "secret" not in SweepDescription(swept, url, "s", "random", 0.01).save(tmp_path).read_text()
    with pytest.raises(ConfigError, match="--storage"):
        read_description(tmp_path)
    assert read_description(tmp_path, url).storage == url


def test_without_optuna_the_way_out_is_named(monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ConfigError, match=r"escape-hw\[sweep\]"):
        require_optuna()


@pytest.mark.slow
def test_a_sweep_on_an_open_bench(tmp_path):
    with escape_hw.open_system("razor-shwfs", set=SMALL) as bench:
        path = escape_hw.save_matrix(tmp_path / "im.fits", bench.calibrate("push-pull"))
        np.save(tmp_path / "psf.npy", bench.take_model_psf())
        sent = []
        variants = tuple(MatrixVariant(name, False, path, file_sha256(path)) for name in ("A", "B"))
        space = tuple(parse_parameter(t) for t in ("gain=0.3:0.6", "leak=0.01", "dropped_modes=2:6"))
        swept = Sweep(
            bench.config.to_toml(), variants, space, Design(4, 1, 1, 6), 200, 1,
            psf=str(tmp_path / "psf.npy"), simulated=False,
        )  # fmt: skip
        description = SweepDescription(
            swept, f"sqlite:///{tmp_path / 'study.db'}", "s", "random", 0.05
        ).validate()
        description.save(tmp_path)
        assert read_description(tmp_path) == description
        with description.open_study() as study:
            found = run(run_sweep(study, bench), observers=(sent.append,))
        assert np.all(bench.dm.shape == 0)
    result = analyse_sweep(swept, found, 0.05)
    assert len(found.records) == 4 + 2 + 12
    done = [progress.done for progress in sent if progress.stage == "sweep"]
    assert done == sorted(set(done))
    assert done[-1] == 18
    for record in found.records:
        assert 0.3 <= record.values["gain"] <= 0.6
        assert 2 <= record.values["dropped_modes"] <= 6
        assert record.values["leak"] == 0.01
    assert set(result.best) == {"A", "B"}
    assert sweep_document(result)["sweep"]["loops"] == {"explore": 4, "shortlist": 2, "final": 12}
    assert len(trials_csv(result).splitlines()) == 1 + 18


@pytest.mark.parametrize(
    ("difference", "word"), [(0.0, "equivalent"), (0.05, "ESCAPE better"), (-0.05, "worse")]
)
@pytest.mark.slow
def test_conclusions(difference, word):
    result = analyse_sweep(SWEPT, synthetic_run(difference), 0.01)
    (one,) = result.comparisons
    assert one.found.mean == pytest.approx(difference, abs=0.005)
    assert (word if word != "worse" else "push-pull better than ESCAPE") in one.text
    assert criteria(result)[-1]["met"] == (difference >= 0)
    # The hill in the gain is what matters, unless the matrices differ by more than it does.
    assert result.importance["gain"] > 0.5
    assert result.importance["chance"] < 0.1
    assert (result.importance["matrix"] > result.importance["chance"]) == (difference != 0)
    # At the same random parameters the same difference shows.
    assert result.at_random[0].found.mean == pytest.approx(difference, abs=0.005)
    assert result.at_random[0].found.pairs == 40
