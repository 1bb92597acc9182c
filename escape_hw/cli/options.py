"""Options that several commands share."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import typer

System = Annotated[str, typer.Argument(help="Name of a system (see 'escape systems') or a TOML file.")]
Json = Annotated[bool, typer.Option("--json", help="Print exactly one JSON document on standard output.")]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="No progress bars.")]
Out = Annotated[
    Path | None,
    typer.Option("--out", metavar="DIR", help="Folder of the run (default: a dated one in your user data)."),
]
Set = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="KEY=VALUE", help="Override any key of the configuration; repeatable."),
]
Seed = Annotated[int | None, typer.Option("--seed", help="Seed of every random stream.")]
Mode = Annotated[str | None, typer.Option("--mode", metavar="sim|hardware", help="Twins or real devices.")]
Matrix = Annotated[Path, typer.Option("--im", metavar="FILE", help="Interaction matrix (FITS).")]
PokePattern = Annotated[
    str | None, typer.Option("--pokes", help="DO-CRIME: white, shaped or equal-snr (default: configured).")
]
Solver = Annotated[
    str | None,
    typer.Option(
        "--solver", help="SPRINT: effects, light, frozen, batches or diagonal (default: configured)."
    ),
]
ExtraParameters = Annotated[
    str | None,
    typer.Option(
        "--also", help="What SPRINT fits beside the registration: anamorphosis, pupil_shift (comma between)."
    ),
]


def as_toml_list(names: str | None) -> str | None:
    """Names with commas between them as a list for an override; ``None`` stays."""
    if names is None:
        return None
    return str([name.strip() for name in names.split(",") if name.strip()])


ModesChoice = Annotated[
    str | None,
    typer.Option("--modes-choice", help="SPRINT's modes: snr, first, d-optimal or a-optimal."),
]
Loss = Annotated[
    str | None, typer.Option("--loss", help="SPRINT: squares, or huber against bad sub-apertures.")
]
Force = Annotated[bool, typer.Option("--force", help="Allow a simulated matrix on hardware.")]


@dataclass(frozen=True, slots=True)
class SystemSelection:
    """Which system, and how its configuration is changed."""

    system: str
    set: tuple[str, ...] = ()
    seed: int | None = None
    mode: str | None = None

    def with_overrides(self, *overrides: str) -> SystemSelection:
        """The same with further overrides, which go last."""
        return replace(self, set=(*self.set, *overrides))

    def with_calibration_settings(self, **asked: str | None) -> SystemSelection:
        """The same with what was asked of the calibration: values by key, ``None`` for as configured."""
        return self.with_overrides(
            *(f"calibration.{key}={value}" for key, value in asked.items() if value is not None)
        )

    @classmethod
    def of(
        cls, system: str, overrides: list[str] | None, seed: int | None, mode: str | None
    ) -> SystemSelection:
        """From the options as typer delivers them."""
        return cls(system, tuple(overrides or ()), seed, mode)
