r"""Emission and absorption along rays through a field that is known only at points, and the adjoint.

.. math:: L = \sum_i T_i (1 - e^{-\sigma_i \delta_i})\, c_i, \qquad T_i = e^{-\tau_i}, \quad
          \tau_i = \sum_{j < i} \sigma_j \delta_j

Samples. A ray crosses runs of occupied cells. A run is cut into equal strata of at most ``step``, and each stratum of length
delta_i has one sample, at random in a fit and in its middle for an image. The strata of a ray fill its runs, so a field of
constant density has Beer-Lambert's transmittance for any step. A first pass evaluates the density alone; samples behind a
transmittance of ``stop`` are dropped, and the networks see a packed array of the rest.

Adjoint. A sweep runs from the last sample of a ray to the first. Let r be the light from behind a sample times the derivative
of the loss by it, at the eye:

.. math:: \frac{\partial}{\partial c_i} = g\, T_i \alpha_i, \qquad
          \frac{\partial}{\partial \sigma_i} = \delta_i \big(\langle g, c_i\rangle\, T_{i+1} - r\big), \qquad
          r \leftarrow r + T_i \alpha_i \langle g, c_i\rangle

So r is a sum, tau is carried instead of T, and nothing is divided by a transmittance. The field then maps the derivatives of
the samples to those of its parameters. Memory: six numbers a sample, and what the field keeps.

Bias. Of the quadrature: an optical depth of a random sample is unbiased, and its exponential is not (by half the variance
of tau, Jensen's inequality). Light behind ``stop`` is left out.

References: Max 1995 (the quadrature); Mildenhall et al. 2020 (strata); Müller et al. 2022, Li et al. 2023 (occupied cells,
packed samples).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from mivol.fields.sampled_field import PointValues, SampledField
from mivol.numerics import one_minus_exp
from mivol.transport.line_integrals.hierarchical_samples import Strata, cut_into_strata, merge_rounds
from mivol.transport.line_integrals.radiance_field import RayBundle, RayGradient
from mivol.transport.traversal.lattice import clip_to_grid
from mivol.transport.traversal.occupancy import list_cells
from mivol.transport.traversal.occupied_cells import OccupiedCells
from mivol.transport.traversal.occupied_walk import OccupiedCell, walk_occupied_cells
from mivol.transport.traversal.random_numbers import draw_pcg32, seed_pcg32

__all__ = [
    "RaySamples",
    "SampledModel",
    "SampledRays",
    "draw_samples",
    "render_hierarchical",
    "render_samples",
    "vjp_samples",
]


@dataclass(frozen=True)
class SampledModel:
    """A field with what a ray needs to cross it.

    Attributes:
        field: known at points.
        cells: cells to sample; the field counts as 0 elsewhere.
        step: longest stratum [length].
        stop: transmittance at which a ray ends.
    """

    field: SampledField
    cells: OccupiedCells
    step: float
    stop: float = 1e-4

    @classmethod
    def from_field(cls, field: SampledField, stop: float = 1e-4) -> SampledModel:
        """The model of a field with a region."""
        return cls(field, list_cells(field.region), field.region.step, stop)


@dataclass
class RaySamples:
    """Samples of rays, packed ray by ray.

    Attributes:
        ray: index of each sample's ray.
        t: distance from the origin of the ray [length].
        dt: length of the stratum [length].
        first, count: of each ray, its first sample and the number of its samples.
    """

    ray: mi.UInt32
    t: mi.Float
    dt: mi.Float
    first: mi.UInt32
    count: mi.UInt32

    @property
    def size(self) -> int:
        """Number of all samples."""
        return dr.width(self.t)

    def points(self, rays: RayBundle) -> mi.Point3f:
        """Places of the samples."""
        o, d = dr.gather(mi.Point3f, rays.o, self.ray), self.directions(rays)
        return o + self.t * d

    def directions(self, rays: RayBundle) -> mi.Vector3f:
        """Directions of the samples' rays."""
        return dr.gather(mi.Vector3f, rays.d, self.ray)


