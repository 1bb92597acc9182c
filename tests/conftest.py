"""Options of the whole suite."""

import signal

import campaign_table
import hardware_option
import pytest
from campaign_table import pytest_terminal_summary
from hardware_option import pytest_configure
from hypothesis import HealthCheck, settings
from study_scripts import import_study

__all__ = ["import_study", "pytest_addoption", "pytest_configure", "pytest_terminal_summary"]

# Shells start background jobs with Ctrl-C and Ctrl-\ ignored, nohup ignores hang-ups; commands inherit that.
_USUAL = {
    signal.SIGINT: signal.default_int_handler,
    signal.SIGQUIT: signal.SIG_DFL,
    signal.SIGHUP: signal.SIG_DFL,
}
for _signal, _handler in _USUAL.items():
    if signal.getsignal(_signal) is signal.SIG_IGN:
        signal.signal(_signal, _handler)

# How long an example takes says how busy the computer is, not whether the code is right.
settings.register_profile("untimed", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("untimed")


def pytest_addoption(parser: pytest.Parser) -> None:
    hardware_option.pytest_addoption(parser)
    campaign_table.pytest_addoption(parser)
