"""Compiles the stand-ins of vendor libraries into the user's cache, and controls them.

Control is by script of faults, log of calls and list of violations.
"""

from __future__ import annotations

import ctypes
import hashlib
import os
import shutil
import subprocess
import tempfile
from importlib.resources import files
from pathlib import Path
from typing import Self

import numpy as np
from numpy.typing import NDArray
from platformdirs import user_cache_path

from escape_hw.errors import EscapeError

#: Stand-ins and the vendor libraries that they replace.
LIBRARIES = {"asdk": "ALPAO's libasdk", "m3api": "XIMEA's libm3api", "aravis": "libaravis-0.8"}
_FLAGS = ("-std=gnu11", "-shared", "-fPIC", "-O2", "-Wall", "-Wextra", "-fvisibility=hidden")
_LIBS = ("-lm", "-lpthread")
#: C compilers, tried after the environment variable ``CC``.
_COMPILERS = ("cc", "gcc", "clang")
_COMPILE_S = 120


class StandInUnavailable(EscapeError):
    """A stand-in cannot be compiled on this machine."""

    exit_code = 2


def build_library(name: str) -> Path:
    """Path of a stand-in's shared library, compiled unless it is in the user's cache.

    Its name contains a checksum of the sources.

    Raises
    ------
    StandInUnavailable
        There is no C compiler, or compilation failed.
    ValueError
        The name is not in :data:`LIBRARIES`.
    """
    if name not in LIBRARIES:
        raise ValueError(f"no stand-in {name!r}; there are {', '.join(LIBRARIES)}")
    sources = files(__package__)
    code, header = ((sources / part).read_bytes() for part in (f"{name}.c", "stand_in.h"))
    compiler = _compiler()
    key = hashlib.sha256(b"\0".join([code, header, " ".join((compiler, *_FLAGS, *_LIBS)).encode()]))
    target = user_cache_path("escape") / "stand-ins" / f"{name}-{key.hexdigest()[:16]}.so"
    if not target.is_file():
        _compile(compiler, name, {f"{name}.c": code, "stand_in.h": header}, target)
    return target


def _compiler() -> str:
    candidates = tuple(filter(None, (os.environ.get("CC", ""), *_COMPILERS)))
    for name in candidates:
        if (path := shutil.which(name)) is not None:
            return path
    raise StandInUnavailable(
        f"no C compiler found (tried {', '.join(candidates)}); install one "
        "(Debian: apt install gcc libc6-dev) or name it in the environment variable CC"
    )


def _compile(compiler: str, name: str, sources: dict[str, bytes], target: Path) -> None:
    """Compile in a temporary folder and move the result, so that no incomplete library is ever loaded."""
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=target.parent) as folder:
            for file, text in sources.items():
                (Path(folder) / file).write_bytes(text)
            command = [compiler, *_FLAGS, f"{name}.c", "-o", target.name, *_LIBS]
            done = subprocess.run(
                command, cwd=folder, capture_output=True, text=True, check=False, timeout=_COMPILE_S
            )
            if done.returncode != 0:
                raise StandInUnavailable(
                    f"{compiler} did not compile the stand-in of {name}; is its C library installed "
                    f"(Debian: libc6-dev)?\n{done.stderr.strip()}"
                )
            os.replace(Path(folder) / target.name, target)
    except subprocess.TimeoutExpired as error:
        raise StandInUnavailable(f"{compiler} did not compile the stand-in of {name}: {error}") from error
    except OSError as error:
        raise StandInUnavailable(
            f"the stand-in of {name} was not compiled: {error}; is {target.parent} writable? "
            "XDG_CACHE_HOME chooses another place"
        ) from error


class StandIn:
    """A stand-in loaded in this process; its state is global to the process.

    ``path`` is the shared library, to be given to a driver; ``library`` is it as loaded by ctypes. Raises
    :class:`StandInUnavailable` if it cannot be compiled on this machine.
    """

    def __init__(self, name: str) -> None:
        self.path: Path = build_library(name)
        self.library = ctypes.CDLL(str(self.path))
        self._text = self.library.escape_stand_in_text
        self._text.argtypes = [ctypes.c_int, ctypes.c_char_p, ctypes.c_size_t]
        self._text.restype = ctypes.c_size_t
        self.library.escape_stand_in_calls.restype = ctypes.c_long

    def clear(self, *, record: bool = True) -> Self:
        """Restore the initial state; with ``record``, log every call from now on."""
        self.library.escape_stand_in_clear()
        self.library.escape_stand_in_record(int(record))
        return self

    def script(self, text: str) -> Self:
        """Add rules of faults, one per line or separated by semicolons; syntax in ``stand_in.h``."""
        line = self.library.escape_stand_in_script(text.encode())
        if line:
            wrong = text.replace(";", "\n").split("\n")[line - 1].strip()
            raise ValueError(f"rule {line} of the script is invalid: {wrong!r}")
        return self

    @property
    def calls(self) -> list[str]:
        """Calls since :meth:`clear`, one line each; violations are among them after ``'! '``."""
        return self._lines(0)

    @property
    def violations(self) -> list[str]:
        """Uses by the caller that the real library leaves undefined."""
        return self._lines(1)

    @property
    def n_calls(self) -> int:
        """Number of calls, recorded or not."""
        return int(self.library.escape_stand_in_calls())

    def names(self) -> list[str]:
        """Names of the functions called, in order, without violations."""
        return [line.partition(" ")[0] for line in self.calls if not line.startswith("! ")]

    def shape(self, n_act: int) -> NDArray[np.float64]:
        """Present shape ``(n_act,)`` of a mirror, fractions of full stroke."""
        out = np.zeros(n_act)
        self.library.escape_stand_in_shape(out.ctypes.data_as(ctypes.c_void_p), n_act)
        return out

    def _lines(self, which: int) -> list[str]:
        length = self._text(which, None, 0)
        buffer = ctypes.create_string_buffer(length + 1)
        self._text(which, buffer, length + 1)
        return buffer.value.decode(errors="replace").splitlines()
