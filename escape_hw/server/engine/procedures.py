"""The procedures as a server offers them: entries for clients, checks of arguments, requests, plans."""

from __future__ import annotations

from dataclasses import replace
from functools import reduce
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from escape_hw.calibration.acquisition.frames import limit_to_reachable
from escape_hw.calibration.acquisition.pokes import (
    PokeSequence,
    PushPullPokes,
    compute_poke_amplitudes,
    compute_random_amplitudes,
    select_random_pokes,
)
from escape_hw.calibration.docrime.open_loop import minimum_frames
from escape_hw.calibration.modes.bases import build_modal_basis
from escape_hw.config.system import SystemConfig
from escape_hw.errors import ConfigError
from escape_hw.remote.state import Arguments, ProcedureEntry, ProcedureParameter, ProcedurePlan
from escape_hw.runtime.procedures.calibration import CalibrationProcedure
from escape_hw.runtime.procedures.declaration import Parameter, ProcedureSpec, check_arguments, present_names
from escape_hw.runtime.procedures.registry import PROCEDURES, find_procedure
from escape_hw.server.engine.product_store import ProductStore

if TYPE_CHECKING:
    from escape_hw.bench import Bench


def offered_parameters(procedure: type[ProcedureSpec[Any]]) -> tuple[Parameter, ...]:
    """The parameters of a procedure that clients may set."""
    return tuple(one for one in procedure.parameters() if one.on_server)


class ProcedureRegistry:
    """The procedures that a server offers for its system, whose configuration has many of the defaults."""

    def __init__(self, config: SystemConfig) -> None:
        self._config = config

    @property
    def entries(self) -> tuple[ProcedureEntry, ...]:
        """Name, help and parameters of all procedures, for clients."""
        return tuple(
            ProcedureEntry(
                name=each.name, title=each.title, help=each.help,
                parameters=tuple(map(self._describe, offered_parameters(each))),
            )
            for each in PROCEDURES
        )  # fmt: skip

    def _describe(self, one: Parameter) -> ProcedureParameter:
        kind = {"run": "text", "choices": "text"}.get(one.kind, one.kind)
        choices = one.choices if kind == "choice" else ()
        return ProcedureParameter(
            name=one.name, kind=kind, default=self._default(one), unit=one.unit, help=one.help,
            label=one.label, choices=choices, low=one.low, high=one.high,
        )  # fmt: skip

    def _default(self, one: Parameter) -> Any:
        if one.default is not None or not one.config_key:
            return one.default
        value = reduce(getattr, one.config_key.split("."), self._config)
        return ",".join(value) if isinstance(value, tuple) else value

    def arguments(self, name: str, given: Arguments) -> Arguments:
        """All arguments of a procedure, defaults included (ConfigError: unknown name, wrong argument)."""
        parameters = offered_parameters(find_procedure(name))
        values = check_arguments(map(_as_sent, parameters), given)
        defaults = {one.name: self._default(one) for one in parameters}
        return {key: defaults[key] if value is None else value for key, value in values.items()}

    def task(self, name: str, given: Arguments, product_store: ProductStore) -> ProcedureSpec[Any]:
        """The request for a run with these arguments.

        A resumed run keeps its own arguments and settings where none are given. ConfigError or ProductError:
        an argument is wrong, a matrix is unknown, or the run cannot be resumed.
        """
        procedure = find_procedure(name)
        parameters = offered_parameters(procedure)
        present = present_names(parameters, given)
        checked = check_arguments(map(_as_sent, parameters), present)
        arguments = {key: checked[key] for key, value in present.items() if value is not None}
        for one in parameters:
            value = arguments.get(one.name)
            if one.kind == "matrix" and value is not None:
                arguments[one.name] = product_store.matrix_path(value)
            elif one.kind == "matrix" and one.required:
                title = one.label or "matrix"
                raise ConfigError(f"{title} ({one.name}) is missing; name one that the server holds")
            elif one.kind == "run" and value is not None:
                arguments[one.name] = product_store.readable_path(value)
        resume = arguments.get("resume")
        if resume is not None and issubclass(procedure, CalibrationProcedure):
            arguments = {**procedure.settings_of_run(resume), **arguments}
        return procedure.from_arguments(arguments)


