r"""A point drawn uniformly from the intervals of a segment in some media.

A uniform point estimates the derivative of the optical depth of a bounded extinction,

.. math:: \partial \tau = \int \partial \sigma\,dt = E[\ell\; \partial \sigma(t)], \qquad t \sim \mathrm{uniform}

with the length l of all intervals of the segment in the box of the field. A segment may leave a boundary and enter it again. A
reservoir keeps an interval with a probability proportional to its length, and reuses the single random number of the segment.

References: Chao 1982 (weighted reservoir sampling).
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from mivol.errors import MivolError
from mivol.transport.media.body import Body
from mivol.transport.media.extinction import BoundedExtinction, RayInterval
from mivol.transport.media.ray_intervals import MediumInterval, RaySegment, revisit_media
from mivol.transport.media.scene_media import SceneMedia

__all__ = [
    "PointReservoir",
    "bounded_parts",
    "offer_medium_interval",
    "offer_interval",
    "start_reservoirs",
    "UniformPoint",
    "draw_uniform_point",
]


@dataclass
class PointReservoir:
    """A reservoir that keeps an interval of several.

    Attributes:
        total: length of the intervals so far [length].
        begin, length: the kept interval.
        u: remainder of the random number, uniform in [0, 1).
    """

    total: mi.Float
    begin: mi.Float
    length: mi.Float
    u: mi.Float

    @property
    def t(self) -> mi.Float:
        """Distance of the point [length]."""
        return dr.fma(self.u, self.length, self.begin)


def bounded_parts(bodies: list[Body]) -> list[tuple[Body, BoundedExtinction]]:
    """The bounded extinctions of some media, in a fixed order."""
    return [(body, part) for body in bodies for part in body.view.parts if not part.exact_line]


def start_reservoirs(count: int, u: mi.Float | None, width: int) -> list[PointReservoir]:
    """Start a segment with ``count`` bounded extinctions.

    Raises:
        MivolError: ``count`` is not 0, and the segment has no random number.
    """
    if count and u is None:
        raise MivolError(
            "a segment through a bounded field has no random number; a drawn point estimates the derivative of its optical "
            "depth: give RaySegment.u."
        )
    zero = dr.zeros(mi.Float, width)
    return [PointReservoir(zero, zero, zero, mi.Float(u)) for _ in range(count)]


def offer_medium_interval(point: PointReservoir, part: BoundedExtinction, interval: RayInterval) -> PointReservoir:
    """Offer the part of an interval inside the box of a field to a reservoir."""
    return offer_interval(point, *part.clip(interval), interval.active)[0]


def offer_interval(point: PointReservoir, begin: mi.Float, end: mi.Float, on: mi.Bool) -> tuple[PointReservoir, mi.Bool]:
    """Offer the interval between two distances to a reservoir; also returns the lanes keeping the interval."""
    length = dr.select(on & (end > begin), end - begin, 0)
    total = point.total + length
    share = length / dr.select(total > 0, total, 1)
    keep = point.u < share
    # Given the outcome, the number is uniform in [0, share) or in [share, 1), and is stretched to [0, 1) again.
    u = dr.select(keep, point.u / dr.select(share > 0, share, 1), (point.u - share) / dr.select(share < 1, 1 - share, 1))
    kept = PointReservoir(total, dr.select(keep, begin, point.begin), dr.select(keep, length, point.length), u)
    return kept, keep & (length > 0)


ENDLESS = 1e30
"""Distance [length] from which a ray counts as endless: rays from a surface are as long as the largest float32, others
infinite.
"""


@dataclass
class UniformPoint:
    """A point of a segment, and the length of its intervals.

    Attributes:
        t: distance of the point on the ray [length].
        length: length of all intervals together [length]; a function times this length has the mean of its integral over them.
        body: index of the medium.
        on: lanes with a point.
    """

    t: mi.Float64
    length: mi.Float
    body: mi.UInt32
    on: mi.Bool


def draw_uniform_point(media: SceneMedia, passed: RaySegment, among: list[Body], u: mi.Float, active: mi.Bool) -> UniformPoint:
    """Draw a point uniformly from the intervals of a segment in some media.

    Args:
        media: media of the scene.
        passed: the segment, of known length.
        among: the media to draw from. Intervals without end count as empty.
        u: number in [0, 1).
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
    start = (PointReservoir(zero, zero, zero, u + zero), dr.zeros(mi.UInt32, width))
    point, body = revisit_media(media, passed, visit, start, active)
    return UniformPoint(mi.Float64(point.t), point.total, body, active & (point.total > 0))
