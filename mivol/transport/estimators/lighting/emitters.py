"""The emitters of a scene, and the random numbers and distances of samples towards an emitter.

An emitter is chosen by the light that it gives around a vertex or along a ray (:mod:`.emitter_grid`). The light of a constant
environment is found by sampled directions alone.

Equiangular sampling draws distances along a ray uniformly in the angle seen from an emitter.

References: Kulla & Fajardo 2012 (equiangular sampling); Talbot et al. 2005 (resampling).
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.kernel_recording import copy_aligned, is_recording
from mivol.transport.estimators.lighting.bright_map import BrightMap
from mivol.transport.estimators.lighting.emitter_grid import EmitterDistribution, tabulate_emitters
from mivol.transport.traversal.box import evaluated_numbers
from mivol.transport.traversal.random_numbers import SpreadSampler, draw_pcg32, draw_state, fork_state
from mivol.transport.traversal.rays import Ray

__all__ = [
    "UNIFORM_EMITTER",
    "ChosenEmitter",
    "EmitterDraw",
    "SceneEmitters",
    "find_bounding_ball",
    "find_even_share",
    "find_lit_box",
    "fractional_part",
    "is_among",
    "join_arrays",
    "EventSamples",
    "EquiangularSampler",
    "make_ball_sampler",
    "make_equiangular_sampler",
    "read_emitters",
]


UNIFORM_EMITTER = "ConstantBackgroundEmitter"
"""Mitsuba's class of a constant environment, whose light is found by phase samples alone."""
PARALLEL_AREA = "DirectionalArea"
"""Mitsuba's class of a surface that shines along its normal only. No path finds its light, and ``eval_direction`` raises."""

CANDIDATES = 4
"""Points drawn on a lamp with hidden sides for each emitter sample. Half of the points of a box face away from a point outside.
(Images of a box beside a ball of fog with 2 and 4 points, over 1 point: 0.92 and 0.75 of the variance, 1.04 times the time.)"""

MIN_HALF_EDGE = 1e-6
"""Smallest half edge of the box of a grid of emitters [length]: shapes may be flat."""


