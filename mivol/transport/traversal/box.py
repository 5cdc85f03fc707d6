"""Boxes in the world (parallelepipeds), balls inside boxes, and the tests that clip a ray to a box or a ball.

References: Kay & Kajiya 1986 (slab test).
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.kernel_recording import is_recording
from mivol.scene_graph import traverse

__all__ = [
    "UNIT_CUBE",
    "Box",
    "clip_to_ball",
    "clip_to_box",
    "clip_to_faces",
    "evaluated_numbers",
    "find_ball",
    "find_faces",
    "fit_ball",
    "fit_box",
    "is_in_box",
    "map_point",
    "map_vector",
    "opaque_numbers",
    "opaque_rows",
    "with_placements",
]


UNIT_CUBE = (0.0, 0.0, 0.0), (1.0, 1.0, 1.0)
"""Two corners of the unit cube, in the coordinates of :meth:`Box.rows`."""


@dataclass
class Box:
    """A parallelepiped in the world: the unit cube under ``to_world`` (4x4, float64).

    Attributes:
        to_world: the map.
        is_round: the ball (ellipsoid) that touches all faces stands in the place of the box.
    """

    to_world: np.ndarray
    is_round: bool = False

    def rows(self) -> list[list[mi.Float64]]:
        """The (3, 4) map from the world to the unit cube (:func:`opaque_rows`).

        The arrays are made anew for each render: ``dr.freeze`` cannot record a function using arrays that were made before the
        recording and are not passed to the function.
        """
        return opaque_rows(self.from_world)

    @property
    def from_world(self) -> np.ndarray:
        """The (3, 4) map from the world to the unit cube."""
        return np.linalg.inv(self.to_world)[:3]

    @property
    def is_upright(self) -> bool:
        """Whether the edges lie along the axes of the world, in their order."""
        axes = np.abs(self.from_world[:, :3])
        return bool((axes - np.diag(axes.diagonal())).max() <= MAX_TILT * axes.max())

    @property
    def edge(self) -> float:
        """Edge length of the cube of the same volume."""
        return float(abs(np.linalg.det(self.to_world[:3, :3])) ** (1 / 3))

    @property
    def diameter(self) -> float:
        """Length of the longest straight line inside [length]."""
        axes = self.to_world[:3, :3]
        if self.is_round:
            return float(np.linalg.norm(axes, 2))
        corners = self.corners()
        return float(max(np.linalg.norm(corners[k] - corners[7 - k]) for k in range(4)))

    def corners(self) -> np.ndarray:
        """The 8 corners, (8, 3)."""
        unit = np.array([[x, y, z, 1] for z in (0, 1) for y in (0, 1) for x in (0, 1)], dtype=np.float64)
        return (unit @ self.to_world.T)[:, :3]

    def contains(self, other: np.ndarray, tolerance: float) -> bool:
        """Whether another box lies inside this box, up to ``tolerance`` of the edges of this box."""
        local = np.c_[Box(other).corners(), np.ones(8)] @ np.linalg.inv(self.to_world).T
        return bool((local[:, :3] >= -tolerance).all() and (local[:, :3] <= 1 + tolerance).all())

    def matches(self, other: np.ndarray, tolerance: float) -> bool:
        """Whether another box has the same corners, up to ``tolerance`` of the size of the other box."""
        theirs = Box(other).corners()
        size = np.ptp(theirs, axis=0).max()
        apart = np.linalg.norm(self.corners()[:, None] - theirs[None], axis=-1).min(axis=1)
        return bool(apart.max() <= tolerance * size)


MAX_TILT = 1e-12
"""Largest entry of a map to an upright box beside its diagonal, over the largest of all [1]. Fits of upright cubes leave 1e-14
by rounding. Float32 vertices know faces to 6e-8 of their distance from the origin, and this tilt moves
them by 1e-12 of the distance."""


_PLACEMENTS: ContextVar[tuple[mi.Float64, dict[bytes, int], mi.UInt32] | None] = ContextVar("placements", default=None)


@contextmanager
def with_placements(numbers: mi.Float64 | None, places: dict[bytes, int]) -> Iterator[None]:
    """Read numbers of :func:`opaque_numbers` from one array inside a ``with`` block.

    A recording takes the array as a single input, in place of a fill for each number.

    Args:
        numbers: the numbers of all groups; None to make every number anew.
        places: index of the first number of each group, by the bytes of the group.
    """
    # Outside of recordings, Dr.Jit copies the number at a literal index at once.
    start = mi.UInt32(0) if numbers is None or is_recording() else dr.opaque(mi.UInt32, 0)
    token = _PLACEMENTS.set(None if numbers is None else (numbers, places, start))
    try:
        yield
    finally:
        _PLACEMENTS.reset(token)


def opaque_numbers(values: np.ndarray) -> list[mi.Float64]:
    """Numbers as arguments of a kernel, so that boxes and grids in different places share one compiled kernel."""
    numbers, places, start = _PLACEMENTS.get() or (None, {}, None)
    first = places.get(values.tobytes())
    if first is None:
        return [dr.opaque(mi.Float64, float(v)) for v in values]
    return [dr.gather(mi.Float64, numbers, start + (first + k)) for k in range(len(values))]


def evaluated_numbers(values: np.ndarray) -> list[mi.Float64]:
    """:func:`opaque_numbers` in memory, for a kernel over all lanes whose other inputs are tables.

    Dr.Jit 1.5 guesses the number of lanes of a recorded kernel from its inputs. If the kernel only gathers, it guesses by the
    sizes of the tables, and may compute too few lanes.
    """
    numbers = opaque_numbers(values)
    dr.eval(numbers)
    return numbers


def opaque_rows(rows: np.ndarray) -> list[list[mi.Float64]]:
    """A (3, 4) map by :func:`opaque_numbers`."""
    flat = opaque_numbers(rows.ravel())
    return [flat[k : k + 4] for k in (0, 4, 8)]


def fit_box(shape: mi.Shape) -> Box | None:
    """Fit the box of a ``cube``, or of a mesh that is a box; None for another shape, or if the faces look inwards.

    The vertices are read on the host, which is not possible inside ``dr.freeze``.
    """
    if not shape.is_mesh() or shape.face_count() != 12:
        return None
    world, faces = _vertices(shape), np.array(traverse(shape)["faces"]).reshape(-1, 3)
    is_cube = shape.class_name() == "Cube"
    unit = (_vertices(mi.load_dict({"type": "cube"})) + 1) / 2 if is_cube else _find_unit_corners(world)
    if unit is None or not _are_faces_of_cube(unit[faces]):
        return None
    corners = world[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    if (np.einsum("fa,fa->f", normals, corners.mean(axis=1) - corners.mean(axis=(0, 1))) <= 0).any():
        return None
    fit, *_ = np.linalg.lstsq(np.c_[unit, np.ones(len(unit))], world, rcond=None)
    to_world = np.eye(4)
    to_world[:3] = fit.T
    return Box(to_world)


def _find_unit_corners(world: np.ndarray) -> np.ndarray | None:
    """The corners (0 or 1, along each edge) of the unit cube that belong to the vertices (N, 3) of a box; None for others."""
    corners, which = np.unique(world, axis=0, return_inverse=True)
    if len(corners) != 8:
        return None
    unit = Box(np.eye(4)).corners()
    tolerance = 4 * 2.0**-24 * np.abs(corners).max()  # each coordinate of a vertex was rounded to float32
    for edges in itertools.combinations(corners[1:] - corners[0], 3):
        apart = np.abs(corners[:, None] - (corners[0] + unit @ np.array(edges))).max(axis=2)
        nearest = apart.argmin(axis=1)
        if apart.min(axis=1).max() <= tolerance and len(set(nearest)) == 8:
            return unit[nearest][which.reshape(-1)]
    return None


def _are_faces_of_cube(corners: np.ndarray) -> bool:
    """Whether triangles (12, 3 corners, 3) of the unit cube cover each of its faces: two a face, with one diagonal."""
    covered = set()
    for triangle in corners:
        flat = np.flatnonzero((triangle == triangle[0]).all(axis=0))
        if len(flat) != 1:
            return False
        missing = np.delete(triangle.sum(axis=0) % 2, flat)  # the corner of the face that is not in the triangle
        covered.add((flat[0], triangle[0, flat[0]], *missing))
    opposite = {(axis, side, 1 - a, 1 - b) for axis, side, a, b in covered}
    return len(covered) == 12 and covered == opposite and len({found[:2] for found in covered}) == 6


def fit_ball(shape: mi.Shape) -> Box:
    """Fit the ball of a ``sphere`` shape. Mitsuba takes the radius from the first axis of its transform."""
    placed = np.array(traverse(shape)["to_world"].matrix, dtype=np.float64).reshape(4, 4)
    radius = np.linalg.norm(placed[:3, 0])
    to_world = np.diag([2 * radius, 2 * radius, 2 * radius, 1.0])
    to_world[:3, 3] = placed[:3, 3] - radius
    return Box(to_world, is_round=True)


def _vertices(shape: mi.Shape) -> np.ndarray:
    return np.array(traverse(shape)["vertex_positions"], dtype=np.float64).reshape(-1, 3)


def map_point(row: list, p: Sequence) -> mi.Float64:
    """A coordinate of a point, by a row of a (3, 4) map, in float64."""
    return dr.fma(row[0], mi.Float64(p[0]), dr.fma(row[1], mi.Float64(p[1]), dr.fma(row[2], mi.Float64(p[2]), row[3])))


def map_vector(row: list, d: Sequence) -> mi.Float64:
    """A coordinate of a direction, by a row of a (3, 4) map, in float64."""
    return dr.fma(row[0], mi.Float64(d[0]), dr.fma(row[1], mi.Float64(d[1]), row[2] * mi.Float64(d[2])))


def clip_to_box(
    rows: list, low: tuple, high: tuple, o: mi.Point3f, d: mi.Vector3f, t0: mi.Float64, t1: mi.Float64
) -> tuple[list[mi.Float64], list[mi.Float64], mi.Float64, mi.Float64]:
    """Clip [t0, t1] of a ray to a box, in float64.

    Args:
        rows: (3, 4) map from the world to the coordinates of the box.
        low, high: corners of the box in these coordinates.
        o, d: world ray.
        t0, t1: interval of the ray [length].

    Returns:
        Origin and direction of the ray in the coordinates of the box, and the interval inside; t1 <= t0 if the ray misses the
        box.
    """
    q, v = [map_point(row, o) for row in rows], [map_vector(row, d) for row in rows]
    for a in range(3):
        parallel = v[a] == 0
        inv = 1 / dr.select(parallel, 1, v[a])
        near, far = (low[a] - q[a]) * inv, (high[a] - q[a]) * inv
        # A ray parallel to two faces lies between them along all its length or nowhere; the products with 1 / 0 would be NaN.
        # In the plane of a face it counts as outside.
        inside = (q[a] > low[a]) & (q[a] < high[a])
        t0 = dr.select(parallel, dr.select(inside, t0, dr.inf), dr.maximum(t0, dr.minimum(near, far)))
        t1 = dr.select(parallel, t1, dr.minimum(t1, dr.maximum(near, far)))
    # The comparison is false for NaN, so rays with NaN get an empty interval; so do directions of length 0, whose interval
    # would be infinite.
    return q, v, t0, dr.select((t1 > t0) & dr.isfinite(t1 - t0), t1, t0)


def find_faces(rows: list) -> tuple[list[mi.Float64], list[mi.Float64]]:
    """Where the two faces across each axis of the world lie on the axis [length], for the ``rows`` of an upright box."""
    edges = [1 / row[a] for a, row in enumerate(rows)]
    low, high = ([(side - row[3]) * edge for row, edge in zip(rows, edges, strict=True)] for side in (0, 1))
    return low, high


def clip_to_faces(
    low: list[mi.Float64], high: list[mi.Float64], o: mi.Point3f, d: mi.Vector3f, t0: mi.Float64, t1: mi.Float64
) -> tuple[mi.Float64, mi.Float64]:
    """Clip [t0, t1] of a ray to an upright box, in float64: three divisions a ray for all boxes.

    Args:
        low, high: faces of the box (:func:`find_faces`).
        o, d, t0, t1: as for :func:`clip_to_box`.

    Returns:
        The interval inside; t1 <= t0 if the ray misses the box.
    """
    begin, end = t0, t1
    for a in range(3):
        # Parallel to two faces, both distances are infinite: of unlike signs between the faces, of like signs outside of them.
        # In the plane of a face one is NaN, and the ray counts as outside.
        p, inv = mi.Float64(o[a]), 1 / mi.Float64(d[a])
        near, far = (low[a] - p) * inv, (high[a] - p) * inv
        begin, end = dr.maximum(begin, dr.minimum(near, far)), dr.minimum(end, dr.maximum(near, far))
    # As in clip_to_box.
    return begin, dr.select((end > begin) & dr.isfinite(end - begin), end, begin)


def find_ball(rows: list) -> tuple[list[mi.Float64], mi.Float64]:
    """The centre [length] of the ball in the unit cube of ``rows``, and the square of its radius."""
    return [(0.5 - row[3]) / row[a] for a, row in enumerate(rows)], dr.square(0.5 / rows[0][0])


def clip_to_ball(
    centre: list[mi.Float64], radius2: mi.Float64, o: mi.Point3f, d: mi.Vector3f, t0: mi.Float64, t1: mi.Float64
) -> tuple[mi.Float64, mi.Float64]:
    """Clip [t0, t1] of a ray to a ball, in float64.

    Args:
        centre, radius2: of the ball (:func:`find_ball`).
        o, d, t0, t1: as for :func:`clip_to_box`.

    Returns:
        The interval inside; t1 <= t0 if the ray misses the ball.
    """
    q, v = [mi.Float64(o[a]) - centre[a] for a in range(3)], [mi.Float64(d[a]) for a in range(3)]
    per_speed2 = 1 / (v[0] * v[0] + v[1] * v[1] + v[2] * v[2])
    middle = -(q[0] * v[0] + q[1] * v[1] + q[2] * v[2]) * per_speed2
    # The square of the distance of the nearest point keeps its digits far away; the discriminant b^2 - a c would not.
    nearest = [dr.fma(middle, b, a) for a, b in zip(q, v, strict=True)]
    inside = radius2 - (nearest[0] * nearest[0] + nearest[1] * nearest[1] + nearest[2] * nearest[2])
    half = dr.sqrt(dr.maximum(inside, 0) * per_speed2)
    t0, t1 = dr.maximum(t0, middle - half), dr.minimum(t1, middle + half)
    # False for NaN: rays with NaN, and directions of length 0, get an empty interval.
    return t0, dr.select((t1 > t0) & dr.isfinite(t1 - t0), t1, t0)


def is_in_box(rows: list, is_round: bool, p: mi.Point3f) -> mi.Bool:
    """Whether a point lies in the unit cube of ``rows``, or in the ball inside the cube."""
    local = [map_point(row, p) for row in rows]
    if is_round:
        return sum(dr.square(x - 0.5) for x in local) <= 0.25
    return (local[0] >= 0) & (local[0] <= 1) & (local[1] >= 0) & (local[1] <= 1) & (local[2] >= 0) & (local[2] <= 1)
