"""A render from the question to the image: a scene's needs, the plan, the walk, the film, and the way back.

Conventions. A session belongs to one integrator. It keeps the survey of the scene it saw last and nothing else, so that the
same integrator may be used on one scene after the other.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from mivol.errors import MivolError
from mivol.scene.derived import renew, tangents_led
from mivol.scene.load import find_sensor
from mivol.scene.needs import Needs, Survey, find_needs, read_coarse, survey_scene
from mivol.scene.plan import Plan, build_world, check_aovs, make_plan
from mivol.transport.aovs import backproject_aovs, integrate_aovs, push_aovs
from mivol.transport.control import View, find_control, find_level
from mivol.transport.film import PLAIN, SPREAD, TILED, Rays, adjoint_rays, record
from mivol.transport.light_grid import Shade, find_light_grid, find_shade
from mivol.transport.path import Settings, is_straight, walk_path
from mivol.transport.score import Adjoint, Primal, Tangent
from mivol.transport.world import World

__all__ = ["Session"]


@dataclass
class _Seen:
    """A scene, known by its shapes and emitters, and its survey.

    Not the scene itself: it may hold the integrator that this session belongs to, and neither would ever be freed.
    """

    parts: list[mi.Object]
    survey: Survey

    def is_of(self, parts: list[mi.Object]) -> bool:
        """Whether these are the very same shapes and emitters."""
        return len(parts) == len(self.parts) and all(a is b for a, b in zip(parts, self.parts, strict=True))


class Session:
    """Renders scenes with one set of settings.

    Args:
        settings: depth, roulette, hidden emitters.
        aovs: comma list of the names in :data:`mivol.transport.aovs.AOVS`.

    Raises:
        MivolError: an unknown AOV, or one named twice.
    """

    def __init__(self, settings: Settings, aovs: str = "") -> None:
        self.settings = settings
        self.aovs = check_aovs(aovs)
        self._seen: _Seen | None = None

    def __repr__(self) -> str:
        s = self.settings
        return f"mivol[max_depth={s.max_depth}, rr_depth={s.rr_depth}, aovs={','.join(self.aovs)}]"

    def render(
        self, scene: mi.Scene, sensor: int | mi.Sensor, seed: int, spp: int, develop: bool = True, evaluate: bool = True
    ) -> mi.TensorXf:
        """Render an image (height, width, colours + AOVs).

        Raises:
            MivolError: what the plan refuses, or ``develop`` false.
        """
        if not develop:
            raise MivolError("develop=False was asked for; mivol returns the developed image: leave it at True.")
        sensor = find_sensor(scene, sensor)
        with dr.suspend_grad():
            world, plan = self._open(scene, sensor, spp, pictures=True)
            image = record(
                sensor, seed, spp, plan.pass_rays, self.aovs, lambda rays: self._primal(scene, world, rays), _layout(world)
            )
        if evaluate:
            dr.eval(image)
        return image

    def render_forward(self, scene: mi.Scene, sensor: int | mi.Sensor, seed: int, spp: int) -> mi.TensorXf:
        """Render the derivative of an image along the gradients that were set on the parameters."""
        sensor = find_sensor(scene, sensor)
        with dr.suspend_grad(), tangents_led(scene):
            with dr.resume_grad():
                world, plan = self._open(scene, sensor, spp)
                world.start_tangent()
            return record(
                sensor, seed, spp, plan.pass_rays, self.aovs, lambda rays: self._tangent(scene, world, rays), _layout(world)
            )

    def render_backward(self, scene: mi.Scene, grad_in: mi.TensorXf, sensor: int | mi.Sensor, seed: int, spp: int) -> None:
        """Add the derivatives of an image, weighted by ``grad_in``, to the gradients of the parameters.

        Cost: a render and its replay; memory independent of the samples, beyond those of a pass.
        """
        sensor = find_sensor(scene, sensor)
        with dr.suspend_grad():
            with dr.resume_grad():
                renew(scene)
                world, plan = self._open(scene, sensor, spp)
            world.start_gradients()
            # What is pulled back to a volume waits there for the end: its edge to the parameter can be passed but once.
            with dr.isolate_grad():
                for rays, dL, daovs in adjoint_rays(
                    sensor, seed, spp, plan.pass_rays, self.aovs, grad_in, _layout(world)
                ):
                    self._replay(scene, world, rays, dL, daovs)
                    dr.eval()
            with dr.resume_grad():
                world.push_gradients()

    def sample(self, scene: mi.Scene, sampler: mi.Sampler, ray: mi.Ray3f, active: mi.Bool) -> tuple:
        """Radiance along given rays, for integrators that nest this one, which do not tell what sensor the rays come from."""
        with dr.suspend_grad():
            world, _ = self._open(scene, find_sensor(scene, 0), 1, pictures=True)
            named = [sensor.get_medium() for sensor in scene.sensors()]
            world.start = named[0] if all(medium is named[0] for medium in named) else None
            world.locates = bool(world.traced)
            score, alpha = walk_path(scene, world, self.settings, sampler, ray, Primal(_black(ray)), active)
            # Their alpha is whether something is seen: it is drawn.
            return score.L, sampler.next_1d(active) < alpha, integrate_aovs(scene, world, ray, self.aovs, active)

    def _open(self, scene: mi.Scene, sensor: mi.Sensor, spp: int, pictures: bool = False) -> tuple[World, Plan]:
        """Ask, plan, and build the media, for pictures or for derivatives."""
        parts = [*scene.shapes(), *scene.emitters()]
        if self._seen is None or not self._seen.is_of(parts) or not self._seen.survey.is_current:
            self._seen = _Seen(parts, survey_scene(scene))
        survey = self._seen.survey
        needs = find_needs(scene, sensor, survey, spp)
        plan = make_plan(needs, self.settings)
        world = build_world(scene, needs, plan, self.settings, survey)
        if world.lights is not None:
            with dr.suspend_grad():
                world.shade = self._shade(scene, world, needs, plan, pictures)
                if self.settings.shadows == "grid":
                    world.light_grid = find_light_grid(scene, world)
        return world, plan

    def _shade(self, scene: mi.Scene, world: World, needs: Needs, plan: Plan, pictures: bool) -> Shade | None:
        """Find where lamps shine; derivatives are not 0 in empty blocks, which only values that were read can tell."""
        blind = not pictures or any(m.unread for m in needs.media)
        rays = needs.film_samples * (plan.events if pictures else 1)
        occupied = None if blind else needs.media[0].occupied
        survey = self._seen.survey
        return find_shade(scene, world, rays, occupied, lambda *asked: read_coarse(survey, *asked))

    def _primal(self, scene: mi.Scene, world: World, rays: Rays) -> tuple:
        score = Primal(_black(rays.ray))
        score, alpha = walk_path(scene, world, self.settings, rays.sampler, rays.ray, score, strata=rays.strata)
        return score.L, alpha, integrate_aovs(scene, world, rays.ray, self.aovs)

    def _tangent(self, scene: mi.Scene, world: World, rays: Rays) -> tuple:
        _take_control(scene, world, rays)
        black = _black(rays.ray)
        score = Tangent(black, black, black)
        score, _ = walk_path(scene, world, self.settings, rays.sampler, rays.ray, score, strata=rays.strata)
        return score.dL, dr.zeros(mi.Float, dr.width(black)), push_aovs(scene, world, rays.ray, self.aovs)

    def _replay(self, scene: mi.Scene, world: World, rays: Rays, dL: mi.Spectrum, daovs: list[mi.Float]) -> None:
        _take_control(scene, world, rays)
        again, L = rays.sampler.clone(), None
        if not is_straight(world, self.settings):
            known = Primal(_black(rays.ray), scatters=False)
            L = walk_path(scene, world, self.settings, rays.sampler, rays.ray, known, strata=rays.strata)[0].L
            dr.eval(L)
        walk_path(scene, world, self.settings, again, rays.ray, Adjoint(L, dL), strata=rays.strata)
        backproject_aovs(scene, world, rays.ray, self.aovs, daovs)


def _layout(world: World) -> str:
    """How the rays of a pass lie: in tiles of pixels where they draw directions of the phase function, or to wide lamps."""
    if world.lights is None:
        return PLAIN
    return TILED if world.lights.has_lobes and not world.is_deterministic else SPREAD


def _take_control(scene: mi.Scene, world: World, rays: Rays) -> None:
    """Find the control variate of a derivative, once for all passes."""
    if world.takes_control:
        world.control = world.control or find_control(scene, world, world.bodies[0], View.of(rays.ray))
    elif world.lights is not None and world.level is None:
        world.level = find_level(scene, world)


def _black(ray: mi.Ray3f) -> mi.Spectrum:
    return dr.zeros(mi.Spectrum, dr.width(ray))