class SceneEmitters:
    """The emitters of a scene, and the samples by which their light is found.

    Args:
        scene: Mitsuba's scene.
        from_camera: media surround the camera, so rays scatter light from their origin on.
        distance: ``near`` for the emitters with a position alone, ``far`` for the emitters at infinity alone, ``any`` for all.
        numbers: of :func:`read_emitters`; by default read from the scene.
        lit_box: corners of :func:`find_lit_box`; by default found in the scene.
        resamples: whether samples of lamps with hidden sides are drawn from candidates.
        bright: table for samples of the environment map; by default Mitsuba's ``envmap`` draws them.

    Attributes:
        sampled: emitters that next-event estimation chooses from: all except a constant environment.
        transmissive: emitters on surfaces that transmit part of the light without deviation.
        samples_phase: phase functions are sampled too, since their directions can hit an emitter.
        is_near: some emitter has a finite distance.
        are_evaluated: ``eval_direction`` of all emitters of the scene is there.
    """

    def __init__(
        self,
        scene: mi.Scene,
        from_camera: bool = False,
        distance: str = "any",
        numbers: mi.Float | None = None,
        lit_box: np.ndarray | None = None,
        resamples: bool = True,
        bright: BrightMap | None = None,
    ) -> None:
        placed = list(zip(scene.emitters(), _find_balls(scene, numbers), strict=True))
        if distance != "any":
            placed = [(e, ball) for e, ball in placed if (ball is not None) == (distance == "near")]
        emitters, delta = [e for e, _ in placed], int(mi.EmitterFlags.Delta)
        self.sampled = [e for e in emitters if e.class_name() != UNIFORM_EMITTER]
        self.transmissive = [e for e in self.sampled if _is_transmissive(e)]
        opaque = [e for e in emitters if not any(e is emitter for emitter in self.transmissive)]
        self.samples_phase = any(not int(e.flags()) & delta for e in opaque)
        self._placed = placed
        self._balls = [ball for e, ball in placed if e.class_name() != UNIFORM_EMITTER]
        self.is_near = any(ball is not None for ball in self._balls)
        self._from_camera = from_camera
        self._map = next((e for e in self.sampled if e.is_environment()), None)
        self._bright = None if self._map is None else bright
        self._hiding = [e for e in self.sampled if resamples and _hides_sides(e)]
        # Dr.Jit records a call for every emitter of the scene, chosen or not.
        self.are_evaluated = all(e.class_name() != PARALLEL_AREA for e in scene.emitters())
        if self.sampled:
            self._table = _EmitterTable.of(scene, self.sampled, self._balls, numbers)
            several = sum(ball is not None for ball in self._balls) > 1
            box = self._table.find_varied_box(find_lit_box(scene) if lit_box is None else lit_box, several)
            self._grid = tabulate_emitters(self._table.pointers, *box, self._balls, self._table.weights)

    def number_of(self, emitter: mi.EmitterPtr) -> mi.UInt32:
        """The index of an emitter among those ``sampled``."""
        return self._table.number(emitter)

    def bounding_ball(self, number: int) -> list[mi.Float] | None:
        """Centre and radius of a ``sampled`` emitter [length]; None if the emitter is at infinity."""
        return self._balls[number]

    def find_ball(self, emitter: mi.Emitter) -> list[mi.Float] | None:
        """Centre and radius of an emitter [length]; None at infinity."""
        return next(ball for e, ball in self._placed if e is emitter or e.ptr == emitter.ptr)

    def draw_event_samples(self, sampler: mi.Sampler | SpreadSampler, active: mi.Bool) -> EventSamples:
        """Draw the random numbers of a scattering event."""
        return EventSamples(
            draw_state(sampler, active),
            sampler.next_2d(active),
            sampler.next_1d(active),
            sampler.next_2d(active),
            sampler.next_1d(active),
            sampler.next_2d(active),
            sampler.next_1d(active),
        )

    def choose_emitter(self, ray: Ray, u: mi.Float) -> ChosenEmitter:
        """Choose one of the ``sampled`` emitters for each lane, by its light along a ray and by ``u`` in [0, 1)."""
        if not self.sampled:
            return ChosenEmitter(mi.UInt32(0), dr.zeros(mi.EmitterPtr, dr.width(ray)), None, None)
        distribution = self._grid.along_ray(ray, self._from_camera)
        number, _ = distribution.sample(u)
        if len(self.sampled) == 1:
            equiangular = make_ball_sampler(ray, self._balls[0])
        elif not self.is_near:
            equiangular = None
        else:
            x, y, z, r, finite = self._table.ball(number)
            equiangular = make_equiangular_sampler(ray, mi.Point3f(x, y, z), dr.square(r), finite)
        return ChosenEmitter(number, self._table.pointer(number), equiangular, distribution)

    def choose_at_point(self, p: mi.Point3f, u: mi.Float) -> tuple[mi.UInt32, mi.Float]:
        """Choose one of the ``sampled`` emitters by its light at a point, by ``u`` in [0, 1).

        Returns:
            The number of the emitter, and a uniform random number for another choice.
        """
        return self._grid.at_point(p).sample(u)

    def probabilities_at_point(self, p: mi.Point3f, numbers: list[int]) -> list[mi.Float]:
        """Probabilities of emitters in :meth:`choose_at_point` [1], by their numbers."""
        distribution = self._grid.at_point(p)
        return [distribution.probability(mi.UInt32(number)) for number in numbers]

    def probability_at_point(self, p: mi.Point3f, number: mi.UInt32) -> mi.Float:
        """Probability of an emitter in :meth:`choose_at_point` [1], by its number."""
        return self._grid.at_point(p).probability(number)

    def ball(self, number: mi.UInt32) -> tuple[mi.Point3f, mi.Float]:
        """Centre and radius of a ``sampled`` emitter [length]; 0 for an emitter at infinity."""
        if len(self.sampled) == 1:
            x, y, z, r = self._balls[0] or [mi.Float(0)] * 4
        else:
            x, y, z, r, _ = self._table.ball(number)
        return mi.Point3f(x, y, z), r

    def sample_direction(self, it: mi.Interaction3f, u: mi.Point2f, active: mi.Bool) -> EmitterDraw:
        """Choose an emitter by its light at a point, and sample a direction towards it, by two numbers in [0, 1)."""
        distribution = self._grid.at_point(it.p)
        number, rest = distribution.sample(u.x)
        emitter, u = self._table.pointer(number), mi.Point2f(rest, u.y)
        return self.draw_direction(it, emitter, distribution.probability(number), u, active)

    def draw_direction(
        self, it: mi.Interaction3f, emitter: mi.EmitterPtr, probability: mi.Float, u: mi.Point2f, active: mi.Bool
    ) -> EmitterDraw:
        """Sample a direction towards a chosen emitter, by two numbers in [0, 1).

        On a lamp with hidden sides, one of several points is taken in proportion to its light (resampling: Talbot et al. 2005).

        Args:
            it: the point to be lit.
            emitter: the emitter.
            probability: probability of the emitter [1].
            u: random numbers.
            active: lanes to sample.
        """
        direct, weight = self._sample_emitter(it, emitter, u, active)
        scale = mi.Float(1)
        if self._hiding and self.are_evaluated:
            first, light = u, dr.max(weight)
            hides, total = active & is_among(self._hiding, emitter), mi.Float(light)
            state = dr.reinterpret_array(mi.UInt32, u.x) * mi.UInt32(0x9E3779B9) + dr.reinterpret_array(mi.UInt32, u.y)
            for k, chance in enumerate(draw_pcg32(state, CANDIDATES - 1)[1], 1):
                v = mi.Point2f(fractional_part(first.x + k / CANDIDATES), fractional_part(dr.fma(k, 0.6180339887, first.y)))
                other, other_weight = emitter.sample_direction(it, v, hides)
                other_light = dr.select(hides, dr.max(other_weight), 0)
                total = total + other_light
                keep = chance * total < other_light
                direct, weight = dr.select(keep, other, direct), dr.select(keep, other_weight, weight)
                u, light = dr.select(keep, v, u), dr.select(keep, other_light, light)
            scale = dr.select(hides, total / (CANDIDATES * dr.select(light > 0, light, 1)), 1)
        density = mi.Float(direct.pdf)
        direct.pdf = dr.select(scale > 0, density * probability / dr.select(scale > 0, scale, 1), 0)
        weight = weight * scale / dr.select(probability > 0, probability, 1)
        return EmitterDraw(direct, weight, emitter, u, density * probability)

    def _sample_emitter(
        self, it: mi.Interaction3f, emitter: mi.EmitterPtr, u: mi.Point2f, active: mi.Bool
    ) -> tuple[mi.DirectionSample3f, mi.Spectrum]:
        """Sample a direction towards an emitter: the sample, and the radiance over its density."""
        if self._bright is None:
            return emitter.sample_direction(it, u, active)
        if len(self.sampled) == 1:
            return self._bright.sample(it, emitter, u, active)
        is_map = active & (emitter == mi.EmitterPtr(self._map))
        direct, weight = emitter.sample_direction(it, u, active & ~is_map)
        of_map, map_weight = self._bright.sample(it, mi.EmitterPtr(self._map), u, is_map)
        return dr.select(is_map, of_map, direct), dr.select(is_map, map_weight, weight)

    def are_balanced(self, emitter: mi.EmitterPtr) -> mi.Bool | bool:
        """Lanes whose samples the balance heuristic weighs: samples of the bright part of a map. In a nearly even map the power
        heuristic has 1.1 times the variance.
        """
        return False if self._bright is None else emitter == mi.EmitterPtr(self._map)

    def pdf_direction(self, it: mi.Interaction3f, direct: mi.DirectionSample3f, active: mi.Bool) -> mi.Float:
        """Density of a direction in :meth:`sample_direction` [1/sr]; 0 towards an emitter that is not sampled."""
        if not self.sampled:
            return mi.Float(0)
        return self.weigh_density(self._grid.at_point(it.p), it, direct, active)

    def weigh_density(
        self, distribution: EmitterDistribution, it: mi.Interaction3f, direct: mi.DirectionSample3f, active: mi.Bool
    ) -> mi.Float:
        """Density of a direction towards an emitter [1/sr], times the probability of the emitter."""
        probability = distribution.probability(self._table.number(direct.emitter))
        active = active & (probability > 0)
        if self._bright is None:
            return direct.emitter.pdf_direction(it, direct, active) * probability
        is_map = active & (direct.emitter == mi.EmitterPtr(self._map))
        pdf = self._bright.pdf(direct.d, is_map)
        if len(self.sampled) > 1:
            pdf += direct.emitter.pdf_direction(it, direct, active & ~is_map)
        return pdf * probability


