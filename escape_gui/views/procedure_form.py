"""Texts of the procedure panel: arguments, plan, progress, result."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from escape_gui.views.convergence import short_unit
from escape_hw.api.registration import PARAMETERS
from escape_hw.api.results import Estimate
from escape_hw.remote.state import (
    ActiveRun,
    Arguments,
    Finish,
    FinishedRun,
    ProcedureParameter,
    ProcedurePlan,
    ProductEntry,
)
from escape_hw.report.tables import TITLES, format_with_error
from escape_hw.report.verdict import strehl_ratio

#: Results that are single numbers, in the order of display: key of the document, words, unit.
_SINGLE_VALUES = (
    ("n_sub_apertures", "Sub-apertures", ""), ("counts", "Counts per sub-aperture", ""),
    ("background", "Background", " counts"), ("peak", "Peak", " counts"), ("total", "Total", " counts"),
    ("delay_frames", "Delay", " frames"),
)  # fmt: skip
#: Entry of a list of choices for an argument without a value.
NO_CHOICE = "–"


def label(parameter: ProcedureParameter) -> str:
    """Words for a parameter in the form."""
    return parameter.label or parameter.name.replace("_", " ").capitalize()


def parameter_hint(parameter: ProcedureParameter) -> str:
    """Its help with the allowed range."""
    low, high, unit = parameter.low, parameter.high, f" {parameter.unit}" if parameter.unit else ""
    words = [parameter.help]
    if low is not None and high is not None:
        words.append(f"{low:g} to {high:g}{unit}.")
    elif low is not None:
        words.append(f"At least {low:g}{unit}.")
    elif high is not None:
        words.append(f"At most {high:g}{unit}.")
    elif unit:
        words.append(f"In{unit}.")
    if parameter.default in (None, ""):
        words.append("May be left empty.")
    return " ".join(word for word in words if word)


def format_value(value: object) -> str:
    """A value as shown in the form."""
    if value is None:
        return ""
    return f"{value:g}" if isinstance(value, float) else str(value)


def parse_value(parameter: ProcedureParameter, text: str) -> float | int | str | None:
    """Value of a field's text; ``None`` if an optional field is empty.

    ValueError: the text is not a number, not an integer or out of range; gives the allowed values.
    """
    text = text.strip().replace("−", "-")
    if not text or text == NO_CHOICE:
        if parameter.default in (None, ""):
            return None
        raise ValueError(f"{label(parameter)}: empty; {format_value(parameter.default)} is usual")
    if parameter.kind not in ("int", "float"):
        return text
    try:
        number = float(text)
    except ValueError:
        hint = "; write a decimal point, and no other separators" if "," in text else ""
        raise ValueError(f"{label(parameter)}: '{text}' is no number{hint}") from None
    low = -math.inf if parameter.low is None else parameter.low
    high = math.inf if parameter.high is None else parameter.high
    if not (math.isfinite(number) and low <= number <= high):
        raise ValueError(f"{label(parameter)}: {text} is out of range. {parameter_hint(parameter)}")
    if parameter.kind == "float":
        return number
    if number != int(number):
        raise ValueError(f"{label(parameter)}: {text} is not a whole number")
    return int(number)


def is_valid(parameter: ProcedureParameter, text: str) -> bool:
    """Whether a field may have this text."""
    try:
        parse_value(parameter, text)
    except ValueError:
        return False
    return True


def rejected_line(rejected: Mapping[str, str]) -> str:
    """A line on entered values that are not valid on this server, by label; empty if there is none."""
    parts = ", ".join(f"{name} {text}" for name, text in rejected.items())
    return f"Entered before, but not valid here: {parts}." if parts else ""


def matrices(products: tuple[ProductEntry, ...]) -> tuple[str, ...]:
    """Names of the matrices to choose from, the newest first."""
    return tuple(one.name for one in reversed(products) if one.kind == "matrix")


def format_duration(seconds: float) -> str:
    """A length of time for people: ``8.0 s``, ``4:12``, ``1:02:03``."""
    if not math.isfinite(seconds):
        return "–"
    if seconds < 60:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d} min"


def plan_lines(plan: ProcedurePlan, *, simulated: bool = False) -> list[str]:
    """A plan in two lines: what it takes, and how far the mirror moves."""
    rate = "simulated frame rate of the camera" if simulated else "camera's frame rate"
    stroke = f"largest command about {100 * plan.stroke:.2g} % of stroke" if plan.stroke else "no pokes"
    if not plan.frames:
        return ["no frames needed: computed from existing data", ""]
    prepare = f", {plan.preparation_frames} of them to prepare" if plan.preparation_frames else ""
    return [f"{plan.frames} sensor frames{prepare}; {format_duration(plan.seconds)} at the {rate}", stroke]


def progress_line(running: ActiveRun) -> str:
    """Progress of a procedure."""
    many = "s" if (running.total or running.completed) != 1 else ""
    # A procedure that runs until it is stopped has no total.
    whole = f" of {running.total}" if running.total else ""
    line = f"{running.stage or running.name}: {running.completed}{whole} {running.unit}{many}"
    if running.paused:
        return f"Paused. {line}"
    if running.remaining_s is not None and math.isfinite(running.remaining_s):
        line += f", {format_duration(running.remaining_s)} left"
    return line


def metrics_line(metrics: Mapping[str, float]) -> str:
    """Progress metrics."""
    known = {name: value for name, value in metrics.items() if math.isfinite(value)}
    return " · ".join(f"{name.replace('_', ' ')} {value:.4g}" for name, value in known.items())


def worst_mode(snr: np.ndarray[Any, np.dtype[np.float64]]) -> str:
    """The mode that is known worst."""
    known = np.where(np.isfinite(snr), snr, np.inf)
    if not known.size or not np.isfinite(known.min()):
        return ""
    return f"worst mode {int(np.argmin(known)) + 1}: SNR {known.min():.3g}"


def result_line(ended: FinishedRun) -> str:
    """How a procedure ended, in one line."""
    word = {Finish.DONE: "Done", Finish.ABORTED: "Aborted", Finish.FAILED: "Failed"}
    return f"{word[ended.finish]}: {ended.name}" + (f". {ended.message}" if ended.message else "")


def comparison_lines(now: Mapping[str, Any], before: Mapping[str, Any] | None) -> list[str]:
    """Results of a run beside those of the previous one, from their documents (``result.json``)."""
    lines = _registration_lines(now, before)
    # A loop has a gain too.
    gain = "Gain of the loop" if "residual_rms_nm" in now else "Gain of the matrix"
    numbers = (("gain", gain, ""), ("residual_rms_nm", "Residual", " nm rms"), *_SINGLE_VALUES)
    for key, words, unit in numbers:
        value = now.get(key)
        if isinstance(value, int | float):
            lines.append(f"{words}: {value:.4g}{unit}{_change(value, (before or {}).get(key), unit)}")
    lines += _gains_lines(now)
    snr, old = now.get("snr") or {}, (before or {}).get("snr") or {}
    if isinstance(snr.get("min"), int | float):
        lines.append(f"SNR of the worst mode: {snr['min']:.3g}{_change(snr['min'], old.get('min'), '')}")
    clipped, frames = now.get("clipped_pokes"), now.get("frames")
    if isinstance(clipped, int | float) and frames:
        lines.append(f"Pokes clipped: {100 * clipped / frames:.2g} % ({clipped:.0f} of {frames})")
    if (strehl := strehl_ratio(now)) is not None:
        last = strehl_ratio(before or {})
        change = "" if last is None else f" (before: {100 * last:.1f} %)"
        lines.append(f"Strehl ratio: {100 * strehl:.1f} %{change}")
    if frames:
        lines.append(_frames_line(now))
    return lines


def _gains_lines(now: Mapping[str, Any]) -> list[str]:
    """Mean and range of the optical gains, and the exchanges of a track."""
    lines = []
    gains = np.asarray([one for one in now.get("optical_gain") or () if one is not None], float)
    if gains.size:
        lines.append(f"Optical gain: mean {gains.mean():.3f}, {gains.min():.3f} to {gains.max():.3f}")
    if "exchanges" in now:
        accepted = sum(bool(one.get("accepted")) for one in now["exchanges"])
        lines.append(f"Matrix exchanged: {accepted} of {len(now['exchanges'])} proposals")
        lines.append(f"Alarms: {len(now.get('alarms') or ())}")
    return lines


def _frames_line(now: Mapping[str, Any]) -> str:
    """Frames, time and lost frames; the time of a twin is that of its own clock."""
    seconds, lost = now.get("sky_seconds"), now.get("lost_frames")
    if not isinstance(seconds, int | float) and now.get("rate_hz"):
        seconds = now["frames"] / now["rate_hz"]
    parts = [f"Frames measured: {now['frames']}"]
    if isinstance(seconds, int | float):
        parts.append(f"{format_duration(seconds)}{' (simulated)' if now.get('simulated') else ''}")
    if isinstance(lost, int | float):
        parts.append(f"{lost} lost")
    return ", ".join(parts)


def _registration_lines(now: Mapping[str, Any], before: Mapping[str, Any] | None) -> list[str]:
    found, old = now.get("registration") or {}, (before or {}).get("registration") or {}
    lines = []
    for name in PARAMETERS:
        one = found.get(name)
        if not one or one.get("value") is None:
            continue
        title, unit = TITLES[name]
        title = title.capitalize()
        value = format_with_error(Estimate(one["value"], one.get("sigma") or 0.0))
        line = f"{title}: {value} {short_unit(unit)}"
        last = old.get(name)
        if last and last.get("value") is not None:
            error = math.hypot(one.get("sigma") or 0.0, last.get("sigma") or 0.0)
            line += f" (Δ {format_with_error(Estimate(one['value'] - last['value'], error))})"
        lines.append(line)
    return lines


def _change(value: float, before: object, unit: str) -> str:
    return f" (before: {before:.4g}{unit})" if isinstance(before, int | float) else ""


def non_default_arguments(parameters: tuple[ProcedureParameter, ...], values: Arguments) -> Arguments:
    """What to send: arguments that differ from the defaults."""
    return {one.name: values[one.name] for one in parameters if values[one.name] != one.default}
