"""The image of the science camera without turbulence, which Strehl ratios are measured against."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.procedure import Procedure, Reporter
from escape_hw.bench import Bench
from escape_hw.calibration.acquisition.frames import validate_frame_count
from escape_hw.errors import CalibrationError
from escape_hw.pipeline.psf.strehl import diffraction_psf, has_light, is_peak_saturated, subtract_background


def measure_model_psf(bench: Bench, *, frames: int = 20) -> Procedure[NDArray[np.float32]]:
    """Mean PSF with a flat mirror and no turbulence in the beam (paper: the empirical model).

    Under a sky that cannot be switched off (``devices.science.model_psf = "design"``) it is the
    diffraction image of the design's pupil, and no frame is taken.

    Raises
    ------
    CalibrationError
        The system has no science camera, it sees no light, or the image's peak is saturated.
    """
    validate_frame_count(frames)
    science = bench.science
    if science is None:
        raise CalibrationError("this system has no science camera to take a PSF with")
    config = bench.config.devices.science
    if config is not None and config.model_psf == "design":
        _, pupil, pixel_m = bench.model().influence_functions()
        across = bench.config.system.pupil_m / pixel_m
        return diffraction_psf(pupil, across, config.psf_px, (config.region[3], config.region[2]))
    bench.dm.flatten()
    science.stop()
    wait = bench.config.devices.science.timeout_s if bench.config.devices.science else 1.0
    report = Reporter("model PSF", frames)
    science.next_frame(wait)
    total, clipped = np.zeros((), np.float64), 0
    try:
        for done in range(frames):
            frame = science.next_frame(wait)
            clipped += is_peak_saturated(frame)
            total = total + frame.data
            if report.due():
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
