"""``escape doctor``."""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated, Any

import typer

from escape_hw.cli import options
from escape_hw.cli.context import command_context

if TYPE_CHECKING:
    from escape_hw.runtime.host.doctor import Finding

_SYMBOLS = {"ok": "✓", "info": "·", "warning": "!", "error": "✗"}


def doctor(
    system: Annotated[
        str, typer.Argument(metavar="[SYSTEM]", help="System whose real devices must work (default: none).")
    ] = "",
    set: options.Set = None,
    mode: options.Mode = None,
    json: options.Json = False,
) -> None:
    """Check that this computer is set up for real devices. Opens none.

    Exit codes: 0 no finding, 1 warnings, 2 errors.
    """
    with command_context("doctor", json=json) as context:
        from escape_hw.io.documents import header_fields
        from escape_hw.runtime.host.doctor import check_computer, exit_code

        config = context.load_config(options.SystemSelection.of(system, set, None, mode)) if system else None
        findings = check_computer(config)
        for finding in findings:
            context.show(f"{_SYMBOLS[finding.level]} {finding.item}: {finding.text}")
            if finding.remedy:
                context.show(f"    → {finding.remedy}")
        code = exit_code(findings)
        start = header_fields("doctor", system or None, None if config is None else config.simulated, None)
        context.result({**start, "verdict": code, "findings": [_to_dict(one) for one in findings]})
        context.code = code


def _to_dict(finding: Finding) -> dict[str, Any]:
    """A finding for ``--json``; version 0.1.0 called the remedy ``way_out``."""
    return {**asdict(finding), "way_out": finding.remedy}
