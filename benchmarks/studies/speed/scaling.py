"""How the cost of a frame grows: ours and OOPAO's against sub-apertures, actuators and modulation.

    python benchmarks/studies/speed/scaling.py --out scaling --minutes 20 --figure docs/figures/scaling.png \\
        --page docs/performance.md

Every point runs in a process of its own, so that its peak memory is its own. Points already in
``--out`` are not measured again, so the run may be stopped and taken up at any time; a point that takes
longer than ``--limit`` seconds is left out.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from escape_benchmarks.realisation_tables import study_parser
from escape_hw.config.bundled import bundled_systems
from escape_hw.config.loader import load_system

#: Sub-apertures across, mirrors ("circle-N" has about pi N^2 / 4 actuators), modulation radii in lambda/D.
ACROSS = (10, 20, 40, 60, 80)
LAYOUTS = (11, 21, 37, 55, 71, 80)
RADII = (1, 2, 3, 5, 8)
PYRAMID_ACROSS = (16, 32, 64, 80)
#: Lenslets across while the actuators grow, and camera pixels per lenslet.
LENSLETS, PIXELS = 40, 8
CODES = ("ours", "OOPAO")
#: Photons per sub-aperture and frame, about as on the bench.
_PHOTONS = 2e4
BEGIN, END = "<!-- scaling: begin -->", "<!-- scaling: end -->"
#: One thread for all packages; must be set before NumPy loads.
_ONE_THREAD = {name: "1" for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")}


@dataclass(frozen=True)
class Point:
    """One system to be measured."""

    series: str
    x: float
    system: str
    overrides: tuple[str, ...]

    def key(self, who: str) -> str:
        return f"{self.series}-{self.x:g}-{who}"


def points() -> list[Point]:
    """All points; those of the pyramid only where its system comes along."""
    out = [Point("sub-apertures across", n, "razor-shwfs", _shack_hartmann(n, 11)) for n in ACROSS]
    for across in LAYOUTS:
        overrides = _shack_hartmann(LENSLETS, across)
        config = load_system("razor-shwfs", overrides=overrides)
        n_act = config.devices.dm.n_act
        out.append(Point("actuators", n_act, "razor-shwfs", overrides))
    if "razor-pywfs" not in bundled_systems():
        print("no system razor-pywfs here: points of the pyramid are left out", file=sys.stderr)
        return out
    still = ("twin.substeps=1", "twin.loss_probability=0")
    out += [Point("modulation", r, "razor-pywfs", (*still, f"sensor.modulation={r}")) for r in RADII]
    return [
        *out,
        *(Point("pyramid pixels across", n, "razor-pywfs", (*still, *_pyramid(n))) for n in PYRAMID_ACROSS),
    ]


def _shack_hartmann(n: int, across: int) -> tuple[str, ...]:
    side = PIXELS * n + 40
    return (
        "twin.substeps=1",
        "twin.loss_probability=0",
        # As bright as the bench, per sub-aperture.
        f"twin.wfs.photons_per_frame={_PHOTONS * n**2}",
        f"sensor.n_sub={n}",
        f"sensor.pitch_px={PIXELS}",
        f"twin.wfs.pitch_px={PIXELS}",
        "sensor.spot_px=1.2",
        f"devices.wfs.sensor_px=[{side},{side}]",
        f"devices.wfs.region=[0,0,{side},{side}]",
        f'devices.dm.layout="circle-{across}"',
        f"devices.dm.pitches_across_pupil={across - 2}",
    )


def _pyramid(n: int) -> tuple[str, ...]:
    near, far = 0.75 * n, 2.25 * n
    return (
        f"sensor.n_sub={n}",
        f"sensor.pupils_px=[[{near},{near}],[{far},{near}],[{near},{far}],[{far},{far}]]",
        f"devices.wfs.sensor_px=[{3 * n},{3 * n}]",
        f"devices.wfs.region=[0,0,{3 * n},{3 * n}]",
    )


def measure(system: str, overrides: tuple[str, ...], who: str, seconds: float) -> dict[str, float]:
    """Median time per frame, set-up time and peak memory, in this process."""
    from escape_benchmarks.optics.frames import oopao_frame, twin_frame
    from escape_hw.api.concurrency import limit_to_one_thread

    start = time.perf_counter()
    with limit_to_one_thread():
        if who == "ours":
            call = twin_frame(load_system(system, overrides=overrides))
        elif system == "razor-shwfs":
            call = oopao_frame(load_system(system, overrides=overrides))
        else:
            call = twin_frame(load_system(system, overrides=(*overrides, "system.optics=oopao")))
        call()
        set_up = time.perf_counter() - start
        times: list[float] = []
        while sum(times) < seconds or len(times) < 3:
            start = time.perf_counter()
            call()
            times.append(time.perf_counter() - start)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return {
        "frame_s": float(np.median(times)),
        "set_up_s": set_up,
        "peak_mb": peak,
        "load": os.getloadavg()[0],
    }


def run_point(point: Point, who: str, limit: float, seconds: float) -> dict[str, object]:
    """Measure one point in a process of its own."""
    job = json.dumps({**asdict(point), "who": who, "seconds": seconds})
    command = [sys.executable, __file__, "--job", job]
    try:
        done = subprocess.run(
            command,
            capture_output=True,
            text=True,
            timeout=limit,
            env={**os.environ, **_ONE_THREAD},
            check=False,
        )
    except subprocess.TimeoutExpired:
        return {"failed": f"longer than {limit:.0f} s"}
    if done.returncode:
        return {"failed": (done.stderr.strip().splitlines() or ["no message"])[-1]}
    return dict(json.loads(done.stdout.strip().splitlines()[-1]))


def campaign(folder: Path, minutes: float, limit: float, seconds: float) -> None:
    """Measure what is not there yet, ours and OOPAO's of a point one after the other."""
    folder.mkdir(parents=True, exist_ok=True)
    end = time.monotonic() + 60 * minutes
    for point in points():
        for who in CODES:
            path = folder / f"{point.key(who).replace(' ', '_')}.json"
            if path.exists():
                continue
            if time.monotonic() > end:
                print("out of time; run again to continue", file=sys.stderr)
                return
            found = run_point(point, who, limit, seconds)
            path.write_text(json.dumps({"series": point.series, "x": point.x, "who": who, **found}))
            print(point.key(who), found, flush=True)


