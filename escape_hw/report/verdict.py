"""One line of verdict on the result of a run: good, usable, not usable or aborted, why, and what to do."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, TypeGuard

from escape_hw.api.results import describe_outcome

#: Signal-to-noise ratio of the worst mode from which a measured matrix is good, and usable.
GOOD_SNR, USABLE_SNR = 3.0, 1.0

#: Standard error of a shift from which on it is usable only: a whole sub-aperture, in %.
UNCERTAIN_SHIFT = 100.0


class Quality(IntEnum):
    """Quality of a result, the worst last; a run that was aborted has no other quality."""

    GOOD = 0
    USABLE = 1
    NOT_USABLE = 2
    ABORTED = 3

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

    def to_dict(self) -> dict[str, str]:
        """Plain values for JSON."""
        return {"quality": self.quality.text, "reason": self.reason, "advice": self.advice}

    def __str__(self) -> str:
        line = (
            f"{self.quality.text.capitalize()}: {self.reason}"
            if self.reason
            else self.quality.text.capitalize()
        )
        return f"{line}; {self.advice}" if self.advice else line


def assess(document: Mapping[str, Any]) -> Verdict | None:
    """The verdict on a ``result.json``; ``None`` without a criterion, as for a reference PSF.

    That on an aborted run states how far it came, and judges what was measured by then.
    """
    judged = _judge(document)
    if not document.get("partial"):
        return judged
    reason = _describe_abort(document)
    if judged is not None:
        reason += f"; what was measured is {judged.quality.text}: {judged.reason}"
    # A sweep continues with the loops that are left.
    return Verdict(Quality.ABORTED, reason, "resume it" if "sweep" in document else "run it again")


def _judge(document: Mapping[str, Any]) -> Verdict | None:
    """The verdict on what a document holds."""
    figures = list(_figures(document))
    problems = list(_problems(document))
    if problems:
        return max(problems, key=lambda one: one.quality)
    return Verdict(Quality.GOOD, ", ".join(figures)) if figures else None


def verdict_document(document: Mapping[str, Any]) -> dict[str, str] | None:
    """The verdict in plain values, for JSON."""
    verdict = assess(document)
    return None if verdict is None else verdict.to_dict()


def _problems(document: Mapping[str, Any]) -> Iterator[Verdict]:
    alarms = _mappings(document.get("alarms"))
    if document.get("stable") is False:
        yield Verdict(
            Quality.NOT_USABLE,
            "the loop was not stable",
            "lower the gain, drop more modes, or calibrate again",
        )
    if document.get("converged") is False:
        warnings = document.get("warnings")
        why = str(warnings[0]) if isinstance(warnings, list | tuple) and warnings else ""
        reason = f"not converged: {why}" if why else "not converged"
        yield Verdict(Quality.NOT_USABLE, reason, "" if why else "measure more frames")
    elif document.get("model_fits") is False:
        yield Verdict(
            Quality.USABLE,
            describe_outcome(True, False) + _describe_residual(document),
            "the notes name what does not fit, and the standard errors contain it",
        )
    elif document.get("converged") and document.get("model_fits", True) is None:
        yield _not_judged(document)
    for criterion in _mappings(document.get("criteria")):
        text = str(criterion.get("text"))
        # Alarms are judged below.
        if not criterion.get("met", True) and not (alarms and text.startswith("no alarms")):
            yield Verdict(Quality.NOT_USABLE, f"not met: {text}", "see the report")
    yield from _uncertain_shifts(document)
    yield from _noisy_modes(document)
    warnings = document.get("warnings")
    for warning in warnings if isinstance(warnings, list | tuple) else ():
        yield Verdict(Quality.USABLE, str(warning), "see the report")
    if alarms:
        many = f"{len(alarms)} alarms, the last" if len(alarms) > 1 else "an alarm"
        yield Verdict(Quality.USABLE, f"{many}: {alarms[-1].get('text', '')}", "see the report")


def _describe_abort(document: Mapping[str, Any]) -> str:
    """How far an aborted run came; files of version 0.1.0 know the frames of its result only."""
    stop, frames = _mapping(document.get("stopped_at")), document.get("frames")
    done, total, unit = stop.get("done"), stop.get("total"), stop.get("unit")
    if not _is_number(done) or not _is_number(total):
        return f"stopped after {frames:,} frames" if _is_number(frames) else "stopped before its end"
    # Progress is reported a few times a second; a result knows its frames exactly.
    if unit == "frame" and _is_number(frames) and done < frames <= total:
        done = frames
    if total == 1:
        return f"{stop.get('stage')} stopped"
    of = f"{done:,} of {total:,}" if total else f"{done:,}"
    return f"{stop.get('stage')} stopped after {of} {unit}s"


def _not_judged(document: Mapping[str, Any]) -> Verdict:
    """That a converged registration is not judged, and how it would be."""
    snr = _mapping(document.get("snr"))
    if "min" in snr and not _is_number(snr["min"]):
        return Verdict(
            Quality.USABLE,
            "converged, but the matrix has no standard errors, so whether the model fits is not judged",
            "state its noise if it is known (matrix.sigma of 'escape import arrays')",
        )
    return Verdict(
        Quality.USABLE,
        "converged, but whether the model fits is not judged",
        "measure more frames, in open loop",
    )


def _describe_residual(document: Mapping[str, Any]) -> str:
    """What a model that does not fit leaves, in brackets."""
    misfit, chi2 = document.get("misfit"), document.get("chi2")
    if not _is_number(misfit) or not _is_number(chi2) or not misfit:
        return ""
    return f" ({misfit:.0%} of the matrix beyond its noise, reduced chi-squared {chi2:.3g})"


def _uncertain_shifts(document: Mapping[str, Any]) -> Iterator[Verdict]:
    """Shifts that may be wrong by a sub-aperture, because the numbering of the lenslets is uncertain."""
    registration = _mapping(document.get("registration"))
    for name in ("shift_x", "shift_y"):
        sigma = _mapping(registration.get(name)).get("sigma")
        if _is_number(sigma) and sigma >= UNCERTAIN_SHIFT:
            reason = f"{name} is uncertain by {sigma:.0f} % of a sub-aperture"
            yield Verdict(Quality.USABLE, reason, "see the notes for the cause")


def _noisy_modes(document: Mapping[str, Any]) -> Iterator[Verdict]:
    """Modes with too much noise; those of a fitted model do not enter its matrix."""
    worst = _mapping(document.get("snr")).get("min")
    if not _is_number(worst) or worst >= GOOD_SNR:
        return
    is_fitted = document.get("converged") is not None
    quality = Quality.USABLE if worst >= USABLE_SNR or is_fitted else Quality.NOT_USABLE
    frames = document.get("frames")
    if not _is_number(frames):
        frames = 0
    # The signal-to-noise ratio grows with the square root of the number of frames; two digits are enough.
    more = "measure more frames"
    if frames:
        more = f"measure about {float(f'{frames * (GOOD_SNR / max(worst, 0.1)) ** 2:.1e}'):,.0f} frames"
    yield Verdict(quality, f"SNR {worst:.2g} in the worst mode", f"{more} or drop the noisy modes")


def _figures(document: Mapping[str, Any]) -> Iterator[str]:
    """The numbers that make a result good."""
    worst = _mapping(document.get("snr")).get("min")
    if _is_number(worst):
        yield f"SNR {worst:.3g} in the worst mode"
    if document.get("converged"):
        # Rounds of a measurement of optical gains, iterations of SPRINT.
        number, what = document.get("iterations"), "iterations"
        if number is None and (rounds := _mappings(document.get("rounds"))):
            number, what = len(rounds), "rounds"
        yield f"converged in {number} {what}" if number else "converged"
    if document.get("stable"):
        yield "loop stable"
        if _is_number(residual := document.get("residual_rms_nm")):
            yield f"residual {residual:.0f} nm rms"
        if (strehl := strehl_ratio(document)) is not None:
            yield f"Strehl ratio {100 * strehl:.1f} %"
    criteria = _mappings(document.get("criteria"))
    if criteria and not any(key in document for key in ("snr", "converged", "stable")):
        yield f"all {len(criteria)} criteria met" if len(criteria) > 1 else f"met: {criteria[0].get('text')}"


def strehl_ratio(document: Mapping[str, Any]) -> float | None:
    """The Strehl ratio (peak) of a closed loop or of a track; ``None`` if it was not measured."""
    strehl = document.get("strehl")
    if isinstance(strehl, Mapping):
        strehl = _mapping(strehl.get("peak")).get("value")
    return float(strehl) if _is_number(strehl) else None


def _mapping(value: object) -> Mapping[str, Any]:
    """A mapping of a document, empty if the file has something else there."""
    return value if isinstance(value, Mapping) else {}


def _mappings(value: object) -> list[Mapping[str, Any]]:
    """The mappings of a list of a document."""
    return [one for one in value if isinstance(one, Mapping)] if isinstance(value, list | tuple) else []


def _is_number(value: object) -> TypeGuard[float]:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
