"""Attributes of results of version 0.1.0 work with a warning."""

from __future__ import annotations

from dataclasses import replace

import fake_results as fake
import pytest

from escape_hw.api.procedure import Reporter


def test_a_registration():
    estimate = fake.registration()
    with pytest.warns(DeprecationWarning, match=r"RegistrationEstimate.measured is called"):
        assert estimate.measured() == estimate.parameters()
    with pytest.warns(DeprecationWarning, match=r"RegistrationEstimate.departures is called"):
        assert estimate.departures is estimate.actuator_corrections


def test_optical_gains():
    result = fake.gains_result()
    with pytest.warns(DeprecationWarning, match=r"GainsResult.beside is called"):
        assert result.beside is result.comparisons


def test_a_metric_of_a_matrix():
    matrix = replace(fake.calibration().matrix, metrics={"shortened": 3})
    assert matrix.metrics == {"clipped_pokes": 3}
    with pytest.warns(DeprecationWarning, match="the metric 'shortened' is called 'clipped_pokes'"):
        assert matrix.metrics["shortened"] == 3
    with pytest.raises(KeyError):
        matrix.metrics["unknown"]


def test_the_delay():
    response = fake.calibration().response
    with pytest.warns(DeprecationWarning, match=r"TemporalResponse.delay is called"):
        assert response.delay == response.delay_frames


def test_a_reporter():
    report = Reporter("stage", 3)
    with pytest.warns(DeprecationWarning, match=r"Reporter.due is called Reporter.is_due"):
        assert report.due()
