"""Total variation with a quadratic bottom: a penalty of a field in NumPy, scaled to the noise of a scan on request.

References: Huber 1964; Charbonnier et al. 1997 (half-quadratic majoriser); Rudin, Osher & Fatemi 1992.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mivol.optim.projections.linear_problems import flatten
from mivol.tomography.projector import Projector


@dataclass(frozen=True)
class SmoothedTV:
    """Total variation with a quadratic bottom (Huber on the length of the gradient): ``strength sum psi(|grad x|) dV``.

    ``psi(t) = t^2 / (2 delta)`` below ``delta`` and ``t - delta / 2`` above; differences are forward, and 0 at the far
    borders.

    Args:
        shape: (Z, Y, X).
        strength: factor on the sum [1/length], which makes the penalty dimensionless.
        delta: slope [value per length] below which noise is smoothed instead of preserved as an edge.
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
        """Share of voxels with a slope of ``delta`` or more, which are preserved as edges."""
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


CHORD = 0.47
"""``sum a^2 / sum a`` over the rays through a voxel of edge 1, whose share of a trilinear field falls to 0 at its neighbours:
2/3 for the distance along the detector's rows (0.70 averaged over directions), times 2/3 for the distance along z. Rays through
the centres of layers have the first factor only, and a balance 1.2 times as strong."""


def scale_tv_to_noise(a: Projector, y: np.ndarray, weights: np.ndarray, tv: float, delta: float) -> SmoothedTV:
    """Total variation in units of the scan's own noise and values, independent of lengths, quanta and materials.

    The data act on a voxel with the gradient ``A^T W r``, whose standard deviation from noise is ``sqrt(sum_i w_i a_ij^2)``.
    Total variation acts through each face with at most ``strength dV / h``. At ``tv`` = 1 both are equal at the median of the
    visible voxels, with ``a_ij^2`` approximated by ``0.47 h a_ij``. ``delta`` = 1 is a slope of the scan's mean value over one
    voxel. The mean value is ``sum w y c / sum w c^2``, with a ray's path length c in the grid.

    Args:
        a: projector of the fitted views.
        y, weights: (views, rows, cols), with variances 1 / weights.
        tv: strength in units of the balance.
        delta: in units of the mean value per voxel.
    """
    edge = float(np.prod(a.grid.voxel_size) ** (1 / 3))
    w = np.asarray(weights, np.float64)
    sensitivity = np.asarray(a.T @ flatten(w, a.dtype), np.float64)
    pull = np.sqrt(CHORD * edge * np.median(sensitivity[sensitivity > 0])) if (sensitivity > 0).any() else 0.0
    chord = np.asarray(a @ np.ones(a.shape[1], a.dtype), np.float64).reshape(w.shape)
    mean = abs(float(np.sum(w * y * chord))) / max(float(np.sum(w * chord**2)), np.finfo(float).tiny)
    slope = delta * mean / edge
    return SmoothedTV(a.grid.shape, tv * float(pull) / edge**2, slope or np.finfo(np.float32).tiny, a.grid.voxel_size)
