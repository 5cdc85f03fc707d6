"""The parameters of a scene are those of ``mi.traverse``, and no call of mivol leaves a Dr.Jit or Mitsuba object in a cycle.

Python's collector frees reference cycles at a moment of its own. If the moment lies in the middle of a trace by Mitsuba, and a
cycle held the plugins of an old scene, Dr.Jit aborts the process.
"""

from __future__ import annotations

import gc
import subprocess
import sys
from collections.abc import Callable
from enum import Enum
from functools import partial
from types import ModuleType

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from ball_photos import BOX, ball, photo
from bounded_ball import register
from fit_scene import small_problem
from gaussian_scenes import boxed, cloud, tensors_of
from media_light_scenes import SCENES
from scattering_scenes import close_up, point, rough_grid, smoke
from volpath_scenes import lit, textured

import scenes
from mivol.errors import MivolError
from mivol.experiments.gaussian_fit import make_start_cloud
from mivol.experiments.script import explain
from mivol.fields.gaussian_field import EXTINCTION_PARAMETERS
from mivol.optim.first_order import Adam
from mivol.optim.gaussians.gaussian_plan import GaussianPlan, GaussianStage
from mivol.optim.gaussians.gaussian_problem import GaussianProblem
from mivol.optim.loop import reconstruct
from mivol.optim.photographs.radiance_plan import RadiancePlan, RadianceStage
from mivol.optim.photographs.radiance_problem import RadianceProblem
from mivol.optim.photographs.ray_batches import RayBatches
from mivol.optim.second_order import GaussNewton, Lbfgs
from mivol.photos import Camera
from mivol.photos.camera import intrinsics
from mivol.scene_graph import find_children, list_values, traverse
from mivol.splatting import Splatter, to_tensors
from mivol.tomography.geometry import ParallelBeam, VoxelGrid
from mivol.tomography.projector import Projector

pytestmark = pytest.mark.usefixtures("test_ball", "traced_balls")

BOXED = scenes.centred(2 * np.eye(3))


@pytest.fixture
def test_ball(variant_rgb: str) -> None:
    register()


# -- Garbage -------------------------------------------------------------------------------------------------------------------


def garbage_of(call: Callable[[], object]) -> list[object]:
    """The objects that only Python's collector frees after a call. The first call fills what modules and Dr.Jit keep."""
    call()
    gc.collect()
    gc.disable()
    gc.set_debug(gc.DEBUG_SAVEALL)
    try:
        call()
        gc.collect()
        return list(gc.garbage)
    finally:
        gc.set_debug(0)
        gc.garbage.clear()
        gc.enable()


def held_by(garbage: list[object]) -> list[str]:
    """The types of the Dr.Jit and Mitsuba objects in cycles or held by objects in cycles. Classes and constants hold none."""
    reached = {id(one): one for each in garbage for one in (each, *gc.get_referents(each))}.values()
    objects = [one for one in reached if not isinstance(one, type | ModuleType | Enum)]
    return [str(type(one)) for one in objects if type(one).__module__.startswith(("drjit", "mitsuba"))]


# -- Calls: each makes its scene anew and keeps nothing ----------------------------------------------------------------------


def smoke_scene() -> mi.Scene:
    return close_up({"smoke": smoke(rough_grid(1), 0.5)[0], "sky": scenes.sky(0.5), "lamp": point((1, -1, 2))[0]}, res=4)


def lamp_scene() -> mi.Scene:
    return close_up({"smoke": smoke(rough_grid(1), 0.5)[0], "lamp": point((1, -1, 2))[0]}, res=4)


def surface_scene() -> mi.Scene:
    """Smoke in a sphere, whose boundary is traced, over a floor, lit by a texture."""
    ball = scenes.ball_of(scenes.medium("homogeneous", 2.0, 0.8), (0, 0, 0), 0.7)
    floor = {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([0, 0, -1]).scale(3)}
    return close_up(lit({"smoke": ball, "floor": floor, "window": textured()}), res=4)


def glass_scene() -> mi.Scene:
    ball = {"type": "sphere", "bsdf": {"type": "dielectric"}, "interior": scenes.medium("homogeneous", 2.0, 0.8)}
    return close_up({"smoke": ball, "sky": scenes.sky()}, res=4)


