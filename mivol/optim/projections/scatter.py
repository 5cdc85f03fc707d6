r"""Scattered light as a smooth term of the detector, fitted by the consistency of the views.

Views of one object agree: their line integrals y lie in the range of the projector A. Scattered light S adds to the light, so
``-log(exp(-A x) + S)`` leaves this range. Legendre polynomials in the columns and rows of the detector, with coefficients
c that hold for all views, and an unknown object x minimise

.. math:: \sum w \, (-\log(T - S(c)) - A x)^2 .

Each Gauss-Newton step eliminates x: the residual, and the derivative of the line integrals by each coefficient, lose what the
object can explain (variable projection). A voxel far from the object, by the last reconstruction, stays empty, so the air
beside the object shows S directly. Derivatives come from the modelled light: with measured light their noise would bias the
fit.

Line integrals are averaged over blocks of pixels and smoothed along the detector. Smoothed views show a smoothed object, so
coarse voxels suffice. Noise raises the mean of a logarithm by half of its variance, which is subtracted first.

Bias: 0.001 of the light without noise, for heads and forty ellipsoids (``mivol bench preparation --only scatter``).

References: Golub & Pereyra 1973, SIAM J. Numer. Anal. 10, 413 (variable projection); White 1980, Econometrica 48, 817 (variance
from the scatter of parts); Ohnesorge, Flohr & Klingenbeck-Regn 1999, Eur. Radiol. 9, 563 (scatter as a smooth term).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.polynomial.legendre import Legendre
from scipy.ndimage import binary_dilation, gaussian_filter
from scipy.sparse.linalg import LinearOperator, lsqr

from mivol.errors import MivolError
from mivol.tomography.filtered import feldkamp, filtered_backprojection
from mivol.tomography.geometry import ConeBeam, ParallelBeam, VoxelGrid
from mivol.tomography.preprocess import interpolate_gaps, subtract_scatter
from mivol.tomography.projector import Projector
from mivol.tomography.stored import matrix_bytes, store_matrix

DEGREE = 2
"""Degree of the polynomials."""

MOST_COLUMNS, CONE_COLUMNS, MOST_LAYERS, MOST_RAYS = 64, 32, 8, 25_000
"""Blocks of pixels along the columns, of a parallel and of a cone beam, and along the rows of a parallel beam; and rays, above
which views are left out."""

SMOOTHING = 1.5
"""Standard deviation of the smoothing [block]."""

ROUNDS, ITERATIONS, DAMPING = 3, 40, 2e-3
"""Gauss-Newton steps; iterations of LSQR in each; damping over the largest singular value of A (a bound)."""

EMPTY = 0.1
"""Share of the brightest percentile of voxels below which a voxel is empty, two blocks away from others."""

LEAST_LINE = 0.02
"""Largest line integral of rays that miss the object."""

FLOOR = 1e-3
"""Standard deviation of the method itself, over the light."""

MOST_NOISE = 0.25
"""Largest variance of a line integral whose mean is corrected."""

NEEDED = 3.0
"""Standard deviations above which scattered light is subtracted."""


@dataclass(frozen=True, eq=False)
class Scatter:
    """Scattered light of a scan, over the light without object.

    Attributes:
        light: (rows, cols), the same in all views.
        sigma: (rows, cols), its standard deviation.
        air: scattered light in the air beside the object, if the views were divided by that air; otherwise 0.
        is_needed: whether ``light`` is above ``NEEDED`` deviations somewhere.
    """

    light: np.ndarray
    sigma: np.ndarray
    air: float
    is_needed: bool

    def subtract(self, y: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Line integrals of the light that was not scattered, and their weights; 0 at pixels darker than the scatter."""
        lines, weights = subtract_scatter(y, weights, self.light)
        return np.where(weights > 0, lines + np.log(1 - self.air), 0.0), weights


