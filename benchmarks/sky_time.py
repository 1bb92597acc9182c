"""Error of the registration against the frames spent: runs the campaign and draws its curves.

    python benchmarks/sky_time.py --plants 20 --frames 220 300 500 1000 10000 --out docs/figures

Writes ``sky-time.json`` and ``sky-time.png``, with the system's name behind for any but ``razor-shwfs``.
Twenty plants take about ten minutes on two cores; on a pyramid (``--system razor-pywfs``) the goal is that of
its own sub-apertures, pixels of the pupil image.
``--curves FILE`` draws curves that were measured before, from ``escape reproduce sky-time --json``.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

from escape_hw.api.procedure import Progress, run
from escape_hw.report.figures_registration import error_curves
from escape_hw.runtime.sky_time import FRAMES, sky_time


def measure(system: str, plants: int, frames: list[int], workers: int) -> dict[str, Any]:
    """Run the campaign with a line per plant."""

    def tell(progress: Progress) -> None:
        print(f"\r{progress.done} of {progress.total} plants", end="", flush=True)

    procedure = sky_time(system, plants=plants, frames=sorted(frames), workers=workers)
    return run(procedure, observers=(tell,))


def main() -> None:
    """Parse, measure or read, write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--system", default="razor-shwfs")
    parser.add_argument("--plants", type=int, default=20)
    parser.add_argument("--frames", type=int, nargs="+", default=list(FRAMES))
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--curves", type=Path)
    parser.add_argument("--out", type=Path, default=Path("."))
    options = parser.parse_args()
    if options.curves is not None:
        curves = json.loads(options.curves.read_text())
    else:
        curves = measure(options.system, options.plants, options.frames, options.workers)
    options.out.mkdir(parents=True, exist_ok=True)
    name = "sky-time" if options.system == "razor-shwfs" else f"sky-time-{options.system}"
    (options.out / f"{name}.json").write_text(json.dumps(curves, indent=1) + "\n")
    error_curves(curves).savefig(options.out / f"{name}.png", dpi=110)
    print(f"\nfewest frames that meet the goal: {curves['fewest_frames']}; curves in {options.out}")


if __name__ == "__main__":
    main()
