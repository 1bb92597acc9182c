"""Requests to a server that concern single devices: settings of cameras, pokes, offsets."""

from __future__ import annotations

import abc
from collections.abc import Mapping
from typing import Any

from escape_hw.remote.state import CameraPlan, OffsetsState, PokePlan
from escape_hw.remote.transport import SLOW_TIMEOUT_S, TIMEOUT_S


class DeviceRequests(abc.ABC):
    """The part of :class:`~escape_hw.remote.client.Connection` that adjusts single devices."""

    @abc.abstractmethod
    def _request(self, verb: str, timeout_s: float = TIMEOUT_S, **fields: Any) -> tuple[Any, bytes]:
        """Send a request; returns its answer and bytes."""

    def check_camera(self, camera: str, **settings: Any) -> CameraPlan:
        """What other settings of a camera would change; nothing is changed.

        Parameters
        ----------
        camera
            ``"wfs"`` or ``"science"``.
        settings
            ``exposure_s``, ``frame_rate_hz``, ``gain_db``, ``region`` (x, y, width, height); those that are
            absent stay.

        Raises
        ------
        SettingRejected
            A value is outside the range of the camera.
        """
        answer, _ = self._request("check_camera", camera=camera, **settings)
        return CameraPlan.model_validate(answer)

    def set_camera(self, camera: str, **settings: Any) -> CameraPlan:
        """Change settings of a camera, see :meth:`check_camera`; returns what was changed.

        Raises
        ------
        RequestRefused
            A procedure runs, or the loop is closed, which needs the camera unchanged.
        SettingRejected
            A value is outside the range of the camera, which is unchanged.
        """
        answer, _ = self._request("set_camera", SLOW_TIMEOUT_S, camera=camera, **settings)
        return CameraPlan.model_validate(answer)

    def check_poke(self, kind: str, number: int, amplitude: float, seconds: float = 2.0) -> PokePlan:
        """What :meth:`poke` would do; nothing moves."""
        answer, _ = self._request(
            "check_poke", SLOW_TIMEOUT_S, kind=kind, number=number, amplitude=amplitude, seconds=seconds
        )
        return PokePlan.model_validate(answer)

    def poke(self, kind: str, number: int, amplitude: float, seconds: float = 2.0) -> None:
        """Poke one actuator or mode for some seconds; the mirror then returns to flat by itself.

        Parameters
        ----------
        kind, number
            ``"actuator"`` or ``"mode"``, and its number from 0.
        amplitude
            Command of the actuator, or of the actuator that the mode moves most, as fraction of full stroke.

        Raises
        ------
        RequestRefused
            The bench is not idle, there is no such actuator or mode, or the poke exceeds a limit.
        """
        self._request("poke", SLOW_TIMEOUT_S, kind=kind, number=number, amplitude=amplitude, seconds=seconds)

    def set_offsets(
        self, terms: Mapping[str, float] | None = None, *, references: str = "keep", flat: str = "keep"
    ) -> OffsetsState:
        """Set the offsets of the mirror at rest and of what a closed loop converges to.

        Parameters
        ----------
        terms
            All terms, in nm rms wavefront: ``tip``, ``tilt``, ``focus``, ``mode 12``; ``None``: as they are.
        references, flat
            ``"keep"``, ``"clear"`` or ``"present"``: the mean of the present slopes as reference of the loop,
            and the present shape of the mirror as flat.

        Raises
        ------
        RequestRefused
            A procedure runs, or a limit of the mirror forbids it; nothing changed.
        """
        answer, _ = self._request(
            "set_offsets", SLOW_TIMEOUT_S, terms=None if terms is None else dict(terms),
            references=references, flat=flat,
        )  # fmt: skip
        return OffsetsState.model_validate(answer)

    def save_offsets(self, name: str) -> OffsetsState:
        """Save the present offsets on the server."""
        answer, _ = self._request("save_offsets", SLOW_TIMEOUT_S, name=name)
        return OffsetsState.model_validate(answer)

    def load_offsets(self, name: str) -> OffsetsState:
        """Restore saved offsets, one of ``state.offsets.saved``."""
        answer, _ = self._request("load_offsets", SLOW_TIMEOUT_S, name=name)
        return OffsetsState.model_validate(answer)
