"""What a server says, for notebooks."""

from __future__ import annotations

from escape_hw.api.representation import table_html
from escape_hw.remote.state import ProcedureEntry, ProcedurePlan, State


def state_html(state: State) -> str:
    """The state as a small table, numbers with their units."""
    loop, running, lease, fault = state.loop, state.procedure, state.lease, state.fault
    rows: dict[str, object] = {
        "system": f"{state.system} ({'SIMULATED' if state.simulated else 'HARDWARE'})",
        "phase": state.phase.value,
    }
    if fault is not None:
        rows["FAULT"] = f"{fault.reason}; {fault.way_out}"
    if running is not None:
        rows["running"] = (
            f"{running.name}: {running.stage}, {running.done} of {running.total} {running.unit}s"
        )
    if loop.closed:
        rows["loop"] = f"closed on {loop.matrix}, gain {loop.gain:g}, residual {loop.residual_nm:.0f} nm"
    rows["camera"] = f"{state.rates.frame_hz:.1f} Hz, {state.rates.lost} frames lost"
    rows["mirror"] = f"rms {100 * state.mirror.rms:.2f} %, peak {100 * state.mirror.peak:.2f} % of the stroke"
    rows["may write"] = "nobody" if lease is None else f"{lease.name} on {lease.host}"
    rows["devices"] = ", ".join(f"{one.name} {one.health.value}" for one in state.devices)
    rows["server"] = f"process {state.server_pid}, ESCAPE {state.version}"
    return table_html(rows, "Server")


def plan_html(plan: ProcedurePlan) -> str:
    """What a procedure would do."""
    given = {key: value for key, value in plan.arguments.items() if value is not None}
    rows: dict[str, object] = {
        "frames": plan.frames,
        "at the camera's rate": f"{plan.seconds:.1f} s",
        "largest poke": f"{100 * plan.stroke:.3g} % of the stroke" if plan.stroke else "none",
        "arguments": ", ".join(f"{key} {value}" for key, value in given.items()),
    }
    if plan.warnings:
        rows["mind"] = "; ".join(plan.warnings)
    return table_html(rows, f"Plan of {plan.name}")


def procedure_html(entry: ProcedureEntry) -> str:
    """A procedure with its parameters."""
    rows = {
        one.name: f"{one.help} {'' if one.default is None else f'Default: {one.default} {one.unit}'}".strip()
        for one in entry.parameters
    }
    return table_html(rows, f"{entry.name}: {entry.help}")
