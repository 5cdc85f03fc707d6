"""Find the rotation axis of a parallel beam on the detector.

Conventions. Line integrals ``y`` are (views, rows, cols); columns are counted from 0 at pixel centres, so the middle of a
detector of C columns is (C - 1) / 2. Angles are in radians. Cone beams: :mod:`mivol.tomography.cone_axis`.

References: Helgason 1965 and Ludwig 1966 (moments of a sinogram); Vo et al. 2014 (the axis from mirrored views); Donath,
Beckmann & Schreyer 2006 (axis from trial reconstructions); White 1980, Econometrica 48, 817 (the variance of a least-squares
fit from the scatter of its parts).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy import interpolate, ndimage, special

from mivol.errors import MivolError
from mivol.tomography.filtered import covers_circle, filtered_backprojection, widest_gap
from mivol.tomography.geometry import ParallelBeam, VoxelGrid
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


LEAST_MASS = 0.1
"""Smallest mass of a row over that of the heaviest row, for its centre of mass to count."""


def axis_from_moments(y: np.ndarray, angles: np.ndarray) -> Axis:
    """Find the axis from the centre of mass of each view, which follows ``c + a cos(theta) + b sin(theta)`` (Ludwig).

    The method needs the whole object in every view and air at 0: a constant error of the air pulls the centre of mass towards
    the middle of the detector. The standard deviation is the scatter of the views, each a mean over rows, or of the rows if
    larger: the rows of a view share errors of sampling, and errors of the flats are the same in all views. What the mean of the
    outermost columns would pull, as an error of the air, is added to it.

    Args:
        y: (views, rows, cols) line integrals of a parallel beam.
        angles: (views,) [rad].
    """
    mass = y.sum(-1)
    rows = np.flatnonzero((mass > LEAST_MASS * mass.mean(0).max()).all(0))
    if mass.max() <= 0 or not len(rows):
        raise MivolError(
            "Found no row with an object in every view, expected one: give scan.axis_offset, or data.find_axis = false for the "
            "middle of the detector."
        )
    y, mass = y[:, rows], mass[:, rows]
    centres = (y @ np.arange(y.shape[-1])) / mass
    design = np.stack([np.ones_like(angles), np.cos(angles), np.sin(angles)], 1)
    column, scatter_of_views = _fit_first_coefficient(design, centres.mean(1))
    columns = np.linalg.lstsq(design, centres, rcond=None)[0][0]
    scatter_of_rows = np.std(columns, ddof=1) / np.sqrt(len(columns)) if len(columns) > 1 else 0.0
    pull = y[..., [0, -1]].mean() * y.shape[-1] / mass.mean() * (column - (y.shape[-1] - 1) / 2)
    sigma = np.linalg.norm([max(scatter_of_views, scatter_of_rows), SAMPLING_ERROR, pull])
    return Axis(column, float(sigma), "moments of the shadows")


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

    Without opposite views, as in scans of less than half a turn, the column of moments counts if every view sees the whole
    object. Reconstructions from such arcs lack directions: their columns were off by 1.6 deviations (RMS) in twenty computed
    scans of whole objects, and by up to 5.9 in scans of cut-off objects. So they do not count there.

    If there are many more views than columns, neighbours are averaged first. In half a turn few views have an opposite view,
    and their noise may hide the resemblance.

    Args:
        y: (views, rows, cols) line integrals.
        weights: inverse variances of ``y``.
        angles: (views,) [rad].

    Raises: MivolError: no opposite views that are mirror images, and an object that some views do not see as a whole.
    """
    y, weights, angles = _average_views(interpolate_gaps(y, weights), weights, np.asarray(angles, float))
    try:
        rough = axis_from_mirrors(y, angles)
    except MivolError:
        if _sees_whole_object(y):
            return axis_from_moments(y, angles)
        raise MivolError(
            "found no rotation axis: opposite views show no mirror images, and some views do not see the whole object between "
            "columns of air; give scan.axis_offset, or data.find_axis = false for the middle."
        ) from None
    try:
        fine = axis_from_reconstructions(y, weights, angles, rough.column)
    except MivolError:
        return replace(rough, method=f"{rough.method}; no column nearby predicts half of the views best")
    apart = abs(fine.column - rough.column)
    ratio = y.shape[2] / max(_directions(np.asarray(angles, float)), 1)
    bumps = np.hypot(MISFIT_ERROR, SPARSE_ERROR * ratio**2)
    fine = replace(fine, uncertainty=max(float(np.hypot(fine.uncertainty, bumps)), apart / 2))
    if fine.uncertainty < rough.uncertainty:
        return fine
    if apart > FAR * rough.uncertainty:
        return replace(rough, method=f"{rough.method}; reconstructions say {fine.column:.2f}, which does not count")
    return rough


