r"""The light of Gaussians along a flight, with its derivatives.

.. math:: \int_0^D T(t)\,j\,dt = \sum_k T(t_k)\,N_k, \qquad E\big[\,[t > t_k]\,\big] = T(t_k)

At t_k the ray enters Gaussians, whose light between entry and exit is N_k (:mod:`mivol.transport.media.gaussian_sweep`). A
flight reaching t_k adds all of N_k instead of the light of a sampled point: N_k is a sum in the order of the Gaussians, which
no single point has, and is free of noise. The derivative by the media in front of t_k is the derivative of the probability of
reaching t_k: -N_k times the derivative of their optical depth.

References: Spanier & Gelbard 1969 (expected values in place of events).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from mivol.transport.estimators.segment import PathSegment
from mivol.transport.media.compositing import zeros
from mivol.transport.media.extinction import to_components
from mivol.transport.media.gaussian_sweep import GaussianSweep
from mivol.transport.media.optical_depth import jvp_optical_depth, vjp_optical_depth
from mivol.transport.media.ray_intervals import MediumInterval, RaySegment, revisit_media
from mivol.transport.media.scene_media import SceneMedia

__all__ = ["GaussianLight"]


@dataclass
class _Entry:
    """An entry of a flight into Gaussians.

    Attributes:
        interval: interval of the ray in the Gaussians, in lanes whose flight reaches it.
        front: ray up to the entry.
        gain: throughput at the entry [1].
    """

    interval: MediumInterval
    front: RaySegment
    gain: mi.Spectrum

    @property
    def on(self) -> mi.Bool:
        """Lanes that enter."""
        return self.interval.active


class GaussianLight:
    """The light of the Gaussians along a flight, at the camera.

    Args:
        media: media of the scene.
        segment: segment of the path, with its throughput.
        ends: distances of the end of the segment, at a surface, and of the end of the flight, at most this far [length].
        channel_weight: returns the weight of each channel at the end of a part of the flight.
        active: lanes that fly.

    Cost: each method walks the media with emitting Gaussians to the end of the segment; derivatives walk the media in front
    too.
    """

    def __init__(
        self,
        media: SceneMedia,
        segment: PathSegment,
        ends: tuple[mi.Float, mi.Float64],
        channel_weight: Callable[[RaySegment, mi.Bool], mi.Spectrum],
        active: mi.Bool,
    ) -> None:
        self.media, self.segment, self.channel_weight, self.active = media, segment, channel_weight, active
        self.whole, self.reached = RaySegment.upto(segment.ray, segment.medium, ends[0]), ends[1]
        self.rows = dr.size_v(mi.Spectrum)

    def value(self) -> mi.Spectrum:
        """The light [radiance]."""

        def add(total: mi.Spectrum, entry: _Entry) -> mi.Spectrum:
            N = mi.Spectrum(*GaussianSweep(entry.interval, self.rows).integrate(True).N)
            return total + dr.select(entry.on, entry.gain * N, 0)

        return self._visit(add, mi.Spectrum(0))

    def vjp(self, dL: mi.Spectrum) -> None:
        """Add ``dL`` times the derivatives of the light to the gradients of the media."""

        def add(state: tuple, entry: _Entry) -> tuple:
            sweep, weight = GaussianSweep(entry.interval, self.rows), dr.select(entry.on, dL * entry.gain, 0)
            light = sweep.integrate(False)
            sweep.vjp(to_components(weight), light.tau, zeros(mi.Float, self.rows))
            vjp_optical_depth(self.media, entry.front, -weight * mi.Spectrum(*light.N), entry.on)
            return state

        self._visit(add, ())

    def jvp(self) -> mi.Spectrum:
        """Tangent of the light."""

        def add(total: mi.Spectrum, entry: _Entry) -> mi.Spectrum:
            light = GaussianSweep(entry.interval, self.rows, tangent=True).integrate(False)
            N, change = (mi.Spectrum(*rows) for rows in (light.N[: self.rows], light.N[self.rows :]))
            change -= N * jvp_optical_depth(self.media, entry.front, entry.on)
            return total + dr.select(entry.on, entry.gain * change, 0)

        return self._visit(add, mi.Spectrum(0))

    def _visit(self, add: Callable, state: object) -> object:
        """Visit each entry of the flight into emitting Gaussians."""

        def visit(state: object, interval: MediumInterval) -> object:
            if not interval.body.view.shows_gaussians:
                return state
            begin, _ = interval.inside()
            interval = replace(interval, active=interval.active & (begin < self.reached))
            front = RaySegment.upto(self.segment.ray, self.segment.medium, dr.select(interval.active, begin, 0))
            gain = self.segment.beta * self.channel_weight(front, interval.active)
            return add(state, _Entry(interval, front, gain))

        return revisit_media(self.media, self.whole, visit, state, self.active)
