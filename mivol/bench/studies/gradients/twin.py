r"""The twin of gradients: the derivative of the mean of an image in a light, by a path tracer that carries it forward.

Delta tracking with one majorant M for the whole box. A tentative collision is real with probability P, which may differ from
sigma / M. The weight of the path takes up the quotient: sigma / (M P) for a real collision and (1 - sigma / M) / (1 - P) for a
null collision. P does not change with sigma. So only the weight w changes, and the product rule carries its derivative along a
direction of densities:

.. math:: (w g)' = w' g + w g', \qquad g' = \frac{\dot\sigma}{M P} \;\text{ or }\; -\frac{\dot\sigma}{M (1 - P)}

Ratio tracking gives the transmittance of the box towards emitters, with its derivative in the same way. The method has no step
size, never divides by sigma (which may be 0), and walks no path twice. It shares only Mitsuba's shapes, emitters, BSDFs and
phase functions with :mod:`mivol`.

Control variates. The weight at the end of a path has the mean 1 for every sigma, and the derivative has the mean 0. The terms
w g' have the mean 0 too, given the path before them. They are summed over the flights after each number of scatterings, times
the remaining albedo and BSDF values. A regression on separate paths finds the multiples of these sums whose subtraction leaves
the smallest variance.

References: Woodcock et al. 1965, Novak et al. 2014 (tracking with weights); Veach 1997 (multiple importance sampling).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.bench.scenes import ParameterGradient, box_scene, make_integrator

ALBEDO = 0.75
INTEGRATORS = ("mivol", "prbvolpath")


@dataclass(frozen=True)
class Light:
    """A light on a box, and the number of scatterings in the box.

    Attributes:
        parts: makes the parts of the scene.
        bar: smallest ratio of variance x time.
        depth: ``max_depth``; -1: unlimited.
        albedo: albedo of the medium.
        samples_emitters: the twin samples emitters at collisions; otherwise its paths find light by chance.
        hidden: ``hide_emitters``.
        traps_light: the boundary of the medium reflects all light of some directions, so this light stays inside.
        rounds: factor on the number of rounds, for variances as well known as in other lights.
    """

    parts: Callable[[], dict]
    bar: float = math.nan
    depth: int = 2
    albedo: float = ALBEDO
    samples_emitters: bool = False
    hidden: bool = False
    traps_light: bool = False
    rounds: int = 1

    def scene(self, values: np.ndarray, side: int) -> mi.Scene:
        """The box around an extinction (Z, Y, X), seen in an image with ``side`` x ``side`` pixels."""
        return mi.load_dict(box_scene(values, side, self.albedo, **self.parts()))

    def integrator(self, name: str) -> mi.Integrator:
        """An integrator with the depth of this light."""
        return make_integrator(name, self.depth, self.hidden)

    def gradients(self, values: np.ndarray, side: int) -> dict[str, ParameterGradient]:
        """The gradients of both integrators, with separate scenes."""
        return {name: ParameterGradient(self.scene(values, side), self.integrator(name)) for name in INTEGRATORS}


MAJORANT_FACTOR, P_MIN, P_MAX = 1.1, 0.25, 0.95
"""Majorant over the largest extinction; bounds of P."""

EMPTY_COLLISIONS = 0.2
"""Real collisions in empty regions [1/length]. More collisions let the weights grow. (A glass box with an empty half, unlimited
depth: trapped light flies along the empty region, and its weight grows with the distance. Most estimates then differ by 1 %, by
4 % at 0.4, and a few are far off for every value.)"""

MIN_EXTINCTION = 0.5
"""Smallest value of the largest extinction, for the majorant [1/length]: derivatives in an empty box need collisions."""

CONTROLS = 12
"""Number of sums of control variates, by number of scatterings; the last sum takes all later flights."""

SURE_SCATTERINGS = 4
"""Scatterings that every path survives; later, absorption ends paths of unlimited depth."""


@dataclass
class _Path:
    """State of paths.

    Attributes:
        rng, ray, on: random numbers, the next ray, active lanes.
        w, dw: weight and the derivative.
        a: product of albedos and BSDF values.
        light, derivative: radiance so far, derivative.
        depth: number of scatterings.
        pdf, delta, last: density of the direction, whether this is a delta direction, origin of the sampled direction.
        controls: sums of a w g' after each number of scatterings; their mean is 0.
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
    controls: list[mi.Float]
    on: mi.Bool

    @classmethod
    def start(cls, ray: mi.Ray3f, rng: mi.PCG32) -> _Path:
        """Paths at the camera."""
        n = dr.width(ray)
        zero, one, on = dr.zeros(mi.Float, n), dr.full(mi.Float, 1, n), dr.full(mi.Bool, True, n)
        last = dr.zeros(mi.Interaction3f, n)
        controls = [mi.Float(zero) for _ in range(CONTROLS)]
        return cls(rng, mi.Ray3f(ray), one, zero, one, zero, zero, dr.zeros(mi.UInt32, n), one, on, last, controls, mi.Bool(on))


