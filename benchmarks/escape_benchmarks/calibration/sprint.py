"""SPRINT beside OOPAO's and SPECULA's: time, errors and capture for the same registrations, in one run.

Ours and OOPAO's solve the very same matrices, of OOPAO's own sensor, which our model of a sensor of
that shape reproduces to 1e-6; and ours also those of its own model of the bench. SPECULA's solves
those of its own model. On the pyramid only OOPAO's stands beside ours, without noise: SPECULA's takes
half a minute per solution there.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from escape_benchmarks.peers.oopao import MirrorUnderTest, OopaoPeer, SolverResult
from escape_benchmarks.peers.specula import MISSING, specula_peer
from escape_benchmarks.rows import time_row
from escape_hw.api.benchmark import BenchmarkRow, product_rate, time_alternately
from escape_hw.api.interaction_matrix import InteractionMatrix
from escape_hw.api.registration import PARAMETERS, Registration
from escape_hw.calibration.modes.bases import karhunen_loeve
from escape_hw.calibration.modes.derivatives import modal_jacobian, modal_matrix
from escape_hw.calibration.sprint.fit import sprint
from escape_hw.config.choices import Solver
from escape_hw.config.loader import load_system
from escape_sim.mirror.influence_functions import pitch_on_pupil
from escape_sim.mirror.mode_surfaces import N_DERIVATIVES, surface_nodes
from escape_sim.models.factory import make_fast_model
from escape_sim.models.pyramid import nominal_pupils
from escape_sim.models.shack_hartmann import nominal_grid
from escape_sim.models.slope_operator import NODES
from escape_sim.optics.pupil import pupil_geometry

if TYPE_CHECKING:
    from escape_hw.api.sensor import SensorGeometry
    from escape_hw.config.system import SystemConfig

#: The paper's laboratory case, Table 1; and one with equal scalings, for solvers with a single scaling.
INJECTED = Registration(-16.0, -71.0, -0.77, 2.9, 0.0)
INJECTED_EQUAL_SCALINGS = Registration(-16.0, -71.0, -0.77, 1.45, 1.45)
#: Sub-apertures across the pupil in which those shifts are given.
INJECTED_N_SUB = 24
#: Numbers of modes, as the paper takes and as the bench does.
MODES = (5, 40)
#: White noise on the matrix, relative to the median column, and how often it is drawn.
NOISE, N_DRAWS = 0.15, 4
#: A mirror with realistic imperfections: scatter of the actuators' gains, and coupling (0.4 in the model).
GAIN_SCATTER, COUPLING = 0.05, 0.43
#: Large misregistrations: shifts in actuator pitches, directions in degrees, and the other parameters.
PITCHES, DIRECTIONS = (0.25, 0.5, 1.0, 1.5, 2.0), (20.0, 200.0)
OTHER_PARAMETERS = (1.0, 2.0, 0.0)
#: Tolerance of a recovered large misregistration, in the units of the parameters; without noise.
CAPTURE_TOLERANCE = np.array([5.0, 5.0, 0.1, 0.5, 0.5])
#: Labels and solvers: gain and registration only, and with random effects.
_REGISTRATION_ONLY: tuple[str, Solver] = ("registration only", "registration-only")
_WITH_MISFIT: tuple[str, Solver] = ("with misfit", "mixed-effects")
_SOLVERS = (_REGISTRATION_ONLY, _WITH_MISFIT)
#: The mirror of every peer's model.
_GAUSSIAN = ("devices.dm.influence=gaussian", "devices.dm.coupling=0.4")
_OOPAO_SENSOR = (*_GAUSSIAN, "sensor.pitch_px=16", "sensor.spot_px=2")
#: OOPAO's pupil images stand on a square around the middle of its grid.
_OOPAO_PYRAMID = (
    *_GAUSSIAN,
    "devices.wfs.region=[248, 184, 144, 144]",
    "sensor.pupils_px=[[35.5, 35.5], [107.5, 35.5], [35.5, 107.5], [107.5, 107.5]]",
)
_QUANTITIES = (
    ("shift", slice(0, 2), "% of a sub-aperture"),
    ("rotation", slice(2, 3), "deg"),
    ("scaling", slice(3, 5), "%"),
)

Solve = Callable[[NDArray[np.float64]], SolverResult]


def run() -> list[BenchmarkRow]:
    """All rows of the stage."""
    bench = load_system("razor-shwfs", overrides=_GAUSSIAN)
    oopao_like = load_system("razor-shwfs", overrides=_OOPAO_SENSOR)
    rows = []
    for modes in _low_modes(bench):
        what = f"sprint, {modes.shape[1]} modes"
        oopao = OopaoPeer(oopao_like, modes)
        rows += _matrices(oopao_like, oopao, what)
        rows += _times(oopao_like, oopao, what, NOISE)
        rows += _exact(oopao_like, oopao, what, (_REGISTRATION_ONLY,))
        rows += _accuracy(oopao_like, bench, oopao, what)
        rows += _capture_rows(oopao_like, oopao, what)
        rows += _specula_rows(bench, modes)
    return rows + pyramid_rows()


def pyramid_rows() -> list[BenchmarkRow]:
    """Rows of the pyramid, calm and without noise."""
    oopao_like = load_system("razor-pywfs", overrides=_OOPAO_PYRAMID)
    rows = []
    for modes in _low_modes(oopao_like):
        what = f"sprint, pyramid, {modes.shape[1]} modes"
        oopao = OopaoPeer(oopao_like, modes)
        rows += _matrices(oopao_like, oopao, what)
        rows += _times(oopao_like, oopao, what, 0.0)
        rows += _exact(oopao_like, oopao, what, (_REGISTRATION_ONLY, _WITH_MISFIT))
        rows += _capture_rows(oopao_like, oopao, what)
    return rows


def injected(config: SystemConfig) -> Registration:
    """:data:`INJECTED` on the pupil of a design, in its own sub-apertures."""
    finer = config.sensor.n_sub / INJECTED_N_SUB
    return replace(INJECTED, shift_x=finer * INJECTED.shift_x, shift_y=finer * INJECTED.shift_y)


def _low_modes(config: SystemConfig) -> list[NDArray[np.float64]]:
    surfaces = make_fast_model(config, None).influence_functions()
    m2c = karhunen_loeve(*surfaces, max(MODES), 4 * config.system.pupil_m)
    return [m2c[:, :n] for n in MODES]


def _sensor(config: SystemConfig) -> SensorGeometry:
    """The design's sensor, as a calibration would find it."""
    return nominal_pupils(config) if config.sensor.kind == "pyramid" else nominal_grid(config)


