"""Every number the paper states, beside ours."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from escape_hw.api.gains import OpticalGains
from escape_hw.api.registration import PARAMETERS
from escape_hw.api.results import Measured
from escape_hw.report.content import RunContent
from escape_hw.report.tables import TITLES, percent, with_error

#: The paper's Table 1.
TABLE1 = {
    "SHORT": dict(zip(PARAMETERS, ("-15.3", "-71.3", "-0.75", "2.9", "0.17"), strict=True)),
    "LONG": dict(zip(PARAMETERS, ("-16.6", "-71.7", "-0.77", "2.9", "-0.02"), strict=True)),
}


@dataclass(frozen=True, slots=True)
class PaperNumber:
    """One number of the paper.

    Parameters
    ----------
    what
        What is stated.
    paper
        The paper's value or words.
    ours
        Ours; ``None`` when the run that gives it is not there.
    """

    what: str
    paper: str
    ours: str | None


@dataclass(frozen=True, slots=True)
class Part:
    """The numbers that one run gives.

    Parameters
    ----------
    kind
        Name of the run in a collection of them.
    command
        What makes it.
    numbers
        Takes the run, or ``None`` when it is not there.
    """

    kind: str
    command: str
    numbers: Callable[[RunContent | None], Iterator[PaperNumber]]


def _calibration(run: RunContent | None, label: str) -> Any:
    return None if run is None else run.calibrations.get(label)


def _table1(run: RunContent | None) -> Iterator[PaperNumber]:
    found: dict[str, dict[str, float]] = {}
    for column, stated in TABLE1.items():
        result = _calibration(run, f"ESCAPE {column}")
        measured = None if result is None or result.registration is None else result.registration.measured()
        for name, value in stated.items():
            title, unit = TITLES[name]
            ours = None
            if measured is not None:
                ours = with_error(measured[name])
                found.setdefault(column, {})[name] = measured[name].value
            yield PaperNumber(f"Table 1, {column}: {title} [{unit}]", value.replace("-", "−"), ours)
    worst = None
    if len(found) == 2:
        # Tangential scaling is left out, as in the paper: it is nothing.
        pairs = [(found["SHORT"][p], found["LONG"][p]) for p in PARAMETERS[:4]]
        worst = f"{max(100 * abs(a - b) / abs(b) for a, b in pairs):.1f} %"
    yield PaperNumber("Table 1: largest inconsistency of SHORT and LONG", "8 %", worst)
    for column, stated_time in (("SHORT", "≈ 20 s"), ("LONG", "≈ 3 min")):
        result = _calibration(run, f"ESCAPE {column}")
        ours = None if result is None else f"{result.sky_seconds:.0f} s, {result.frames} frames"
        yield PaperNumber(f"sky time of {column}", stated_time, ours)


def _difference(run: RunContent | None, first: str, second: str) -> str | None:
    """Strehl (peak) of one loop minus another's, with both errors."""
    if run is None or first not in run.loops or second not in run.loops:
        return None
    a, b = run.loops[first].strehl, run.loops[second].strehl
    if a is None or b is None:
        return "no Strehl ratio: the loops were too short"
    sigma = float(np.hypot(a.peak.sigma, b.peak.sigma))
    return percent(Measured(a.peak.value - b.peak.value, sigma)).strip().replace("-", "−")


def _shwfs(run: RunContent | None) -> Iterator[PaperNumber]:
    yield PaperNumber(
        "Shack-Hartmann, Strehl of ESCAPE minus baseline",
        "consistent",
        _difference(run, "ESCAPE", "push-pull"),
    )
    yield PaperNumber(
        "Shack-Hartmann, Strehl of DO-CRIME minus baseline", "very slightly worse",
        _difference(run, "DO-CRIME", "push-pull"),
    )  # fmt: skip
    rate = None if run is None or not run.loops else next(iter(run.loops.values()))
    yield PaperNumber(
        "Shack-Hartmann, loop speed", "500 Hz", None if rate is None else f"{rate.rate_hz:.0f} Hz"
    )


