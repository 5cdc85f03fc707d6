"""The media of a scene, and the start and end of a pass of derivatives with respect to them.

Conventions. A body is a medium behind a boundary. Rays are clipped to boundaries that are boxes or balls; other boundaries are
traced.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable, Sequence
from copy import copy
from dataclasses import replace
from functools import cached_property, reduce
from operator import or_
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.transport.media.body import Body, is_followed
from mivol.transport.media.extinction import to_scene_channels
from mivol.transport.media.phases import Phase
from mivol.transport.traversal.box import opaque_numbers, opaque_rows
from mivol.transport.traversal.rays import Ray, spawn_ray, to_mitsuba_ray

__all__ = ["SceneMedia", "ScenePhases"]


class SceneMedia:
    """The media of a scene, with the parts of Mitsuba's scene that have to be traced.

    Args:
        scene: Mitsuba's scene: surfaces and boundaries.
        bodies: the media.
        has_surfaces: whether some shape is more than the boundary of a medium.
        has_null_transmission: whether some surface transmits part of the light undeviated.
        start: the medium named by the sensor, or None.
        locates_camera: whether the camera may be inside a traced boundary while the sensor names no medium.
        size: size of the scene [length], which scales the offset of spawned rays.
        stops_rays: whether every traced boundary stops or turns all rays, so that a segment stays in one medium.
        surface_boxes: (3, 4) maps from the world to cubes [-1, 1]^3 that contain all surfaces and traced boundaries; None if
            unknown.
        tracer: a scene of the surfaces alone, without the boundaries of ``boxed`` media; None to trace ``scene``.
        lit_box: corners (2, 3) of the box around the boundaries of media; None if unknown.
    """

    def __init__(
        self,
        scene: mi.Scene,
        bodies: list[Body],
        has_surfaces: bool,
        has_null_transmission: bool = False,
        start: mi.Medium | None = None,
        locates_camera: bool = False,
        size: float = 1.0,
        stops_rays: bool = False,
        surface_boxes: Sequence[np.ndarray] | None = None,
        tracer: mi.Scene | None = None,
        lit_box: np.ndarray | None = None,
    ) -> None:
        self.scene, self.tracer, self.lit_box = scene, tracer or scene, lit_box
        self.boxed = [b for b in bodies if b.box is not None]
        # The tracer tells a segment by its medium, which several boundaries may share.
        self.traced = list({b.view.medium.ptr: b for b in bodies if b.box is None}.values())
        self.has_surfaces, self.has_null_transmission = has_surfaces, has_null_transmission
        self.traces = has_surfaces or bool(self.traced)
        self.channels = 1 if mi.is_monochromatic else max([b.view.channels for b in bodies], default=1)
        self.start, self.locates_camera = start, locates_camera
        self.size = mi.Float(opaque_numbers(np.array([size], np.float64))[0])
        self.stops_rays = stops_rays
        self.has_solid_surfaces = has_surfaces and stops_rays and (tracer is not None or not self.boxed)
        self.surface_boxes = surface_boxes and [
            [[mi.Float(v) for v in row] for row in opaque_rows(rows)] for rows in surface_boxes
        ]

    @cached_property
    def alone(self) -> SceneMedia:
        """The media without the surfaces."""
        media = copy(self)
        media.has_surfaces = media.traces = False
        return media

    def by_quadrature(self) -> SceneMedia:
        """The same media, with their gradients and tangents, whose bounded parts are integrated by quadrature."""
        if not self.is_bounded:
            return self
        media = copy(self)
        media.__dict__.pop("alone", None)
        media.boxed, media.traced = ([body.by_quadrature() for body in bodies] for bodies in (self.boxed, self.traced))
        return media

    def find_blocked(self, ray: Ray, active: mi.Bool) -> mi.Bool:
        """Find the rays that meet a surface, if ``has_solid_surfaces``."""
        traced = to_mitsuba_ray(ray)
        return self.tracer.ray_test(traced, active & self.may_meet_surface(traced, traced.maxt))

    @cached_property
    def phases(self) -> ScenePhases:
        """The phase functions of the media."""
        return ScenePhases(self.bodies)

    @property
    def bodies(self) -> list[Body]:
        """All media."""
        return self.boxed + self.traced

    def bodies_at(self, index: mi.UInt32, on: mi.Bool) -> list[tuple[Body, mi.Bool]]:
        """The media, each with the lanes of ``on`` whose ``index`` among ``bodies`` is that medium."""
        return [(body, on & (index == k)) for k, body in enumerate(self.bodies)]

    def medium_of(self, index: mi.UInt32, on: mi.Bool) -> mi.MediumPtr:
        """Mitsuba's medium by its index among ``bodies``; null in lanes that are not ``on``."""
        medium = dr.zeros(mi.MediumPtr, dr.width(on))
        for body, own in self.bodies_at(index, on):
            medium = dr.select(own, mi.MediumPtr(body.view.medium), medium)
        return medium

    @property
    def is_homogeneous(self) -> bool:
        """Whether every medium is the same everywhere in its boundary, so only the length of a ray inside counts."""
        return all(part.is_constant for body in self.bodies for part in body.view.parts)

    @property
    def follows_extinction(self) -> bool:
        """Whether the extinction of some medium is differentiated."""
        return any(body.follows_extinction for body in self.bodies)

    @property
    def is_single(self) -> bool:
        """Whether a single walk of cells passes all extinction in order: one medium, whose grids share their cells."""
        return len(self.bodies) == 1 and len(self.bodies[0].flight_parts) == len(self.bodies[0].view.parts)

    def to_channels(self, values: list[mi.Float]) -> list[mi.Float]:
        """Numbers of a grey or rgb body, for each channel of the scene."""
        return to_scene_channels(values, self.channels)

    def sum_channels(self, rows: list[mi.Float]) -> list[mi.Float]:
        """Derivatives by the channels of the scene, from derivatives by colours: the transpose of :meth:`to_channels`."""
        return rows if len(rows) == self.channels else [sum(rows[1:], rows[0])]

    @property
    def tracks_shadows(self) -> bool:
        """Whether tracking estimates the transmittance of shadow rays: always in bounded fields."""
        return self.estimates_shadows or self.is_bounded

    @property
    def estimates_shadows(self) -> bool:
        """Whether images may estimate the transmittance of some medium, whose block ranges are known."""
        return any(b.estimates_shadows for b in self.bodies)

    @property
    def is_bounded(self) -> bool:
        """Whether some medium has no known optical depth along a ray, so its transmittance is estimated."""
        return any(b.is_bounded for b in self.bodies)

    @property
    def emits(self) -> bool:
        """Whether some medium is a source of light."""
        return any(b.view.emits for b in self.bodies)

    def vectors_to_channels(self, values: list[mi.Vector3f]) -> list[mi.Vector3f]:
        """Vectors of a grey or rgb body, for each channel of the scene."""
        axes = [self.to_channels([v[a] for v in values]) for a in range(3)]
        return [mi.Vector3f(*v) for v in zip(*axes, strict=True)]

    def medium_at(self, ray: mi.Ray3f) -> mi.MediumPtr:
        """The medium around the origin of camera rays."""
        n = dr.width(ray)
        if self.start is not None:
            return dr.select(dr.full(mi.Bool, True, n), mi.MediumPtr(self.start), None)
        if self.locates_camera:
            return _locate(self.scene, ray, self.size)
        return dr.zeros(mi.MediumPtr, n)

    def may_meet_surface(self, ray: mi.Ray3f, maxt: mi.Float) -> mi.Bool:
        """Whether a surface may lie on a ray up to the distance ``maxt`` [length]; never False if Mitsuba would find one."""
        if self.surface_boxes is None:
            return mi.Bool(True)
        meets = mi.Bool(False)
        for rows in self.surface_boxes:
            near, far = mi.Float(0), mi.Float(maxt)
            for row in rows:
                o = dr.fma(row[0], ray.o.x, dr.fma(row[1], ray.o.y, dr.fma(row[2], ray.o.z, row[3])))
                inverse = dr.rcp(dr.fma(row[0], ray.d.x, dr.fma(row[1], ray.d.y, row[2] * ray.d.z)))
                a, b = (-1 - o) * inverse, (1 - o) * inverse
                near, far = dr.maximum(near, dr.minimum(a, b)), dr.minimum(far, dr.maximum(a, b))
            # A ray inside the plane of a face has a NaN, and counts as meeting the box.
            meets |= ~(near > far)
        return meets

    def medium_around(self, p: mi.Point3f) -> mi.MediumPtr:
        """The medium around points, by the first traced boundary above; null for media in boxes, which need none."""
        n = dr.width(p)
        if not self.traced:
            return dr.zeros(mi.MediumPtr, n)
        return _locate(self.scene, mi.Ray3f(p, mi.Vector3f(0, 0, 1), dr.inf, mi.Float(0), mi.Color0f()), self.size)

    def find_followed(self) -> None:
        """Find what is differentiated in each medium."""
        for body in self.bodies:
            body.find_followed()

    def start_gradients(self, rays: float = math.inf) -> None:
        """Begin a reverse pass of so many rays: set the gradient of each part to zero."""
        for body in self.bodies:
            body.microflakes_gradient = dr.zeros(mi.Float, 6) if is_followed(body.view.microflakes) else None
            body.gradients = [part.start_gradient(rays) for part in body.view.parts]

    def deliver_gradients(self) -> None:
        """End a reverse pass: deliver the gradients of the parts to their parameters."""
        pairs = []
        for body in self.bodies:
            folded = (part.fold_gradient(g) for part, g in zip(body.view.parts, body.gradients, strict=True))
            pairs += [(dr.ravel(p.scaled(body.view.scale)), g) for p, g in zip(body.view.parts, folded, strict=True)]
            if body.microflakes_gradient is not None:
                slopes = (dr.gather(mi.Float, body.microflakes_gradient, mi.UInt32(k)) for k in range(6))
                pairs += zip(body.view.microflakes, slopes, strict=True)
            body.gradients, body.microflakes_gradient = [], None
        followed = [(values, gradient) for values, gradient in pairs if dr.grad_enabled(values)]
        if followed:
            dr.eval([gradient for _, gradient in followed])
            # All at once: parts may share edges, which Dr.Jit follows only once.
            for values, gradient in followed:
                dr.accum_grad(values, gradient)
                dr.enqueue(dr.ADMode.Backward, values)
            dr.traverse(dr.ADMode.Backward)

    def find_only_constant(self) -> mi.Float | mi.Color3f | None:
        """The only coefficient with gradients, if it is the same everywhere in its medium: a part of the extinction, times the
        scale of the medium, or the albedo. None for any other coefficient, for several, and beside emitting media.
        """
        found: dict[tuple, mi.Float | mi.Color3f | None] = {}
        for body in self.bodies:
            view = body.view
            if view.emits or is_followed(view.microflakes):
                return None
            for k, part in enumerate(view.parts):
                if body.follows[k]:
                    with dr.resume_grad():
                        found[view.medium.ptr, k] = part.scaled(view.scale) if part.is_constant else None
            if body.follows_albedo and view.albedo is not None:
                found[view.medium.ptr, "albedo"] = None if isinstance(view.albedo, mi.Volume) else view.albedo
        return next(iter(found.values())) if len(found) == 1 else None

    def start_unit_tangent(self) -> None:
        """Begin a forward pass along :meth:`find_only_constant`, with a tangent of 1 in every channel."""
        for body in self.bodies:
            parts = zip(body.view.parts, body.follows, strict=True)
            body.has_tangent, body.tangents = body.follows, [type(part.values)(1) if on else None for part, on in parts]
            if body.follows_albedo and body.view.albedo is not None:
                with dr.resume_grad():
                    albedo = dr.detach(body.view.albedo)
                    dr.enable_grad(albedo)
                    dr.set_grad(albedo, 1)
                body.view = replace(body.view, albedo=albedo)

    def start_tangent(self) -> None:
        """Begin a forward pass: take the tangent of each part from the parameters."""
        for body in self.bodies:
            products = [p.scaled(body.view.scale) for p in body.view.parts]
            followed = [p for p in products if dr.grad_enabled(p)]
            if followed:
                # The tangents of the parameters are kept: what else was made of them, such as an albedo, is followed later.
                dr.forward_to(*followed, flags=dr.ADFlag.ClearEdges)
            # A bounded part differentiates its field at points; its product does not tell whether it has a tangent.
            pairs = zip(products, body.view.parts, strict=True)
            body.has_tangent = [dr.grad_enabled(p) or not part.exact_line for p, part in pairs]
            body.tangents = [dr.detach(dr.grad(p)) for p in products]
            if dr.grad_enabled(body.phase):
                # A table is made from its values.
                dr.forward_to(body.phase, flags=dr.ADFlag.ClearEdges)
            if is_followed(body.view.microflakes):
                dr.forward_to(body.view.microflakes, flags=dr.ADFlag.ClearEdges)
                body.microflakes_tangent = dr.detach(dr.grad(body.view.microflakes))
            # A literal 0 would make the loop over the Gaussians of a cell take its sum for a constant.
            dr.make_opaque(body.tangents, body.microflakes_tangent)