@dataclass(frozen=True, slots=True, eq=False)
class EscapeSolver:
    """Our SPRINT with the fast model of a design."""

    config: SystemConfig
    m2c: NDArray[np.float64]

    def solver(self, solver_name: Solver, noise: bool = True) -> Solve:
        """Build the model; return the solver on it, with or without noise."""
        grid = _sensor(self.config)
        model = make_fast_model(self.config, grid)

        def solve(data: NDArray[np.float64]) -> SolverResult:
            sigma = np.full(data.shape, _sigma(data) if noise else 0.0, np.float32)
            system = self.config.system.name
            matrix = InteractionMatrix(
                data.astype(np.float32), sigma, self.m2c, grid.valid, system, "push-pull", True
            )
            found = sprint(matrix, model, solver=solver_name)
            return SolverResult(found.registration, found.converged)

        return solve

    def matrix(self, registration: Registration) -> NDArray[np.float64]:
        """Matrix of our model at a registration."""
        return modal_matrix(make_fast_model(self.config, None), registration, self.m2c)


def mirror(real: bool) -> MirrorUnderTest:
    """The nominal mirror, or one with realistic imperfections."""
    gains = GAIN_SCATTER * np.random.default_rng(7).standard_normal(97) if real else np.zeros(97)
    return MirrorUnderTest(1 + gains, COUPLING if real else 0.4)


def _matrices(config: SystemConfig, oopao: OopaoPeer, what: str) -> list[BenchmarkRow]:
    """The synthetic matrix, alone and with what a step of the descent needs."""
    model, m2c, at = make_fast_model(config, None), oopao.m2c, injected(config)
    ours, theirs = modal_matrix(model, at, m2c), oopao.matrix(at, mirror(False))
    scale = float(np.vdot(ours, theirs) / np.vdot(ours, ours))
    note = f"relative difference {np.linalg.norm(scale * ours - theirs) / np.linalg.norm(theirs):.1e}"
    times = time_alternately(
        lambda: modal_matrix(model, at, m2c),
        # As its SPRINT makes them.
        lambda: oopao.matrix(at, mirror(False), both_ways=False),
        rounds=3,
    )
    rate = product_rate()
    alone, whole = (1e3 * count / rate for count in _operations(config, model.n_act, m2c.shape[1]))
    with_derivatives = time_alternately(lambda: modal_jacobian(model, at, m2c), None, rounds=3)[0]
    matrices = 1 + 2 * len(PARAMETERS)
    repeated = None if times[1] is None else matrices * times[1]
    peer, many = f"{oopao.name.split(':')[0]}: mirror and InteractionMatrix", f"{matrices} of OOPAO's"
    return [
        time_row(f"{what}: synthetic matrix", times, peer, "ms", note, alone),
        time_row(f"{what}: with derivatives", (with_derivatives, repeated), peer, "ms", many, whole),
    ]