@dataclass
class _EmitterTable:
    """The sampled emitters by number, and their numbers.

    Attributes:
        emitters: the emitters.
        pointers: the emitters as an array.
        numbers: number of each emitter by its index in Dr.Jit's registry, and a number beyond all emitters for others.
        balls: centre and radius of each emitter, and whether its distance is finite, one array for each.
        weights: sampling weight of each emitter.
    """

    emitters: list[mi.Emitter]
    pointers: mi.EmitterPtr
    numbers: mi.UInt32
    balls: list[mi.Float]
    weights: mi.Float

    @classmethod
    def of(
        cls, scene: mi.Scene, emitters: list[mi.Emitter], balls: list[list[mi.Float] | None], read: mi.Float | None
    ) -> _EmitterTable:
        """Make the table.

        Args:
            scene: Mitsuba's scene.
            emitters: the emitters, in the order of the scene.
            balls: centre and radius of each; None for an emitter at infinity.
            read: numbers of :func:`read_emitters`; None to read them here.
        """
        count, everyone = len(emitters), scene.emitters()
        if count == 1:
            (only,) = emitters
            return cls(emitters, mi.EmitterPtr(only), mi.UInt32(0), [], mi.Float(1))
        chosen = {id(e) for e in emitters}
        left_out = [k for k, e in enumerate(everyone) if id(e) not in chosen]
        number = place = dr.arange(mi.UInt32, count)
        if len(left_out) == 1:
            place = dr.select(number < left_out[0], number, number + 1)
        elif left_out:
            place = join_arrays([dr.opaque(mi.UInt32, k) for k, e in enumerate(everyone) if id(e) in chosen])
        pointers = dr.gather(mi.EmitterPtr, scene.emitters_dr(), place)
        size = max(int(dr.reinterpret_array(mi.UInt32, mi.EmitterPtr(e))[0]) for e in everyone) + 1
        numbers = dr.full(mi.UInt32, count, size)
        dr.scatter(numbers, number, dr.reinterpret_array(mi.UInt32, pointers))
        far = [dr.opaque(mi.Float, 0)] * 4
        rows = zip(*(far if b is None else b for b in balls), strict=True)
        finite = [dr.opaque(mi.Float, float(b is not None)) for b in balls]
        columns = [join_arrays(list(row)) for row in (*rows, finite)]
        weights = pointers.sampling_weight() if read is None else dr.gather(mi.Float, read, place)
        dr.eval(pointers, numbers, columns, weights)
        return cls(emitters, pointers, numbers, columns, weights)

    def pointer(self, number: mi.UInt32) -> mi.EmitterPtr:
        """The emitter of a number."""
        if len(self.emitters) == 1:
            return mi.EmitterPtr(self.emitters[0])
        return dr.gather(mi.EmitterPtr, self.pointers, number)

    def number(self, emitter: mi.EmitterPtr) -> mi.UInt32:
        """The number of an emitter; a number beyond all emitters if it is not sampled."""
        if len(self.emitters) == 1:
            return dr.select(emitter == mi.EmitterPtr(self.emitters[0]), mi.UInt32(0), 1)
        index = dr.reinterpret_array(mi.UInt32, emitter)
        known = index < dr.width(self.numbers)
        return dr.select(known, dr.gather(mi.UInt32, self.numbers, index, known), len(self.emitters))

    def ball(self, number: mi.UInt32) -> tuple[mi.Float, mi.Float, mi.Float, mi.Float, mi.Bool]:
        """Centre and radius of an emitter [length], and whether its distance is finite."""
        x, y, z, r, finite = (dr.gather(mi.Float, column, number) for column in self.balls)
        return x, y, z, r, finite > 0

    def find_varied_box(self, lit: np.ndarray, several: bool) -> tuple[mi.Point3f, mi.Vector3f]:
        """Centre and half edges of the part of a box (2 corners, 3) in which the shares of emitters vary [length]: near them.

        Far away from all emitters with a position, shares are even. The part reaches beyond them by half of their largest
        distance along an axis. Without ``several`` such emitters, or if all lie far outside, it is the whole box.
        """
        numbers = evaluated_numbers(lit.ravel())
        low, high = mi.Point3f(*numbers[:3]), mi.Point3f(*numbers[3:])
        if several:
            *axes, r, finite = self.balls
            below = mi.Point3f(*(dr.min(dr.select(finite > 0, x - r, dr.inf)) for x in axes))
            above = mi.Point3f(*(dr.max(dr.select(finite > 0, x + r, -dr.inf)) for x in axes))
            reach = dr.max(above - below) / 2
            cut_low, cut_high = dr.maximum(low, below - reach), dr.minimum(high, above + reach)
            is_part = dr.all(cut_low < cut_high)
            low, high = dr.select(is_part, cut_low, low), dr.select(is_part, cut_high, high)
        return (low + high) / 2, dr.maximum(mi.Vector3f(high - low) / 2, MIN_HALF_EDGE)


