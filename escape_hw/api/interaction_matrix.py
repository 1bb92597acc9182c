"""Interaction matrix with mask, basis, standard errors and provenance."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.representation import image_html, table_html
from escape_hw.deprecation import renamed_text, warn_renamed


class _Metrics(dict[str, Any]):
    """Scalars by name; names of version 0.1.0 are replaced, and served with a warning."""

    _RENAMED: ClassVar[dict[str, str]] = {"shortened": "clipped_pokes"}

    def __init__(self, values: Any = ()) -> None:
        super().__init__(values)
        for old, new in self._RENAMED.items():
            if old in self:
                self[new] = self.pop(old)

    def __missing__(self, key: str) -> Any:
        new = self._RENAMED.get(key)
        if new is None:
            raise KeyError(key)
        warn_renamed(renamed_text(f"the metric '{key}'", f"'{new}'"))
        return self[new]


@dataclass(frozen=True, slots=True, eq=False)
class InteractionMatrix:
    """An interaction matrix with its sub-aperture mask, basis, errors and provenance.

    Parameters
    ----------
    data
        ``(n_slopes, n_modes)``, slopes per unit mode (paper Eq. s = D c): a mode whose rms surface is the
        full stroke.
    sigma
        Standard error of every element, same shape, without the error of the common gain. For DO-CRIME the
        relative standard error of that gain is ``metrics["gain_sigma"]``.
    m2c
        Mode-to-command matrix ``(n_act, n_modes)``; columns have unit rms surface over the pupil.
    valid
        Valid sub-apertures, boolean ``(n_rows, n_columns)``.
    system
        Name of the system.
    method
        ``push-pull``, ``push-pull-fast``, ``modulated``, ``docrime``, ``docrime-whitened`` or ``escape``;
        ``docrime-closed`` and ``push-pull-fast-closed`` were measured in closed loop.
    simulated
        True when any device was simulated.
    metrics
        Scalars of the measurement (frames, poke, delay, lost frames, ...).
    slope_unit
        Unit of the slopes.
    layout
        Layout of the actuators it is of, as in ``devices.dm.layout``; empty if unknown.
    """

    data: NDArray[np.float32]
    sigma: NDArray[np.float32]
    m2c: NDArray[np.float64]
    valid: NDArray[np.bool_]
    system: str
    method: str
    simulated: bool
    metrics: dict[str, Any] = field(default_factory=dict)
    slope_unit: str = "pixel"
    layout: str = ""

    def __post_init__(self) -> None:
        object.__setattr__(self, "metrics", _Metrics(self.metrics))
        if self.data.ndim != 2:
            raise ValueError(f"the matrix has shape {self.data.shape}; it must be (n_slopes, n_modes)")
        n_slopes, n_modes = self.data.shape
        if self.sigma.shape != self.data.shape:
            raise ValueError(f"sigma has shape {self.sigma.shape}, the matrix {self.data.shape}")
        if self.m2c.ndim != 2 or self.m2c.shape[1] != n_modes:
            raise ValueError(f"m2c has shape {self.m2c.shape}; {n_modes} columns are needed")
        if 2 * int(self.valid.sum()) != n_slopes:
            raise ValueError(f"{n_slopes} slopes do not fit {int(self.valid.sum())} valid sub-apertures")

    @property
    def n_slopes(self) -> int:
        """Number of slopes."""
        return int(self.data.shape[0])

    @property
    def n_modes(self) -> int:
        """Number of modes."""
        return int(self.data.shape[1])

    @property
    def unit(self) -> str:
        """Unit of the elements as text: that of the slopes, per mode whose rms surface is the full stroke."""
        slopes = "normalised slope" if self.slope_unit == "1" else self.slope_unit
        return f"{slopes} per full stroke rms"

    def snr(self) -> NDArray[np.float64]:
        """Signal-to-noise ratio per mode ``(n_modes,)``: rms of the column over rms of its errors.

        The noise power is subtracted from the power of the column, so pure noise gives 0. Infinite where
        the standard errors are zero.
        """
        return snr_per_mode(self.data, self.sigma)

    def maps(self, mode: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Slope maps (x, y) of one mode, each ``(n_rows, n_columns)``, NaN outside the pupil."""
        n = self.n_slopes // 2
        slope_maps = []
        for part in (self.data[:n, mode], self.data[n:, mode]):
            image = np.full(self.valid.shape, np.nan)
            image[self.valid] = part
            slope_maps.append(image)
        return slope_maps[0], slope_maps[1]

    def __repr__(self) -> str:
        system, size, quality = self._summary()
        return f"<{type(self).__name__} {self.method} of {system}: {size}; signal to noise {quality}>"

    def _summary(self) -> tuple[str, str, str]:
        """System, size and signal-to-noise ratio as text."""
        snr = self.snr()
        all_finite = np.isfinite(snr).all()
        return (
            f"{self.system}{' (SIMULATED)' if self.simulated else ''}",
            f"{self.n_slopes} slopes × {self.n_modes} modes, in {self.unit}",
            f"{snr.min():.3g} at worst, median {np.median(snr):.3g}" if all_finite else "computed",
        )

    def _repr_html_(self) -> str:
        """Thumbnail and summary for notebooks."""
        system, size, quality = self._summary()
        rows: dict[str, object] = {
            "method": self.method,
            "system": system,
            "size": size,
            "signal to noise": quality,
            **{
                name: self.metrics[name]
                for name in ("frames", "poke", "delay_frames")
                if name in self.metrics
            },
        }
        return table_html(rows, "Interaction matrix", image_html(self.data))


def snr_per_mode(data: NDArray[np.floating], sigma: NDArray[np.floating]) -> NDArray[np.float64]:
    """See :meth:`InteractionMatrix.snr`; any number of columns ``(n_slopes, n)``."""
    noise = np.mean(np.square(sigma, dtype=float), axis=0)
    power = np.mean(np.square(data, dtype=float), axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(noise > 0, np.sqrt(np.maximum(power - noise, 0) / noise), np.inf)
