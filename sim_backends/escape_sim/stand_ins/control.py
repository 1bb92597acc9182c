"""Handle on a stand-in: faults by script, what it was called with, what it complains of."""

from __future__ import annotations

import ctypes
from pathlib import Path
from typing import Self

import numpy as np
from numpy.typing import NDArray

from escape_sim.stand_ins.build import build


class StandIn:
    """One stand-in, as this process has it loaded; there is one state per process.

    Parameters
    ----------
    name
        Of the stand-in, see :data:`~escape_sim.stand_ins.build.LIBRARIES`.

    Attributes
    ----------
    path
        The shared library, to be given to a driver.
    library
        The same as ctypes has it loaded.

    Raises
    ------
    StandInUnavailable
        It cannot be compiled here.
    """

    def __init__(self, name: str) -> None:
        self.path: Path = build(name)
        self.library = ctypes.CDLL(str(self.path))
        self._text = self.library.escape_stand_in_text
        self._text.argtypes, self._text.restype = (
            [ctypes.c_int, ctypes.c_char_p, ctypes.c_size_t],
            ctypes.c_size_t,
        )
        self.library.escape_stand_in_calls.restype = ctypes.c_long

    def clear(self, *, record: bool = True) -> Self:
        """Forget everything, as if freshly loaded; with ``record``, log every call from here on."""
        self.library.escape_stand_in_clear()
        self.library.escape_stand_in_record(int(record))
        return self

    def script(self, text: str) -> Self:
        """Add rules to the script of faults, one per line or between semicolons; see ``stand_in.h``.

        Raises
        ------
        ValueError
            A rule means nothing.
        """
        line = self.library.escape_stand_in_script(text.encode())
        if line:
            wrong = text.replace(";", "\n").split("\n")[line - 1].strip()
            raise ValueError(f"rule {line} of the script means nothing: {wrong!r}")
        return self

    @property
    def calls(self) -> list[str]:
        """The calls since :meth:`clear`, one line each; complaints stand among them after ``'! '``."""
        return self._lines(0)

    @property
    def complaints(self) -> list[str]:
        """What the caller did that the real library leaves undefined."""
        return self._lines(1)

    @property
    def n_calls(self) -> int:
        """How many calls there were, recorded or not."""
        return int(self.library.escape_stand_in_calls())

    def names(self) -> list[str]:
        """Names of the functions called, in order, complaints left out."""
        return [line.partition(" ")[0] for line in self.calls if not line.startswith("! ")]

    def shape(self, n_act: int) -> NDArray[np.float64]:
        """The shape ``(n_act,)`` that a mirror has now, fraction of full stroke."""
        out = np.zeros(n_act)
        self.library.escape_stand_in_shape(out.ctypes.data_as(ctypes.c_void_p), n_act)
        return out

    def _lines(self, which: int) -> list[str]:
        length = self._text(which, None, 0)
        buffer = ctypes.create_string_buffer(length + 1)
        self._text(which, buffer, length + 1)
        return buffer.value.decode(errors="replace").splitlines()
