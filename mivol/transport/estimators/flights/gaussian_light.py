r"""The light that Gaussians show along a flight, with its derivatives.

.. math:: \int_0^D T(t)\,j\,dt = \sum_k T(t_k)\,N_k, \qquad E\big[\,[t > t_k]\,\big] = T(t_k)

A flight of length t that gets as far as t_k, where the ray enters Gaussians, adds all the light N_k that they show from there
to where it leaves them (:mod:`mivol.transport.media.gaussian_sweep`), and not that of one point: N_k is the sum in their order,
which no point has, and has no noise. Its derivative by what lies in front of them is that of the flight's own chance to get so
far, -N_k times that of its optical depth.

References: Spanier & Gelbard 1969 (expected values in the place of events).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from mivol.transport.estimators.segment import PathSegment
from mivol.transport.media.channels import to_components
from mivol.transport.media.compositing import zeros
from mivol.transport.media.gaussian_sweep import GaussianSweep
from mivol.transport.media.optical_depth import jvp_optical_depth, vjp_optical_depth
from mivol.transport.media.ray_intervals import MediumInterval, RaySegment, revisit_media
from mivol.transport.media.scene_media import SceneMedia

__all__ = ["GaussianLight"]


@dataclass
class _Entry:
    """Where a flight enters Gaussians.

    Attributes:
        interval: of the ray in them, in the lanes that get so far.
        front: the flight to there.
        gain: throughput at its end.
    """

    interval: MediumInterval
    front: RaySegment
    gain: mi.Spectrum

    @property
    def on(self) -> mi.Bool:
        """Lanes that enter."""
        return self.interval.active


class GaussianLight:
    """The light of all Gaussians along a flight, as the camera sees it.

    Args:
        media: of the scene.
        segment: ray and throughput.
        ends: distances at which the segment ends, at a surface, and the flight, at the latest there [length].
        weigh: the weight of each channel at the end of a part of the flight.
        active: lanes that fly.

    Cost: of each of the methods a walk of the media that show Gaussians, to the end of the segment; derivatives walk what is in
    front of them too.
    """

    def __init__(
        self,
        media: SceneMedia,
        segment: PathSegment,
        ends: tuple[mi.Float, mi.Float64],
        weigh: Callable[[RaySegment, mi.Bool], mi.Spectrum],
        active: mi.Bool,
    ) -> None:
        self.media, self.segment, self.weigh, self.active = media, segment, weigh, active
        self.whole, self.reached = RaySegment.upto(segment.ray, segment.medium, ends[0]), ends[1]
        self.rows = dr.size_v(mi.Spectrum)

    def value(self) -> mi.Spectrum:
        """The light."""

        def add(total: mi.Spectrum, entry: _Entry) -> mi.Spectrum:
            N = mi.Spectrum(*GaussianSweep(entry.interval, self.rows).integrate(True).N)
            return total + dr.select(entry.on, entry.gain * N, 0)

        return self._visit(add, mi.Spectrum(0))

    def vjp(self, dL: mi.Spectrum) -> None:
        """Add ``dL`` times its derivatives to the gradients of the media."""

        def add(state: tuple, entry: _Entry) -> tuple:
            sweep, weight = GaussianSweep(entry.interval, self.rows), dr.select(entry.on, dL * entry.gain, 0)
            own = sweep.integrate(False)
            sweep.vjp(to_components(weight), own.tau, zeros(mi.Float, self.rows))
            vjp_optical_depth(self.media, entry.front, -weight * mi.Spectrum(*own.N), entry.on)
            return state

        self._visit(add, ())

    def jvp(self) -> mi.Spectrum:
        """Its tangent."""

        def add(total: mi.Spectrum, entry: _Entry) -> mi.Spectrum:
            own = GaussianSweep(entry.interval, self.rows, tangent=True).integrate(False)
            N, change = (mi.Spectrum(*rows) for rows in (own.N[: self.rows], own.N[self.rows :]))
            change -= N * jvp_optical_depth(self.media, entry.front, entry.on)
            return total + dr.select(entry.on, entry.gain * change, 0)

        return self._visit(add, mi.Spectrum(0))

    def _visit(self, add: Callable, state: object) -> object:
        """Visit each place where the flight enters Gaussians that are shown."""

        def visit(state: object, interval: MediumInterval) -> object:
            if not interval.body.view.shows_gaussians:
                return state
            begin, _ = interval.inside()
            interval = replace(interval, active=interval.active & (begin < self.reached))
            front = RaySegment.upto(self.segment.ray, self.segment.medium, dr.select(interval.active, begin, 0))
            gain = self.segment.beta * self.weigh(front, interval.active)
            return add(state, _Entry(interval, front, gain))

        return revisit_media(self.media, self.whole, visit, state, self.active)
