"""Where slopes and actuators of a recorded run stood."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from escape_gui.replay.streams import main_calibration
from escape_hw.remote.state import Geometry
from escape_hw.server.views import outlines

if TYPE_CHECKING:
    from escape_hw.report.content import RunContent


def geometry_of(run: RunContent) -> Geometry:
    """The geometry of a run's main calibration; empty parts where the run tells nothing of them."""
    main = main_calibration(run)
    layout, places = run.layout, run.places_m
    seen: dict[str, object] = {}
    if main is not None:
        grid = main[1].grid
        seen = {
            "valid": _rows(grid.valid),
            "outlines_px": outlines(grid),
            "n_modes": main[1].matrix.n_modes,
        }
    return Geometry.model_validate(
        {
            **seen,
            "layout": () if layout is None else _rows(layout),
            "places_m": () if places is None else tuple((float(x), float(y)) for x, y in places),
        }
    )


def _rows(mask: NDArray[np.bool_]) -> tuple[str, ...]:
    return tuple("".join("1" if spot else "0" for spot in row) for row in mask)