def fit_scatter(beam: ParallelBeam | ConeBeam, y: np.ndarray, weights: np.ndarray, air_columns: int = 0) -> Scatter:
    """Fit scattered light to the line integrals of a scan whose object lies within the columns of the detector.

    Args:
        beam: geometry.
        y: line integrals (views, rows, cols).
        weights: inverse variances; for unknown noise, as of many quanta, because noise raises the mean of logarithms.
        air_columns: columns of air at each edge, by which the views were divided; 0: the flats tell the light.

    Raises:
        MivolError: no object, an object that reaches the edges of the detector, or air darker than the flats.
    """
    small, average, views = _coarsen(beam, y.shape)
    grid = _voxels(small)
    a = Projector(small, grid, views)
    if matrix_bytes(a) is not None:
        a = store_matrix(a)
    shapes = _polynomials(*y.shape[1:])
    edge = np.r_[:air_columns, y.shape[2] - air_columns : y.shape[2]] if air_columns else np.r_[:0]
    at_edges = shapes[..., edge].mean((1, 2)) if air_columns else np.zeros(len(shapes))
    filled = interpolate_gaps(y, weights)[views]
    light, blocks = np.exp(-filled), np.stack([average(shape[None])[0] for shape in shapes])
    used = weights[views] > 0
    variance = np.where(used, light**2 / np.where(used, weights[views], 1.0), 0.0)
    found, covariance = np.zeros(len(shapes)), np.zeros((len(shapes),) * 2)
    for _ in range(ROUNDS):
        left = np.maximum(light - np.tensordot(found, shapes, 1), 1e-3)
        noise = 0.5 * np.minimum(variance / left**2, MOST_NOISE)
        lines = average(-np.log(left / (1 - found @ at_edges)) - noise)
        with np.errstate(divide="ignore"):
            # Counts have the variance of the light: of the logarithm, light / left^2.
            scale = np.sqrt(1 / average(light / left**2))
        task = _Consistency(a, scale / scale.mean(), lines)
        predicted = task.explain(lines)
        slopes = np.exp(np.clip(predicted, 0, 6)) * blocks[:, None] - (at_edges / (1 - found @ at_edges))[:, None, None, None]
        residual = task.scale * (lines - predicted)
        left_over = np.stack([task.scale * (slope - task.explain(slope)) for slope in slopes], -1)
        inverse = np.linalg.inv(np.einsum("vrci,vrcj->ij", left_over, left_over))
        step = -inverse @ np.einsum("vrci,vrc->i", left_over, residual)
        pull = np.einsum("vrci,vrc->vi", left_over, residual + left_over @ step)
        covariance = inverse @ (pull.T @ pull) @ inverse
        found = found + step
    _check(predicted, found, shapes)
    sigma = np.sqrt(np.einsum("irc,ij,jrc->rc", shapes, covariance, shapes) + FLOOR**2)
    scattered = np.tensordot(found, shapes, 1)
    return Scatter(scattered, sigma, float(found @ at_edges), bool((scattered > NEEDED * sigma).any()))


def _check(predicted: np.ndarray, found: np.ndarray, shapes: np.ndarray) -> None:
    """Refuse an object beyond the detector, and light below 0."""
    outer = np.abs(predicted[..., [0, -1]]).mean()
    if outer > 0.05 * predicted.max():
        raise MivolError(
            "found an object that reaches the edges of the detector, expected air beside it to find scattered light by: leave "
            "data.scatter out."
        )
    least = float(np.tensordot(found, shapes, 1).min())
    if least < -0.05:
        raise MivolError(
            f"found scattered light of {least:.2g} of the light, expected none below 0: flats of another exposure look like "
            "that, set data.air to the columns of air at each edge."
        )


