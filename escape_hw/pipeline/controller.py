"""What a loop needs of a modal controller."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray


class Controller(Protocol):
    """Turns slopes into modal commands, frame by frame.

    Attributes
    ----------
    residual
        Reconstructed slopes of the last frame ``(n_modes,)``.
    """

    @property
    def residual(self) -> NDArray[np.float32]:
        """See the class."""
        ...

    def __call__(self, slopes: NDArray[np.float32]) -> NDArray[np.floating]:
        """Next modal command ``(n_modes,)`` from slopes ``(n_slopes,)``; the same array at every call."""
        ...

    def applied(self, modes: NDArray[np.floating]) -> None:
        """Tell the controller what the mirror really took of its command ``(n_modes,)``."""
        ...

    def reset(self) -> None:
        """Forget everything."""
        ...
