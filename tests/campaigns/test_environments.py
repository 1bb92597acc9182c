"""Commands in unusual environments: a promised exit code, and never a traceback."""

from __future__ import annotations

import os
import random
import resource
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest
from campaign_table import Campaign
from running import ESCAPE, words_of_other_user

pytestmark = [
    pytest.mark.campaign,
    pytest.mark.timeout(3000),
    pytest.mark.skipif(not sys.platform.startswith("linux"), reason="users and devices of Linux"),
]

SEED, NUMBER = 9, 50
#: Fields of an environment, by the words for them.
LOCALES: dict[str, dict[str, str]] = {
    "": {},
    "C": {"LANG": "C", "LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"},
    "latin 1": {"LANG": "en_US.ISO-8859-1", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"},
    "ASCII": {"PYTHONIOENCODING": "ascii"},
    "UTF-16": {"PYTHONIOENCODING": "utf-16"},
    "unknown": {"LC_ALL": "xx_XX.nothing"},
    "TERM": {"TERM": "nothing", "COLUMNS": "-1", "LINES": "x"},
    "narrow": {"COLUMNS": "1"},
    "colour": {"FORCE_COLOR": "1", "NO_COLOR": "1"},
}
HOMES = ("usual", "missing", "unreadable", "a file", "empty", "relative")
STREAMS = ("usual", "usual", "full", "no reader", "closed")
#: Limits: descriptors, bytes of a file.
LIMITS = ((None, None), (None, None), (30, None), (64, None), (None, 0), (None, 2000))


def commands(im: Path, system: Path) -> tuple[tuple[object, ...], ...]:
    calibrate = ("calibrate", system, "--method", "docrime", "--frames", 100)
    return (
        ("systems",), ("systems", "--json"), ("--help",), ("show", im), ("show", im, "--json"), ("doctor",),
        ("config", "check", system), ("config", "schema"), ("keys", "list"), ("keys", "make"), ("systms",),
        ("compare", im, im), calibrate, (*calibrate, "--out", "run", "--json"),
    )  # fmt: skip


@pytest.fixture
def place(im: Path, system: Path) -> Iterator[Path]:
    """A folder that everybody can use, with a product and a system."""
    folder = Path("/tmp") / f"escape-campaign-{os.getpid()}"
    folder.mkdir()
    try:
        folder.chmod(0o777)
        shutil.copy(im, folder / "im.fits")
        shutil.copy(system, folder / "small.toml")
        (folder / "secret").mkdir(mode=0o000)
        (folder / "file").touch()
        (folder / "home").mkdir()
        (folder / "home").chmod(0o777)
        yield folder
    finally:
        (folder / "secret").chmod(0o700)
        shutil.rmtree(folder)


def stream(kind: str, stack: ExitStack) -> int:
    """A descriptor for a standard stream."""
    if kind == "full":
        descriptor = os.open("/dev/full", os.O_WRONLY)
    elif kind == "no reader":
        reading, descriptor = os.pipe()
        os.close(reading)
    else:
        return subprocess.PIPE
    stack.callback(os.close, descriptor)
    return descriptor


def preparation(closed: list[int], descriptors: int | None, size: int | None) -> Callable[[], None]:
    """What the process does before it becomes the command."""

    def prepare() -> None:
        for number in closed:
            os.close(number)
        if descriptors is not None:
            resource.setrlimit(resource.RLIMIT_NOFILE, (descriptors, descriptors))
        if size is not None:
            signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
            resource.setrlimit(resource.RLIMIT_FSIZE, (size, size))

    return prepare


def words_for_mounting(target: str) -> tuple[str, ...]:
    """Words that start a command whose mounts nobody else sees; none where this computer allows no mounts."""
    if shutil.which("unshare") is None:
        return ()
    for more in ((), ("--map-root-user",)):
        words = ("unshare", "--mount", *more)
        probe = [*words, "sh", "-c", f"mount -t tmpfs -o size=16k tmpfs {target}"]
        if subprocess.run(probe, capture_output=True, check=False).returncode == 0:
            return words
    return ()


def verdict(done: subprocess.CompletedProcess[bytes], streams: dict[str, str]) -> str:
    """What is wrong with an end; empty if nothing is."""
    text = (done.stdout or b"") + (done.stderr or b"")
    if b"Traceback" in text or b"defect of ESCAPE" in text:
        return f"traceback: {text[-1500:].decode(errors='replace')}"
    if done.returncode not in (0, 1, 2, 3):
        return f"exit code {done.returncode}: {text[-500:].decode(errors='replace')}"
    if done.returncode and set(streams.values()) == {"usual"} and not text:
        return f"exit code {done.returncode} without a message"
    return ""


def test_environments(campaign: Campaign, place: Path) -> None:
    rng, another = random.Random(SEED), words_of_other_user() or ()
    tried = commands(place / "im.fits", place / "small.toml")
    homes = {
        "usual": str(place / "home"), "missing": str(place / "missing"), "unreadable": str(place / "secret"),
        "a file": str(place / "file"), "empty": "", "relative": "home",
    }  # fmt: skip
    kept = {name: value for name, value in os.environ.items() if not name.startswith(("XDG_", "PYTHONIO"))}
    for number in range(NUMBER):
        words, user = rng.choice(tried), another if rng.random() < 0.5 else ()
        locale, home, limits = rng.choice(sorted(LOCALES)), rng.choice(HOMES), rng.choice(LIMITS)
        streams = {name: rng.choice(STREAMS) for name in ("stdout", "stderr")}
        closed = [one for one, name in ((1, "stdout"), (2, "stderr")) if streams[name] == "closed"]
        work = place / str(number)
        work.mkdir()
        work.chmod(0o777)
        with ExitStack() as stack:
            ends = {name: stream(kind, stack) for name, kind in streams.items()}
            try:
                done = subprocess.run(
                    [*user, *ESCAPE, *map(str, words)], check=False, timeout=300, cwd=work, **ends,
                    stdin=subprocess.DEVNULL, preexec_fn=preparation(closed, *limits),
                    env={**kept, **LOCALES[locale], "HOME": homes[home]},
                )  # fmt: skip
                problem = verdict(done, streams)
            except subprocess.TimeoutExpired as error:
                problem = f"no end within {error.timeout} s"
        if problem:
            campaign.fail(f"{words[:2]} {locale=} {home=} {streams} {limits} user={user[1:2]}: {problem}")
        else:
            campaign.count(f"exit code {done.returncode}")
    campaign.end("commands with another locale, home, user, standard streams, limit of descriptors or files")


@pytest.mark.parametrize("folder", ["/dev/shm", "disk"])
def test_little_space(campaign: Campaign, place: Path, folder: str, system: Path) -> None:
    """A file system of a few kilobytes, for shared memory or for products."""
    target = "/dev/shm" if folder == "/dev/shm" else str(place / "home")
    mounts = words_for_mounting(target)
    if not mounts:
        pytest.skip("this computer allows no mounts, not even in a name space of its own")
    calibrate = ["calibrate", str(place / "small.toml"), "--method", "docrime", "--frames", "200"]
    for size in (4, 16, 64, 128, 256, 512):
        command = [*calibrate, "--out", f"{target}/run"]
        if folder == "/dev/shm":
            command = ["serve", str(place / "small.toml"), "--out", str(place / "runs")]
        mount = f'mount -t tmpfs -o size={size}k tmpfs {target} && exec timeout -s INT 20 "$@"'
        done = subprocess.run(
            [*mounts, "sh", "-c", mount, "sh", *ESCAPE, *command], capture_output=True, check=False,
            timeout=300, cwd=place, env={**os.environ, "HOME": str(place), "XDG_RUNTIME_DIR": str(place)},
        )  # fmt: skip
        problem = verdict(done, {"stdout": "usual", "stderr": "usual"})
        # 124: it was still serving when it was stopped.
        if problem and not (folder == "/dev/shm" and done.returncode in (124, 130)):
            campaign.fail(f"{size} kB: {problem}")
        else:
            campaign.count("works" if done.returncode in (0, 124, 130) else "refused")
    what = (
        "serve with little shared memory"
        if folder == "/dev/shm"
        else "calibrate on a disk that is nearly full"
    )
    campaign.end(what)