class Twin:
    """Derivative of the mean of an image along a direction in the space of voxels.

    Args:
        values: extinction (Z, Y, X) of the box [-1, 1]^3 [1/length].
        direction: direction of change (Z, Y, X).
        side: edge of the image [pixels].
        light: light on the box, depth, and whether emitters are sampled at collisions.
    """

    def __init__(self, values: np.ndarray, direction: np.ndarray, side: int, light: Light) -> None:
        self.scene = light.scene(np.float32(values), side)
        self.light = light
        self.scatterings = 2**31 if light.depth < 0 else light.depth - 1
        self.majorant = MAJORANT_FACTOR * max(float(values.max()), MIN_EXTINCTION)
        self.p_min = min(P_MIN, EMPTY_COLLISIONS / self.majorant)
        both = np.stack([values, direction], axis=-1).astype(np.float32)
        self.field = mi.Texture3f(mi.TensorXf(both), wrap_mode=dr.WrapMode.Clamp)
        self.multiples: np.ndarray | None = None

    def derivative(self, seed: int, spp: int) -> float:
        """Unbiased estimate from ``spp`` samples per pixel."""
        if self.multiples is None:
            self.multiples = self._choose_multiples(seed + 50_000, spp)
        _, derivative, controls = self.paths(seed, spp)
        return float(derivative.mean() - self.multiples @ controls.mean(axis=1))

    def paths(self, seed: int, spp: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Radiance of each path (N,), its derivative (N,), and the control variates of mean 0 (1 + CONTROLS, N)."""
        sensor = self.scene.sensors()[0]
        width, height = sensor.film().size()
        # Consecutive streams of PCG32 are correlated, so a hash of the number is their state.
        state = mi.sample_tea_32(dr.opaque(mi.UInt32, seed), dr.arange(mi.UInt32, int(width) * int(height) * spp))
        rng = mi.PCG32(initstate=mi.UInt64(state[0]), initseq=mi.UInt64(state[1]))
        ray, _ = sensor.sample_ray(0, 0, mi.Point2f(rng.next_float32(), rng.next_float32()), mi.Point2f(0.5))
        path = _Path.start(ray, rng)
        (path,) = dr.while_loop((path,), cond=lambda p: p.on, body=lambda p: (self._step(p),), label="twin")
        light, derivative, *controls = (np.array(x, np.float64) for x in (path.light, path.derivative, path.dw, *path.controls))
        return light, derivative, np.stack(controls)

    def _choose_multiples(self, seed: int, spp: int) -> np.ndarray:
        """Multiples of the control variates that leave the smallest variance, from separate paths."""
        _, derivative, controls = self.paths(seed, spp)
        derivative, controls = derivative - derivative.mean(), controls - controls.mean(axis=1, keepdims=True)
        return np.linalg.lstsq(controls @ controls.T, controls @ derivative, rcond=1e-10)[0]

    def _step(self, p: _Path) -> _Path:
        """Follow paths to the next collision or surface, and past it."""
        si = self.scene.ray_intersect(p.ray, p.on)
        p, t, hit = self._fly(p, si.t)
        p = self._add_emission(p, si, p.on & ~hit)
        may = p.on & (p.depth < self.scatterings)
        collides, meets = hit & may, p.on & ~hit & si.is_valid()
        mei = dr.zeros(mi.MediumInteraction3f, dr.width(p.ray))
        mei.p, mei.wi, mei.sh_frame, mei.t = p.ray.o + t * p.ray.d, -p.ray.d, mi.Frame3f(-p.ray.d), t
        if self.light.samples_emitters:
            p = self._add_emitter_sample(p, mei, collides)
        p, turned, lives = self._scatter(p, mei, collides)
        p, passed = self._cross(p, si, meets, may)
        p.ray.maxt = dr.largest(mi.Float)
        p.on = p.on & ((turned & lives) | passed)
        return p

    def _at(self, x: mi.Point3f) -> tuple[mi.Float, mi.Float]:
        """Extinction at a point, and the derivative."""
        sigma, rate = self.field.eval(0.5 * x + 0.5)
        return sigma, rate

    def _fly(self, p: _Path, end: mi.Float) -> tuple[_Path, mi.Float, mi.Bool]:
        """Fly to the first real collision before ``end``; its distance, and the lanes with a collision."""
        ray, majorant = p.ray, self.majorant
        inside = p.on & (dr.max(dr.abs(ray.o + 1e-3 * ray.d)) < 1)

        def body(rng: mi.PCG32, t: mi.Float, w: mi.Float, dw: mi.Float, controls: mi.Float, hit: mi.Bool, go: mi.Bool) -> tuple:
            t = t - dr.log(1 - rng.next_float32()) / majorant
            go = go & (t < end)
            sigma, rate = self._at(ray.o + t * ray.d)
            chance = dr.clip(sigma / majorant, self.p_min, P_MAX)
            real = go & (rng.next_float32() < chance)
            g = dr.select(real, sigma / majorant / chance, (1 - sigma / majorant) / (1 - chance))
            dg = dr.select(real, rate / majorant / chance, -rate / majorant / (1 - chance))
            dw, controls = dr.select(go, dw * g + w * dg, dw), controls + dr.select(go, w * dg, 0)
            return rng, t, dr.select(go, w * g, w), dw, controls, hit | real, go & ~real

        zero = dr.zeros(mi.Float, dr.width(ray))
        state = (p.rng, zero, p.w, p.dw, mi.Float(zero), inside & False, inside)
        p.rng, t, p.w, p.dw, controls, hit, _ = dr.while_loop(state, lambda *s: s[-1], body, label="flight")
        number = dr.minimum(p.depth, CONTROLS - 1)
        p.controls = [total + dr.select(number == k, p.a * controls, 0) for k, total in enumerate(p.controls)]
        return p, t, hit

    def _add_emission(self, p: _Path, si: mi.SurfaceInteraction3f, shown: mi.Bool) -> _Path:
        """Add the light of an emitter that a path hits."""
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

    def _add_emitter_sample(self, p: _Path, mei: mi.MediumInteraction3f, on: mi.Bool) -> _Path:
        """Add the light of an emitter sample, through the box."""
        u = mi.Point2f(p.rng.next_float32(), p.rng.next_float32())
        ds, weight = self.scene.sample_emitter_direction(mei, u, False, on)
        on = on & (ds.pdf > 0)
        value, pdf = self._phase().eval_pdf(mi.PhaseFunctionContext(None), mei, ds.d, on)
        mis = dr.select(ds.delta, 1, _heuristic(ds.pdf, pdf))
        le = dr.select(on, dr.mean(weight * value) * mis * p.a * self.light.albedo, 0)
        p.rng, T, dT = self._transmittance(p.rng, mei.p, ds, on)
        p.light += le * p.w * T
        p.derivative += le * (p.dw * T + p.w * dT)
        return p

    def _transmittance(self, rng: mi.PCG32, x: mi.Point3f, ds: mi.DirectionSample3f, on: mi.Bool) -> tuple:
        """Transmittance of the box from x to an emitter, and the derivative, by ratio tracking."""
        d, majorant = ds.d, self.majorant
        leaves = dr.min((dr.select(d > 0, 1.0, -1.0) - x) / dr.select(d == 0, 1e-20, d))
        end = dr.minimum(leaves, ds.dist)

        def body(rng: mi.PCG32, t: mi.Float, T: mi.Float, slope: mi.Float, go: mi.Bool) -> tuple:
            t = t - dr.log(1 - rng.next_float32()) / majorant
            go = go & (t < end)
            sigma, rate = self._at(x + t * d)
            slope = dr.select(go, slope - rate / (majorant - sigma), slope)
            return rng, t, dr.select(go, T * (1 - sigma / majorant), T), slope, go

        zero = dr.zeros(mi.Float, dr.width(x))
        rng, _, T, slope, _ = dr.while_loop((rng, zero, zero + 1, zero, mi.Bool(on)), lambda *s: s[-1], body, label="look")
        return rng, T, T * slope

    def _phase(self) -> mi.PhaseFunction:
        """Phase function of the box."""
        return next(s.interior_medium() for s in self.scene.shapes() if s.is_medium_transition()).phase_function()

    def _scatter(self, p: _Path, mei: mi.MediumInteraction3f, on: mi.Bool) -> tuple[_Path, mi.Bool, mi.Bool]:
        """Sample a direction at a collision; the lanes with a direction, and the lanes without absorption."""
        u = mi.Point2f(p.rng.next_float32(), p.rng.next_float32())
        wo, _, pdf = self._phase().sample(mi.PhaseFunctionContext(None), mei, p.rng.next_float32(), u, on)
        sure = p.depth < SURE_SCATTERINGS if self.light.depth < 0 else mi.Bool(True)
        lives = sure | (p.rng.next_float32() < self.light.albedo)
        p.a = dr.select(on & sure, p.a * self.light.albedo, p.a)
        p.depth = dr.select(on, p.depth + 1, p.depth)
        p.pdf, p.delta = dr.select(on, pdf, p.pdf), p.delta & ~on
        p.last = dr.select(on, mi.Interaction3f(mei), p.last)
        p.ray.o, p.ray.d = dr.select(on, mei.p, p.ray.o), dr.select(on, wo, p.ray.d)
        return p, on, lives

    def _cross(self, p: _Path, si: mi.SurfaceInteraction3f, on: mi.Bool, may: mi.Bool) -> tuple[_Path, mi.Bool]:
        """Cross a surface; the lanes that continue. A ``null`` surface is no scattering."""
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
    """Weight of the power heuristic."""
    total = dr.square(a) + dr.square(b)
    return dr.select(total > 0, dr.square(a) / dr.select(total > 0, total, 1), 0)
