"""Calibrate without a source, save the matrix, close the loop, and measure the Strehl ratio.

Run it with: python examples/close_the_loop.py [im.fits]
"""

import sys
import tempfile
from pathlib import Path

import escape_hw

path = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(tempfile.mkdtemp()) / "im.fits"

with escape_hw.open_system("razor-shwfs", seed=4) as bench:
    result = bench.calibrate("escape", frames=1000, progress=True)
    escape_hw.save_matrix(path, result)

    # Another script can load the file; it contains geometry, basis, standard errors and a checksum.
    product = escape_hw.load_matrix(path, expect_system="razor-shwfs")
    print(f"{path.name}: {product.matrix.method}, {product.matrix.n_modes} modes")

    model = bench.take_model_psf()  # flat mirror without turbulence; Strehl ratio 1 by definition
    run = bench.close_loop(product, frames=1500, model_psf=model, progress=True)

print(f"gain {run.gain}, leak {run.leak}: {'stable' if run.stable else 'DIVERGED'}")
print(f"residual seen by the sensor: {run.residual_rms_nm:.0f} nm rms")
for way in ("peak", "otf", "encircled"):
    ratio = getattr(run.strehl, way)
    print(f"Strehl ratio, {way}: {100 * ratio.value:.1f} ± {100 * ratio.sigma:.1f} %")
