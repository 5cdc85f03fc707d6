"""Gaussians from bytes: the steps in which compact formats keep colours, opacities and rotations.

Conventions. An opacity of 255 of 255 is the logit inf, 0 is -inf. Quaternions come out as (w, x, y, z), of unit length where
the format leaves one entry out.
"""

from __future__ import annotations

import numpy as np

from mivol.points.gaussians import CONSTANT_HARMONIC, logit

__all__ = ["completed", "harmonics_of_colours", "logits_of_bytes", "logs_of_scales"]


def logits_of_bytes(codes: np.ndarray) -> np.ndarray:
    """Logits of opacities in 0..255."""
    return logit(codes / 255)


def harmonics_of_colours(colours: np.ndarray) -> np.ndarray:
    """Coefficients of degree 0 of colours in 0..1."""
    return (colours - 0.5) / CONSTANT_HARMONIC


def logs_of_scales(scales: np.ndarray) -> np.ndarray:
    """Logarithms; of a scale that is not above 0 -inf or NaN, which is refused by its index when the Gaussians are checked."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.log(np.asarray(scales, np.float64))


def completed(others: np.ndarray, which: np.ndarray) -> np.ndarray:
    """Unit quaternions of which one entry, not below 0, was left out.

    Args:
        others: (N, 3) the entries that are there, in their order.
        which: (N,) the number of the one that is not.

    Returns:
        (N, 4).
    """
    rows = np.arange(len(others))
    quaternions = np.empty((len(others), 4))
    quaternions[rows, which] = np.sqrt(np.maximum(0, 1 - (others**2).sum(axis=1)))
    for number in range(3):
        quaternions[rows, number + (which <= number)] = others[:, number]
    return quaternions
