"""Where a segment of a path ends: at a surface, or outside of the scene.

Media that a segment passes are events of the segment's own estimator, which lights them without turning the path.
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
        t: length of the segment.
        medium: what surrounds the end.
        at_surface: lanes that have met a surface; the others have escaped or ended before.
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
        """The surface as a vertex that may turn the path."""
        return SurfaceVertex(media, self.si, self.si.bsdf(ray), self.medium)