def draw_samples(cells: OccupiedCells, rays: RayBundle, step: float, u: float | None) -> RaySamples | None:
    """Draw a sample of each stratum; None if no ray meets an occupied cell.

    Args:
        cells: occupied cells.
        rays: world rays, |d| = 1.
        step: longest stratum [length].
        u: uniform number in [0, 1), the seed of the places; None: the middles of the strata.

    Cost: two walks, the first to count the runs of each ray.
    """
    width = dr.width((rays.o, rays.d))
    segment = clip_to_grid(cells, rays.o, rays.d, mi.Float(0), rays.t_max)
    dr.eval(segment)

    def count_run(runs: mi.UInt32, cell: OccupiedCell, on: mi.Bool) -> mi.UInt32:
        return dr.select(on & (cell.entered < 0), runs + 1, runs)

    runs, _, _ = walk_occupied_cells(cells, segment, count_run, dr.zeros(mi.UInt32, width))
    dr.eval(runs)
    first_run = dr.prefix_sum(runs)
    run_count = int(dr.sum(runs)[0])
    if run_count == 0:
        return None
    begin, end, ray = dr.empty(mi.Float, run_count), dr.empty(mi.Float, run_count), dr.empty(mi.UInt32, run_count)
    lane = dr.arange(mi.UInt32, width)

    def write_run(following: mi.UInt32, cell: OccupiedCell, on: mi.Bool) -> mi.UInt32:
        starts = on & (cell.entered < 0)
        following = dr.select(starts, following + 1, following)
        dr.scatter(begin, cell.t, following - 1, starts)
        dr.scatter(ray, lane, following - 1, starts)
        dr.scatter(end, cell.t + cell.dt, following - 1, on)
        return following

    walk_occupied_cells(cells, segment, write_run, mi.UInt32(first_run))
    dr.eval(begin, end, ray)
    strata = mi.UInt32(dr.maximum(dr.ceil((end - begin) * dr.opaque(mi.Float, 1 / step)), 1))
    first = dr.prefix_sum(strata)
    size = int(dr.sum(strata)[0])
    marks = dr.zeros(mi.UInt32, size)
    dr.scatter(marks, mi.UInt32(1), first)
    run = dr.cumsum(marks) - 1
    sample = dr.arange(mi.UInt32, size)
    share = mi.Float(0.5) if u is None else draw_pcg32(seed_pcg32(dr.opaque(mi.Float, u), size), 1)[1][0]
    own = dr.gather(mi.UInt32, ray, run)
    a = dr.gather(mi.Float, begin, run)
    dt = (dr.gather(mi.Float, end, run) - a) / mi.Float(dr.gather(mi.UInt32, strata, run))
    t = dr.gather(mi.Float, segment.t0, own) + dr.fma(dt, mi.Float(sample - dr.gather(mi.UInt32, first, run)) + share, a)
    counts = dr.zeros(mi.UInt32, width)
    dr.scatter_add(counts, strata, ray)
    dr.eval(own, t, dt, counts)
    return RaySamples(own, t, dt, dr.prefix_sum(counts), counts)


@dataclass
class SampledRays:
    """The result of a render, and what the adjoint needs.

    Attributes:
        colour: radiance, without light from behind the field.
        T: transmittance of each ray.
        distance: expected depth times opacity [length].
        drawn: number of samples whose density was evaluated.
        samples: the samples that count; None without samples.
        values: the field at the samples; None without samples.
    """

    colour: mi.Color3f
    T: mi.Float
    distance: mi.Float
    drawn: int = 0
    samples: RaySamples | None = None
    values: PointValues | None = None