def _gain_words(gains: OpticalGains | None) -> str | None:
    if gains is None:
        return None
    scatter = float(np.std(gains.trend) / np.mean(gains.trend))
    return f"{np.mean(gains.best):.2f}, over the modes ± {100 * scatter:.0f} %"


def _pywfs(run: RunContent | None) -> Iterator[PaperNumber]:
    result = None if run is None else next(iter(run.gains.values()), None)
    beside: Mapping[str, OpticalGains] = {} if result is None else result.beside
    yield PaperNumber(
        "pyramid, optical gain of the baseline", "< 1, roughly constant", _gain_words(beside.get("push-pull"))
    )
    yield PaperNumber(
        "pyramid, optical gain of open-loop DO-CRIME", "> 1, roughly constant",
        _gain_words(beside.get("DO-CRIME")),
    )  # fmt: skip
    poke = None if result is None or not result.rounds else f"{100 * result.rounds[-1].poke:.2g} %"
    yield PaperNumber("pyramid, pokes in closed loop, share of the stroke", "0.1 to 0.2 %", poke)
    for first, second, words in (
        ("ESCAPE", "push-pull", "similar"),
        ("ESCAPE + OG", "push-pull + OG", "similar"),
        ("DO-CRIME + OG", "push-pull + OG", "only very marginally worse"),
        ("ESCAPE + OG", "ESCAPE", "very similar"),
    ):
        found = _difference(run, first, second)
        yield PaperNumber(f"pyramid, Strehl of {first} minus {second}", words, found)
    loop = None if run is None or not run.loops else next(iter(run.loops.values()))
    yield PaperNumber("pyramid, loop speed", "300 Hz", None if loop is None else f"{loop.rate_hz:.0f} Hz")


def _maps(run: RunContent | None) -> Iterator[PaperNumber]:
    result = _calibration(run, "DO-CRIME")
    modes = None if result is None else str(result.matrix.n_modes)
    yield PaperNumber("MAPS, modes of the matrix", "100", modes)
    yield PaperNumber(
        "MAPS, sky time of the matrix", "a few minutes",
        None if result is None else f"{result.sky_seconds / 60:.1f} min",
    )  # fmt: skip
    escape = _calibration(run, "ESCAPE")
    yield PaperNumber(
        "MAPS, pseudo-synthetic matrix", "not attempted",
        None if escape is None else f"Strehl minus DO-CRIME's {_difference(run, 'ESCAPE', 'DO-CRIME')}",
    )  # fmt: skip


def _swept(run: RunContent | None) -> Iterator[PaperNumber]:
    document = {} if run is None else run.document
    sweep = document.get("sweep")
    name = "the sweep" if run is None else str(document["system"])
    trials = (
        None if sweep is None else f"{sweep['loops']['explore']}, {sum(sweep['loops'].values())} loops in all"
    )
    yield PaperNumber(f"{name}: randomised trials", "1,000", trials)
    share = None
    if sweep is not None and "matrix" in sweep["importance"]:
        kept, chance = sweep["importance"]["matrix"], sweep["importance"].get("chance", 0.0)
        share = f"{100 * kept:.1f} % of the variance; a parameter that does nothing {100 * chance:.1f} %"
    yield PaperNumber(f"{name}: importance of the choice of matrix", "little or none", share)
    stated = [
        row["text"]
        for row in document.get("comparisons", ())
        if row["first"].startswith("ESCAPE") and row["second"] == "push-pull"
    ]
    yield PaperNumber(f"{name}: at their own best parameters", "equivalent", "; ".join(stated) or None)


PARTS = (
    Part("table1", "escape reproduce table1", _table1),
    Part("shwfs", "escape reproduce shwfs --loop-frames 30000", _shwfs),
    Part("pywfs", "escape reproduce pywfs", _pywfs),
    Part("maps", "escape reproduce maps", _maps),
    Part("sweep-shwfs", "escape sweep razor-shwfs --trials 1000", _swept),
    Part("sweep-pywfs", "escape sweep razor-pywfs --trials 1000 --frames 250", _swept),
)
