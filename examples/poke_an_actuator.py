"""Poke one actuator and measure it with the wavefront sensor.

Run it with: python examples/poke_an_actuator.py
"""

import numpy as np

import escape_hw

ACTUATOR = 48  # at the centre of the mirror
POKE = 0.1  # fraction of full stroke

with escape_hw.open_system("razor-shwfs") as bench:
    bench.screen.set(inserted=False)  # no turbulence
    grid = bench.find_sensor(frames=20).grid
    slopes_of = bench.slopes_of(grid)

    def mean_slopes() -> np.ndarray:
        """Mean slopes of a few frames, after the mirror has settled."""
        for _ in range(3):
            bench.wfs.next_frame()
        return np.mean([slopes_of(bench.wfs.next_frame().data) for _ in range(5)], axis=0)

    before = mean_slopes()
    command = bench.dm.shape  # a copy of the present shape
    command[ACTUATOR] += POKE
    report = bench.dm.send(command)  # every command passes the guard
    print(f"unchanged by the guard: {report.guard.is_unchanged}")
    after = mean_slopes()

    # The guard limits a command that is too large and rejects one that is not finite.
    command[ACTUATOR] = 5.0
    report = bench.dm.send(command)
    print(f"requested 5.0, sent {report.sent[ACTUATOR]}")
    try:
        command[ACTUATOR] = np.nan
        bench.dm.send(command)
    except escape_hw.errors.CommandRejected as refusal:
        print(f"rejected: {refusal}")

# At the end of the 'with' block the mirror is flattened and every device is closed.
x, y = (after - before).reshape(2, -1)
strength = np.zeros(grid.valid.shape)
strength[grid.valid] = np.hypot(x, y)
print(f"largest slope: {strength.max():.2f} pixels")
shades = " .:-=+*#%@"
for row in strength / strength.max() * (len(shades) - 1):
    print("".join(2 * shades[round(value)] for value in row).rstrip())
