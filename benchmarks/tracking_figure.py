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
#: How far off the shift may be [% of a sub-aperture], and the Strehl ratio beside the loop that knows [%].
SHIFT_BAR, STREHL_BAR = 2.0, 1.0
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
    picture(rows, truth, gains, others).savefig(figure, dpi=110, facecolor="white")


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


def beside(looks: NDArray[np.float64], t: Any, ratios: Any) -> NDArray[np.float64]:
    """The tracked loop's Strehl ratios at the moments of looks at another one ``(n,)``."""
    return np.array([ratios[np.argmin(np.abs(t - end))] for end in looks[:, 0]])


def difference(loop: str, looks: NDArray[np.float64], t: Any, ratios: Any) -> str:
    """Mean Strehl ratios of the tracked loop and another one at the same moments, and of their difference."""
    here = beside(looks, t, ratios)
    apart = here - looks[:, 1]
    error = apart.std(ddof=1) / np.sqrt(len(apart))
    return (
        f"Strehl ratio: tracked {100 * here.mean():.2f} %, {loop} {100 * looks[:, 1].mean():.2f} %, tracked "
        f"minus {loop} {100 * apart.mean():+.2f} +- {100 * error:.2f} % ({len(apart)} looks), relative "
        f"{100 * apart.mean() / looks[:, 1].mean():+.2f} +- {100 * error / looks[:, 1].mean():.2f} %; "
        f"last quarter {100 * apart[-len(apart) // 4 :].mean():+.2f} %"
    )


def band(panel: Any, t: Any, value: Any, sigma: Any) -> None:
    """A course with the band of its standard errors."""
    panel.fill_between(t, value - sigma, value + sigma, color=style.SERIES[0], alpha=0.3, lw=0)
    panel.plot(t, value, color=style.SERIES[0], lw=1.2, label="tracked")


def picture(rows: dict[str, Any], truth: Any, gains: Any, others: dict[str, Any]) -> Figure:
    """Shift and its error, rotation, gain, Strehl ratio and what it lacks, against time."""
    figure = style.new_figure(9.2, 9.0)
    panels = figure.subplots(3, 2, sharex=True).ravel()
    t = rows["seconds"]
    for panel, name, k, title in (
        (panels[0], "shift_x", 0, "shift x [% of a sub-aperture]"),
        (panels[2], "rotation", 2, "rotation [deg]"),
    ):
        band(panel, t, rows[name] - truth[0, k], rows[f"{name}_sigma"])
        panel.plot(t, truth[:, k] - truth[0, k], ":", color=style.INK, lw=1.4, label="truth")
        style.tidy(panel).set_title(f"{title}, since the start", fontsize=9.5)
    band(panels[1], t, rows["shift_x"] - truth[:, 0], rows["shift_x_sigma"])
    panels[1].axhline(0, color=style.INK, lw=0.8)
    for bar in (-SHIFT_BAR, SHIFT_BAR):
        panels[1].axhline(bar, color=style.MUTED, lw=1.0, ls=":", label="asked for" if bar > 0 else None)
    panels[1].margins(y=0.2)
    style.tidy(panels[1]).set_title("shift x, tracked less truth [% of a sub-aperture]", fontsize=9.5)
    band(panels[3], t, rows["optical_gain"], rows["optical_gain_sigma"])
    panels[3].plot(gains[:, 0], gains[:, 1], "o", ms=3, color=style.INK, label="truth")
    style.tidy(panels[3]).set_title("optical gain, beside the start's matrix", fontsize=9.5)
    strehl_panels(panels[4], panels[5], rows, others)
    for panel in panels:
        panel.legend(frameon=False, fontsize=8)
    for panel in panels[4:]:
        panel.set_xlabel("seconds")
    return figure


def strehl_panels(panel: Any, lacking: Any, rows: dict[str, Any], others: dict[str, Any]) -> None:
    """Strehl ratios, and what each loop lacks of the one that knows on the same air."""
    t, ratio = rows["seconds"], np.isfinite(rows["strehl"])
    panel.errorbar(
        t[ratio], 100 * rows["strehl"][ratio], 100 * rows["strehl_sigma"][ratio],
        color=style.SERIES[0], lw=1.0, elinewidth=0.5, label="tracked, with pokes",
    )  # fmt: skip
    known = others.get("knows")
    for (loop, looks), mark, colour in zip(others.items(), "os", (style.INK, style.SERIES[1]), strict=False):
        panel.plot(looks[:, 0], 100 * looks[:, 1], mark, ms=3.5, color=colour, label=LABELS[loop])
        if known is not None and len(known) == len(looks) and loop != "knows":
            lack = 100 * (looks[:, 1] / known[:, 1] - 1)
            lacking.plot(looks[:, 0], lack, mark, ms=3.5, color=colour, label=LABELS[loop])
    if known is not None:
        lack = 100 * (beside(known, t, rows["strehl"]) / known[:, 1] - 1)
        lacking.plot(known[:, 0], lack, "-", color=style.SERIES[0], lw=1.2, label="tracked, with pokes")
    lacking.axhline(-STREHL_BAR, color=style.MUTED, lw=1.0, ls=":", label="asked for")
    style.tidy(panel).set_title("Strehl ratio, peak [%]", fontsize=9.5)
    style.tidy(lacking).set_title("Strehl ratio beside the loop that knows [%]", fontsize=9.5)
