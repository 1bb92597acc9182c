"""Memory of a window after eight hours of history."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

HERE = Path(__file__).parent
#: Limit of the process, of which the libraries take 210 to 255 MB by their version, and of its growth; MB.
LIMIT_MB, GROWTH_MB = 350, 80


@pytest.mark.campaign
@pytest.mark.timeout(1800)
def test_eight_hours_of_history_need_less_than_80_mb(tmp_path: Path) -> None:
    environment = {
        **os.environ, "QT_QPA_PLATFORM": "offscreen", "OPENBLAS_NUM_THREADS": "1",
        "PYTHONPATH": os.pathsep.join([str(HERE), str(HERE.parent), *sys.path]),
    }  # fmt: skip
    done = subprocess.run(
        [sys.executable, str(HERE / "eight_hours.py")],
        capture_output=True, text=True, check=False, cwd=tmp_path, env=environment, timeout=280,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    memory = json.loads(done.stdout.splitlines()[-1])
    print(memory)
    assert memory["states"] == 8 * 3600 * 5 + 1
    assert memory["peak_mb"] < LIMIT_MB
    assert memory["end_mb"] - memory["start_mb"] < GROWTH_MB