def _operations(config: SystemConfig, n_act: int, n_modes: int) -> tuple[int, int]:
    """Floating-point operations of a modal matrix, and of one with derivatives, as they are made."""
    if config.sensor.kind == "pyramid":
        return _pyramid_operations(config, n_act, n_modes)
    windows, across = nominal_grid(config).n_valid, config.sensor.n_sub + 2
    seen = (3 * NODES) ** 2
    surfaces = 2 * (across * NODES) ** 2 * n_act * n_modes + 4 * windows * seen * n_modes
    # Three factors along x against two slopes, five pairs of factors, ten products into modes.
    zonal = 4 * windows * n_act * (seen + 3 * NODES) + 4 * windows * n_act * n_modes
    whole = 4 * windows * n_act * (3 * seen + 5 * 3 * NODES) + 10 * 4 * windows * n_act * n_modes
    return min(surfaces, zonal), whole


def _pyramid_operations(config: SystemConfig, n_act: int, n_modes: int) -> tuple[int, int]:
    """The same on a pyramid: surfaces on the nodes, then the response by the phase there."""
    sigma = pitch_on_pupil(config) / np.sqrt(2 * np.log(1 / config.devices.dm.coupling))
    nodes = surface_nodes(pupil_geometry(config).coordinates_m, float(sigma))[0].size ** 2
    one = 2 * nodes * n_modes * (n_act + nominal_pupils(config).n_slopes)
    return one, (1 + N_DERIVATIVES) * one


def _times(config: SystemConfig, oopao: OopaoPeer, what: str, noise: float) -> list[BenchmarkRow]:
    ours, noisy = EscapeSolver(config, oopao.m2c), noise > 0
    data = oopao.matrix(injected(config), mirror(False))
    if noisy:
        data = _draws(data)[0]
    peer_label, note = f"{oopao.name}, 6 iterations", f"OOPAO's matrix, {noise:.0%} noise"
    set_up = time_alternately(lambda: make_fast_model(config, None), oopao.set_up, rounds=2)
    wide_up = time_alternately(lambda: list(make_fast_model(config, None).variants()), None, rounds=2)[0]
    registration_only, full = (ours.solver(name, noise=noisy) for _, name in _SOLVERS)
    solve = time_alternately(lambda: registration_only(data), lambda: oopao.solve(data), rounds=3)
    wide = time_alternately(lambda: full(data), None, rounds=3)[0]
    theirs = None if set_up[1] is None or solve[1] is None else set_up[1] + solve[1]
    timed = (
        ("set-up", set_up, "mirror, sensor and telescope exist already"),
        ("one solution, registration only", solve, note),
        ("one solution, with misfit", (wide, solve[1]), note),
        ("set-up and solution, registration only", (set_up[0] + solve[0], theirs), note),
        ("set-up and solution, with misfit", (wide_up + wide, theirs), note),
    )
    return [time_row(f"{what}: {label}", times, peer_label, "s", text) for label, times, text in timed]


def _exact(
    config: SystemConfig, oopao: OopaoPeer, what: str, cases: Sequence[tuple[str, Solver]]
) -> list[BenchmarkRow]:
    """Errors on a matrix of OOPAO's without noise, for solvers with their labels."""
    oopao.set_up()
    at, ours = injected(config), EscapeSolver(config, oopao.m2c)
    matrix = [oopao.matrix(at, mirror(False))]
    theirs, rows = _errors(oopao.solve, matrix, at), []
    for label, solver_name in cases:
        our_data = _errors(ours.solver(solver_name, noise=False), matrix, at)
        rows += _error_rows(what, f"no noise, {label}", our_data, theirs, f"{oopao.name}, 6 iterations")
    return rows


def _accuracy(
    oopao_like: SystemConfig, bench: SystemConfig, oopao: OopaoPeer, what: str
) -> list[BenchmarkRow]:
    """Errors on OOPAO's noisy matrices, and each on its own."""
    solvers = {label: EscapeSolver(oopao_like, oopao.m2c).solver(name) for label, name in _SOLVERS}
    own = EscapeSolver(bench, oopao.m2c)
    peer_label, rows = f"{oopao.name}, 6 iterations", []
    for kind in ("ideal", "real"):
        matrices = _draws(oopao.matrix(INJECTED, mirror(kind == "real")))
        theirs = _errors(oopao.solve, matrices, INJECTED)
        for label, solve in solvers.items():
            our_data = _errors(solve, matrices, INJECTED)
            rows += _error_rows(what, f"{kind} mirror, {label}", our_data, theirs, peer_label)
        if kind == "ideal":
            our_data = _errors(own.solver("registration-only"), _draws(own.matrix(INJECTED)), INJECTED)
            rows += _error_rows(what, "ideal mirror, each its own sensor", our_data, theirs, peer_label)
    return rows


