"""Options of the driver ``asm`` in ``[devices.dm.options]``."""

from __future__ import annotations

from dataclasses import dataclass

#: Default port of ``escape emulate asm``.
DEFAULT_PORT = 7336
#: Host name of an emulator inside this process with the twin's actuators.
EMULATOR = "emulator"

#: Smallest and largest value of each number.
OPTION_RANGES = {
    "port": (1, 65535),
    "connect_s": (1e-3, 600),
    "reply_s": (1e-3, 600),
    "heartbeat_s": (1e-3, 600),
    "step_s": (1e-3, 600),
    "retry_s": (1e-3, 600),
    "max_skips": (1, 1e6),
}


@dataclass(frozen=True, slots=True)
class AsmOptions:
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
    port: int = DEFAULT_PORT
    lift: bool = True
    connect_s: float = 2.0
    reply_s: float = 0.5
    heartbeat_s: float = 0.1
    step_s: float = 60.0
    retry_s: float = 0.25
    max_skips: int = 10
