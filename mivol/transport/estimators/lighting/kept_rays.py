r"""A path keeps one ray of many and follows the kept ray at the end of the path. Rays mirrored by glass are kept this way.

.. math:: L = \frac{w}{w_c}\, L_c, \qquad w = \sum_k w_k

A path keeps ray c of its rays k with the probability w_c / w, by weighted reservoir sampling. For all weights above 0 the mean
equals the sum over all rays. With weights in proportion to the light L_k, only w has noise.

**Mirrors.** Glass mirrors a share R = 4 to 10 % of the light. By chance, a share R of the paths is mirrored and meets lamps in
mirrors, and emitter samples never do. So at smooth glass every path offers the mirrored ray with its share R of the light, and
a mirrored path leaves out the next lamp. The weight of a ray contains the radiance of the environment in the direction of the
ray, and the mean radiance of lamps with a bounding ball on the way.

References: Chao 1982 (weighted reservoir sampling); Arvo & Kirk 1990 (splitting in place of chance).
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Self

import drjit as dr
import mitsuba as mi

from mivol.transport.estimators.lighting.emitters import SceneEmitters
from mivol.transport.estimators.lighting.shadow_rays import find_transmittance
from mivol.transport.media.scene_media import SceneMedia
from mivol.transport.traversal.rays import FineRay, Ray

__all__ = ["LARGEST_REFLECTANCE", "KeptMirror", "KeptRay", "MirroredEmitters"]


RADIANCE_DRAWS, LEAST_RADIANCE = 64, 1e-3
"""Number of points at which the radiance of a lamp is read, and least share of the largest radiance of a lamp [1], since a
texture may be dark at these points. All numbers above 0 are unbiased."""

BALL = 1.001 * 3**0.5
"""Radius of the ball around the bounding box of a lamp, over the root mean square distance of its points [1]."""

LARGEST_REFLECTANCE = 0.95
"""Reflectance of glass above which mirrored paths find lamps by chance [1]: rays of total reflections would displace each
other. (Variance over that with 0.5: balls of thin glass 0.93 and 0.96.)"""


@dataclass
class KeptRay:
    """A ray kept by a path (weighted reservoir sampling).

    Attributes:
        p: origin of the ray.
        aim: point at which the ray ends, or its direction.
        medium: medium around the origin.
        light: factor on the light at the end of the ray [1], or light without shadows [radiance].
        weight: reservoir weight of the ray.
        total: total weight of the rays so far.
    """

    p: mi.Point3d
    aim: mi.Point3f
    medium: mi.MediumPtr
    light: mi.Spectrum
    weight: mi.Float
    total: mi.Float

    @classmethod
    def empty(cls, n: int) -> Self:
        """A reservoir of ``n`` lanes before the first ray."""
        kinds = mi.Point3d, mi.Point3f, mi.MediumPtr, mi.Spectrum, mi.Float, mi.Float
        return cls(*(dr.zeros(kind, n) for kind in kinds))

    def add(
        self,
        ray: tuple[mi.Point3d, mi.Point3f | mi.Vector3f, mi.MediumPtr, mi.Spectrum],
        weight: mi.Float,
        chance: mi.Float,
    ) -> Self:
        """Offer another ray (``p``, ``aim``, ``medium``, ``light``); ``chance`` is uniform in [0, 1)."""
        total = self.total + weight
        keep = chance * total < weight
        mine = self.p, self.aim, self.medium, self.light, self.weight
        return type(self)(*(dr.select(keep, new, type(old)(old)) for new, old in zip((*ray, weight), mine, strict=True)), total)

    def scatter(self, values: Self, index: mi.UInt32, active: mi.Bool) -> None:
        """Write the reservoirs of lanes that are ``active`` to the lanes ``index``."""
        for field in fields(self):
            dr.scatter(getattr(self, field.name), getattr(values, field.name), index, active)

    def light_of_all(self) -> mi.Spectrum:
        """``light`` of the kept ray over the probability of keeping the ray; 0 without a ray."""
        on = self.weight > 0
        return dr.select(on, self.light * (self.total / dr.select(on, self.weight, 1)), 0)

    def light_at_camera(self, media: SceneMedia, ray: Ray) -> mi.Spectrum:
        """The light of all rays at the camera, from the kept ray [radiance].

        Args:
            media: media and surfaces.
            ray: a ray of each path, for its time.

        Cost: one ray.
        """
        raise NotImplementedError


class KeptMirror(KeptRay):
    """A kept ray mirrored by glass; ``aim`` is the direction."""

    def light_at_camera(self, media: SceneMedia, ray: Ray) -> mi.Spectrum:
        """Light of lamps and of the environment in mirrors, dimmed by partly transparent surfaces on the way."""
        on = self.weight > 0
        far = dr.full(mi.Float, dr.inf, dr.width(self.weight))
        mirrored = FineRay(self.p, mi.Vector3f(self.aim), far, ray.time, ray.wavelengths)
        end, _, _, T = find_transmittance(media, mirrored, self.medium, on, None)
        return self.light_of_all() * T * end.si.emitter(media.scene, on).eval(end.si, on)


class MirroredEmitters:
    """Guesses of the light along mirrored rays: of the environment, and of lamps with a surface.

    Args:
        scene: Mitsuba's scene.
        emitters: its emitters.
    """

    def __init__(self, scene: mi.Scene, emitters: SceneEmitters) -> None:
        self._environment = scene.environment()
        self._balls, radiances = [], []
        for emitter in scene.emitters():
            shape = emitter.get_shape()
            if shape is not None:
                self._balls.append(emitters.find_ball(emitter))
                radiances.append(_find_radiance(emitter, shape))
        largest = mi.Float(0)
        for radiance in radiances:
            largest = dr.maximum(largest, radiance)
        self._radiances = [dr.maximum(radiance, LEAST_RADIANCE * largest) + 1e-30 for radiance in radiances]
        dr.eval(self._radiances)

    def guess(self, ray: Ray, active: mi.Bool) -> mi.Spectrum:
        """A guess of the radiance along a ray, without shadows; above 0 for all rays to an emitter."""
        found = mi.Spectrum(0)
        if self._environment is not None:
            si = dr.zeros(mi.SurfaceInteraction3f, dr.width(ray.d))
            si.wi, si.wavelengths, si.time = -ray.d, ray.wavelengths, ray.time
            found += self._environment.eval(si, active)
        for (x, y, z, r), radiance in zip(self._balls, self._radiances, strict=True):
            away, reach = mi.Point3f(x, y, z) - mi.Point3f(ray.o), BALL * r
            ahead = dr.dot(away, ray.d)
            beside = dr.squared_norm(away - ahead * ray.d)
            meets = (ahead > -reach) & (beside <= dr.square(reach) + 1e-5 * dr.squared_norm(away))
            found += dr.select(meets, radiance, 0)
        return found


def _find_radiance(emitter: mi.Emitter, shape: mi.Shape) -> mi.Float:
    """Mean radiance of a lamp along its normal, of the brightest channel."""
    k = dr.arange(mi.Float, RADIANCE_DRAWS) + 0.5
    u = mi.Point2f(k / RADIANCE_DRAWS, k * 0.6180339887 - dr.floor(k * 0.6180339887))
    si = mi.SurfaceInteraction3f(shape.sample_position(mi.Float(0), u), mi.Color0f())
    si.wi = mi.Vector3f(0, 0, 1)
    return dr.mean(dr.max(emitter.eval(si)))