def read(folder: Path) -> list[dict[str, Any]]:
    return [json.loads(path.read_text()) for path in sorted(folder.glob("*.json"))]


def slope(x: NDArray[np.float64], y: NDArray[np.float64]) -> float:
    """Exponent of the growth over the upper half of the range, where fixed costs no longer count."""
    large = x >= np.median(x)
    return float(np.polyfit(np.log(x[large]), np.log(y[large]), 1)[0]) if large.sum() > 1 else float("nan")


def curves(
    rows: list[dict[str, Any]], series: str, who: str, what: str
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    pairs = sorted(
        (float(r["x"]), float(r[what]))
        for r in rows
        if r["series"] == series and r["who"] == who and what in r
    )
    return np.array([p[0] for p in pairs]), np.array([p[1] for p in pairs])


def figure(rows: list[dict[str, Any]], path: Path) -> None:
    import matplotlib.pyplot as plt

    names = [
        s
        for s in dict.fromkeys(str(r["series"]) for r in rows)
        if len(curves(rows, s, "ours", "frame_s")[0]) > 1
    ]
    if not names:
        raise SystemExit("no series has two points yet; run again with more time")
    drawn, axes = plt.subplots(2, len(names), figsize=(4.2 * len(names), 6.0), sharex="col", squeeze=False)
    for column, series in enumerate(names):
        for who, mark in zip(CODES, "os", strict=True):
            for row, (what, scale, label) in enumerate(
                (("frame_s", 1e3, "time per frame [ms]"), ("peak_mb", 1.0, "peak memory [MB]"))
            ):
                x, y = curves(rows, series, who, what)
                if not x.size:
                    continue
                ax = axes[row, column]
                grows = f", exponent {slope(x, y):.1f}" if row == 0 and x.size > 2 else ""
                ax.loglog(x, y * scale, f"{mark}-", label=f"{who}{grows}")
                ax.set_ylabel(label)
                ax.grid(alpha=0.3)
                crowded = np.append(x[1:] / x[:-1] < 1.3, False)
                ax.set_xticks(x, ["" if close else f"{v:g}" for v, close in zip(x, crowded, strict=True)])
                ax.minorticks_off()
        axes[1, column].set_ylim(bottom=100)
        axes[0, column].legend(frameon=False)
        axes[1, column].set_xlabel(series if series != "modulation" else "modulation radius [lambda/D]")
    drawn.tight_layout()
    drawn.savefig(path, dpi=130)
    plt.close(drawn)


def table(rows: list[dict[str, Any]]) -> str:
    lines = [
        "| | | ours [ms] | OOPAO [ms] | times faster | ours [MB] | OOPAO [MB] |",
        "|---|---:|---:|---:|---:|---:|---:|",
    ]
    for series in dict.fromkeys(str(r["series"]) for r in rows):
        for x in sorted({float(r["x"]) for r in rows if r["series"] == series}):
            both = [
                next((r for r in rows if r["series"] == series and r["x"] == x and r["who"] == who), {})
                for who in CODES
            ]
            time_ms = [1e3 * float(r["frame_s"]) if "frame_s" in r else None for r in both]
            memory = [float(r["peak_mb"]) if "peak_mb" in r else None for r in both]
            cells = [
                *(
                    str(r.get("failed", "-")) if v is None else f"{v:.3g}"
                    for v, r in zip(time_ms, both, strict=True)
                )
            ]
            ratio = f"{time_ms[1] / time_ms[0]:.1f}" if time_ms[0] and time_ms[1] else "-"
            cells += [ratio, *("-" if v is None else f"{v:.0f}" for v in memory)]
            lines.append(f"| {series} | {x:g} | " + " | ".join(cells) + " |")
    fits = []
    for series in dict.fromkeys(str(r["series"]) for r in rows):
        for who in CODES:
            grown = curves(rows, series, who, "frame_s")
            if grown[0].size > 2:
                fits.append(f"{series}, {who}: {slope(*grown):.2f}")
    loads = [float(r["load"]) for r in rows if "load" in r]
    load = f" Load average {min(loads):.1f} to {max(loads):.1f}." if loads else ""
    return "\n".join(
        [*lines, "", "Exponents over the upper half of each range: " + "; ".join(fits) + "." + load]
    )


def main() -> None:
    parser = study_parser(__doc__)
    parser.set_defaults(out=Path("scaling"))
    parser.add_argument("--minutes", type=float, default=20.0, help="begin no point after this time")
    parser.add_argument("--limit", type=float, default=240.0, help="seconds for one point")
    parser.add_argument("--seconds", type=float, default=2.0, help="seconds of frames for one point")
    parser.add_argument("--figure", type=Path, help="write the figure")
    parser.add_argument("--page", type=Path, help="put the table between the marks of a page")
    parser.add_argument("--job", help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.job:
        job = json.loads(given.job)
        print(json.dumps(measure(job["system"], tuple(job["overrides"]), job["who"], job["seconds"])))
        return
    campaign(given.out, given.minutes, given.limit, given.seconds)
    rows = read(given.out)
    if given.figure:
        figure(rows, given.figure)
    if given.page:
        text = given.page.read_text()
        before, after = text.split(BEGIN)[0], text.split(END)[1]
        given.page.write_text(f"{before}{BEGIN}\n\n{table(rows)}\n\n{END}{after}")
    print(table(rows))


if __name__ == "__main__":
    main()
