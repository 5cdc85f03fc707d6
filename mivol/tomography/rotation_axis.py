"""Find the rotation axis on the detector, for parallel beams and for circular cone beams.

Conventions. Line integrals ``y`` are (views, rows, cols); columns are counted from 0 at pixel centres, so the middle of a
detector of C columns is (C - 1) / 2. Angles are in radians.

Cone beams. ``alpha`` is the angle [rad] between a ray and the central ray, positive towards larger columns; the axis appears
at ``alpha = epsilon``. In the plane of the source's circle, and in the geometry of :mod:`mivol.tomography.geometry`, the ray
(theta, alpha) and the ray (theta + pi + 2 epsilon - 2 alpha, 2 epsilon - alpha) run along the same line from its two ends.
Sort both rays by the direction of the line, ``phi = theta - alpha``. A cone-beam ray and its opposite then form a
parallel-beam pair, half a turn apart: ``P(phi, alpha) = P(phi + pi, 2 epsilon - alpha)``. The result is the column of the
axis. The place of the central ray is not estimated: ``detector_offset`` is taken as given.

References: Helgason 1965 and Ludwig 1966 (moments of a sinogram); Vo et al. 2014 (the axis from mirrored views); Donath,
Beckmann & Schreyer 2006 (axis from trial reconstructions); Parker 1982, Med. Phys. 9, 254 (the two ends of a line); White 1980,
Econometrica 48, 817 (the variance of a least-squares fit from the scatter of its parts).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy import interpolate, ndimage, optimize

from mivol.errors import MivolError
from mivol.tomography.filtered import covers_circle, filtered_backprojection, widest_gap
from mivol.tomography.geometry import ConeBeam, ParallelBeam, VoxelGrid
from mivol.tomography.preprocess import interpolate_gaps
from mivol.tomography.projector import Projector


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


# -- Cone beams ------------------------------------------------------------------------------------------------------------


MAX_ROWS, MAX_DIRECTIONS = 4, 360
"""Rows and directions of lines; more are not needed, since each pair of views of a row gives the axis to a fraction of a
column."""

SEARCH_DIRECTIONS, MIN_OVERLAP, MIN_CORRELATION = 24, 0.02, 0.5
"""Limits of the search for the nearest column: number of directions; smallest share of slopes measured twice; smallest
correlation of slopes for matching ends (1 without noise; noise alone stays below 0.2 for 24 directions with 5 independent
columns each)."""

SECTORS = 24
"""Sectors of directions. The disagreement of the sectors gives the uncertainty: Student's t with 23 degrees of freedom."""


SAMPLING_ERROR = 0.01
"""Standard deviation [columns] caused by edges between columns and views: the largest error without noise for a head in 60 to
360 views."""


@dataclass(frozen=True, eq=False)
class MirroredRows:
    """Projections of a row, sorted by the direction of their lines, and the projections half a turn away.

    Attributes:
        here, there: (directions, cols) line integrals, smoothed; ``there`` as a spline in the column.
        weights_here, weights_there: 0 for unmeasured rays.
    """

    here: np.ndarray
    there: interpolate.CubicSpline
    weights_here: np.ndarray
    weights_there: np.ndarray


def axis_from_fans(y: np.ndarray, weights: np.ndarray, beam: ConeBeam) -> Axis:
    """Find the column of the axis at which opposite rays along the same line agree best (weighted least squares).

    Only rows next to the plane of the source's circle are used: opposite rays then part by at most half a row. Columns are
    smoothed by at least a column, and by half of the movement of an edge between neighbouring views, so interpolation between
    columns and views prefers no column. The standard deviation comes from 24 sectors of directions, by the scatter of their
    slopes about 0 at the minimum. The scatter includes noise of every distribution, and errors of the light and of the
    geometry.

    Args:
        y: (views, rows, cols) line integrals.
        weights: inverse variances of ``y``; 0: not used.
        beam: angles, distances and pixels; its ``axis_offset`` is ignored.

    Raises:
        MivolError: no row near the plane of the circle, no line measured twice, or no minimum of the misfit.
    """
    pairs = [_pair_rows(y[:, row], weights[:, row], beam) for row in _rows_in_the_plane(beam)]
    alpha = _fan_angles(beam)
    column = _nearest_column(pairs[0], beam, alpha)
    for width in (2.0, 0.5, 0.5):
        # Weights of the middle serve all five trials: an overlap that grows with the trial would move the minimum.
        fixed = [_pair_weights(pair, _mirrored_columns(beam, alpha, column)) for pair in pairs]

        def misfit(trial: float, fixed: list[np.ndarray] = fixed) -> np.ndarray:
            columns = _mirrored_columns(beam, alpha, trial)
            return np.sum([_sector_misfits(pair, columns, w) for pair, w in zip(pairs, fixed, strict=True)], axis=0)

        column, sigma = _sector_minimum(misfit, column, width)
    method = f"rays measured from both ends, {len(pairs)} row" + "s" * (len(pairs) > 1)
    return Axis(column, float(np.hypot(sigma, SAMPLING_ERROR)), method)


