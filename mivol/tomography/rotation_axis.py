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
from typing import NamedTuple

import numpy as np
from scipy import interpolate, ndimage

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


def axis_from_mirrors(y: np.ndarray, angles: np.ndarray, n_views: int = 360) -> Axis:
    """Find the axis from opposite views, which are mirror images about the axis.

    A view is compared with its mirror image, interpolated between views (cubic in the angle). After half a turn, the first view
    lies between the last ones and its mirrored successors, and the last view likewise. The column of the axis is the least
    squared difference over the columns that both see, less the mean difference of each row. So neither the rest of the object
    outside the detector nor a factor of the light matters. The search over all columns maximises the correlation of slopes,
    weighted by the overlap.

    Columns are smoothed by at least a column, and by half of the movement of an edge between neighbouring views. The standard
    deviation comes from the scatter of up to 24 groups, as in :func:`axis_from_fans`. A group has the columns at some distance
    from the axis, on both sides and in all views: a view and its opposite compare the same readings, and a column's wrong gain
    is in all views. If few columns are common and views are many, a group has some of the views instead.

    Args:
        y: (views, rows, cols) line integrals of a parallel beam.
        angles: (views,) [rad].
        n_views: most views to compare.

    Raises: MivolError: no view half a turn from others, a view without contrast, or views that resemble no mirror image.
    """
    here, there, are_measured = _opposite_views(y, np.asarray(angles, float), n_views)
    flat = np.flatnonzero(np.ptp(y, axis=-1).max(axis=-1) <= 0)
    if len(flat):
        raise MivolError(f"Found view {flat[0]} without contrast, expected an object in every view.")
    step = np.pi / max(_directions(np.asarray(angles, float)), 1)
    width = float(np.clip(step * y.shape[-1] / 4, 1.0, 3.0))
    column = _nearest_mirror(here, there)
    here, there = (ndimage.gaussian_filter1d(views, width, axis=-1, mode="nearest") for views in (here, there))
    spline = interpolate.CubicSpline(np.arange(y.shape[-1]), there, axis=-1)
    for reach in (2.0, 0.5, 0.5):
        s = _common_columns(y.shape[-1], column, int(np.ceil(2 * width)), reach)

        group = _mirror_groups(s, column, width, len(here))

        def misfit(trial: float, s: np.ndarray = s, group: np.ndarray | None = group) -> np.ndarray:
            difference = here[..., s] - spline(2 * trial - s)
            squares = (difference - difference.mean(-1, keepdims=True)) ** 2
            if group is not None:
                return np.bincount(group, squares.sum((0, 1)))
            return np.array([part.sum() for part in np.array_split(squares, min(SECTORS, len(squares)))])

        column, sigma = _jackknife_minimum(misfit, column, reach)
    floor = SAMPLING_ERROR if are_measured else JOIN_ERROR
    return Axis(column, float(np.hypot(sigma, floor)), f"mirror images, {len(here)} views")


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

    The result is the column of the smaller standard deviation. The refined column's includes the bumps of the misfit
    (``MISFIT_ERROR``), and is at least half of the distance between both, because wrong light moves it by more than noise does.
    The column of mirror images also holds if reconstructions have no least misfit nearby: the object is wider than the
    detector, or the light is wrong.

    Args:
        y: (views, rows, cols) line integrals.
        weights: inverse variances of ``y``.
        angles: (views,) [rad].

    Raises: MivolError: neither mirror images nor moments with a least misfit nearby.
    """
    y = interpolate_gaps(y, weights)
    try:
        rough, is_sure = axis_from_mirrors(y, angles), True
    except MivolError:
        rough, is_sure = axis_from_moments(y, angles), False
    try:
        fine = axis_from_reconstructions(y, weights, angles, rough.column)
    except MivolError:
        if is_sure:
            return replace(rough, method=f"{rough.method}; no column nearby predicts half of the views best")
        raise MivolError(
            f"found no rotation axis: opposite views show no mirror images, and no column near {rough.column:.0f} (by the "
            "centre of mass) predicts half of the views best; give scan.axis_offset, or data.find_axis = false for the middle."
        ) from None
    apart = abs(fine.column - rough.column)
    ratio = y.shape[2] / max(_directions(np.asarray(angles, float)), 1)
    bumps = np.hypot(MISFIT_ERROR, SPARSE_ERROR * ratio**2)
    fine = replace(fine, uncertainty=max(float(np.hypot(fine.uncertainty, bumps)), apart / 2))
    if not is_sure or fine.uncertainty < rough.uncertainty:
        return fine
    if apart > FAR * rough.uncertainty:
        return replace(rough, method=f"{rough.method}; reconstructions say {fine.column:.2f}, which does not count")
    return rough


MISFIT_ERROR, SPARSE_ERROR = 0.04, 0.02
"""Standard deviation [columns] of the refined column without noise: a constant, and a factor on the square of columns over
directions in half a turn. Measured for heads and blocks on 120 columns: rms .18, .056 and .041 in 40, 90 and 180 directions."""

FAR = 5.0
"""Distance of the refined from the rough column [standard deviation of the rough one] beyond which it is said."""


def _directions(angles: np.ndarray) -> int:
    """Number of directions in half a turn, by the median step of the angles."""
    theta = np.unique(np.round(np.mod(angles, 2 * np.pi), 9))
    return round(np.pi / np.median(np.diff(theta))) if len(theta) > 1 else 0


def _opposite_views(y: np.ndarray, angles: np.ndarray, n_views: int) -> tuple[np.ndarray, np.ndarray, bool]:
    """Pairs of images (pairs, rows, cols), ``here(s) = there(2 c - s)`` for an axis at column c.

    ``here`` is a view, less the part of its neighbours in its cubic interpolation; ``there`` the part of mirrored views. The
    last result is whether all directions between neighbours are mirrored views: views cover more than half a turn.
    """
    theta, first = np.unique(np.round(np.mod(angles, 2 * np.pi), 9), return_index=True)
    step = np.pi / max(_directions(angles), 1)
    found: dict[bool, list[tuple[int, list[_Node]]]] = {True: [], False: []}
    for index, at in enumerate(theta):
        own = _signed(theta - at)
        own[index] = np.inf
        nodes = _nodes(own, _signed(theta + np.pi - at), step)
        if nodes is not None:
            found[all(node.is_mirrored for node in nodes)].append((index, nodes))
    are_measured = bool(found[True])
    pairs = found[are_measured]
    if are_measured:  # a view half a turn after the first ones compares the same readings again
        pairs = [pair for pair in pairs if theta[pair[0]] < theta[pairs[0][0]] + np.pi - step / 4]
    if not pairs:
        raise MivolError("Found no two views half a turn apart, expected some: use axis_from_moments.")
    chosen = np.unique(np.linspace(0, len(pairs) - 1, min(n_views, len(pairs))).astype(int))
    rows = min(y.shape[1], max(1, MIRRORED_LINES // len(chosen)))
    rows = np.unique(np.linspace(0, y.shape[1] - 1, rows).astype(int))
    here, there = np.zeros((2, len(chosen), len(rows), y.shape[2]))
    for image, mirrored, (index, nodes) in zip(here, there, (pairs[i] for i in chosen), strict=True):
        image += y[first[index], rows]
        for weight, node in zip(_lagrange(np.array([node.place for node in nodes])), nodes, strict=True):
            part = weight * y[first[node.index], rows]
            if node.is_mirrored:
                mirrored += part
            else:
                image -= part
    return here, there, are_measured


MIRRORED_LINES = 1440
"""Most rows of all views that are compared with their mirror images."""


class _Node(NamedTuple):
    """A view in the interpolation at another: its angle from there, whether it is mirrored, its index by angle."""

    place: float
    is_mirrored: bool
    index: int


def _signed(angle: np.ndarray) -> np.ndarray:
    """Angles from -pi to pi."""
    return np.mod(angle + np.pi, 2 * np.pi) - np.pi


def _nodes(own: np.ndarray, mirrored: np.ndarray, step: float) -> list[_Node] | None:
    """One mirrored view at the same angle, or two views on either side, at least one of which is mirrored; None if missing.

    A side has mirrored views if the nearest is at most 1.25 steps away, else the view's own neighbours.

    Args:
        own, mirrored: angles from the view to the others and to the mirrored views [rad].
        step: angle between views.
    """
    nearest = int(np.argmin(abs(mirrored)))
    if abs(mirrored[nearest]) < 0.02 * step:
        return [_Node(0.0, True, nearest)]
    nodes: list[_Node] = []
    for sign in (-1, 1):
        for places, is_mirrored in ((sign * mirrored, True), (sign * own, False)):
            near = np.flatnonzero((places > 0) & (places < 2.75 * step))
            near = near[np.argsort(places[near])][:2]
            if len(near) == 2 and places[near[0]] < 1.25 * step:
                nodes += [_Node(sign * float(places[i]), is_mirrored, int(i)) for i in near]
                break
    return nodes if len(nodes) == 4 and any(node.is_mirrored for node in nodes) else None


def _lagrange(places: np.ndarray) -> np.ndarray:
    """Weights of values at some places in their polynomial at 0."""
    others = [np.delete(places, k) for k in range(len(places))]
    return np.array([np.prod(-rest) / np.prod(place - rest) for place, rest in zip(places, others, strict=True)])


def _common_columns(columns: int, column: float, margin: int, reach: float) -> np.ndarray:
    """Columns that a view and its mirror image see, for every axis within ``reach``, ``margin`` from the detector's edges."""
    s = np.arange(margin, columns - margin)
    return s[(2 * (column - reach) - s >= margin) & (2 * (column + reach) - s <= columns - 1 - margin)]


