"""Contract checks of deformable mirrors: commands, limits, counters and flattening."""

from __future__ import annotations

import math
import unittest
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.mirror import DeformableMirror, DMInfo
from escape_hw.errors import CommandRejected, DeviceError, DeviceLost
from escape_hw.safety.limits import MirrorLimits, nearest_pairs, neighbour_pairs
from escape_hw.testing.checks import FULL, READS, TINY, assert_identified, assert_refused, check, replace_hook

#: Tolerance for rounding, fraction of full stroke.
ROUNDING = 1e-9


def small_poke(dm: DeformableMirror) -> NDArray[np.float64]:
    """The flat shape with one enabled actuator poked; legal from flat under any limits."""
    lim, flat = dm.limits, dm.flat
    enabled = np.setdiff1d(np.arange(flat.size), lim.disabled)
    if not enabled.size:
        raise unittest.SkipTest(f"{dm.name}: every actuator is disabled")
    bounds = (lim.max_stroke, lim.max_slew, lim.max_neighbour, lim.max_mean, lim.max_abs_sum)
    size = min(0.01, *(0.5 * bound for bound in bounds if bound is not None))
    chosen = enabled[np.abs(flat[enabled]).argmin()]
    flat[chosen] += -size if flat[chosen] > 0 else size
    return flat


@contextmanager
def record_transfers(dm: DeformableMirror) -> Iterator[list[NDArray[np.float64]]]:
    """Record every command accepted by the device, in order, with the numbering of the layout."""
    reached: list[NDArray[np.float64]] = []
    transfer = dm._send

    def record(command: NDArray[np.float64]) -> NDArray[np.float64] | None:
        assert command.dtype == np.float64, f"the driver received {command.dtype}, not float64"
        assert command.flags.c_contiguous, "the driver received a command that is not contiguous"
        assert command.shape == (dm.info.n_act,), f"the driver received shape {command.shape}"
        kept = transfer(command)
        if kept is None:
            reached.append(dm._from_hardware(command).copy())
        return kept

    with replace_hook(dm, "_send", record):
        yield reached


def limit_violations(
    dm: DeformableMirror, before: NDArray[np.float64], after: NDArray[np.float64]
) -> list[str]:
    """Limits violated by a step between two shapes, computed independently of the guard."""
    lim, found = dm.limits, []
    if not np.isfinite(after).all():
        found.append("a value is not finite")
    if np.abs(after).max() > lim.max_stroke:
        found.append(f"stroke {np.abs(after).max():.6g} > {lim.max_stroke}")
    if any(after[i] != 0 for i in lim.disabled):
        found.append(f"a disabled actuator of {lim.disabled} moved")
    if lim.max_slew is not None and np.abs(after - before).max() > lim.max_slew + ROUNDING:
        found.append(f"slew {np.abs(after - before).max():.6g} > {lim.max_slew}")
    enabled = np.setdiff1d(np.arange(after.size), lim.disabled)
    if lim.max_mean is not None and enabled.size and abs(after[enabled].mean()) > lim.max_mean + ROUNDING:
        found.append(f"mean {after[enabled].mean():.6g} > {lim.max_mean}")
    if lim.max_abs_sum is not None and np.abs(after).sum() > lim.max_abs_sum + ROUNDING:
        found.append(f"sum of magnitudes {np.abs(after).sum():.6g} > {lim.max_abs_sum}")
    if lim.max_neighbour is not None:
        layout = dm.info.layout
        pairs = nearest_pairs(dm.info.positions_m) if layout is None else neighbour_pairs(layout)
        steps = [abs(after[a] - after[b]) for a, b in pairs]
        if max(steps, default=0.0) > lim.max_neighbour + ROUNDING:
            found.append(f"neighbours differ by {max(steps):.6g} > {lim.max_neighbour}")
    return found


@check(DeformableMirror, FULL)
def check_mirror_obeys_its_limits(dm: DeformableMirror) -> None:
    """Every command that reaches the device obeys every limit."""
    rng = np.random.default_rng(1)
    n, start = dm.info.n_act, dm.shape
    wild = [size * rng.standard_normal(n) for size in (0.01, 0.3, 1.0, 10.0, 1e300) for _ in range(8)]
    level = [np.full(n, value) for value in (5.0, -5.0, 1.0, -1e308)]
    checkers = [np.where(np.arange(n) % 2, value, -value) for value in (1.0, -2.0)]
    with record_transfers(dm) as reached:
        for command in (*wild, *level, *checkers):
            report = dm.send(command)
            assert np.array_equal(reached[-1], report.sent), "report.sent is not what reached the device"
    for before, after in pairwise([start, *reached]):
        broken = limit_violations(dm, before, after)
        assert not broken, f"a command that reached the device violates its limits: {'; '.join(broken)}"


