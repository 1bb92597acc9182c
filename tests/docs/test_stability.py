"""What README, guides and examples use is public by the page on API stability."""

from __future__ import annotations

import ast
import importlib
import inspect
import re
from collections.abc import Iterator

import pytest
from pages import EVERY, ROOT, blocks_of

import escape_hw
from escape_hw.config.loader import load_system
from escape_sim.devices.twins import shared_bench

PAGE = (ROOT / "docs" / "reference" / "stability.md").read_text(encoding="utf-8")
GUIDE = ROOT / "docs" / "devices" / "add-a-driver.md"
#: Name in another module -> its members that stay.
LISTED = {
    name: set(re.findall(r"`(\w+)`", members))
    for name, members in re.findall(r"^\| `(escape_\w+\.[\w.]+)`[^|]*\|([^|]*)\|$", PAGE, re.MULTILINE)
}


def sources() -> list[str]:
    pages = [
        block.text
        for page in EVERY
        # That page is about the source of the package.
        if page.name != "add-a-procedure.md" and "decisions" not in page.parts
        for block in blocks_of(page)
    ]
    return [*pages, *(script.read_text(encoding="utf-8") for script in (ROOT / "examples").glob("*.py"))]


def imported() -> Iterator[tuple[str, str]]:
    """Modules of ours and the names that are imported from them."""
    for module, names in re.findall(
        r"^ *from (escape_[\w.]+) import ([\w, ]+)$", "\n".join(sources()), re.MULTILINE
    ):
        for name in names.split(", "):
            yield module, name


def load(name: str) -> object:
    module, _, member = name.rpartition(".")
    return getattr(importlib.import_module(module), member)


def test_what_is_imported_is_public() -> None:
    found = set(imported())
    assert ("escape_sim.devices.twins", "shared_bench") in found
    for module, name in found:
        exported = module.startswith("escape_drivers.") and module.count(".") == 1
        assert (
            module == "escape_hw.errors"
            or (exported and name in importlib.import_module(module).__all__)
            or f"{module}.{name}" in LISTED
        ), f"{module}.{name}"


@pytest.mark.parametrize("name", LISTED)
def test_what_is_listed_exists(name: str) -> None:
    thing = load(name)
    bench = shared_bench(load_system("razor-shwfs"), {}) if name.endswith("SimBench") else None
    if bench is not None:
        assert isinstance(bench, thing)
    for member in LISTED[name]:
        if name.endswith("StandIn"):
            # Its path is that of the compiled library.
            assert hasattr(thing, member) or member == "path"
        else:
            owner = bench or thing
            assert (
                hasattr(owner, member)
                or hasattr(getattr(bench, "wfs_detector", None), member)
                or f"self.{member}" in inspect.getsource(thing)
            ), member


def test_members_of_the_bench_that_the_guide_uses_are_listed() -> None:
    used = set()
    for block in blocks_of(GUIDE):
        if block.language == "python":
            for node in ast.walk(ast.parse(block.text)):
                if isinstance(node, ast.Attribute) and ast.unparse(node.value) in ("bench", "self._bench"):
                    used.add(node.attr)
    # An opened system is called bench too.
    used -= {"calibrate", "close_loop", "wfs"}
    assert used <= LISTED["escape_sim.devices.bench.SimBench"]
    assert "drive" in used


def test_limits_of_a_mirror_opened_alone_are_stated() -> None:
    page = (ROOT / "docs" / "safety.md").read_text(encoding="utf-8")
    stated = dict(re.findall(r"^\| `(\w+)` \|.*\| ([\d.]+) \|$", page, re.MULTILINE))
    limits = load("escape_hw.safety.limits.CAUTIOUS_LIMITS")
    assert isinstance(limits, escape_hw.MirrorLimits)
    assert len(stated) == 5
    assert {name: float(value) for name, value in stated.items()} == {
        name: getattr(limits, name) for name in stated
    }
