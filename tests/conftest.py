"""Options of the whole suite."""

from hardware_option import pytest_addoption, pytest_configure

__all__ = ["pytest_addoption", "pytest_configure"]
