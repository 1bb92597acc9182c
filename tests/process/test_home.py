"""Home directories that cannot be read or written, or are no directories, for a user without privileges."""

from __future__ import annotations

import itertools
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from running import ESCAPE, NOBODY, words_of_other_user


@pytest.fixture(scope="module")
def homes(tmp_path_factory) -> dict[str, str]:
    unreadable = tmp_path_factory.mktemp("home") / "secret"
    unreadable.mkdir(mode=0o000)
    return {"unreadable": str(unreadable), "missing": "/nonexistent", "no folder": "/dev/null"}


@pytest.fixture(scope="module")
def other_user() -> tuple[str, ...]:
    """Words that run a command without privileges; skips where that user cannot read the package."""
    words = words_of_other_user()
    if words is None:
        pytest.skip(f"needs setpriv, and an installed package that user {NOBODY} can read")
    return words


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="users of Linux")
@pytest.mark.parametrize(
    ("words", "home"),
    [
        *itertools.product(
            ["systems", "show IM", "doctor", "keys make", "keys list", "calibrate"],
            ["unreadable", "missing", "no folder"],
        ),
        # Of the other homes, "show IM" shows that the libraries' caches are elsewhere.
        ("docrime", "unreadable"),
    ],
)
@pytest.mark.slow
def test_a_home_that_cannot_be_used(homes, other_user, im, system, tmp_path, words, home):
    command = {
        "show IM": ("show", "im.fits"),
        "calibrate": ("calibrate", "small.toml", "--method", "docrime", "--frames", 100),
        "docrime": ("calibrate", "small.toml", "--method", "docrime", "--frames", 100, "--out", "run"),
    }.get(words, tuple(words.split()))
    place = Path("/tmp" if os.getuid() == 0 else tmp_path) / f"escape-home-test-{os.getpid()}"
    place.mkdir(exist_ok=True)
    try:
        place.chmod(0o777)
        shutil.copy(im, place / "im.fits")
        shutil.copy(system, place / "small.toml")
        kept = {name: value for name, value in os.environ.items() if not name.startswith("XDG_")}
        done = subprocess.run(
            [*other_user, *ESCAPE, *map(str, command)],
            capture_output=True, text=True, check=False, timeout=120, cwd=place,
            env={**kept, "HOME": homes[home]},
        )  # fmt: skip
    finally:
        shutil.rmtree(place)
    assert "Traceback" not in done.stderr
    assert "defect of ESCAPE" not in done.stderr
    works = words in ("systems", "show IM", "docrime")
    # Keys of nobody: an unreadable folder is an error, a missing one holds none.
    expected = {"doctor": (1, 2), "keys list": (0, 2)}.get(words, (0,) if works else (2,))
    assert done.returncode in expected, done.stderr
