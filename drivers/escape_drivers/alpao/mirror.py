"""ALPAO deformable mirrors through the vendor's libasdk."""

from __future__ import annotations

import logging
import math
import os
from collections.abc import Callable, Mapping
from copy import copy
from ctypes import c_void_p
from functools import partial
from typing import TYPE_CHECKING, Any, Literal, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field

from escape_drivers.alpao.library import AlpaoLibrary, format_version
from escape_drivers.common.mirror import require_geometry
from escape_drivers.common.options import (
    keywords_of,
    known_layout,
    mirror_settings,
    require_serial,
    section_options,
)
from escape_hw.api.mirror import DeformableMirror, DMInfo
from escape_hw.config.devices import mirror_info
from escape_hw.config.layouts import n_actuators, shorten
from escape_hw.config.options import parse_limits, parse_options
from escape_hw.config.section import Section
from escape_hw.errors import CommandRejected, DeviceError, NotOpen
from escape_hw.safety.limits import CAUTIOUS_LIMITS, MirrorLimits

if TYPE_CHECKING:
    from escape_hw.config.devices import MirrorConfig
    from escape_hw.config.registry import DeviceContext

log = logging.getLogger(__name__)

#: ``TriggerIn`` and ``TriggerMode`` as the SDK numbers them.
_TRIGGER_IN = {"off": 0.0, "rising": 1.0, "falling": 2.0}
_TRIGGER_OUT = {"long": 0.0, "short": 1.0}
#: Folder of the mirrors' configuration files in the SDK.
_CONFIG_VARIABLE = "ACECFG"


class AlpaoOptions(Section):
    """The ``[devices.dm.options]`` of this driver; what is left at its default is not sent, but the trigger.

    Parameters
    ----------
    library
        Path of ``libasdk.so``; empty: ``ESCAPE_ALPAO_LIBRARY``, then the system's loader.
    config_folder
        Folder of the mirror's ``.acfg`` and binary configuration (``ACECFG``).
    sync
        ``"wait"``: a send returns when the electronics have the shape; ``"return"``: after checks.
    ack_timeout_ms
        Longest wait for the electronics' acknowledgement; 0: as the SDK has it.
    trigger_in
        Wait for an edge before each shape. Set at every opening, because the electronics keep what another
        program left; empty: off, if the electronics have triggers.
    trigger_out
        Length of the pulse that goes out with each shape.
    """

    library: str = ""
    config_folder: str = ""
    sync: Literal["", "wait", "return"] = ""
    ack_timeout_ms: int = Field(0, ge=0, le=60_000)
    trigger_in: Literal["", "off", "rising", "falling"] = ""
    trigger_out: Literal["", "long", "short"] = ""

    def sdk_parameters(self) -> list[tuple[str, float]]:
        """Parameters to set after opening, in order."""
        wanted: list[tuple[str, float]] = []
        if self.sync:
            wanted.append(("SyncMode", float(self.sync == "return")))
        if self.ack_timeout_ms:
            wanted.append(("AckTimeout", float(self.ack_timeout_ms)))
        if self.trigger_out:
            wanted.append(("TriggerMode", _TRIGGER_OUT[self.trigger_out]))
        return wanted

    @property
    def is_triggered(self) -> bool:
        """Whether each shape waits for an edge."""
        return self.trigger_in in ("rising", "falling")


