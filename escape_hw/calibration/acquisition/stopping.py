"""Target at which a measurement stops: signal-to-noise ratio per mode, or accuracy of the registration."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from escape_hw.api.interaction_matrix import InteractionMatrix
from escape_hw.errors import ConfigError


@dataclass(frozen=True, slots=True)
class Target:
    """Target of a measurement, which stops when it is reached, or at its number of frames.

    Parameters
    ----------
    snr
        Signal-to-noise ratio of every mode.
    accuracy
        Standard error of both shifts of the registration, % of a sub-aperture.

    Raises
    ------
    ConfigError
        Neither is given, or one is not positive.
    """

    snr: float | None = None
    accuracy: float | None = None

    def __post_init__(self) -> None:
        if self.snr is None and self.accuracy is None:
            raise ConfigError("the target is empty; give a signal-to-noise ratio or an accuracy")
        for name, value in (("snr", self.snr), ("accuracy", self.accuracy)):
            if value is not None and not 0 < value < np.inf:
                raise ConfigError(f"{name} is {value}; it must be positive")

    def is_snr_reached(self, matrix: InteractionMatrix) -> bool:
        """Whether every mode of a matrix has the signal-to-noise ratio; true if none is asked for."""
        return self.snr is None or float(matrix.snr().min()) >= self.snr


def reject_accuracy_target(until: Target | None) -> None:
    """Raise :class:`ConfigError` if the target is an accuracy, which only a registration has."""
    if until is not None and until.accuracy is not None:
        raise ConfigError(
            f"accuracy is {until.accuracy}; this method measures no registration: use the method 'escape', "
            "or a signal-to-noise ratio"
        )
