r"""A second opinion on gradients: the derivative of a picture's mean by a path tracer that carries it forward.

Delta tracking with one majorant M for the whole box. A tentative collision is real with a probability P that need not be
sigma / M: the weight of the path takes up the quotient, sigma / (M P) where it is real and (1 - sigma / M) / (1 - P) where it
is not. P does not change with sigma, so the weight w is all that does, and its derivative along a direction of densities is
carried beside it by the product rule:

.. math:: (w g)' = w' g + w g', \qquad g' = \frac{\dot\sigma}{M P} \;\text{ or }\; -\frac{\dot\sigma}{M (1 - P)}

Emitters are looked at through as much of the box as lies between, by ratio tracking with the derivative carried likewise. There
is no step whose size matters, nothing is divided by sigma, so it may be 0, and nothing is walked back. All that it shares with
:mod:`mivol` is Mitsuba: shapes, emitters, BSDFs and phase functions.

The weight at the end of a path has the mean 1 whatever sigma is, so its derivative has the mean 0. So has w g', whatever is
known of the path so far: it is summed over the flights after each number of scatterings, times what albedo and BSDFs have left.
Multiples of these sums are subtracted, those that leave the least variance in paths of their own (a regression).

References: Woodcock et al. 1965, Novak et al. 2014 (tracking with weights); Veach 1997 (multiple importance sampling).
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.bench.studies.gradients.density_gradient import Light

__all__ = ["Twin"]

ABOVE, LEAST, MOST = 1.1, 0.25, 0.95
"""The majorant over the largest extinction; bounds of P."""

SELDOM = 0.2
"""Collisions [1/length] that happen where nothing is: each more of them would let weights grow. (Glass whose box has an empty
half, unlimited depth: light that is caught by reflection flies through emptiness for as long as it runs along it, and weights
grow with all of that way. Most estimates differ by 1 %, by 4 % at 0.4, and a few are far off whatever the number.)"""

FAINTEST = 0.5
"""Largest extinction for which the majorant is chosen, at least [1/length]: where nothing is, P needs collisions to happen."""

AHEAD = 12
"""Numbers of scatterings whose flights have sums of their own; the last is of all later ones."""

SURE = 4
"""Scatterings that every path survives; after these absorption ends paths of unlimited depth."""


@dataclass
class _Path:
    """The state of paths.

    Attributes:
        rng, ray, on: random numbers, the ray ahead, lanes that go on.
        w, dw: the weight and its derivative.
        a: what albedo and BSDFs leave.
        light, derivative: found so far.
        depth: number of scatterings.
        pdf, delta, last: of the direction, and where it was sampled.
        idle: sums of a w g' after each number of scatterings.
    """

    rng: mi.PCG32
    ray: mi.Ray3f
    w: mi.Float
    dw: mi.Float
    a: mi.Float
    light: mi.Float
    derivative: mi.Float
    depth: mi.UInt32
    pdf: mi.Float
    delta: mi.Bool
    last: mi.Interaction3f
    idle: list[mi.Float]
    on: mi.Bool

    @classmethod
    def start(cls, ray: mi.Ray3f, rng: mi.PCG32) -> _Path:
        """Paths as they leave the camera."""
        n = dr.width(ray)
        zero, one, on = dr.zeros(mi.Float, n), dr.full(mi.Float, 1, n), dr.full(mi.Bool, True, n)
        last = dr.zeros(mi.Interaction3f, n)
        idle = [mi.Float(zero) for _ in range(AHEAD)]
        return cls(rng, mi.Ray3f(ray), one, zero, one, zero, zero, dr.zeros(mi.UInt32, n), one, on, last, idle, mi.Bool(on))


class Twin:
    """The derivative of a picture's mean along a direction in the space of voxels.

    Args:
        values: (Z, Y, X) extinction of the box [-1, 1]^3 [1/length].
        direction: (Z, Y, X) in which it changes.
        side: of the picture [pixels].
        light: what lights the box, how often light scatters; emitters are sampled at collisions.
    """

    def __init__(self, values: np.ndarray, direction: np.ndarray, side: int, light: Light) -> None:
        self.scene = light.scene(np.float32(values), side)
        self.light = light
        self.scatterings = 2**31 if light.depth < 0 else light.depth - 1
        self.majorant = ABOVE * max(float(values.max()), FAINTEST)
        self.least = min(LEAST, SELDOM / self.majorant)
        both = np.stack([values, direction], axis=-1).astype(np.float32)
        self.field = mi.Texture3f(mi.TensorXf(both), wrap_mode=dr.WrapMode.Clamp)
        self.levels: np.ndarray | None = None

    def derivative(self, seed: int, spp: int) -> float:
        """An unbiased estimate from this many samples a pixel."""
        if self.levels is None:
            self.levels = self._choose_levels(seed + 50_000, spp)
        _, found, idle = self.paths(seed, spp)
        return float(found.mean() - self.levels @ idle.mean(axis=1))

    def paths(self, seed: int, spp: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The light of each path (N,), its derivative (N,), and what has the mean 0 (1 + AHEAD, N)."""
        sensor = self.scene.sensors()[0]
        width, height = sensor.film().size()
        # Streams of PCG32 that are numbered in a row resemble each other: a hash of the number is their state.
        state = mi.sample_tea_32(dr.opaque(mi.UInt32, seed), dr.arange(mi.UInt32, int(width) * int(height) * spp))
        rng = mi.PCG32(initstate=mi.UInt64(state[0]), initseq=mi.UInt64(state[1]))
        ray, _ = sensor.sample_ray(0, 0, mi.Point2f(rng.next_float32(), rng.next_float32()), mi.Point2f(0.5))
        path = _Path.start(ray, rng)
        (path,) = dr.while_loop((path,), cond=lambda p: p.on, body=lambda p: (self._step(p),), label="twin")
        light, derivative, *idle = (np.array(x, np.float64) for x in (path.light, path.derivative, path.dw, *path.idle))
        return light, derivative, np.stack(idle)

    def _choose_levels(self, seed: int, spp: int) -> np.ndarray:
        """The multiples of what has the mean 0 that leave the least noise, from paths of their own."""
        _, found, idle = self.paths(seed, spp)
        found, idle = found - found.mean(), idle - idle.mean(axis=1, keepdims=True)
        return np.linalg.lstsq(idle @ idle.T, idle @ found, rcond=1e-10)[0]

    def _step(self, p: _Path) -> _Path:
        """To the next collision or surface, and over it."""
        si = self.scene.ray_intersect(p.ray, p.on)
        p, t, hit = self._fly(p, si.t)
        p = self._add_emission(p, si, p.on & ~hit)
        may = p.on & (p.depth < self.scatterings)
        collides, meets = hit & may, p.on & ~hit & si.is_valid()
        mei = dr.zeros(mi.MediumInteraction3f, dr.width(p.ray))
        mei.p, mei.wi, mei.sh_frame, mei.t = p.ray.o + t * p.ray.d, -p.ray.d, mi.Frame3f(-p.ray.d), t
        if self.light.samples_emitters:
            p = self._add_drawn(p, mei, collides)
        p, turned, lives = self._scatter(p, mei, collides)
        p, passed = self._cross(p, si, meets, may)
        p.ray.maxt = dr.largest(mi.Float)
        p.on = p.on & ((turned & lives) | passed)
        return p

    def _at(self, x: mi.Point3f) -> tuple[mi.Float, mi.Float]:
        """Extinction and its derivative."""
        sigma, rate = self.field.eval(0.5 * x + 0.5)
        return sigma, rate

    def _fly(self, p: _Path, end: mi.Float) -> tuple[_Path, mi.Float, mi.Bool]:
        """Fly to the first real collision before ``end``; its distance, and the lanes that have one."""
        ray, most = p.ray, self.majorant
        inside = p.on & (dr.max(dr.abs(ray.o + 1e-3 * ray.d)) < 1)

        def body(rng: mi.PCG32, t: mi.Float, w: mi.Float, dw: mi.Float, idle: mi.Float, hit: mi.Bool, go: mi.Bool) -> tuple:
            t = t - dr.log(1 - rng.next_float32()) / most
            go = go & (t < end)
            sigma, rate = self._at(ray.o + t * ray.d)
            chance = dr.clip(sigma / most, self.least, MOST)
            real = go & (rng.next_float32() < chance)
            g = dr.select(real, sigma / most / chance, (1 - sigma / most) / (1 - chance))
            dg = dr.select(real, rate / most / chance, -rate / most / (1 - chance))
            dw, idle = dr.select(go, dw * g + w * dg, dw), idle + dr.select(go, w * dg, 0)
            return rng, t, dr.select(go, w * g, w), dw, idle, hit | real, go & ~real

        zero = dr.zeros(mi.Float, dr.width(ray))
        state = (p.rng, zero, p.w, p.dw, mi.Float(zero), inside & False, inside)
        p.rng, t, p.w, p.dw, idle, hit, _ = dr.while_loop(state, lambda *s: s[-1], body, label="flight")
        here = dr.minimum(p.depth, AHEAD - 1)
        p.idle = [found + dr.select(here == k, p.a * idle, 0) for k, found in enumerate(p.idle)]
        return p, t, hit

    def _add_emission(self, p: _Path, si: mi.SurfaceInteraction3f, shown: mi.Bool) -> _Path:
        """The light that a path finds by chance."""
        if self.light.hidden:
            shown = shown & (p.depth > 0)
        emitter, mis = si.emitter(self.scene, shown), mi.Float(1)
        if self.light.samples_emitters:
            direct = mi.DirectionSample3f(self.scene, si, p.last)
            other = self.scene.pdf_emitter_direction(p.last, direct, shown & ~p.delta & (emitter != None))
            mis = dr.select(p.delta, 1, _heuristic(p.pdf, other))
        le = dr.select(shown, dr.mean(emitter.eval(si, shown)) * mis * p.a, 0)
        p.light, p.derivative = p.light + le * p.w, p.derivative + le * p.dw
        return p

    def _add_drawn(self, p: _Path, mei: mi.MediumInteraction3f, on: mi.Bool) -> _Path:
        """The light of an emitter sample, through the box."""
        u = mi.Point2f(p.rng.next_float32(), p.rng.next_float32())
        ds, weight = self.scene.sample_emitter_direction(mei, u, False, on)
        on = on & (ds.pdf > 0)
        value, pdf = self._phase().eval_pdf(mi.PhaseFunctionContext(None), mei, ds.d, on)
        mis = dr.select(ds.delta, 1, _heuristic(ds.pdf, pdf))
        le = dr.select(on, dr.mean(weight * value) * mis * p.a * self.light.albedo, 0)
        p.rng, T, dT = self._look(p.rng, mei.p, ds, on)
        p.light += le * p.w * T
        p.derivative += le * (p.dw * T + p.w * dT)
        return p

    def _look(self, rng: mi.PCG32, x: mi.Point3f, ds: mi.DirectionSample3f, on: mi.Bool) -> tuple:
        """The transmittance of the box from x towards an emitter, and its derivative, by ratio tracking."""
        d, most = ds.d, self.majorant
        leaves = dr.min((dr.select(d > 0, 1.0, -1.0) - x) / dr.select(d == 0, 1e-20, d))
        end = dr.minimum(leaves, ds.dist)

        def body(rng: mi.PCG32, t: mi.Float, T: mi.Float, slope: mi.Float, go: mi.Bool) -> tuple:
            t = t - dr.log(1 - rng.next_float32()) / most
            go = go & (t < end)
            sigma, rate = self._at(x + t * d)
            slope = dr.select(go, slope - rate / (most - sigma), slope)
            return rng, t, dr.select(go, T * (1 - sigma / most), T), slope, go

        zero = dr.zeros(mi.Float, dr.width(x))
        rng, _, T, slope, _ = dr.while_loop((rng, zero, zero + 1, zero, mi.Bool(on)), lambda *s: s[-1], body, label="look")
        return rng, T, T * slope

    def _phase(self) -> mi.PhaseFunction:
        """The phase function of the box."""
        return next(s.interior_medium() for s in self.scene.shapes() if s.is_medium_transition()).phase_function()

    def _scatter(self, p: _Path, mei: mi.MediumInteraction3f, on: mi.Bool) -> tuple[_Path, mi.Bool, mi.Bool]:
        """A new direction at a collision; lanes that have one, and those that were not absorbed."""
        u = mi.Point2f(p.rng.next_float32(), p.rng.next_float32())
        wo, _, pdf = self._phase().sample(mi.PhaseFunctionContext(None), mei, p.rng.next_float32(), u, on)
        sure = p.depth < SURE if self.light.depth < 0 else mi.Bool(True)
        lives = sure | (p.rng.next_float32() < self.light.albedo)
        p.a = dr.select(on & sure, p.a * self.light.albedo, p.a)
        p.depth = dr.select(on, p.depth + 1, p.depth)
        p.pdf, p.delta = dr.select(on, pdf, p.pdf), p.delta & ~on
        p.last = dr.select(on, mi.Interaction3f(mei), p.last)
        p.ray.o, p.ray.d = dr.select(on, mei.p, p.ray.o), dr.select(on, wo, p.ray.d)
        return p, on, lives

    def _cross(self, p: _Path, si: mi.SurfaceInteraction3f, on: mi.Bool, may: mi.Bool) -> tuple[_Path, mi.Bool]:
        """Over a surface; lanes that go on. One that is ``null`` does not count as a scattering."""
        u = mi.Point2f(p.rng.next_float32(), p.rng.next_float32())
        bs, weight = si.bsdf().sample(mi.BSDFContext(), si, p.rng.next_float32(), u, on)
        null = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Null)
        on = on & (null | may)
        turns, ahead = on & ~null, si.spawn_ray(si.to_world(bs.wo))
        p.a = dr.select(on, p.a * dr.mean(weight), p.a)
        p.depth = dr.select(turns, p.depth + 1, p.depth)
        p.pdf, p.delta = dr.select(turns, bs.pdf, p.pdf), p.delta | (turns & mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta))
        p.last = dr.select(turns, mi.Interaction3f(si), p.last)
        p.ray.o, p.ray.d = dr.select(on, ahead.o, p.ray.o), dr.select(on, ahead.d, p.ray.d)
        return p, on & (p.a > 0)


def _heuristic(a: mi.Float, b: mi.Float) -> mi.Float:
    """The power heuristic."""
    total = dr.square(a) + dr.square(b)
    return dr.select(total > 0, dr.square(a) / dr.select(total > 0, total, 1), 0)
