"""Find the rotation axis of a parallel-beam scan on the detector.

Conventions. Line integrals ``y`` are (views, rows, cols); columns are counted from 0 at pixel centres, so the middle of a
detector of C columns is (C - 1) / 2. Angles are in radians.

References: Helgason 1965 and Ludwig 1966 (moments of a sinogram); Vo et al. 2014 (the axis from mirrored views); Donath,
Beckmann & Schreyer 2006 (axis from trial reconstructions).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy import ndimage, optimize

from mivol.errors import MivolError
from mivol.tomography.filtered import filtered_backprojection
from mivol.tomography.geometry import ParallelBeam, VoxelGrid
from mivol.tomography.projector import Projector

__all__ = ["Axis", "axis_from_mirrors", "axis_from_moments", "axis_from_reconstructions", "find_axis"]


@dataclass(frozen=True)
class Axis:
    """The rotation axis on the detector.

    Args:
        column: column in pixels, counted from 0 at the first column's centre.
        uncertainty: standard deviation [pixels].
        method: method of the search.
    """

    column: float
    uncertainty: float
    method: str

    def offset(self, n_columns: int, pitch: float = 1.0) -> float:
        """The ``axis_offset`` of a :class:`~mivol.tomography.geometry.ParallelBeam` with ``n_columns`` columns [length]."""
        return (self.column - (n_columns - 1) / 2) * pitch


def axis_from_mirrors(y: np.ndarray, angles: np.ndarray, n_pairs: int = 12) -> Axis:
    """Find the axis from views half a turn apart, which are mirror images about the axis.

    Each of the ``n_pairs`` pairs nearest to half a turn gives the column of the best mirror image (least squares, cubic
    interpolation). A pair that misses half a turn by ``e`` is off by about ``slope e``; a straight line through the columns of
    all pairs is read at ``e = 0``.

    Args:
        y: (views, rows, cols) line integrals of a parallel beam.
        angles: (views,) [rad].
        n_pairs: most pairs to use.

    Raises: MivolError: no two views within 5 degrees of half a turn, or an empty view among them.
    """
    first, second, miss = _opposite_pairs(np.asarray(angles, float), n_pairs)
    used = np.union1d(first, second)
    flat = used[np.ptp(y[used], axis=-1).max(axis=-1) <= 0]
    if len(flat):
        raise MivolError(f"Found view {flat[0]} without contrast, expected an object in every view.")
    columns = np.array([_find_mirror_column(y[i], y[j]) for i, j in zip(first, second, strict=True)])
    uneven = np.ptp(miss) > 1e-9
    design = np.stack([np.ones_like(miss), miss], 1) if uneven else np.ones((len(miss), 1))
    column, sigma = _fit_first_coefficient(design, columns)
    return Axis(column, sigma, f"mirror images, {len(miss)} pairs of views")


def axis_from_moments(y: np.ndarray, angles: np.ndarray) -> Axis:
    """Find the axis from the centre of mass of each view, which follows ``c + a cos(theta) + b sin(theta)`` (Ludwig).

    The method needs the whole object in every view and air at 0: a constant error of the air pulls the centre of mass towards
    the middle of the detector. The standard deviation is the scatter of the views, or of the rows if larger: errors of the
    flats are the same in all views, and only rows reveal them.

    Args:
        y: (views, rows, cols) line integrals of a parallel beam.
        angles: (views,) [rad].
    """
    mass = y.sum(-1)
    if not (mass > 0).all():
        raise MivolError("Found a row of a view with no absorption in it, expected an object in every row and view.")
    centres = (y @ np.arange(y.shape[-1])) / mass
    design = np.stack([np.ones_like(angles), np.cos(angles), np.sin(angles)], 1)
    columns, sigmas = np.transpose([_fit_first_coefficient(design, centres[:, row]) for row in range(y.shape[1])])
    variance = max(np.mean(sigmas**2), np.var(columns, ddof=1) if len(columns) > 1 else 0.0) / len(columns)
    return Axis(float(columns.mean()), float(np.sqrt(variance)), "moments of the shadows")


def axis_from_reconstructions(y: np.ndarray, weights: np.ndarray, angles: np.ndarray, start: float, width: float = 2.0) -> Axis:
    """Refine the axis: find the column at which half of the views best predicts the other half.

    Each trial back-projects every other view with a filter, projects to the views between, and takes the weighted mean squared
    residual. A parabola is fitted to five trial columns, then again on a quarter of the width. The halves then change roles,
    and the estimate is the mean of both results. The standard deviation comes from the parabola's curvature (with the residual
    as noise), or from half of the difference of both results if larger.

    Args:
        y: (views, rows, cols) line integrals of a parallel beam; only the middle row or two are used.
        weights: inverse variances of ``y``.
        angles: (views,) [rad], evenly over half a turn or a whole turn.
        start: first column of the search.
        width: half width of the search [pixels].

    Raises: MivolError: no minimum of the misfit within the search.
    Cost: for each of the 20 trials an A and two A^T over half of the views, at the detector's resolution.
    """
    middle = slice((y.shape[1] - 1) // 2, y.shape[1] // 2 + 1)
    y, weights = y[:, middle], weights[:, middle]
    halves = (slice(0, None, 2), slice(1, None, 2))
    estimates = []
    for known_part, hidden_part in (halves, halves[::-1]):

        def misfit(column: float, known_part: slice = known_part, hidden_part: slice = hidden_part) -> float:
            return _held_out_misfit(y, weights, angles, column, known_part, hidden_part)

        n = int((weights[hidden_part] > 0).sum())
        coarse, _ = _parabola_minimum(misfit, start, width, n)
        estimates.append(_parabola_minimum(misfit, coarse, width / 4, n))
    (a, sigma_a), (b, sigma_b) = estimates
    sigma = max(abs(a - b) / 2, float(np.hypot(sigma_a, sigma_b)) / 2)
    return Axis((a + b) / 2, sigma, "one half of the views predicted from the other")


def find_axis(y: np.ndarray, weights: np.ndarray, angles: np.ndarray) -> Axis:
    """Find the rotation axis of a parallel-beam scan: by mirror images (else by moments), refined by reconstructions.

    The result is the refined column. Its uncertainty is at least half of the distance from the rough column, because finite
    pixels and drifting light move both columns by more than noise does.

    Args:
        y: (views, rows, cols) line integrals.
        weights: inverse variances of ``y``.
        angles: (views,) [rad].
    """
    try:
        rough = axis_from_mirrors(y, angles)
    except MivolError:
        rough = axis_from_moments(y, angles)
    fine = axis_from_reconstructions(y, weights, angles, rough.column)
    return replace(fine, uncertainty=max(fine.uncertainty, abs(fine.column - rough.column) / 2))


def _opposite_pairs(angles: np.ndarray, n_pairs: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(first, second, angle beyond half a turn), the best pairs first."""
    i, j = np.triu_indices(len(angles), 1)
    miss = np.mod(angles[j] - angles[i], 2 * np.pi) - np.pi
    best = np.argsort(np.abs(miss), kind="stable")[:n_pairs]
    best = best[np.abs(miss[best]) < np.radians(5)]
    if len(best) == 0:
        raise MivolError("Found no two views half a turn apart (to 5 degrees), expected some: use axis_from_moments.")
    return i[best], j[best], miss[best]


