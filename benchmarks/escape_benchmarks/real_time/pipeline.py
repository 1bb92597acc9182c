"""Slopes and integrator against the kernels of pyRTC (pyramid slopes against numpy), on the same arrays."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from escape_benchmarks.peers.pyrtcao import NOT_INSTALLED, import_pyrtc, peer_name
from escape_benchmarks.rows import time_row
from escape_hw.api.benchmark import BenchmarkRow, time_alternately
from escape_hw.api.pyramid import PyramidPupils, pupil_boxes
from escape_hw.api.sensor import SubApertureGrid
from escape_hw.pipeline.control.integrator import LeakyIntegrator
from escape_hw.pipeline.slopes.pyramid import PyramidSlopes, slopes_of_image
from escape_hw.pipeline.slopes.shack_hartmann import ShackHartmannSlopes


def run() -> list[BenchmarkRow]:
    """All rows of the stage."""
    # RAZOR's grid with whole pixels (the peer knows no others), and a large one.
    rows = [_slopes(n_sub, pitch) for n_sub, pitch in ((10, 8), (24, 16), (40, 8))]
    rows += [_pyramid(n, mode) for n, mode in ((16, "global"), (64, "global"), (64, "local"))]
    return rows + [_integrator(modes, slopes) for modes, slopes in ((97, 200), (94, 900), (1200, 2512))]


def spots(n_sub: int, pitch: int, seed: int = 0) -> NDArray[np.uint16]:
    """A frame with one spot per lenslet, moved by up to a pixel, on a background of zero."""
    rng = np.random.default_rng(seed)
    line = np.arange(pitch) - (pitch - 1) / 2
    move = rng.uniform(-1, 1, (2, n_sub, n_sub, 1))
    x, y = np.exp(-((line - move) ** 2) / (2 * 1.2**2))
    image = 900 * y[:, :, :, None] * x[:, :, None, :]
    return np.asarray(image.transpose(0, 2, 1, 3).reshape(n_sub * pitch, -1).round(), dtype=np.uint16)


def _slopes(n_sub: int, pitch: int) -> BenchmarkRow:
    frame = spots(n_sub, pitch)
    valid = np.ones((n_sub, n_sub), np.bool_)
    half = (pitch - 1) / 2
    grid = SubApertureGrid(
        float(pitch), (half, half), valid, np.zeros((n_sub**2, 2), np.float32), valid.astype(np.float32)
    )
    extractor = ShackHartmannSlopes(grid, (frame.shape[0], frame.shape[1]))
    peer = _peer_slopes(frame, n_sub, pitch)
    note = NOT_INSTALLED
    if peer is not None:
        worst = float(np.abs(extractor(frame) - peer().ravel()).max())
        note = f"largest difference {worst:.1e} px" if worst < 1e-4 else f"DISAGREES by {worst:.1e} px"
    out = np.empty(grid.n_slopes, np.float32)
    times = time_alternately(lambda: extractor(frame, None, out), peer)
    stage = f"pipeline: slopes {n_sub} x {n_sub}, {pitch} px"
    return time_row(stage, times, peer_name("compute_slopes_shwfs_optim_numba"), "us", note)


def _pyramid(n: int, normalisation: str) -> BenchmarkRow:
    """Pyramid slopes beside the same sum in numpy, on images of ``n`` pixels."""
    side = 3 * n
    frame = np.random.default_rng(0).integers(8, 1000, (side, side)).astype(np.uint16)
    line = np.arange(n) - (n - 1) / 2
    valid = np.hypot(line[:, None], line[None, :]) <= n / 2
    centres = np.array([[0.7, 0.7], [2.3, 0.8], [0.7, 2.2], [2.2, 2.2]]) * n
    pupils = PyramidPupils(
        centres, float(n), pupil_boxes(centres, n), valid, np.zeros((int(valid.sum()), 2), np.float32),
        valid.astype(np.float32), normalisation=normalisation,
    )  # fmt: skip
    slopes_of = PyramidSlopes(pupils, (side, side))
    worst = float(np.abs(slopes_of(frame) - slopes_of_image(frame, pupils)).max())
    note = f"largest difference {worst:.1e}" if worst < 1e-5 else f"DISAGREES by {worst:.1e}"
    out = np.empty(pupils.n_slopes, np.float32)
    times = time_alternately(lambda: slopes_of(frame, None, out), lambda: slopes_of_image(frame, pupils))
    return time_row(f"pipeline: pyramid slopes {n} px, {normalisation}", times, "numpy", "us", note)


def _peer_slopes(
    frame: NDArray[np.uint16], n_sub: int, pitch: int
) -> Callable[[], NDArray[np.float32]] | None:
    module = import_pyrtc("slopes_process")
    if module is None:
        return None
    image = frame.astype(np.int32)  # what its wavefront sensor publishes
    kernel = module.compute_slopes_shwfs_optim_numba
    line = module.shwfs_subaperture_coords(pitch)
    weights = np.meshgrid(line, line)[0].astype(np.float32)
    reference = np.zeros((2 * n_sub, n_sub), np.float32)
    out = np.zeros_like(reference)

    def call() -> NDArray[np.float32]:
        kernel(image, out, reference, np.float32(0), np.float32(pitch), weights, 0, 0, pitch)
        return out

    return call


def _integrator(n_modes: int, n_slopes: int) -> BenchmarkRow:
    rng = np.random.default_rng(0)
    matrix = rng.standard_normal((n_modes, n_slopes)).astype(np.float32) / np.float32(n_slopes)
    slopes = rng.standard_normal(n_slopes).astype(np.float32)
    start = rng.standard_normal(n_modes).astype(np.float32)
    gain, leak = 0.3, 0.01
    ours = LeakyIntegrator(matrix, gain, leak)
    peer = _peer_integrator(matrix, slopes, start, gain, leak)
    note = NOT_INSTALLED
    if peer is not None:
        ours.set_applied(start)
        worst = float(np.abs(ours(slopes) - peer()).max() / np.abs(start).max())
        # Large reconstructors are held in 16 bits.
        note = f"largest difference {worst:.1e}" if worst < 1e-4 else f"DISAGREES by {worst:.1e}"
    times = time_alternately(lambda: ours(slopes), peer)
    stage = f"pipeline: integrator {n_modes} x {n_slopes}"
    return time_row(stage, times, peer_name("leaky_integrator_numba"), "us", note)


def _peer_integrator(
    matrix: NDArray[np.float32],
    slopes: NDArray[np.float32],
    start: NDArray[np.float32],
    gain: float,
    leak: float,
) -> Callable[[], NDArray[np.float32]] | None:
    module = import_pyrtc("loop")
    if module is None:
        return None
    kernel, scaled, out = module.leaky_integrator_numba, np.float32(gain) * matrix, np.zeros_like(start)
    leak_factor, n_modes = np.float32(leak), len(start)

    def call() -> NDArray[np.float32]:
        kernel(slopes, scaled, start, out, leak_factor, n_modes)
        return out

    return call
