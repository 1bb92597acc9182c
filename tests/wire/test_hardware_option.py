"""``pytest --hardware``: with stand-ins in place of hardware."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from driver_bench import fresh

from escape_hw.config.loader import load_system

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def bench_file(tmp_path: Path) -> Path:
    libraries = {"dm": "asdk", "wfs": "m3api"}
    path = tmp_path / "bench.toml"
    chosen = [f'devices.{key}.options.library="{fresh(name).path}"' for key, name in libraries.items()]
    path.write_text(load_system("razor-shwfs", mode="hardware", overrides=chosen).to_toml())
    return path


def run(*words: object) -> subprocess.CompletedProcess[str]:
    command = [
        sys.executable,
        "-m",
        "pytest",
        "-p",
        "no:cacheprovider",
        "-p",
        "no:xdist",
        "-v",
        *map(str, words),
    ]
    inherited = {key: value for key, value in os.environ.items() if not key.startswith("PYTEST")}
    return subprocess.run(
        command, cwd=ROOT, capture_output=True, text=True, timeout=240, env=inherited, check=False
    )


@pytest.mark.slow
def test_only_devices_whose_serial_number_was_typed_are_touched(bench_file: Path) -> None:
    path = ROOT / "tests/contract/test_hardware.py"
    done = run(f"--hardware={bench_file}", "--serial", "SIM97", "--maxchange", 1, path)
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr
    assert "[dm-mirror_flattens] PASSED" in done.stdout
    assert "[wfs-" not in done.stdout, "its number was not typed"
    assert "obeys_its_limits" not in done.stdout, "the full range was not allowed"
    gentle = run(f"--hardware={bench_file}", "--serial", "SIM97", "--serial", "SIMWFS", path)
    assert gentle.returncode == 0, gentle.stdout[-3000:] + gentle.stderr
    assert "[wfs-camera_frames_are_not_overwritten] PASSED" in gentle.stdout
    assert "mirror_flattens" not in gentle.stdout, "without --maxchange nothing moves"


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ((), "type the serial number of every device"),
        (("--serial", "BAX999"), "has the serial number BAX999"),
        (("--serial", "SIM97", "--serial", "x"), "has the serial number x"),
    ],
)
def test_without_a_typed_serial_number_it_refuses(bench_file: Path, words, message) -> None:
    done = run(f"--hardware={bench_file}", *words)
    assert done.returncode == 4
    assert message in done.stderr
    assert "SIMWFS" not in done.stderr, "the number is to be read from the device, not from the refusal"


def test_a_serial_number_alone_is_a_mistake() -> None:
    assert "only with --hardware" in run("--serial", "SIM97").stderr


def test_a_wrong_file_is_refused() -> None:
    done = run("--hardware", "absent.toml", "--serial", "SIM97")
    assert done.returncode == 4
    assert "absent.toml" in done.stderr
