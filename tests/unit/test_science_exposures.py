"""The twin's science camera: its memory does not grow while nobody reads it."""

from __future__ import annotations

import numpy as np
from small_system import configuration

from escape_hw.runtime.session.system import System
from escape_sim.devices.twins import SimScienceCamera


def test_an_unread_science_camera_keeps_few_images() -> None:
    with System.from_config(configuration("twin.paced=false")) as bench:
        science = bench.science
        assert isinstance(science, SimScienceCamera)
        science.start()
        per_image = science.settings.frame_rate_hz / bench.wfs.settings.frame_rate_hz
        frames = round(60 / per_image)  # the time of 60 science frames
        for _ in range(frames):
            bench.wfs.next_frame(1.0)
        exposures = science._bench._exposures
        assert exposures is not None
        assert len(exposures._sums) <= 3
        # A late reader still gets the newest complete frame, exposed while the sensor was read.
        complete = max(exposures._sums) - 1
        image = science.next_frame(1.0)
        assert image.index >= complete
        assert np.ptp(image.data) > 0
        assert len(exposures._sums) <= 3
