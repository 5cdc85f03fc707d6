"""The random numbers of a scattering event, and quasi-random shifts of them for several events on one ray."""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from mivol.transport.traversal.strata import Strata

__all__ = ["EventSamples"]


@dataclass
class EventSamples:
    """The random numbers of one scattering event, uniform in [0, 1).

    Attributes:
        piece: seeds the reservoir that keeps a piece of the ray.
        inside: technique of distance sampling, and the distance in the piece.
        which_emitter: the emitter.
        emitter: point or direction on it.
        component: component of the phase function.
        direction: direction of the phase sample.
        which_shadow_ray: the shadow ray whose derivative is computed.
        strata: strata that directions are drawn from; None for the whole square.
    """

    piece: mi.Float
    inside: mi.Point2f
    which_emitter: mi.Float
    emitter: mi.Point2f
    component: mi.Float
    direction: mi.Point2f
    which_shadow_ray: mi.Float
    strata: Strata | None = None

    def part(self, number: mi.UInt32, count: int) -> EventSamples:
        """The numbers of one of ``count`` events on a ray.

        They are those of the first event, shifted by an additive recurrence; directions are stratified over the events.
        """
        if count == 1:
            return self.aim(self.emitter, self.direction)
        # Additive recurrences with the generalised golden ratios have low discrepancy in one and two dimensions (Roberts 2018).
        k, across = mi.Float(number), max(a for a in range(1, int(count**0.5) + 1) if count % a == 0)
        part = Strata(number, across, count // across)

        def one(u: mi.Float) -> mi.Float:
            return _wrap(dr.fma(k, 0.6180339887, u))

        def two(u: mi.Point2f) -> mi.Point2f:
            return mi.Point2f(_wrap(dr.fma(k, 0.7548776662, u.x)), _wrap(dr.fma(k, 0.5698402910, u.y)))

        moved = EventSamples(
            self.piece,
            two(self.inside),
            self.which_emitter,
            self.emitter,
            one(self.component),
            self.direction,
            one(self.which_shadow_ray),
            self.strata,
        )
        return moved.aim(part.jitter(two(self.emitter)), part.jitter(two(self.direction)))

    def aim(self, emitter: mi.Point2f, direction: mi.Point2f) -> EventSamples:
        """The same numbers with others for directions, which are moved into their strata."""
        if self.strata is not None:
            emitter, direction = self.strata.jitter(emitter), self.strata.jitter(direction)
        return replace(self, emitter=emitter, direction=direction, strata=None)


def _wrap(x: mi.Float) -> mi.Float:
    return x - dr.floor(x)
