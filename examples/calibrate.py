"""Measure the interaction matrix three ways and compare them.

Run it with: python examples/calibrate.py
"""

from dataclasses import replace

import numpy as np

import escape_hw
from escape_hw.report.comparison import compare

FRAMES = 1000  # two seconds at 500 Hz; the paper's SHORT run has 10,000

with escape_hw.open_system("razor-shwfs") as bench:
    # Push-pull needs a calm beam: the phase screen is taken out for it, and put back.
    push_pull = bench.calibrate("push-pull", frames=5, progress=True)

    # ESCAPE works under turbulence: DO-CRIME, then SPRINT, then a matrix computed from a model.
    escape = bench.calibrate("escape", frames=FRAMES, progress=True)
    planted = bench.config.twin.registration.to_registration()  # nobody but a twin can tell

print(f"{escape.frames} frames, {escape.sky_seconds:.1f} s of them; delay {escape.response.delay:.2f} frames")

# The DO-CRIME matrix that ESCAPE started from is kept, with a standard error for every element.
docrime = replace(escape, matrix=escape.measured, registration=None)
snr = docrime.matrix.snr()
print(f"DO-CRIME, signal-to-noise ratio per mode: least {snr.min():.1f}, median {np.median(snr):.1f}")

# Compared over the sub-apertures that both runs found lit. Moving spots answer a push less than
# spots at rest, so the gains differ; the loop gain takes that up.
for name, result in (("DO-CRIME", docrime), ("ESCAPE", escape)):
    difference = compare(push_pull, result)
    gain, agreement = np.median(difference.gain_ratio), np.median(difference.correlation)
    print(f"{name:>8} against push-pull: median gain {gain:.3f}, median correlation {agreement:.4f}")

print(f"SPRINT {'converged' if escape.registration.converged else 'did NOT converge'}:")
for name, found in escape.registration.parameters().items():
    truth = getattr(planted, name)
    print(f"{name:>18}: {found.value:8.3f} ± {found.sigma:.3f} {found.unit} (planted {truth:g})")
