"""Frames of four pupil images with known parameters, computed without the twin's optics."""

from __future__ import annotations

import numpy as np

#: Nominal centres (x, y) on a region of 192 x 192, not on a square.
NOMINAL = np.array([[45.0, 48.0], [152.0, 65.0], [46.0, 128.0], [130.0, 128.0]])
SHAPE = (192, 192)
N = 64


def disk(centre: np.ndarray, diameter: float, shape: tuple[int, int] = SHAPE, fine: int = 8) -> np.ndarray:
    """Share of every pixel inside a circle, by counting points in it."""
    at = (np.arange(fine) + 0.5) / fine - 0.5
    x = (np.arange(shape[1])[:, None] + at).ravel()
    y = (np.arange(shape[0])[:, None] + at).ravel()
    inside = (x[None, :] - centre[0]) ** 2 + (y[:, None] - centre[1]) ** 2 <= (diameter / 2) ** 2
    return inside.reshape(shape[0], fine, shape[1], fine).mean(axis=(1, 3))


def uneven(rng: np.random.Generator, strength: float, shape: tuple[int, int] = SHAPE) -> np.ndarray:
    """A positive brightness with waves of all lengths down to five pixels, mean 1."""
    y, x = np.indices(shape)
    waves = np.zeros(shape)
    for length in np.geomspace(5, 100, 12):
        kx, ky = 2 * np.pi / length * np.array([np.cos(a := rng.uniform(0, np.pi)), np.sin(a)])
        waves += np.cos(kx * x + ky * y + rng.uniform(0, 2 * np.pi))
    bright = np.exp(strength * waves / np.sqrt(6))
    return bright / bright.mean()


def frame(
    centres: np.ndarray,
    rng: np.random.Generator,
    *,
    diameter: float = float(N),
    level: float = 300.0,
    strength: float = 0.0,
    noise: float = 0.0,
    background: float = 0.0,
) -> np.ndarray:
    """Counts of a mean frame; every image has its own unevenness."""
    image = np.full(SHAPE, background)
    for centre in centres:
        image += level * disk(centre, diameter) * uneven(rng, strength)
    return (image + noise * rng.standard_normal(SHAPE)).astype(np.float32)


def moved(rng: np.random.Generator, reach: float = 2.5) -> np.ndarray:
    """Centres beside their nominal places."""
    return NOMINAL + rng.uniform(-reach, reach, (4, 2))
