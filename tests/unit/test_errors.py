"""The error tree: names, exit codes, and the way to another process and back."""

from __future__ import annotations

import pickle

import pytest

from escape_hw import errors

#: Those of the core; a driver may know more about its own, and make them otherwise.
DEVICE_ERRORS = [
    kind
    for kind in (errors.DeviceError, *errors.DeviceError.__subclasses__())
    if kind.__module__ == errors.__name__
]


@pytest.mark.parametrize("kind", DEVICE_ERRORS)
def test_device_errors_name_their_device(kind: type[errors.DeviceError]) -> None:
    error = kind("dm", "went away")
    assert str(error) == "dm: went away"
    assert error.device == "dm"
    assert error.exit_code == 3


@pytest.mark.parametrize("kind", DEVICE_ERRORS)
def test_device_errors_cross_to_another_process(kind: type[errors.DeviceError]) -> None:
    again = pickle.loads(pickle.dumps(kind("dm", "went away")))
    assert type(again) is kind
    assert str(again) == "dm: went away"
    assert again.device == "dm"


def test_an_abort_carries_its_partial_result_across() -> None:
    again = pickle.loads(pickle.dumps(errors.Aborted(partial=[1, 2])))
    assert again.partial == [1, 2]
    assert str(again) == "aborted by the operator"


def test_every_error_has_an_exit_code_of_the_specification() -> None:
    def below(kind: type[errors.EscapeError]) -> set[type[errors.EscapeError]]:
        return {kind}.union(*(below(sub) for sub in kind.__subclasses__()))

    tree = below(errors.EscapeError)
    assert len(tree) >= 14
    assert {kind.exit_code for kind in tree} == {1, 2, 3, 130}
