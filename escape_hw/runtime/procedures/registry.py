"""All procedures. Importing this module loads no numerical library."""

from __future__ import annotations

from typing import Any

from escape_hw.errors import ConfigError
from escape_hw.runtime.procedures.calibration import (
    DocrimeProcedure,
    EscapeProcedure,
    FastPushPullProcedure,
    ModulatedProcedure,
    PushPullProcedure,
)
from escape_hw.runtime.procedures.declaration import ProcedureSpec
from escape_hw.runtime.procedures.detector import DarkProcedure, FlatProcedure
from escape_hw.runtime.procedures.gains import GainsProcedure
from escape_hw.runtime.procedures.loop import LoopProcedure
from escape_hw.runtime.procedures.model_psf import ModelPsfProcedure
from escape_hw.runtime.procedures.sensor import SensorProcedure
from escape_hw.runtime.procedures.sprint import SprintProcedure
from escape_hw.runtime.procedures.track import TrackProcedure

#: The procedures in the order in which a window lists them.
PROCEDURES: list[type[ProcedureSpec[Any]]] = [
    EscapeProcedure,
    DocrimeProcedure,
    PushPullProcedure,
    FastPushPullProcedure,
    ModulatedProcedure,
    SprintProcedure,
    LoopProcedure,
    GainsProcedure,
    TrackProcedure,
    SensorProcedure,
    ModelPsfProcedure,
    DarkProcedure,
    FlatProcedure,
]


def find_procedure(name: str) -> type[ProcedureSpec[Any]]:
    """The procedure of that name.

    Raises
    ------
    ConfigError
        There is none; lists the names.
    """
    known = {procedure.name: procedure for procedure in PROCEDURES}
    if name not in known:
        raise ConfigError(f"no procedure is called '{name}'; there are {', '.join(known)}")
    return known[name]