def _capture_rows(config: SystemConfig, oopao: OopaoPeer, what: str) -> list[BenchmarkRow]:
    """Numbers of large misregistrations recovered, and of wrong results reported as converged."""
    solve = EscapeSolver(config, oopao.m2c).solver("registration-only", noise=False)
    pitch = 100 * config.sensor.n_sub / config.devices.dm.pitches_across_pupil
    # The same fraction of the pupil on every sensor.
    tolerance = CAPTURE_TOLERANCE * ([config.sensor.n_sub / INJECTED_N_SUB] * 2 + [1] * 3)
    places = [
        Registration(
            pitch * p * np.cos(np.deg2rad(way)), pitch * p * np.sin(np.deg2rad(way)), *OTHER_PARAMETERS
        )
        for p in PITCHES
        for way in DIRECTIONS
    ]
    found, wrong = np.zeros(2, int), np.zeros(2, int)
    for registration in places:
        data = oopao.matrix(registration, mirror(False))
        for k, answer in enumerate((solve(data), oopao.solve(data, 10))):
            error = np.abs(answer.registration.to_array() - registration.to_array())
            right = bool((error < tolerance).all())
            found[k] += right and answer.valid
            wrong[k] += answer.valid and not right
    peer_label = f"{oopao.name}, 10 iterations"
    note = f"shifts of {PITCHES[0]} to {PITCHES[-1]} actuator pitches, turned and scaled; no noise"
    unit = f"of {len(places)}"
    ours, theirs = zip(found.tolist(), wrong.tolist(), strict=True)
    return [
        BenchmarkRow(
            f"{what}: recovered from large misregistrations",
            ours[0],
            theirs[0],
            peer_label,
            unit,
            "higher",
            note,
        ),
        BenchmarkRow(
            f"{what}: wrong but reported as converged", ours[1], theirs[1], peer_label, unit, "lower", note
        ),
    ]


def _specula_rows(config: SystemConfig, modes: NDArray[np.float64]) -> list[BenchmarkRow]:
    ours = EscapeSolver(config, modes)
    solve, what = ours.solver("registration-only"), f"sprint, {modes.shape[1]} modes"
    our_data = _draws(ours.matrix(INJECTED_EQUAL_SCALINGS))
    peer = specula_peer(config, modes, make_fast_model(config, None))
    label, note = "each its own sensor, registration only", "one scaling injected; SPECULA has one scaling"
    if peer is None:
        seconds = time_alternately(lambda: solve(our_data[0]), None, rounds=2)[0]
        return [time_row(f"{what}: {label}", (seconds, None), "SPECULA", "s", MISSING)]
    theirs = _draws(peer.matrix(INJECTED_EQUAL_SCALINGS))
    times = time_alternately(lambda: solve(our_data[0]), lambda: peer.solve(theirs[0]), rounds=2)
    peer_label = f"{peer.name}, 6 iterations"
    rows = [time_row(f"{what}: {label}", times, peer_label, "s", note)]
    errors = [
        _errors(one, data, INJECTED_EQUAL_SCALINGS) for one, data in ((solve, our_data), (peer.solve, theirs))
    ]
    for e in errors:
        # Two scalings against one: their mean is what compares.
        e[:, 3:] = e[:, 3:].mean(axis=1, keepdims=True)
    return rows + _error_rows(what, label, errors[0], errors[1], peer_label)


def _draws(matrix: NDArray[np.float64]) -> list[NDArray[np.float64]]:
    rng = np.random.default_rng(1)
    return [matrix + rng.normal(0, _sigma(matrix), matrix.shape) for _ in range(N_DRAWS)]


def _sigma(matrix: NDArray[np.float64]) -> float:
    return NOISE * float(np.median(matrix.std(axis=0)))


def _errors(
    solve: Solve, matrices: Sequence[NDArray[np.float64]], injected: Registration
) -> NDArray[np.float64]:
    """Errors ``(n_draws, 5)`` in the units of the parameters."""
    return np.stack([solve(data).registration.to_array() - injected.to_array() for data in matrices])


def _error_rows(
    what: str, label: str, ours: NDArray[np.float64], theirs: NDArray[np.float64], peer_label: str
) -> list[BenchmarkRow]:
    note = f"rms over {len(ours)} draws of {NOISE:.0%} noise" if len(ours) > 1 else "the paper's registration"
    rows = []
    for quantity, which, unit in _QUANTITIES:
        rms = [float(np.sqrt(np.mean(np.square(e[:, which])))) for e in (ours, theirs)]
        stage = f"{what}: error of {quantity}, {label}"
        rows.append(BenchmarkRow(stage, rms[0], rms[1], peer_label, unit, "lower", note))
    return rows
