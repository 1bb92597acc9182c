"""Whether a sensor removes tip and tilt, from its matrix."""

from __future__ import annotations

import numpy as np
import pytest

from escape_hw.api.interaction_matrix import InteractionMatrix
from escape_hw.calibration.sprint.tip_tilt import is_tip_tilt_removed, remove_tip_tilt

N_MODES = 40


@pytest.mark.parametrize(("exceptions", "removed"), [(0, True), (1, True), (10, False), (N_MODES, False)])
def test_a_dead_actuator_does_not_hide_it(exceptions, removed):
    data = np.random.default_rng(0).standard_normal((72, N_MODES))
    data = np.where(np.arange(N_MODES) < exceptions, data, remove_tip_tilt(data))
    valid = np.ones((6, 6), dtype=bool)
    sigma = np.full(data.shape, 0.1, np.float32)
    matrix = InteractionMatrix(
        data.astype(np.float32), sigma, np.eye(N_MODES), valid, "razor-shwfs", "push-pull", True
    )
    assert is_tip_tilt_removed(matrix) is removed