def join_arrays(values: list[mi.Float] | list[mi.UInt32]) -> mi.Float | mi.UInt32:
    """Join arrays, sixteen at once: a kernel with hundreds of inputs would take a second to compile."""
    while len(values) > 1:
        values = [dr.concat(values[k : k + 16]) for k in range(0, len(values), 16)]
        dr.eval(values)
    return values[0]


def find_even_share(scene: mi.Scene, numbers: mi.Float | None) -> mi.Float:
    """The share of constant environments in the fluence of all emitters, times their sampling weights [1].

    Args:
        scene: a scene with several emitters, all at infinity.
        numbers: of :func:`read_emitters`, which begin with the weights; None to read them here.
    """
    emitters, pointers, box = scene.emitters(), scene.emitters_dr(), (mi.Point3f(0), mi.Vector3f(1))
    weights = pointers.sampling_weight() if numbers is None else numbers
    light = tabulate_emitters(pointers, *box, [None] * len(emitters), weights).everywhere
    even = [number for number, emitter in enumerate(emitters) if emitter.class_name() == UNIFORM_EMITTER]
    return sum((dr.gather(mi.Float, light, mi.UInt32(number)) for number in even), mi.Float(0))


def find_lit_box(scene: mi.Scene) -> np.ndarray:
    """Corners (2, 3) of the box around all boundaries of media; around the scene without boundaries; 0 without shapes."""
    shapes = scene.shapes()
    boxes = [s.bbox() for s in shapes if s.is_medium_transition()] or [s.bbox() for s in shapes]
    found = mi.ScalarBoundingBox3f()
    for box in boxes:
        found.expand(box)
    return np.array([found.min, found.max], np.float64) if found.valid() else np.zeros((2, 3))