def _mirror_groups(s: np.ndarray, column: float, width: float, views: int) -> np.ndarray | None:
    """Group of each column by its distance from the axis; None to group views: if there are 8, and fewer than 5 such groups.

    Smoothed noise correlates over 3.5 widths (the area of its correlation over its peak), which a group of 6 widths exceeds.
    """
    distance = abs(s - column)
    groups = min(SECTORS, int(len(s) / 2 / np.ceil(6 * width)))
    if groups < 5 and views >= 8:
        return None
    groups = max(groups, 3)
    return np.minimum((distance / (distance.max() + 1) * groups).astype(int), groups - 1)


def _jackknife_minimum(misfit: Callable[[float], np.ndarray], centre: float, width: float) -> tuple[float, float]:
    """(column, standard deviation) as :func:`_sector_minimum`, with the deviation by leaving out one group at a time.

    Two edges of the object may have most of the curvature: the slope of their group is then small at the minimum, whatever the
    noise. Without the group, the minimum moves by what the group contributes.

    Reference: Efron 1982, "The jackknife, the bootstrap and other resampling plans".
    """
    column, _ = _sector_minimum(misfit, centre, width)
    offsets = np.linspace(-1.0, 1.0, 5)
    a, b, _ = np.polyfit(offsets, [misfit(centre + width * o) for o in offsets], 2)
    curvature, rest = a.sum(), a.sum() - a
    # Without the group that has nearly all of the curvature, the minimum is undetermined: a twentieth stays.
    left_out = -(b.sum() - b) / (2 * np.maximum(rest, curvature / 20))
    variance = (len(a) - 1) / len(a) * np.sum((left_out - left_out.mean()) ** 2)
    return column, float(width * np.sqrt(variance))


