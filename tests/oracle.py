"""The slow, obvious twins: what light does along a ray, in float64 NumPy, written for reading.

Conventions. Grids are (Z, Y, X) or (Z, Y, X, C), values at voxel centres, clamped borders, over the unit cube that
`to_world` (4x4) places in the world; outside the cube there is vacuum. A point u of the unit cube has lattice
coordinate q = u N - 1/2, so voxel k sits at q = k and the faces of the box at q = -1/2 and N - 1/2. Rays are o + t d,
and every integral is over t: it is a world length where |d| = 1. Points, directions and lattice coordinates are
ordered (x, y, z).

Nothing here knows Dr.Jit, Mitsuba or mivol.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence

import numpy as np
from scipy.ndimage import map_coordinates

GAUSS_2 = (0.5 - math.sqrt(3) / 6, 0.5 + math.sqrt(3) / 6)


# -- Frames and boxes ------------------------------------------------------------------------------------------------


def grid_shape(values: np.ndarray) -> tuple[int, int, int]:
    """Number of voxels along (x, y, z)."""
    return values.shape[2], values.shape[1], values.shape[0]


def with_channels(values: np.ndarray) -> np.ndarray:
    """The grid as (Z, Y, X, C), of its own type: what is read of it becomes float64."""
    values = np.asarray(values)
    return values[..., None] if values.ndim == 3 else values


def to_unit_cube(to_world: np.ndarray, o: np.ndarray, d: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The same ray, with the same parameter t, in the frame where the box is [0, 1]^3."""
    to_world = np.asarray(to_world, dtype=np.float64)
    inverse = np.linalg.inv(to_world[:3, :3])
    o, d = np.asarray(o, dtype=np.float64), np.asarray(d, dtype=np.float64)
    return inverse @ (o - to_world[:3, 3]), inverse @ d


