"""Geometry that is given to a mirror's class, checked as that of a system file is."""

from __future__ import annotations

import math

from escape_hw.config.devices import Pitch, Stroke
from escape_hw.config.layouts import resolve_layout
from escape_hw.config.options import parse_options
from escape_hw.config.section import Section
from escape_hw.errors import ConfigError


class _Lengths(Section):
    """The ranges are those of ``[devices.dm]``."""

    pitch_m: Pitch
    stroke_m: Stroke = math.nan


def require_geometry(device: str, layout: str, pitch_m: float, stroke_m: float | None) -> str:
    """Check the geometry of a mirror.

    Parameters
    ----------
    device
        Name in messages.
    layout
        Arrangement of the actuators; empty: as the mirror reports. Tables of positions are in pitches.
    pitch_m
        Distance between actuators, metres.
    stroke_m
        Metres of surface for a command of 1; NaN or ``None``: not known.

    Returns
    -------
    str
        The layout, with the content of its file in place of the file's name.

    Raises
    ------
    ConfigError
        Layout, pitch or stroke is not possible.
    """
    stroke_is_known = stroke_m is not None and not (isinstance(stroke_m, float) and math.isnan(stroke_m))
    lengths = {"pitch_m": pitch_m, **({"stroke_m": stroke_m} if stroke_is_known else {})}
    parse_options(_Lengths, device, lengths)
    try:
        return resolve_layout(layout) if layout else ""
    except ValueError as error:
        raise ConfigError(f"{device}.layout: {error}") from error