def _hides_sides(emitter: mi.Emitter) -> bool:
    """Whether only a part of an emitter's surface faces a point: a mesh of several faces, or a cylinder."""
    shape = emitter.get_shape()
    return shape is not None and (shape.class_name() == "Cylinder" or (shape.is_mesh() and shape.primitive_count() > 2))


def _is_transmissive(emitter: mi.Emitter) -> bool:
    shape = emitter.get_shape()
    return shape is not None and mi.has_flag(shape.bsdf().flags(), mi.BSDFFlags.Null)


def find_bounding_ball(emitter: mi.Emitter) -> list[float] | None:
    """Centre of an emitter's bounding box, and root mean square distance of its points [length]; None for an emitter at
    infinity.
    """
    box = emitter.get_shape().bbox() if emitter.get_shape() is not None else emitter.bbox()
    low, high = np.array(box.min, dtype=np.float64), np.array(box.max, dtype=np.float64)
    if emitter.is_environment() or not np.isfinite([low, high]).all() or (high < low).any():
        return None
    return [*((low + high) / 2), float(np.linalg.norm(high - low) / math.sqrt(12))]


def read_emitters(scene: mi.Scene) -> mi.Float | None:
    """Sampling weights of the emitters, then centre and radius of each emitter with a position (:func:`find_bounding_ball`),
    flat, as an input of recordings. None without emitters.
    """
    emitters = scene.emitters()
    balls = [ball for e in emitters if (ball := find_bounding_ball(e)) is not None]
    numbers = [*(e.sampling_weight() for e in emitters), *itertools.chain(*balls)]
    return mi.Float(copy_aligned(np.array(numbers, np.float32))) if numbers else None


