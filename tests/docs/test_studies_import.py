"""The scripts of the studies find what they import."""

from __future__ import annotations

import pytest
from study_scripts import STUDIES

SCRIPTS = sorted(str(path.relative_to(STUDIES)) for path in STUDIES.glob("*/*.py"))


@pytest.mark.parametrize("script", SCRIPTS)
def test_a_study_can_be_imported(script, import_study):
    import_study(script)


def test_every_study_is_in_the_list():
    """One row per command; a module that only helps another script of its folder is none."""
    listed = (STUDIES / "README.md").read_text(encoding="utf-8")
    commands = {script for script in SCRIPTS if "__main__" in (STUDIES / script).read_text(encoding="utf-8")}
    assert commands
    assert all(f"`{script}`" in listed for script in commands)
