r"""A point of each bounded extinction along a segment, drawn evenly: derivatives of the optical depth are looked at there.

.. math:: \partial \tau = \int \partial \sigma\,dt = E[\ell\; \partial \sigma(t)], \qquad t \sim \mathrm{uniform}

with the length l of all the segment's intervals in the field's box. A segment may leave a boundary and enter it again: the
interval is kept by its share of the length so far (reservoir sampling), which needs no more than the one number of the segment.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from mivol.errors import MivolError
from mivol.transport.media.body import Body
from mivol.transport.media.bounded_extinction import BoundedExtinction
from mivol.transport.media.extinction import RayInterval

__all__ = ["DrawnPoint", "bounded_parts", "draw_in", "start_points"]


@dataclass
class DrawnPoint:
    """What has been seen of one bounded extinction.

    Attributes:
        total: length [length] of the intervals so far.
        begin, length: the one that was kept.
        u: what is left of the random number, even in [0, 1).
    """

    total: mi.Float
    begin: mi.Float
    length: mi.Float
    u: mi.Float

    @property
    def t(self) -> mi.Float:
        """Distance of the point."""
        return dr.fma(self.u, self.length, self.begin)


def bounded_parts(bodies: list[Body]) -> list[tuple[Body, BoundedExtinction]]:
    """The bounded extinctions of some media, in a fixed order."""
    return [(body, part) for body in bodies for part in body.view.parts if not part.exact_line]


def start_points(count: int, u: mi.Float | None, width: int) -> list[DrawnPoint]:
    """Begin a segment with ``count`` bounded extinctions.

    Raises:
        MivolError: there are some, and the segment has no random number.
    """
    if count and u is None:
        raise MivolError("the derivative of an optical depth through a bounded field was asked for, which is estimated only.")
    zero = dr.zeros(mi.Float, width)
    return [DrawnPoint(zero, zero, zero, mi.Float(u)) for _ in range(count)]


def draw_in(point: DrawnPoint, part: BoundedExtinction, interval: RayInterval) -> DrawnPoint:
    """Offer one more interval to the reservoir."""
    begin, end = part.clip(interval)
    length = dr.select(interval.active & (end > begin), end - begin, 0)
    total = point.total + length
    share = length / dr.select(total > 0, total, 1)
    keep = point.u < share
    # Given the outcome, the number is even again in its part of [0, 1).
    u = dr.select(keep, point.u / dr.select(share > 0, share, 1), (point.u - share) / dr.select(share < 1, 1 - share, 1))
    return DrawnPoint(total, dr.select(keep, begin, point.begin), dr.select(keep, length, point.length), u)
