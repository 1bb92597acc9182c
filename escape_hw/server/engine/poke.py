"""A poke of one actuator or mode, held for some seconds."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.concurrency import SignalSafeFlag
from escape_hw.api.procedure import Progress
from escape_hw.calibration.acquisition.frames import ramp_to
from escape_hw.errors import EscapeError, RequestRefused
from escape_hw.remote.requests import PokeRequest
from escape_hw.remote.state import PokePlan
from escape_hw.server.engine.bench_owner import REOPEN_REMEDY, BenchOwner

log = logging.getLogger(__name__)


class PokeRunner:
    """Plans pokes, and holds them in the main thread while frames are read; then flattens the mirror."""

    def __init__(self, owner: BenchOwner) -> None:
        self._owner, self._bench = owner, owner.bench

    def plan(self, request: PokeRequest) -> PokePlan:
        """What a poke would do; nothing moves (RequestRefused: there is no such actuator or mode)."""
        return self._plan(request)[0]

    def start(self, request: PokeRequest, on_begun: Callable[[EscapeError | None], object]) -> None:
        """Reserve the engine and queue the poke (RequestRefused: not idle, or beyond a limit).

        ``on_begun`` is called once: when the mirror has the shape, or with the reason why it has not.
        """
        plan, shape = self._plan(request)
        if plan.refusal:
            raise RequestRefused(plan.refusal)
        stop = self._owner.state.begin_poke(plan.description)
        self._owner.post(lambda: self._run(plan.description, shape, request.seconds, stop, on_begun))

    def _plan(self, request: PokeRequest) -> tuple[PokePlan, NDArray[np.float64]]:
        dm = self._bench.dm
        if not dm.is_open:
            raise RequestRefused("the mirror is not open")
        unit, name = self._unit_shape(request)
        flat, poke = dm.flat, request.amplitude * unit
        allowed = _largest_amplitude(dm.largest_legal_scale, flat, unit)
        nm = 1e9 * dm.info.stroke_m
        known = math.isfinite(nm)
        description = f"{name} at {request.amplitude:+.4g} of the stroke" + (
            f" ({nm * request.amplitude:+.4g} nm of surface)" if known else ""
        )
        refusal = ""
        if abs(request.amplitude) > allowed * (1 + 1e-9):
            refusal = f"the limits of the mirror allow at most {allowed:.4g} of the stroke for {name}"
        try:
            self._owner.state.check_idle()
        except RequestRefused as error:
            refusal = str(error)
        peak = abs(request.amplitude)
        plan = PokePlan(
            description=description, peak=peak, peak_nm=nm * peak if known else 0.0, allowed=allowed,
            refusal=refusal,
        )  # fmt: skip
        return plan, flat + poke

    def _unit_shape(self, request: PokeRequest) -> tuple[NDArray[np.float64], str]:
        """Shape ``(n_act,)`` whose largest command is 1, and its name.

        Names count actuators from 0 and modes from 1, as the configuration and the offsets do.
        """
        n_act = self._bench.dm.info.n_act
        if request.kind == "actuator":
            if request.number >= n_act:
                raise RequestRefused(
                    f"actuator {request.number} does not exist; the mirror has 0 to {n_act - 1}"
                )
            if request.number in self._bench.dm.limits.disabled:
                raise RequestRefused(f"actuator {request.number} is disabled in the configuration")
            return np.eye(n_act)[request.number], f"actuator {request.number}"
        m2c = self._owner.modal_basis
        n_modes = m2c.shape[1]
        if request.number >= n_modes:
            raise RequestRefused(f"mode {request.number + 1} does not exist; the basis has 1 to {n_modes}")
        mode = m2c[:, request.number]
        return mode / np.abs(mode).max(), f"mode {request.number + 1}"

    def _run(
        self,
        description: str,
        shape: NDArray[np.float64],
        seconds: float,
        stop: SignalSafeFlag,
        on_begun: Callable[[EscapeError | None], object],
    ) -> None:
        """Hold the poke until the time is over or it is stopped; in the main thread."""
        owner, failure = self._owner, None
        try:
            if not stop.is_set():
                ramp_to(self._bench.dm, shape)
            log.info("poke: %s for %g s", description, seconds)
            owner.observe(Progress(description, 0, math.ceil(seconds), "second"))
            owner.state_publisher.publish()
            on_begun(None)
            began = time.monotonic()
            while not stop.is_set() and (elapsed := time.monotonic() - began) < seconds:
                owner.observe(Progress(description, int(elapsed), math.ceil(seconds), "second", elapsed))
                owner.read_idle_frame()
        except EscapeError as error:
            failure = error
            owner.make_safe(str(error), REOPEN_REMEDY, error.device)
            on_begun(error)
        finally:
            owner.flatten()
            owner.state.end_poke()
            if failure is None:
                log.info("poke ended, mirror flat")
            owner.state_publisher.publish()
            owner.send_flat_replies()


def _largest_amplitude(
    scale_of: Callable[[NDArray[np.float64]], float], flat: NDArray[np.float64], unit: NDArray[np.float64]
) -> float:
    """Largest amplitude up to 1, of either sign, at which the sum with the flat is legal; by bisection."""
    low, high = 0.0, 1.0
    for step in range(30):
        tried = high if step == 0 else 0.5 * (low + high)
        if all(scale_of(flat + sign * tried * unit) >= 1 for sign in (1, -1)):
            low = tried
        else:
            high = tried
    return low
