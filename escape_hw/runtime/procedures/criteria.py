"""Pass criteria of procedures and of the reproduced results of the paper."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from escape_hw.api.optical_gains import GainsResult
from escape_hw.api.registration import PARAMETERS, Registration
from escape_hw.api.results import LoopResult, RegistrationEstimate
from escape_hw.pipeline.statistics import MeanInterval

#: Differences between SHORT and LONG in the paper's Table 1, to the last digit printed there.
PAPER_DIFFERENCES = {
    "shift_x": 1.3,
    "shift_y": 0.4,
    "rotation": 0.02,
    "radial_scaling": 0.1,
    "tangential_scaling": 0.19,
}
#: Largest pull (difference over standard error) that still counts as recovered.
_LARGEST_PULL = 4.0
#: Difference of Strehl ratios down to which ESCAPE counts as equivalent to the measured baseline.
STREHL_MARGIN = -0.005


def criterion(text: str, met: bool) -> dict[str, Any]:
    """One criterion for documents and reports."""
    return {"text": text, "met": bool(met)}


def _readable_name(name: str) -> str:
    return name.replace("_", " ")


def sprint_converged(label: str, estimate: RegistrationEstimate | None) -> dict[str, Any]:
    """SPRINT converged; ``limited`` where it did so without a model that fits."""
    check = criterion(f"{label}: SPRINT converged", estimate is not None and estimate.converged)
    if estimate is None or not estimate.converged or estimate.model_fits is not False:
        return check
    return {"text": f"{label}: SPRINT {estimate.outcome}", "met": True, "limited": True}


def gains_converged(result: GainsResult) -> dict[str, Any]:
    """The bootstrap of the optical gains converged."""
    if not result.rounds:
        return criterion("optical gains: measured at least once", False)
    last = result.rounds[-1]
    short = "" if last.reached else ", its frames ended before the accuracy asked for"
    return criterion(
        f"optical gains: converged in {len(result.rounds)} rounds (last change {100 * last.change:.1f} %, "
        f"{100 * last.expected_change:.1f} % expected of the errors, "
        f"poke {100 * last.poke:.2g} % of stroke{short})",
        result.converged,
    )


def injected_value_recovered(
    label: str, estimate: RegistrationEstimate, injected: Registration
) -> dict[str, Any]:
    """The injected registration lies within the error bars."""
    worst, name = largest_pull(estimate, injected)
    return criterion(
        f"{label}: injected registration recovered within {_LARGEST_PULL:g} standard errors "
        f"(largest pull {worst:.1f}, {_readable_name(name)})",
        worst <= _LARGEST_PULL,
    )


def largest_pull(estimate: RegistrationEstimate, injected: Registration) -> tuple[float, str]:
    """Largest error of a registration in standard errors, and its parameter.

    It is NaN, which counts as not recovered, from no standard error and no difference.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        pulls = np.abs(estimate.registration.to_array() - injected.to_array()) / estimate.sigma
    return float(pulls.max()), PARAMETERS[int(pulls.argmax())]


def short_and_long_agree(short: RegistrationEstimate, long: RegistrationEstimate) -> list[dict[str, Any]]:
    """SHORT and LONG agree at least as well as the paper's, parameter by parameter."""
    criteria_met = []
    for name, value in short.parameters().items():
        difference = abs(value.value - long.parameters()[name].value)
        allowed = PAPER_DIFFERENCES[name]
        criteria_met.append(
            criterion(
                f"SHORT and LONG agree in {_readable_name(name)}: {difference:.3g} "
                f"(paper: {allowed:g} {value.unit})",
                difference <= allowed,
            )
        )
    return criteria_met


def loop_criteria(results: Mapping[str, LoopResult]) -> list[dict[str, Any]]:
    """Every loop is stable; ESCAPE is not below the measured baseline by more than a margin.

    The errors of the Strehl ratios do not contain that of the gain, which every matrix has of its own.
    The baseline is push-pull or, where there is no source for it, DO-CRIME.
    """
    criteria_met = [criterion(f"{label}: loop stable", loop.stable) for label, loop in results.items()]
    ours_name = "ESCAPE + OG" if "ESCAPE + OG" in results else "ESCAPE"
    escape, name = results.get(ours_name), "push-pull" if "push-pull" in results else "DO-CRIME"
    baseline = results.get(name)
    if escape is None or baseline is None or escape.model_psf is None or baseline.model_psf is None:
        return criteria_met
    if not (escape.stable and baseline.stable):
        return criteria_met  # which one is not stable is said above, and there is nothing to compare
    if escape.strehl is None or baseline.strehl is None or not math.isfinite(escape.strehl.peak.sigma):
        return [
            *criteria_met,
            criterion(f"Strehl of {ours_name} and {name} compared: their loops were too short", False),
        ]
    for way, what in (("peak", "peak"), ("otf", "OTF"), ("encircled", "encircled")):
        ours, theirs = getattr(escape.strehl, way), getattr(baseline.strehl, way)
        error = math.hypot(ours.sigma, theirs.sigma)
        difference = ours.value - theirs.value
        criteria_met.append(
            criterion(
                f"Strehl ({what}) of {ours_name} minus {name}: {100 * difference:+.1f} ± "
                f"{100 * error:.1f} %, not below {100 * STREHL_MARGIN:.1f} % by two standard errors or more",
                difference > STREHL_MARGIN - 2 * error,
            )
        )
    return criteria_met


def stable_for_every_seed(label: str, unstable: Sequence[int]) -> dict[str, Any]:
    """The loop with a matrix is stable for every seed; ``unstable`` are the seeds for which it is not."""
    which = f" (not for {', '.join(map(str, unstable))})" if unstable else ""
    return criterion(f"{label}: loop stable for every seed{which}", not unstable)


def strehl_not_worse(first: str, second: str, difference: MeanInterval) -> dict[str, Any]:
    """The Strehl ratio of a matrix is not below that of another by more than a margin.

    ``difference`` is that of the Strehl ratios in percent, paired by seed.
    """
    margin = 100 * STREHL_MARGIN
    return criterion(
        f"Strehl (peak) of {first} minus {second}, {difference.n} seeds: {difference} %, "
        f"not below {margin:.1f} % with all of the interval",
        difference.high > margin,
    )
