"""What a caller may say to a server, before anything is sent."""

from __future__ import annotations

import math
from typing import Any

import pytest

from escape_hw.config.models import GAIN_MOST
from escape_hw.errors import ConfigError
from escape_hw.remote import requests as ask

CLIENT = "0123456789abcdef"


@pytest.mark.parametrize("gain", [0.0, -1.0, 1.01 * GAIN_MOST, 40.0, math.nan, math.inf, "much"])
@pytest.mark.parametrize("kind", [ask.SetLoop, ask.CloseLoop])
def test_a_gain_outside_the_configurations_range_is_refused(kind: type[ask.Request], gain: object) -> None:
    matrix = "im"
    assert ask.made(kind, client=CLIENT, matrix=matrix, gain=GAIN_MOST).model_dump()["gain"] == GAIN_MOST
    with pytest.raises(ConfigError, match="gain: Input should be"):
        ask.made(kind, client=CLIENT, matrix=matrix, gain=gain)


@pytest.mark.parametrize("kind", [ask.Start, ask.Check])
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_an_argument_that_is_no_number_does_not_become_the_default(
    kind: type[ask.Request], value: float
) -> None:
    fields: dict[str, Any] = {"client": CLIENT, "procedure": "docrime"}
    assert ask.made(kind, **fields, arguments={"poke": 0.01, "snr": None})
    with pytest.raises(ConfigError, match=r"arguments\.poke"):
        ask.made(kind, **fields, arguments={"poke": value})


def test_a_path_with_a_null_byte_is_refused() -> None:
    assert ask.made(ask.LoadProduct, client=CLIENT, path="/data/größe.fits")
    with pytest.raises(ConfigError, match="path"):
        ask.made(ask.LoadProduct, client=CLIENT, path="a\x00.fits")