@dr.syntax
def _locate(scene: mi.Scene, ray: mi.Ray3f, size: mi.Float) -> mi.MediumPtr:
    """Find the medium around a point: the near side of the first boundary along a ray, through all other surfaces."""
    probe = mi.Ray3f(ray.o, ray.d, dr.inf, ray.time, ray.wavelengths)  # the boundary may lie beyond the sensor's far_clip
    medium = dr.zeros(mi.MediumPtr, dr.width(ray))
    going = dr.full(mi.Bool, True, dr.width(ray))
    while dr.hint(going, label="the medium around the camera"):
        si = scene.ray_intersect(probe, mi.RayFlags.All, False, going)
        is_hit = going & si.is_valid()
        boundary = is_hit & si.is_medium_transition()
        medium = dr.select(boundary, si.target_medium(-ray.d), medium)
        probe = spawn_ray(si, ray.d, size)
        going = is_hit & ~boundary
    return medium


# -- Phase functions of the media -------------------------------------------------------------------------------------------


class ScenePhases:
    """The phase functions of some media. Media whose phase functions differ by numbers only share an evaluation.

    Args:
        bodies: the media.

    Attributes:
        has_microflakes: whether some phase function is, or contains, a microflake phase function.
    """

    def __init__(self, bodies: list[Body]) -> None:
        plugins = [body.view.medium.phase_function() for body in bodies]
        self.has_microflakes = any(int(p.flags()) & int(mi.PhaseFunctionFlags.Microflake) for p in plugins if p is not None)
        self._groups: dict[Hashable, list[Body]] = {}
        for body in bodies:
            key = body.phase.merge_key() or body.view.medium.phase_function().ptr
            self._groups.setdefault(key, []).append(body)

    def eval(self, mei: mi.MediumInteraction3f, d: mi.Vector3f, active: mi.Bool) -> mi.Spectrum:
        """Phase function at points of ``mei.medium`` for light from the direction ``d`` [1/sr], with derivatives."""
        return self._select(mei, active, mi.Spectrum(0), lambda phase, on: phase.eval_pdf(mei, d, on)[0])

    def pdf(self, mei: mi.MediumInteraction3f, d: mi.Vector3f, active: mi.Bool) -> mi.Float:
        """Density of the direction ``d`` in :meth:`sample` [1/sr]."""
        return self._select(mei, active, mi.Float(0), lambda phase, on: phase.eval_pdf(mei, d, on)[1])

    def sample(
        self, mei: mi.MediumInteraction3f, component: mi.Float, direction: mi.Point2f, active: mi.Bool
    ) -> tuple[mi.Vector3f, mi.Spectrum, mi.Float]:
        """Sample a direction.

        Args:
            mei: the point, its medium, and the direction towards the camera.
            component: uniform random number in [0, 1) for the component of the phase function.
            direction: two uniform random numbers in [0, 1) for the direction.
            active: lanes to sample.

        Returns:
            The direction, value over density [1], and density [1/sr].
        """
        nothing = mi.Vector3f(0, 0, 1), mi.Spectrum(0), mi.Float(0)
        return self._select(mei, active, nothing, lambda phase, on: phase.sample(mei, component, direction, on))

    def _select(
        self, mei: mi.MediumInteraction3f, active: mi.Bool, rest: Any, evaluate: Callable[[Phase, mi.Bool], Any]
    ) -> Any:
        """The result of ``evaluate`` for the phase function of each lane's medium; ``rest`` in other lanes."""
        for bodies in self._groups.values():
            phase, *others = [body.phase for body in bodies]
            inside = [mei.medium == mi.MediumPtr(body.view.medium) for body in bodies]
            for other, own in zip(others, inside[1:], strict=True):
                phase = dr.select(own, other, phase)
            on = active if len(self._groups) == 1 else active & reduce(or_, inside)
            rest = dr.select(on, evaluate(phase, on), rest)
        return rest
