"""Filtered back-projection: the inverse of the Radon transform for parallel beams, cheap and without noise weights.

References: Kak & Slaney, Principles of Computerized Tomographic Imaging (1988), section 3.3, Eq. 61 (the ramp kernel).
"""

from __future__ import annotations

import numpy as np

from mivol.errors import MivolError
from mivol.tomography.geometry import ParallelBeam
from mivol.tomography.projector import Projector


def filtered_backprojection(projector: Projector, y: np.ndarray) -> np.ndarray:
    """Reconstruct a parallel-beam scan over half a turn or whole turns in one step.

    The ramp-filtered views are smeared back with the projector's own transpose, each voxel divided by what it gets from
    views of all ones: ``x = pi A^T(h * y) / A^T 1``.

    Args:
        projector: of a :class:`~mivol.tomography.geometry.ParallelBeam` with angles evenly spread.
        y: (views, rows, cols) line integrals.

    Returns:
        (Z, Y, X) float32 [1/length].

    Bias: the ramp stops at the pixels' Nyquist frequency; few views leave streaks.
    Cost: two A^T (one is kept by the projector).
    """
    if not isinstance(projector.geometry, ParallelBeam):
        raise MivolError(f"Found {type(projector.geometry).__name__}, expected a ParallelBeam: use an iterative solver.")
    filtered = filter_ramp(y, projector.geometry.pitch[1])
    weights = projector.column_sums
    smeared = projector.T @ filtered.astype(np.float32)
    return np.pi * smeared / np.where(weights > 1e-6 * weights.max(), weights, np.inf)


def filter_ramp(y: np.ndarray, pitch: float) -> np.ndarray:
    """Convolve each row with the band-limited ramp, zero beyond the detector.

    ``h(0) = 1 / (4 pitch^2)``, ``h(n) = -1 / (pi n pitch)^2`` for odd n, 0 for even n; the sum is times ``pitch``.

    Args:
        y: (..., cols).
        pitch: of the columns [length].

    Returns:
        (..., cols) float64 [1/length].
    """
    n = y.shape[-1]
    size = 2 * n
    k = np.minimum(np.arange(size), size - np.arange(size))
    h = np.where(k % 2 == 1, -1.0 / (np.pi * np.maximum(k, 1) * pitch) ** 2, 0.0)
    h[0] = 1.0 / (4 * pitch**2)
    return pitch * np.fft.irfft(np.fft.rfft(y, size) * np.fft.rfft(h), size)[..., :n]
