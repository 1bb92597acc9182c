"""What a caller may say to a server, before anything is sent."""

from __future__ import annotations

import math
from typing import Any

import pytest

from escape_hw.config.system import MAX_GAIN
from escape_hw.errors import ConfigError
from escape_hw.remote import requests

CLIENT = "0123456789abcdef"


@pytest.mark.parametrize("gain", [0.0, -1.0, 1.01 * MAX_GAIN, 40.0, math.nan, math.inf, "much"])
@pytest.mark.parametrize("kind", [requests.SetLoop, requests.CloseLoop])
def test_a_gain_outside_the_configurations_range_is_refused(
    kind: type[requests.Request], gain: object
) -> None:
    matrix = "im"
    assert (
        requests.build_request(kind, client=CLIENT, matrix=matrix, gain=MAX_GAIN).model_dump()["gain"]
        == MAX_GAIN
    )
    with pytest.raises(ConfigError, match="gain: Input should be"):
        requests.build_request(kind, client=CLIENT, matrix=matrix, gain=gain)


@pytest.mark.parametrize("kind", [requests.StartProcedure, requests.PlanProcedure])
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_an_argument_that_is_no_number_does_not_become_the_default(
    kind: type[requests.Request], value: float
) -> None:
    fields: dict[str, Any] = {"client": CLIENT, "procedure": "docrime"}
    assert requests.build_request(kind, **fields, arguments={"poke": 0.01, "snr": None})
    with pytest.raises(ConfigError, match=r"arguments\.poke"):
        requests.build_request(kind, **fields, arguments={"poke": value})


def test_a_path_with_a_null_byte_is_refused() -> None:
    assert requests.build_request(requests.LoadProduct, client=CLIENT, path="/data/größe.fits")
    with pytest.raises(ConfigError, match="path"):
        requests.build_request(requests.LoadProduct, client=CLIENT, path="a\x00.fits")
