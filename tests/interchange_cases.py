"""Sensors of both kinds with matrices on them, as calibrations of ESCAPE."""

from __future__ import annotations

import numpy as np

from escape_hw.api.interaction_matrix import InteractionMatrix
from escape_hw.api.pyramid import PyramidPupils
from escape_hw.api.results import CalibrationResult
from escape_hw.api.sensor import SubApertureGrid
from escape_hw.io.interchange.pyrtc.calibration import FrameSettings, TargetSystem

SHAPE = (400, 400)
FACTS = FrameSettings(SHAPE, 12.0)


def lenslets(n: int = 24, n_modes: int = 94, seed: int = 3) -> CalibrationResult:
    """A disk of lenslets on a frame of 400 pixels, whose pitch is no whole number of them."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:n, :n] - (n - 1) / 2
    valid = x**2 + y**2 < (n / 2) ** 2
    count = int(valid.sum())
    references = rng.normal(0, 0.3, (count, 2)).astype(np.float32)
    grid = SubApertureGrid(15.55, (21.3, 19.8), valid, references, valid.astype(np.float32), 3426.0, 1.1, 7.9)
    data = rng.standard_normal((2 * count, n_modes)).astype(np.float32)
    sigma = rng.uniform(0.01, 0.02, data.shape).astype(np.float32)
    m2c = rng.standard_normal((97, n_modes))
    matrix = InteractionMatrix(data, sigma, m2c, valid, "razor-shwfs", "docrime", True, {"frames": 10_000})
    return CalibrationResult(matrix, grid, 10_000, 3, 20.0)


def pyramid(n: int = 16, seed: int = 4) -> CalibrationResult:
    """Four images of 16 pixels on a frame of 48, some pixels of the rim dark."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:n, :n] - (n - 1) / 2
    valid = x**2 + y**2 < (0.47 * n) ** 2
    corners = np.array([[5, 4], [28, 5], [4, 27], [29, 28]])
    references = rng.normal(0, 0.05, (int(valid.sum()), 2)).astype(np.float32)
    pupils = PyramidPupils(
        corners + (n - 1) / 2, float(n), corners.astype(np.intp), valid, references,
        valid.astype(np.float32), mean_low_orders=rng.normal(0, 0.1, (6, 2)),
    )  # fmt: skip
    data = rng.standard_normal((2 * int(valid.sum()), 20)).astype(np.float32)
    sigma = np.full_like(data, 0.01)
    matrix = InteractionMatrix(
        data, sigma, rng.standard_normal((97, 20)), valid, "razor-pywfs", "docrime", True, {}, "1"
    )
    return CalibrationResult(matrix, pupils, 100, 0, 1.0)


def target(result: CalibrationResult, simulated: bool = False) -> TargetSystem:
    return TargetSystem(result.matrix.system, result.grid.kind, result.grid.valid.shape[0], 97, simulated)


def add_frame(settings: str, shape: tuple[int, int]) -> str:
    """pyRTC's own part of a configuration beside what we wrote."""
    return settings + f"wfs:\n  width: {shape[1]}\n  height: {shape[0]}\n"