def _coarsen(
    beam: ParallelBeam | ConeBeam, shape: tuple[int, int, int]
) -> tuple[ParallelBeam | ConeBeam, Callable[[np.ndarray], np.ndarray], np.ndarray]:
    """The beam of blocks of pixels; what averages images over blocks and smooths them; and the views that take part."""
    views, rows, columns = shape
    # Layers of a parallel beam are independent: they need no smoothing, and few of them serve.
    is_parallel = isinstance(beam, ParallelBeam)
    wide = max(1, -(-columns // (MOST_COLUMNS if is_parallel else CONE_COLUMNS)))
    high = max(1, -(-rows // MOST_LAYERS)) if is_parallel else min(wide, rows)
    count = rows // high, columns // wide
    first = (rows - count[0] * high) // 2, (columns - count[1] * wide) // 2
    inner = np.s_[:, first[0] : first[0] + count[0] * high, first[1] : first[1] + count[1] * wide]

    def average(images: np.ndarray) -> np.ndarray:
        blocks = images[inner].reshape(len(images), count[0], high, count[1], wide).mean((2, 4))
        return gaussian_filter(blocks, (0, 0 if is_parallel else SMOOTHING, SMOOTHING), mode="nearest")

    cut = [(2 * f + n * b - m) / 2 for f, n, b, m in zip(first, count, (high, wide), (rows, columns), strict=True)]
    small = replace(
        beam,
        detector=count,
        pitch=(high * beam.pitch[0], wide * beam.pitch[1]),
        detector_offset=tuple(o + c * p for o, c, p in zip(beam.detector_offset, cut, beam.pitch, strict=True)),
    )
    step = max(1, -(-views * count[0] * count[1] // MOST_RAYS))
    return small, average, np.arange(0, views, step)


def _voxels(beam: ParallelBeam | ConeBeam) -> VoxelGrid:
    """Voxels as large as blocks at the axis; of a cone beam also beyond its first and last rows."""
    rows, columns = beam.detector
    scale = beam.source_to_detector / beam.source_to_axis if isinstance(beam, ConeBeam) else 1.0
    layers = rows if isinstance(beam, ParallelBeam) else rows + 2 * (rows // 4)
    height, edge = (pitch / scale for pitch in beam.pitch)
    middle = beam.detector_offset[0] / scale
    return VoxelGrid((layers, columns, columns), (edge, edge, height), (0.0, 0.0, middle))


def _polynomials(rows: int, columns: int) -> np.ndarray:
    """Products of Legendre polynomials (count, rows, columns) up to ``DEGREE``; of fewer than four rows along columns alone."""
    u = np.linspace(-1, 1, columns)[None] * np.ones((rows, 1))
    v = (np.linspace(-1, 1, rows) if rows > 1 else np.zeros(1))[:, None] * np.ones((1, columns))
    degrees = [(n - k, k) for n in range(DEGREE + 1) for k in range(n + 1) if not k or rows >= 4]
    return np.stack([Legendre.basis(m)(u) * Legendre.basis(k)(v) for m, k in degrees])


class _Consistency:
    """Weighted least squares of an object that stays empty far from its first reconstruction."""

    def __init__(self, a: Projector, scale: np.ndarray, lines: np.ndarray) -> None:
        self.scale = scale
        lines_of, flat = a.as_linear_operator(), scale.ravel()
        method = filtered_backprojection if isinstance(a.geometry, ParallelBeam) else feldkamp
        x = method(a, lines)
        near = binary_dilation(x > EMPTY * np.percentile(x, 99), np.ones((min(3, x.shape[0]), 3, 3)), iterations=2)
        if lines.max() < LEAST_LINE:
            raise MivolError("found no object in the views, expected one to find scattered light by: leave data.scatter out.")
        inside = near.astype(np.float32).ravel()
        self._damping = DAMPING * float(np.sqrt(a.column_sums.max() * a.row_sums.max()))
        # The functions do not hold self: a circle would be freed at any time, even while Dr.Jit records, which aborts.
        self._operator = LinearOperator(
            lines_of.shape,
            matvec=lambda v: flat * (lines_of @ (inside * v)),
            rmatvec=lambda r: inside * (lines_of.T @ (flat * r)),
            dtype=np.float64,
        )

    def explain(self, lines: np.ndarray) -> np.ndarray:
        """The nearest line integrals of an object."""
        b = (self.scale * lines).ravel()
        x = lsqr(self._operator, b, damp=self._damping, iter_lim=ITERATIONS, atol=1e-7, btol=1e-7)[0]
        return (self._operator @ x).reshape(lines.shape) / self.scale
