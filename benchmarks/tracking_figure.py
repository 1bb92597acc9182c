"""What ``tracking.py`` measured: errors against the truth in numbers, exchanges, and the figure."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from escape_hw.api.registration import PARAMETERS
from escape_hw.report import style

#: Seconds of tracking that are not judged.
SETTLED_S = 10.0
#: Seconds before and after an exchange that are held against each other.
BUMP_S = 0.1
LABELS = {"knows": "knows the truth, no pokes", "never": "never looks, no pokes"}


def looked(out: Path, loop: str) -> NDArray[np.float64]:
    """Looks at another loop so far ``(n, 3)``: end in seconds, Strehl ratio, its error."""
    path = out / f"{loop}.jsonl"
    lines = path.read_text().splitlines() if path.exists() else []
    return np.array(sorted(json.loads(line) for line in lines)).reshape(-1, 3)


def draw(out: Path, figure: Path) -> None:
    """Errors in numbers, and the figure."""
    tracked = json.loads((out / "track.json").read_text())
    rows = {name: np.array(values, float) for name, values in tracked["rows"].items()}
    truth, t = np.array(tracked["truth"]), rows["seconds"]
    settled = t > SETTLED_S
    for k, name in enumerate(PARAMETERS):
        error = (rows[name] - truth[:, k])[settled]
        chi2 = np.mean(np.square(error / rows[f"{name}_sigma"][settled]))
        rms, worst = np.sqrt(np.mean(error**2)), np.abs(error).max()
        print(
            f"{name}: rms error {rms:.4f}, largest {worst:.4f}, chi2 {chi2:.2f}; mean {error.mean():+.4f}, "
            f"scatter about it {error.std():.4f}"
        )
    gains = np.array(tracked["gains"])
    gains = gains[gains[:, 0] > SETTLED_S]
    share = np.interp(gains[:, 0], t, rows["optical_gain"]) / gains[:, 1] - 1
    print(f"optical gain: mean error {share.mean():+.4f}, rms {np.sqrt(np.mean(share**2)):.4f},", end=" ")
    print(f"largest {np.abs(share).max():.4f}; true {gains[:, 1].min():.3f} to {gains[:, 1].max():.3f}")
    print(bumps(out, t, rows["exchanged"] > 0))
    others = {}
    for loop in ("knows", "never"):
        looks = looked(out, loop)
        if len(looks):
            others[loop] = looks
            print(difference(loop, others[loop], t, rows["strehl"]))
    picture(rows, truth, gains, others).savefig(figure, dpi=110)


def bumps(out: Path, t: Any, exchanged: Any) -> str:
    """Wavefront error in front of the sensor just after exchanges, beside that just before, and elsewhere."""
    ripples = np.load(out / "ripples.npz")
    # An answer is taken up, and its matrix into use, when the second after it ends.
    edges, swapped = t[1:-1], exchanged[:-2]
    at = np.searchsorted(ripples["seconds"], edges)
    span = np.searchsorted(ripples["seconds"], edges + BUMP_S) - at
    squares = np.concatenate([[0.0], np.cumsum(np.square(ripples["nm"], dtype=float))])
    after = np.sqrt((squares[at + span] - squares[at]) / span)
    before = np.sqrt((squares[at] - squares[at - span]) / span)
    step = after - before
    if not swapped.any():
        return "no exchange"
    own, others = step[swapped], step[~swapped]
    return (
        f"wavefront in front of the sensor (mean {before.mean():.0f} nm), {BUMP_S:g} s after beside before "
        f"{len(own)} exchanges: {own.mean():+.2f} +- {own.std() / np.sqrt(len(own)):.2f} nm, "
        f"rms {own.std():.2f}, largest {np.abs(own).max():.2f}; at the {len(others)} other seconds "
        f"rms {others.std():.2f}, largest {np.abs(others).max():.2f}"
    )


def difference(loop: str, looks: NDArray[np.float64], t: Any, ratios: Any) -> str:
    """Mean Strehl ratios of the tracked loop and another one at the same moments, and of their difference."""
    here = np.array([ratios[np.argmin(np.abs(t - end))] for end in looks[:, 0]])
    apart = here - looks[:, 1]
    error = apart.std(ddof=1) / np.sqrt(len(apart))
    return (
        f"Strehl ratio: tracked {100 * here.mean():.2f} %, {loop} {100 * looks[:, 1].mean():.2f} %, tracked "
        f"minus {loop} {100 * apart.mean():+.2f} +- {100 * error:.2f} % ({len(apart)} looks), "
        f"last quarter {100 * apart[-len(apart) // 4 :].mean():+.2f} %"
    )


def picture(rows: dict[str, Any], truth: Any, gains: Any, others: dict[str, Any]) -> Figure:
    """Shift, rotation, gain and Strehl ratio against time."""
    figure = style.new_figure(9.2, 6.4)
    panels = figure.subplots(2, 2).ravel()
    t = rows["seconds"]
    for panel, name, k, title in (
        (panels[0], "shift_x", 0, "shift x [% of a sub-aperture]"),
        (panels[1], "rotation", 2, "rotation [deg]"),
    ):
        value, sigma = rows[name] - truth[0, k], rows[f"{name}_sigma"]
        panel.fill_between(t, value - sigma, value + sigma, color=style.SERIES[0], alpha=0.3, lw=0)
        panel.plot(t, value, color=style.SERIES[0], lw=1.2, label="tracked")
        panel.plot(t, truth[:, k] - truth[0, k], ":", color=style.INK, lw=1.2, label="truth")
        style.tidy(panel).set_title(f"{title}, since the start", fontsize=9.5)
    sigma = rows["optical_gain_sigma"]
    panels[2].fill_between(
        t, rows["optical_gain"] - sigma, rows["optical_gain"] + sigma, color=style.SERIES[0], alpha=0.3, lw=0
    )
    panels[2].plot(t, rows["optical_gain"], color=style.SERIES[0], lw=1.2, label="tracked")
    panels[2].plot(gains[:, 0], gains[:, 1], "o", ms=3, color=style.INK, label="truth")
    style.tidy(panels[2]).set_title("optical gain, beside the start's matrix", fontsize=9.5)
    ratio = np.isfinite(rows["strehl"])
    panels[3].errorbar(
        t[ratio], rows["strehl"][ratio], rows["strehl_sigma"][ratio],
        color=style.SERIES[0], lw=1.0, elinewidth=0.5, label="tracked, with pokes",
    )  # fmt: skip
    for (loop, looks), mark, colour in zip(others.items(), "os", (style.INK, style.SERIES[1]), strict=False):
        panels[3].plot(looks[:, 0], looks[:, 1], mark, ms=3.5, color=colour, label=LABELS[loop])
    style.tidy(panels[3]).set_title("Strehl ratio, peak", fontsize=9.5)
    for panel in panels:
        panel.set_xlabel("seconds")
        panel.legend(frameon=False, fontsize=8)
    return figure