def to_lattice(values: np.ndarray, to_world: np.ndarray, o: np.ndarray, d: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The same ray, with the same parameter t, in lattice coordinates."""
    n = np.array(grid_shape(values), dtype=np.float64)
    u, du = to_unit_cube(to_world, o, d)
    return u * n - 0.5, du * n


def slab_interval(low: np.ndarray, high: np.ndarray, o: np.ndarray, d: np.ndarray) -> tuple[float, float]:
    """Interval of t inside the axis-aligned box [low, high]; (0, 0) where the ray misses it."""
    t0, t1 = -math.inf, math.inf
    for axis in range(3):
        if d[axis] == 0:
            if not low[axis] <= o[axis] <= high[axis]:
                return 0.0, 0.0
            continue
        with np.errstate(over="ignore"):
            a, b = sorted(((low[axis] - o[axis]) / d[axis], (high[axis] - o[axis]) / d[axis]))
        t0, t1 = max(t0, a), min(t1, b)
    return (t0, t1) if t0 < t1 else (0.0, 0.0)


def box_interval(to_world: np.ndarray, o: np.ndarray, d: np.ndarray) -> tuple[float, float]:
    """Interval of t inside the unit cube placed by `to_world`; (0, 0) where the ray misses it."""
    return slab_interval(np.zeros(3), np.ones(3), *to_unit_cube(to_world, o, d))


def ellipsoid_interval(matrix: np.ndarray, centre: np.ndarray, o: np.ndarray, d: np.ndarray) -> tuple[float, float]:
    """Interval of t inside (x - c)^T M (x - c) <= 1; (0, 0) where the ray misses it."""
    m, c = np.asarray(matrix, dtype=np.float64), np.asarray(o, dtype=np.float64) - np.asarray(centre, dtype=np.float64)
    d = np.asarray(d, dtype=np.float64)
    qa, qb, qc = d @ m @ d, d @ m @ c, c @ m @ c - 1
    discriminant = qb * qb - qa * qc
    if discriminant <= 0:
        return 0.0, 0.0
    root = math.sqrt(discriminant)
    return (-qb - root) / qa, (-qb + root) / qa


def sphere_interval(centre: np.ndarray, radius: float, o: np.ndarray, d: np.ndarray) -> tuple[float, float]:
    """Interval of t inside a sphere; (0, 0) where the ray misses it."""
    return ellipsoid_interval(np.eye(3) / radius**2, centre, o, d)


def overlap(*intervals: tuple[float, float]) -> tuple[float, float]:
    """Intersection of intervals; (0, 0) where it is empty."""
    t0, t1 = max(a for a, _ in intervals), min(b for _, b in intervals)
    return (t0, t1) if t0 < t1 else (0.0, 0.0)


# -- The trilinear field ---------------------------------------------------------------------------------------------


def corner_weights(shape: tuple[int, int, int], q: np.ndarray) -> list[tuple[tuple[np.ndarray, ...], np.ndarray]]:
    """The eight ((iz, iy, ix), weight) of points q (n, 3) in lattice coordinates; both nodes clamped to the grid."""
    low = np.floor(q).astype(np.int64)
    after = q - low
    ends = [[np.clip(low[:, axis] + step, 0, shape[axis] - 1) for step in (0, 1)] for axis in range(3)]
    shares = [(1 - after[:, axis], after[:, axis]) for axis in range(3)]
    return [
        ((ends[2][dz], ends[1][dy], ends[0][dx]), shares[0][dx] * shares[1][dy] * shares[2][dz])
        for dz, dy, dx in itertools.product((0, 1), repeat=3)
    ]


def trilinear(values: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Field (n, C) at lattice coordinates q (n, 3), as if the border values went on for ever."""
    values = with_channels(values)
    return sum(weight[:, None] * values[node] for node, weight in corner_weights(grid_shape(values), q))


def trilinear_slope(values: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Length (n, C) of the field's gradient in lattice coordinates: its change over one voxel."""
    values = with_channels(values)
    step = 1e-3
    inside = np.floor(q) + np.clip(q - np.floor(q), step, 1 - step)
    slopes = [
        (trilinear(values, inside + step * axis) - trilinear(values, inside - step * axis)) / (2 * step) for axis in np.eye(3)
    ]
    return np.sqrt(sum(s * s for s in slopes))


# -- Optical depth ---------------------------------------------------------------------------------------------------


def crossings(values: np.ndarray, to_world: np.ndarray, o: np.ndarray, d: np.ndarray, t0: float, t1: float) -> np.ndarray:
    """Sorted t at which the ray enters the box, crosses a plane through voxel centres, or leaves; cut to [t0, t1]."""
    n = np.array(grid_shape(values))
    q, dq = to_lattice(values, to_world, o, d)
    a, b = overlap((t0, t1), slab_interval(np.full(3, -0.5), n - 0.5, q, dq))
    planes = [np.array([a, b])]
    for axis in range(3):
        if dq[axis] != 0:
            with np.errstate(over="ignore"):
                t = (np.arange(n[axis]) - q[axis]) / dq[axis]
            planes.append(t[(t > a) & (t < b)])
    return np.sort(np.concatenate(planes))


def quadrature_points(
    values: np.ndarray, to_world: np.ndarray, o: np.ndarray, d: np.ndarray, t0: float, t1: float
) -> tuple[np.ndarray, np.ndarray]:
    """Lattice points (m, 3) and weights (m,): two Gauss points in each cell, exact for the cubic that a trilinear
    function is along a line."""
    t = crossings(values, to_world, o, d, t0, t1)
    q, dq = to_lattice(values, to_world, o, d)
    length = np.diff(t)
    nodes = np.concatenate([t[:-1] + g * length for g in GAUSS_2])
    return q + nodes[:, None] * dq, np.concatenate([length / 2, length / 2])


def each_ray(function: Callable, o: np.ndarray, d: np.ndarray, t0: float, t1: float | np.ndarray) -> np.ndarray:
    """`function(o, d, t0, t1)` for one ray, or stacked for rays (n, 3)."""
    o, d = np.asarray(o, dtype=np.float64), np.asarray(d, dtype=np.float64)
    if o.ndim == 1 and d.ndim == 1:
        return function(o, d, float(t0), float(t1))
    o, d = np.broadcast_arrays(o, d)
    starts, ends = np.broadcast_to(t0, len(o)), np.broadcast_to(t1, len(o))
    return np.array([function(*ray) for ray in zip(o, d, starts, ends, strict=True)])


def tau_twin(
    values: np.ndarray, to_world: np.ndarray, o: np.ndarray, d: np.ndarray, t0: float = 0.0, t1: float = math.inf
) -> np.ndarray:
    """Optical depth of o + t d, t in [t0, t1], per channel: (C,) for one ray, (n, C) for rays (n, 3)."""

    def one(o, d, t0, t1):
        q, weight = quadrature_points(values, to_world, o, d, t0, t1)
        return weight @ trilinear(values, q)

    return each_ray(one, o, d, t0, t1)


def tau_quadrature(
    values: np.ndarray, to_world: np.ndarray, o: np.ndarray, d: np.ndarray, t0: float, t1: float, n: int = 1 << 18
) -> np.ndarray:
    """The twin's own judge: n midpoints, SciPy's interpolation, an inside test at each point. Error O(1/n), (C,)."""
    values = with_channels(values).astype(np.float64)
    t = t0 + (np.arange(n) + 0.5) * (t1 - t0) / n
    u, du = to_unit_cube(to_world, o, d)
    points = u + t[:, None] * du
    inside = np.all((points >= 0) & (points <= 1), axis=1)
    q = (points * np.array(grid_shape(values)) - 0.5)[:, ::-1].T
    sigma = [map_coordinates(values[..., c], q, order=1, mode="nearest") for c in range(values.shape[3])]
    return np.array([np.sum(s * inside) * (t1 - t0) / n for s in sigma])


def tau_gradient_twin(
    shape: tuple[int, ...], to_world: np.ndarray, o: np.ndarray, d: np.ndarray, t0: float = 0.0, t1: float = math.inf
) -> np.ndarray:
    """One dense row of A, d tau / d sigma, of shape (Z, Y, X); `shape` is that of the grid, (Z, Y, X)."""
    row = np.zeros(shape[:3])
    q, weight = quadrature_points(row, to_world, o, d, t0, t1)
    for node, corner in corner_weights(grid_shape(row), q):
        np.add.at(row, node, weight * corner)
    return row


def tau_scale(
    values: np.ndarray, to_world: np.ndarray, o: np.ndarray, d: np.ndarray, t0: float = 0.0, t1: float = math.inf
) -> np.ndarray:
    """The measure of a ray's error: integral of (sigma + h |grad sigma|), h one voxel; (C,) or (n, C)."""

    def one(o, d, t0, t1):
        q, weight = quadrature_points(values, to_world, o, d, t0, t1)
        return weight @ (np.abs(trilinear(values, q)) + trilinear_slope(values, q))

    return each_ray(one, o, d, t0, t1)


# -- Images and distances --------------------------------------------------------------------------------------------


def pixel_means(
    T: Callable[[np.ndarray, np.ndarray], np.ndarray], o: np.ndarray, d: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Mean and variance of T(o, d) over the rays of each pixel: rays (..., k, 3) give (..., C)."""
    rays_o, rays_d = o.reshape(-1, 3), d.reshape(-1, 3)
    value = np.stack([np.atleast_1d(T(*ray)) for ray in zip(rays_o, rays_d, strict=True)])
    value = value.reshape(*o.shape[:-1], -1)
    return value.mean(axis=-2), value.var(axis=-2, ddof=1)


def depth_twin(
    sigma: Callable[[np.ndarray], np.ndarray], breaks: Sequence[float], surface: float | None = None, n: int = 4096
) -> tuple[float, float]:
    """Alpha and alpha-weighted mean distance, (integral of t sigma T dt + T_s t_s) / alpha, channels averaged.

    `sigma(t)` gives (m, C) at distances t (m,); `breaks` are the distances, in rising order, between which it is
    smooth; `surface` is the distance of an opaque surface: light stops there and alpha is 1. The depth is 0 where alpha
    is 0. Error O(n^-2) with n midpoints between two breaks.
    """
    end = math.inf if surface is None else surface
    edges = np.concatenate(
        [np.linspace(min(a, end), min(b, end), n, endpoint=False) for a, b in itertools.pairwise(breaks)]
        + [[min(breaks[-1], end)]]
    )
    middle = (edges[1:] + edges[:-1]) / 2
    tau = np.cumsum(sigma(middle) * np.diff(edges)[:, None], axis=0)
    T = np.exp(-np.vstack([np.zeros(tau.shape[1]), tau]))
    moment = np.mean(middle @ (T[:-1] - T[1:]))
    left = np.mean(T[-1])
    if surface is not None:
        return 1.0, float(moment + left * surface)
    return float(1 - left), float(moment / (1 - left)) if left < 1 else 0.0
