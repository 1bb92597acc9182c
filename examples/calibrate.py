"""Measure the interaction matrix in three ways and compare the results.

Run it with: python examples/calibrate.py
"""

from dataclasses import replace

import numpy as np

import escape_hw
from escape_hw.report.comparison import compare

FRAMES = 1000  # two seconds at 500 Hz; the paper's SHORT run has 10,000

with escape_hw.open_system("razor-shwfs") as bench:
    # Push-pull needs a source: the phase screen is removed during the measurement.
    push_pull = bench.calibrate("push-pull", frames=5, progress=True)

    # ESCAPE works under turbulence: DO-CRIME, then SPRINT, then a pseudo-synthetic matrix.
    escape = bench.calibrate("escape", frames=FRAMES, progress=True)
    injected = bench.config.twin.registration.to_registration()  # true value, known for a twin only

print(
    f"{escape.frames} frames in {escape.sky_seconds:.1f} s; delay {escape.response.delay_frames:.2f} frames"
)

# The result includes the DO-CRIME matrix, with a standard error for every element.
docrime = replace(escape, matrix=escape.measured, registration=None)
snr = docrime.matrix.snr()
print(f"DO-CRIME, signal-to-noise ratio per mode: minimum {snr.min():.1f}, median {np.median(snr):.1f}")

# Comparison over the sub-apertures that are valid in both runs. The gains differ because turbulence reduces
# the response of the spots; the loop gain compensates for this.
for name, result in (("DO-CRIME", docrime), ("ESCAPE", escape)):
    difference = compare(push_pull, result)
    gain, agreement = np.median(difference.gain_ratio), np.median(difference.correlation)
    print(f"{name:>8} against push-pull: median gain {gain:.3f}, median correlation {agreement:.4f}")

print(f"SPRINT {escape.registration.outcome}:")
for name, estimate in escape.registration.parameters().items():
    value = getattr(injected, name)
    print(f"{name:>18}: {estimate.value:8.3f} ± {estimate.sigma:.3f} {estimate.unit} (injected {value:g})")