def cone_axis_offset(axis: Axis, beam: ConeBeam) -> float:
    """The ``axis_offset`` of a cone beam with the axis at a column [length]."""
    return _detector_position(beam, axis.column) * beam.source_to_axis / beam.source_to_detector


def _detector_position(beam: ConeBeam, column: float | np.ndarray) -> float | np.ndarray:
    """Distance of a column from the central ray, on the detector [length]."""
    return (column - (beam.detector[1] - 1) / 2) * beam.pitch[1] + beam.detector_offset[1]


def _fan_angles(beam: ConeBeam) -> np.ndarray:
    """Alpha of each column."""
    return np.arctan(_detector_position(beam, np.arange(beam.detector[1])) / beam.source_to_detector)


def _mirrored_columns(beam: ConeBeam, alpha: np.ndarray, column: float) -> np.ndarray:
    """Columns (cols,) of the opposite rays, for an axis at ``column``."""
    epsilon = np.arctan(_detector_position(beam, column) / beam.source_to_detector)
    place = beam.source_to_detector * np.tan(2 * epsilon - alpha)
    return (place - beam.detector_offset[1]) / beam.pitch[1] + (beam.detector[1] - 1) / 2


def _rows_in_the_plane(beam: ConeBeam) -> np.ndarray:
    """Up to MAX_ROWS rows next to the plane of the circle.

    Two opposite rays rising by ``v / source_to_detector`` cross at the axis. At a distance r they are ``2 r v /
    source_to_detector`` apart, which must be at most half the height of a row at the axis.
    """
    widest = np.abs(_detector_position(beam, np.array([0, beam.detector[1] - 1]))).max()
    reach = widest * beam.source_to_axis / beam.source_to_detector
    limit = max(beam.pitch[0] * beam.source_to_axis / (4 * reach), 0.5 * beam.pitch[0] * (1 + 1e-9))
    near = np.argsort(np.abs(beam.v), kind="stable")[:MAX_ROWS]
    near = near[np.abs(beam.v[near]) <= limit]
    if not len(near):
        raise MivolError("found no row of the detector in the plane of the source's circle, expected one to find the axis by.")
    return near


def _pair_rows(y: np.ndarray, weights: np.ndarray, beam: ConeBeam) -> MirroredRows:
    """Sort a row (views, cols) by direction."""
    alpha, cols = _fan_angles(beam), beam.detector[1]
    turn = _ViewSpline.from_views(interpolate_gaps(y[:, None], weights[:, None])[:, 0], weights, beam.angles)
    phi = np.pi * np.arange(turn.directions) / turn.directions
    # Movement of an edge at the widest ray between neighbouring views [columns].
    step = np.ptp(alpha) / 2 * (np.pi / turn.directions) * beam.source_to_detector / beam.pitch[1]
    width = max(1.0, step)
    sides = [_smooth(*turn.at(phi[:, None] + alpha + half), width) for half in (0.0, np.pi)]
    (here, weights_here), (there, weights_there) = sides
    return MirroredRows(here, interpolate.CubicSpline(np.arange(cols), there, axis=1), weights_here, weights_there)


