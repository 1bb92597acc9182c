"""``escape doctor``."""

from __future__ import annotations

from dataclasses import asdict
from typing import Annotated

import typer

from escape_hw.cli import options
from escape_hw.cli.session import session

_SIGNS = {"ok": "✓", "info": "·", "warning": "!", "error": "✗"}


def doctor(
    system: Annotated[
        str, typer.Argument(metavar="[SYSTEM]", help="System whose real devices must work (default: none).")
    ] = "",
    set: options.Set = None,
    mode: options.Mode = None,
    json: options.Json = False,
) -> None:
    """Look whether this computer can drive real devices; opens none.

    Exit codes of its own: 0 all is well, 1 something is not as it should be, 2 something will not work.
    """
    with session("doctor", json=json) as one:
        from escape_hw.io.documents import head
        from escape_hw.runtime.doctor import examine, exit_code

        config = one.configured(options.Choice.of(system, set, None, mode)) if system else None
        findings = examine(config)
        for finding in findings:
            one.show(f"{_SIGNS[finding.level]} {finding.item}: {finding.text}")
            if finding.way_out:
                one.show(f"    → {finding.way_out}")
        code = exit_code(findings)
        start = head("doctor", system or None, None if config is None else config.simulated, None)
        one.result({**start, "verdict": code, "findings": [asdict(finding) for finding in findings]})
        one.code = code