def _as_sent(one: Parameter) -> Parameter:
    """The parameter as a client sends it: files are names or paths as text, and nothing is required."""
    return replace(one, kind="text" if one.kind in ("matrix", "run") else one.kind, required=False)


def needs_loop(name: str, arguments: Arguments) -> bool:
    """Whether a procedure works in closed loop, so that it cannot be paused between two frames."""
    return find_procedure(name).works_in_closed_loop(arguments)


#: Number of random pokes that are simulated for a plan, and share of clipped pokes above which it warns.
_SIMULATED_POKES, _CLIPPED_WARNING_SHARE = 1000, 0.01


class ProcedurePlanner:
    """Plans procedures on an open bench; nothing is moved."""

    def __init__(self, bench: Bench) -> None:
        self._bench = bench
        self._m2c: NDArray[np.float64] | None = None

    def plan(self, name: str, arguments: Arguments) -> ProcedurePlan:
        """The plan of a procedure; ``arguments`` are complete (EscapeError: no modal basis)."""
        rate = self._bench.wfs.settings.frame_rate_hz
        procedure = find_procedure(name)
        frames = procedure.planned_frames(self._bench, arguments)
        stroke, clipped_share = self._simulate_pokes(name, arguments)
        return ProcedurePlan(
            name=name, arguments=dict(arguments), frames=frames, seconds=frames / rate, stroke=stroke,
            preparation_frames=procedure.preparation_frames(self._bench, arguments),
            warnings=tuple(self._warnings(name, arguments, clipped_share)),
        )  # fmt: skip

    def _simulate_pokes(self, name: str, arguments: Arguments) -> tuple[float, float]:
        """Largest command of a run, and share of its pokes that the limits clip, from a simulated sequence.

        Pokes are drawn and limited as in a run, from a flat mirror; in closed loop the command of the loop
        adds to them.
        """
        poke = arguments.get("poke")
        if poke is None:
            return 0.0, 0.0
        bench, dm = self._bench, self._bench.dm
        if self._m2c is None:
            self._m2c = build_modal_basis(bench)
        m2c, rng = self._m2c, np.random.default_rng(1)
        source: PokeSequence
        if find_procedure(name).random_pokes:
            amplitude = compute_random_amplitudes(bench, m2c, float(poke))
            kind = arguments.get("pokes") or bench.config.calibration.pokes
            source, count = select_random_pokes(str(kind))(amplitude, rng), _SIMULATED_POKES  # type: ignore[arg-type]
        else:
            source = PushPullPokes(compute_poke_amplitudes(bench, m2c, float(poke)), rng)
            count = 2 * m2c.shape[1]
        sent, peak, clipped = dm.flat, 0.0, 0
        for _ in range(count):
            requested = m2c @ source()
            sent = limit_to_reachable(dm, requested, sent)
            peak = max(peak, float(np.abs(sent).max()))
            clipped += not np.array_equal(requested, sent)
        return peak, clipped / count

    def _warnings(self, name: str, arguments: Arguments, clipped_share: float) -> list[str]:
        bench, found = self._bench, []
        if clipped_share > _CLIPPED_WARNING_SHARE:
            found.append(
                f"about {100 * clipped_share:.2g} % of the pokes clipped: they exceed a limit of the mirror "
                "and are scaled down as a whole; the estimator uses the scaled pokes"
            )
        frames = int(arguments.get("frames") or 0)
        least = minimum_frames(bench.config.calibration, bench.config.basis.n_modes)
        if name in ("docrime", "push-pull-fast") and frames < least:
            found.append(f"{frames} frames cannot constrain the modes; at least {least} are needed")
        if name == "push-pull" and bench.screen is None and not bench.simulated:
            found.append("push-pull needs a source: make sure that no turbulence is in the beam")
        if name == "gains":
            found.append("the number of rounds is an estimate: a poor matrix needs several times as many")
        if arguments.get("snr") is not None or arguments.get("accuracy") is not None:
            found.append("the run stops earlier if the target is reached")
        return found
