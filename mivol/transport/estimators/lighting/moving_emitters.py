r"""The derivative of the optical depth of a shadow ray with respect to the position of the emitter at the end.

.. math:: \frac{\partial \tau}{\partial l} = \frac{\tau}{L}\,\omega + \int_0^L \frac{t}{L} \nabla\sigma\,dt
          \mp \sum_{faces} \frac{t_f}{L}\,\sigma(t_f) \frac{n}{n \cdot \omega}

for tau from x to l = x + L w. In the first term the ray becomes longer. In the second it rotates about x through the
extinction; two Gauss points a cell are exact, since t times the gradient of a trilinear function is a cubic along a ray. In the
third it crosses the boundaries of media at other points.

Conventions. The upper sign belongs to faces through which the ray leaves. The faces of boxes are known. Other boundaries are
traced once more; at each of them, the extinction steps from its value on one side to its value on the other, and the step moves
along the ray.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from mivol.transport.media.body import Body
from mivol.transport.media.extinction import BoundedExtinction, ExactExtinction, RayInterval, to_spectrum
from mivol.transport.media.optical_depth import segment_optical_depth
from mivol.transport.media.ray_intervals import OWN_SURFACE, MediumInterval, RaySegment, revisit_media
from mivol.transport.media.scene_media import SceneMedia
from mivol.transport.traversal.box import UNIT_CUBE, map_point, map_vector
from mivol.transport.traversal.grid_walk import Cell, NodeArray, walk_cells
from mivol.transport.traversal.interpolation import GAUSS_POINT, gauss_points
from mivol.transport.traversal.lattice import Lattice, Segment, clip_to_grid
from mivol.transport.traversal.rays import Ray, hit_distance, point_along, spawn_ray, to_mitsuba_ray

__all__ = ["attach_position", "moving_transmittance", "optical_depth_gradient"]


SIDE_STEP = 1e-5
"""Distance from a surface at which the extinction is read on either side, as a fraction of the distance along the ray [1]: ten
times its rounding."""

EDGE = 1e-6
"""Distance from two faces of a box at which a point lies at their edge, over the size of the box [1]. The ends of segments in a
grid are rounded to float32, 6e-8 of their distance."""


def optical_depth_gradient(
    media: SceneMedia, ray_segment: RaySegment, tau: list[mi.Float], active: mi.Bool
) -> list[mi.Vector3f]:
    """Derivative of the optical depth of a shadow ray with respect to its far end.

    Args:
        media: media and boundaries of the scene.
        ray_segment: the shadow ray; its length is the distance to the emitter.
        tau: optical depth of the ray for each channel [1].
        active: lanes to differentiate.

    Returns:
        One vector for each channel [1/length].

    Cost: one walk of each grid; two more traces with traced boundaries.
    """
    d, length = ray_segment.ray.d, dr.maximum(ray_segment.length, 1e-30)

    def visit(total: list, interval: MediumInterval) -> list:
        body, t0, t1, on = interval.body, interval.t0, interval.t1, interval.active
        scale = dr.detach(body.view.scale) * body.area(d)
        for part in body.view.parts:
            rows = media.vectors_to_channels([scale * v for v in _part_gradient(body, part, ray_segment, t0, t1, on)])
            total = [a + b for a, b in zip(total, rows, strict=True)]
        if body.view.microflakes is None:
            return total
        # The direction of the ray changes perpendicular to itself, and with it the projected area of microflakes.
        turn = body.apply_microflakes(d) * dr.rcp(dr.maximum(dr.square(body.area(d)), 1e-30)) - d
        depths = body.optical_depth(interval, media.channels)
        return [a + t * turn for a, t in zip(total, depths, strict=True)]

    zero = [mi.Vector3f(0) for _ in range(media.channels)]
    turned = revisit_media(media, ray_segment, visit, zero, active)
    if media.traced:
        turned = [a + b for a, b in zip(turned, _boundary_gradient(media, ray_segment, active), strict=True)]
    return [dr.select(active, (d * t + v) / length, 0) for t, v in zip(tau, turned, strict=True)]


def moving_transmittance(
    media: SceneMedia, ray_segment: RaySegment, tau: list[mi.Float] | None, end: mi.Point3f, active: mi.Bool
) -> mi.Spectrum:
    """A factor of value 1 carrying the derivative of a shadow ray's transmittance by the position of its end.

    ``tau`` is the optical depth of the ray for each channel [1], or None if its transmittance was estimated. The derivative of
    the factor is the derivative of log T = -tau, so T times the factor has the value and the derivative of T.
    """
    moved, media = end - dr.detach(end), media.by_quadrature()
    with dr.suspend_grad():
        tau = segment_optical_depth(media, ray_segment, active) if tau is None else tau
        slopes = optical_depth_gradient(media, ray_segment, tau, active)
    return to_spectrum([1 - dr.dot(s, moved) for s in slopes])


@dr.syntax
def _boundary_gradient(media: SceneMedia, ray_segment: RaySegment, active: mi.Bool) -> list[mi.Vector3f]:
    """L times the third term for traced boundaries, one vector for each channel."""
    # -- State ------------------------------------------------------------------------------------------------------------
    ray = ray_segment.ray
    onward = to_mitsuba_ray(ray)  # ray behind the last surface
    going = mi.Bool(active)
    total = [dr.zeros(mi.Vector3f, dr.width(ray)) for _ in range(media.channels)]

    while dr.hint(going, label="boundaries on the way to an emitter"):
        hit = media.scene.ray_intersect(onward, mi.RayFlags.All, False, going)
        t = hit_distance(ray, hit)
        going &= hit.is_valid() & (t < ray_segment.length * OWN_SURFACE)
        crosses = going & hit.is_medium_transition()
        total = _add_boundary(total, media, ray, hit, t, crosses)
        onward = spawn_ray(hit, ray.d, media.size)
    return total


def _add_boundary(
    total: list[mi.Vector3f], media: SceneMedia, ray: Ray, hit: mi.SurfaceInteraction3f, t: mi.Float, crosses: mi.Bool
) -> list[mi.Vector3f]:
    """Add the term of a boundary, from the extinctions slightly in front of the boundary and behind."""
    slope = dr.dot(hit.n, ray.d)
    face = mi.Vector3f(hit.n) * dr.rcp(dr.select(slope != 0, slope, 1))
    for side, to, sign in ((-ray.d, 1 - SIDE_STEP, -1.0), (ray.d, 1 + SIDE_STEP, 1.0)):
        medium = hit.target_medium(side)
        for body in media.traced:
            # If the ray grazes the surface (slope 0), both sides lie in the same medium and the two terms cancel.
            on = crosses & (medium == mi.MediumPtr(body.view.medium))
            sigma = body.extinction_at(ray, t * to, media.channels, on)
            total = [v + dr.select(on, sign * t * x * face, 0) for v, x in zip(total, sigma, strict=True)]
    return total


def _part_gradient(
    body: Body, part: ExactExtinction, ray_segment: RaySegment, t0: mi.Float64, t1: mi.Float64, on: mi.Bool
) -> list[mi.Vector3f]:
    """L times the second and third term of one part, one vector for each channel."""
    ray, end = ray_segment.ray, mi.Float64(ray_segment.length)
    if part.is_constant:
        value = dr.detach(part.constant)
        each = [value] if part.channels == 1 else [value.x, value.y, value.z]
        leaving = _boundary_direction(body, ray, t1) if body.box is not None else mi.Vector3f(0)
        entering = _boundary_direction(body, ray, t0) if body.box is not None else mi.Vector3f(0)
        shift = dr.select(on & (t0 > 0), entering * mi.Float(t0), 0) - dr.select(on & (t1 < end), leaving * mi.Float(t1), 0)
        return [v * shift for v in each]
    lattice = part.lattice.where_derivatives()
    segment = clip_to_grid(lattice, ray.o, ray.d, t0, t1)
    a, b = mi.Float64(segment.t0), mi.Float64(segment.t0) + mi.Float64(segment.length)
    inside = on & (segment.length > 0)
    vectors = _rotation_gradient(lattice, part, ray, segment, inside)
    rows, low, high = lattice.from_world, (-0.5,) * 3, tuple(n - 0.5 for n in lattice.res[::-1])
    at_points = isinstance(part, BoundedExtinction)
    if at_points:
        rows, (low, high) = part.rows, UNIT_CUBE
        a, b = map(mi.Float64, part.clip(RayInterval(ray, t0, t1, on)))
    leaves, enters = b < end * (1 - 1e-6), a > 0
    if body.box is None:
        # A traced boundary cutting the grid has its own terms; only faces of the grid inside the boundary count.
        leaves, enters = leaves & (b < t1 * (1 - 2 * SIDE_STEP)), enters & (a > t0 * (1 + 2 * SIDE_STEP))
    for t, sign, moves in ((b, -1.0, leaves), (a, 1.0, enters)):
        lanes = inside & moves
        face = _face_direction(rows, low, high, ray, t)
        if body.cuts_grids:
            # A boundary cutting the grid: the ray leaves (or enters) the medium through a face of the boundary.
            cut = dr.abs(t - (t1 if sign < 0 else t0)) <= 1e-6 * dr.abs(t)
            face = dr.select(cut, _boundary_direction(body, ray, t), face)
        # A field known at points is 0 in the face itself: it is read slightly inside.
        at = t * (1 + sign * SIDE_STEP) if at_points else t
        values = part.eval_at(mi.Float(1), ray, mi.Float(at), lanes)
        vectors = [v + dr.select(lanes, sign * mi.Float(t) * s * face, 0) for v, s in zip(vectors, values, strict=True)]
    return vectors


def _rotation_gradient(
    lattice: Lattice, part: ExactExtinction, ray: Ray, segment: Segment, active: mi.Bool
) -> list[mi.Vector3f]:
    """The integral of t grad(sigma) over a grid, one world vector for each channel."""
    at_points = isinstance(part, BoundedExtinction)

    def visit(total: list, cell: Cell, on: mi.Bool) -> list:
        half = dr.select(on, 0.5 * cell.dt, 0)
        for u, p in zip((GAUSS_POINT, 1 - GAUSS_POINT), gauss_points(cell), strict=True):
            t = segment.t0 + cell.s + u * cell.dt
            if at_points:
                slopes = part.field.slopes(ray(t), ray.d, on)
            else:
                slopes = [dr.select(cell.ahead, g, -g) for g in (_trilinear_gradient(c, p) for c in cell.corners[0])]
            total = [v + (half * t) * g for v, g in zip(total, slopes, strict=True)]
        return total

    zero = [dr.zeros(mi.Vector3f, dr.width(segment.length)) for _ in range(part.channels)]
    reads = [] if at_points else [NodeArray(dr.detach(part.lattice.values.array), part.channels)]
    gradients = walk_cells(lattice, segment, visit, zero, reads, active)
    if at_points:
        return gradients
    rows = [[mi.Float(v) for v in row[:3]] for row in lattice.from_world]
    return [mi.Vector3f(*(sum(rows[a][k] * g[a] for a in range(3)) for k in range(3))) for g in gradients]


def _trilinear_gradient(c: list[mi.Float], p: mi.Vector3f) -> mi.Vector3f:
    """The gradient of the trilinear function of 8 corners at a point, in cells."""

    def mix(a: mi.Float, b: mi.Float, t: mi.Float) -> mi.Float:
        return dr.fma(t, b - a, a)

    dx = mix(mix(c[1] - c[0], c[3] - c[2], p.y), mix(c[5] - c[4], c[7] - c[6], p.y), p.z)
    x = [mix(c[q], c[q + 1], p.x) for q in (0, 2, 4, 6)]
    dy = mix(x[1] - x[0], x[3] - x[2], p.z)
    dz = mix(x[2], x[3], p.y) - mix(x[0], x[1], p.y)
    return mi.Vector3f(dx, dy, dz)


def _boundary_direction(body: Body, ray: Ray, t: mi.Float64) -> mi.Vector3f:
    """n / (n . w) of the box or ball around a medium at a point of a ray."""
    if not body.box.is_round:
        return _face_direction(body.rows, *UNIT_CUBE, ray, t)
    p = point_along(ray, t)
    # The normal is the gradient of the squared distance from the middle, in the coordinates of the unit cube.
    q = [map_point(row, p) - 0.5 for row in body.rows]
    n = [sum(q[a] * body.rows[a][k] for a in range(3)) for k in range(3)]
    slope = map_vector(n, ray.d)
    return mi.Vector3f(*(mi.Float(x / dr.select(slope != 0, slope, 1)) for x in n))


def _face_direction(rows: list, low: tuple, high: tuple, ray: Ray, t: mi.Float64) -> mi.Vector3f:
    """n / (n . w) of the face of a box at a point of a ray; at an edge, of the face that the ray crosses more steeply.

    Rays towards an emitter in the plane of a face may run in this plane, and 1 / (n . w) has no bound there.
    """
    best, steepest, normal = mi.Float64(dr.inf), mi.Float64(0), mi.Vector3f(0)
    p = point_along(ray, t)
    for row, a, b in zip(rows, low, high, strict=True):
        q = map_point(row, p)
        speed = sum(row[k] * mi.Float64(ray.d[k]) for k in range(3))
        off, steepness = dr.minimum(dr.abs(q - a), dr.abs(q - b)) / (b - a), dr.abs(speed) / (b - a)
        nearer = (off < best - EDGE) | ((off < best + EDGE) & (steepness > steepest))
        inv = dr.rcp(dr.select(speed != 0, speed, 1))
        normal = dr.select(nearer, mi.Vector3f(*(mi.Float(row[k] * inv) for k in range(3))), normal)
        best, steepest = dr.select(nearer, off, best), dr.select(nearer, steepness, steepest)
    return normal


def attach_position(placed: mi.DirectionSample3f, direct: mi.DirectionSample3f) -> mi.DirectionSample3f:
    """Attach an emitter sample to the position or direction of its emitter; samples of other emitters stay as they are.

    Args:
        placed: emitter sample drawn again with the same numbers, attached to the emitter's position or direction.
        direct: the emitter sample.
    """
    placed.p = dr.select(direct.delta, placed.p, direct.p)
    placed.d = dr.select(direct.delta, placed.d, direct.d)
    placed.dist = dr.select(direct.delta, placed.dist, direct.dist)
    placed.n, placed.uv, placed.pdf, placed.emitter = direct.n, direct.uv, direct.pdf, direct.emitter
    return placed