def bounded_scene(albedo: float) -> mi.Scene:
    inside = scenes.medium("mivol_medium", {"type": "test_ball", "sigma": 2.0, "radius": 0.5}, albedo)
    return close_up({"smoke": scenes.box_of(inside, BOXED), "sky": scenes.sky()}, res=4)


def gaussian_scene(as_light: bool) -> mi.Scene:
    drawn = cloud(6)
    if as_light:
        inside = {"type": "mivol_medium", "emission": tensors_of(drawn, tuple(to_tensors(drawn)))}
    else:
        inside = {"type": "mivol_medium", "sigma_t": tensors_of(drawn, EXTINCTION_PARAMETERS), "albedo": 0.5}
    return boxed(inside, lamp={"type": "point", "position": [1.5, 2.0, 2.5], "intensity": 10.0})


def emitting_scene(name: str) -> mi.Scene:
    return close_up(SCENES[name](), res=4)


RENDERS = {
    "absorption": (smoke_scene, 1, {}),
    "single_scattering": (smoke_scene, 2, {}),
    "free_flight": (smoke_scene, 4, {}),
    "scattering_quadrature": (lamp_scene, 2, {"deterministic": True}),
    "tracked_absorption": (partial(bounded_scene, 0.0), 3, {}),
    "bounded free_flight": (partial(bounded_scene, 0.5), 3, {}),
    "emission": (partial(emitting_scene, "radiance field"), 1, {}),
    "light of media": (partial(emitting_scene, "in fog"), 3, {}),
    "surfaces": (surface_scene, 4, {}),
    "glass": (glass_scene, 4, {}),
    "AOVs": (smoke_scene, 2, {"aovs": "tau, tau.R, alpha, depth"}),
    "Gaussians as matter": (partial(gaussian_scene, False), 3, {}),
    "Gaussians as light": (partial(gaussian_scene, True), 1, {}),
}
"""Scene, depth and settings of renders: each segment estimator, and what else is computed in another way."""


def differentiated_key(params: mi.SceneParameters) -> str:
    """A parameter of a medium that has derivatives."""
    ends = (".data", ".sigma", ".value.value", ".density", ".opacity_logits")
    return next(key for end in ends for key in params.keys() if "interior_medium" in key and key.endswith(end))  # noqa: SIM118


def render(name: str, way: str) -> None:
    """A picture, or its derivatives, as users call them."""
    make, depth, settings = RENDERS[name]
    scene, integrator = make(), mi.load_dict({"type": "mivol", "max_depth": depth, **settings})
    if way == "picture":
        dr.eval(mi.render(scene, integrator=integrator, spp=2))
        return
    params = traverse(scene)
    key = differentiated_key(params)
    dr.enable_grad(params[key])
    params.update()
    if way == "reverse":
        dr.backward(dr.mean(mi.render(scene, params, integrator=integrator, spp=2), axis=None))
        dr.eval(dr.grad(params[key]))
    else:
        dr.set_grad(params[key], 1.0)
        dr.eval(integrator.render_forward(scene, params, spp=2))


def refuse_a_render() -> None:
    """An error whose traceback holds the frames of a render."""
    try:
        mi.render(smoke_scene(), integrator=mi.load_dict({"type": "mivol", "max_depth": 4, "deterministic": True}), spp=1)
    except MivolError:
        return
    raise AssertionError("the render was not refused")


def nest_the_integrator() -> None:
    nested = {"type": "aov", "aovs": "d:depth", "image": {"type": "mivol", "max_depth": 3}}
    dr.eval(mi.render(smoke_scene(), integrator=mi.load_dict(nested), spp=2))


def fit_scene(optimizer: object) -> None:
    reconstruct(small_problem(), optimizer, 2)


def fit_radiance_field() -> None:
    batches = RayBatches.from_photos([photo(ball(8), k, 12) for k in range(3)], (1,))
    plan = RadiancePlan((RadianceStage(8, 2, 1, 2, 4),), degree=1)
    reconstruct(RadianceProblem(batches, BOX, plan), plan.optimizer, plan.course())


def fit_gaussians() -> None:
    views = [photo(ball(8), k, 12) for k in range(3)]
    plan = GaussianPlan((GaussianStage(2, 2, 0, 1),), start=20, most=30)
    points = np.random.default_rng(1).uniform(-0.5, 0.5, (20, 3))
    start = make_start_cloud(points, views, plan.degree)
    problem = GaussianProblem(RayBatches.from_photos(views, (1,)), [view.camera for view in views], start, plan)
    reconstruct(problem, plan.optimizer, plan.course())


