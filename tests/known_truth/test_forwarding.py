"""A model that stands for another one has its members, as protocols see them."""

from __future__ import annotations

import inspect

import pytest
import small_pyramid
import small_system

from escape_hw.api.synthetic_model import (
    DifferentiableModel,
    HasActuatorPositions,
    HasGainTrend,
    HasSlopeWeights,
    HasSystematicError,
)
from escape_hw.calibration.sprint.tip_tilt import TipTiltFreeModel
from escape_hw.config.system import SystemConfig
from escape_sim.models.factory import make_fast_model
from escape_sim.models.pyramid import PyramidModel, nominal_pupils


def check(original: object, model: TipTiltFreeModel) -> None:
    for name in (name for name in dir(original) if not name.startswith("_")):
        # As isinstance looks for the members of a protocol since Python 3.12.
        inspect.getattr_static(model, name)
    assert not hasattr(model, "no_such_member")


def test_lenslets_without_tip_and_tilt() -> None:
    original = make_fast_model(small_system.configuration(), None)
    model = TipTiltFreeModel(original)
    check(original, model)
    assert isinstance(model, DifferentiableModel)
    assert isinstance(model, HasActuatorPositions)
    assert model.n_act == original.n_act


@pytest.mark.parametrize("turbulence", [0.0, 5.0])
def test_a_pyramid_without_tip_and_tilt(turbulence: float) -> None:
    config: SystemConfig = small_pyramid.configuration()
    original = PyramidModel(config, nominal_pupils(config), turbulence=turbulence)
    model = TipTiltFreeModel(original)
    check(original, model)
    for protocol in (DifferentiableModel, HasGainTrend, HasSlopeWeights, HasSystematicError):
        assert isinstance(model, protocol)
    assert model.gain_trend == original.gain_trend
    assert isinstance(model.with_pupil_shift(1.0, 2.0), TipTiltFreeModel)
