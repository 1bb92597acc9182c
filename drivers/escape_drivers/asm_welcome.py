"""Compares what an adaptive secondary says of itself with what is configured."""

from __future__ import annotations

from typing import TYPE_CHECKING

from escape_drivers.asm_messages import Welcome
from escape_hw.errors import DeviceError, SettingRejected

if TYPE_CHECKING:
    from escape_hw.config.device_models import MirrorConfig

#: Head-room for the mirror's limits, which come as single-precision numbers.
_ROUNDING = 1e-6


def require_meant(name: str, section: MirrorConfig, welcome: Welcome) -> None:
    """Require the mirror that was meant; who only looks needs no more.

    Raises
    ------
    DeviceError
        It is another mirror.
    """
    if welcome.present.size != section.n_act:
        raise DeviceError(
            name,
            f"has {welcome.present.size} actuators, devices.{name}.layout = '{section.layout}' has "
            f"{section.n_act}; correct the layout or the address",
        )
    if section.serial and section.serial != welcome.serial:
        raise DeviceError(
            name,
            f"is {welcome.serial!r}, not {section.serial!r}; correct devices.{name}.serial or the address",
        )


def require_fit(name: str, section: MirrorConfig, welcome: Welcome) -> tuple[int, ...]:
    """Require the mirror that was meant, and limits of ours that lie within its own.

    Parameters
    ----------
    name
        The device's.
    section
        Its configuration.
    welcome
        What the mirror says.

    Returns
    -------
    tuple of int
        Configured actuators to be taken out of service that still are in service; empty: none.

    Raises
    ------
    DeviceError
        It is another mirror.
    SettingRejected
        A limit of ours exceeds the mirror's, or actuators are out of service that the configuration
        counts on.
    """
    require_meant(name, section, welcome)
    limits, stroke = section.limits, section.stroke_m
    slew = limits.max_slew if limits.max_slew is not None else 2 * limits.max_stroke
    for key, ours, theirs in (
        ("max_stroke", limits.max_stroke, welcome.max_command_m / stroke),
        ("max_slew", slew, welcome.max_step_m / stroke),
    ):
        if ours > theirs * (1 + _ROUNDING):
            raise SettingRejected(
                name,
                f"devices.{name}.limits.{key} is {ours:g}; the mirror itself skips commands beyond "
                f"{theirs:.4g}: set it to that or less",
            )
    missing = sorted(set(welcome.disabled) - set(limits.disabled))
    if missing:
        every = sorted({*welcome.disabled, *limits.disabled})
        raise SettingRejected(
            name,
            f"actuators {missing} are out of service that the configuration counts on; put this into "
            f"[devices.{name}.limits]: disabled = {every}",
        )
    return () if set(limits.disabled) == set(welcome.disabled) else limits.disabled
