"""Options that several commands share."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import typer

from escape_hw.cli.completion import complete_driver, complete_system

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
Force = Annotated[bool, typer.Option("--force", help="Allow a simulated matrix on hardware.")]


Driver = Annotated[
    str | None,
    typer.Option(
        "--driver",
        metavar="NAME",
        help="Driver of a real device, in place of a system; --set then gives its settings.",
        autocompletion=complete_driver,
    ),
]
Serial = Annotated[
    str | None, typer.Option("--serial", metavar="NUMBER", help="Serial number of the device, with --driver.")
]


@dataclass(frozen=True, slots=True)
class SystemSelection:
    """A system and the changes to its configuration; or the driver of one device and its settings."""

    system: str
    set: tuple[str, ...] = ()
    seed: int | None = None
    mode: str | None = None
    driver: str = ""
    serial: str = ""

    def with_overrides(self, *overrides: str) -> SystemSelection:
        """The selection with further overrides, applied last."""
        return replace(self, set=(*self.set, *overrides))

    def words(self) -> tuple[str, ...]:
        """The selection as words of a command line."""
        options = [("--driver", self.driver), ("--serial", self.serial)]
        options += [("--set", change) for change in self.set]
        options += [("--seed", "" if self.seed is None else str(self.seed)), ("--mode", self.mode or "")]
        given = (word for option, value in options if value for word in (option, value))
        return (self.system, *given) if self.system else tuple(given)


#: A command's system, named by its argument; see :func:`~escape_hw.cli.command.command`.
Selection = Annotated[
    SystemSelection,
    typer.Argument(
        help="Name of a system (see 'escape systems') or a TOML file.", autocompletion=complete_system
    ),
]
#: A system or, with ``--driver``, none; see :class:`~escape_hw.cli.devices.device_tools.DeviceCommand`.
DeviceSelection = Annotated[
    SystemSelection,
    typer.Argument(
        help="Name of a system (see 'escape systems') or a TOML file; none with --driver.",
        autocompletion=complete_system,
    ),
]
#: Default of a command whose argument may be left out.
NO_SYSTEM = SystemSelection("")
OptionalSelection = Annotated[
    SystemSelection,
    typer.Argument(
        help="Name of a system (see 'escape systems') or a TOML file; not with --resume.",
        autocompletion=complete_system,
    ),
]
