"""Offsets of the mirror and of the loop: set, saved and restored."""

from __future__ import annotations

import logging
import re
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.offsets import Offsets
from escape_hw.calibration.modes.low_orders import combine_low_orders
from escape_hw.errors import CommandRejected, EscapeError, IncompatibleProduct, ProductError, RequestRefused
from escape_hw.io.fits.offsets import load_offsets, save_offsets
from escape_hw.remote.requests import OffsetsRequest
from escape_hw.remote.state import OffsetsState
from escape_hw.runtime.session.record import BenchRecord
from escape_hw.server.engine.bench_owner import BenchOwner
from escape_hw.streams.ring import ReaderCache

log = logging.getLogger(__name__)

#: Time over which the present slopes are averaged, and between two samples, seconds.
_AVERAGE_S, _SAMPLE_S = 2.0, 0.005

#: Called once with the answer or the error.
Reply = Callable[[OffsetsState | None, EscapeError | None], object]


class OffsetControl:
    """Holds the offsets, and applies them to the mirror's flat and to the loop."""

    def __init__(self, owner: BenchOwner, runs: Path) -> None:
        self._owner, self._bench = owner, owner.bench
        self._folder = runs / "offsets" / owner.bench.config.system.name
        self.offsets = Offsets()
        self.saved: tuple[str, ...] = ()
        self._list_saved()

    @property
    def state(self) -> OffsetsState:
        """The offsets for clients."""
        now = self.offsets
        return OffsetsState(
            terms=dict(now.terms),
            references=bool(now.slopes.size),
            flat=bool(now.flat.size),
            saved=self.saved,
        )

    def handle(self, request: OffsetsRequest, reply: Reply) -> None:
        """Set, save or load; ``reply`` may be called from another thread (EscapeError: not possible now)."""
        if request.verb == "save_offsets":
            self._save(request.name)
            reply(self.state, None)
            return
        self._require_possible()
        if request.verb == "load_offsets":
            self._apply(self._load(request.name), reply)
            return
        new = self.offsets
        if request.terms is not None:
            terms = {name: nm for name, nm in request.terms.items() if nm}
            new = replace(new, terms=terms, modes=self._modes(terms))
        if request.flat != "keep":
            flat = self._present_flat() if request.flat == "present" else np.zeros(0)
            new = replace(new, flat=flat)
        if request.references == "clear":
            new = replace(new, slopes=np.zeros((2, 0, 0), np.float32))
        if request.references != "present":
            self._apply(new, reply)
            return
        if new.terms and self._owner.state.snapshot.loop_control is None:
            raise RequestRefused(
                "the present slopes contain tip, tilt or focus; clear them, or close the loop"
            )
        threading.Thread(
            target=self._apply_with_references, args=(new, reply), name="reference slopes", daemon=True
        ).start()

    def _require_possible(self) -> None:
        state = self._owner.state.snapshot
        if not self._bench.dm.is_open:
            raise RequestRefused("the devices are not open")
        if state.loop_control is None or state.active_run is not None or state.fault is not None:
            self._owner.state.check_idle()

    # ------------------------------------------------------------ parts
    def _modes(self, terms: dict[str, float]) -> NDArray[np.float64]:
        if not terms:
            return np.zeros(0)
        info = self._bench.dm.info
        if not np.isfinite(info.stroke_m):
            raise RequestRefused("offsets in nanometres need the stroke of the mirror (devices.dm.stroke_m)")
        # Reflection doubles the surface; modes have unit rms surface.
        return combine_low_orders(terms, self._owner.modal_basis, info.positions_m, 2e9 * info.stroke_m)

    def _present_flat(self) -> NDArray[np.float64]:
        """The present shape without the terms."""
        shape, modes = self._bench.dm.shape, self.offsets.modes
        return shape - self._owner.modal_basis @ modes if modes.size else shape

    def _apply_with_references(self, new: Offsets, reply: Reply) -> None:
        """Average the present slopes, and apply them; in a thread of its own."""
        try:
            self._apply(replace(new, slopes=self._average_slopes()), reply)
        except EscapeError as error:
            reply(None, error)

    def _average_slopes(self) -> NDArray[np.float32]:
        """Mean of the present slopes as maps ``(2, rows, columns)``; in closed loop plus their offset."""
        publisher, readers = self._owner.publisher, ReaderCache()
        grid, segment = publisher.grid, {one.name: one.segment for one in publisher.entries}.get("slopes")
        samples: dict[int, NDArray[np.float32]] = {}
        until = time.monotonic() + _AVERAGE_S
        try:
            while grid is not None and time.monotonic() < until:
                reader = readers.reader("slopes", segment)
                sample = None if reader is None else reader.latest(max(samples, default=-1))
                if sample is not None:
                    samples[sample.index] = sample.data
                time.sleep(_SAMPLE_S)
        finally:
            readers.close()
        if grid is None or not samples or next(iter(samples.values())).size != grid.n_slopes:
            raise RequestRefused("there are no slopes; find the sensor first, and let it see light")
        maps = np.zeros((2, *grid.valid.shape), np.float32)
        maps[:, grid.valid] = np.mean(list(samples.values()), axis=0).reshape(2, -1)
        control, now = self._owner.state.snapshot.loop_control, self.offsets
        if control is not None and now.slopes.shape == maps.shape:
            # Slopes of a closed loop are relative to the present references.
            maps += now.slopes
        return maps

    # ------------------------------------------------------------ apply, save
    def _apply(self, new: Offsets, reply: Reply) -> None:
        """Check the offsets against the limits of the mirror and the matrix of the loop, and apply them."""
        self._require_possible()
        dm, control = self._bench.dm, self._owner.state.snapshot.loop_control
        flat = np.zeros(dm.info.n_act) if not new.flat.size else new.flat.copy()
        if new.modes.size:
            if new.modes.size != self._owner.modal_basis.shape[1]:
                raise IncompatibleProduct(f"the offsets are of {new.modes.size} modes, not of this basis")
            flat += self._owner.modal_basis @ new.modes
        if control is not None:
            # Before anything changes: the matrix of the loop may not fit.
            control.request_change(offsets=new)
        try:
            dm.set_flat(flat)
        except CommandRejected as error:
            if control is not None:
                control.request_change(offsets=self.offsets)
            raise RequestRefused(str(error)) from None
        self.offsets = new
        words = ", ".join(f"{name} {nm:g} nm" for name, nm in new.terms.items()) or "none"
        references = "measured" if new.slopes.size else "of the matrix"
        log.info(
            "offsets: %s; reference slopes %s; flat %s", words, references, "set" if new.flat.size else "0"
        )
        if control is not None:
            self._owner.state_publisher.publish()
            reply(self.state, None)
            return

        def flatten() -> None:
            self._owner.flatten()
            self._owner.state_publisher.publish()
            reply(self.state, None)

        self._owner.post(flatten)

    def _save(self, name: str) -> None:
        path, record = self._path(name), BenchRecord.from_bench(self._bench)
        self._folder.mkdir(parents=True, exist_ok=True)
        save_offsets(path, self.offsets, record.system, record.simulated, record.origin())
        log.info("offsets saved as '%s'", name)
        self._list_saved()

    def _load(self, name: str) -> Offsets:
        product = load_offsets(
            self._find_saved().get(name) or self._path(name),
            expect_system=self._folder.name,
            allow_simulated=self._bench.simulated,
        )
        return product.result

    def _path(self, name: str) -> Path:
        """File of a name; a name that no file has is refused, since two of them would share one file."""
        possible = re.sub(r"[^\w.+-]", "-", name)
        if name != possible:
            raise RequestRefused(
                f"offsets '{name}': a name has letters, digits and . _ + - only, such as '{possible}'"
            )
        return self._folder / f"{name}.fits"

    def _list_saved(self) -> None:
        try:
            self.saved = tuple(sorted(self._find_saved()))
        except OSError as error:
            log.warning("saved offsets cannot be listed: %s", error)

    def _find_saved(self) -> dict[str, Path]:
        """Saved files by name; those of earlier versions are ``SYSTEM_NAME.fits`` in the parent folder."""
        prefix = f"{self._folder.name}_"
        earlier = self._folder.parent.glob(f"{prefix}*.fits")
        found = {path.stem.removeprefix(prefix): path for path in earlier if self._is_of_this_system(path)}
        return found | {path.stem: path for path in self._folder.glob("*.fits")}

    def _is_of_this_system(self, path: Path) -> bool:
        try:
            load_offsets(path, expect_system=self._folder.name)
        except IncompatibleProduct:
            return False
        except ProductError as error:
            log.warning("saved offsets: %s", error)
        return True
