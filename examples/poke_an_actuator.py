"""Push one actuator and look at it through the wavefront sensor.

Run it with: python examples/poke_an_actuator.py
"""

import numpy as np

import escape_hw

ACTUATOR = 48  # the one in the middle of the mirror
PUSH = 0.1  # fraction of full stroke

with escape_hw.open_system("razor-shwfs") as bench:
    bench.screen.set(inserted=False)  # no turbulence: one frame is enough to see a push
    grid = bench.find_sensor(frames=20).grid
    slopes_of = bench.slopes_of(grid)

    def look() -> np.ndarray:
        """Mean slopes of a few frames, once the mirror has settled."""
        for _ in range(3):
            bench.wfs.next_frame()
        return np.mean([slopes_of(bench.wfs.next_frame().data) for _ in range(5)], axis=0)

    before = look()
    command = bench.dm.shape  # a copy of what the mirror has now
    command[ACTUATOR] += PUSH
    report = bench.dm.send(command)  # every command passes the guard
    print(f"sent; untouched by the guard: {report.guard.is_unchanged}")
    after = look()

    # What the guard is for: far too much is made legal, nonsense is refused.
    command[ACTUATOR] = 5.0
    report = bench.dm.send(command)
    print(f"asked for 5.0, the mirror got {report.sent[ACTUATOR]}")
    try:
        command[ACTUATOR] = np.nan
        bench.dm.send(command)
    except escape_hw.errors.CommandRejected as refusal:
        print(f"refused: {refusal}")

# The 'with' block has flattened the mirror and closed every device.
x, y = (after - before).reshape(2, -1)
strength = np.zeros(grid.valid.shape)
strength[grid.valid] = np.hypot(x, y)
print(f"largest slope: {strength.max():.2f} pixels")
shades = " .:-=+*#%@"
for row in strength / strength.max() * (len(shades) - 1):
    print("".join(2 * shades[round(value)] for value in row).rstrip())
