r"""A point of each bounded extinction along a segment, drawn uniformly, for the derivative of its optical depth.

.. math:: \partial \tau = \int \partial \sigma\,dt = E[\ell\; \partial \sigma(t)], \qquad t \sim \mathrm{uniform}

with the length l of all the segment's intervals in the field's box. A segment may leave a boundary and enter it again: one of
its intervals is kept with a probability proportional to its length, by weighted reservoir sampling, which reuses the one random
number of the segment.

References: Chao 1982 (weighted reservoir sampling).
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from mivol.errors import MivolError
from mivol.transport.media.body import Body
from mivol.transport.media.bounded_extinction import BoundedExtinction
from mivol.transport.media.extinction import RayInterval

__all__ = ["DrawnPoint", "bounded_parts", "draw_in", "offer_interval", "start_points"]


@dataclass
class DrawnPoint:
    """The reservoir of one bounded extinction.

    Attributes:
        total: length [length] of the intervals so far.
        begin, length: the one that was kept.
        u: what is left of the random number, uniform in [0, 1).
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
    return offer_interval(point, *part.clip(interval), interval.active)[0]


def offer_interval(point: DrawnPoint, begin: mi.Float, end: mi.Float, on: mi.Bool) -> tuple[DrawnPoint, mi.Bool]:
    """Offer the interval between two distances to the reservoir; besides, the lanes that keep it."""
    length = dr.select(on & (end > begin), end - begin, 0)
    total = point.total + length
    share = length / dr.select(total > 0, total, 1)
    keep = point.u < share
    # Given the outcome, the number is uniform in [0, share) or in [share, 1), and is stretched to [0, 1) again.
    u = dr.select(keep, point.u / dr.select(share > 0, share, 1), (point.u - share) / dr.select(share < 1, 1 - share, 1))
    kept = DrawnPoint(total, dr.select(keep, begin, point.begin), dr.select(keep, length, point.length), u)
    return kept, keep & (length > 0)