@check(DeformableMirror, FULL)
def check_mirror_reports_clipping(dm: DeformableMirror) -> None:
    """A command beyond the stroke is clipped, reported and counted."""
    dm.flatten()
    command = np.zeros(dm.info.n_act)
    poked = int(np.flatnonzero(small_poke(dm) != dm.flat)[0])
    command[poked] = 5.0
    report = dm.send(command)
    assert report.guard.clipped == 1, f"one actuator exceeded the stroke, but the report is {report.guard}"
    assert not report.guard.is_unchanged, "report.guard.is_unchanged is true for a clipped command"
    assert dm.clipped_count == 1, f"clipped_count is {dm.clipped_count} after one clipped actuator"


@check(DeformableMirror, TINY)
def check_mirror_failed_transfer_keeps_shape(dm: DeformableMirror) -> None:
    """A failed transfer raises and keeps the last shape."""
    dm.flatten()
    shape, sent, command = dm.shape, dm.sent_count, small_poke(dm)
    with replace_hook(dm, "_send", _failing_transfer(dm)):
        assert_refused(dm, DeviceLost, "a transfer that fails", dm.send, command)
        assert np.array_equal(dm.shape, shape), "the transfer failed, but the shape changed"
        assert dm.sent_count == sent, "the transfer failed, but sent_count increased"
    dm.send(command)
    assert np.array_equal(dm.shape, command), "a command after a failed transfer was not sent"


@check(DeformableMirror, TINY)
def check_mirror_flattens(dm: DeformableMirror) -> None:
    """``flatten`` works just after ``open``, after a poke and after a rejected command."""
    with record_transfers(dm) as reached:
        dm.flatten()
        known = dm._present_shape() is not None
        assert reached or known, "flatten() after open() sent nothing, although the shape is unknown"
        assert np.array_equal(dm.shape, dm.flat), "flatten() after open() did not end at flat"
        for rejected in (False, True):
            dm.send(small_poke(dm))
            if rejected:
                command = np.full(dm.info.n_act, np.nan)
                assert_refused(dm, CommandRejected, "a command of NaN", dm.send, command)
            dm.flatten()
            assert np.array_equal(reached[-1], dm.flat), "flatten() did not end at flat"
            assert np.array_equal(dm.shape, dm.flat), "shape is not flat after flatten()"


@check(DeformableMirror, TINY)
def check_mirror_flat_can_be_set(dm: DeformableMirror) -> None:
    """A legal flat command is stored and reached; an illegal one is rejected."""
    dm.flatten()
    chosen = small_poke(dm)
    dm.set_flat(chosen)
    too_far = np.full(dm.info.n_act, 1.5)
    for what, command in (("NaN", np.full(dm.info.n_act, np.nan)), ("1.5 full strokes", too_far)):
        assert_refused(dm, CommandRejected, f"a flat of {what}", dm.set_flat, command)
    assert np.array_equal(dm.flat, chosen), "flat differs from the argument of set_flat()"
    assert not np.array_equal(dm.shape, chosen), "set_flat() moved the mirror"
    dm.flatten()
    assert np.array_equal(dm.shape, chosen), "flatten() did not go to the command of set_flat()"


@check(DeformableMirror, FULL)
def check_mirror_ramps_to_flat(dm: DeformableMirror) -> None:
    """``flatten`` returns from the end of the range in small, legal steps."""
    small_poke(dm)  # skips when no actuator may move
    shape = _drive_to_limit(dm)
    with record_transfers(dm) as reached:
        dm.flatten()
        assert np.array_equal(reached[-1], dm.flat), "flatten() did not end at flat"
        for before, after in pairwise([shape, *reached]):
            step = float(np.abs(after - before).max())
            assert step <= dm.RAMP_STEP + ROUNDING, (
                f"flatten() jumped by {step:.3g} of full stroke; RAMP_STEP is {dm.RAMP_STEP}"
            )
            broken = limit_violations(dm, before, after)
            assert not broken, f"flatten() violated the limits: {'; '.join(broken)}"


@check(DeformableMirror, TINY)
def check_mirror_is_flat_when_closed(dm: DeformableMirror) -> None:
    """The last command before disconnection is flat."""
    dm.send(small_poke(dm))
    flat = dm.flat
    with record_transfers(dm) as reached:
        disconnect, state_at_close = dm._close, []

        def record_and_close() -> None:
            state_at_close.extend(reached[-1:])
            disconnect()

        with replace_hook(dm, "_close", record_and_close):
            dm.close()
    assert state_at_close, "close() sent nothing; the mirror is still poked"
    assert np.array_equal(state_at_close[0], flat), "the mirror was not flat at disconnection"


