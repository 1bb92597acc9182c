"""Checks of requests before they are sent to a server."""

from __future__ import annotations

import math
from typing import Any

import pytest

from escape_hw.config.system import MAX_GAIN
from escape_hw.errors import ConfigError
from escape_hw.remote import requests
from escape_hw.remote.state import ActiveRun, State

CLIENT = "0123456789abcdef"


@pytest.mark.parametrize("gain", [0.0, -1.0, 1.01 * MAX_GAIN, 40.0, math.nan, math.inf, "much"])
@pytest.mark.parametrize("verb", ["set_loop", "close_loop"])
def test_a_gain_outside_the_configurations_range_is_refused(verb: str, gain: object) -> None:
    matrix = "im"
    assert (
        requests.build_request(verb, client=CLIENT, matrix=matrix, gain=MAX_GAIN).model_dump()["gain"]
        == MAX_GAIN
    )
    with pytest.raises(ConfigError, match="gain: Input should be"):
        requests.build_request(verb, client=CLIENT, matrix=matrix, gain=gain)


@pytest.mark.parametrize("verb", ["start_procedure", "plan"])
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_an_argument_that_is_no_number_does_not_become_the_default(verb: str, value: float) -> None:
    fields: dict[str, Any] = {"client": CLIENT, "procedure": "docrime"}
    assert requests.build_request(verb, **fields, arguments={"poke": 0.01, "snr": None})
    with pytest.raises(ConfigError, match=r"arguments\.poke"):
        requests.build_request(verb, **fields, arguments={"poke": value})


def test_a_path_with_a_null_byte_is_refused() -> None:
    assert requests.build_request("load_product", client=CLIENT, path="/data/größe.fits")
    with pytest.raises(ConfigError, match="path"):
        requests.build_request("load_product", client=CLIENT, path="a\x00.fits")


def test_attributes_of_version_0_1_0_still_work_with_a_deprecation_message() -> None:
    state = State(active_run=ActiveRun(id=1, name="docrime", arguments={}, completed=7))
    with pytest.warns(DeprecationWarning, match="State.procedure is now called active_run"):
        run = state.procedure  # type: ignore[attr-defined]
    with pytest.warns(DeprecationWarning, match="ActiveRun.done is now called completed"):
        assert run.done == 7
    with pytest.raises(AttributeError):
        _ = state.nothing  # type: ignore[attr-defined]


def test_the_first_request_of_another_version_is_understood_so_that_it_can_be_refused() -> None:
    text = '{"verb": "hello", "client": "00000000", "schema_version": 1, "name": "x", "host": "y", "pid": 1}'
    assert isinstance(requests.REQUESTS.validate_json(text), requests.RegisterClient)
