"""What a deformable mirror promises about limits, failures and its flat shape."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.mirror import DeformableMirror
from escape_hw.errors import CommandRejected, DeviceError, DeviceLost
from escape_hw.testing.checks import FULL, TINY, Check, Factory, check, opened, refused, replaced
from escape_hw.testing.mirror_tools import ROUNDING, breaches, gentle, spied


@check(FULL)
def check_mirror_obeys_its_limits(factory: Factory) -> None:
    """Whatever is asked for, what reaches the device obeys every limit at once."""
    rng = np.random.default_rng(1)
    with opened(factory) as dm:
        n, start = dm.info.n_act, dm.shape
        wild = [size * rng.standard_normal(n) for size in (0.01, 0.3, 1.0, 10.0, 1e300) for _ in range(8)]
        level = [np.full(n, value) for value in (5.0, -5.0, 1.0, -1e308)]
        checkers = [np.where(np.arange(n) % 2, value, -value) for value in (1.0, -2.0)]
        with spied(dm) as reached:
            for command in (*wild, *level, *checkers):
                report = dm.send(command)
                assert np.array_equal(reached[-1], report.sent), "report.sent is not what reached the device"
        for before, after in pairwise([start, *reached]):
            broken = breaches(dm, before, after)
            assert not broken, f"what reached the device breaks its limits: {'; '.join(broken)}"


@check(FULL)
def check_mirror_reports_clipping(factory: Factory) -> None:
    """A command beyond the stroke is clipped, and the report and the counter say so."""
    with opened(factory) as dm:
        dm.flatten()
        command = np.zeros(dm.info.n_act)
        poked = int(np.flatnonzero(gentle(dm) != dm.flat)[0])
        command[poked] = 5.0
        report = dm.send(command)
        assert report.guard.clipped == 1, (
            f"one actuator was beyond the stroke, the report says {report.guard}"
        )
        assert not report.guard.untouched, "the report says that nothing was changed"
        assert dm.clipped_count == 1, f"clipped_count is {dm.clipped_count} after one clipped actuator"


@check(TINY)
def check_mirror_failed_transfer_keeps_shape(factory: Factory) -> None:
    """When a transfer fails, the error comes out and the last good shape stays the last."""
    with opened(factory) as dm:
        dm.flatten()
        shape, sent, command = dm.shape, dm.sent_count, gentle(dm)
        with replaced(dm, "_send", _losing(dm)):
            refused(dm, DeviceLost, "a transfer that fails", dm.send, command)
            assert np.array_equal(dm.shape, shape), "the transfer failed, but the shape changed"
            assert dm.sent_count == sent, "the transfer failed, but sent_count rose"
        dm.send(command)
        assert np.array_equal(dm.shape, command), "no command passes after one failed transfer"


@check(TINY)
def check_mirror_flattens(factory: Factory) -> None:
    """``flatten`` works just after ``open``, after a poke and after a rejected command."""
    with opened(factory) as dm, spied(dm) as reached:
        dm.flatten()
        known = dm._present_shape() is not None  # noqa: SLF001 - only then may flatten() send nothing
        assert reached or known, "flatten() after open() sent nothing; the mirror may have any shape"
        assert np.array_equal(dm.shape, dm.flat), "flatten() after open() did not end at flat"
        for rejected in (False, True):
            dm.send(gentle(dm))
            if rejected:
                command = np.full(dm.info.n_act, np.nan)
                refused(dm, CommandRejected, "a command of NaN", dm.send, command)
            dm.flatten()
            assert np.array_equal(reached[-1], dm.flat), "flatten() did not end at flat"
            assert np.array_equal(dm.shape, dm.flat), "shape is not flat after flatten()"


@check(TINY)
def check_mirror_flat_can_be_set(factory: Factory) -> None:
    """A legal flat is kept and reached; an illegal one is refused and changes nothing."""
    with opened(factory) as dm:
        dm.flatten()
        chosen = gentle(dm)
        dm.set_flat(chosen)
        too_far = np.full(dm.info.n_act, 1.5)
        for what, command in (("NaN", np.full(dm.info.n_act, np.nan)), ("1.5 full strokes", too_far)):
            refused(dm, CommandRejected, f"a flat of {what}", dm.set_flat, command)
        assert np.array_equal(dm.flat, chosen), "flat is not what set_flat() was given"
        assert not np.array_equal(dm.shape, chosen), "set_flat() moved the mirror; flatten() does that"
        dm.flatten()
        assert np.array_equal(dm.shape, chosen), "flatten() did not go to the flat that was set"


@check(FULL)
def check_mirror_ramps_to_flat(factory: Factory) -> None:
    """``flatten`` comes back from the end of the range in small steps, each legal."""
    with opened(factory) as dm:
        gentle(dm)  # skips when no actuator may move
        shape = _far_out(dm)
        with spied(dm) as reached:
            dm.flatten()
            assert np.array_equal(reached[-1], dm.flat), "flatten() did not end at flat"
            for before, after in pairwise([shape, *reached]):
                step = float(np.abs(after - before).max())
                assert step <= dm.RAMP_STEP + ROUNDING, (
                    f"flatten() jumped by {step:.3g} of full stroke; RAMP_STEP is {dm.RAMP_STEP}"
                )
                broken = breaches(dm, before, after)
                assert not broken, f"flatten() broke the limits on its way: {'; '.join(broken)}"


@check(TINY)
def check_mirror_is_flat_when_closed(factory: Factory) -> None:
    """The last thing that reaches the device before it is disconnected is flat."""
    with opened(factory) as dm:
        dm.send(gentle(dm))
        flat = dm.flat
        with spied(dm) as reached:
            disconnect, at_the_end = dm._close, []  # noqa: SLF001 - see what was sent by then

            def closing() -> None:
                at_the_end.extend(reached[-1:])
                disconnect()

            with replaced(dm, "_close", closing):
                dm.close()
        assert at_the_end, "close() sent nothing; the mirror was left poked"
        assert np.array_equal(at_the_end[0], flat), "the mirror was not flat when it was disconnected"


@check(TINY)
def check_mirror_closes_when_lost(factory: Factory) -> None:
    """A mirror that cannot be flattened any more is closed all the same, and the cause comes out."""
    with opened(factory) as dm:
        dm.send(gentle(dm))
        with replaced(dm, "_send", _losing(dm)):
            refused(dm, DeviceLost, "close() of a mirror that was lost", dm.close)
        assert not dm.is_open, "still open after close()"
        dm.open()
        dm.flatten()
        assert np.array_equal(dm.shape, dm.flat), "it cannot be used again once it is back"
        dm.send(gentle(dm))
        try:
            with replaced(dm, "_send", _losing(dm)), dm:
                raise DeviceError(dm.name, "the first cause")
        except DeviceError as error:
            assert "the first cause" in str(error), f"close() hid the first cause behind: {error}"


def _losing(dm: DeformableMirror) -> Callable[[NDArray[np.float64]], None]:
    def transfer(command: NDArray[np.float64]) -> None:
        raise DeviceLost(dm.name, "unplugged by the check")

    return transfer


def _far_out(dm: DeformableMirror) -> NDArray[np.float64]:
    """Send a smooth shape again and again until the mirror is as far out as it will go."""
    target = np.linspace(-1.0, 1.0, dm.info.n_act)
    for _ in range(1000):
        before = dm.shape
        dm.send(target)
        if np.allclose(dm.shape, before, atol=ROUNDING):
            break
    return dm.shape


SAFETY: tuple[Check, ...] = (
    check_mirror_obeys_its_limits,
    check_mirror_reports_clipping,
    check_mirror_failed_transfer_keeps_shape,
    check_mirror_flattens,
    check_mirror_flat_can_be_set,
    check_mirror_ramps_to_flat,
    check_mirror_is_flat_when_closed,
    check_mirror_closes_when_lost,
)
