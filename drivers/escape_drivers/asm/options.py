"""Options of the driver ``asm`` in ``[devices.dm.options]``."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from escape_hw.config.section import Section

#: Default port of ``escape emulate asm``.
DEFAULT_PORT = 7336
#: Host name of an emulator inside this process with the twin's actuators.
EMULATOR = "emulator"

#: A duration in seconds.
Seconds = Annotated[float, Field(ge=1e-3, le=600)]


class AsmOptions(Section):
    """Options of the link; times in seconds.

    Parameters
    ----------
    host, port
        Address of the mirror's gateway; host ``"emulator"``: an emulator inside this process, whose
        actuators are those of the simulated bench.
    lift
        Lead the mirror to ``RUNNING`` when it is opened.
    connect_s, reply_s
        Longest wait for a connection and for an answer.
    heartbeat_s
        Without a command for so long, the driver gives a sign of life.
    step_s
        Longest duration of one step of the ladder.
    retry_s
        Pause between attempts to get a lost connection back.
    max_skips
        Commands in a row that the mirror may skip before that is an error.
    """

    host: str = "127.0.0.1"
    port: int = Field(DEFAULT_PORT, ge=1, le=65535)
    lift: bool = True
    connect_s: Seconds = 2.0
    reply_s: Seconds = 0.5
    heartbeat_s: Seconds = 0.1
    step_s: Seconds = 60.0
    retry_s: Seconds = 0.25
    max_skips: int = Field(10, ge=1, le=1_000_000)
