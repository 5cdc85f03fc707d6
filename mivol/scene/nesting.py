"""Do the boundaries of media agree about the medium between them?

A boundary names its interior and exterior medium. A ray leaving one boundary must be in the medium in front of the next
boundary. Overlapping shapes, and shapes with coinciding surfaces of which a ray hits only one, leave the medium undetermined.
Mitsuba's integrators then follow the order of crossings, and lose the outer medium behind the inner one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.scene_graph import traverse
from mivol.transport.traversal.box import Box, fit_box
from mivol.transport.traversal.rays import spawn_ray

RAYS_PER_PAIR = 512
"""Rays for each pair of shapes, through the space shared by their boxes."""

CROSSINGS = 16
"""Most surfaces along a ray."""

MAX_PAIRS = 64
"""Most tested pairs; further pairs usually share the fault of these pairs, or have none."""

MIN_FAULT_SHARE = 0.01
"""Smallest share of a pair's rays that must find the fault: single rays graze an edge, and miss on leaving a shape."""

MIN_OPEN_FAULT_SHARE = 0.2
"""The same share for a shape with holes: rays leaving through a hole seem to be still inside."""

FACE_TOLERANCE = 1e-6
"""Depth, in sizes, to which neighbours may overlap: float32 vertices of touching faces agree to this depth."""

UNKNOWN = -1
"""Stands for the registry index of an unknown medium."""


@dataclass(frozen=True)
class OrientedBox:
    """A parallelepiped around a shape: a ``cube`` itself, else the axis-aligned bounding box.

    Attributes:
        corners: (8, 3).
        edges: (3, 3) directions, in rows.
    """

    corners: np.ndarray
    edges: np.ndarray

    @property
    def edge(self) -> float:
        """Mean length of its edges [length]."""
        return float(np.mean([np.linalg.norm(self.corners[k] - self.corners[0]) for k in (1, 2, 4)]))

    def shares(self, other: OrientedBox, margin: float = -FACE_TOLERANCE) -> bool:
        """Whether two boxes share space: no plane separates them by ``margin`` (in sizes; a negative margin permits an
        overlap).
        """
        across = [np.cross(a, b) for a in self.edges for b in other.edges]
        across += [np.cross(r.edges[i], r.edges[i - 1]) for r in (self, other) for i in range(3)]
        axes = np.array([a / n for a in across if (n := np.linalg.norm(a)) > FACE_TOLERANCE])
        one, two = axes @ self.corners.T, axes @ other.corners.T
        gap = np.maximum(one.min(axis=1) - two.max(axis=1), two.min(axis=1) - one.max(axis=1))
        size = max(np.abs(self.corners).max(), np.abs(other.corners).max())
        return bool((gap < margin * size).all())

    @property
    def longest_edge(self) -> float:
        """Length of its longest edge [length]."""
        return float(np.linalg.norm(self.corners[[4, 2, 1]] - self.corners[0], axis=1).max())

    def distance(self, point: np.ndarray) -> float:
        """Distance of a point, over the longest edge [1]; 0 inside. For a sheared box, at most the distance."""
        edges = self.corners[[4, 2, 1]] - self.corners[0]
        # The box of a rectangle has no third edge: least squares leave the way to its plane. In a box with space they would
        # leave rounding only, and the distance inside is 0 exactly.
        inside, _, rank, _ = np.linalg.lstsq(edges.T, point - self.corners[0])
        above = point - self.corners[0] - inside @ edges if rank < 3 else np.zeros(3)
        lengths = np.linalg.norm(edges, axis=1)
        away = (inside - np.clip(inside, 0, 1)) * lengths
        return float(np.hypot(np.linalg.norm(away), np.linalg.norm(above)) / lengths.max())

    def contains(self, other: OrientedBox) -> bool:
        """Whether another box lies inside, to ``FACE_TOLERANCE``."""
        return all(self.distance(corner) <= FACE_TOLERANCE for corner in other.corners)

    @classmethod
    def from_box(cls, box: Box) -> OrientedBox:
        """Convert a parallelepiped."""
        edges = box.to_world[:3, :3].T
        return cls(box.corners(), edges / np.linalg.norm(edges, axis=1, keepdims=True))


