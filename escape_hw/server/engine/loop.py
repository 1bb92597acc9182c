"""The closed loop outside procedures: closing, changing parameters, opening."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import asdict, replace

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.concurrency import SignalSafeFlag
from escape_hw.api.procedure import run as run_procedure
from escape_hw.calibration.loop.control import LoopControl
from escape_hw.calibration.loop.operation import run_until_opened
from escape_hw.errors import Aborted, EscapeError
from escape_hw.io.fits.matrix import MatrixProduct
from escape_hw.remote.requests import CloseLoop, SetLoop
from escape_hw.runtime.procedures.matrix_input import load_fitting_matrix, require_hardware_matrix
from escape_hw.server.engine.bench_owner import BenchOwner
from escape_hw.server.engine.product_store import ProductStore
from escape_hw.server.engine.state import LoopParameters

log = logging.getLogger(__name__)

_REMEDY = "Fix the device, then clear the fault."
#: Called once: with ``None`` when the loop is closed, or with the reason why it cannot be closed.
OnClosed = Callable[[EscapeError | None], object]


class LoopRunner:
    """Closes the loop and changes its parameters."""

    def __init__(self, owner: BenchOwner, product_store: ProductStore) -> None:
        self._owner, self._bench, self._state = owner, owner.bench, owner.state
        #: A procedure replaces the bench's configuration while it runs.
        self._config = owner.bench.config
        self._product_store = product_store
        #: PSF without turbulence ``(rows, columns)``, once measured; the running Strehl ratio needs it.
        self.model_psf: NDArray[np.float32] | None = None

    def prepare(self, request: CloseLoop | LoopParameters) -> tuple[LoopParameters, LoopControl]:
        """Load the matrix and compute the reconstructor; nothing moves.

        ConfigError, ProductError, IncompatibleProduct or CalibrationError: a parameter is out of range, or
        the matrix does not fit this bench.
        """
        settings = self._merge(request)
        control = LoopControl(
            self._bench, self._load_matrix(settings.matrix).result,
            gain=settings.gain, leak=settings.leak, dropped_modes=settings.dropped_modes,
        )  # fmt: skip
        return settings, control

    def close(self, request: CloseLoop, on_closed: OnClosed) -> None:
        """Close the loop until it is opened.

        RequestRefused unless the engine is idle; errors of :meth:`prepare`.
        """
        self._state.check_can_start(needs_loop=False)
        settings, control = self.prepare(request)
        self.post(settings, control, self._state.begin_loop(settings, control), on_closed)

    def post(
        self, settings: LoopParameters, control: LoopControl, stop: SignalSafeFlag, on_closed: OnClosed
    ) -> None:
        """Queue a loop that the engine's state has accepted."""
        self._owner.post(lambda: self._run(settings, control, stop, on_closed))

    def change(self, request: SetLoop) -> None:
        """Change the parameters of the loop, closed or not; those that are absent stay.

        After an error (see :meth:`prepare`) the loop continues unchanged.
        """
        before, control = self._state.snapshot.loop, self._state.snapshot.loop_control
        settings = self._merge(request)
        product = None if request.matrix is None else self._load_matrix(request.matrix)
        if control is not None:
            control.request_change(
                calibration=None if product is None else product.result,
                gain=request.gain, leak=request.leak, dropped_modes=request.dropped_modes,
            )  # fmt: skip
        self._state.set_loop_settings(settings)
        old = asdict(before)
        changes = [f"{key} {old[key]} -> {new}" for key, new in asdict(settings).items() if old[key] != new]
        log.info("loop: %s", ", ".join(changes) or "unchanged")

    def _merge(self, request: CloseLoop | SetLoop | LoopParameters) -> LoopParameters:
        requested = {key: getattr(request, key) for key in ("matrix", "gain", "leak", "dropped_modes")}
        return replace(
            self._state.snapshot.loop, **{key: value for key, value in requested.items() if value is not None}
        )

    def _load_matrix(self, name: str) -> MatrixProduct:
        # Real drivers may be connected to simulated libraries: the open devices decide what is a simulation.
        product = load_fitting_matrix(
            self._product_store.matrix_path(name), self._config, self._bench.simulated
        )
        require_hardware_matrix(product, self._bench, force=False)
        return product

    def _run(
        self, settings: LoopParameters, control: LoopControl, stop: SignalSafeFlag, on_closed: OnClosed
    ) -> None:
        """Keep the loop closed until it is opened; in the main thread."""
        state = self._state
        try:
            self._bench.wfs.stop()
            self._owner.publisher.reset_residual()
            state.set_loop_closed(True)
            self._owner.state_publisher.publish()
            on_closed(None)
            log.info("loop closed on '%s', gain %g", settings.matrix, settings.gain)
            end = run_procedure(
                run_until_opened(self._bench, control, model_psf=self.model_psf),
                observers=(self._owner.observe,), abort=stop,
            )  # fmt: skip
            log.info("loop open after %d frames, %d lost; mirror flat", end.frames, end.lost_frames)
            if end.fault:
                # The parameters that led to the fault are not the default of the next loop.
                matrix = state.snapshot.loop.matrix
                state.set_loop_settings(LoopParameters.from_config(self._config, matrix))
                self._owner.make_safe(f"the loop was opened: {end.fault}", _REMEDY)
        except Aborted:
            log.info("loop open, mirror flat")
        except EscapeError as error:
            was_closed = state.snapshot.loop_closed
            self._owner.make_safe(str(error), _REMEDY)
            if not was_closed:
                on_closed(error)
        finally:
            state.end_loop()
            self._owner.send_flat_replies()
