"""The runner: abort from a thread, Ctrl-C at any point, failing observers, procedures that ignore it."""

from __future__ import annotations

import logging
import math
import os
import signal
import threading
import time
from collections.abc import Iterator
from typing import Any

import pytest

from escape_hw.api import procedure as module
from escape_hw.api.procedure import Procedure, Progress, Reporter, run
from escape_hw.errors import Aborted, DeviceLost


def counting(steps: int, log: list[str]) -> Procedure[int]:
    """Count; when aborted return what was counted so far; note the clean-up."""
    done = 0
    try:
        for done in range(1, steps + 1):
            yield Progress("count", done, steps)
    except Aborted:
        log.append("aborted")
    finally:
        log.append("clean")
    return done


def interrupt() -> None:
    os.kill(os.getpid(), signal.SIGINT)


@pytest.fixture(autouse=True)
def _handler_is_restored() -> Iterator[None]:
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    yield
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_result_and_progress_come_through() -> None:
    log: list[str] = []
    seen: list[Progress] = []
    assert run(counting(3, log), observers=(seen.append,)) == 3
    assert [progress.done for progress in seen] == [1, 2, 3]
    assert log == ["clean"]


def test_abort_from_another_thread_stops_at_the_next_step_and_keeps_the_partial_result() -> None:
    log: list[str] = []
    abort = threading.Event()

    def operator(progress: Progress) -> None:
        if progress.done == 3:
            thread = threading.Thread(target=abort.set)
            thread.start()
            thread.join()

    with pytest.raises(Aborted, match="by the operator") as caught:
        run(counting(10_000, log), abort=abort, observers=(operator,))
    assert caught.value.partial == 3
    assert caught.value.stopped_at == {"stage": "count", "done": 3, "total": 10_000, "unit": "frame"}
    assert log == ["aborted", "clean"]


def test_an_abort_before_the_start_starts_nothing() -> None:
    log: list[str] = []
    abort = threading.Event()
    abort.set()
    with pytest.raises(Aborted):
        run(counting(3, log), abort=abort)
    assert log == []


def test_an_abort_after_the_last_step_does_not_spoil_the_result() -> None:
    abort = threading.Event()

    def finishing() -> Procedure[str]:
        yield Progress("only", 1, 1)
        abort.set()
        return "complete"

    assert run(finishing(), abort=abort) == "complete"


def test_a_procedure_may_raise_its_own_partial_result() -> None:
    def raising() -> Procedure[None]:
        try:
            while True:
                yield Progress("endless", 0, 0)
        except Aborted as stop:
            raise Aborted("stopped with half a matrix", partial="half") from stop

    abort = threading.Event()
    with pytest.raises(Aborted, match="half a matrix") as caught:
        run(raising(), abort=abort, observers=(lambda _: abort.set(),))
    assert caught.value.partial == "half"


def test_a_procedure_may_report_while_it_clears_up() -> None:
    abort = threading.Event()
    seen: list[str] = []
    thrown = 0

    def clearing() -> Procedure[str]:
        nonlocal thrown
        try:
            while True:
                yield Progress("work", 0, 0)
        except Aborted:
            thrown += 1
        for k in range(5):
            yield Progress("flatten", k, 5)
        return "flat"

    def observe(progress: Progress) -> None:
        seen.append(progress.stage)
        abort.set()

    with pytest.raises(Aborted) as caught:
        run(clearing(), abort=abort, observers=(observe,))
    assert caught.value.partial == "flat"
    assert thrown == 1
    assert seen == ["work", *["flatten"] * 5]


