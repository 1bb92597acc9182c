"""Values that keys of the configuration and parameters of procedures may take. Light to import."""

from __future__ import annotations

from typing import Literal, get_args

Estimator = Literal["auto", "matrix", "telemetry"]
#: Data that SPRINT fits within ESCAPE.
ESTIMATORS: tuple[str, ...] = get_args(Estimator)
PokePattern = Literal["white", "anticorrelated", "equal-snr"]
#: Poke sequences of DO-CRIME.
POKE_PATTERNS: tuple[str, ...] = get_args(PokePattern)
Solver = Literal["mixed-effects", "registration-only", "frozen-derivatives", "batches", "diagonal"]
#: Solvers of SPRINT.
SOLVERS: tuple[str, ...] = get_args(Solver)
ModesChoice = Literal["snr", "first", "d-optimal", "a-optimal"]
#: Criteria by which SPRINT chooses its modes.
MODES_CHOICES: tuple[str, ...] = get_args(ModesChoice)
ExtraParameter = Literal["anamorphosis", "pupil_shift"]
#: Parameters that SPRINT can fit beside the registration.
EXTRA_PARAMETERS: tuple[str, ...] = get_args(ExtraParameter)
Loss = Literal["squares", "huber"]
#: Loss functions of SPRINT.
LOSSES: tuple[str, ...] = get_args(Loss)
ActuatorModel = Literal["fitted", "nominal"]
#: Actuators of the pseudo-synthetic matrix.
ACTUATOR_MODELS: tuple[str, ...] = get_args(ActuatorModel)
