"""The event at the end of a path segment: a collision with a medium, a surface, or escape from the scene."""

from __future__ import annotations

from dataclasses import dataclass

import mitsuba as mi

from mivol.transport.estimators.segment import Collision, SegmentEstimate
from mivol.transport.estimators.vertex import EitherVertex, MediumVertex, SurfaceVertex, Vertex
from mivol.transport.media.scene_media import SceneMedia

__all__ = ["PathEvent"]


@dataclass
class PathEvent:
    """The end of a segment.

    Attributes:
        si: the surface; not valid where the path has left the scene.
        t: length of the segment to there [length].
        medium: the medium around it.
        at_surface: lanes that have hit a surface.
        collision: where lanes have met a medium before; None where paths scatter at surfaces only.
        chance: for derivatives of paths that scatter in media, a number in [0, 1) by which one of their shadow rays is kept.
    """

    si: mi.SurfaceInteraction3f
    t: mi.Float
    medium: mi.MediumPtr
    at_surface: mi.Bool
    collision: Collision | None
    chance: mi.Float | None = None

    @classmethod
    def of(cls, found: SegmentEstimate, active: mi.Bool) -> PathEvent:
        """The event at the end of a segment."""
        end, collision = found.end, found.collision
        arrives = active if collision is None else active & ~collision.on
        chance = None if found.probe is None else found.probe.chance
        return cls(end.si, end.t, end.medium, arrives & end.si.is_valid(), collision, chance)

    @property
    def in_medium(self) -> mi.Bool:
        """Lanes that have met a medium."""
        return mi.Bool(False) if self.collision is None else self.collision.on

    def vertex(self, media: SceneMedia) -> Vertex:
        """The point at which light is scattered."""
        if self.collision is None:
            return self.surface_vertex(media)
        inside = MediumVertex(media, self.collision.mei, self.collision.place)
        return EitherVertex(self.surface_vertex(media), inside, self.collision.on) if media.has_surfaces else inside

    def surface_vertex(self, media: SceneMedia) -> SurfaceVertex:
        """The point of the surface."""
        return SurfaceVertex(media, self.si, self.si.bsdf(), self.medium)
