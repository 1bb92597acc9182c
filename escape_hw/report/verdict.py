"""One line of verdict on the result of a run: good, usable or not usable, why, and what to do."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

#: Signal-to-noise ratio of the worst mode from which a measured matrix is good, and usable.
GOOD_SNR, USABLE_SNR = 3.0, 1.0


class Quality(IntEnum):
    """Quality of a result, the worst last."""

    GOOD = 0
    USABLE = 1
    NOT_USABLE = 2

    @property
    def text(self) -> str:
        """Words."""
        return self.name.lower().replace("_", " ")


@dataclass(frozen=True, slots=True)
class Verdict:
    """Quality of a result, the reason, and what to do if it is not good."""

    quality: Quality
    reason: str
    advice: str = ""

    def __str__(self) -> str:
        line = (
            f"{self.quality.text.capitalize()}: {self.reason}"
            if self.reason
            else self.quality.text.capitalize()
        )
        return f"{line}; {self.advice}" if self.advice else line


def assess(document: Mapping[str, Any]) -> Verdict | None:
    """The verdict on a ``result.json``; ``None`` without a criterion, as for a reference PSF."""
    figures = list(_figures(document))
    problems = list(_problems(document))
    if problems:
        return max(problems, key=lambda one: one.quality)
    return Verdict(Quality.GOOD, ", ".join(figures)) if figures else None


def _problems(document: Mapping[str, Any]) -> Iterator[Verdict]:
    for criterion in document.get("criteria") or ():
        if not criterion.get("met", True):
            yield Verdict(Quality.NOT_USABLE, f"not met: {criterion.get('text')}", "see the report")
    if document.get("converged") is False:
        yield Verdict(Quality.NOT_USABLE, "not converged", "read the warnings, and measure more frames")
    yield from _noisy_modes(document)
    if document.get("partial"):
        yield Verdict(
            Quality.USABLE, "the run was aborted, the data measured so far are saved", "run it again"
        )
    for warning in document.get("warnings") or ():
        yield Verdict(Quality.USABLE, str(warning), "see the report")
    if alarms := document.get("alarms"):
        yield Verdict(Quality.USABLE, f"{len(alarms)} alarms", "see the report")


def _noisy_modes(document: Mapping[str, Any]) -> Iterator[Verdict]:
    """Modes with too much noise; those of a fitted model do not enter its matrix."""
    worst = (document.get("snr") or {}).get("min")
    if not isinstance(worst, int | float) or not math.isfinite(worst) or worst >= GOOD_SNR:
        return
    is_fitted = document.get("converged") is not None
    quality = Quality.USABLE if worst >= USABLE_SNR or is_fitted else Quality.NOT_USABLE
    frames = document.get("frames")
    # The signal-to-noise ratio grows with the square root of the number of frames; two digits are enough.
    more = "measure more frames"
    if frames:
        more = f"measure about {float(f'{frames * (GOOD_SNR / max(worst, 0.1)) ** 2:.1e}'):,.0f} frames"
    yield Verdict(quality, f"SNR {worst:.2g} in the worst mode", f"{more} or drop the noisy modes")


def _figures(document: Mapping[str, Any]) -> Iterator[str]:
    """The numbers that make a result good."""
    worst = (document.get("snr") or {}).get("min")
    if isinstance(worst, int | float):
        yield f"SNR {worst:.3g} in the worst mode"
    if document.get("converged"):
        iterations = document.get("iterations")
        yield f"converged in {iterations} iterations" if iterations else "converged"
    if document.get("stable"):
        yield "loop stable"