@check(DeformableMirror, TINY)
def check_mirror_closes_when_lost(dm: DeformableMirror) -> None:
    """A mirror that cannot be flattened is closed, and the cause is raised."""
    dm.send(small_poke(dm))
    with replace_hook(dm, "_send", _failing_transfer(dm)):
        assert_refused(dm, DeviceLost, "close() of a mirror that was lost", dm.close)
    assert not dm.is_open, "still open after close()"
    dm.open()
    dm.flatten()
    assert np.array_equal(dm.shape, dm.flat), "the mirror cannot be used again after reopening"
    dm.send(small_poke(dm))
    try:
        with replace_hook(dm, "_send", _failing_transfer(dm)), dm:
            raise DeviceError(dm.name, "the first cause")
    except DeviceError as error:
        assert "the first cause" in str(error), f"close() replaced the first exception by: {error}"


def _failing_transfer(dm: DeformableMirror) -> Callable[[NDArray[np.float64]], None]:
    def transfer(command: NDArray[np.float64]) -> None:
        raise DeviceLost(dm.name, "unplugged by the check")

    return transfer


def _drive_to_limit(dm: DeformableMirror) -> NDArray[np.float64]:
    """Repeat a large smooth shape until the mirror moves no further."""
    target = np.linspace(-1.0, 1.0, dm.info.n_act)
    for _ in range(1000):
        before = dm.shape
        dm.send(target)
        if np.allclose(dm.shape, before, atol=ROUNDING):
            break
    return dm.shape


@check(DeformableMirror, READS)
def check_mirror_info_is_complete(dm: DeformableMirror) -> None:
    """Identity and geometry are complete and consistent."""
    info = dm.info
    assert_identified(info, DMInfo)
    assert info.serial, "info.serial is empty; products need it"
    assert info.n_act >= 1, f"info.n_act is {info.n_act}"
    assert 0 < info.stroke_m < 1 or math.isnan(info.stroke_m), (
        f"info.stroke_m is {info.stroke_m}; the unit is metres of surface, NaN if it is not known"
    )
    assert isinstance(dm.limits, MirrorLimits), f"limits is {type(dm.limits).__name__}"
    _require_geometry(info)


def _require_geometry(info: DMInfo) -> None:
    positions = info.positions_m
    assert positions.shape == (info.n_act, 2), (
        f"positions_m has shape {positions.shape} for {info.n_act} actuators"
    )
    assert np.isfinite(positions).all(), "positions_m has values that are not finite"
    assert len(np.unique(positions, axis=0)) == info.n_act, "two actuators have the same position"
    if info.layout is None:
        return
    assert info.layout.dtype == bool, f"layout has type {info.layout.dtype}; it must be bool"
    assert info.layout.ndim == 2, f"layout has shape {info.layout.shape}; it must be a map"
    n_layout = int(info.layout.sum())
    assert n_layout == info.n_act, f"layout has {n_layout} positions for {info.n_act} actuators"
    rows, columns = np.nonzero(info.layout)
    for axis, name, number in ((0, "x", columns), (1, "y", rows)):
        levels = [positions[number == k, axis] for k in np.unique(number)]
        ordered = all(a.max() < b.min() for a, b in pairwise(levels))
        assert ordered, f"{name} of positions_m does not increase along the layout; is it row-major?"