def _find_balls(scene: mi.Scene, numbers: mi.Float | None) -> list[list[mi.Float] | None]:
    """Centre and radius of each emitter of a scene, or None at infinity.

    Args:
        scene: Mitsuba's scene.
        numbers: of :func:`read_emitters`; None to read them here.
    """
    balls = [find_bounding_ball(e) for e in scene.emitters()]
    if numbers is None:
        return [None if ball is None else [dr.opaque(mi.Float, v) for v in ball] for ball in balls]
    # Outside of recordings, Dr.Jit copies the number at a literal index at once.
    start = mi.UInt32(0) if is_recording() else dr.opaque(mi.UInt32, 0)
    firsts = np.cumsum([len(balls), *(0 if ball is None else len(ball) for ball in balls)])
    return [
        None if ball is None else [dr.gather(mi.Float, numbers, start + int(first + k)) for k in range(len(ball))]
        for ball, first in zip(balls, firsts[:-1], strict=True)
    ]


def is_among(emitters: list[mi.Emitter], emitter: mi.EmitterPtr) -> mi.Bool:
    """Whether the emitter of each lane is in a list."""
    is_listed = mi.Bool(False)
    for candidate in emitters:
        is_listed |= emitter == mi.EmitterPtr(candidate)
    return is_listed


@dataclass
class EmitterDraw:
    """A direction drawn towards an emitter.

    Attributes:
        direct: Mitsuba's sample. Its density contains the probability of the emitter, and is divided by the mean light of the
            candidates over the light of the sample.
        weight: radiance over ``direct.pdf``.
        emitter: the emitter.
        u: random numbers of the direction.
        density: density of the direction by Mitsuba, times the probability of the emitter, for the power heuristic [1/sr].
    """

    direct: mi.DirectionSample3f
    weight: mi.Spectrum
    emitter: mi.EmitterPtr
    u: mi.Point2f
    density: mi.Float


@dataclass
class ChosenEmitter:
    """The emitter chosen for each lane.

    Attributes:
        number: index in ``SceneEmitters.sampled``.
        emitter: Mitsuba's emitter.
        equiangular: sampler of distances by the angle seen from the emitter; None if all emitters are at infinity.
        distribution: distribution of the choice; None without emitters to choose from.
    """

    number: mi.UInt32
    emitter: mi.EmitterPtr
    equiangular: EquiangularSampler | None
    distribution: EmitterDistribution | None