SEARCH_WIDTH = 2.0
"""Smoothing of slopes in the search for the nearest column [columns]."""


def _nearest_mirror(here: np.ndarray, there: np.ndarray) -> float:
    """Half a whole column where slopes resemble mirrored slopes most.

    The score is Fisher's z of the correlation times the root of the number of common columns: for noise its standard deviation
    is the same for every overlap.
    """
    n, width = here.shape[-1], SEARCH_WIDTH
    margin = int(2 * width)
    mask = np.zeros(n)
    mask[margin : n - margin] = 1
    a, b = (mask * ndimage.gaussian_filter1d(views, width, axis=-1, order=1, mode="nearest") for views in (here, there))

    def convolve(one: np.ndarray, other: np.ndarray) -> np.ndarray:
        product = np.fft.irfft(np.fft.rfft(one, 2 * n) * np.fft.rfft(other, 2 * n), 2 * n)
        return product.reshape(-1, 2 * n).sum(0)[: 2 * n - 1]

    common = np.rint(convolve(mask, mask))
    energy_here, energy_there = convolve(a**2, mask), convolve(mask, b**2)
    enough = (common >= MIN_COMMON) & (np.minimum(energy_here, energy_there) > MIN_OVERLAP * min(np.sum(a**2), np.sum(b**2)))
    if not enough.any():
        raise MivolError("Found no structure in opposite views, expected some: use axis_from_moments.")
    correlation = -convolve(a, b)[enough] / np.sqrt(energy_here[enough] * energy_there[enough])
    score = np.arctanh(np.clip(correlation, -0.9999, 0.9999)) * np.sqrt(common[enough])
    best = int(np.argmax(score))
    # Of noise with slopes smoothed over a width w, n products have a correlation of variance (3 / 4) sqrt(2 pi) w / n.
    deviations = score * np.sqrt(a.shape[0] * a.shape[1] / (0.75 * np.sqrt(2 * np.pi) * width))
    others = score[abs(np.arange(len(score)) - best) > 8 * width]
    is_clear = deviations[best] > CLEAR and others.max(initial=0.0) < RUNNER_UP * score[best]
    if correlation[best] < MIN_CORRELATION and not is_clear:
        raise MivolError("Found opposite views that resemble no mirror images, expected some: check the angles.")
    return float(np.flatnonzero(enough)[best]) / 2


JOIN_ERROR = 0.03
"""Standard deviation [columns] caused by interpolation between the first and the mirrored last view of half a turn: measured
without noise for heads and blocks in 40 to 180 views (rms .013 to .027)."""

CLEAR, RUNNER_UP = 7.0, 0.8
"""Standard deviations of noise above which a correlation below ``MIN_CORRELATION`` counts, and the most that the score of
another column may be over the best."""

MIN_COMMON = 8
"""Fewest columns that a view and its mirror image have in common."""


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
