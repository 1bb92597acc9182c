"""Access to OOPAO: imported on first use, output suppressed, ``sys.exit`` turned into an error.

OOPAO 1.0 prints dozens of lines per object, which no option prevents, and ends the interpreter on a
command of the wrong length. All use of OOPAO goes through this module.
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

# One user at a time: OOPAO's objects share their source, and suppression replaces sys.stdout.
_oopao_lock = threading.RLock()


class _ThreadFilteredOutput(io.TextIOBase):
    """Standard output that drops what one thread writes."""

    def __init__(self, thread: int, stream: TextIO) -> None:
        self._thread, self._stream = thread, stream

    def write(self, text: str) -> int:
        return len(text) if threading.get_ident() == self._thread else self._stream.write(text)

    def flush(self) -> None:
        self._stream.flush()


@contextmanager
def suppress_output() -> Iterator[None]:
    """Suppress what OOPAO prints from this thread; raise RuntimeError if it calls ``sys.exit``."""
    with _oopao_lock:
        original_stdout = sys.stdout
        sys.stdout = _ThreadFilteredOutput(threading.get_ident(), original_stdout)
        try:
            yield
        except SystemExit as exit_error:
            raise RuntimeError("OOPAO tried to end the process; it rejected its input") from exit_error
        finally:
            sys.stdout = original_stdout


@cache
def oopao_classes() -> SimpleNamespace:
    """OOPAO's classes used here, imported on first call (about two seconds).

    Raises
    ------
    ConfigError
        OOPAO is not installed.
    """
    names = (
        "DeformableMirror", "MisRegistration", "OPD_map", "Pyramid", "ShackHartmann", "Source", "Telescope",
    )  # fmt: skip
    with suppress_output():
        try:
            return SimpleNamespace(**{name: getattr(import_module(f"OOPAO.{name}"), name) for name in names})
        except ImportError as import_error:
            raise ConfigError(
                f"OOPAO cannot be imported ({import_error}); install it with: pip install OOPAO"
            ) from import_error


def mis_registration(registration: Registration, sub_aperture_m: float) -> Any:
    """OOPAO's ``MisRegistration``: same rotation and scalings, opposite shifts in metres."""
    out = oopao_classes().MisRegistration()
    out.shiftX = -registration.shift_x / 100 * sub_aperture_m
    out.shiftY = -registration.shift_y / 100 * sub_aperture_m
    out.rotationAngle = registration.rotation
    out.radialScaling = registration.radial_scaling / 100
    out.tangentialScaling = registration.tangential_scaling / 100
    out.anamorphosisAngle = registration.anamorphosis_angle
    return out


@dataclass(frozen=True, slots=True, eq=False)
class SourceAndTelescope:
    """A monochromatic source and a telescope."""

    source: Any
    telescope: Any
    #: Number of photons for one unit of ``amplitude ** 2``.
    photons_per_unit: float

    def propagate(self, path: Any, sensor: Any) -> None:
        """Propagate the light to a sensor by OOPAO's mirror or an optical path ``(n, n)`` in metres."""
        with suppress_output():
            if isinstance(path, np.ndarray):
                path = oopao_classes().OPD_map(path.astype(float))
            # '**' starts a new propagation; '*' would add to the last one.
            self.source**self.telescope * path * sensor


def make_source(amplitude: NDArray[np.float32], diameter_m: float, wavelength_m: float) -> SourceAndTelescope:
    """Source and telescope for a pupil amplitude ``(n, n)`` whose side is ``diameter_m``."""
    lib = oopao_classes()
    with suppress_output():
        power = np.square(amplitude, dtype=float)
        telescope = lib.Telescope(
            resolution=amplitude.shape[0],
            diameter=diameter_m,
            samplingTime=1.0,
            pupil=power > 0,
            pupilReflectivity=power,
        )
        source = lib.Source("R", 0, display_properties=False)
        source.wavelength = wavelength_m  # OOPAO's constructor takes named bands only
        source * telescope
        photons = float(source.nPhoton) * telescope.samplingTime * (diameter_m / amplitude.shape[0]) ** 2
    return SourceAndTelescope(source, telescope, photons)


def make_lenslets(light: SourceAndTelescope, n_sub: int, window: int) -> Any:
    """A noise-free diffractive ``ShackHartmann``, two pixels per lambda/d.

    The relative threshold of OOPAO's centroid (1 % by default) makes small-signal slopes depend on the
    stroke and is switched off. ``slopes_units`` is 1, so slopes are centroids in its pixels. ``window``
    is the number of pixels across each lenslet's image, even.
    """
    with suppress_output():
        sensor = oopao_classes().ShackHartmann(
            nSubap=n_sub,
            telescope=light.telescope,
            lightRatio=1e-6,
            threshold_cog=0,
            shannon_sampling=True,
            n_pixel_per_subaperture=window,
        )
        sensor.slopes_units = 1.0
        # Limits the size of batches of wavefronts; the default is 1 GB.
        sensor.cpu_batch_memory = 1.5e8
        # fft_workers speeds up asterisms only; -1 would start a thread per core.
        sensor.fft_workers = 1
    return sensor


def make_pyramid(light: SourceAndTelescope, n_sub: int, separation: int, edge: int, roof: float = 0.0) -> Any:
    """A noise-free ``Pyramid`` without modulation, every pixel valid.

    ``n_sub`` is the number of camera pixels across the pupil, ``separation`` and ``edge`` those between
    two pupil images and beside them, ``roof`` its ``rooftop``.
    """
    with suppress_output():
        sensor = oopao_classes().Pyramid(
            nSubap=n_sub,
            telescope=light.telescope,
            modulation=0,
            lightRatio=0,
            n_pix_separation=separation,
            n_pix_edge=edge,
            rooftop=roof,
        )
        # Its focal-plane image is not used.
        sensor.compute_focal_plane = False
    return sensor
