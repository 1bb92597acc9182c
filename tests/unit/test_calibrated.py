"""What ``load_matrix`` returns is accepted wherever a calibration is; others are refused with a remedy."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import fake_results as fake
import numpy as np
import pytest
from small_system import SMALL

import escape_hw
from escape_hw.calibration.optical_gain.bootstrap import GainsRun
from escape_hw.io.fits.matrix import load_matrix, save_matrix
from escape_hw.runtime.session.calibration_input import as_calibration, as_matrix_and_grid


def test_a_product_stands_for_its_calibration(tmp_path: Path) -> None:
    found = fake.calibration()
    product = load_matrix(save_matrix(tmp_path / "im.fits", found))
    assert as_calibration(found) is found
    assert as_calibration(product) is product.result
    assert as_matrix_and_grid(product, None) == (product.matrix, product.grid)
    assert as_matrix_and_grid(found, product.grid) == (found.matrix, product.grid)
    assert as_matrix_and_grid(found.matrix, found.grid) == (found.matrix, found.grid)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ("first/im.fits", r"not a str; read it: escape_hw.load_matrix\('first/im.fits'\)"),
        (Path("im.fits"), r"escape_hw.load_matrix\('im.fits'\)"),
        (fake.matrix(), "InteractionMatrix; a matrix alone has no sensor geometry"),
        (GainsRun(fake.gains_result(), fake.calibration()), "not a GainsRun; take its .rescaled_calibration"),
        (SimpleNamespace(latest=None), "take its .latest"),
        (None, "not a NoneType"),
    ],
)
def test_what_is_no_calibration_is_refused_with_the_way_out(given: object, words: str) -> None:
    with pytest.raises(TypeError, match=words):
        as_calibration(given)


def test_a_matrix_needs_its_geometry() -> None:
    with pytest.raises(TypeError, match="give the grid as well"):
        as_matrix_and_grid(fake.matrix(), None)


@pytest.mark.slow
def test_a_script_may_pass_what_it_loaded(tmp_path: Path) -> None:
    with escape_hw.open_system("razor-shwfs", set=SMALL) as bench:
        product = load_matrix(escape_hw.save_matrix(tmp_path / "im.fits", bench.calibrate(frames=400)))
        run = bench.close_loop(product, frames=100)
        again = bench.close_loop(product.matrix, product.grid, frames=100)
        assert (run.stable, run.frames, run.method) == (True, again.frames, again.method)
        gain, _ = bench.find_best_gain(product, gains=(0.3,), frames=100)
        assert gain == 0.3
        followed = bench.track(product, seconds=1)
        assert followed.stable
        # The measured matrix behind the computed one tells the registration again.
        estimate = bench.find_registration(product)
        pull = estimate.registration.to_array() - product.registration.registration.to_array()
        assert np.all(np.abs(pull) < 6 * np.hypot(estimate.sigma, product.registration.sigma))
        small = bench.calibrate("docrime", frames=400, poke=0.002, closed_loop=product)
        assert small.matrix.method.startswith("docrime-closed")
        with pytest.raises(TypeError, match=r"load_matrix\('im.fits'\)"):
            bench.track("im.fits", seconds=1)  # type: ignore[arg-type]
