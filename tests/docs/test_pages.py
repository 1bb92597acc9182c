"""The commands and code of the tutorials and how-to pages run, in their order."""

from __future__ import annotations

import json
import sys
import tomllib
from pathlib import Path

import pytest
from pages import EVERY, ROOT, Block, Reader, blocks_of, call, spelled_right
from quoted import differences

DOCS = ROOT / "docs"
#: Pages whose blocks belong together and are run whole; of the others, commands are parsed.
RUN = sorted(
    [
        *DOCS.glob("tutorial/*.md"), *DOCS.glob("how-to/*.md"), DOCS / "devices" / "add-a-driver.md",
        DOCS / "reference" / "products.md",
    ]
)  # fmt: skip


def name_of(page: Path) -> str:
    return str(page.relative_to(DOCS))


def has_slow_blocks(page: Path) -> bool:
    """Whether a page has blocks that :func:`test_a_page_can_be_followed` leaves out."""
    return any("slow" in block.marks for block in blocks_of(page))


def run_block(block: Block, reader: Reader) -> str:
    """Run a block; what it printed."""
    printed = ""
    if block.language == "python":
        done = call([sys.executable, "-c", block.text], reader.folder)
        assert done.returncode == 0, done.stderr
        printed = done.stdout
    elif block.language == "sh":
        for line in block.commands():
            done = reader.escape(line)
            # Whether this computer can drive real devices is not for a test to say.
            allowed = (0, 1) if line.startswith("escape doctor") else (0,)
            assert done.returncode in allowed, f"{line}: {done.stderr}"
            printed += done.stdout
    return printed


@pytest.mark.parametrize("page", RUN, ids=name_of)
@pytest.mark.slow
def test_a_page_can_be_followed(page: Path, tmp_path: Path, tmp_path_factory: pytest.TempPathFactory) -> None:
    reader, printed = Reader(tmp_path, tmp_path_factory), ""
    for block in blocks_of(page):
        if "printed" in block.marks:
            assert differences(block.text, printed) == []
        elif "slow" not in block.marks:
            printed = run_block(block, reader)


def test_a_quotation_is_compared_with_the_output() -> None:
    printed = "delay: 2.16 frames\n Shift X [%]  −16.036 ± 0.050   −0.7   −16\n"
    assert differences("delay: 2.17 frames\n Shift X [%] −16.05 ± 0.051  −0.9  −16", printed) == []
    assert differences("rotation 0.0019 0.012", "rotation 0.0020 0.013") == []
    assert differences("converged in 16 iterations", "converged in 15 iterations") == []
    assert len(differences("converged in 16 iterations", "converged in 13 iterations")) == 1
    assert len(differences("rotation 0.0019 15", "rotation 0.0022 15")) == 1
    assert len(differences("rotation 0.0019 15", "rotation 0.0019 16")) == 1
    assert len(differences("delay: 3.16 frames\nlag: 2.16 frames", printed)) == 2
    assert len(differences("Shift X [%] −16.1 ± 0.050  −0.7  −16", printed)) == 1
    assert len(differences("Shift X [%] −16.036 ± 0.090  −0.7  −16", printed)) == 1


@pytest.mark.timeout(3600)
@pytest.mark.parametrize(
    "page",
    [
        pytest.param(
            page, marks=pytest.mark.slow if name_of(page) == "tutorial/telescope.md" else pytest.mark.campaign
        )
        for page in RUN
        if has_slow_blocks(page)
    ],
    ids=name_of,
)
def test_a_page_can_be_followed_to_its_end(
    page: Path, tmp_path: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    reader = Reader(tmp_path, tmp_path_factory)
    for block in blocks_of(page):
        run_block(block, reader)


@pytest.mark.parametrize("page", EVERY, ids=name_of)
def test_blocks_are_well_formed(page: Path) -> None:
    for block in blocks_of(page):
        for line in block.commands() if block.language == "sh" else ():
            spelled_right(line.replace("\\", ""))
        if block.language == "toml":
            tomllib.loads(block.text)
        if block.language == "json":
            json.loads(block.text)
        if block.language == "python":
            compile(block.text, str(page), "exec")


@pytest.mark.slow
def test_the_site_is_built_without_a_warning(tmp_path: Path) -> None:
    pytest.importorskip("sphinx", reason="pip install 'escape-hw[docs]'")
    words = [sys.executable, "-m", "sphinx", "-W", "--keep-going", "-q", "-b", "html"]
    done = call([*words, "-d", str(tmp_path / "trees"), str(DOCS), str(tmp_path / "site")], ROOT)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "site" / "reference" / "_generated" / "configuration.html").is_file()
    text = (tmp_path / "site" / "reference" / "_generated" / "command-line.html").read_text(encoding="utf-8")
    assert "calibrate" in text