@check(DeformableMirror, READS)
def check_mirror_refuses_not_finite(dm: DeformableMirror) -> None:
    """A command with a NaN or infinity is rejected, and the message gives its index."""
    n_act = dm.info.n_act
    for value, index in ((np.nan, n_act - 1), (np.inf, 0), (-np.inf, n_act // 2)):
        command = np.zeros(n_act)
        command[index] = value
        refusal = _assert_rejected(dm, command, f"a command with {value} at actuator {index}")
        assert f"actuator {index} " in f"{refusal} ", f"the message does not give index {index}: {refusal}"


@check(DeformableMirror, READS)
def check_mirror_refuses_wrong_shape(dm: DeformableMirror) -> None:
    """A command of any shape but ``(n_act,)`` is rejected."""
    n = dm.info.n_act
    for shape in ((n + 1,), (n - 1,), (n, 1), (1, n), (0,), ()):
        _assert_rejected(dm, np.zeros(shape), f"a command of shape {shape}")


@check(DeformableMirror, READS)
def check_mirror_refuses_wrong_type(dm: DeformableMirror) -> None:
    """Anything but real numbers raises ``CommandRejected``, not an exception of numpy."""
    n = dm.info.n_act
    wrong: dict[str, Any] = {
        "bool": np.zeros(n, dtype=bool),
        "complex": np.zeros(n, dtype=complex),
        "object": np.array([0.0] * n, dtype=object),
        "text": np.array(["0"] * n),
        "ragged": [[0.0, 0.0], [0.0], *([0.0] for _ in range(n - 2))],
        "None": None,
        "dictionary": {"command": 0.0},
        "masked": np.ma.masked_array(np.zeros(n), mask=True),
    }
    for kind, command in wrong.items():
        _assert_rejected(dm, command, f"a command of kind {kind}")


def _assert_rejected(dm: DeformableMirror, command: Any, what: str) -> CommandRejected:
    """Require that ``command`` is rejected and counted and changes nothing else."""
    shape, sent, rejected = dm.shape, dm.sent_count, dm.rejected_count
    refusal = assert_refused(dm, CommandRejected, what, dm.send, command)
    assert np.array_equal(dm.shape, shape), f"{what}: rejected, but the shape changed"
    assert dm.sent_count == sent, f"{what}: rejected, but sent_count increased"
    assert dm.rejected_count == rejected + 1, (
        f"{what}: rejected_count went from {rejected} to {dm.rejected_count}"
    )
    return refusal


@check(DeformableMirror, TINY)
def check_mirror_sends_legal_commands_unchanged(dm: DeformableMirror) -> None:
    """A legal command is sent unchanged."""
    dm.flatten()
    command = small_poke(dm)
    report = dm.send(command)
    assert report.guard.is_unchanged, f"a legal command was changed: {report.guard}"
    assert np.array_equal(report.sent, command), "report.sent differs from the command"
    assert np.array_equal(dm.shape, command), "shape differs from the command"


@check(DeformableMirror, TINY)
def check_mirror_takes_any_real_array(dm: DeformableMirror) -> None:
    """Lists, float32, integers, strided and read-only arrays are accepted."""
    dm.flatten()
    plain = small_poke(dm)
    strided = np.repeat(plain, 2)[::2]
    read_only = plain.copy()
    read_only.setflags(write=False)
    single = plain.astype(np.float32)
    kinds: dict[str, tuple[Any, NDArray[np.float64]]] = {
        "strided": (strided, plain),
        "read-only": (read_only, plain),
        "list": (plain.tolist(), plain),
        "float32": (single, single.astype(np.float64)),
        "big-endian": (plain.astype(">f8"), plain),
        "integers": (np.zeros(plain.size, dtype=np.int8), np.zeros(plain.size)),
    }
    for kind, (command, expected) in kinds.items():
        sent = dm.send(command).sent
        assert sent.dtype == np.float64, f"{kind}: sent as {sent.dtype}, not float64"
        if dm.limits.max_slew is None:
            assert np.array_equal(sent, expected), f"{kind}: another command was sent"


@check(DeformableMirror, TINY)
def check_mirror_shares_no_memory(dm: DeformableMirror) -> None:
    """Arrays of the caller and returned arrays share no memory with the mirror."""
    dm.flatten()
    command = small_poke(dm)
    kept = command.copy()
    report = dm.send(command)
    assert np.array_equal(command, kept), "send() changed the array of the caller"
    command[:] = 0.5
    assert np.array_equal(dm.shape, kept), "the mirror stored the array of the caller instead of a copy"
    assert not report.sent.flags.writeable, "report.sent is writable; the guard relies on it"
    for name, answer in (("shape", dm.shape), ("flat", dm.flat)):
        before = answer.copy()
        answer += 0.25
        assert np.array_equal(getattr(dm, name), before), f"writing into {name} changed the mirror"


@check(DeformableMirror, TINY)
def check_mirror_counts(dm: DeformableMirror) -> None:
    """The counters start at ``open`` and count each send once."""
    counts = (dm.sent_count, dm.clipped_count, dm.rejected_count)
    assert counts == (0, 0, 0), f"the counters are {counts} after open(), not 0"
    command = small_poke(dm)
    for n in range(1, 4):
        dm.send(command)
        assert dm.sent_count == n, f"sent_count is {dm.sent_count} after {n} sends"
    assert dm.clipped_count == 0, f"clipped_count is {dm.clipped_count}, but nothing was clipped"
    assert dm.rejected_count == 0, f"rejected_count is {dm.rejected_count}, but nothing was rejected"


@check(DeformableMirror, TINY)
def check_mirror_times_its_sends(dm: DeformableMirror) -> None:
    """``sent_ns`` is on the clock of the mirror."""
    command = small_poke(dm)
    for _ in range(3):
        before = dm.now_ns()
        sent_ns = dm.send(command).sent_ns
        after = dm.now_ns()
        assert before <= sent_ns <= after, f"sent_ns is {sent_ns}, outside {before} to {after} ns"
