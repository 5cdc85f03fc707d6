"""What the first walk of paths has found along their segments, in memory, for the replay of the same paths.

A replay draws the same random numbers, so it finds the same collisions and the same shadows. It reads them here. So it walks no
grid for a flight and traces no shadow ray of a vertex. It traces a segment only if the segment ends at a surface, or if
derivatives need the boundaries on the way.

Memory: 12 bytes a segment, 16 with shadows, and 24 more with near light; 36, and 48 more, with an rgb extinction.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from mivol.transport.estimators.segment import KnownFlight, SegmentEstimate
from mivol.transport.estimators.single_scattering.near_light import NearLightPlace

__all__ = ["KeptSegments", "SegmentNumber"]


@dataclass
class SegmentNumber:
    """The number of the next segment of a path among the segments in memory.

    Attributes:
        index: index in memory.
        left: number of segments for which the memory has room.
    """

    index: mi.UInt32
    left: mi.UInt32

    def after(self, stride: int, on: mi.Bool) -> SegmentNumber:
        """The number after a followed segment, in the lanes that followed."""
        following, left = self.index + stride, dr.maximum(self.left, 1) - 1
        return SegmentNumber(dr.select(on, following, self.index), dr.select(on, left, self.left))


AT_SURFACE = -1.0
"""Stored distance of segments that end at a surface; infinite if a path leaves the scene."""


@dataclass
class KeptSegments:
    """What a walk has found along segments, in memory.

    Attributes:
        t: distance of the collision on the ray [length], or ``AT_SURFACE``, or infinite.
        body: index of the medium of the collision.
        shadow: transmittance of the shadow ray of the vertex in front of the segment, as in ``DirectSample`` [1]; None if
            replays follow shadow rays again.
        weight: weight of each channel of an rgb extinction [1]; None in grey scenes.
        places: where segments have found near light; None without near light, or if replays draw it again.
        skips_boundaries: replays need no boundary in front of the end of a segment.
    """

    t: mi.Float64
    body: mi.UInt32
    shadow: mi.Float | mi.Spectrum | None
    weight: mi.Spectrum | None
    places: NearLightPlace | None
    skips_boundaries: bool

    @classmethod
    def empty(cls, count: int, channels: int, keeps_shadows: bool, keeps_places: bool, skips_boundaries: bool) -> KeptSegments:
        """Room in memory for many segments, in a scene with so many channels of the extinction."""
        shadow = dr.empty(mi.Float if channels == 1 else mi.Spectrum, count) if keeps_shadows else None
        places = NearLightPlace.empty(count, channels) if keeps_places else None
        weight = dr.empty(mi.Spectrum, count) if channels > 1 else None
        kept = cls(dr.empty(mi.Float64, count), dr.empty(mi.UInt32, count), shadow, weight, places, skips_boundaries)
        dr.eval(kept)
        return kept

    def set_flight(self, index: mi.UInt32, estimate: SegmentEstimate, active: mi.Bool) -> None:
        """Write the ends of segments to memory."""
        hit = estimate.collision
        t = dr.select(hit.on, hit.t, dr.select(estimate.end.si.is_valid(), mi.Float64(AT_SURFACE), mi.Float64(dr.inf)))
        dr.scatter(self.t, t, index, active)
        dr.scatter(self.body, hit.body, index, active & hit.on)
        if self.weight is not None:
            dr.scatter(self.weight, estimate.T, index, active)

    def flight_at(self, index: mi.UInt32, active: mi.Bool, other: KnownFlight) -> KnownFlight:
        """The flights of the segments with an index; in lanes that are not active, the ``other`` flights."""
        t = dr.gather(mi.Float64, self.t, index, active)
        collides = active & (t >= 0) & dr.isfinite(t)
        body = dr.gather(mi.UInt32, self.body, index, collides)
        distance = dr.select(collides, t, dr.inf)
        flight = KnownFlight(dr.select(active, distance, other.t), dr.select(active, body, other.body), active | other.on)
        if self.weight is not None:
            weight = dr.gather(mi.Spectrum, self.weight, index, active)
            flight.weight = dr.select(active, weight, 1 if other.weight is None else other.weight)
        if self.skips_boundaries:
            flight.meets_no_surface = active & (t >= 0)
        return flight

    def set_shadow(self, index: mi.UInt32, T: mi.Spectrum, active: mi.Bool) -> None:
        """Write the shadows of vertices to memory."""
        if self.shadow is not None:
            dr.scatter(self.shadow, T[0] if isinstance(self.shadow, mi.Float) else T, index, active)

    def shadow_at(self, index: mi.UInt32, active: mi.Bool) -> tuple[mi.Float | mi.Spectrum, mi.Bool] | None:
        """The shadows of the vertices with an index, and the lanes with a shadow; None without shadows."""
        return None if self.shadow is None else (dr.gather(type(self.shadow), self.shadow, index, active), active)
