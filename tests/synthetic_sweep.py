"""A sweep of synthetic loops with known differences."""

from __future__ import annotations

import numpy as np

from escape_hw.runtime.sweep.design import EXPLORE, FINAL, Design, MatrixVariant, Slot, Sweep
from escape_hw.runtime.sweep.run import SweepRun
from escape_hw.runtime.sweep.search_space import parse_parameter
from escape_hw.runtime.sweep.study import TrialRecord

SWEPT = Sweep(
    "",
    (MatrixVariant("push-pull", False, __file__, ""), MatrixVariant("ESCAPE", False, __file__, "")),  # type: ignore[arg-type]
    tuple(parse_parameter(text) for text in ("gain=0.1:1", "leak=0.01", "dropped_modes=0:9")),
    Design(80),
    400,
    1,
)


def synthetic_run(difference: float) -> SweepRun:
    """Loops with a maximum in the gain, common turbulence, and a difference between the variants."""
    rng, records = np.random.default_rng(1), []
    for stage, count in ((EXPLORE, 40), (FINAL, 24)):
        for index in range(count):
            turbulence = rng.normal(0, 0.03)
            gain = float(rng.uniform(0.1, 1.0)) if stage == EXPLORE else 0.5
            for variant, offset in (("push-pull", 0.0), ("ESCAPE", difference)):
                merit = 0.5 + turbulence - (gain - 0.5) ** 2 + offset + rng.normal(0, 0.004)
                ways = {way: {"value": merit, "sigma": 0.01} for way in ("peak", "otf", "encircled")}
                outcome = {"strehl": ways, "stable": True, "diverged": False}
                values = {"gain": gain, "leak": 0.01, "dropped_modes": 3}
                records.append(TrialRecord(Slot(stage, variant, index), values, outcome, merit))
    return SweepRun(records)
