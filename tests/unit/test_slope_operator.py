"""Slopes of sums of separable functions equal those of the summed surfaces."""

from __future__ import annotations

import numpy as np
import pytest

from escape_sim.models.slope_operator import SlopeOperator

AROUND = [(down, right) for down in (-1, 0, 1) for right in (-1, 0, 1)]


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize(
    ("n_sub", "samples", "steps"),
    [(7, 8, AROUND), (6, 3, AROUND), (5, 5, [(0, 0), (1, 0)]), (4, 1, AROUND)],
    ids=["odd", "fewer samples than nodes", "two steps", "one sample"],
)
def test_sums_of_products_equal_the_slopes_of_their_surfaces(
    n_sub: int, samples: int, steps: list[tuple[int, int]], dtype: type[np.floating]
) -> None:
    rng = np.random.default_rng(1)
    y, x = np.indices((n_sub, n_sub)) - (n_sub - 1) / 2
    # Without symmetry, and with a lenslet that is left out.
    valid = np.hypot(x, y) < n_sub / 2
    valid[0], valid[2, 1] = False, False
    weights = {step: rng.standard_normal((2, valid.sum(), samples, samples)) for step in steps}
    operator = SlopeOperator(weights, valid, 0.1)
    # Two Gaussians for each of five actuators, the last of which does nothing. They are narrow: most lenslets
    # see few actuators.
    at_m = operator.nodes_m[:, None] - rng.uniform(-0.1, 0.1, (3, 2, 2, 1, 5)) * n_sub / 2
    functions = np.exp(-np.square(at_m / 0.1))
    functions[:, 1, ..., -1] = 0
    sums = [(along_x.astype(dtype), along_y.astype(dtype)) for along_x, along_y in functions]
    slopes = operator.sums_of_products(sums)
    assert slopes.dtype == dtype
    assert not slopes[..., -1].any()
    surfaces = [np.einsum("tya,txa->yxa", along_y, along_x) for along_x, along_y in functions]
    want = np.stack([operator.slopes(surface) for surface in surfaces])
    assert slopes == pytest.approx(want, abs=30 * np.finfo(dtype).eps * np.abs(want).max())
