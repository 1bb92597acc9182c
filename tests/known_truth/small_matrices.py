"""Matrices of a small bench whose mirror differs from its model: places, gains and rings of actuators."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
from numpy.typing import NDArray
from small_system import configuration

from escape_hw.api.interaction_matrix import InteractionMatrix
from escape_hw.api.registration import Registration
from escape_hw.config.layouts import layout_map
from escape_hw.io.interchange.arrays import design_geometry
from escape_hw.runtime.session.array_target import array_target
from escape_sim.models.factory import make_fast_model

CONFIG = configuration()
GRID = design_geometry(layout_map("circle-12"), array_target(CONFIG))
MODEL = make_fast_model(CONFIG, GRID)
NOISE = 0.02
TRUTH = Registration(10.0, -8.0, 0.5, 1.0, -1.0)


@cache
def true_matrix(truth: Registration = TRUTH) -> NDArray[np.float64]:
    """A mirror with a ring around each of its actuators, which have places and gains of their own."""
    rng = np.random.default_rng(4)
    columns = []
    for actuator, (x, y) in enumerate(5 * rng.normal(size=(MODEL.n_act, 2))):
        at = replace(truth, shift_x=truth.shift_x + x, shift_y=truth.shift_y + y)
        columns.append((MODEL.zonal_matrix(at) + 0.2 * MODEL.zonal_matrix(at, 2.2))[:, actuator])
    return np.stack(columns, axis=1) * (1 + 0.05 * rng.normal(size=MODEL.n_act))


@cache
def measured(seed: int, tilt: float = 0.0) -> InteractionMatrix:
    """The matrix with noise, and with a wavefront of its own in every column."""
    rng, true = np.random.default_rng(seed), true_matrix()
    data = true + NOISE * rng.normal(size=true.shape)
    if tilt:
        rows, columns = np.argwhere(GRID.valid).T / GRID.valid.shape[0] - 0.5
        focus, astigmatism = np.concatenate([columns, rows]), np.concatenate([rows, columns])
        data += tilt * (np.outer(focus, rng.normal(size=37)) + np.outer(astigmatism, rng.normal(size=37)))
    return InteractionMatrix(
        data.astype(np.float32), np.full(data.shape, NOISE, np.float32), np.eye(37), GRID.valid,
        CONFIG.system.name, "push-pull", True, slope_unit=GRID.slope_unit,
    )  # fmt: skip