def test_a_procedure_that_ignores_the_abort_is_closed_after_its_grace(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(module, "ABORT_GRACE_S", 0.05)
    log: list[str] = []

    def deaf() -> Procedure[None]:
        try:
            while True:
                try:
                    yield Progress("for ever", 0, 0)
                except Aborted:
                    log.append("ignored")
        finally:
            log.append("clean")

    abort = threading.Event()
    abort.set()
    procedure = deaf()
    next(procedure)
    with pytest.raises(Aborted):
        run(procedure, abort=abort)
    assert log == ["ignored", "clean"]
    assert "did not end within 0.05 s" in caplog.text


def test_a_procedure_that_refuses_even_to_be_closed_does_not_hang_the_runner(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(module, "ABORT_GRACE_S", 0.0)
    refusals = 0

    def immortal() -> Procedure[None]:
        nonlocal refusals
        while refusals < 3:
            try:
                yield Progress("for ever", 0, 0)
            except BaseException:
                refusals += 1

    abort = threading.Event()
    procedure = immortal()
    next(procedure)
    abort.set()
    with pytest.raises(Aborted):
        run(procedure, abort=abort)
    assert refusals == 2
    assert "did not close" in caplog.text


def test_ctrl_c_inside_a_step_lets_the_step_finish_and_keeps_the_partial_result() -> None:
    log: list[str] = []

    def measuring() -> Procedure[list[str]]:
        try:
            for k in range(100):
                if k == 3:
                    interrupt()
                    time.sleep(0.01)
                log.append(f"step {k}")
                yield Progress("measure", k, 100)
        except Aborted:
            log.append("aborted")
        return log

    with pytest.raises(Aborted, match="Ctrl-C") as caught:
        run(measuring())
    assert log == ["step 0", "step 1", "step 2", "step 3", "aborted"]
    assert caught.value.partial is log


def test_a_second_ctrl_c_breaks_into_a_step_that_hangs() -> None:
    log: list[str] = []

    def hanging() -> Procedure[None]:
        yield Progress("start", 0, 1)
        try:
            interrupt()
            interrupt()
            time.sleep(30)
        finally:
            log.append("clean")

    began = time.monotonic()
    with pytest.raises(Aborted, match="Ctrl-C"):
        run(hanging())
    assert time.monotonic() - began < 5
    assert log == ["clean"]


def test_keyboard_interrupt_from_an_observer_stops_the_procedure_properly() -> None:
    log: list[str] = []

    def observer(progress: Progress) -> None:
        if progress.done == 2:
            raise KeyboardInterrupt

    with pytest.raises(Aborted, match="Ctrl-C") as caught:
        run(counting(10, log), observers=(observer,))
    assert caught.value.partial == 2
    assert log == ["aborted", "clean"]


def test_ctrl_c_during_an_observer_stops_the_procedure_properly() -> None:
    log: list[str] = []
    with pytest.raises(Aborted, match="Ctrl-C") as caught:
        run(counting(10, log), observers=(lambda progress: interrupt() if progress.done == 2 else None,))
    assert caught.value.partial == 2


def test_the_applications_own_handler_is_left_alone() -> None:
    abort = threading.Event()
    previous = signal.signal(signal.SIGINT, lambda *_: abort.set())
    try:
        ours = signal.getsignal(signal.SIGINT)
        with pytest.raises(Aborted, match="by the operator") as caught:
            run(counting(10, []), abort=abort, observers=(lambda progress: interrupt(),))
        assert signal.getsignal(signal.SIGINT) is ours
        assert caught.value.partial == 1
    finally:
        signal.signal(signal.SIGINT, previous)


def test_it_runs_in_another_thread_too() -> None:
    answer: list[int] = []
    thread = threading.Thread(target=lambda: answer.append(run(counting(3, []))))
    thread.start()
    thread.join(5)
    assert answer == [3]


def test_a_crashing_observer_is_dropped_and_the_others_continue(caplog: pytest.LogCaptureFixture) -> None:
    calls: list[int] = []
    seen: list[Progress] = []

    def crashing(progress: Progress) -> None:
        calls.append(progress.done)
        raise ZeroDivisionError("plot failed")

    with caplog.at_level(logging.ERROR):
        assert run(counting(3, []), observers=(crashing, seen.append)) == 3
    assert calls == [1]
    assert len(seen) == 3
    assert "plot failed" in caplog.text


def test_an_observer_that_exits_the_program_still_lets_the_procedure_clear_up() -> None:
    log: list[str] = []

    def leaving(progress: Progress) -> None:
        raise SystemExit(4)

    with pytest.raises(SystemExit):
        run(counting(3, log), observers=(leaving,))
    assert log == ["clean"]


def test_errors_of_the_procedure_come_out_unchanged() -> None:
    lost = DeviceLost("dm", "cable out")

    def failing() -> Procedure[None]:
        yield Progress("start", 0, 1)
        raise lost

    with pytest.raises(DeviceLost) as caught:
        run(failing())
    assert caught.value is lost


def test_a_device_fault_during_clean_up_after_an_abort_is_raised() -> None:
    abort = threading.Event()

    def failing() -> Procedure[None]:
        try:
            while True:
                yield Progress("work", 0, 0)
        finally:
            raise DeviceLost("dm", "not flat")

    with pytest.raises(DeviceLost, match="not flat") as caught:
        run(failing(), abort=abort, observers=(lambda _: abort.set(),))
    assert isinstance(caught.value.__context__, Aborted)


@pytest.mark.parametrize(
    ("done", "total", "elapsed", "fraction", "remaining"),
    [(0, 10, 1.0, 0.0, math.nan), (5, 10, 1.0, 0.5, 1.0), (10, 10, 2.0, 1.0, 0.0), (12, 10, 2.0, 1.0, 0.0)],
)
def test_progress_arithmetic(
    done: int, total: int, elapsed: float, fraction: float, remaining: float
) -> None:
    progress = Progress("s", done, total, elapsed_s=elapsed)
    assert progress.fraction == fraction
    assert progress.remaining_s == pytest.approx(remaining, nan_ok=True)


def test_progress_without_a_total_is_complete() -> None:
    assert Progress("s", 0, 0).fraction == 1.0


def test_reporter_is_due_at_once_and_then_at_most_twenty_times_a_second(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    now = 100.0
    clock: Any = lambda: now  # noqa: E731
    monkeypatch.setattr("escape_hw.api.procedure.time.monotonic", clock)
    report = Reporter("frames", 1000)
    yielded = []
    for frame in range(1000):
        if report.is_due():
            yielded.append(report(frame, flux=2.0))
        now += 0.002
    assert len(yielded) == pytest.approx(2.0 / Reporter.PERIOD_S, abs=1)
    assert yielded[0].done == 0
    assert yielded[-1].elapsed_s == pytest.approx(yielded[-1].done * 0.002)
    assert yielded[-1].metrics == {"flux": 2.0}
