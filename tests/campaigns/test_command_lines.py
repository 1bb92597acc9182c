"""Hostile command lines: a promised exit code, a message, and never a traceback."""

from __future__ import annotations

import random
import signal
import socket
from collections.abc import Iterator
from pathlib import Path
from types import FrameType
from typing import Any

import pytest
import typer.main
from campaign_table import Campaign

from escape_hw.api.device import Device
from escape_hw.bench import Bench
from escape_hw.cli import main
from escape_hw.cli.app import app
from escape_hw.errors import DeviceLost

pytestmark = [pytest.mark.campaign, pytest.mark.timeout(3000, method="thread")]

SEED, NUMBER = 604, 400
#: Longest run of a command that opens nothing, seconds; generous, for busy computers.
LONGEST_S = 60
NOTHING_OPENS = "the campaign opens nothing"
#: Commands that change the computer, or compute for minutes without a device.
EXCLUDED = {("udev", "install"), ("with-stand-ins",), ("reproduce", "sky-time")}

HOSTILE = (
    "", " ", "-", "--", "---", "-h", "nan", "inf", "-inf", "-1", "0", "-0.0", "1e308", "1e309", "1e-320",
    "9" * 5000, "-" + "9" * 400, "0x10", "1_000", "٣", "½", "true", "null", "None", "[]", "{}", "[" * 5000,
    "{a=" * 900, "x" * 5000, "/".join(["y" * 200] * 25), "../" * 60, "~nobody-here/x", "$HOME", "`id`",
    "a\nb", "a\rb", "\x1b[31mred\x1b[0m", "\x07", "\udcff\udcfe", "\u202eevil", "😀", "%s%n", "{0}", "[bold]",
    "[/]", "; ls", "<script>alert(1)</script>", "=", "==", "a=b=c", ".=1", "loop.gain=", "loop.=1",
    "loop.gain=nan",
    "devices.wfs.region=[0,0,1,1]", "devices.wfs.region=[1e9,0,8,8]", "system.name=../../x", "system.seed=-1",
    "basis.n_modes=0", "calibration.frames=1e99", "twin.wfs.photons_per_frame=-1",
    "devices.dm.limits.disabled=[0,0]", "atmosphere=1", "schema=99", "tcp://", "tcp://:0", "tcp://[::1]:99999",
    "0.0.0.0", "256.1.1.1", "65536", "/dev/null", "/dev/full", "/dev/zero", "/proc/self/mem", "/", ".", "..",
)  # fmt: skip
#: Values that many options accept.
PLAUSIBLE = (
    "razor-shwfs", "razor-pywfs", "maps-nir", "SMALL", "IM", "1", "3", "0.5", "100", "escape", "docrime",
    "push-pull", "e727", "asm", "dm", "wfs", "loop.gain=0.4", "system.seed=3",
)  # fmt: skip
FILES = ("IM", "SMALL", "CUT", "EMPTY", "FOLDER", "LINK", "BINARY", "missing.fits")


class TookTooLong(BaseException):
    """The command did not end."""


