"""Finding the lenslet grid, the valid sub-apertures and the references from frames."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, optimize

from escape_hw.api.sensor import SubApertureGrid
from escape_hw.errors import CalibrationError
from escape_hw.pipeline.slopes import SlopeExtractor, windows

#: How far the real pitch may lie from the nominal one.
_PITCH_RANGE = 0.03
#: Least contrast of the comb of spots (1 for points, 0 for even light). Turbulence that smears the
#: spots over half a pitch leaves more than 0.5; the noise of a dark camera makes up to 0.05.
_LEAST_CONTRAST = 0.2
#: Pixels above the threshold without which there is nothing to look at: a few spots.
_LEAST_PIXELS = 24


def _comb_power(profile: NDArray[np.float64], pitch: float) -> complex:
    """Fourier component of a profile at one period per ``pitch``."""
    return complex(np.sum(profile * np.exp(-2j * np.pi * np.arange(profile.size) / pitch)))


def _pitch_and_phase(image: NDArray[np.float64], nominal: float) -> tuple[float, float, float]:
    """Common pitch of both axes, and the position of one lenslet centre along x and y."""
    profiles = [image.sum(axis=0), image.sum(axis=1)]
    profiles = [p - ndimage.uniform_filter1d(p, int(round(nominal)) | 1) for p in profiles]

    def lack(pitch: float) -> float:
        return -sum(abs(_comb_power(p, pitch)) ** 2 for p in profiles)

    # The comb's peak is about pitch^2 / length wide: scan finer than that, then polish.
    trial = nominal * (1 + np.linspace(-_PITCH_RANGE, _PITCH_RANGE, 241))
    best = float(trial[np.argmin([lack(t) for t in trial])])
    step = float(trial[1] - trial[0])
    pitch = float(optimize.minimize_scalar(lack, bounds=(best - step, best + step), method="bounded").x)
    phases = [-np.angle(_comb_power(p, pitch)) * pitch / (2 * np.pi) for p in profiles]
    return pitch, float(phases[0]), float(phases[1])


def _require_spots(light: NDArray[np.float64], pitch: float) -> None:
    """Refuse light that no lenslets made: the noise of a dark camera, or an even glow."""
    if np.count_nonzero(light) < _LEAST_PIXELS:
        raise CalibrationError(
            "no light above the threshold on the wavefront sensor; check source, beam stop and exposure"
        )
    contrast = min(abs(_comb_power(light.sum(axis=axis), pitch)) for axis in (0, 1)) / light.sum()
    if contrast < _LEAST_CONTRAST:
        raise CalibrationError(
            f"no regular spots {pitch:.2f} pixels apart on the wavefront sensor (contrast {contrast:.2f}, "
            f"{_LEAST_CONTRAST} is needed); check source, beam stop, exposure and sensor.pitch_px"
        )


def _lattice_fit(
    rows: NDArray[np.intp], columns: NDArray[np.intp], spots: NDArray[np.float64], weight: NDArray[np.float64]
) -> tuple[float, float, float]:
    """Weighted least-squares pitch and origin (x, y) of spots on a square lattice."""
    n = rows.size
    design = np.zeros((2 * n, 3))
    design[:n, 0], design[n:, 0] = columns, rows
    design[:n, 1] = design[n:, 2] = 1.0
    w = np.sqrt(np.tile(weight, 2))
    answer = np.linalg.lstsq(design * w[:, None], np.concatenate([spots[:, 0], spots[:, 1]]) * w, rcond=None)[
        0
    ]
    return float(answer[0]), float(answer[1]), float(answer[2])


def find_grid(
    mean_frame: NDArray[np.float32],
    *,
    n_sub: int,
    nominal_pitch_px: float,
    threshold: float,
    min_flux: float,
    references: str = "lattice",
) -> SubApertureGrid:
    """Find pitch, offset, valid sub-apertures and references from a mean frame.

    The mean of many frames will do, turbulent ones too: turbulence moves single spots, but a
    lattice fitted to all of them keeps only the error of the mean tilt and focus.

    Parameters
    ----------
    mean_frame
        Mean of dark-subtracted frames in counts ``(rows, columns)``.
    n_sub
        Lenslets across the grid.
    nominal_pitch_px
        Design pitch in pixels; the real one may differ by 3 %.
    threshold
        Centre-of-gravity threshold in counts.
    min_flux
        Sub-apertures with less flux than this share of the brightest are left out.
    references
        ``"lattice"``: the references are the lattice points (the choice without a source);
        ``"mean"``: the mean spot positions (the choice with one).

    Returns
    -------
    SubApertureGrid

    Raises
    ------
    CalibrationError
        No regular spots, or too few lit sub-apertures.
    """
    if references not in ("lattice", "mean"):
        raise ValueError(f"references is {references!r}; choose 'lattice' or 'mean'")
    image = np.asarray(mean_frame, dtype=np.float64)
    light = np.maximum(image - threshold, 0.0)
    pitch, x, y = _pitch_and_phase(light, nominal_pitch_px)
    _require_spots(light, pitch)
    x, y = _centre_lattice(light, pitch, x, y, n_sub)
    grid = None
    for _ in range(3):
        grid = _grid_at(image, n_sub, pitch, (x, y), min_flux)
        extractor = SlopeExtractor(grid, image.shape, threshold=0.0)  # type: ignore[arg-type]
        offset = _measure(extractor, light)
        spots = grid.centres_px() + offset
        rows, columns = np.nonzero(grid.valid)
        pitch, x, y = _lattice_fit(rows, columns, spots, grid.flux[grid.valid].astype(float))
    assert grid is not None  # noqa: S101 - the loop above ran
    if abs(pitch / nominal_pitch_px - 1) > _PITCH_RANGE:
        raise CalibrationError(
            f"the fitted lenslet pitch is {pitch:.3f} pixels, the design says {nominal_pitch_px}; "
            "check sensor.pitch_px and the binning"
        )
    grid = _grid_at(image, n_sub, pitch, (x, y), min_flux)
    if references == "mean":
        extractor = SlopeExtractor(grid, image.shape, threshold=0.0)  # type: ignore[arg-type]
        grid = SubApertureGrid(
            grid.pitch_px,
            grid.origin_px,
            grid.valid,
            _measure(extractor, light).astype(np.float32),
            grid.flux,
            grid.counts,
        )
    return grid


def _centre_lattice(
    light: NDArray[np.float64], pitch: float, x: float, y: float, n_sub: int
) -> tuple[float, float]:
    """Number the lenslets so that the pupil's light is centred on the ``n_sub`` by ``n_sub`` grid."""
    # The outline of the pupil, not its brightness: a Gaussian beam need not be centred on it.
    smooth = ndimage.uniform_filter(light, int(round(pitch)))
    outline = smooth > 0.3 * np.percentile(smooth, 99)
    rows, columns = np.nonzero(outline)
    half = (n_sub - 1) / 2
    middle = [0.5 * (v.min() + v.max()) for v in (columns, rows)]
    return tuple(  # type: ignore[return-value]
        phase + pitch * round((m - phase) / pitch - half) for m, phase in zip(middle, (x, y), strict=True)
    )


