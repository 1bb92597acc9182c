"""The line of verdict on a result."""

from __future__ import annotations

import pytest

from escape_hw.report.verdict import Quality, assess

ESCAPE = {"converged": True, "iterations": 15, "frames": 600, "snr": {"min": 23.8}, "criteria": []}
#: As a run of 600 frames reports it: the progress is a little older.
STOPPED_AT = {"stage": "DO-CRIME", "done": 590, "total": 2000, "unit": "frame"}


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
        (
            {"partial": True},
            Quality.ABORTED,
            "Aborted: stopped after 600 frames; what was measured is good: SNR 23.8 in the worst mode, "
            "converged in 15 iterations; run it again",
        ),
        (
            {"partial": True, "stopped_at": STOPPED_AT, "converged": None, "snr": {"min": 0.35}},
            Quality.ABORTED,
            "Aborted: DO-CRIME stopped after 600 of 2,000 frames; what was measured is not usable: SNR 0.35 "
            "in the worst mode; run it again",
        ),
        (
            {"partial": True, "stopped_at": {**STOPPED_AT, "done": 3, "total": 20, "unit": "iteration"}},
            Quality.ABORTED,
            "Aborted: DO-CRIME stopped after 3 of 20 iterations; what was measured is good",
        ),
        (
            {
                "partial": True,
                "stopped_at": {"stage": "synthetic model", "done": 0, "total": 1, "unit": "model"},
            },
            Quality.ABORTED,
            "Aborted: synthetic model stopped; what was measured is good",
        ),
        (
            {"partial": True, "stopped_at": {**STOPPED_AT, "total": 0}},
            Quality.ABORTED,
            "DO-CRIME stopped after 590 frames",
        ),
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
     {"strehl": {"peak": 3}, "stable": True}, {"snr": {"min": 2.0}, "frames": "many"},
     {"partial": True, "stopped_at": "late"}, {"partial": True, "stopped_at": {"done": "x", "total": 3}}],
)  # fmt: skip
def test_a_damaged_document_is_assessed_as_far_as_it_goes(document: dict[str, object]) -> None:
    verdict = assess(document)
    assert verdict is None or str(verdict)


def test_a_result_without_a_criterion_has_no_verdict() -> None:
    assert assess({"frames": 100, "criteria": []}) is None


def test_an_aborted_sweep_is_resumed() -> None:
    stopped_at = {"stage": "sweep", "done": 3, "total": 20, "unit": "loop"}
    document = {"partial": True, "stopped_at": stopped_at, "criteria": [], "sweep": {}}
    assert str(assess(document)) == "Aborted: sweep stopped after 3 of 20 loops; resume it"


def test_an_aborted_run_without_a_criterion_says_only_how_far_it_came() -> None:
    document = {"partial": True, "stopped_at": STOPPED_AT, "criteria": []}
    assert str(assess(document)) == "Aborted: DO-CRIME stopped after 590 of 2,000 frames; run it again"
