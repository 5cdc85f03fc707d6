"""Find the rotation axis of a circular cone beam on the detector.

Conventions. As in :mod:`mivol.tomography.rotation_axis`. ``alpha`` is the angle [rad] between a ray and the central ray,
positive towards larger columns; the axis appears at ``alpha = epsilon``. In the plane of the source's circle, and in the
geometry of :mod:`mivol.tomography.geometry`, the ray (theta, alpha) and the ray (theta + pi + 2 epsilon - 2 alpha, 2 epsilon
- alpha) run along the same line from its two ends. Sort both rays by the direction of the line, ``phi = theta - alpha``. A
cone-beam ray and its opposite then form a parallel-beam pair, half a turn apart: ``P(phi, alpha) = P(phi + pi, 2 epsilon -
alpha)``. The result is the column of the axis. The place of the central ray is not estimated: ``detector_offset`` is taken as
given.

References: Parker 1982, Med. Phys. 9, 254 (the two ends of a line).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import interpolate, ndimage

from mivol.errors import MivolError
from mivol.tomography.filtered import covers_circle, widest_gap
from mivol.tomography.geometry import ConeBeam
from mivol.tomography.preprocess import interpolate_gaps
from mivol.tomography.rotation_axis import MIN_CORRELATION, MIN_OVERLAP, SAMPLING_ERROR, SECTORS, Axis, sector_minimum

MAX_ROWS, MAX_DIRECTIONS = 4, 360
"""Rows and directions of lines; more are not needed, since each pair of views of a row gives the axis to a fraction of a
column."""

SEARCH_DIRECTIONS = 24
"""Number of directions in the search for the nearest column."""


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

        column, sigma = sector_minimum(misfit, column, width)
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
