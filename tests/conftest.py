"""Options of the whole suite."""

from hardware_option import pytest_addoption, pytest_configure
from hypothesis import HealthCheck, settings

__all__ = ["pytest_addoption", "pytest_configure"]

# How long an example takes says how busy the computer is, not whether the code is right.
settings.register_profile("untimed", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("untimed")
