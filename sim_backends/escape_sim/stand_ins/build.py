"""Compiles the stand-ins with the system's C compiler, once, into the user's cache."""

from __future__ import annotations

import hashlib
import os
import shutil
import subprocess
import tempfile
from importlib.resources import files
from pathlib import Path

from platformdirs import user_cache_path

from escape_hw.errors import EscapeError

#: What can be built: the vendor library that each stands for.
LIBRARIES = {
    "asdk": "ALPAO's libasdk",
    "m3api": "XIMEA's libm3api",
    "aravis": "libaravis-0.8",
}
_FLAGS = ("-std=gnu11", "-shared", "-fPIC", "-O2", "-Wall", "-Wextra", "-fvisibility=hidden")
_LIBS = ("-lm", "-lpthread")
#: Names that a C compiler goes by; ``CC`` in the environment comes first.
_COMPILERS = ("cc", "gcc", "clang")
_COMPILE_S = 120


class StandInUnavailable(EscapeError):
    """A stand-in cannot be compiled on this machine."""

    exit_code = 2


def build(name: str) -> Path:
    """The shared library that stands in for a vendor's, compiled if it is not in the cache yet.

    Parameters
    ----------
    name
        One of :data:`LIBRARIES`.

    Returns
    -------
    Path
        In ``stand-ins`` below the user's cache folder; its name holds a checksum of its sources.

    Raises
    ------
    StandInUnavailable
        No C compiler, or it failed.
    ValueError
        There is no such stand-in.
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
    wanted = (os.environ.get("CC", ""), *_COMPILERS)
    for name in wanted:
        found = shutil.which(name) if name else None
        if found is not None:
            return found
    raise StandInUnavailable(
        f"no C compiler found (tried {', '.join(filter(None, wanted))}); install one "
        "(Debian: apt install gcc libc6-dev) or name it in the environment variable CC"
    )


def _compile(compiler: str, name: str, sources: dict[str, bytes], target: Path) -> None:
    """Compile beside the target and move it there, so that nobody ever loads half a library."""
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        _compile_in_place(compiler, name, sources, target)
    except OSError as error:
        raise StandInUnavailable(
            f"the stand-in of {name} was not compiled: {error}; is {target.parent} writable? "
            "XDG_CACHE_HOME chooses another place"
        ) from error


def _compile_in_place(compiler: str, name: str, sources: dict[str, bytes], target: Path) -> None:
    with tempfile.TemporaryDirectory(dir=target.parent) as folder:
        for file, text in sources.items():
            (Path(folder) / file).write_bytes(text)
        out = Path(folder) / target.name
        command = [compiler, *_FLAGS, f"{name}.c", "-o", str(out), *_LIBS]
        try:
            done = subprocess.run(
                command, cwd=folder, capture_output=True, text=True, check=False, timeout=_COMPILE_S
            )
        except subprocess.TimeoutExpired as error:
            raise StandInUnavailable(f"{compiler} did not compile the stand-in of {name}: {error}") from error
        if done.returncode != 0:
            raise StandInUnavailable(
                f"{compiler} did not compile the stand-in of {name}; is its C library installed "
                f"(Debian: libc6-dev)?\n{done.stderr.strip()}"
            )
        os.replace(out, target)
