"""A point of a segment that is drawn evenly from its intervals in some media."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from mivol.transport.media.body import Body
from mivol.transport.media.drawn_points import DrawnPoint, offer_interval
from mivol.transport.media.ray_intervals import MediumInterval, RaySegment, revisit_media
from mivol.transport.media.scene_media import SceneMedia

__all__ = ["EvenPoint", "draw_even_point"]


ENDLESS = 1e30
"""Distance [length] from which a ray counts as one without end: those that start at a surface are as long as the largest
float32, the others infinite."""


@dataclass
class EvenPoint:
    """A point of a segment, and the length that it stands for.

    Attributes:
        t: its distance on the ray [length].
        length: of all intervals together [length]; a function times this has the mean of its integral over them.
        body: index of its medium.
        on: lanes that have one.
    """

    t: mi.Float64
    length: mi.Float
    body: mi.UInt32
    on: mi.Bool


def draw_even_point(media: SceneMedia, passed: RaySegment, among: list[Body], u: mi.Float, active: mi.Bool) -> EvenPoint:
    """Draw a point evenly from the intervals of a segment in some media.

    Args:
        media: of the scene.
        passed: the segment, which has been walked before.
        among: the media asked about. Intervals without end count as empty.
        u: a number in [0, 1).
        active: lanes to draw for.
    """
    width, bodies = dr.width(passed.ray), media.bodies

    def visit(state: tuple, interval: MediumInterval) -> tuple:
        point, index = state
        if not any(interval.body is body for body in among):
            return state
        begin, end = interval.inside()
        on = interval.active & (end > begin) & (end < ENDLESS)
        point, kept = offer_interval(point, mi.Float(dr.select(on, begin, 0)), mi.Float(dr.select(on, end, 0)), on)
        number = next(k for k, body in enumerate(bodies) if body is interval.body)
        return point, dr.select(kept, mi.UInt32(number), index)

    zero = dr.zeros(mi.Float, width)
    start = (DrawnPoint(zero, zero, zero, u + zero), dr.zeros(mi.UInt32, width))
    point, body = revisit_media(media, passed, visit, start, active)
    return EvenPoint(mi.Float64(point.t), point.total, body, active & (point.total > 0))
