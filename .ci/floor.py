"""Print the oldest release of every dependency that pyproject.toml allows, as constraints for pip.

Of a requirement such as ``numpy>=2.0`` the newest patch of that release: first ones may have been withdrawn.
"""

import re
import tomllib
from pathlib import Path

project = tomllib.loads(Path(__file__).parents[1].joinpath("pyproject.toml").read_text("utf-8"))["project"]
groups = [project["dependencies"], *project["optional-dependencies"].values()]
for requirement in sorted({requirement for group in groups for requirement in group}):
    found = re.fullmatch(r"([A-Za-z0-9_.-]+)(?:\[[a-z,]+\])?>=([0-9.]+).*", requirement)
    if found:
        print(f"{found[1]}=={found[2]}{'' if found[2].count('.') > 1 else '.*'}")