def render_samples(model: SampledModel, rays: RayBundle, u: float | None = None) -> SampledRays:
    """Integrate emission and absorption along rays.

    Args:
        model: field and cells.
        rays: world rays, |d| = 1; evaluated.
        u: uniform number in [0, 1), the seed of the samples; None: middles of strata.
    """
    if model.field.coarse is not None:
        return render_hierarchical(model, rays, u)[0]
    width = dr.width((rays.o, rays.d))
    samples = draw_samples(model.cells, rays, model.step, u)
    if samples is None:
        return SampledRays(dr.zeros(mi.Color3f, width), dr.full(mi.Float, 1, width), dr.zeros(mi.Float, width))
    drawn = samples.size
    rendered = _render_at(model.field, rays, _drop_hidden(model, rays, samples))
    rendered.drawn = drawn
    return rendered


def render_hierarchical(model: SampledModel, rays: RayBundle, u: float | None) -> tuple[SampledRays, SampledRays]:
    """Integrate along rays with samples in two rounds (:mod:`.hierarchical_samples`).

    Args:
        model: a field with a coarse one.
        rays: world rays, |d| = 1; evaluated.
        u: uniform number in [0, 1), the seed of the samples; None: even samples.

    Returns:
        The result of the field at the samples of both rounds, and of the coarse field at those of the first.
    """
    width, field, (first, second) = dr.width((rays.o, rays.d)), model.field, model.field.rounds
    strata = cut_into_strata(model.cells, rays, first, u)
    if strata is None:
        empty = SampledRays(dr.zeros(mi.Color3f, width), dr.full(mi.Float, 1, width), dr.zeros(mi.Float, width))
        return empty, empty
    dt = dr.gather(mi.Float, strata.dt, dr.arange(mi.UInt32, dr.width(strata.t)) // first)
    coarse = _render_at(field.coarse, rays, RaySamples(*_place(strata, first, strata.t, dt)))
    weights = _find_weights(coarse.samples, coarse.values.sigma)
    t, dt = merge_rounds(strata, weights, second, u)
    return _render_at(field, rays, RaySamples(*_place(strata, first + second, t, dt))), coarse


def _place(strata: Strata, number: int, t: mi.Float, dt: mi.Float) -> tuple:
    """Arguments of :class:`RaySamples`."""
    ray, start, counts = strata.packed(number)
    dr.eval(dt)
    return ray, t, dt, start, counts


def _render_at(field: SampledField, rays: RayBundle, samples: RaySamples) -> SampledRays:
    """Integrate a field at given samples."""
    p, d = samples.points(rays), samples.directions(rays)
    dr.eval(p, d)
    values = field.evaluate(p, d)
    colour, tau, distance = _composite(samples, values)
    rendered = SampledRays(colour, dr.exp(-tau), distance, samples.size, samples, values)
    dr.eval(rendered.colour, rendered.T, rendered.distance)
    return rendered


@dr.syntax
def _find_weights(samples: RaySamples, sigma: mi.Float) -> mi.Float:
    """Compositing weight of each sample."""
    weights = dr.zeros(mi.Float, samples.size)
    tau, k = dr.zeros(mi.Float, dr.width(samples.count)), mi.UInt32(0)
    while dr.hint(k < samples.count, exclude=[weights]):
        at = samples.first + k
        thickness = dr.gather(mi.Float, sigma, at) * dr.gather(mi.Float, samples.dt, at)
        dr.scatter(weights, dr.exp(-tau) * one_minus_exp(thickness), at)
        tau += thickness
        k += 1
    dr.eval(weights)
    return weights


def _drop_hidden(model: SampledModel, rays: RayBundle, samples: RaySamples) -> RaySamples:
    """The samples in front of the stop of their rays."""
    if model.stop <= 0:
        return samples
    p = samples.points(rays)
    dr.eval(p)
    kept = _count_visible(samples, model.field.density(p) * samples.dt, -math.log(model.stop))
    dr.eval(kept)
    place = dr.arange(mi.UInt32, samples.size) - dr.gather(mi.UInt32, samples.first, samples.ray)
    chosen = dr.compress(place < dr.gather(mi.UInt32, kept, samples.ray))
    ray, t, dt = (dr.gather(type(a), a, chosen) for a in (samples.ray, samples.t, samples.dt))
    dr.eval(ray, t, dt)
    return RaySamples(ray, t, dt, dr.prefix_sum(kept), kept)


@dr.syntax
def _count_visible(samples: RaySamples, thickness: mi.Float, depth: float) -> mi.UInt32:
    """The number of samples of each ray up to an optical depth, the sample that reaches it included."""
    dr.eval(thickness)
    limit = dr.opaque(mi.Float, depth)
    k, tau = dr.zeros(mi.UInt32, dr.width(samples.count)), mi.Float(0)
    while (k < samples.count) & (tau < limit):
        tau += dr.gather(mi.Float, thickness, samples.first + k)
        k += 1
    return k


@dr.syntax
def _composite(samples: RaySamples, values: PointValues) -> tuple[mi.Color3f, mi.Float, mi.Float]:
    """Colour, optical depth and expected distance times opacity of each ray."""
    dr.eval(values.sigma, values.colour)
    colour, tau, distance = dr.zeros(mi.Color3f, dr.width(samples.count)), mi.Float(0), mi.Float(0)
    k = mi.UInt32(0)
    while k < samples.count:
        at = samples.first + k
        thickness = dr.gather(mi.Float, values.sigma, at) * dr.gather(mi.Float, samples.dt, at)
        weight = dr.exp(-tau) * one_minus_exp(thickness)
        colour += weight * dr.gather(mi.Color3f, values.colour, at)
        distance += weight * dr.gather(mi.Float, samples.t, at)
        tau += thickness
        k += 1
    return colour, tau, distance


def vjp_samples(rendered: SampledRays, gradient: RayGradient) -> dict[str, mi.Float]:
    """Derivatives by the parameters of the field, by name; empty without samples.

    Args:
        rendered: from :func:`render_samples`.
        gradient: d loss / d colour, d loss / d T and d loss / d distance of each ray.
    """
    if rendered.samples is None:
        return {}
    dsigma, dcolour = _sweep_back(rendered, gradient)
    dr.eval(dsigma, dcolour)
    return rendered.values.vjp(dsigma, dcolour)


@dr.syntax
def _sweep_back(rendered: SampledRays, gradient: RayGradient) -> tuple[mi.Float, mi.Color3f]:
    """Derivatives by extinction and colour of each sample."""
    samples, values, g = rendered.samples, rendered.values, mi.Color3f(gradient.colour)
    by_distance, width = mi.Float(gradient.distance), dr.width(samples.count)
    dsigma, dcolour = dr.empty(mi.Float, samples.size), dr.empty(mi.Color3f, samples.size)
    tau = _sum_thickness(samples, values.sigma)
    # The light from behind all samples: what the caller puts there is in d loss / d T.
    behind = mi.Float(gradient.T) * dr.exp(-tau) + dr.zeros(mi.Float, width)
    k = mi.UInt32(samples.count)
    while dr.hint(k > 0, exclude=[dsigma, dcolour]):
        k -= 1
        at = samples.first + k
        dt = dr.gather(mi.Float, samples.dt, at)
        thickness = dr.gather(mi.Float, values.sigma, at) * dt
        after = dr.exp(-tau)
        tau = dr.maximum(tau - thickness, 0)
        weight = dr.exp(-tau) * one_minus_exp(thickness)
        light = dr.dot(g, dr.gather(mi.Color3f, values.colour, at)) + by_distance * dr.gather(mi.Float, samples.t, at)
        dr.scatter(dsigma, dt * (light * after - behind), at)
        dr.scatter(dcolour, weight * g, at)
        behind += weight * light
    return dsigma, dcolour


@dr.syntax
def _sum_thickness(samples: RaySamples, sigma: mi.Float) -> mi.Float:
    """Optical depth of each ray."""
    tau, k = dr.zeros(mi.Float, dr.width(samples.count)), mi.UInt32(0)
    while k < samples.count:
        at = samples.first + k
        tau += dr.gather(mi.Float, sigma, at) * dr.gather(mi.Float, samples.dt, at)
        k += 1
    dr.eval(tau)
    return tau
