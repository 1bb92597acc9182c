"""How SPRINT is configured, as its functions take it."""

from __future__ import annotations

from typing import TypedDict

from escape_hw.config.models import Actuators, CalibrationSection, Extra, Loss, ModesChoice, Solver


class SprintSettings(TypedDict):
    """Options of :func:`~escape_hw.calibration.sprint.sprint`."""

    choice: ModesChoice
    solver: Solver
    loss: Loss
    actuators: Actuators
    learning_rate: float
    also: tuple[Extra, ...]


def as_configured(section: CalibrationSection) -> SprintSettings:
    """Options of SPRINT as a system's configuration has them."""
    return {
        "choice": section.modes_choice,
        "solver": section.solver,
        "loss": section.loss,
        "actuators": section.actuators,
        "learning_rate": section.learning_rate,
        "also": section.also,
    }
