"""Commands and code of the README and the documents run, and their links exist."""

from __future__ import annotations

import re
import shutil
import sys
import tomllib
from pathlib import Path

import pytest
from pages import EVERY, ROOT, Reader, call, escape, spelled_right

README = (ROOT / "README.md").read_text(encoding="utf-8")
TOUR = (ROOT / "docs" / "commands.md").read_text(encoding="utf-8")
#: Minutes each; that their words are right is checked all the same.
LONG = (
    "escape reproduce shwfs", "escape reproduce table1", "escape reproduce pywfs",
    "escape reproduce maps", "escape reproduce revolt", "escape reproduce sky-time", "escape report run",
    "escape calibrate razor-pywfs", "escape gains razor-pywfs", "escape sweep", "escape reproduce all",
)  # fmt: skip


def blocks(language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", README + TOUR, re.MULTILINE | re.DOTALL)


def shell_lines() -> list[str]:
    return [line.strip().removeprefix(".venv/bin/") for block in blocks("sh") for line in block.splitlines()]


def escape_lines() -> list[str]:
    return [line for line in shell_lines() if line.startswith("escape ")]


@pytest.mark.parametrize("number", range(len(blocks("python"))))
@pytest.mark.slow
def test_python_blocks_run(number: int, tmp_path: Path) -> None:
    if "StandIn(" in blocks("python")[number] and not any(map(shutil.which, ("cc", "gcc", "clang"))):
        pytest.skip("stand-ins need a C compiler")
    done = call([sys.executable, "-c", blocks("python")[number]], tmp_path)
    assert done.returncode == 0, done.stderr
    if "Strehl" in blocks("python")[number]:
        assert re.search(r"shift x: -1\d\.\d+ ± \d", done.stdout)
        assert re.search(r"Strehl ratio: 0\.\d+ ± 0\.\d+", done.stdout)


@pytest.mark.timeout(1500)
@pytest.mark.slow
def test_commands_run_in_the_order_they_stand(
    tmp_path: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    reader, ran, done_lines = Reader(tmp_path, tmp_path_factory), 0, set()
    for line in escape_lines():
        if not line.startswith(LONG):
            if line in done_lines:
                continue  # the README and the tour begin alike
            done_lines.add(line)
            done = reader.escape(line)
            assert done.returncode == 0, f"{line}: {done.stderr}"
            ran += 1
    assert ran >= 9
    assert (tmp_path / "first" / "report.html").is_file()
    assert (tmp_path / "closed" / "report.html").is_file()


def test_long_commands_are_spelled_right() -> None:
    long = [line for line in escape_lines() if line.startswith(LONG)]
    assert {line for line in LONG if any(found.startswith(line) for found in long)} == set(LONG)
    for line in long:
        spelled_right(line)


def test_make_targets_exist() -> None:
    targets = [line.split()[1] for line in shell_lines() if line.startswith("make ")]
    assert {"run", "test", "check", "perf"} <= set(targets)
    if shutil.which("make") is None:
        pytest.skip("make is not installed")
    for target in targets:
        # With a Python named, make does not start every one that it knows.
        python = f"PYTHON={sys.executable}"
        done = call(["make", "--dry-run", "--directory", str(ROOT), python, target], ROOT)
        assert done.returncode == 0, done.stderr


def test_other_shell_lines_are_the_install_steps() -> None:
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    others = [line for line in shell_lines() if line and not line.startswith(("make ", "escape "))]
    for line in others:
        steps = ("python3 -m venv", ". .venv/bin/activate", "pip install --editable", "pytest")
        assert line.startswith(steps), line
        for extra in re.findall(r"\[([a-z,]+)\]", line):
            assert set(extra.split(",")) <= set(extras)


def test_the_environment_is_activated_before_its_commands_are_called() -> None:
    lines = [line.strip() for block in blocks("sh") for line in block.splitlines()]
    assert lines.index(". .venv/bin/activate") < lines.index(escape_lines()[0])
    for page in (
        TOUR,
        *((ROOT / "docs/tutorial" / name).read_text() for name in ("bench.md", "operator.md")),
    ):
        assert 0 <= page.find("`. .venv/bin/activate`") < re.search(r"^(\$ )?escape ", page, re.M).start()


def test_mistakes_are_reported_as_shown(tmp_path: Path) -> None:
    shown = re.findall(r"^    bench\.toml:\d+  (.*)$", TOUR, re.MULTILINE)
    assert len(shown) == 2
    assert escape("escape config init my-bench --out bench.toml", tmp_path).returncode == 0
    file = tmp_path / "bench.toml"
    text, gains = re.subn(
        r"(?ms)(^\[loop\].*?)^gain = [^\n]*", r"\1gain = 3.0\nleek = 0.01", file.read_text(), count=1
    )
    assert gains == 1
    file.write_text(text)
    done = escape("escape config check bench.toml", tmp_path)
    assert done.returncode == 2
    told = re.findall(r"bench\.toml:\d+  (.*)$", done.stderr, re.MULTILINE)
    assert told == shown


@pytest.mark.parametrize(
    "document",
    ["README.md", "benchmarks/studies/README.md", *(str(page.relative_to(ROOT)) for page in EVERY)],
)
def test_links_lead_somewhere(document: str) -> None:
    path = ROOT / document
    text = path.read_text(encoding="utf-8")
    assert "@@" not in text
    for target in re.findall(r"\]\(([^)#]+)[^)]*\)", text):
        # Written from the code when the site is built, which another test does.
        if not target.startswith(("http://", "https://")) and "_generated/" not in target:
            assert (path.parent / target).exists(), f"{document} points at {target}"