def axis_from_entropy(y: np.ndarray, weights: np.ndarray, angles: np.ndarray) -> Axis:
    """Find the axis at which filtered back-projection has the histogram of least entropy (Donath et al. 2006).

    A wrong axis blurs edges, and blurred edges spread the histogram. The search covers the middle half of the detector. It adds
    the entropies of up to five rows, each of a disc about the axis that all views see; readings beyond the detector count as
    the outermost ones. So the object may be wider than the detector. Over many columns the entropy also follows the light that
    views lack, so the minimum is that of the entropy less its median over neighbouring columns. Columns are averaged first, and
    halved in each further step.

    No standard deviation is known: with much noise or rings, all rows agree on a wrong column.

    Args:
        y: (views, rows, cols) line integrals.
        weights: inverse variances of ``y``.
        angles: (views,) [rad].

    Raises: MivolError: directions missing in half a turn, or no column, or several, with a clear minimum.
    """
    y, _, angles = _average_views(interpolate_gaps(y, weights), weights, np.asarray(angles, float))
    if not covers_circle(angles, np.pi):
        raise MivolError(
            "found directions missing in half a turn, expected all of them for the entropy of slices: give scan.axis_offset, "
            "or data.find_axis = true."
        )
    count = min(ENTROPY_ROWS, y.shape[1])
    y = y[:, ((np.arange(count) + 0.5) * y.shape[1] / count).astype(int)]
    n = y.shape[2]
    at_once = 2 ** int(np.ceil(np.log2(max(1.0, n / ENTROPY_COLUMNS))))
    columns = np.arange(n / 4, 3 * n / 4, at_once)
    total = _slice_entropies(y, angles, columns, at_once)
    dips = total - ndimage.median_filter(total, ENTROPY_TREND, mode="nearest")
    best = int(np.argmin(dips[DIP:-DIP])) + DIP if len(dips) > 2 * DIP else 0
    others = dips[abs(np.arange(len(dips)) - best) > DIP]
    if not dips[best] < 0 or others.min() < DIP_RUNNER_UP * dips[best]:
        raise MivolError(
            f"found no column from {columns[0]:.0f} to {columns[-1]:.0f} whose slice has clearly the least entropy, expected "
            "one: give scan.axis_offset, or data.find_axis = true."
        )
    column = columns[best]
    while True:
        at_once = max(1, at_once // 2)
        columns = column + at_once * np.arange(-1.5, 2.0, 0.5)
        total = _slice_entropies(y, angles, columns, at_once)
        column = columns[np.argmin(total)]
        if at_once == 1:
            break
    a, b, _ = np.polyfit(columns - column, total, 2)
    column += np.clip(-b / (2 * a), -0.5, 0.5) if a > 0 else 0.0
    return Axis(float(column), np.nan, f"least entropy of slices, {y.shape[1]} rows")


ENTROPY_ROWS, ENTROPY_COLUMNS = 5, 256
"""Most rows, and columns of the first step, of the search for the least entropy."""

ENTROPY_TREND, DIP, DIP_RUNNER_UP = 13, 4, 0.4
"""Columns of the median that is subtracted from entropies, columns about a minimum that belong to it, and the most that
another minimum may be of the deepest one."""


def _slice_entropies(y: np.ndarray, angles: np.ndarray, columns: np.ndarray, at_once: int) -> np.ndarray:
    """Entropies of slices (columns,), sums over rows, for trial columns; ``at_once`` columns are averaged to a pixel.

    The bins of a row are the same for all trials: the root of the number of pixels, over half more than the range of the first
    slice.
    """
    views, rows, n = y.shape
    width = n // at_once
    means = y[..., : width * at_once].reshape(views, rows, width, at_once).mean(-1)
    smooth = ndimage.gaussian_filter1d(means, ENTROPY_SMOOTHING, axis=-1, mode="nearest")
    padded = np.pad(smooth, ((0, 0), (0, 0), (width // 2, width // 2)), mode="edge")
    reach = min(width, ENTROPY_COLUMNS) // 4
    from_axis = np.arange(-reach, reach + 1)
    disc = np.hypot(from_axis[:, None], from_axis) <= reach
    grid, edges, entropies = VoxelGrid((rows, *disc.shape)), None, []
    for column in columns:
        offset = (column - (at_once - 1) / 2) / at_once - (width - 1) / 2
        beam = ParallelBeam(angles, padded.shape[1:], axis_offset=offset)
        values = filtered_backprojection(Projector(beam, grid), padded, "hann")[:, disc]
        if edges is None:
            low, high = np.percentile(values, [0.5, 99.5], axis=1)
            edges = np.linspace(1.25 * low - 0.25 * high, 1.25 * high - 0.25 * low, int(np.sqrt(disc.sum())), axis=1)
            edges[:, 0], edges[:, -1] = -np.inf, np.inf
        shares = [np.histogram(*row)[0] / row[0].size for row in zip(values, edges, strict=True)]
        entropies.append(sum(float(special.entr(share).sum()) for share in shares))
    return np.array(entropies)


ENTROPY_SMOOTHING = 1.5
"""Standard deviation [columns] of the smoothing before slices: without it, noise hides the minimum."""


AIR_SHARE, MASS_SCATTER = 0.02, 0.02
"""Most that the mean of an edge may be over the largest mean of a column, and scatter of the mass over views, of an object that
all views see as a whole."""


def _sees_whole_object(y: np.ndarray) -> bool:
    """Whether each view (views, rows, cols) has air at both edges, and all have the same sum, which is the object's mass."""
    profile, width = y.mean(1), max(2, y.shape[2] // 20)
    edges = np.abs([profile[:, :width].mean(1), profile[:, -width:].mean(1)])
    mass = profile.sum(1)
    return bool(edges.max() < AIR_SHARE * profile.max() and np.std(mass) < MASS_SCATTER * np.mean(mass))


VIEWS_A_COLUMN = 2
"""Directions in half a turn over columns, of averaged views: in one, the object moves by .8 columns at the detector's edge."""


def _average_views(y: np.ndarray, weights: np.ndarray, angles: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Means of neighbouring views with their weights and angles; the views themselves unless twice as many as needed."""
    at_once = _directions(angles) // (VIEWS_A_COLUMN * y.shape[2])
    if at_once < 2:
        return y, weights, angles
    start = widest_gap(angles, 2 * np.pi)[1]
    beyond = np.mod(angles - start + 1e-9, 2 * np.pi)
    groups = np.array_split(np.argsort(beyond, kind="stable"), max(1, len(angles) // at_once))
    total = np.stack([weights[group].sum(0) for group in groups])
    light = np.stack([(weights[group] * y[group]).sum(0) for group in groups])
    plain = np.stack([y[group].mean(0) for group in groups])
    mean = np.divide(light, total, out=plain, where=total > 0)
    return mean, total, start + np.array([beyond[group].mean() for group in groups])


MISFIT_ERROR, SPARSE_ERROR = 0.04, 0.02
"""Standard deviation [columns] of the refined column without noise: a constant, and a factor on the square of columns over
directions in half a turn. Measured for heads and blocks on 120 columns: rms .18, .056 and .041 in 40, 90 and 180 directions."""

FAR = 5.0
"""Distance of the refined from the rough column [standard deviations of the rough column] beyond which mivol reports it."""


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
"""Largest number of rows, over the views, compared with their mirror images."""


class _Node(NamedTuple):
    """A view in the interpolation at another: its angle from there, whether it is mirrored, its index by angle."""

    place: float
    is_mirrored: bool
    index: int


def _signed(angle: np.ndarray) -> np.ndarray:
    """Angles from -pi to pi."""
    return np.mod(angle + np.pi, 2 * np.pi) - np.pi


def _nodes(own: np.ndarray, mirrored: np.ndarray, step: float) -> list[_Node] | None:
    """Find a mirrored view at the same angle, or two neighbours of which at least one is mirrored; None if missing.

    On each side, a mirrored view within 1.25 steps is taken, otherwise the nearest view itself.

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
    """(column, standard deviation) as :func:`sector_minimum`, with the deviation by leaving out one group at a time.

    Two edges of the object may have most of the curvature: the slope of their group is then small at the minimum, whatever the
    noise. Without the group, the minimum moves by what the group contributes.

    Reference: Efron 1982, "The jackknife, the bootstrap and other resampling plans".
    """
    column, _ = sector_minimum(misfit, centre, width)
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

CLEAR, RUNNER_UP = 6.0, 0.8
"""Standard deviations of noise above which a correlation below ``MIN_CORRELATION`` counts (noise alone reaches it for one of
10^6 detectors of a thousand columns), and the most that the score of another column may be over the best."""

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
    if not len(seen):
        raise MivolError("found no line integral above 0, expected an object that absorbs light: check flats and views.")
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


MIN_OVERLAP, MIN_CORRELATION = 0.02, 0.5
"""Limits of the search for the nearest column: smallest share of slopes measured twice; smallest correlation of slopes for
matching ends (1 without noise; noise alone stays below 0.2 for 24 directions with 5 independent columns each)."""

SECTORS = 24
"""Sectors of directions. The disagreement of the sectors gives the uncertainty: Student's t with 23 degrees of freedom."""


SAMPLING_ERROR = 0.01
"""Standard deviation [columns] caused by edges between columns and views: the largest error without noise for a head in 60 to
360 views."""


def sector_minimum(misfit: Callable[[float], np.ndarray], centre: float, width: float) -> tuple[float, float]:
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