def _find_mirror_column(a: np.ndarray, b: np.ndarray) -> float:
    """Column c of the best fit of ``a(s) = b(2 c - s)``; ``a`` and ``b`` are (rows, cols)."""
    n = a.shape[-1]
    # sum_s a(s) b(k - s), k = 2 c, is a convolution: its peak is the best whole k.
    size = 2 * n
    k0 = int(np.fft.irfft((np.fft.rfft(a, size) * np.fft.rfft(b, size)).sum(0), size).argmax())
    s = np.arange(n, dtype=float)
    spline = ndimage.spline_filter1d(b, axis=-1, mode="nearest")

    def misfit(c: float) -> float:
        mirrored = [ndimage.map_coordinates(row, [2 * c - s], mode="nearest", prefilter=False) for row in spline]
        return float(np.sum((a - np.array(mirrored)) ** 2))

    return float(optimize.minimize_scalar(misfit, bounds=(k0 / 2 - 1, k0 / 2 + 1), method="bounded").x)


def _fit_first_coefficient(design: np.ndarray, values: np.ndarray) -> tuple[float, float]:
    """(first coefficient, its standard deviation) of a least-squares fit."""
    coefficients, *_ = np.linalg.lstsq(design, values, rcond=None)
    freedom = max(len(values) - design.shape[1], 1)
    scatter = np.sum((values - design @ coefficients) ** 2) / freedom
    return float(coefficients[0]), float(np.sqrt(scatter * np.linalg.pinv(design.T @ design)[0, 0]))


def _held_out_misfit(
    y: np.ndarray, weights: np.ndarray, angles: np.ndarray, column: float, known_part: slice, hidden_part: slice
) -> float:
    rows, cols = y.shape[1:]
    n = 2 * _object_radius(y, column) + 1
    grid, offset = VoxelGrid((rows, n, n)), Axis(column, 0.0, "trial").offset(cols)
    beams = (ParallelBeam(angles[part], (rows, cols), axis_offset=offset) for part in (known_part, hidden_part))
    known, hidden = (Projector(beam, grid) for beam in beams)
    predicted = hidden @ filtered_backprojection(known, y[known_part])
    w, target = weights[hidden_part], y[hidden_part]
    # Filtered back-projection of few views loses some scale: fit a factor.
    scale = np.sum(w * predicted * target) / np.sum(w * predicted**2)
    return float(np.sum(w * (target - scale * predicted) ** 2) / np.sum(w > 0))


def _object_radius(y: np.ndarray, column: float) -> int:
    """Pixels from the axis to the outermost pixel that ever sees a tenth of the densest ray, plus a tenth."""
    seen = np.flatnonzero((y > 0.1 * y.max()).any(axis=(0, 1)))
    return int(np.ceil(1.1 * np.abs(seen - column).max()))


def _parabola_minimum(f: Callable[[float], float], centre: float, width: float, n: int) -> tuple[float, float]:
    """(abscissa, standard deviation) of the minimum of a parabola fitted to a mean of ``n`` weighted squares."""
    offsets = np.linspace(-1.0, 1.0, 5)
    a, b, c = map(float, np.polyfit(offsets, [f(centre + width * o) for o in offsets], 2))
    if a <= 0 or abs(b) > 2 * a:
        raise MivolError(
            f"Found no least misfit between columns {centre - width:.1f} and {centre + width:.1f}, expected one: start "
            "nearer, or search wider."
        )
    # At a standard deviation from the minimum, n a (offset / sigma)^2 rises by the mean square of the residual.
    return centre - width * b / (2 * a), width * float(np.sqrt((c - b * b / (4 * a)) / (n * a)))
