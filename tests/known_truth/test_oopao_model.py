"""The fast synthetic model against OOPAO's."""

from __future__ import annotations

import numpy as np
import pytest

from escape_hw.api.model import SyntheticModel
from escape_hw.api.registration import Registration
from escape_hw.config import load_system
from escape_hw.errors import CalibrationError
from escape_sim import model as fast_model
from escape_sim import oopao_model

PAPER = Registration(-16.0, -71.0, -0.77, 2.9, 0.0)
#: Slopes of OOPAO come from windows of 14 of its pixels (7 lambda/d), ours from 15.54 camera pixels
#: (6.76 lambda/d): the wings of the spots beyond are what the two do not share.
MATRIX_TOLERANCE = 0.02


@pytest.fixture(scope="module")
def config():
    return load_system("razor-shwfs")


@pytest.fixture(scope="module")
def oopao(config):
    return oopao_model.make_model(config, None)


@pytest.fixture(scope="module")
def fast(config):
    return fast_model.make_model(config, None)


def relative(ours, theirs):
    """Relative difference after the best common gain, and that gain."""
    gain = float((ours * theirs).sum() / (theirs * theirs).sum())
    return float(np.linalg.norm(ours - gain * theirs) / np.linalg.norm(ours)), gain
