"""The event at the end of a path segment: a surface, or escape from the scene.

Scattering inside a segment is no event of the path: the segment's estimator samples it and lights it, and the path itself goes
straight on.
"""

from __future__ import annotations

from dataclasses import dataclass

import mitsuba as mi

from mivol.transport.estimators.vertex import SurfaceVertex
from mivol.transport.media.ray_intervals import SegmentEnd
from mivol.transport.media.scene_media import SceneMedia

__all__ = ["PathEvent"]


@dataclass
class PathEvent:
    """The end of a segment.

    Attributes:
        si: the surface; not valid where the path has left the scene.
        t: length of the segment [length].
        medium: the medium around the end.
        at_surface: lanes that have hit a surface; the others have escaped, or ended before.
    """

    si: mi.SurfaceInteraction3f
    t: mi.Float
    medium: mi.MediumPtr
    at_surface: mi.Bool

    @classmethod
    def of(cls, end: SegmentEnd, active: mi.Bool) -> PathEvent:
        """The event at the end of a segment."""
        return cls(end.si, end.t, end.medium, active & end.si.is_valid())

    def vertex(self, media: SceneMedia, ray: mi.Ray3f) -> SurfaceVertex:
        """The surface as a vertex, at which direct light is estimated."""
        return SurfaceVertex(media, self.si, self.si.bsdf(ray), self.medium)