def _smooth(value: np.ndarray, weights: np.ndarray, was_seen: np.ndarray, width: float) -> tuple[np.ndarray, np.ndarray]:
    """Smooth by a Gaussian over ``width`` columns; the weight is 0 where the Gaussian reaches unmeasured columns."""
    margin = 2 * min(int(np.ceil(2 * width)), value.shape[1] // 8) + 1
    whole = ndimage.minimum_filter1d(was_seen.astype(np.uint8), margin, axis=1, mode="constant")
    return ndimage.gaussian_filter1d(value, width, axis=1, mode="nearest"), np.where(whole, weights, 0.0)


@dataclass(frozen=True, eq=False)
class _ViewSpline:
    """A row of a scan interpolated between views: a spline in theta, periodic for views all around the circle."""

    spline: interpolate.CubicSpline
    theta: np.ndarray
    weights: np.ndarray
    is_closed: bool
    directions: int

    @classmethod
    def from_views(cls, y: np.ndarray, weights: np.ndarray, angles: np.ndarray) -> _ViewSpline:
        """Args: y, weights: (views, cols)."""
        is_closed = covers_circle(angles, 2 * np.pi)
        start = 0.0 if is_closed else widest_gap(angles, 2 * np.pi)[1]
        theta, first = np.unique(np.round(np.mod(angles - start + 1e-9, 2 * np.pi) - 1e-9, 9), return_index=True)
        y, weights = y[first], weights[first]
        if len(theta) < 4:
            raise MivolError(f"found {len(theta)} different view angles, expected at least 4 to find the rotation axis by.")
        directions = int(min(np.ceil(np.pi / np.median(np.diff(theta))), MAX_DIRECTIONS))
        theta = theta + start
        if is_closed:
            theta = np.append(theta, theta[0] + 2 * np.pi)
            y, weights = np.concatenate([y, y[:1]]), np.concatenate([weights, weights[:1]])
        spline = interpolate.CubicSpline(theta, y, bc_type="periodic" if is_closed else "not-a-knot")
        return cls(spline, theta, weights, is_closed, directions)

    def at(self, theta: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Line integrals, weights, and whether the ray was measured, for angles (directions, cols).

        Beyond the views, the nearest view stands in and counts as unmeasured.
        """
        theta = np.mod(theta - self.theta[0] + 1e-9, 2 * np.pi) + self.theta[0] - 1e-9
        was_seen = theta <= self.theta[-1] + 1e-9
        beyond = np.where(theta < (self.theta[0] + self.theta[-1]) / 2 + np.pi, self.theta[-1], self.theta[0])
        theta = np.where(was_seen, theta, beyond)
        before = np.clip(np.searchsorted(self.theta, theta, side="right") - 1, 0, len(self.theta) - 2)
        along, columns = theta - self.theta[before], np.arange(theta.shape[1])
        value = np.zeros_like(theta)
        for power in self.spline.c:
            value = value * along + power[before, columns]
        return value, np.minimum(self.weights[before, columns], self.weights[before + 1, columns]), was_seen


def _pair_weights(pair: MirroredRows, columns: np.ndarray) -> np.ndarray:
    """Inverse variances (directions, cols) of the differences of mirrored rays; 0 if a ray of the pair was not measured."""
    nearest = np.rint(columns).astype(int)
    inside = (columns >= 0) & (columns <= len(columns) - 1)
    there = np.where(inside, pair.weights_there[:, np.clip(nearest, 0, len(columns) - 1)], 0.0)
    both = (pair.weights_here > 0) & (there > 0)
    return np.where(both, pair.weights_here * there / np.where(both, pair.weights_here + there, 1.0), 0.0)


def _sector_misfits(pair: MirroredRows, columns: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Weighted squared differences of mirrored rays, summed over each sector of directions (sectors,)."""
    squares = weights * (pair.here - pair.there(np.clip(columns, 0, len(columns) - 1))) ** 2
    bounds = np.linspace(0, len(squares), min(SECTORS, len(squares)) + 1).astype(int)[:-1]
    return np.add.reduceat(squares.sum(1), bounds)


def _nearest_column(pair: MirroredRows, beam: ConeBeam, alpha: np.ndarray) -> float:
    """The whole column with the highest correlation of mirrored slopes, over rays measured from both ends."""
    some = slice(None, None, max(1, len(pair.here) // SEARCH_DIRECTIONS))
    here, rising = np.gradient(pair.here[some], axis=1), pair.there.derivative()
    thinned = MirroredRows(here, pair.there, pair.weights_here[some], pair.weights_there[some])
    energy = np.sum(thinned.weights_here * here**2)
    best, found = -np.inf, 0.0
    for column in range(len(alpha)):
        columns = _mirrored_columns(beam, alpha, column)
        w = _pair_weights(thinned, columns)
        there = -rising(np.clip(columns, 0, len(alpha) - 1))[some]
        here_energy, there_energy = np.sum(w * here**2), np.sum(w * there**2)
        if 2 * min(here_energy, there_energy) <= MIN_OVERLAP * energy:
            continue
        correlation = np.sum(w * here * there) / np.sqrt(here_energy * there_energy)
        best, found = max((best, found), (correlation, float(column)))
    if best < MIN_CORRELATION:
        raise MivolError("found no structure visible from both ends of its lines, expected some: check the angles.")
    return found


def _sector_minimum(misfit: Callable[[float], np.ndarray], centre: float, width: float) -> tuple[float, float]:
    """(column, standard deviation) of the minimum of a parabola, fitted to the misfits (sectors,) at five columns.

    The slope of the misfit is a sum over sectors of independent noise. The slope is 0 at the minimum, and the scatter of the
    sectors' slopes about 0 gives the variance.
    """
    offsets = np.linspace(-1.0, 1.0, 5)
    a, b, _ = np.polyfit(offsets, [misfit(centre + width * o) for o in offsets], 2)
    if not a.sum() > 0 or abs(b.sum()) > 2 * a.sum():
        raise MivolError(f"found no column near {centre:.0f} about which rays measured from both ends agree best.")
    x = -b.sum() / (2 * a.sum())
    slopes = 2 * a * x + b
    variance = len(slopes) / (len(slopes) - 1) * np.sum(slopes**2) / (2 * a.sum()) ** 2
    return float(centre + width * x), float(width * np.sqrt(variance))
