"""Reference PSF of the science camera without turbulence, for Strehl ratios."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.procedure import Procedure, Reporter
from escape_hw.bench import Bench
from escape_hw.calibration.acquisition.frames import validate_frame_count
from escape_hw.errors import CalibrationError
from escape_hw.pipeline.psf.strehl import diffraction_psf, has_light, is_peak_saturated, subtract_background


def measure_model_psf(bench: Bench, *, frames: int = 20) -> Procedure[NDArray[np.float32]]:
    """Mean PSF ``(rows, columns)`` with a flat mirror and no turbulence in the beam (paper: empirical model).

    With ``devices.science.model_psf = "design"``, for systems on the sky, it is the diffraction image of the
    design's pupil, and no frame is taken.

    Raises
    ------
    ConfigError
        The number of frames is not at least 1.
    CalibrationError
        The system has no science camera, it sees no light, or the image's peak is saturated.
    """
    validate_frame_count(frames)
    science, config = bench.science, bench.config.devices.science
    if science is None:
        raise CalibrationError("this system has no science camera to take a PSF with")
    if config is not None and config.model_psf == "design":
        _, pupil, pixel_m = bench.model().influence_functions()
        across = bench.config.system.pupil_m / pixel_m
        return diffraction_psf(pupil, across, config.psf_px, (config.region[3], config.region[2]))
    bench.dm.flatten()
    science.stop()
    timeout_s = config.timeout_s if config else 1.0
    report = Reporter("model PSF", frames)
    # The exposure of the first frame may have begun before the mirror was flat.
    science.next_frame(timeout_s)
    total, clipped = np.zeros((), np.float64), 0
    try:
        for done in range(frames):
            frame = science.next_frame(timeout_s)
            clipped += is_peak_saturated(frame)
            total = total + frame.data
            if report.is_due():
                yield report(done + 1)
    finally:
        science.stop()
    if clipped:
        raise CalibrationError(
            f"{science.name}: the peak of the model PSF is saturated in {clipped} of {frames} frames; expose "
            "for a shorter time or dim the source"
        )
    image = subtract_background(total / frames).astype(np.float32)
    if not has_light(image):
        raise CalibrationError(
            f"{science.name}: no light on the science camera; check the source, the beam stop and the region"
        )
    return image
