"""Configure the camera of the wavefront sensor, record frames, and save them.

Run it with: python examples/grab_frames.py [frames.npz]
"""

import sys
from dataclasses import replace

import numpy as np

import escape_hw

N_FRAMES = 100

with escape_hw.open_system("razor-shwfs") as bench:
    camera = bench.wfs
    print(f"{camera.info.model}, serial {camera.info.serial}, simulated: {camera.info.simulated}")

    # configure() returns the settings read back from the hardware.
    wanted = replace(camera.settings, exposure_s=1.0e-3, frame_rate_hz=400.0)
    print(f"nearest achievable: {camera.check(wanted)}")  # changes nothing
    settings = camera.configure(wanted)

    frames = [camera.next_frame(timeout_s=1.0) for _ in range(N_FRAMES)]
    status = camera.status()

cube = np.stack([frame.data for frame in frames])  # 16-bit counts (frames, rows, columns)
index = np.array([frame.index for frame in frames])  # frame counter of the device; gaps are lost frames
arrived_s = np.array([frame.arrived_ns for frame in frames]) * 1e-9  # monotonic clock
saturated = sum(frame.n_saturated for frame in frames)

print(f"{status.delivered} frames of {cube.shape[2]} x {cube.shape[1]} pixels, {status.lost} lost")
print(f"asked for {settings.frame_rate_hz:.1f} Hz, measured {1 / np.median(np.diff(arrived_s)):.1f} Hz")
print(f"brightest pixel {cube.max()} of {2**10 - 1} counts, {saturated} saturated")
if len(sys.argv) > 1:
    np.savez(sys.argv[1], frames=cube, index=index, arrived_s=arrived_s)
    print(f"written: {sys.argv[1]}")
