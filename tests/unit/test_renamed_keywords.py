"""Keywords of version 0.1.0 work with a warning."""

from __future__ import annotations

import inspect

import pytest

from escape_hw.calibration.sprint.fit import sprint
from escape_hw.deprecation import renamed_keywords


@renamed_keywords(old="new")
def function(value: int, *, new: int = 1) -> tuple[int, int]:
    return value, new


def test_the_former_name_is_passed_on_with_a_warning():
    with pytest.warns(DeprecationWarning, match=r"function\(old=\) is called function\(new=\)"):
        assert function(2, old=3) == (2, 3)
    assert function(2, new=3) == (2, 3)
    assert function(2) == (2, 1)


def test_both_names_are_refused():
    with pytest.warns(DeprecationWarning, match="is called"), pytest.raises(TypeError, match="give one"):
        function(2, old=3, new=3)


def test_the_signature_has_the_present_names():
    assert list(inspect.signature(function).parameters) == ["value", "new"]
    assert "extra_parameters" in inspect.signature(sprint).parameters
