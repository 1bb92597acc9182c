"""Offsets: tip, tilt and focus as modes, the references of a loop, and their file."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import fake_results as fake
import numpy as np
import pytest

from escape_hw.api.offsets import Offsets
from escape_hw.calibration.modes.low_orders import combine_low_orders
from escape_hw.errors import ConfigError, IncompatibleProduct, ProductError, RequestRefused
from escape_hw.io.fits.offsets import load_offsets, save_offsets
from escape_hw.remote.requests import OffsetsRequest
from escape_hw.server.engine.offsets import OffsetControl

#: Wavefront of a coefficient of 1, nm rms.
NM = 7000.0


@pytest.fixture
def positions() -> np.ndarray:
    y, x = np.indices((9, 9)) - 4.0
    inside = np.hypot(x, y) <= 4.5
    return np.stack([x[inside], y[inside]], axis=1)


@pytest.fixture
def m2c(positions: np.ndarray) -> np.ndarray:
    """An orthonormal basis that contains tip, tilt and focus."""
    x, y = positions.T
    r2 = x**2 + y**2
    rng = np.random.default_rng(0)
    columns = np.stack([x, y, r2 - r2.mean(), *rng.normal(size=(3, x.size))], axis=1)
    return np.linalg.qr(columns)[0]


def test_terms_have_the_wavefront_that_was_asked_for(m2c: np.ndarray, positions: np.ndarray) -> None:
    for name in ("tip", "tilt", "focus", "mode 5"):
        modes = combine_low_orders({name: 140.0}, m2c, positions, NM)
        assert NM * np.linalg.norm(modes) == pytest.approx(140.0)
    tip = m2c @ combine_low_orders({"tip": 100.0}, m2c, positions, NM)
    assert np.corrcoef(tip, positions[:, 0])[0, 1] == pytest.approx(1.0)
    both = combine_low_orders({"tip": 30.0, "focus": -40.0}, m2c, positions, NM)
    assert NM * np.linalg.norm(both) == pytest.approx(50.0)


@pytest.mark.parametrize("name", ["coma", "mode 0", "mode 7"])
def test_unknown_terms_are_refused(name: str, m2c: np.ndarray, positions: np.ndarray) -> None:
    with pytest.raises(ConfigError, match="there is no term"):
        combine_low_orders({name: 1.0}, m2c, positions, NM)


def test_references_are_the_response_of_the_modes_and_the_measured_slopes() -> None:
    matrix = fake.calibration("escape").matrix
    assert not Offsets().reference_slopes(matrix).any()
    modes = np.zeros(matrix.n_modes)
    modes[1] = 0.02
    maps = np.random.default_rng(1).normal(size=(2, *matrix.valid.shape)).astype(np.float32)
    offset = Offsets({"mode 2": 1.0}, modes, maps).reference_slopes(matrix)
    measured = np.concatenate([maps[0][matrix.valid], maps[1][matrix.valid]])
    assert offset == pytest.approx(0.02 * matrix.data[:, 1] + measured, abs=1e-6)
    with pytest.raises(IncompatibleProduct, match="modes"):
        Offsets(modes=np.ones(matrix.n_modes + 1)).reference_slopes(matrix)
    with pytest.raises(IncompatibleProduct, match="sub-apertures"):
        Offsets(slopes=np.ones((2, 3, 3), np.float32)).reference_slopes(matrix)


def test_offsets_are_saved_and_restored(tmp_path: Path) -> None:
    offsets = Offsets(
        {"tip": 20.0, "mode 3": -5.0},
        np.arange(4.0),
        np.ones((2, 3, 3), np.float32),
        np.linspace(-0.1, 0.1, 9),
    )
    path = save_offsets(tmp_path / "offsets.fits", offsets, "small", True, fake.ORIGIN)
    back = load_offsets(path).result
    assert back.terms == offsets.terms
    for name in ("modes", "slopes", "flat"):
        assert np.array_equal(getattr(back, name), getattr(offsets, name))
    empty = replace(offsets, terms={}, modes=np.zeros(0), flat=np.zeros(0))
    save_offsets(path, empty, "small", True, fake.ORIGIN)
    assert load_offsets(path).result.modes.size == 0
    path.write_bytes(path.read_bytes()[:-2000])
    with pytest.raises(ProductError):
        load_offsets(path)


def offset_control(runs: Path, simulated: bool) -> OffsetControl:
    """The offsets in the engine of the system 'small'."""
    config = SimpleNamespace(system=SimpleNamespace(name="small"))
    dm = SimpleNamespace(is_open=True, info=SimpleNamespace(n_act=4), set_flat=lambda flat: None)
    state = SimpleNamespace(loop_control=None, active_run=None, fault=None)
    owner: Any = SimpleNamespace(
        bench=SimpleNamespace(config=config, dm=dm, simulated=simulated),
        state=SimpleNamespace(snapshot=state, check_idle=lambda: None),
        post=lambda job: None,
    )
    return OffsetControl(owner, runs)


def load_saved(runs: Path, simulated: bool, name: str = "x") -> tuple[OffsetControl, dict[str, float]]:
    """Load the offsets of a name in the engine of the system 'small'; returns its control and the terms."""
    control = offset_control(runs, simulated)
    request = OffsetsRequest(verb="load_offsets", client="0" * 8, name=name)
    control.handle(request, lambda state, error: None)
    return control, dict(control.offsets.terms)


def test_saved_offsets_of_another_system_or_of_a_simulation_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "offsets" / "small" / "x.fits"
    path.parent.mkdir(parents=True)
    save_offsets(path, Offsets({"tip": 1.0}), "small", True, fake.ORIGIN)
    assert load_saved(tmp_path, simulated=True)[1] == {"tip": 1.0}
    with pytest.raises(IncompatibleProduct, match="made in simulation"):
        load_saved(tmp_path, simulated=False)
    save_offsets(path, Offsets({"tip": 1.0}), "large", False, fake.ORIGIN)
    with pytest.raises(IncompatibleProduct, match="its system is 'large'"):
        load_saved(tmp_path, simulated=False)


@pytest.mark.parametrize("verb", ["save_offsets", "load_offsets"])
@pytest.mark.parametrize(("name", "possible"), [("a b", "a-b"), ("../a", "..-a"), ("a/b", "a-b")])
def test_a_name_that_no_file_has_is_refused_with_one_that_a_file_can_have(
    tmp_path: Path, verb: str, name: str, possible: str
) -> None:
    control = offset_control(tmp_path, simulated=True)
    request: Any = SimpleNamespace(verb=verb, name=name)
    with pytest.raises(RequestRefused, match=f"offsets '{name}': .* such as '{possible}'"):
        control.handle(request, lambda state, error: None)
    assert not list(tmp_path.rglob("*.fits"))


def test_offsets_are_loaded_by_the_name_that_is_listed(tmp_path: Path) -> None:
    path = tmp_path / "offsets" / "small" / "a b.fits"
    path.parent.mkdir(parents=True)
    save_offsets(path, Offsets({"tip": 1.0}), "small", True, fake.ORIGIN)
    control, terms = load_saved(tmp_path, simulated=True, name="a b")
    assert (control.saved, terms) == (("a b",), {"tip": 1.0})


def test_offsets_saved_by_earlier_versions_are_found_by_their_system(tmp_path: Path) -> None:
    folder = tmp_path / "offsets"
    folder.mkdir()
    save_offsets(folder / "small_x.fits", Offsets({"tip": 2.0}), "small", False, fake.ORIGIN)
    save_offsets(folder / "small_b_x.fits", Offsets({"tip": 3.0}), "small_b", False, fake.ORIGIN)
    control, terms = load_saved(tmp_path, simulated=False)
    assert (control.saved, terms) == (("x",), {"tip": 2.0})
