"""What an engine is told when it starts."""

from __future__ import annotations

from pathlib import Path

from pydantic import BaseModel, ConfigDict


class Setup(BaseModel):
    """An engine's orders, sent by the front as the first message.

    Parameters
    ----------
    config_text
        The system's whole configuration, TOML.
    runs
        Folder under which runs go.
    reads
        Folders that products may be loaded from.
    first_run
        Number of the first run.
    silence_s
        When the front was silent for so long, the mirror is made safe.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    config_text: str
    runs: Path
    reads: tuple[Path, ...]
    first_run: int = 1
    silence_s: float = 15.0