def oriented_box(shape: mi.Shape) -> OrientedBox:
    """Box around a shape."""
    box = fit_box(shape)
    if box is not None:
        return OrientedBox.from_box(box)
    low, high = shape_bounds(shape)
    return OrientedBox(np.where(np.indices((2, 2, 2)).reshape(3, 8).T == 0, low, high), np.eye(3))


def find_nesting_fault(scene: mi.Scene, traced: Sequence[mi.Shape] = ()) -> str | None:
    """Find boundaries that disagree about the medium between them.

    Args:
        scene: the scene.
        traced: boundaries traced by rays, for which coinciding surfaces matter; overlaps always matter.

    Returns:
        A sentence about two shapes, or about pieces of a shape, with the way out; None without a fault.

    Cost: nothing if no boundaries share space and no boundary is a mesh; else 512 rays for each pair, up to 64 pairs.
    """
    shapes = [s for s in scene.shapes() if s.is_medium_transition()]
    pairs = _pairs(shapes, {_registry_id(mi.ShapePtr(s)) for s in traced})
    if not pairs:
        return None
    closed = {_registry_id(mi.ShapePtr(s)) for s in {t.ptr: t for pair in pairs for t in pair}.values() if _is_closed(s)}
    size = scene_diagonal(scene)
    found = _find_disagreements(scene, _make_rays(pairs, 2 * size), closed, size)
    for k, pair in enumerate(pairs):
        numbers = {_registry_id(mi.ShapePtr(s)) for s in pair}
        rays = {ray for ray, *shapes in found if ray // RAYS_PER_PAIR == k and numbers.issuperset(shapes)}
        if len(rays) >= (MIN_FAULT_SHARE if closed.issuperset(numbers) else MIN_OPEN_FAULT_SHARE) * RAYS_PER_PAIR:
            return _describe_fault(*pair)
    return None


def _pairs(shapes: list[mi.Shape], traced: set[int]) -> list[tuple[mi.Shape, mi.Shape]]:
    """Pairs of shapes that share space, or that touch if traced; a mesh of several pieces is paired with itself."""
    boxes = [(s, oriented_box(s), _registry_id(mi.ShapePtr(s)) in traced) for s in shapes]
    alone = [(s, s) for s in shapes if s.is_mesh() and s.class_name() not in ("Cube", "Rectangle")]
    close = (
        (a, b) for a, b in combinations(boxes, 2) if a[1].shares(b[1], FACE_TOLERANCE if a[2] or b[2] else -FACE_TOLERANCE)
    )
    return [*alone, *((a[0], b[0]) for a, b in close)][:MAX_PAIRS]


def shape_bounds(shape: mi.Shape) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper corner of a shape. Meshes merged by Mitsuba 3.9.1 have no valid box of their own."""
    box = shape.bbox()
    if box.valid():
        return np.array(box.min), np.array(box.max)
    points = np.array(traverse(shape)["vertex_positions"]).reshape(-1, 3)
    return points.min(axis=0), points.max(axis=0)


def scene_diagonal(scene: mi.Scene) -> float:
    """Diagonal of the box around all shapes [length]; 0 for a scene without shapes."""
    corners = [c for s in scene.shapes() for c in shape_bounds(s)]
    return float(np.linalg.norm(np.ptp(corners, axis=0))) if corners else 0.0


def _is_closed(shape: mi.Shape) -> bool:
    """Whether a shape encloses its interior: a ball, or a mesh with every edge passed once each way."""
    geometry = traverse(shape)
    if "vertex_positions" not in geometry:  # no mesh, or a rectangle, whose vertices Mitsuba does not show
        return shape.shape_type() in (mi.ShapeType.Sphere.value, mi.ShapeType.Ellipsoids.value)
    points = np.array(geometry["vertex_positions"]).reshape(-1, 3)
    faces = np.unique(points, axis=0, return_inverse=True)[1].ravel()[np.array(geometry["faces"]).reshape(-1, 3)]
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    there, back = (np.sort(e[:, 0].astype(np.int64) * len(points) + e[:, 1]) for e in (edges, edges[:, ::-1]))
    return bool(np.array_equal(there, back))


def _make_rays(pairs: list[tuple[mi.Shape, mi.Shape]], far: float) -> mi.Ray3f:
    """Rays from a distance through the space shared by the boxes of two shapes."""
    rng, origins, targets = np.random.default_rng(0), [], []
    for a, b in pairs:
        one, two = shape_bounds(a), shape_bounds(b)
        low, high = np.maximum(one[0], two[0]), np.minimum(one[1], two[1])
        d = rng.normal(size=(RAYS_PER_PAIR, 3))
        targets.append(rng.uniform(np.minimum(low, high), np.maximum(low, high), (RAYS_PER_PAIR, 3)))
        origins.append(targets[-1] + d / np.linalg.norm(d, axis=1, keepdims=True) * far)
    o, d = np.concatenate(origins), np.concatenate(targets) - np.concatenate(origins)
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    return mi.Ray3f(mi.Point3f(o.T.astype(np.float32)), mi.Vector3f(d.T.astype(np.float32)))


def _find_disagreements(scene: mi.Scene, ray: mi.Ray3f, closed: set[int], size: float) -> list[tuple[int, int, int]]:
    """Find each (ray, shape, shape) whose second shape names another medium than the ray's medium since the first shape.

    Between closed shapes every side counts, and a ray leaving the scene must end in its first medium. For shapes with holes
    only entries from inside another shape count. The medium behind an opaque surface without media is unknown.
    """
    n = dr.width(ray)
    inside, outside, last = np.full(n, UNKNOWN), np.full(n, UNKNOWN), np.zeros(n, int)
    going, sure, found = np.ones(n, bool), np.ones(n, bool), []
    for _ in range(CROSSINGS):
        si = scene.ray_intersect(ray, mi.RayFlags.All, False, mi.Bool(going))
        sides = [_registry_ids(p) for p in (si.shape, si.target_medium(-ray.d), si.target_medium(ray.d))]
        facts = [si.is_valid(), si.is_medium_transition(), dr.dot(si.n, ray.d) < 0, _is_opaque(si)]
        ray = spawn_ray(si, ray.d, size)
        # Evaluate now, with the next ray: otherwise the kernel of each crossing would repeat all earlier crossings and be
        # compiled anew (8 s for 12 boxes).
        dr.eval(sides, facts, ray)
        shape, near, far = (np.array(numbers).astype(int) for numbers in sides)
        valid, transition, enters, opaque = map(np.array, facts)
        hit = valid & going
        left = going & ~hit & sure & (inside != UNKNOWN) & (inside != outside)
        found += zip(*(np.stack([np.arange(n), last, last])[:, left]).tolist(), strict=True)
        going = hit
        if not going.any():
            break
        crosses = going & transition
        whole = np.isin(shape, list(closed))
        wrong = crosses & (inside != UNKNOWN) & (near != inside) & ((sure & whole) | (enters & (inside != 0)))
        found += zip(*(np.stack([np.arange(n), last, shape])[:, wrong]).tolist(), strict=True)
        sure &= whole | ~crosses
        outside = np.where(crosses & (outside == UNKNOWN), near, outside)
        inside = np.where(crosses, far, np.where(opaque, UNKNOWN, inside))
        last = np.where(crosses, shape, last)
    return found


def _is_opaque(si: mi.SurfaceInteraction3f) -> mi.Bool:
    clear = int(mi.BSDFFlags.Null) | int(mi.BSDFFlags.Transmission)
    return si.is_valid() & ~si.is_medium_transition() & ((si.bsdf().flags() & mi.UInt32(clear)) == 0)


def _registry_ids(pointers: mi.ShapePtr | mi.MediumPtr) -> mi.UInt32:
    """Dr.Jit's registry indices of objects; 0 for no object."""
    return dr.reinterpret_array(mi.UInt32, pointers)


def _registry_id(pointer: mi.ShapePtr) -> int:
    return int(_registry_ids(pointer)[0])


def _describe_fault(a: mi.Shape, b: mi.Shape) -> str:
    one, two = (s.id() or f"a {s.class_name()}" for s in (a, b))
    if a is b:
        return (
            f"pieces of {one} overlap, or their surfaces coincide in part (Mitsuba makes one mesh of all with the same medium "
            "and BSDF), so the end of its medium is undetermined: leave a gap of a thousandth of the scene between them, or "
            "make one surface of them."
        )
    return (
        f"{one} and {two} overlap, or parts of their surfaces coincide, and disagree about the medium between them: if one "
        "lies inside the other, give the inner shape the medium of the outer shape as its exterior "
        '(<ref name="exterior" id="..."/>, beside the interior), with a gap of a thousandth of the scene between their '
        "surfaces; else move them apart."
    )