def _grid_at(
    image: NDArray[np.float64], n_sub: int, pitch: float, origin: tuple[float, float], min_flux: float
) -> SubApertureGrid:
    line = np.arange(n_sub) * pitch
    centres = np.stack([a.ravel() for a in np.meshgrid(origin[0] + line, origin[1] + line)], axis=1)
    boxes = windows(centres, pitch, image.shape)  # type: ignore[arg-type]
    area = np.pad(image.cumsum(0).cumsum(1), ((1, 0), (1, 0)))
    top, end, left, right = boxes.T
    flux = area[end, right] - area[top, right] - area[end, left] + area[top, left]
    whole = (end - top >= int(pitch)) & (right - left >= int(pitch))
    flux = np.where(whole, np.maximum(flux, 0.0), 0.0).reshape(n_sub, n_sub)
    # Relative to the typical bright sub-aperture: one hot pixel must not darken all others.
    counts = float(np.percentile(flux[flux > 0.02 * flux.max()], 95))
    flux = flux / counts
    valid = flux >= min_flux
    if valid.sum() < 6:
        raise CalibrationError(
            f"only {int(valid.sum())} sub-apertures are lit above {min_flux:.0%} of the brightest; "
            "check the beam, the camera region and sensor.min_flux"
        )
    return SubApertureGrid(
        pitch, origin, valid, np.zeros((int(valid.sum()), 2), np.float32), flux.astype(np.float32), counts
    )


def _measure(extractor: SlopeExtractor, light: NDArray[np.float64]) -> NDArray[np.float64]:
    """Spot offsets ``(n_valid, 2)`` of a mean frame that is no longer made of whole counts."""
    scale = 60000.0 / float(light.max())
    slopes = extractor(np.asarray(light * scale, dtype=np.uint16))
    return np.asarray(slopes.reshape(2, -1).T, dtype=np.float64)
