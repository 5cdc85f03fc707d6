"""A plume of smoke without a simulation: a widening, swirling column, torn by turbulence.

The turbulence is Gaussian noise filtered to the power spectrum |k|^-13/3, a little steeper than Kolmogorov's |k|^-11/3. Three
fields of it displace the points, which makes the curls. A fourth field eats holes into the edge of the column.
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import map_coordinates

__all__ = ["make_plume"]


def make_plume(shape: tuple[int, int, int] = (160, 96, 96), seed: int = 3) -> np.ndarray:
    """A plume that rises from the middle of the lower face.

    Args:
        shape: voxels (Z, Y, X).
        seed: of the turbulence.

    Returns:
        Density (Z, Y, X), float32, in [0, 1], 0 on the outermost voxels.
    """
    rng = np.random.default_rng(seed)
    here = np.indices(shape, dtype=np.float64)
    height = here[0] / shape[0]
    push = np.stack([turbulence(shape, rng) for _ in range(3)])
    moved = here + push * (2 + 13 * height)
    z, y, x = (moved[k] / shape[2] for k in range(3))
    top = shape[0] / shape[2]
    angle, lean = 5.0 * z / top, 0.10 * np.clip(z / top, 0, 1.2)
    radius = 0.05 + 0.27 * np.clip(z / top, 0, 1) ** 0.9
    away = np.hypot(y - 0.5 - lean * np.sin(angle), x - 0.5 - lean * np.cos(angle) * np.clip(2 * z, 0, 1)) / radius
    column = np.clip(1.35 - away, 0, 1)
    torn = map_coordinates(turbulence(shape, rng), moved, order=1, mode="grid-wrap")
    density = np.clip(1.6 * column * (0.75 + 0.55 * torn) - 0.35 * height, 0, 1)
    fade = np.clip((1 - height) / 0.22, 0, 1) ** 1.5 / (1 + 4 * height)
    edge = np.minimum.reduce([np.minimum(here[k], shape[k] - 1 - here[k]) for k in range(3)])
    return (density * fade * np.clip(edge / 4, 0, 1)).astype(np.float32)


def turbulence(shape: tuple[int, int, int], rng: np.random.Generator, largest: float = 30) -> np.ndarray:
    """Gaussian noise with the power spectrum |k|^-13/3 below a largest wavelength [voxel]; mean 0, variance 1."""
    waves = np.meshgrid(np.fft.fftfreq(shape[0]), np.fft.fftfreq(shape[1]), np.fft.rfftfreq(shape[2]), indexing="ij")
    square = sum(k**2 for k in waves)
    spectrum = np.fft.rfftn(rng.normal(size=shape)) * (square + largest**-2) ** (-13 / 12)
    spectrum[0, 0, 0] = 0
    field = np.fft.irfftn(spectrum, shape)
    return field / field.std()
