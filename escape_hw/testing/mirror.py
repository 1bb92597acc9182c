"""What a deformable mirror promises about commands, copies, counters and clocks."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.mirror import DeformableMirror, DMInfo
from escape_hw.errors import CommandRejected
from escape_hw.safety.limits import MirrorLimits
from escape_hw.testing.checks import READS, TINY, Check, Factory, check, opened, refused, up_to
from escape_hw.testing.common import COMMON
from escape_hw.testing.mirror_safety import SAFETY
from escape_hw.testing.mirror_tools import gentle


@check(READS)
def check_mirror_info_is_complete(factory: Factory) -> None:
    """Identity and geometry are there, and agree with each other."""
    with opened(factory) as dm:
        info = dm.info
        assert isinstance(info, DMInfo), f"info is {type(info).__name__}, not DMInfo"
        assert info.model, "info.model is empty"
        assert info.serial, "info.serial is empty; products could not say which mirror they are from"
        assert isinstance(info.simulated, bool), f"info.simulated is {info.simulated!r}, not a bool"
        assert info.n_act >= 1, f"info.n_act is {info.n_act}"
        assert 0 < info.stroke_m < 1, f"info.stroke_m is {info.stroke_m}; metres of surface are meant"
        assert isinstance(dm.limits, MirrorLimits), f"limits is {type(dm.limits).__name__}"
        _require_geometry(info)


def _require_geometry(info: DMInfo) -> None:
    places = info.positions_m
    assert places.shape == (info.n_act, 2), f"positions_m has shape {places.shape} for {info.n_act} actuators"
    assert np.isfinite(places).all(), "positions_m holds values that are not finite"
    assert len(np.unique(places, axis=0)) == info.n_act, "two actuators stand in the same place"
    if info.layout is None:
        return
    assert info.layout.dtype == bool, f"layout has type {info.layout.dtype}; it must be bool"
    assert info.layout.ndim == 2, f"layout has shape {info.layout.shape}; it must be a map"
    n_places = int(info.layout.sum())
    assert n_places == info.n_act, f"layout has {n_places} places for {info.n_act} actuators"
    rows, columns = np.nonzero(info.layout)
    for axis, name, number in ((0, "x", columns), (1, "y", rows)):
        levels = [places[number == k, axis] for k in np.unique(number)]
        ordered = all(a.max() < b.min() for a, b in pairwise(levels))
        assert ordered, f"{name} of positions_m does not rise with the layout; is the numbering row by row?"


@check(READS)
def check_mirror_refuses_not_finite(factory: Factory) -> None:
    """One NaN or infinity rejects the whole command and names its index."""
    with opened(factory) as dm:
        n_act = dm.info.n_act
        for value, index in ((np.nan, n_act - 1), (np.inf, 0), (-np.inf, n_act // 2)):
            command = np.zeros(n_act)
            command[index] = value
            refusal = _nothing_happens(dm, command, f"a command with {value} at actuator {index}")
            assert f"actuator {index} " in f"{refusal} ", f"the index {index} is not named: {refusal}"


@check(READS)
def check_mirror_refuses_wrong_shape(factory: Factory) -> None:
    """A command of any shape but ``(n_act,)`` is rejected."""
    with opened(factory) as dm:
        n = dm.info.n_act
        for shape in ((n + 1,), (n - 1,), (n, 1), (1, n), (0,), ()):
            _nothing_happens(dm, np.zeros(shape), f"a command of shape {shape}")


@check(READS)
def check_mirror_refuses_wrong_type(factory: Factory) -> None:
    """Anything but real numbers is rejected, and never with an error of numpy's."""
    with opened(factory) as dm:
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
            _nothing_happens(dm, command, f"a command of kind {kind}")


def _nothing_happens(dm: DeformableMirror, command: Any, what: str) -> CommandRejected:
    """Require that ``command`` is rejected, counted, and leaves everything else as it was."""
    shape, sent, rejected = dm.shape, dm.sent_count, dm.rejected_count
    refusal = refused(dm, CommandRejected, what, dm.send, command)
    assert np.array_equal(dm.shape, shape), f"{what}: it was rejected, but the shape changed"
    assert dm.sent_count == sent, f"{what}: it was rejected, but sent_count rose"
    assert dm.rejected_count == rejected + 1, (
        f"{what}: rejected_count went from {rejected} to {dm.rejected_count}"
    )
    return refusal


