"""After a procedure of one's own that leaves the mirror poked, the mirror is flat."""

from __future__ import annotations

import numpy as np
import pytest
from small_bench import assert_flat, small

from escape_hw.api.procedure import Progress
from escape_hw.errors import Aborted, CalibrationError, DeviceError


def poke(bench):
    bench.dm.send(np.full(bench.dm.info.n_act, 0.02))
    yield Progress("poke", 1, 1)
    return "done"


def fail(bench):
    yield from poke(bench)
    raise CalibrationError("nothing found")


def stop(bench):
    yield from poke(bench)
    raise KeyboardInterrupt


def test_it_ends() -> None:
    with small() as bench:
        assert bench.run(poke(bench)) == "done"
        assert_flat(bench)


@pytest.mark.parametrize(("procedure", "error"), [(stop, Aborted), (fail, CalibrationError)])
def test_it_fails_or_is_stopped(procedure, error) -> None:
    with small() as bench:
        with pytest.raises(error):
            bench.run(procedure(bench))
        assert_flat(bench)


def test_the_error_of_the_procedure_is_raised_where_the_mirror_fails_too(monkeypatch, caplog) -> None:
    with small() as bench, monkeypatch.context() as patched:

        def refuse():
            raise DeviceError("dm", "no power")

        patched.setattr(bench, "_leave_flat", refuse)
        with pytest.raises(CalibrationError):
            bench.run(fail(bench))
    assert "could NOT be made flat: dm: no power" in caplog.text
