"""Total variation with a quadratic bottom, as a penalty of a field in NumPy.

References: Huber 1964; Charbonnier et al. 1997 (half-quadratic majoriser).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class SmoothedTV:
    """Total variation with a quadratic bottom (Huber on the length of the gradient): ``strength sum psi(|grad x|) dV``.

    ``psi(t) = t^2 / (2 delta)`` below ``delta`` and ``t - delta / 2`` above; differences are forward and 0 at the far
    borders.

    Args:
        shape: (Z, Y, X).
        strength: multiplies the sum [1/length], which makes the whole dimensionless.
        delta: slope [value per length] below which noise is smoothed instead of kept as an edge.
        voxel_size: one number or (x, y, z) [length].

    References: Huber 1964; Charbonnier et al. 1997 (half-quadratic majoriser).
    """

    shape: tuple[int, int, int]
    strength: float
    delta: float
    voxel_size: float | tuple[float, float, float] = 1.0

    def value(self, x: np.ndarray) -> float:
        """The penalty."""
        t = np.sqrt(sum(d * d for d in self._differences(x)))
        psi = np.where(t < self.delta, t * t / (2 * self.delta), t - self.delta / 2)
        return self._scale * float(psi.sum(dtype=np.float64))

    def gradient(self, x: np.ndarray) -> np.ndarray:
        """(n,) derivative of the penalty."""
        differences = self._differences(x)
        w = self._inverse_slope(differences)
        total = np.zeros(self.shape, x.dtype)
        for axis, d in enumerate(differences):
            flux = np.delete(w * d, -1, axis) / self._spacing[axis]
            total[_part(axis, slice(1, None))] += flux
            total[_part(axis, slice(None, -1))] -= flux
        return (total * self._scale).reshape(-1).astype(x.dtype)

    def curvature(self, x: np.ndarray, p: np.ndarray) -> float:
        """Second derivative of the majoriser at ``x`` along ``p``."""
        w = self._inverse_slope(self._differences(x))
        return self._scale * float(sum((w * d * d).sum(dtype=np.float64) for d in self._differences(p)))

    def separable(self, x: np.ndarray) -> np.ndarray:
        """(n,) diagonal that majorises: ``(p - q)^2 <= 2 p^2 + 2 q^2`` on each difference."""
        w = self._inverse_slope(self._differences(x))
        total = np.zeros(self.shape, x.dtype)
        for axis, h in enumerate(self._spacing):
            part = 2 * np.delete(w, -1, axis) / h**2
            total[_part(axis, slice(1, None))] += part
            total[_part(axis, slice(None, -1))] += part
        return (total * self._scale).reshape(-1).astype(x.dtype)

    def share_of_edges(self, x: np.ndarray) -> float:
        """The share of voxels whose slope is ``delta`` or more: kept as edges, not smoothed as noise."""
        t = np.sqrt(sum(d * d for d in self._differences(x)))
        return float(np.mean(t >= self.delta))

    @property
    def _spacing(self) -> np.ndarray:
        return np.broadcast_to(np.asarray(self.voxel_size, float), (3,))[::-1]

    @property
    def _scale(self) -> float:
        return self.strength * float(np.prod(self._spacing))

    def _differences(self, x: np.ndarray) -> list[np.ndarray]:
        x = x.reshape(self.shape)
        return [
            np.diff(x, axis=i, append=x[_part(i, slice(-1, None))]) / h.astype(x.dtype) for i, h in enumerate(self._spacing)
        ]

    def _inverse_slope(self, differences: list[np.ndarray]) -> np.ndarray:
        return 1.0 / np.maximum(np.sqrt(sum(d * d for d in differences)), self.delta)


def _part(axis: int, where: slice) -> tuple[slice, ...]:
    return tuple(where if i == axis else slice(None) for i in range(3))
