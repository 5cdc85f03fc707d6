r"""Predict whether sampling the light of media pays, from a coarse table of the emission, before a render.

Light emitted by a medium reaches a scattering point in two ways: a path passes through the medium by chance, or the estimator
samples a point of the medium (:mod:`mivol.transport.estimators.lighting.emission_sampling`). Paths seldom hit a fire over a
floor by chance, and sampling pays. In a room of even glow nearly every path sees the same light, and sampling only adds noise
and time. The prediction compares both: at points seen by the camera, directions are sampled either way, and the table gives
the light along them. With the variances V over the directions of a point, the gain is

.. math:: g = \frac{\sum_x V_{chance}(x)}{c\,\sum_x V_{drawn}(x)}

with c the time of a path with sampling over the time of a path without. The prediction assumes diffuse surfaces and isotropic
phase functions, and ignores extinction and occlusion: the gain decides about noise only, never about the mean.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.kernel_recording import without_garbage_collection
from mivol.scene.nesting import shape_bounds
from mivol.scene.survey import OUTSIDE_SHAPES, Boundary, SceneSurvey, is_instance
from mivol.scene_graph import list_values, traverse_children
from mivol.transport.estimators.lighting.direct_lighting import power_heuristic
from mivol.transport.estimators.lighting.emission_sampling import CELLS_PER_AXIS, EmissionTable, EmittingBox, tabulate_emission
from mivol.transport.media.body import Body
from mivol.transport.media.medium_view import MediumView
from mivol.transport.media.ray_intervals import RaySegment, draw_uniform_point, find_end
from mivol.transport.media.scene_media import SceneMedia
from mivol.transport.traversal.box import Box

SAMPLING_COST = 2.0
"""Time of a path with sampling over the time of a path without (measured on two cores: 1.4 to 2.5)."""

SIDE, DIRECTIONS, SEED = 32, 32, 0xF12E
"""Camera rays along an edge of the film, directions per point, and seed of both."""


def read_media_light(
    media: SceneMedia, boundaries: Sequence[Boundary], scattering: Sequence[Body], sensor: mi.Sensor, survey: SceneSurvey
) -> MediaLight | None:
    """Locate the light of media, once for each state of the media, and predict the gain of sampling.

    A gain is kept while the light has hardly changed: a stale gain affects noise only, not the mean.

    Returns:
        The light; None if the place of an emitting medium is unknown, because the medium fills no shape or shapes are
            instances.
    """
    boxes = find_emitting_boxes(media, boundaries)
    if boxes is None:
        return None
    # Keep the arrays with the result, so that Dr.Jit cannot give their indices to other arrays.
    arrays = [array for box in boxes for array in _emission_state(box.body.view)]
    state = (*(a.index if dr.is_array_v(a) else a for a in arrays), *(box.box.to_world.tobytes() for box in boxes))
    known = survey.media_light
    if known is None or known[0] != state:
        with without_garbage_collection(), dr.suspend_grad():
            table = tabulate_emission(boxes, media.channels)
            before = None if known is None else known[3]
            if before is None or not _is_alike(table, *before[:2]):
                gain = predict_gain(media, table, sensor, scattering)
                before = table.density, [each.box for each in table.boxes], gain
        survey.media_light = (state, arrays, MediaLight(table.density, table.cumulative, before[2]), before)
    return survey.media_light[2]


MAX_MOVED = 0.1
"""Largest share of the light in other cells, and largest way of a box over its edge, for which a predicted gain is kept [1]."""


def _is_alike(table: EmissionTable, density: mi.Float, places: Sequence[Box]) -> bool:
    """Whether a table has hardly changed from an earlier table, given by density and places of boxes."""
    boxes = [each.box for each in table.boxes]
    way = max(np.abs(now.corners() - old.corners()).max() / old.edge for now, old in zip(boxes, places, strict=True))
    volumes = [dr.full(mi.Float, each.cell_volume, CELLS_PER_AXIS**3) for each in table.boxes]
    change = dr.sum(dr.abs(table.density - density) * dr.concat(volumes))
    return way <= MAX_MOVED and float(change[0]) <= 2 * MAX_MOVED


def find_emitting_boxes(media: SceneMedia, boundaries: Sequence[Boundary]) -> list[EmittingBox] | None:
    """Find the media that emit, each with a box around all of its light; None if a box is unknown."""
    scene, lost = media.scene, {b.medium.ptr for b in boundaries if b.shape == OUTSIDE_SHAPES}
    has_instances, boxes = any(is_instance(s) for s in scene.shapes()), []
    for body in media.bodies:
        if not body.view.emits:
            continue
        if body.box is not None:
            around = body.box.to_world
        elif body.view.medium.ptr in lost or has_instances:
            return None
        else:
            around = _box_of_shapes(scene, body.view.medium)
        boxes.append(EmittingBox(body, Box(find_light_place(body.view, around))))
    return boxes


def find_light_place(view: MediumView, around: np.ndarray) -> np.ndarray:
    """The smallest box around the light of a medium: the boundary ``around``, or a grid."""
    return min([*_emission_boxes(view), around], key=lambda m: abs(np.linalg.det(m[:3, :3])))


def _emission_boxes(view: MediumView) -> list[np.ndarray]:
    """Boxes of grids outside of which a medium emits nothing."""
    if view.emission_density is not None:
        light = [view.emission_density] if view.emission is None else []
        parts = []
    else:
        light, parts = [view.emission], view.parts
    places = [p.lattice.to_world for p in parts if len(parts) == 1 and p.lattice is not None]
    for volume in light:
        if hasattr(volume, "mivol_to_world"):
            places.append(volume.mivol_to_world)
        elif isinstance(volume, mi.Volume) and volume.ptr in view.stock_boxes:
            places.append(view.stock_boxes[volume.ptr].to_world)
    return places


def _box_of_shapes(scene: mi.Scene, medium: mi.Medium) -> np.ndarray:
    """Box around all shapes filled by a medium."""
    inside = [
        shape_bounds(s) for s in scene.shapes() if s.interior_medium() is not None and s.interior_medium().ptr == medium.ptr
    ]
    low, high = np.min([b[0] for b in inside], axis=0), np.max([b[1] for b in inside], axis=0)
    place = np.diag([*(np.asarray(high, np.float64) - low), 1.0])
    place[:3, 3] = low
    return place


def _emission_state(view: MediumView) -> list:
    """The values behind the light of a medium: flat arrays and numbers."""
    found = []
    for _, value in list_values(traverse_children(view.medium)):
        if isinstance(value, int | float):
            found.append(value)
        elif dr.is_array_v(value):
            value = dr.detach(value.array if dr.is_tensor_v(value) else value)
            found += [value] if dr.depth_v(value) == 1 else list(value)
    return found


def predict_gain(media: SceneMedia, table: EmissionTable, sensor: mi.Sensor, scattering: Sequence[Body]) -> float:
    """Predict the gain of sampling: variance by chance, over the variance of sampling times its cost [1].

    Args:
        media: media of the scene.
        table: their emission.
        sensor: the sensor whose rays find scattering points.
        scattering: media that scatter.
    """
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(SEED, SIDE**2)
    i = dr.arange(mi.UInt32, SIDE**2)
    film = (mi.Point2f(i % SIDE, i // SIDE) + sampler.next_2d()) / SIDE
    ray, _ = sensor.sample_ray(0.0, sampler.next_1d(), film, sampler.next_2d())
    ray = mi.Ray3f(ray)
    on = dr.full(mi.Bool, True, SIDE**2)
    end = find_end(media, ray, media.medium_at(ray), on)
    chance = drawn = 0.0
    if media.has_surfaces:
        si = end.si
        lit = si.is_valid() & mi.has_flag(si.bsdf().flags(), mi.BSDFFlags.Smooth)
        normal = mi.Vector3f(dr.select(dr.dot(si.n, ray.d) > 0, -si.n, si.n))
        noise = _estimate_variances(table, si.p, normal, lit)
        chance, drawn = chance + noise[0], drawn + noise[1]
    if scattering:
        passed = RaySegment(ray, media.medium_at(ray), end.t)
        point = draw_uniform_point(media, passed, list(scattering), sampler.next_1d(), on)
        noise = _estimate_variances(table, ray(mi.Float(point.t)), None, point.on)
        chance, drawn = chance + noise[0], drawn + noise[1]
    return chance / (SAMPLING_COST * drawn) if drawn > 0 else 0.0


def _estimate_variances(table: EmissionTable, p: mi.Point3f, normal: mi.Vector3f | None, on: mi.Bool) -> tuple[float, float]:
    """Variances of the light scattered by points, by chance and with sampling, each summed over the points.

    Args:
        table: the emission.
        p: the points.
        normal: normals of surfaces, which scatter with the cosine; None for media, which scatter evenly.
        on: points that count.
    """
    points, n = dr.width(p), dr.width(p) * DIRECTIONS
    which = dr.arange(mi.UInt32, n) // DIRECTIONS
    p, on = dr.gather(mi.Point3f, p, which), dr.gather(mi.Bool, on, which)
    frame = None if normal is None else mi.Frame3f(dr.gather(mi.Vector3f, normal, which))
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(SEED, n)

    def own(d: mi.Vector3f) -> mi.Float:
        return mi.Float(dr.inv_four_pi) if frame is None else dr.maximum(dr.dot(frame.n, d), 0) * dr.inv_pi

    u, warp = sampler.next_2d(), mi.warp
    around = warp.square_to_uniform_sphere(u) if frame is None else frame.to_world(warp.square_to_cosine_hemisphere(u))
    towards = dr.normalize(table.sample_point(sampler.next_1d(), [sampler.next_1d() for _ in range(4)]) - p)
    met, aimed = (table.integrate_density(p, d, on) for d in (around, towards))
    a, b = own(around), own(towards)
    met_weighed = met.light * power_heuristic(a, met.pdf)
    drawn = dr.select(aimed.pdf > 0, b * aimed.light / aimed.pdf * power_heuristic(aimed.pdf, b), 0)
    rows = [np.array(v, dtype=np.float64).reshape(points, DIRECTIONS) for v in (met.light, met_weighed, drawn)]
    by_chance, weighed, found = (float(row.var(axis=1).sum()) for row in rows)
    return by_chance, weighed + found


@dataclass
class MediaLight:
    """The light that media emit.

    Attributes:
        density, cumulative: as in :class:`mivol.transport.estimators.lighting.emission_sampling.EmissionTable`.
        gain: predicted gain in time to an error of sampling over chance [1]; NaN after the plan, which has used it.
    """

    density: mi.Float
    cumulative: mi.Float64
    gain: float = math.nan