@pytest.fixture
def nothing_opens(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """No device, network, window, server or emulator; files in a temporary folder only."""

    def refuse(*_: object, **__: object) -> Any:
        raise DeviceLost("campaign", NOTHING_OPENS)

    def unreachable(*_: object, **__: object) -> Any:
        raise OSError("no network in the campaign")

    monkeypatch.setattr(Device, "open", refuse)
    monkeypatch.setattr(Bench, "open", refuse)
    monkeypatch.setattr("escape_hw.server.frontend.supervisor.FrontEndSupervisor.__enter__", refuse)
    monkeypatch.setattr("escape_hw.cli.devices.emulate._serve", refuse)
    monkeypatch.setattr("escape_hw.cli.system.perf.run_benchmarks", refuse)
    monkeypatch.setattr("escape_hw.config.registry.window_runner", lambda: lambda *_: 0)
    monkeypatch.setattr(socket, "create_connection", unreachable)
    monkeypatch.setattr(socket, "getaddrinfo", unreachable)
    for name in ("HOME", "XDG_DATA_HOME", "XDG_CONFIG_HOME", "XDG_CACHE_HOME", "XDG_RUNTIME_DIR"):
        folder = tmp_path / name
        folder.mkdir(mode=0o700)
        monkeypatch.setenv(name, str(folder))
    work = tmp_path / "work"
    work.mkdir()
    monkeypatch.chdir(work)


@pytest.fixture
def files(tmp_path: Path, im: Path, system: Path) -> dict[str, str]:
    """Files of every kind, by the words that stand for them."""
    folder = tmp_path / "files"
    folder.mkdir()
    (folder / "cut.fits").write_bytes(im.read_bytes()[:4000])
    (folder / "empty.fits").touch()
    (folder / "folder.fits").mkdir()
    (folder / "link.fits").symlink_to("link.fits")
    (folder / "binary.toml").write_bytes(random.Random(1).randbytes(3000))
    names = {"CUT": "cut", "EMPTY": "empty", "FOLDER": "folder", "LINK": "link"}
    made = {word: str(folder / f"{name}.fits") for word, name in names.items()}
    return {**made, "BINARY": str(folder / "binary.toml"), "IM": str(im), "SMALL": str(system)}


def commands(group: Any, path: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Every command with the words that call it."""
    for name, command in group.commands.items():
        if hasattr(command, "commands"):
            yield from commands(command, (*path, name))
        elif (*path, name) not in EXCLUDED:
            yield (*path, name), command


def value(parameter: Any, rng: random.Random) -> str:
    """A value, often of the right kind."""
    kind = rng.random()
    if kind < 0.45:
        return rng.choice(HOSTILE)
    if kind < 0.6:
        return rng.choice(PLAUSIBLE)
    if "|" in (parameter.metavar or ""):
        return rng.choice(parameter.metavar.split("|"))
    if parameter.name == "system":
        return rng.choice(("SMALL", "razor-shwfs", "maps-nir"))
    if "Path" in str(parameter.type_descriptor):
        return rng.choice(FILES)
    return rng.choice(("1", "0.5", "7", "2e3", *FILES))


def line(path: tuple[str, ...], command: Any, rng: random.Random) -> list[str]:
    """One command line."""
    words = [*path]
    for parameter in command.params:
        if parameter.param_type_name == "argument":
            n = 1 if parameter.nargs == 1 else rng.randrange(4)
            words += [value(parameter, rng) for _ in range(n)] if rng.random() < 0.9 else []
        elif rng.random() < 0.2 and parameter.name != "help":
            words.append(rng.choice(parameter.opts))
            words += [] if parameter.is_flag else [value(parameter, rng)]
    if rng.random() < 0.15:
        words.insert(rng.randrange(len(words) + 1), rng.choice(HOSTILE))
    if rng.random() < 0.3:
        words.append("--json")
    return words


def test_hostile_command_lines(
    campaign: Campaign, nothing_opens: None, files: dict[str, str], capsys: pytest.CaptureFixture[str]
) -> None:
    def stop(number: int, frame: FrameType | None) -> None:
        raise TookTooLong

    known = list(commands(typer.main.get_command(app)))
    assert len(known) > 30
    rng = random.Random(SEED)
    before = signal.signal(signal.SIGALRM, stop)
    try:
        for _ in range(NUMBER):
            words = [files.get(word, word) for word in line(*rng.choice(known), rng)]
            signal.alarm(LONGEST_S)
            try:
                outcome = run(words, capsys)
            except TookTooLong:
                outcome = f"took more than {LONGEST_S} s"
            except BaseException as error:
                outcome = f"{type(error).__name__}: {str(error)[:200]}"
            signal.alarm(0)
            if outcome.startswith("exit code "):
                campaign.count(outcome)
            else:
                campaign.fail(f"{[word[:80] for word in words]}: {outcome}")
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)
    campaign.end("hostile command lines, in one process")


def run(words: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    """Run a command; the outcome."""
    capsys.readouterr()
    with pytest.raises(SystemExit) as ended:
        main(words)
    out, err = capsys.readouterr()
    code = ended.value.code or 0
    if "Traceback" in out + err or "defect of ESCAPE" in out + err:
        return f"traceback, exit code {code}: {err[-600:]}"
    if code not in (0, 1, 2) and not (code == 3 and NOTHING_OPENS in err):
        return f"unexpected end with code {code}: {err[-600:]}"
    if code == 2 and not err.strip():
        return "refused without a message"
    return f"exit code {code}"
