"""The table of the study of the MAPS matrix has the numbers of its file."""

from __future__ import annotations

import json
from pathlib import Path

STUDIES = Path(__file__).parents[2] / "docs" / "studies"
#: Columns of the file by the rows of the table.
ROWS = {
    "correlation, published and twin": "correlation published twin",
    "correlation, published and synthetic": "correlation published synthetic",
    "the same without responses far from the actuator": "correlation near synthetic",
    "correlation, twin and synthetic": "correlation twin synthetic",
    "published, part that the synthetic mode explains": "published: synthetic",
    "published, noise from pixel to pixel": "published: noise",
    "published, rest": "published: rest",
    "twin, part that the synthetic mode explains": "twin, DO-CRIME: synthetic",
    "twin, noise from pixel to pixel": "twin, DO-CRIME: noise",
    "twin, noise by its standard errors": "twin stated noise",
    "published, part within two pixels of the rim": "published: rim",
    "twin, part within two pixels of the rim": "twin, DO-CRIME: rim",
    "synthetic, part within two pixels of the rim": "synthetic: rim",
    "published, part in the upper left quarter": "published: upper left",
    "twin, part in the upper left quarter": "twin, DO-CRIME: upper left",
    "synthetic, part in the upper left quarter": "synthetic: upper left",
}


def test_the_table_has_the_numbers_of_the_file() -> None:
    page = (STUDIES / "maps-matrix.md").read_text(encoding="utf-8")
    document = json.loads((STUDIES / "maps-matrix" / "maps.json").read_text())
    table = [line.strip("| ").split(" | ") for line in page.splitlines() if line.startswith("| ")]
    quoted = {label: [float(cell) for cell in cells] for label, *cells in table[1:]}
    assert quoted.keys() == ROWS.keys()
    for label, name in ROWS.items():
        values = list(document["by group"][name].values())
        assert all(abs(a - b) < 0.0051 for a, b in zip(quoted[label], values, strict=True)), label
    assert f"{document['n_common']} pixels" in page
