"""Turned cameras, and mirrors that count or pull otherwise: refused by name, right once described."""

from __future__ import annotations

import re
from functools import cache

import numpy as np
import pytest
import small_pyramid
from small_system import GAUSSIAN_TWIN, configuration

from escape_hw.api.flips import FLIPS
from escape_hw.api.results import RegistrationEstimate
from escape_hw.runtime.session.system import System

INJECTED = (
    "twin.registration.shift_x=12.0",
    "twin.registration.shift_y=-7.0",
    "twin.registration.rotation=1.0",
)


@cache
def fitted(*more: str) -> RegistrationEstimate:
    """The registration from 300 frames of the small bench."""
    with System.from_config(configuration(*GAUSSIAN_TWIN, *INJECTED, *more)) as bench:
        found = bench.calibrate("escape", frames=300).registration
    assert found is not None
    return found


#: Keys of the twin that are not those of the devices.
CASES = [
    "wfs.flip=left-right",
    *(pytest.param(f"wfs.flip={flip}", marks=pytest.mark.slow) for flip in FLIPS[2:]),
    pytest.param("mirror.order=turn-90", marks=pytest.mark.slow),
    "mirror.polarity=-1",
]


def device_key(key: str) -> str:
    """The key of the device that describes a key of the twin."""
    return "devices." + key.replace("mirror.", "dm.")


@pytest.mark.parametrize("true", CASES)
def test_the_registration_is_the_same_once_it_is_described(true: str) -> None:
    found = fitted(f"twin.{true}", device_key(true))
    assert found.converged
    # Frames and shapes are the same to the last bit.
    assert np.array_equal(found.registration.to_array(), fitted().registration.to_array())


@pytest.mark.parametrize("true", CASES)
def test_what_is_not_described_is_refused_and_its_key_named(true: str) -> None:
    found = fitted(f"twin.{true}")
    assert not found.converged
    key, _, value = device_key(true).partition("=")
    quoted = value if value == "-1" else f"'{value}'"
    assert any(f"{key} = {quoted}" in warning for warning in found.warnings), found.warnings


@pytest.mark.parametrize("true", ["wfs.flip=turn-90", "mirror.order=turn-90"])
@pytest.mark.slow
def test_either_of_two_suggested_keys_fits(true: str) -> None:
    """Camera and numbering have the same effect on a matrix; the registration is turned with them."""
    text = " ".join(fitted(f"twin.{true}").warnings)
    keys = re.findall(r"(devices\.(?:wfs\.flip|dm\.order)) = '([\w-]+)'", text)
    assert len(keys) == 2
    other = next(f"{key}={value}" for key, value in keys if f"{key}={value}" != device_key(true))
    found = fitted(f"twin.{true}", other)
    assert found.converged
    expected = np.array([-7.0, -12.0, 1.0])
    assert (np.abs(found.registration.to_array()[:3] - expected) < 4 * found.sigma[:3]).all()


@pytest.mark.slow
def test_suggestions_add_to_what_is_described_already() -> None:
    camera = fitted("twin.wfs.flip=turn-90", "devices.wfs.flip=left-right", "devices.dm.order=none")
    assert "devices.wfs.flip = 'turn-90'" in " ".join(camera.warnings)
    mirror = fitted("twin.mirror.order=turn-90", "devices.dm.order=left-right", "devices.dm.polarity=1")
    assert "devices.dm.order = 'turn-90'" in " ".join(mirror.warnings)
    both = fitted("twin.mirror.polarity=-1", "twin.wfs.flip=transpose")
    text = " ".join(both.warnings)
    assert "devices.wfs.flip = 'transpose'" in text
    assert "and devices.dm.polarity = -1" in text


@pytest.mark.slow
def test_a_numbering_from_the_other_end_and_the_other_sign_are_named_together() -> None:
    found = fitted("twin.mirror.order=turn-180", "twin.mirror.polarity=-1")
    assert not found.converged
    assert "devices.dm.order = 'turn-180', and devices.dm.polarity = -1" in found.warnings[0]


@pytest.mark.slow
def test_a_table_is_not_replaced_by_a_flip() -> None:
    straight = ",".join(map(str, range(37)))
    found = fitted("twin.wfs.flip=up-down", f"devices.dm.order='numbers:{straight}'")
    text = " ".join(found.warnings)
    assert (
        "devices.wfs.flip = 'up-down' or, if the camera is right, correct the numbers of devices.dm.order"
        in text
    )


@pytest.mark.slow
def test_the_key_of_a_pyramids_camera_is_named() -> None:
    """A flip exchanges the pupil images as well."""
    with small_pyramid.small("twin.wfs.flip=turn-90") as bench:
        found = bench.calibrate("escape", frames=900).registration
    assert found is not None
    assert any("devices.wfs.flip = 'turn-90'" in warning for warning in found.warnings), found.warnings
