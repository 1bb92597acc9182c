"""Threads of the linear algebra; SPRINT limits them while it computes, not while it is suspended."""

from __future__ import annotations

from contextlib import contextmanager

import numpy as np
import small_system
import threadpoolctl

from escape_hw.api.concurrency import limit_to_one_thread
from escape_hw.api.interaction_matrix import InteractionMatrix
from escape_hw.api.registration import Registration
from escape_hw.calibration.sprint import fit
from escape_sim.models.factory import make_fast_model
from escape_sim.models.shack_hartmann import nominal_grid


def test_the_limit_does_not_hold_while_the_procedure_is_suspended(monkeypatch):
    entered = 0

    @contextmanager
    def limit():
        nonlocal entered
        entered += 1
        try:
            yield
        finally:
            entered -= 1

    config = small_system.configuration()
    model = make_fast_model(config, None)
    data = model.zonal_matrix(Registration(3.0, -5.0, 0.4)).astype(np.float32)
    sigma = np.full(data.shape, 0.1, np.float32)
    valid = nominal_grid(config).valid
    matrix = InteractionMatrix(data, sigma, np.eye(model.n_act), valid, "small", "push-pull", True)
    monkeypatch.setattr(fit, "limit_to_one_thread", limit)
    suspended = 0
    for _ in fit.fit_registration(matrix, model):
        assert entered == 0
        suspended += 1
    assert suspended > 1


def test_the_libraries_are_searched_once(monkeypatch):
    """The search takes milliseconds, and a fit sets the limit for every step."""
    original, searches = threadpoolctl.ThreadpoolController, []
    monkeypatch.setattr(threadpoolctl, "ThreadpoolController", lambda: searches.append(1) or original())
    for _ in range(3):
        with limit_to_one_thread():
            pass
    assert len(searches) <= 1
    with limit_to_one_thread():
        assert {one["num_threads"] for one in threadpoolctl.threadpool_info()} == {1}