def splat() -> None:
    pose = np.eye(4)
    pose[2, 3] = 4.0
    image, cache = (splatter := Splatter(16, 16, 2)).forward(
        to_tensors(cloud(6)), Camera(intrinsics(20.0, 20.0, 8.0, 8.0), (16, 16), pose)
    )
    splatter.backward(cache, dr.ones(mi.TensorXf, image.shape))


def project() -> None:
    a = Projector(ParallelBeam(np.arange(4) * 0.7, (1, 12), 0.2), VoxelGrid((1, 8, 8), (0.25, 0.25, 1.0)))
    a.T @ (a @ np.ones((1, 8, 8), np.float32))


CALLS = {f"{name}, {way}": partial(render, name, way) for name in RENDERS for way in ("picture", "reverse", "forward")} | {
    "a refusal": refuse_a_render,
    "inside another integrator": nest_the_integrator,
    "explain": lambda: explain(smoke_scene(), 4, noise=0.1),
    "scene by Adam": lambda: fit_scene(Adam()),
    "scene by L-BFGS": lambda: fit_scene(Lbfgs()),
    "scene by Gauss-Newton": lambda: fit_scene(GaussNewton()),
    "radiance field": fit_radiance_field,
}
RECORDED = {"Gaussians": fit_gaussians, "splatter": splat, "projector": project}
"""Calls that record kernels by ``dr.freeze``, which leaves classes and functions of its own in cycles."""


QUICK = {
    *("single_scattering, picture", "free_flight, reverse", "scattering_quadrature, picture", "tracked_absorption, picture"),
    *(
        "surfaces, reverse",
        "AOVs, forward",
        "Gaussians as matter, picture",
        "a refusal",
        "inside another integrator",
        "explain",
    ),
    *("scene by Gauss-Newton", "radiance field"),
}
"""Calls that every run of the tests makes; between them they pass through each room."""


@pytest.mark.parametrize("name", [pytest.param(name, marks=() if name in QUICK else pytest.mark.slow) for name in CALLS])
def test_a_call_leaves_no_cycle(name: str) -> None:
    assert garbage_of(CALLS[name]) == []


@pytest.mark.parametrize("name", RECORDED)
def test_recorded_kernels_are_in_no_cycle(name: str) -> None:
    assert held_by(garbage_of(RECORDED[name])) == []


def test_an_object_in_a_cycle_is_seen() -> None:
    """The checks themselves: a list that holds itself and an array, and a function that holds a scene."""

    def leave_a_list() -> None:
        closed: list[object] = [mi.Float(1.0)]
        closed.append(closed)

    def leave_a_function() -> None:
        scene = lamp_scene()

        def again() -> object:
            return again, scene

    assert [str(type(mi.Float()))] == held_by(garbage_of(leave_a_list))
    assert any("Scene" in kind for kind in held_by(garbage_of(leave_a_function)))


OLD_SCENE = """
import gc
import drjit as dr, mitsuba as mi
import mivol
mi.set_variant("llvm_ad_rgb")

def load():
    ball = {"type": "sphere", "bsdf": {"type": "null"}, "interior": {"type": "homogeneous", "albedo": 0.8, "sigma_t": 1.0}}
    film = {"type": "hdrfilm", "width": 4, "height": 4}
    camera = {"type": "perspective", "to_world": mi.ScalarTransform4f().look_at([0, 4, 1], [0, 0, 0], [0, 0, 1]), "film": film}
    return mi.load_dict({"type": "scene", "sky": {"type": "constant"}, "ball": ball, "camera": camera})

gc.disable()
mi.render(load(), integrator=mi.load_dict({"type": "mivol", "max_depth": 3}), spp=1)
scene = load()
peer, params = mi.load_dict({"type": "prbvolpath", "max_depth": 3}), mi.traverse(scene)
key = "ball.interior_medium.sigma_t.value.value"
dr.enable_grad(params[key])
params.update()
image = mi.render(scene, params, integrator=peer, spp=1)
sample = type(peer).sample

def collect_and_sample(self, mode, *given, **named):
    if mode == dr.ADMode.Backward:
        gc.collect()
    return sample(self, mode, *given, **named)

type(peer).sample = collect_and_sample
dr.backward(dr.mean(image, axis=None))
print(dr.grad(params[key]))
"""


