"""What each imperfection of a sensor changes in the registration of a calibration: paired realisations.

    python benchmarks/studies/registration/nuisances.py --system razor-shwfs --frames 1000 --realisations 5
    python benchmarks/studies/registration/nuisances.py --system razor-pywfs --frames 1500 --realisations 3 \\
        --case diameter

Each imperfection of :data:`CASES` is drawn from the distribution stated there, with the number of the
realisation as seed, and the realisation is calibrated with it and without any of them: the same mirror,
registration, turbulence and noise. Realisations from 2000 on are for this study. Appends a line per
realisation to ``SYSTEM-CASE.jsonl``, and measures what is missing. Prints a table: rms change of each
parameter, in its unit and in stated standard errors, and the largest one, from the realisations that
converged with and without; rms and largest error in stated errors; number of those that converged; mean
reduced chi-squared. A calibration takes 10 s (razor-shwfs) or 70 s (razor-pywfs) of a core.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from registration_errors import run_realisation

from escape_benchmarks.realisation_tables import Line, each_realisation, realisation_numbers, study_parser
from escape_hw.config.loader import load_system
from escape_hw.config.system import SystemConfig

#: The imperfections of the table are off: the bundled twins have some of them.
NONE = ("twin.latency_jitter_s=0", "twin.substeps=1")
PYRAMID_NONE = (*NONE, "twin.pyramid.ellipse=0", "twin.pyramid.phase=0")
#: Fraction of the turbulence in the layer that the phase screen is; the others are the twin's atmosphere.
_SCREEN_FRACTION = 0.6
#: Wavelength in metres of the Fried parameter of the atmosphere.
_R0_WAVELENGTH_M = 500e-9

#: Overrides of a realisation: drawn from a generator, for a configuration.
Draw = Callable[[np.random.Generator, SystemConfig], list[str]]


@dataclass(frozen=True, slots=True)
class Case:
    """An imperfection: its distribution and why it is so wide, and how it is drawn."""

    distribution: str
    reason: str
    draw: Draw
    #: Kinds of sensor that can have it.
    kinds: tuple[str, ...] = ("shack-hartmann", "pyramid")


def _set(key: str, values: NDArray[np.float64] | float) -> str:
    """Override of a number or a list of them."""
    return f"{key}={np.round(values, 10).tolist()}"


def _layers(rng: np.random.Generator, config: SystemConfig) -> list[str]:
    """Two more layers; the strength of the turbulence is that of the screen alone."""
    screen = config.devices.screen
    if screen is None:
        raise ValueError(f"{config.system.name} has no phase screens")
    first = rng.uniform(0.3, 0.7)
    chromatic = (_R0_WAVELENGTH_M / config.system.wavelength_m) ** 1.2
    others = screen.screens_r0_m[screen.screen] * (1 - _SCREEN_FRACTION) ** -0.6 * chromatic
    weaker = [r0 * _SCREEN_FRACTION**-0.6 for r0 in screen.screens_r0_m]
    return [
        f"devices.screen.screens_r0_m={weaker}",
        f"twin.atmosphere.r0_m={others!r}", f"twin.atmosphere.outer_scale_m={screen.outer_scale_m!r}",
        f"twin.atmosphere.fraction=[{first!r},{1 - first!r}]",
        _set("twin.atmosphere.speed_m_s", screen.speed_m_s * rng.uniform(0.3, 3.0, 2)),
        _set("twin.atmosphere.direction_deg", rng.uniform(-180, 180, 2)),
    ]  # fmt: skip


CASES: Mapping[str, Case] = {
    "run": Case(
        "another `twin.run_seed`", "for comparison: the same bench with other turbulence and noise",
        lambda rng, config: [f"twin.run_seed={int(rng.integers(1, 2**31))}"],
    ),
    "clocking": Case(
        "normal, 0.2 degrees", "moves a spot at the edge by 0.65 pixels, as far as one sees by eye",
        lambda rng, config: [_set("twin.wfs.clocking_deg", 0.2 * rng.standard_normal())], ("shack-hartmann",),
    ),
    "distortion": Case(
        "normal, 0.2 % at half the width", "choice: an ordinary relay lens",
        lambda rng, config: [_set("twin.wfs.distortion", 0.002 * rng.standard_normal())], ("shack-hartmann",),
    ),
    "diameter": Case(
        "uniform, ±0.5 pixels", "`sensor.n_sub` is a whole number",
        lambda rng, config: [_set("twin.pyramid.diameter_px", config.sensor.n_sub + rng.uniform(-0.5, 0.5))],
        ("pyramid",),
    ),
    "modulation radius": Case(
        "normal, 5 %", "choice: the beam's diameter on the modulator, from which its scale follows",
        lambda rng, config: [_set("twin.pyramid.radius_error", 0.05 * rng.standard_normal())], ("pyramid",),
    ),
    "ellipse": Case(
        "uniform, 0 to 0.1, at any angle", "an uncorrected emulated stage has 0.035",
        lambda rng, config: [
            _set("twin.pyramid.ellipse", rng.uniform(0, 0.1)),
            _set("twin.pyramid.ellipse_angle_deg", rng.uniform(-90, 90)),
        ], ("pyramid",),
    ),
    "stroke": Case(
        "normal, 10 %", "choice: a data sheet's stroke is that of the type, at one voltage",
        lambda rng, config: [
            _set("twin.mirror.stroke_m", config.devices.dm.stroke_m * (1 + 0.1 * rng.standard_normal()))
        ],
    ),
    "beam radius": Case(
        "log-normal, 10 %", "choice: a collimated laser whose radius nobody measured",
        lambda rng, config: [
            _set("twin.beam.radius_m", config.sensor.beam_radius_m * np.exp(0.1 * rng.standard_normal()))
        ],
    ),
    "beam centre": Case(
        "normal, 5 % of the pupil in x and y", "choice: a beam centred on the pupil by eye",
        lambda rng, config: [
            _set("twin.beam.centre_m", 0.05 * config.system.pupil_m * rng.standard_normal(2))
        ],
    ),
    "outer scale": Case(
        "log-uniform, 1.5 to 45 pupils", "the models assume 4 pupils",
        lambda rng, config: [
            _set("devices.screen.outer_scale_m", config.system.pupil_m * 1.5 * 30 ** rng.uniform())
        ],
    ),
    "wind layers": Case(
        "40 % of the turbulence in two more layers, 0.3 to 3 times the speed of the screen, any direction",
        "choice: three layers dominate many profiles", _layers,
    ),
    "latency jitter": Case(
        "uniform, 0 to 0.3 ms", "choice: a general-purpose operating system under load",
        lambda rng, config: [_set("twin.latency_jitter_s", rng.uniform(0, 3e-4))],
    ),
    "exposure blur": Case(
        "4 steps per exposure", "the bundled twins have 1, which blurs the motion of the mirror only",
        lambda rng, config: ["twin.substeps=4"],
    ),
    "all of them": Case("each of the above, together", "", lambda rng, config: _all(rng, config)),
}  # fmt: skip


def _all(rng: np.random.Generator, config: SystemConfig) -> list[str]:
    """Every imperfection that the sensor can have."""
    drawn = [case.draw(rng, config) for name, case in CASES.items() if _is_single(name, case, config)]
    return [override for overrides in drawn for override in overrides]


def _is_single(name: str, case: Case, config: SystemConfig) -> bool:
    return config.sensor.kind in case.kinds and name not in ("run", "all of them")


def off(config: SystemConfig) -> tuple[str, ...]:
    """Overrides that switch the imperfections off."""
    return PYRAMID_NONE if config.sensor.kind == "pyramid" else NONE


def expected_change(overrides: Sequence[str], row: Line, config: SystemConfig) -> list[float]:
    """Change ``(5,)`` of the correct registration: with larger pupil images the mirror is larger on them."""
    change = [0.0] * 5
    for override in overrides:
        key, _, value = override.partition("=")
        if key == "twin.pyramid.diameter_px":
            larger = float(value) / config.sensor.n_sub
            change[3:] = [(100 + scaling) * (larger - 1) for scaling in row["injected"][3:]]
    return change


def measure(system: str, name: str | None, number: int, frames: int) -> Line:
    """Calibrate a realisation with an imperfection; with none without ``name``."""
    config = load_system(system)
    drawn: list[str] = []
    if name is not None:
        # Every imperfection has its own stream.
        drawn = CASES[name].draw(np.random.default_rng([number, list(CASES).index(name)]), config)
    row = run_realisation(system, number, frames, [*off(config), *drawn], False)
    change = expected_change(drawn, row, config)
    row["error"] = np.subtract(row["error"], change).tolist()
    return {"drawn": drawn, "expected_change": change, **row}


def print_table(rows: Mapping[str, list[Line]], reference: list[Line]) -> None:
    """Markdown of the changes by imperfection."""
    names = ("shift x [%]", "shift y [%]", "rotation [deg]", "radial [%]", "tangential [%]")
    print(f"| imperfection | {' | '.join(names)} | largest | error | converged | chi-squared |")
    print("|---|" + "---:|" * (len(names) + 4))
    without = {line["realisation"]: line for line in reference}
    print(f"| none | {' | '.join(['–'] * 6)} | {_outcome(reference)} |")
    for name, lines in rows.items():
        pairs = [(without[line["realisation"]], line) for line in lines]
        both = [(zero, one) for zero, one in pairs if zero["converged"] and one["converged"]]
        cells, largest = ["–"] * 5, "–"
        if both:
            changes = np.array([np.subtract(one["error"], zero["error"]) for zero, one in both])
            in_sigmas = changes / np.array([one["sigma"] for _, one in both])
            cells = [f"{rms(c):.2g} ({rms(s):.2f} σ)" for c, s in zip(changes.T, in_sigmas.T, strict=True)]
            largest = f"{np.abs(in_sigmas).max():.1f} σ"
        print(f"| {name} | {' | '.join(cells)} | {largest} | {_outcome(lines)} |")
    for name, lines in rows.items():
        for line in lines:
            for warning in line["warnings"]:
                print(f"\n{name}, realisation {line['realisation']}: {warning}")


def _outcome(lines: Sequence[Line]) -> str:
    """Rms and largest error in stated errors, number of the converged realisations, mean chi-squared."""
    errors = np.array([np.divide(line["error"], line["sigma"]) for line in lines if line["converged"]])
    error = f"{rms(errors):.2f}, {np.abs(errors).max():.1f} σ" if len(errors) else "–"
    return f"{error} | {len(errors)} of {len(lines)} | {np.mean([line['chi2'] for line in lines]):.2f}"


def print_distributions(names: Sequence[str]) -> None:
    """Markdown of the distributions."""
    print("| imperfection | distribution | origin of its width |\n|---|---|---|")
    for name in names:
        print(f"| {name} | {CASES[name].distribution} | {CASES[name].reason} |")
    print()


def rms(values: NDArray[np.float64]) -> float:
    """Root of the mean square."""
    return float(np.sqrt(np.mean(np.square(values))))


def main() -> None:
    """Measure what is missing, and print the tables."""
    parser = study_parser(__doc__, "razor-shwfs", 5)
    parser.set_defaults(first=2000)
    parser.add_argument("--frames", type=int, default=1000)
    parser.add_argument("--case", dest="cases", nargs="*", choices=list(CASES), help="default: all")
    options = parser.parse_args()
    system, frames, kind = options.system, options.frames, load_system(options.system).sensor.kind
    possible = [name for name, case in CASES.items() if kind in case.kinds]
    asked = possible if options.cases is None else [name for name in options.cases if name in possible]

    def lines(name: str | None) -> list[Line]:
        label = (name or "none").replace(" ", "-")
        return each_realisation(
            options.out / f"{system}-{label}.jsonl",
            {"system": system, "frames": frames, "case": name},
            realisation_numbers(options),
            lambda number: measure(system, name, number, frames),
            lambda row: f"{label}: {np.round(row['error'], 3).tolist()}",
        )

    reference = lines(None)
    rows = {name: lines(name) for name in asked}
    print_distributions(asked)
    print_table(rows, reference)


if __name__ == "__main__":
    main()