@check(TINY)
def check_mirror_sends_legal_commands_unchanged(factory: Factory) -> None:
    """What obeys every limit arrives bit for bit."""
    with opened(factory) as dm:
        dm.flatten()
        command = gentle(dm)
        report = dm.send(command)
        assert report.guard.untouched, f"a legal command was changed: {report.guard}"
        assert np.array_equal(report.sent, command), "report.sent is not what was asked for"
        assert np.array_equal(dm.shape, command), "shape is not what was sent"


@check(TINY)
def check_mirror_takes_any_real_array(factory: Factory) -> None:
    """Lists, float32, integers, strided and read-only arrays are commands too."""
    with opened(factory) as dm:
        dm.flatten()
        plain = gentle(dm)
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
        for kind, (command, meant) in kinds.items():
            sent = dm.send(command).sent
            assert sent.dtype == np.float64, f"{kind}: sent as {sent.dtype}, not float64"
            if dm.limits.max_slew is None:
                assert np.array_equal(sent, meant), f"{kind}: the mirror got something else"


@check(TINY)
def check_mirror_shares_no_memory(factory: Factory) -> None:
    """Neither the caller's array nor an answer's can change what the mirror holds."""
    with opened(factory) as dm:
        dm.flatten()
        command = gentle(dm)
        kept = command.copy()
        report = dm.send(command)
        assert np.array_equal(command, kept), "send() wrote into the caller's array"
        command[:] = 0.5
        assert np.array_equal(dm.shape, kept), "the mirror kept the caller's array instead of a copy"
        assert not report.sent.flags.writeable, "report.sent can be written to; the guard relies on it"
        for name, answer in (("shape", dm.shape), ("flat", dm.flat)):
            before = answer.copy()
            answer += 0.25
            assert np.array_equal(getattr(dm, name), before), f"writing into {name} changed the mirror"


@check(TINY)
def check_mirror_counts(factory: Factory) -> None:
    """The counters count from ``open``, each send once."""
    with opened(factory) as dm:
        counts = (dm.sent_count, dm.clipped_count, dm.rejected_count)
        assert counts == (0, 0, 0), f"the counters are {counts} after open(); they count from there"
        command = gentle(dm)
        for n in range(1, 4):
            dm.send(command)
            assert dm.sent_count == n, f"sent_count is {dm.sent_count} after {n} sends"
        assert dm.clipped_count == 0, f"clipped_count is {dm.clipped_count}, but nothing was clipped"
        assert dm.rejected_count == 0, f"rejected_count is {dm.rejected_count}, but all was legal"


@check(TINY)
def check_mirror_times_its_sends(factory: Factory) -> None:
    """``sent_ns`` is on the mirror's own clock, between before and after."""
    with opened(factory) as dm:
        command = gentle(dm)
        for _ in range(3):
            before = dm.now_ns()
            sent_ns = dm.send(command).sent_ns
            after = dm.now_ns()
            assert before <= sent_ns <= after, f"sent at {sent_ns} ns, but between {before} and {after} ns"


MIRROR: tuple[Check, ...] = (
    *COMMON,
    check_mirror_info_is_complete,
    check_mirror_refuses_not_finite,
    check_mirror_refuses_wrong_shape,
    check_mirror_refuses_wrong_type,
    check_mirror_sends_legal_commands_unchanged,
    check_mirror_takes_any_real_array,
    check_mirror_shares_no_memory,
    check_mirror_counts,
    check_mirror_times_its_sends,
    *SAFETY,
)


def mirror_checks(max_level: int = 3) -> list[Check]:
    """Checks for a :class:`~escape_hw.api.mirror.DeformableMirror`.

    Parameters
    ----------
    max_level
        Leave out what moves the mirror more: 0 rests, 1 pokes by a percent, 3 uses the full range.
    """
    return up_to(MIRROR, max_level)