class AlpaoMirror(DeformableMirror):
    """An ALPAO mirror. Closing ramps to flat, stops, resets and releases it, in this order.

    Parameters
    ----------
    serial
        Serial number, such as ``"BAX118"``.
    name
        Name in messages.
    layout
        Arrangement of the actuators, see :mod:`escape_hw.config.layouts`; empty: by the number of
        actuators, the only part of the geometry that the SDK reports. If none is known for this number, the
        positions in ``info`` are NaN, and ``max_neighbour`` limits the difference of any two actuators.
    pitch_m
        Distance between actuators, metres.
    stroke_m
        Metres of surface at the actuator for a command of 1; NaN: not known.
    limits
        Limits of every command; a table has those that differ from the cautious ones.
    **options
        Fields of :class:`AlpaoOptions`.

    Raises
    ------
    ConfigError
        The serial number is missing, or geometry, limits or an option is wrong.
    """

    def __init__(
        self,
        serial: str | int,
        *,
        name: str = "alpao",
        layout: str = "",
        pitch_m: float = 1.5e-3,
        stroke_m: float = math.nan,
        limits: MirrorLimits | Mapping[str, Any] = CAUTIOUS_LIMITS,
        **options: Any,
    ) -> None:
        super().__init__(name, parse_limits(name, limits))
        self._serial, self._options = (
            # Configuration files have names in capitals, and the SDK searches for capitals.
            require_serial("serial", serial).upper(),
            parse_options(AlpaoOptions, name, options, keywords_of(type(self))),
        )
        self._layout = require_geometry(name, layout, pitch_m, stroke_m)
        self._pitch_m, self._stroke_m = pitch_m, stroke_m
        self._buffer = np.empty(0)
        self._library: AlpaoLibrary | None = None
        self._handle: c_void_p | None = None
        self._transfer: Callable[[], int] = _raise_not_connected
        self._playing = False
        #: Whether a shape was sent since opening, so that closing has to reset the mirror.
        self._has_moved = False
        self._info = self._build_info(self._layout, "ALPAO mirror", False) if layout else None

    @classmethod
    def from_section(cls, section: MirrorConfig, context: DeviceContext) -> Self:
        """The mirror of ``[devices.dm]``; raises ``ConfigError`` as the class does."""
        options = section_options(AlpaoOptions, context.name, section)
        return cls(**mirror_settings(context.name, section), **options)

    @property
    def info(self) -> DMInfo:
        """Identity and geometry; ``NotOpen`` before ``open`` if no layout was given."""
        if self._info is None:
            raise NotOpen(self.name, "its number of actuators is known once it is open; call open() first")
        return self._info

    @property
    def handle(self) -> c_void_p:
        """The SDK's handle, for calls that this driver does not make; raises ``NotOpen`` when closed."""
        self.require_open()
        return self._require_connected()[1]

    def play_patterns(self, patterns: ArrayLike, repeats: int = 1) -> None:
        """Start a sequence of shapes that the electronics send autonomously; returns at once.

        With ``trigger_in`` each edge brings the next shape. Nothing is clipped here: a sequence that
        breaks a limit anywhere, from the present shape on and from its end to its beginning, is
        refused as a whole. The electronics do not tell which shape they have reached: until the next
        command :attr:`shape` is one of them, and the slew rule is obeyed from all, see
        :meth:`CommandGuard.mark_sequence <escape_hw.safety.guard.CommandGuard.mark_sequence>`.

        Parameters
        ----------
        patterns
            Shapes ``(n_patterns, n_act)``, fractions of full stroke.
        repeats
            How often the sequence is sent; 0: until it is stopped.

        Raises
        ------
        CommandRejected
            A shape is malformed or breaks a limit; nothing is sent.
        NotOpen, DeviceError
            The mirror is not connected, or the transfer failed.
        """
        with self._lock:
            sequence = self._validate_sequence(patterns, repeats)
            in_hardware = np.ascontiguousarray([self._to_hardware(shape) for shape in sequence])
            self._stop_playing()
            library, handle = self._require_connected()
            # The mirror's shape is unknown from here on, also if the call fails: the next flatten() sends.
            self._playing = self._has_moved = True
            self._shape_known = False
            self._guard_when_open().mark_sequence(sequence)
            pointer = c_void_p(in_hardware.ctypes.data)
            library.call("asdkSendPattern", handle, pointer, len(sequence), repeats)

    def _set_trigger(self, trigger_in: str) -> None:
        """Set the trigger's edge; electronics without triggers need no "off"."""
        library, handle = self._require_connected()
        library.set(handle, "TriggerIn", _TRIGGER_IN[trigger_in], if_supported=trigger_in == "off")

    def _before_close(self) -> None:
        """Without the trigger, so that the ramp to flat waits for no edge; first of all, a sequence stops."""
        self._stop_playing(arm_again=False)
        if self._options.is_triggered:
            self._set_trigger("off")
        super()._before_close()

    def stop_pattern(self) -> None:
        """Stop a sequence; the mirror keeps the shape it has. Does nothing when none runs."""
        with self._lock:
            self._guard_when_open()
            self._stop_playing()

    def _open(self) -> None:
        self._playing = self._has_moved = False
        if self._options.config_folder:
            os.environ[_CONFIG_VARIABLE] = self._options.config_folder
        library = self._library = AlpaoLibrary(self.name, self._options.library)
        handle = self._handle = library.init(self._serial)
        n_act = round(library.get(handle, "NbOfActuator"))
        layout = self._layout or known_layout(n_act)
        if not layout:
            log.warning(
                "%s: the arrangement of its %d actuators is not known; max_neighbour limits the difference "
                "of any two of them, and what needs positions is refused; give its layout",
                self.name, n_act,
            )  # fmt: skip
        elif n_act != (wanted := n_actuators(layout)):
            raise DeviceError(
                self.name,
                f"has {n_act} actuators, but the layout {shorten(layout)!r} has {wanted}; "
                "correct layout or serial",
            )
        version = format_version(library.get(handle, "VersionInfo"))
        log.info("%s: SDK %s, mirror %s", self.name, version, self._serial)
        for name, value in self._options.sdk_parameters():
            library.set(handle, name, value)
        self._set_trigger(self._options.trigger_in or "off")
        # A function object of its own without prototype: both arguments are C pointers for good already,
        # and checking them at every call costs as much as the call.
        # The buffer never moves, so its address is made once.
        self._buffer = np.zeros(n_act)
        self._transfer = partial(library.c["asdkSend"], handle, c_void_p(self._buffer.ctypes.data))
        self._info = self._build_info(layout, f"ALPAO mirror, SDK {version}", library.stand_in, n_act)

    def _close(self) -> None:
        library, handle = self._library, self._handle
        self._library = self._handle = None
        self._playing, self._transfer = False, _raise_not_connected
        if library is None or handle is None:
            return
        # After a failed opening, or if nothing could be sent, the mirror keeps the shape that it had.
        for name in (*(("asdkStop", "asdkReset") if self._has_moved else ()), "asdkRelease"):
            try:
                library.call(name, handle)
            except DeviceError as error:
                # The mirror may be disconnected; the remaining steps are still tried.
                log.warning("while closing: %s", error)

    def _release_after_failed_open(self) -> None:
        self._close()

    def _send(self, command: NDArray[np.float64]) -> None:
        if self._playing:
            self._stop_playing()
        self._has_moved = True
        self._buffer[:] = command
        if self._transfer() != 0:
            raise self._require_connected()[0].error_for("asdkSend")

    def _stop_playing(self, *, arm_again: bool = True) -> None:
        if not self._playing:
            return
        library, handle = self._require_connected()
        library.call("asdkStop", handle)
        self._playing = False
        if arm_again and self._options.is_triggered:
            # Users report that a second triggered sequence fails (0x102, 0x104) without this.
            self._set_trigger("off")
            self._set_trigger(self._options.trigger_in)

    def _validate_sequence(self, patterns: ArrayLike, repeats: int) -> list[NDArray[np.float64]]:
        # A copy follows the sequence: a refused one changes nothing that is known of the mirror's shape.
        guard = copy(self._guard_when_open())
        rows = [guard.validate(row) for row in np.asarray(patterns)]
        if not rows or repeats < 0:
            raise CommandRejected(
                self.name, f"{len(rows)} shapes, {repeats} repeats; need one and none below 0"
            )
        cyclic_rows = rows if repeats == 1 else [*rows, rows[0]]
        slew = f"max_slew = {self.limits.max_slew}"
        too_far = f"is further than {slew} from a shape that the mirror may have; flatten() first"
        for number, row in enumerate(cyclic_rows):
            if not guard.is_legal(row):
                why = guard.find_violation(row) or too_far
                raise CommandRejected(self.name, f"shape {number % len(rows)} of the sequence: {why}")
            guard.set_last(row)
            too_far = f"is further from the one before than {slew}"
        return rows

    def _require_connected(self) -> tuple[AlpaoLibrary, c_void_p]:
        if self._library is None or self._handle is None:
            raise DeviceError(self.name, "is not connected; call open() first")
        return self._library, self._handle

    @property
    def applies_twin_section(self) -> bool:
        """True with the stand-in of the SDK, behind which is the simulated bench."""
        return self._info is not None and self._info.simulated

    def _build_info(self, layout: str, model: str, stand_in: bool, n_act: int = 0) -> DMInfo:
        named = f"{model} (stand-in)" if stand_in else model
        if not layout:
            unknown = np.full((n_act, 2), math.nan)
            return DMInfo(named, self._serial, n_act, None, unknown, self._stroke_m, stand_in)
        return mirror_info(layout, self._pitch_m, self._stroke_m, named, self._serial, simulated=stand_in)


#: Name of the entry point in version 0.1.0, which an environment installed then still has.
make_mirror = AlpaoMirror


def _raise_not_connected() -> int:
    """Take the place of the transfer while there is none."""
    raise RuntimeError("a command passed the guard of a mirror that is not connected")
