"""Do the boundaries of media agree about what lies between them?

A ray that entered one boundary is in that one's medium. Where it then enters another one, that one has to say so: by what
it names as its exterior. Shapes that overlap and name none leave it open which medium is where; stock integrators then go
by the order of the crossings, and drop the outer medium behind the inner one.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

__all__ = ["bounds", "nesting_fault", "overlap"]

RAYS = 512
"""Rays for each pair of shapes whose boxes overlap, through what the boxes share."""

CROSSINGS = 16
"""Surfaces that a ray is followed through."""

MOST_PAIRS = 64
"""Pairs that are looked at: more have the same fault as these, or none."""

SHARE = 0.01
"""Share of a pair's rays that must find the fault: single ones graze an edge, and miss where they leave a shape."""


def nesting_fault(scene: mi.Scene) -> str | None:
    """Find boundaries that overlap without saying which medium is around them.

    Returns:
        A sentence about two shapes, one of which is entered from inside the other and names no exterior, and the way out;
        None where all is well.

    Cost: nothing where no boxes of boundaries overlap; else 512 rays for each pair, up to 64 pairs.
    """
    shapes = [s for s in scene.shapes() if s.is_medium_transition()]
    pairs = [(a, b) for i, a in enumerate(shapes) for b in shapes[i + 1 :] if overlap(a, b)][:MOST_PAIRS]
    if not pairs:
        return None
    found = _entries(scene, _rays(pairs))
    both = [way for a, b in pairs for way in ((a, b), (b, a))]
    wrong = (way for way in both if found.count(tuple(_number(mi.ShapePtr(s)) for s in way)) >= SHARE * RAYS)
    return next((_sentence(*way) for way in wrong), None)


def overlap(a: mi.Shape, b: mi.Shape) -> bool:
    """Whether the bounding boxes of two shapes share more than a face."""
    low, high = _shared(a, b)
    # Neighbours may share a face, whose float32 vertices agree to 1e-6 of their size only.
    return bool((high - low > 1e-6 * np.maximum(np.abs(high), np.abs(low))).all())


def bounds(shape: mi.Shape) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper corner of a shape. Meshes that Mitsuba 3.9.1 has merged have no valid box of their own."""
    box = shape.bbox()
    if box.valid():
        return np.array(box.min), np.array(box.max)
    points = np.array(mi.traverse(shape)["vertex_positions"]).reshape(-1, 3)
    return points.min(axis=0), points.max(axis=0)


def _shared(a: mi.Shape, b: mi.Shape) -> tuple[np.ndarray, np.ndarray]:
    one, two = bounds(a), bounds(b)
    return np.maximum(one[0], two[0]), np.minimum(one[1], two[1])


def _rays(pairs: list[tuple[mi.Shape, mi.Shape]]) -> mi.Ray3f:
    """Rays from around two shapes through the box that their boxes share."""
    rng, origins, targets = np.random.default_rng(0), [], []
    for a, b in pairs:
        low, high = _shared(a, b)
        ends = np.array([*bounds(a), *bounds(b)])
        d = rng.normal(size=(RAYS, 3))
        targets.append(rng.uniform(low, high, (RAYS, 3)))
        origins.append(targets[-1] + d / np.linalg.norm(d, axis=1, keepdims=True) * 2 * np.linalg.norm(np.ptp(ends, axis=0)))
    o, d = np.concatenate(origins), np.concatenate(targets) - np.concatenate(origins)
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    return mi.Ray3f(mi.Point3f(o.T.astype(np.float32)), mi.Vector3f(d.T.astype(np.float32)))


def _entries(scene: mi.Scene, ray: mi.Ray3f) -> list[tuple[int, int]]:
    """The (shape, shape) of each time that a ray, just inside one, enters another that names no medium around it."""
    n = dr.width(ray)
    inside, last, going, found = np.zeros(n, int), np.zeros(n, int), np.ones(n, bool), []
    for _ in range(CROSSINGS):
        si = scene.ray_intersect(ray, mi.RayFlags.All, False, mi.Bool(going))
        going &= np.array(si.is_valid())
        if not going.any():
            break
        shape = np.array(_numbers(si.shape))
        crosses = going & np.array(si.is_medium_transition())
        near, far = (np.array(_numbers(si.target_medium(d))) for d in (-ray.d, ray.d))
        enters = crosses & np.array(dr.dot(si.n, ray.d) < 0)
        wrong = enters & (inside != 0) & (near == 0)
        found += zip(last[wrong].tolist(), shape[wrong].tolist(), strict=True)
        inside = np.where(crosses, far, inside)
        last = np.where(crosses, shape, last)
        ray = si.spawn_ray(ray.d)
    return found


def _numbers(pointers: mi.ShapePtr | mi.MediumPtr) -> mi.UInt32:
    """What Dr.Jit calls objects by; 0 for none."""
    return dr.reinterpret_array(mi.UInt32, pointers)


def _number(pointer: mi.ShapePtr) -> int:
    return int(_numbers(pointer)[0])


def _sentence(outer: mi.Shape, inner: mi.Shape) -> str:
    one, two = (s.id() or f"a {s.class_name()}" for s in (outer, inner))
    return (
        f"{two} is entered from inside {one}, but names no medium as what is around it: give {two} the medium of {one} as its "
        f'exterior (<ref name="exterior" id="..."/>, beside the interior), or move them apart.'
    )
