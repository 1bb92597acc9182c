"""``escape doctor``."""

from __future__ import annotations

from dataclasses import asdict
from typing import Annotated

import typer

from escape_hw.cli.command import command
from escape_hw.cli.completion import complete_system
from escape_hw.cli.context import CommandContext
from escape_hw.cli.options import NO_SYSTEM, SystemSelection

_SYMBOLS = {"ok": "✓", "info": "·", "warning": "!", "error": "✗"}


@command("doctor", without=("seed",))
def doctor(
    context: CommandContext,
    selection: Annotated[
        SystemSelection,
        typer.Argument(
            help="System whose real devices must work (default: none).", autocompletion=complete_system
        ),
    ] = NO_SYSTEM,
) -> None:
    """Check that this computer is set up for real devices. Opens none.

    Exit codes: 0 no finding, 1 warnings, 2 errors.
    """
    from escape_hw.runtime.host.doctor import check_computer, exit_code

    config = context.load_config(selection) if selection.system else None
    findings = check_computer(config)
    for finding in findings:
        context.show(f"{_SYMBOLS[finding.level]} {finding.item}: {finding.text}")
        if finding.remedy:
            context.show(f"    → {finding.remedy}")
    code = exit_code(findings)
    context.set_subject(selection.system or None, None if config is None else config.simulated, None)
    # "way_out" is the name of version 0.1.0.
    context.report(verdict=code, findings=[{**asdict(one), "way_out": one.remedy} for one in findings])
    context.code = code
