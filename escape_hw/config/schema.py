"""JSON schema of the system files, for editors that check TOML while typing."""

from __future__ import annotations

from typing import Any

from escape_hw.config.models import SystemConfig


def json_schema() -> dict[str, Any]:
    """The schema of a system's TOML file with ranges, defaults and descriptions."""
    schema = SystemConfig.model_json_schema(by_alias=True)
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "ESCAPE system",
        **{key: value for key, value in schema.items() if key != "title"},
    }
