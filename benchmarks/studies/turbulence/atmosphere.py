"""Structure function and boiling of the twin's open-air turbulence against theory, as a figure.

    python benchmarks/studies/turbulence/atmosphere.py --out docs/figures

Writes ``atmosphere.png``. Takes about a minute.
"""

from __future__ import annotations

import math

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import NDArray

from escape_benchmarks.realisation_tables import study_parser
from escape_hw.report.figures import style
from escape_sim.atmosphere.layers import TurbulentLayer
from escape_sim.atmosphere.von_karman import TurbulenceSource, structure_function

PIXEL_M, R0_M, N, SIZE = 0.1, 0.15, 64, 512
LIT = np.ones((N, N), bool)
SEEDS = 400


def phase(layer: TurbulentLayer, time_s: float) -> NDArray[np.float64]:
    """Phase over the pupil in radians."""
    out = np.zeros((N, N), np.float32)
    layer.add(time_s, out)
    return out.astype(float)


def draw_structure(axes: Axes) -> None:
    """Measured over theoretical structure function for three outer scales."""
    pixels = np.unique(np.geomspace(1, N - 1, 16).astype(int))
    for colour, (outer, label) in zip(
        style.SERIES, ((5.0, "$L_0$ = 5 m"), (25.0, "25 m"), (1e9, "Kolmogorov")), strict=False
    ):
        source = TurbulenceSource(SIZE, PIXEL_M, R0_M, outer, N + 3)
        found = []
        for seed in range(SEEDS):
            own = np.random.SeedSequence(seed, spawn_key=(round(math.log(outer)),))
            layer = TurbulentLayer(source, 1.0, (7.3, 3.1), 3.0, LIT, own)
            p = phase(layer, 0.1 * seed)
            found.append([((p[:, k:] - p[:, : N - k]) ** 2).mean() for k in pixels])
        want = structure_function(pixels * PIXEL_M, R0_M, math.inf if outer == 1e9 else outer)
        ratio, error = np.mean(found, axis=0) / want, np.std(found, axis=0) / math.sqrt(SEEDS) / want
        axes.errorbar(pixels * PIXEL_M, ratio, error, color=colour, label=label, marker="o", ms=3, lw=1)
    axes.axhline(1, color=style.MUTED, lw=0.8)
    axes.set(xscale="log", xlabel="separation [m]", ylabel="measured / theory", ylim=(0.8, 1.2))
    axes.set_title(f"structure function, {SEEDS} draws")
    style.legend(axes)


def draw_boiling(axes: Axes) -> None:
    """Correlation of static turbulence with itself after a time, in units of the boiling time."""
    lags = np.linspace(0, 2.4, 13)
    source = TurbulenceSource(256, PIXEL_M, R0_M, 2.0, N + 3)
    products = []
    for seed in range(SEEDS):
        layer = TurbulentLayer(source, 1.0, (0.0, 0.0), 1.0, LIT, np.random.SeedSequence(seed))
        start = phase(layer, 0.0)
        products.append([(start * phase(layer, lag)).mean() for lag in lags])
    mean = np.mean(products, axis=0)
    error = np.std(products, axis=0) / math.sqrt(SEEDS) / mean[0]
    axes.errorbar(lags, mean / mean[0], error, color=style.SERIES[0], fmt="o", ms=3, lw=1, label="measured")
    fine = np.linspace(0, 2.4, 200)
    turn = np.minimum(1.474456 * fine, np.pi)
    rho = ((np.pi - turn) * np.cos(turn) + np.sin(turn)) / np.pi
    axes.plot(fine, rho, color=style.SERIES[1], lw=1, label="theory")
    axes.axhline(math.exp(-1), color=style.MUTED, lw=0.8, ls=":")
    axes.set(xlabel="time / boiling time", ylabel="correlation")
    axes.set_title("boiling")
    style.legend(axes)


def main() -> None:
    """Measure and draw."""
    options = study_parser(__doc__).parse_args()
    figure = style.new_figure(8.0, 3.0)
    left, right = figure.subplots(1, 2)
    draw_structure(style.style_axes(left))
    draw_boiling(style.style_axes(right))
    options.out.mkdir(parents=True, exist_ok=True)
    (options.out / "atmosphere.png").write_bytes(style.png(figure, 110))


if __name__ == "__main__":
    main()