def test_a_collection_between_traces_of_another_integrator_ends_well() -> None:
    """``prbvolpath`` renders a scene, and garbage is collected before its backward pass. When cycles of mivol held the plugins
    of an earlier scene, Dr.Jit aborted the process ("invalid redefinition of function")."""
    done = subprocess.run([sys.executable, "-c", OLD_SCENE], capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr[-600:]
    assert done.stdout.startswith("[")


KEPT_SCENES = """
import mivol, numpy as np, mitsuba as mi
mi.set_variant("llvm_ad_rgb")

def load(shape, **parts):
    film = {"type": "hdrfilm", "width": 8, "height": 6, "rfilter": {"type": "box"}}
    view = mi.ScalarTransform4f().look_at([0, 0, 4], [0, 0, 0], [0, 1, 0])
    camera = {"type": "perspective", "to_world": view, "film": film}
    return mi.load_dict({"type": "scene", "camera": camera, "sky": {"type": "constant"}, "shape": {"type": shape, **parts}})

kept, direct = [], mi.load_dict({"type": "direct"})
for _ in range(3):
    kept.append(load("sphere"))
    np.array(direct.render(kept[-1], kept[-1].sensors()[0], spp=4))
fog = {"type": "homogeneous", "albedo": 0.5, "sigma_t": 1.0}
scene = load("cube", bsdf={"type": "null"}, interior=fog)
print(np.array(mi.render(scene, integrator=mi.load_dict({"type": "mivol"}), spp=4)).shape)
"""


def test_scenes_that_a_stock_integrator_rendered_stay_in_memory() -> None:
    """``render`` of ``direct`` leaves the numbers of three samplers unevaluated, the first traced with one shape. When
    the first recording of mivol evaluated them in one kernel, Dr.Jit aborted the process ("invalid redefinition ...")."""
    done = subprocess.run([sys.executable, "-c", KEPT_SCENES], capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr[-600:]
    assert done.stdout == "(6, 8, 3)\n"


# -- Parameters ----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", RENDERS)
def test_parameters_are_those_of_mitsuba(name: str) -> None:
    """The same keys in the same order, with the same objects, flags, parents and depths, and values of the same bits."""
    scene = RENDERS[name][0]()
    ours, theirs = traverse(scene), mi.traverse(scene)
    assert list(ours.properties) == list(theirs.properties)
    for (_, kind, node, flags), (_, their_kind, *rest) in zip(
        ours.properties.values(), theirs.properties.values(), strict=True
    ):
        assert [node, flags] == rest
        assert (kind is None) == (their_kind is None)
    assert ours.hierarchy == theirs.hierarchy
    for (key, value), (_, other) in zip(list_values(ours), theirs, strict=True):
        assert type(value) is type(other)
        assert dr.all(value == other, axis=None) if dr.is_array_v(value) else str(value) == str(other), key


def test_objects_of_one_name_are_numbered() -> None:
    """A plugin that calls two objects alike, as ``mi.traverse`` numbers them."""

    class Pair(mi.BSDF):
        def __init__(self, props: mi.Properties) -> None:
            super().__init__(props)
            self.parts = [mi.load_dict({"type": "diffuse", "reflectance": value}) for value in (0.1, 0.2)]

        def traverse(self, callback: mi.TraversalCallback) -> None:
            for part in self.parts:
                callback.put("part", part, mi.ParamFlags.Differentiable)

    mi.register_bsdf("test_pair", Pair)
    pair = mi.load_dict({"type": "test_pair"})
    assert list(traverse(pair).properties) == list(mi.traverse(pair).properties)
    assert list(traverse(pair).properties) == ["part.reflectance.value", "part_1.reflectance.value"]


def test_an_object_under_two_names_is_found_under_both() -> None:
    """Mitsuba merges equal volumes; the parameters have one of the names."""
    inside = mi.load_dict({"type": "mivol_medium", "sigma_t": 0.5, "albedo": 0.5})
    assert {"sigma_t", "albedo"} <= set(find_children(inside))


def test_a_parameter_takes_its_discontinuity_from_its_object() -> None:
    """The flags of the vertices of a mesh, and of a parameter without derivatives below it."""
    mesh = mi.load_dict({"type": "cube"})
    ours, theirs = ({key: entry[3] for key, entry in made(mesh).properties.items()} for made in (traverse, mi.traverse))
    assert ours == theirs and len(set(ours.values())) > 1
