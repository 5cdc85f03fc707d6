"""The random numbers of one scattering event, and of several events on one ray."""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from mivol.transport.traversal.strata import Strata

__all__ = ["EventSamples"]


@dataclass
class EventSamples:
    """The random numbers of one scattering event: which piece, where in it, which lamp, its direction, the phase function's,
    and which of the two is followed back."""

    piece: mi.Float
    inside: mi.Point2f
    lamp: mi.Float
    emitter: mi.Point2f
    component: mi.Float
    direction: mi.Point2f
    choice: mi.Float
    strata: Strata | None = None

    def part(self, number: mi.UInt32, count: int) -> EventSamples:
        """The numbers of one of ``count`` events: those of the first, moved on, each in its part of the strata."""
        if count == 1:
            return self.aim(self.emitter, self.direction)
        # Multiples of the generalised golden ratios fill one and two dimensions evenly (Roberts 2018).
        k, across = mi.Float(number), max(a for a in range(1, int(count**0.5) + 1) if count % a == 0)
        part = Strata(number, across, count // across)

        def one(u: mi.Float) -> mi.Float:
            return _wrap(dr.fma(k, 0.6180339887, u))

        def two(u: mi.Point2f) -> mi.Point2f:
            return mi.Point2f(_wrap(dr.fma(k, 0.7548776662, u.x)), _wrap(dr.fma(k, 0.5698402910, u.y)))

        moved = EventSamples(
            self.piece,
            two(self.inside),
            self.lamp,
            self.emitter,
            one(self.component),
            self.direction,
            one(self.choice),
            self.strata,
        )
        return moved.aim(part.jitter(two(self.emitter)), part.jitter(two(self.direction)))

    def aim(self, emitter: mi.Point2f, direction: mi.Point2f) -> EventSamples:
        """The same with other numbers for directions, in their strata."""
        if self.strata is not None:
            emitter, direction = self.strata.jitter(emitter), self.strata.jitter(direction)
        return replace(self, emitter=emitter, direction=direction, strata=None)


def _wrap(x: mi.Float) -> mi.Float:
    return x - dr.floor(x)
