"""OOPAO on a leash: imported late, silent, seeded by nothing, never able to end the process.

OOPAO 1.0 prints dozens of lines per object, has no switch against it, and ends the interpreter on
a command of the wrong length. Everything that touches OOPAO goes through this module.
"""

from __future__ import annotations

import io
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from types import SimpleNamespace
from typing import Any, TextIO

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.registration import Registration
from escape_hw.errors import ConfigError

# One user at a time: OOPAO's objects share their source, and the mute swaps sys.stdout.
_oopao_lock = threading.RLock()


class _ThreadFilteredOutput(io.TextIOBase):
    """Standard output that drops what one thread writes and passes on everything else."""

    def __init__(self, thread: int, behind: TextIO) -> None:
        self._thread, self._stream = thread, behind

    def write(self, text: str) -> int:
        return len(text) if threading.get_ident() == self._thread else self._stream.write(text)

    def flush(self) -> None:
        self._stream.flush()


@contextmanager
def quiet() -> Iterator[None]:
    """Silence what OOPAO prints from this thread, and turn its ``sys.exit`` into an error.

    Raises
    ------
    RuntimeError
        OOPAO tried to end the process.
    """
    with _oopao_lock:
        original_stdout = sys.stdout
        sys.stdout = _ThreadFilteredOutput(threading.get_ident(), original_stdout)
        try:
            yield
        except SystemExit as exit_error:
            raise RuntimeError("OOPAO tried to end the process; its input was refused") from exit_error
        finally:
            sys.stdout = original_stdout


@cache
def oopao() -> SimpleNamespace:
    """The classes used, imported on first call (about two seconds).

    Raises
    ------
    ConfigError
        OOPAO is not installed.
    """
    names = (
        "DeformableMirror", "MisRegistration", "OPD_map", "Pyramid", "ShackHartmann", "Source", "Telescope",
    )  # fmt: skip
    with quiet():
        try:
            return SimpleNamespace(**{name: getattr(import_module(f"OOPAO.{name}"), name) for name in names})
        except ImportError as import_error:
            raise ConfigError(
                f"OOPAO cannot be imported ({import_error}); install it with: pip install OOPAO"
            ) from import_error


def mis_registration(registration: Registration, sub_aperture_m: float) -> Any:
    """OOPAO's ``MisRegistration`` for ours: same rotation and scalings, opposite shifts in metres."""
    out = oopao().MisRegistration()
    out.shiftX = -registration.shift_x / 100 * sub_aperture_m
    out.shiftY = -registration.shift_y / 100 * sub_aperture_m
    out.rotationAngle = registration.rotation
    out.radialScaling = registration.radial_scaling / 100
    out.tangentialScaling = registration.tangential_scaling / 100
    out.anamorphosisAngle = registration.anamorphosis_angle
    return out


@dataclass(frozen=True, slots=True, eq=False)
class SourceAndTelescope:
    """A monochromatic source behind a pupil.

    ``photons_per_unit`` is what OOPAO calls one unit of ``amplitude ** 2``, in photons.
    """

    source: Any
    telescope: Any
    photons_per_unit: float


def make_source(amplitude: NDArray[np.float32], diameter_m: float, wavelength_m: float) -> SourceAndTelescope:
    """Source and telescope for a square pupil map.

    Parameters
    ----------
    amplitude
        Pupil amplitude ``(n, n)``; zero outside the pupil.
    diameter_m
        Side of the map in metres.
    wavelength_m
        Wavelength in metres; set after the source is made, for OOPAO knows named bands only.
    """
    lib = oopao()
    with quiet():
        power = np.square(amplitude, dtype=float)
        telescope = lib.Telescope(
            resolution=amplitude.shape[0],
            diameter=diameter_m,
            samplingTime=1.0,
            pupil=power > 0,
            pupilReflectivity=power,
        )
        source = lib.Source("R", 0, display_properties=False)
        source.wavelength = wavelength_m
        source * telescope
        photons_per_unit = (
            float(source.nPhoton) * telescope.samplingTime * (diameter_m / amplitude.shape[0]) ** 2
        )
    return SourceAndTelescope(source, telescope, photons_per_unit)


def make_lenslets(light: SourceAndTelescope, n_sub: int, window: int) -> Any:
    """A noise-free diffractive ``ShackHartmann``, two pixels per lambda/d.

    The relative threshold of OOPAO's centroid (1 % by default) makes small-signal slopes depend on
    the stroke, so it is off; ``slopes_units`` is 1, so slopes are plain centroids in its pixels.

    Parameters
    ----------
    light
        Source and telescope.
    n_sub
        Lenslets across the pupil map.
    window
        Pixels across each lenslet's image, even.
    """
    with quiet():
        sensor = oopao().ShackHartmann(
            nSubap=n_sub,
            telescope=light.telescope,
            lightRatio=1e-6,
            threshold_cog=0,
            shannon_sampling=True,
            n_pixel_per_subaperture=window,
        )
        sensor.slopes_units = 1.0
        # Batches of wavefronts are sized by this; the default of 1 GB is too much for a side task.
        sensor.cpu_batch_memory = 1.5e8
        # fft_workers only helps asterisms; -1 would start a thread per core.
        sensor.fft_workers = 1
    return sensor


def make_pyramid(light: SourceAndTelescope, n_sub: int, separation: int, edge: int, roof: float = 0.0) -> Any:
    """A noise-free ``Pyramid`` at rest, every pixel valid.

    Parameters
    ----------
    light
        Source and telescope.
    n_sub
        Camera pixels across the pupil map.
    separation, edge
        Pixels between two pupil images, and beside them.
    roof
        Its ``rooftop``.
    """
    with quiet():
        sensor = oopao().Pyramid(
            nSubap=n_sub,
            telescope=light.telescope,
            modulation=0,
            lightRatio=0,
            n_pix_separation=separation,
            n_pix_edge=edge,
            rooftop=roof,
        )
        # Its image of the focal plane is not looked at.
        sensor.compute_focal_plane = False
    return sensor
