"""Numbers of frames of the paper's runs; importing them loads no numerical library."""

from __future__ import annotations

#: By case, and by keyword of its procedure; a share of them shortens the case.
FRAMES = {
    # 20 seconds and 3 minutes at 500 Hz.
    "table1": {"short": 10_000, "long": 100_000},
    "shwfs": {"frames": 10_000, "loop_frames": 30_000},
    "pywfs": {"frames": 100_000, "closed_frames": 20_000, "loop_frames": 20_000},
    # Two minutes at 500 Hz: "a few minutes of sky-time" in the paper.
    "maps": {"frames": 60_000, "loop_frames": 10_000},
    # SHORT is close to the fewest frames of a matrix with a share of 0.1; LONG is a calibration on the
    # telescope (``calibration.frames``).
    "revolt": {"short": 2500, "long": 10_000},
}
#: Frames of a loop of the case "revolt", several times longer than the turbulence is correlated. No share
#: shortens them: the loops are as short as they can be.
PAIRED_LOOP_FRAMES = 600
#: Seeds from which the intervals of that case are computed.
SEEDS = 5
