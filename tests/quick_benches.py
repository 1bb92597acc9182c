"""Simulated benches that open at once."""

from __future__ import annotations

from collections.abc import Iterator

import pytest


@pytest.fixture(scope="module", autouse=True)
def little_noise() -> Iterator[None]:
    """Detectors keep less noise in store, which takes most of the time in which a bench opens."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("escape_sim.optics.detector.Detector.POOL", 1 << 19)
        yield