@dataclass
class EventSamples:
    """The random numbers of a scattering event, uniform in [0, 1).

    Attributes:
        generator: state of the generator that chooses pieces of the ray and estimates shadows.
        inside: numbers for the technique of distance sampling, and for the distance inside the piece.
        which_emitter: number for the emitter.
        emitter: numbers for the point or direction on the emitter.
        component: number for the component of the phase function.
        direction: numbers for the direction of the phase sample.
        which_shadow_ray: number for the differentiated shadow ray.
    """

    generator: mi.UInt32
    inside: mi.Point2f
    which_emitter: mi.Float
    emitter: mi.Point2f
    component: mi.Float
    direction: mi.Point2f
    which_shadow_ray: mi.Float

    def for_event(self, number: mi.UInt32, count: int) -> EventSamples:
        """The numbers of one of ``count`` events on a ray.

        An additive recurrence shifts the numbers of the first event; directions are stratified over the events.
        """
        # The first ``count`` forks choose the pieces of the ray; each event has two for its shadow rays.
        generator = fork_state(self.generator, count + 2 * number)
        if count == 1:
            return replace(self, generator=generator)
        # Additive recurrences with the generalised golden ratios have low discrepancy in one and two dimensions (Roberts 2018).
        k, across = mi.Float(number), max(a for a in range(1, int(count**0.5) + 1) if count % a == 0)

        def one(u: mi.Float) -> mi.Float:
            return fractional_part(dr.fma(k, 0.6180339887, u))

        def two(u: mi.Point2f) -> mi.Point2f:
            return mi.Point2f(fractional_part(dr.fma(k, 0.7548776662, u.x)), fractional_part(dr.fma(k, 0.5698402910, u.y)))

        def in_part(u: mi.Point2f) -> mi.Point2f:
            """Into the event's own cell of a grid over the square."""
            i, j = number % across, number // across
            return mi.Point2f((mi.Float(i) + u.x) / across, (mi.Float(j) + u.y) / (count // across))

        return EventSamples(
            generator,
            two(self.inside),
            self.which_emitter,
            in_part(two(self.emitter)),
            one(self.component),
            in_part(two(self.direction)),
            one(self.which_shadow_ray),
        )


def fractional_part(x: mi.Float) -> mi.Float:
    """x - floor(x), in [0, 1)."""
    return x - dr.floor(x)


def make_ball_sampler(ray: Ray, ball: list[mi.Float] | None) -> EquiangularSampler | None:
    """Make the sampler towards an emitter by its bounding ball (x, y, z, radius) [length]; None if the emitter is at
    infinity."""
    if ball is None:
        return None
    x, y, z, r = ball
    return make_equiangular_sampler(ray, mi.Point3f(x, y, z), dr.square(r), mi.Bool(True))


def make_equiangular_sampler(ray: Ray, centre: mi.Point3f, radius2: mi.Float, finite: mi.Bool) -> EquiangularSampler:
    """Make the sampler towards a ball about ``centre``, for lanes with an emitter at a ``finite`` distance."""
    away = centre - mi.Point3f(ray.o)
    t0 = dr.dot(away, ray.d)
    h2 = dr.squared_norm(away - t0 * ray.d)
    # A ray may pass through a point light. h has an error of 1e-7 of the distance to the light, so rho is at least 2e-6 of this
    # distance. The bound changes the density, and with it the variance, but no mean.
    rho = dr.sqrt(h2 + radius2 + 4e-12 * dr.squared_norm(away) + 1e-30)
    return EquiangularSampler(t0, dr.select(finite, rho, 1), finite)


@dataclass
class EquiangularSampler:
    """Equiangular sampling towards one emitter.

    Attributes:
        t0: distance along the ray at which the emitter is nearest [length].
        rho: distance from the ray to the emitter at ``t0`` [length].
        finite: lanes with an emitter at a finite distance; ``t0`` and ``rho`` have no meaning in other lanes.
    """

    t0: mi.Float
    rho: mi.Float
    finite: mi.Bool

    def angle(self, a: mi.Float, dt: mi.Float) -> mi.Float:
        """The angle of [a, a + dt] seen from the emitter [rad]; a difference of two arctangents would cancel to 0 far away."""
        near, far = a - self.t0, (a - self.t0) + dt
        return dr.atan2(self.rho * dt, dr.fma(near, far, dr.square(self.rho)))

    def mean(self, a: mi.Float, dt: mi.Float) -> mi.Float:
        """Mean of 1 / (rho^2 + (t - t0)^2) over [a, a + dt] [1/length^2]; 1 for an emitter at infinity."""
        return dr.select(self.finite, self.angle(a, dt) * dr.rcp(self.rho * dt), 1)

    def nearest(self, a: mi.Float, dt: mi.Float) -> mi.Float:
        """Smallest distance from [a, a + dt] to the emitter [length]."""
        return dr.hypot(self.rho, dr.clip(self.t0 - a, 0, dt) - (self.t0 - a))

    def evenness(self, a: mi.Float, dt: mi.Float) -> mi.Float:
        """Smallest over mean 1 / (rho^2 + (t - t0)^2) in [a, a + dt] [1]; in (0, 1], and 1 for an emitter at infinity."""
        far = dr.maximum(dr.abs(a - self.t0), dr.abs((a - self.t0) + dt))
        least = dr.rcp(dr.square(self.rho) + dr.square(far))
        return dr.select(self.finite, dr.minimum(least / self.mean(a, dt), 1), 1)

    def sample(self, a: mi.Float, dt: mi.Float, u: mi.Float) -> mi.Float:
        """Distance from ``a`` at the fraction ``u`` of the angle [length], by the addition theorem of the tangent."""
        x = (a - self.t0) / self.rho
        sin, cos = dr.sincos(u * self.angle(a, dt))
        return dr.clip(self.rho * sin * dr.fma(x, x, 1) / dr.fma(-x, sin, cos), 0, dt)

    def density(self, a: mi.Float, dt: mi.Float, t: mi.Float) -> mi.Float:
        """Density of :meth:`sample` at the distance ``t`` from ``a`` [1/length]."""
        return self.rho * dr.rcp(self.squared_distance(a, t) * self.angle(a, dt))

    def squared_distance(self, a: mi.Float, t: mi.Float) -> mi.Float:
        """Squared distance to the emitter at the distance ``t`` from ``a`` [length^2]."""
        return dr.square(self.rho) + dr.square((a - self.t0) + t)
