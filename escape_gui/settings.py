"""Settings of the window, saved between sessions. A damaged file does not prevent the start."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Literal

import platformdirs
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from escape_hw.io.storage import write_atomic
from escape_hw.suggestions import closest_match

#: Workspace that the window shows when it is opened for the first time.
FIRST_WORKSPACE = "align"


class Settings(BaseModel):
    """Theme, font size and layouts."""

    model_config = ConfigDict(validate_assignment=True, extra="ignore")

    theme: Literal["dark", "light"] = "dark"
    font_scale: float = Field(1.0, ge=0.8, le=2.0)
    workspace: str = "operate"
    #: Arrangement of the docks by workspace: Qt's format, base64.
    layouts: dict[str, str] = Field(default_factory=dict)
    #: Limits of the alarms by name; alarms without a limit are off.
    alarms: dict[str, float] = Field(default_factory=dict)
    alarms_muted: bool = False
    #: Size and position of the window: Qt's format, base64.
    geometry: str = ""


def settings_file() -> Path:
    """Path of the settings file in the user's configuration folder."""
    return Path(platformdirs.user_config_dir("escape")) / "gui.json"


def load_settings(path: Path) -> tuple[Settings, tuple[str, ...]]:
    """Read settings; invalid entries are ignored, with a warning for each."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        # The first start: look at the devices and the light.
        return Settings(workspace=FIRST_WORKSPACE), ()
    except (OSError, ValueError) as error:
        return Settings(), (f"{path}: cannot be read ({error}); using the default settings",)
    if not isinstance(content, dict):
        return Settings(), (f"{path}: not a table of settings; using the default settings",)
    settings, warnings = Settings(), []
    for key, value in content.items():
        if key not in Settings.model_fields:
            meant = closest_match(key, Settings.model_fields)
            hint = f"; did you mean '{meant}'?" if meant else ""
            warnings.append(f"{path}: unknown setting '{key}' is ignored{hint}")
            continue
        try:
            setattr(settings, key, value)
        except ValidationError as error:
            reason = error.errors()[0]["msg"]
            warnings.append(f"{path}: setting '{key}' is ignored: {reason}")
    return settings, tuple(warnings)


def save_settings(path: Path, settings: Settings) -> None:
    """Write settings atomically; raise `StorageError` if the file cannot be written."""
    write_atomic(path, (settings.model_dump_json(indent=2) + "\n").encode())
