"""Every check on mirrors fails on a mirror that violates only the checked rule."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import Any

import numpy as np
from broken import Broken

from escape_hw.api.mirror import DeformableMirror, DMInfo, SendReport
from escape_hw.errors import CommandRejected
from escape_hw.safety.guard import GuardReport
from escape_hw.testing.reference_devices import RecordingMirror


def info_of(**changes: Any) -> property:
    """Make an ``info`` that differs from the reference mirror's."""
    return property(lambda self: replace(RecordingMirror().info, **changes))


def unguarded(self: Any, command: Any) -> Any:
    """Send without any guard, as a driver that overrides ``send`` might."""
    self.require_open()
    shape = np.asarray(command, dtype=float)
    self._send(shape)
    self._guard.last = shape
    self.sent_count += 1
    return SendReport(shape, self.now_ns(), GuardReport())


def knocks_first(self: Any, command: Any) -> Any:
    """Send the requested command, then the one limited by the guard."""
    self.require_open()
    self._send(np.real(np.asarray(command)).astype(float))
    return DeformableMirror.send(self, command)


def repairs_nan(self: Any, command: Any) -> Any:
    return DeformableMirror.send(self, np.nan_to_num(command))


def names_no_index(self: Any, command: Any) -> Any:
    try:
        return DeformableMirror.send(self, command)
    except CommandRejected:
        raise CommandRejected(self.name, "bad command") from None


def flattens_shape(self: Any, command: Any) -> Any:
    self.require_open()
    command = np.resize(np.asarray(command), self.info.n_act)
    return DeformableMirror.send(self, command)


def converts_type(self: Any, command: Any) -> Any:
    self.require_open()
    return DeformableMirror.send(self, np.array(command, dtype=float))


def halves(self: Any, command: Any) -> Any:
    return DeformableMirror.send(self, 0.5 * np.asarray(command))


def only_arrays(self: Any, command: Any) -> Any:
    if not isinstance(command, np.ndarray):
        raise CommandRejected(self.name, "give an array")
    return DeformableMirror.send(self, command)


def keeps_reference(self: Any, command: Any) -> Any:
    report = DeformableMirror.send(self, command)
    self._guard.last = command
    return report


def writable_report(self: Any, command: Any) -> Any:
    report = DeformableMirror.send(self, command)
    return replace(report, sent=report.sent.copy())


def counts_twice(self: Any, command: Any) -> Any:
    report = DeformableMirror.send(self, command)
    self.sent_count += 1
    return report


def on_another_clock(self: Any, command: Any) -> Any:
    return replace(DeformableMirror.send(self, command), sent_ns=time.time_ns())


def beyond_the_guard(self: Any) -> None:
    DeformableMirror._after_open(self)
    self._guard.is_legal = lambda shape: True


def keeps_quiet(self: Any, command: Any) -> Any:
    report = DeformableMirror.send(self, command)
    return replace(report, guard=GuardReport())


def accepts_first(self: Any, command: Any) -> Any:
    safe, _ = self._guard_when_open()(command)
    self._guard.reset(self._guard.last)
    return DeformableMirror.send(self, safe)


def jumps_to_flat(self: Any) -> None:
    if (self.shape != self.flat).any() or not self.sent_count:
        DeformableMirror.send(self, self.flat)


def lazy_flatten(self: Any) -> None:
    if (self.shape != self.flat).any():
        DeformableMirror.flatten(self)


def any_flat(self: Any, command: Any) -> None:
    self._flat = np.asarray(command, dtype=float)


def leaks_on_failure(self: Any) -> None:
    self._before_close()
    self._close()
    self._is_open = False


def hides_the_cause(self: Any, *error: Any) -> None:
    self.close()


def swapped(self: Any) -> DMInfo:
    info = RecordingMirror().info
    return replace(info, positions_m=info.positions_m[:, ::-1])


BROKEN: list[Broken] = [
    ("no serial", RecordingMirror, "mirror_info_is_complete", {"info": info_of(serial="")}),
    (
        "too few places",
        RecordingMirror,
        "mirror_info_is_complete",
        {"info": info_of(positions_m=np.zeros((3, 2)))},
    ),
    ("x and y swapped", RecordingMirror, "mirror_info_is_complete", {"info": property(swapped)}),
    ("stroke in microns", RecordingMirror, "mirror_info_is_complete", {"info": info_of(stroke_m=2.2)}),
    ("repairs NaN", RecordingMirror, "mirror_refuses_not_finite", {"send": repairs_nan}),
    ("names no index", RecordingMirror, "mirror_refuses_not_finite", {"send": names_no_index}),
    ("takes any shape", RecordingMirror, "mirror_refuses_wrong_shape", {"send": flattens_shape}),
    ("takes any type", RecordingMirror, "mirror_refuses_wrong_type", {"send": converts_type}),
    ("sends half", RecordingMirror, "mirror_sends_legal_commands_unchanged", {"send": halves}),
    ("no lists", RecordingMirror, "mirror_takes_any_real_array", {"send": only_arrays}),
    ("keeps a reference", RecordingMirror, "mirror_shares_no_memory", {"send": keeps_reference}),
    ("writable report", RecordingMirror, "mirror_shares_no_memory", {"send": writable_report}),
    ("counts twice", RecordingMirror, "mirror_counts", {"send": counts_twice}),
    ("another clock", RecordingMirror, "mirror_times_its_sends", {"send": on_another_clock}),
    ("no guard", RecordingMirror, "mirror_obeys_its_limits", {"send": unguarded}),
    ("knocks first", RecordingMirror, "mirror_obeys_its_limits", {"send": knocks_first}),
    ("guard switched off", RecordingMirror, "mirror_obeys_its_limits", {"_after_open": beyond_the_guard}),
    ("keeps quiet", RecordingMirror, "mirror_reports_clipping", {"send": keeps_quiet}),
    ("believes too early", RecordingMirror, "mirror_failed_transfer_keeps_shape", {"send": accepts_first}),
    ("lazy flatten", RecordingMirror, "mirror_flattens", {"flatten": lazy_flatten}),
    ("takes any flat", RecordingMirror, "mirror_flat_can_be_set", {"set_flat": any_flat}),
    ("jumps to flat", RecordingMirror, "mirror_ramps_to_flat", {"flatten": jumps_to_flat}),
    ("closes poked", RecordingMirror, "mirror_is_flat_when_closed", {"_before_close": lambda self: None}),
    ("stays open when lost", RecordingMirror, "mirror_closes_when_lost", {"close": leaks_on_failure}),
    ("hides the cause", RecordingMirror, "mirror_closes_when_lost", {"__exit__": hides_the_cause}),
]
