r"""Light that reaches a point of a medium from the lamps, through volumetric shadows, and turns towards the camera.

.. math:: L_s(x, \omega) = \int_{4\pi} f(x, \omega, \omega_i)\, L_e(x, \omega_i)\, e^{-\tau(x, \omega_i)}\,d\omega_i

A lamp is drawn before the distance, so that the distance may be drawn for it; its direction is Mitsuba's. Where a lamp can be
met by chance, a second direction is drawn from the phase function, and the power heuristic weighs both (Veach 1997, Eq. 9.13);
light that is the same from everywhere needs the second one only. A lamp that lets light pass (a pane) is no end of a ray: it is
aimed at only.

Conventions. An arrival is one shadow ray: the light that it brings is already dimmed by the exact optical depth along it and
turned by the phase function. Surfaces cast shadows; what they reflect is one more scattering and not seen.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.phase.turn import INV_FOUR_PI
from mivol.transport.dice import start_dice
from mivol.transport.film import Strata
from mivol.transport.free_flight import Focus, Lamp
from mivol.transport.lamp_motion import shadow_of_moving
from mivol.transport.path import Way, follow_lamp, light_through, power_heuristic, shadow_ray
from mivol.transport.world import World

__all__ = ["Arrival", "Draw", "Lights", "arrivals", "focus_on"]

UNIFORM = "ConstantBackgroundEmitter"


@dataclass
class Draw:
    """The random numbers of one scattering event: which piece, where in it, which lamp, its direction, the phase function's,
    and which of the two is followed back."""

    piece: mi.Float
    inside: mi.Point2f
    lamp: mi.Float
    emitter: mi.Point2f
    lobe: mi.Float
    turn: mi.Point2f
    choice: mi.Float
    strata: Strata | None = None

    def part(self, number: mi.UInt32, count: int) -> Draw:
        """The numbers of one of ``count`` events: those of the first, moved on, each in its part of the strata."""
        if count == 1:
            return self.aim(self.emitter, self.turn)
        # Multiples of the generalised golden ratios fill one and two dimensions evenly (Roberts 2018).
        k, across = mi.Float(number), max(a for a in range(1, int(count**0.5) + 1) if count % a == 0)
        part = Strata(number, across, count // across)

        def one(u: mi.Float) -> mi.Float:
            return _wrap(dr.fma(k, 0.6180339887, u))

        def two(u: mi.Point2f) -> mi.Point2f:
            return mi.Point2f(_wrap(dr.fma(k, 0.7548776662, u.x)), _wrap(dr.fma(k, 0.5698402910, u.y)))

        moved = Draw(
            self.piece, two(self.inside), self.lamp, self.emitter, one(self.lobe), self.turn, one(self.choice), self.strata
        )
        return moved.aim(part.jitter(two(self.emitter)), part.jitter(two(self.turn)))

    def aim(self, emitter: mi.Point2f, turn: mi.Point2f) -> Draw:
        """The same with other numbers for directions, in their strata."""
        if self.strata is not None:
            emitter, turn = self.strata.jitter(emitter), self.strata.jitter(turn)
        return replace(self, emitter=emitter, turn=turn, strata=None)


def _wrap(x: mi.Float) -> mi.Float:
    return x - dr.floor(x)


class Lights:
    """The emitters of a scene, and how their light is to be found.

    Args:
        scene: Mitsuba's scene.

    Attributes:
        drawn: emitters that directions are drawn towards, all alike: all but a constant background.
        panes: emitters on surfaces that let light pass undeviated.
        has_lobes: directions are drawn from the phase function too, since some emitter can be met by chance.
    """

    def __init__(self, scene: mi.Scene) -> None:
        emitters = scene.emitters()
        delta = int(mi.EmitterFlags.Delta)
        self.drawn = [e for e in emitters if e.class_name() != UNIFORM]
        self.panes = [e for e in self.drawn if _is_pane(e)]
        met = [e for e in emitters if not any(e is pane for pane in self.panes)]
        self.has_lobes = any(not int(e.flags()) & delta for e in met)
        balls = [_ball(e) for e in self.drawn]
        self.is_near = any(b is not None for b in balls)
        self._balls = [None if b is None else [dr.opaque(mi.Float, v) for v in b] for b in balls]

    def ball(self, number: int) -> list[mi.Float] | None:
        """Centre and radius of a lamp that directions are drawn towards; None for one at infinity."""
        return self._balls[number]

    def draw(self, sampler: mi.Sampler, active: mi.Bool, strata: Strata | None = None) -> Draw:
        """Draw the numbers of one event, and note the strata of a pass, where it has some, for directions."""
        return Draw(
            sampler.next_1d(active),
            sampler.next_2d(active),
            sampler.next_1d(active),
            sampler.next_2d(active),
            sampler.next_1d(active),
            sampler.next_2d(active),
            sampler.next_1d(active),
            strata,
        )

    def choose(self, ray: mi.Ray3f, u: mi.Float) -> Lamp:
        """Draw a lamp, each with the same probability."""
        n, width = len(self.drawn), dr.width(ray)
        index = dr.minimum(mi.UInt32(u * n), max(n - 1, 0))
        emitter = dr.zeros(mi.EmitterPtr, width)
        centre, radius2, finite = mi.Point3f(0), mi.Float(0), mi.Bool(False)
        for k, (candidate, ball) in enumerate(zip(self.drawn, self._balls, strict=True)):
            here = index == k
            emitter = dr.select(here, mi.EmitterPtr(candidate), emitter)
            if ball is not None:
                x, y, z, r = ball
                centre = dr.select(here, mi.Point3f(x, y, z), centre)
                radius2, finite = dr.select(here, dr.square(r), radius2), here | finite
        return Lamp(index, emitter, _focus(ray, centre, radius2, finite) if self.is_near else None)


def _is_pane(emitter: mi.Emitter) -> bool:
    shape = emitter.get_shape()
    return shape is not None and mi.has_flag(shape.bsdf().flags(), mi.BSDFFlags.Null)


def _ball(emitter: mi.Emitter) -> list[float] | None:
    """Centre and radius of an emitter; None for one at infinity."""
    box = emitter.get_shape().bbox() if emitter.get_shape() is not None else emitter.bbox()
    low, high = np.array(box.min, dtype=np.float64), np.array(box.max, dtype=np.float64)
    if emitter.is_environment() or not np.isfinite([low, high]).all() or (high < low).any():
        return None
    return [*((low + high) / 2), float(np.linalg.norm(high - low) / math.sqrt(12))]


def focus_on(ray: mi.Ray3f, ball: list[mi.Float] | None) -> Focus | None:
    """One lamp as seen from rays; None where it is at infinity."""
    if ball is None:
        return None
    x, y, z, r = ball
    return _focus(ray, mi.Point3f(x, y, z), dr.square(r), mi.Bool(True))


def _focus(ray: mi.Ray3f, centre: mi.Point3f, radius2: mi.Float, finite: mi.Bool) -> Focus:
    away = centre - ray.o
    t0 = dr.dot(away, ray.d)
    h2 = dr.squared_norm(away - t0 * ray.d)
    # A ray through a point light sees it at distance 0; 1e-4 of the way there keeps the angle in float32. It is a density.
    rho = dr.sqrt(h2 + radius2 + 1e-8 * dr.squared_norm(away) + 1e-30)
    return Focus(t0, dr.select(finite, rho, 1), finite)


@dataclass
class Arrival:
    """Light that one shadow ray brings: ``value`` is turned and dimmed, per steradian of nothing: it is radiance."""

    way: Way
    value: mi.Spectrum
    on: mi.Bool


def arrivals(
    scene: mi.Scene,
    world: World,
    mei: mi.MediumInteraction3f,
    lamp: Lamp,
    draw: Draw,
    attached: bool,
    active: mi.Bool,
    estimates: bool = False,
) -> list[Arrival]:
    """Estimate the light that arrives at a point and turns into ``mei.wi``.

    Args:
        scene, world: surfaces and media.
        mei: the point; ``medium`` is what surrounds it.
        lamp: drawn for each lane.
        draw: random numbers.
        attached: keep the derivatives of phase function and emitters.
        active: lanes to light.
        estimates: shadows may be estimated, in grids whose blocks are known; otherwise they are exact.

    Returns:
        One or two shadow rays, whose values add up to L_s.

    Bias: none. Variance: that of one direction towards a lamp and one of the phase function.
    """
    found = []
    # Where shadows are estimated no ray is followed back: the number that would choose one is free.
    one, two = (start_dice(draw.choice, dr.width(active), k) if estimates else None for k in range(2))
    if world.lights.drawn:
        found.append(_from_lamp(scene, world, mei, lamp, draw, attached, active, one))
    if world.lights.has_lobes:
        found.append(_from_lobe(scene, world, mei, draw, attached, active, two))
    return found


def _from_lamp(
    scene: mi.Scene,
    world: World,
    mei: mi.MediumInteraction3f,
    lamp: Lamp,
    draw: Draw,
    attached: bool,
    active: mi.Bool,
    dice: mi.UInt32 | None,
) -> Arrival:
    """A direction towards the lamp."""
    lights, phase = world.lights, mei.medium.phase_function()
    direct, weight = lamp.emitter.sample_direction(mei, draw.emitter, active)
    on = active & (direct.pdf > 0)
    way, clear, tau, light = shadow_ray(scene, world, mi.Point3f(mei.p), mei.medium, direct, on, dice)
    w_mis = mi.Float(1)
    if lights.has_lobes:
        pdf_lobe = _lobe_pdf(world, phase, mei, direct.d, on)
        pdf = direct.pdf / len(lights.drawn)
        w_mis = dr.select(direct.delta | _is_among(lights.panes, lamp.emitter), 1, power_heuristic(pdf, pdf_lobe))
    dim = light * (w_mis * len(lights.drawn))
    with dr.resume_grad(when=attached):
        moved = follow_lamp(lamp.emitter, mei, draw.emitter, direct, on) if attached else direct
        f, _ = phase.eval_pdf(_context(), mei, moved.d, on)
        source = lamp.emitter.eval_direction(mei, moved, on) / direct.pdf if attached else weight
        if attached:
            source = source * shadow_of_moving(scene, world, way, tau, moved.p, on & clear)
        value = dr.select(on & clear, dim * f * source, 0)
    return Arrival(way, value, on & clear)


def _from_lobe(
    scene: mi.Scene,
    world: World,
    mei: mi.MediumInteraction3f,
    draw: Draw,
    attached: bool,
    active: mi.Bool,
    dice: mi.UInt32 | None,
) -> Arrival:
    """A direction of the phase function."""
    lights, phase = world.lights, mei.medium.phase_function()
    wo, weight, pdf = _sample_lobe(world, phase, mei, draw, active)
    on = active & (pdf > 0)
    ray = mi.Ray3f(mei.p, wo, dr.inf, mei.time, mei.wavelengths)
    end, _, light = light_through(scene, world, ray, mei.medium, on, dice)
    si = end.si
    emitter = si.emitter(scene, on)
    on &= (emitter != None) & ~_is_among(lights.panes, emitter)
    w_mis = mi.Float(1)
    if lights.drawn:
        direct = mi.DirectionSample3f(scene, si, mei)
        pdf_lamp = emitter.pdf_direction(mei, direct, on) / len(lights.drawn)
        w_mis = dr.select(_is_among(lights.drawn, emitter), power_heuristic(pdf, pdf_lamp), 1)
    dim = light * w_mis
    with dr.resume_grad(when=attached):
        if attached:
            f, _ = phase.eval_pdf(_context(), mei, wo, on)
            weight = f / pdf
        value = dr.select(on, dim * weight * emitter.eval(si, on), 0)
    return Arrival(Way(ray, mei.medium, end.t, True), value, on)


def _sample_lobe(
    world: World, phase: mi.PhaseFunctionPtr, mei: mi.MediumInteraction3f, draw: Draw, active: mi.Bool
) -> tuple[mi.Vector3f, mi.Spectrum, mi.Float]:
    """A direction, value over density, and density of a phase function; where it has flakes the direction is drawn evenly.

    Mitsuba 3.9.1 draws directions of flakes from another density than ``eval_pdf`` tells (6 % of a picture in a constant sky).
    """
    wo, weight, pdf = phase.sample(_context(), mei, draw.lobe, draw.turn, active)
    if world.has_flakes:
        even = _has_flakes(phase)
        wo = dr.select(even, mi.warp.square_to_uniform_sphere(draw.turn), wo)
        f, _ = phase.eval_pdf(_context(), mei, wo, active & even)
        weight, pdf = dr.select(even, f / INV_FOUR_PI, weight), dr.select(even, INV_FOUR_PI, pdf)
    return wo, weight, pdf


def _lobe_pdf(
    world: World, phase: mi.PhaseFunctionPtr, mei: mi.MediumInteraction3f, d: mi.Vector3f, active: mi.Bool
) -> mi.Float:
    """Density of :func:`_sample_lobe`."""
    _, pdf = phase.eval_pdf(_context(), mei, d, active)
    return dr.select(_has_flakes(phase), INV_FOUR_PI, pdf) if world.has_flakes else pdf


def _has_flakes(phase: mi.PhaseFunctionPtr) -> mi.Bool:
    return (phase.flags() & mi.UInt32(int(mi.PhaseFunctionFlags.Microflake))) != 0


def _is_among(emitters: list[mi.Emitter], emitter: mi.EmitterPtr) -> mi.Bool:
    found = mi.Bool(False)
    for candidate in emitters:
        found |= emitter == mi.EmitterPtr(candidate)
    return found


def _context() -> mi.PhaseFunctionContext:
    return mi.PhaseFunctionContext(None)
