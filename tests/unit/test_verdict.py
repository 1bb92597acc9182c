"""The line of verdict on a result."""

from __future__ import annotations

import pytest

from escape_hw.report.verdict import Quality, assess

ESCAPE = {"converged": True, "iterations": 15, "frames": 600, "snr": {"min": 23.8}, "criteria": []}


@pytest.mark.parametrize(
    ("changes", "quality", "words"),
    [
        ({}, Quality.GOOD, "Good: SNR 23.8 in the worst mode, converged in 15 iterations"),
        (
            {"snr": {"min": 0.35}},
            Quality.USABLE,
            "Usable: SNR 0.35 in the worst mode; measure about 44,000 frames",
        ),
        ({"converged": False}, Quality.NOT_USABLE, "Not usable: not converged"),
        (
            {"model_fits": False, "misfit": 0.144, "chi2": 22.4},
            Quality.USABLE,
            "Usable: converged, but the model does not fit (14% of the matrix beyond its noise, reduced "
            "chi-squared 22.4); the notes name what does not fit",
        ),
        ({"converged": False, "model_fits": False}, Quality.NOT_USABLE, "Not usable: not converged"),
        ({"model_fits": None}, Quality.USABLE, "Usable: converged, but whether the model fits is not judged"),
        (
            {"model_fits": False, "misfit": 0.0, "chi2": 1.0},
            Quality.USABLE,
            "the model does not fit; the notes",
        ),
        (
            {"model_fits": None, "snr": {"min": None}},
            Quality.USABLE,
            "Usable: converged, but the matrix has no standard errors",
        ),
        ({"converged": None, "snr": {"min": 0.35}}, Quality.NOT_USABLE, "SNR 0.35 in the worst mode"),
        ({"converged": None, "snr": {"min": 2.0}}, Quality.USABLE, "measure about 1,400 frames"),
        ({"criteria": [{"text": "loop stable", "met": False}]}, Quality.NOT_USABLE, "not met: loop stable"),
        ({"warnings": ["scaling beyond 5 %"]}, Quality.USABLE, "scaling beyond 5 %; see the report"),
        ({"partial": True}, Quality.USABLE, "Usable: the run was aborted after 600 frames; run it again"),
        ({"alarms": [{}, {"text": "jumped"}]}, Quality.USABLE, "2 alarms, the last: jumped; see the report"),
        ({"stable": False}, Quality.NOT_USABLE, "the loop was not stable; lower the gain"),
        (
            {"alarms": [{"text": "x"}], "criteria": [{"text": "no alarms (1)", "met": False}]},
            Quality.USABLE,
            "an alarm: x",
        ),
        (
            {"converged": None, "snr": None, "stable": True, "residual_rms_nm": 44.1, "strehl": 0.365},
            Quality.GOOD,
            "Good: loop stable, residual 44 nm rms, Strehl ratio 36.5 %",
        ),
        (
            {"iterations": None, "rounds": [{}, {}], "snr": None},
            Quality.GOOD,
            "Good: converged in 2 rounds",
        ),
    ],
)
def test_verdict_has_quality_reason_and_advice(
    changes: dict[str, object], quality: Quality, words: str
) -> None:
    verdict = assess({**ESCAPE, **changes})
    assert verdict is not None
    assert verdict.quality is quality
    assert words in str(verdict)


def test_criteria_alone_make_a_verdict() -> None:
    criteria = [{"text": "loop stable", "met": True}, {"text": "Strehl compared", "met": True}]
    assert str(assess({"criteria": criteria})) == "Good: all 2 criteria met"
    assert str(assess({"criteria": criteria[:1]})) == "Good: met: loop stable"


@pytest.mark.parametrize(
    "document",
    [{"snr": "high"}, {"snr": {"min": "1"}}, {"criteria": [3]}, {"alarms": ["x"]}, {"warnings": 4},
     {"strehl": {"peak": 3}, "stable": True}, {"snr": {"min": 2.0}, "frames": "many"}],
)  # fmt: skip
def test_a_damaged_document_is_assessed_as_far_as_it_goes(document: dict[str, object]) -> None:
    verdict = assess(document)
    assert verdict is None or str(verdict)


def test_a_result_without_a_criterion_has_no_verdict() -> None:
    assert assess({"frames": 100, "criteria": []}) is None
