"""Renders and gradients that are recorded give the numbers of traced ones, whatever changes between calls.

Kernels are recorded while Python's collector is paused.
"""

from __future__ import annotations

import contextlib
import gc
import itertools
import re
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from tempfile import NamedTemporaryFile

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scattering_scenes import PLACE, cases, close_up, mivol, point, rough_grid, smoke, sun

import scenes
from mivol.bench.studies.steps import count_launches
from mivol.errors import MivolError
from mivol.kernel_recording import (
    CannotRecordError,
    RecordedFunctions,
    RecordedKernel,
    RecordedTask,
    Recordings,
    copy_aligned,
    is_recording,
    without_garbage_collection,
)
from mivol.scene import media_light, plan, readings, render_tasks, scene_state, session
from mivol.scene.scene_state import SceneState, UnfollowedStateError, describe_foreign, find_hidden_arrays
from mivol.scene.stand_in import FORMATS, StandIn, describe_kind
from mivol.threads import set_thread_count
from mivol.transport.path.film import RenderSamples, film_passes, find_batch_views
from mivol.transport.traversal.grid_blocks import find_empty_distances
from scenes import ball_of, box_of, camera, grid_volume, medium, pencil, refused, sky

pytestmark = pytest.mark.usefixtures("cpu_back_end")

INSIDE = "smoke.interior_medium."


def smoke_under(kind: str = "mivol_medium", phase: dict | None = None, **more: dict) -> mi.Scene:
    volume = "mivol_voxels" if kind == "mivol_medium" else "gridvolume"
    given = {} if phase is None else {"phase": phase}
    smoke = medium(kind, grid_volume(volume, rough_grid(4, 3.0).astype(np.float32), PLACE), 0.8, **given)
    return close_up({"smoke": box_of(smoke, PLACE), **(more or {"sky": sky(0.7)})}, res=6)


def lamp_in_fog() -> mi.Scene:
    """A lamp in a ball over a floor: light of near emitters along segments, and traced surfaces."""
    floor = {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([0, 0, -1.5]).scale(3)}
    fog = ball_of(medium("homogeneous", 1.5, 0.8), (0, 0, 0), 1.2)
    return close_up({"smoke": fog, "lamp": point((0.2, 0.1, 0.3))[0], "floor": floor}, res=6)


def fire(**more: dict) -> mi.Scene:
    light = grid_volume("mivol_voxels", rough_grid(6, 1.0, (5, 4, 6)).astype(np.float32), PLACE)
    smoke = medium("mivol_medium", grid_volume("mivol_voxels", rough_grid(4, 3.0).astype(np.float32), PLACE), 0.8)
    return close_up({"smoke": box_of(smoke | {"emission_density": light}, PLACE), **more}, res=6)


def lit_by_map() -> dict:
    """An environment map."""
    colours = np.random.default_rng(1).uniform(0.1, 1.0, (8, 16, 3)).astype(np.float32)
    return {"type": "envmap", "bitmap": mi.Bitmap(colours)}


def lit_by_maps() -> mi.Scene:
    """Under an environment map and a spot."""
    above = mi.ScalarTransform4f().look_at([2, -2, 3], [0, 0, 0], [0, 0, 1])
    spot = {"type": "spot", "to_world": above, "intensity": 20.0, "cutoff_angle": 14.0, "beam_width": 7.0}
    return smoke_under(sky=lit_by_map(), spot=spot)


def before_painted_faces() -> mi.Scene:
    """Before a square with colours at its vertices, beside a rough ball."""
    material = mi.Properties()
    reflectance = {"type": "mesh_attribute", "name": "vertex_color"}
    material["bsdf"] = mi.load_dict({"type": "diffuse", "reflectance": reflectance})
    square = mi.Mesh("square", 4, 2, props=material)
    square.add_attribute("vertex_color", 3, [0.5, 0.2, 0.3, 0.3, 0.5, 0.9] * 2)
    params = mi.traverse(square)
    params["vertex_positions"] = mi.Float([-2, 1.5, -2, 2, 1.5, -2, 2, 1.5, 2, -2, 1.5, 2])
    params["faces"] = mi.UInt32([0, 1, 2, 0, 2, 3])
    params.update()
    ball = {"type": "sphere", "center": [0.3, -0.9, -0.2], "radius": 0.7, "bsdf": {"type": "roughplastic", "alpha": 0.3}}
    return smoke_under(sky=sky(0.7), ball=ball, wall=square)


def blend_of_blends() -> dict:
    table = {"type": "tabphase", "values": "0.2, 0.1, 0.5, 0.9"}
    return {
        "type": "blendphase",
        "weight": grid_volume("gridvolume", np.random.default_rng(5).uniform(0.1, 0.9, (2, 3, 2, 1)), PLACE),
        "a": {"type": "blendphase", "weight": 0.4, "a": table, "b": {"type": "hg"}},
        "b": {"type": "rayleigh"},
    }


def microflakes(count: int = 1) -> dict:
    matrices = np.float32([0.3, 0.5, 0.7, 0.05, 0.02, -0.03]) * np.arange(1, count + 1, dtype=np.float32)[:, None]
    return {"type": "sggx", "S": grid_volume("gridvolume", matrices.reshape(count, 1, 1, 6), PLACE)}


SCENES: dict[str, tuple[Callable[[], mi.Scene], int, list[str]]] = {
    "grid": (smoke_under, 4, [INSIDE + "sigma_t.data", INSIDE + "albedo.value.value", "sky.radiance.value"]),
    "one scattering": (lambda: smoke_under(sun=sun([0.3, 0.2, -1.0])[0]), 2, [INSIDE + "sigma_t.data", "sun.irradiance.value"]),
    "stock grid": (lambda: smoke_under("heterogeneous"), 4, [INSIDE + "sigma_t.data", INSIDE + "albedo.value.value"]),
    "phase": (lambda: smoke_under(phase={"type": "mivol_hg", "g": 0.5}), 4, [INSIDE + "phase_function.g"]),
    "stock phase": (
        lambda: smoke_under(phase={"type": "hg", "g": 0.5}),
        4,
        [INSIDE + key for key in ("phase_function.g", "sigma_t.data")],
    ),
    "blend": (
        lambda: smoke_under(phase=blend_of_blends()),
        4,
        [
            INSIDE + "phase_function." + key
            for key in ("weight.data", "phase_0.weight.value.value", "phase_0.phase_0.values", "phase_0.phase_1.g")
        ],
    ),
    "microflakes": (
        lambda: smoke_under(phase=microflakes()),
        3,
        [INSIDE + "phase_function.S.data", INSIDE + "sigma_t.data"],
    ),
    "lamp": (lamp_in_fog, 5, [INSIDE + "sigma_t.value.value", "floor.bsdf.reflectance.value", "lamp.position"]),
    "maps": (lit_by_maps, 3, ["sky.data", "sky.scale", "spot.beam_width"]),
    "surfaces": (before_painted_faces, 3, ["wall.vertex_color", "ball.bsdf.alpha"]),
    "fire": (fire, 3, [INSIDE + "emission_density.data", INSIDE + "sigma_t.data"]),
}


class Pair:
    """The same renders by recordings, and traced anew in each call."""

    def __init__(self, scene: mi.Scene, depth: int) -> None:
        self.scene, self.params = scene, mi.traverse(scene)
        self.recorded, self.traced = (mi.load_dict(mivol(max_depth=depth)) for _ in range(2))

        def refuse(*_: object) -> None:
            raise CannotRecordError

        self.traced.session.recordings.call = refuse
        set_thread_count(1)  # sums over lanes then have one order

    @property
    def recordings(self) -> Recordings:
        return self.recorded.session.recordings

    def scale(self, key: str, factor: float) -> None:
        self.params[key] = type(self.params[key])(self.params[key] * factor)
        self.params.update()

    def images(self, seed: int, **more: object) -> list[np.ndarray]:
        return [
            np.array(mi.render(self.scene, integrator=integrator, seed=seed, spp=2, **more))
            for integrator in (self.recorded, self.traced)
        ]

    def gradients(self, key: str, seed: int) -> list[np.ndarray]:
        return [self.gradient(integrator, key, seed) for integrator in (self.recorded, self.traced)]

    @contextlib.contextmanager
    def differentiated(self, key: str) -> Iterator[object]:
        """The value of a parameter, whose gradients are enabled inside of the block."""
        value = type(self.params[key])(dr.detach(self.params[key]))
        dr.enable_grad(value)
        self.params[key] = value
        self.params.update()
        yield value
        self.params[key] = type(value)(dr.detach(value))
        self.params.update()

    def gradient(self, integrator: mi.Integrator, key: str, seed: int) -> np.ndarray:
        with self.differentiated(key) as value:
            dr.backward(dr.mean(mi.render(self.scene, self.params, integrator=integrator, seed=seed, spp=2), axis=None))
            return np.array(dr.ravel(dr.grad(value)))

    def tangents(self, key: str, seed: int) -> list[np.ndarray]:
        return [self.tangent(integrator, key, seed) for integrator in (self.recorded, self.traced)]

    def tangent(self, integrator: mi.Integrator, key: str, seed: int) -> np.ndarray:
        with self.differentiated(key) as value:
            # A map copies what it is given.
            dr.set_grad(self.params[key], 0.1 * (seed + 1) + value)
            return np.array(integrator.render_forward(self.scene, self.params, seed=seed, spp=2))

    def assert_same(self, seed: int, **more: object) -> None:
        found, truth = self.images(seed, **more)
        assert np.array_equal(found, truth) and truth.max() > 0


SLOW = "stock grid", "phase", "surfaces", "fire", "microflakes"


@pytest.mark.parametrize("name", cases(SCENES, slow=SLOW))
def test_images_follow_values(name: str) -> None:
    """To the last bit, and after the first calls without another recording."""
    make, depth, keys = SCENES[name]
    pair = Pair(make(), depth)
    for key in keys:
        for call in range(6):
            pair.scale(key, 0.9)
            pair.assert_same(call)
            if call == 1:
                count = pair.recordings.count
        assert pair.recordings.count == count, key
    assert not any(pair.recordings.failures.values())


def assert_close(gradients: list[np.ndarray]) -> None:
    """Kernels of other inputs may round and sum in another order: some 200 terms in a voxel."""
    found, truth = gradients
    assert np.abs(found - truth).max() <= 200 * 2**-24 * np.abs(truth).max() > 0


def assert_same_derivatives(name: str, find: Callable[[Pair, str, int], list[np.ndarray]]) -> Pair:
    """The derivatives by each parameter of a scene, in three calls with other values."""
    make, depth, keys = SCENES[name]
    pair = Pair(make(), depth)
    for key in keys:
        for call in range(3):
            pair.scale(key, 0.9)
            found, truth = find(pair, key, call)
            # Kernels of other inputs may round and sum in another order: some 200 terms in a voxel. A single number sums over
            # 72 paths, with 3 vertices, the light and the direction of each, and 3 colours.
            terms = 200 if truth.size > 1 else 72 * 3 * 2 * 3
            assert np.abs(found - truth).max() <= terms * 2**-24 * np.abs(truth).max(), key
            assert np.abs(truth).max() > 0, key
    assert not any(pair.recordings.failures.values())
    return pair


@pytest.mark.parametrize(
    "name", cases(SCENES, slow=("stock grid", "phase", "surfaces", "fire", "microflakes", "one scattering"))
)
def test_gradients_follow_values(name: str) -> None:
    assert_same_derivatives(name, Pair.gradients)


@pytest.mark.parametrize("name", cases(SCENES, slow=[name for name in SCENES if name not in ("phase", "one scattering")]))
def test_tangents_follow_values(name: str) -> None:
    pair = assert_same_derivatives(name, Pair.tangents)
    # The ``g`` of a stock ``hg`` is recorded anew in each step. Two recordings join the arrays of the scene and its tracer.
    assert pair.recordings.count <= 2 * len(SCENES[name][2]) + {"stock phase": 1, "lamp": 2, "surfaces": 2}.get(name, 0)


@pytest.mark.parametrize(
    ("make", "key"),
    [(lit_by_maps, "sky.scale"), (SCENES["stock phase"][0], INSIDE + "phase_function.g")],
    ids=["sky", "phase"],
)
def test_a_number_that_changes_becomes_an_array(make: Callable, key: str) -> None:
    """A number would be compiled into the kernels of each step."""
    pair, counts = Pair(make(), 3), []
    for call in range(4):
        pair.params[key] = mi.Float(0.5 + 0.1 * call)
        pair.params.update()
        assert pair.params[key].state == dr.VarState.Literal
        pair.gradient(pair.recorded, key, call)
        counts.append(pair.recordings.count)
    assert counts[1] == counts[-1]


def test_a_gradient_flows_on_to_what_a_parameter_was_made_from() -> None:
    """A grid made from one number, again in each step."""
    pair = Pair(smoke_under(), 3)
    base = mi.TensorXf(dr.detach(pair.params[INSIDE + "sigma_t.data"]))
    for step in range(3):
        found = []
        for integrator in (pair.recorded, pair.traced):
            factor = dr.opaque(mi.Float, 1 + 0.1 * step)
            dr.enable_grad(factor)
            pair.params[INSIDE + "sigma_t.data"] = base * factor
            pair.params.update()
            dr.backward(dr.mean(mi.render(pair.scene, pair.params, integrator=integrator, seed=step, spp=2), axis=None))
            found.append(float(dr.grad(factor)[0]))
        assert found[0] == found[1] != 0
    assert 0 < pair.recordings.count <= 4


def test_an_hg_elsewhere_disturbs_no_recording() -> None:
    """Dr.Jit would record no call through a pointer while an ``hg`` lives whose ``g`` was set."""
    other = Pair(smoke_under(phase={"type": "hg", "g": 0.5}), 3)
    other.scale(INSIDE + "phase_function.g", 0.9)
    dr.make_opaque(other.params[INSIDE + "phase_function.g"])
    pair = Pair(smoke_under(phase={"type": "mivol_hg", "g": 0.5}), 3)
    for call in range(3):
        pair.assert_same(call)
    assert pair.recordings.count == 1 and not any(pair.recordings.failures.values())


def test_cameras_move_between_calls() -> None:
    pair = Pair(smoke_under(), 3)
    for angle in np.linspace(0, 1, 4):
        sensor = mi.load_dict(camera((4 * np.sin(angle), -4 * np.cos(angle), 1.0), (0.0, 0.0, 0.0), res=6, fov=35.0))
        pair.assert_same(1, sensor=sensor)


def batch_of(*views: dict) -> dict:
    film = {"type": "hdrfilm", "width": 6 * len(views), "height": 6, "rfilter": {"type": "box"}}
    return {"type": "batch", "film": film, "sampler": {"type": "independent"}, **{f"eye{k}": v for k, v in enumerate(views)}}


def test_a_cache_of_shadows_is_recorded_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Dr.Jit records no list of unknown length: with two threads it would trace every call again."""
    values = np.zeros((8, 8, 8, 1), np.float32)
    values[:4] = 3.0
    smoke = medium("mivol_medium", grid_volume("mivol_voxels", values, PLACE), 0.8)
    pair = Pair(close_up({"smoke": box_of(smoke, PLACE), "sun": sun([0.3, 0.2, -1.0])[0]}, res=24), 2)
    set_thread_count(2)
    made, build = [], plan.build_visibility_cache
    monkeypatch.setattr(plan, "build_visibility_cache", lambda *given: made.append(build(*given)) or made[-1])
    for call in range(4):
        pair.scale(INSIDE + "sigma_t.data", 0.9)
        found, truth = pair.images(call)
        # Sums of two samples for a pixel, by kernels that may round in another order.
        np.testing.assert_allclose(found, truth, rtol=8 * 2.0**-24, atol=0)
    assert made[-1] is not None
    # Four calls of the traced integrator, and the first of the other.
    assert len(made) == 4 + 1


def test_views_of_a_batch_are_seen_side_by_side() -> None:
    """With the rays that Mitsuba's ``batch`` makes, to the last bit."""
    eyes = [camera((4 * np.sin(a), -4 * np.cos(a), 1.0), (0.0, 0.0, 0.0), res=6, fov=35.0) for a in (0.0, 1.0, 2.0)]
    pair, batch = Pair(smoke_under(), 3), mi.load_dict(batch_of(*eyes))
    for call in range(4):
        pair.scale(INSIDE + "sigma_t.data", 0.9)
        pair.assert_same(call, sensor=batch)
        if call == 1:
            count = pair.recordings.count
    assert pair.recordings.count == count
    rays = [next(film_passes(RenderSamples(batch, 3, 2, 1 << 20, views))) for views in (find_batch_views(batch), None)]
    for part in ("o", "d", "maxt"):
        mine, mitsubas = (np.array(getattr(found.ray, part)) for found in rays)
        assert np.array_equal(mine, mitsubas)
    assert np.unique(np.array(rays[0].ray.o), axis=1).shape[1] > 3


def test_each_camera_of_a_scene_has_its_own_facts() -> None:
    """One camera stands outside of a traced ball, one inside: a plan is made for each."""
    ball = ball_of(medium("homogeneous", 1.5, 0.0), (0, 0, 0), 1.2) | {"bsdf": {"type": "thindielectric"}}
    eyes = {f"eye{k}": camera((0.0, y, 0.0), (0.0, 0.1, 0.0), res=6, fov=35.0) for k, y in enumerate((-4.0, 0.0))}
    scene = mi.load_dict({"type": "scene", "ball": ball, "sky": sky(1.0), **eyes})
    outside, inside = (SceneState.of(scene, sensor) for sensor in scene.sensors())
    assert outside.key == inside.key and not outside.is_same(inside)
    pair = Pair(scene, 3)
    for sensor in (0, 1, 0):
        pair.assert_same(1, sensor=sensor)


def test_a_camera_that_moves_into_a_traced_boundary_has_new_facts() -> None:
    """A recording follows the place of a camera, and a plan tells inside from outside."""
    ball = ball_of(medium("homogeneous", 1.5, 0.0), (0, 0, 0), 1.2) | {"bsdf": {"type": "thindielectric"}}
    eye = camera((0.0, -4.0, 0.5), (0.0, 0.1, 0.5), res=6, fov=35.0)
    scene, kept = mi.load_dict({"type": "scene", "ball": ball, "sky": sky(1.0), "eye": eye}), mi.load_dict(mivol(max_depth=3))
    params, pictures, inside = mi.traverse(scene), [], []
    for y in (-4.0, 0.0):
        params["eye.to_world"] = mi.Transform4f().look_at([0, y, 0.5], [0, y + 1, 0.5], [0, 0, 1])
        params.update()
        pictures += [np.array(mi.render(scene, integrator=i, seed=1, spp=2)) for i in (kept, mi.load_dict(mivol(max_depth=3)))]
        inside.append(kept.session._opened[True].needs.camera_inside)
    assert inside == [False, True]
    assert np.array_equal(pictures[0], pictures[1]) and np.array_equal(pictures[2], pictures[3])
    assert not np.array_equal(pictures[1], pictures[3])


@pytest.mark.parametrize(
    ("key", "computes"),
    [
        ("sky.data", True),
        ("floor.bsdf.reflectance.data", True),
        (INSIDE + "albedo.data", True),
        (INSIDE + "sigma_t.data", False),
    ],
)
def test_values_that_plugins_compute_are_known_by_their_sources(key: str, computes: bool) -> None:
    """Transport reads an extinction from its parameter; all else is computed anew before a gradient."""
    grids = (grid_volume("gridvolume", rough_grid(4, value).astype(np.float32), PLACE) for value in (3.0, 0.9))
    texture = {"type": "bitmap", "data": mi.TensorXf(np.full((2, 2, 3), 0.5, np.float32)), "raw": True}
    floor = {"type": "rectangle", "bsdf": {"type": "diffuse", "reflectance": texture}}
    sky = {"type": "envmap", "bitmap": mi.Bitmap(np.full((4, 8, 3), 0.5, np.float32))}
    scene = close_up({"smoke": box_of(medium("heterogeneous", *grids), PLACE), "floor": floor, "sky": sky}, res=6)
    dr.enable_grad(mi.traverse(scene)[key])
    state = SceneState.of(scene, scene.sensors()[0])
    assert [name for name, _ in state.differentiated] == [key]
    surveyed = mi.load_dict(mivol(max_depth=3)).session._survey(scene, state)
    assert surveyed.derives_from(scene, state.differentiated) is computes


def test_arrays_of_a_coloured_grid_that_is_called_follow_its_values() -> None:
    """Mitsuba pads colours to four numbers, in an array of its own. Between two updates, each tangent counts, and a gradient
    finds the values after it."""
    values = np.random.default_rng(3).uniform(0, 2, (4, 4, 4, 3)).astype(np.float32)
    grid = grid_volume("gridvolume", values, PLACE) | {"filter_type": "nearest", "raw": True}
    floor = {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([0, 0, -1.5]).scale(3)}
    scene = close_up({"smoke": box_of(medium("heterogeneous", grid, 0.7), PLACE), "floor": floor, "sky": sky(0.7)}, res=6)
    params, key, integrator = mi.traverse(scene), INSIDE + "sigma_t.data", mi.load_dict(mivol(max_depth=3))
    value = mi.TensorXf(values)
    dr.enable_grad(value)
    params[key] = value
    params.update()
    tangents = []
    for factor in (1, -2):
        dr.set_grad(value, factor * mi.TensorXf(values))
        tangents.append(np.array(integrator.render_forward(scene, params, seed=1, spp=4)))
    np.testing.assert_array_equal(tangents[1], -2 * tangents[0])
    dr.set_grad(value, 0)
    dr.backward(dr.sum(mi.render(scene, params, integrator=integrator, seed=2, seed_grad=1, spp=4)))
    # The same paths; some 1000 float32 terms of both signs.
    assert np.sum(np.array(dr.grad(value)) * values) == pytest.approx(np.sum(tangents[0], dtype=np.float64), rel=1e-3)



def test_what_a_recording_does_not_follow_is_recorded_anew() -> None:
    """A refractive index is a number in the kernels of Mitsuba's glass."""
    pair = Pair(smoke_under(sky=sky(0.7), pane={"type": "rectangle", "bsdf": {"type": "thindielectric"}}), 3)
    pair.assert_same(1)
    before = pair.images(1)[0]
    pair.params["pane.bsdf.eta"] = 2.0
    pair.params.update()
    pair.assert_same(1)
    assert not np.array_equal(pair.images(1)[0], before)


@pytest.mark.parametrize("kind", ["heterogeneous", pytest.param("homogeneous", marks=pytest.mark.slow)])
def test_the_scale_of_a_stock_medium_is_followed(kind: str) -> None:
    """A number in Mitsuba. Images and gradients to the last bit, as by an integrator that has seen no other scale."""
    make = {"heterogeneous": lambda: smoke_under(kind), "homogeneous": lambda: fog_in({"type": "cube"})}
    pair, counts, sums = Pair(make[kind](), 4), [], set()
    for scale in (1.0, 1.1, 1.2, 1.0, 1.3, 1.15, 1.25, 1.05):
        pair.params[INSIDE + "scale"] = scale
        pair.params.update()
        pair.assert_same(0)
        fresh = mi.load_dict(mivol(max_depth=4))
        image = np.array(mi.render(pair.scene, integrator=fresh, seed=0, spp=2))
        assert np.array_equal(pair.images(0)[0], image)
        gradients = [pair.gradient(one, INSIDE + "albedo.value.value", 1) for one in (pair.recorded, fresh)]
        assert np.array_equal(*gradients) and gradients[0] != 0
        counts.append(pair.recordings.count)
        sums.add(image.sum())
    # A scale of 1 is a literal, so it has a recording of its own.
    assert len(sums) == 7 and counts[5] == counts[7] and not any(pair.recordings.failures.values())


def look_from(x: float) -> mi.AffineTransform4f:
    return mi.AffineTransform4f().look_at([x, -2, 3], [0, 0, 0], [0, 0, 1])


MOVES: dict[str, tuple[Callable[[], mi.Scene], int, str, Callable[[float], object]]] = {
    "two lamps": (
        lambda: smoke_under(lamp=point((0.2, 0.1, 2.0))[0], other=point((0.2, 0.1, 2.0))[0]),
        3,
        "other.position",
        lambda x: mi.Point3f(x, 0.1, 2.0),
    ),
    "spot": (lit_by_maps, 3, "spot.to_world", look_from),
    "map": (lit_by_maps, 3, "sky.to_world", look_from),
    "sun": (lambda: smoke_under(sun=sun([0.3, 0.2, -1.0])[0]), 2, "sun.to_world", look_from),
}
"""A scene, its depth, a parameter, and values of the parameter."""


@pytest.mark.parametrize("name", cases(MOVES, slow=("map",)))
def test_the_place_of_an_emitter_is_followed(name: str) -> None:
    """To the last bit. Two lamps begin at one place."""
    make, depth, key, at = MOVES[name]
    pair, sums = Pair(make(), depth), set()
    pair.assert_same(0)
    for x in (1.0, 1.2, 1.4, 0.9):
        pair.params[key] = at(x)
        pair.params.update()
        pair.assert_same(0)
        sums.add(pair.images(0)[0].sum())
        if x == 1.2:
            count = pair.recordings.count
    assert len(sums) == 4 and pair.recordings.count == count and not any(pair.recordings.failures.values())


@pytest.mark.parametrize("distance", ["near", "far"])
def test_the_sampling_weight_of_an_emitter_is_followed(distance: str) -> None:
    """Mitsuba keeps the weight as a number. Without samples, at a weight of 0, a lamp is black."""
    lamps = (sun([0.3, 0.2, -1.0]), sun([0.0, 1.0, -0.2])) if distance == "far" else (point((1, -1, 2)), point((-2, 0, 1)))
    pair, counts = Pair(smoke_under(first=lamps[0][0], second=lamps[1][0]), 3), []
    for call, weight in enumerate((2.0, 3.0, 0.5, 0.0, 4.0, 0.25)):
        pair.params["second.sampling_weight"] = weight
        pair.params.update()
        pair.assert_same(call)
        first = np.array(mi.render(pair.scene, integrator=mi.load_dict(mivol(max_depth=3)), seed=call, spp=2))
        assert np.array_equal(pair.images(call)[0], first)
        assert_close(pair.gradients(INSIDE + "sigma_t.data", call))
        counts.append(pair.recordings.count)
    assert counts[2] == counts[5] > 0 and not any(pair.recordings.failures.values())


def among_shapes(**more: dict) -> mi.Scene:
    """Smoke between a floor, a ball, a block and a lamp."""
    floor = {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([0, 0, -1.5]).scale(3)}
    above = mi.ScalarTransform4f().look_at([0.5, -1, 3], [0, 0, 0], [0, 1, 0]).scale(0.5)
    lamp = {"type": "rectangle", "to_world": above, "emitter": {"type": "area", "radiance": 9.0}}
    ball = {"type": "sphere", "center": [1.0, -1.5, 0.9], "radius": 0.2}
    block = {"type": "cube", "to_world": mi.ScalarTransform4f().translate([0.5, -1.6, 0.3]).scale(0.3)}
    return smoke_under(**({"floor": floor, "lamp": lamp, "ball": ball, "block": block} | more))


def fog_in(shape: dict, other: dict | None = None, **more: dict) -> mi.Scene:
    """A homogeneous medium over a floor, under a lamp."""
    floor = {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([0, 0, -1.5]).scale(3)}
    fog = shape | {"bsdf": {"type": "null"}, "interior": medium("homogeneous", 1.5, 0.8)} | more
    others = {} if other is None else {"other": other}
    return close_up({"smoke": fog, "floor": floor, "lamp": point((0.2, 0.1, 5.0))[0], **others}, res=6)


def fire_on_a_floor() -> mi.Scene:
    """Smoke that emits, over a floor."""
    return fire(floor={"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([0, 0, -1.5]).scale(3)})


def smoke_in_the_sun() -> mi.Scene:
    """Images have a table of shadows."""
    grid = medium("mivol_medium", grid_volume("mivol_voxels", rough_grid(4, 3.0).astype(np.float32), PLACE), 0.8)
    return close_up({"smoke": box_of(grid, PLACE), "sun": sun([0.3, 0.2, -1.0])[0]}, res=96)


def among_copies() -> mi.Scene:
    """Smoke beside a copy of a ball."""
    group = {"type": "shapegroup", "ball": {"type": "sphere", "radius": 0.3}}
    place = mi.ScalarTransform4f().translate([0.9, -1.4, 0.4])
    return among_shapes(group=group, copy={"type": "instance", "group": {"type": "ref", "id": "group"}, "to_world": place})


def among_curves(kind: str) -> mi.Scene:
    """Smoke behind a curve of five points, with their radii."""
    with NamedTemporaryFile("w", suffix=".txt") as file:
        file.writelines(f"{x} {-1.3 + 0.1 * x * x} {0.4 * x} 0.1\n" for x in (-1, -0.5, 0, 0.5, 1))
        file.flush()
        return among_shapes(curve={"type": kind, "filename": file.name})


MOVED_SHAPES: dict[str, tuple[Callable[[], mi.Scene], str, str]] = {
    "floor": (among_shapes, "floor.to_world", INSIDE + "sigma_t.data"),
    "lamp": (among_shapes, "lamp.to_world", INSIDE + "albedo.value.value"),
    "ball": (among_shapes, "ball.to_world", INSIDE + "sigma_t.data"),
    "block": (among_shapes, "block.vertex_positions", "lamp.emitter.radiance.value"),
    "block in the sun": (lambda: among_shapes(lamp=lit_by_map()), "block.vertex_positions", INSIDE + "sigma_t.data"),
    "box of fog": (lambda: fog_in({"type": "cube"}), "smoke.vertex_positions", INSIDE + "sigma_t.value.value"),
    "ball of fog": (lambda: fog_in({"type": "sphere"}), "smoke.to_world", INSIDE + "albedo.value.value"),
    "box of glass": (
        lambda: fog_in({"type": "cube"}, bsdf={"type": "thindielectric"}),
        "smoke.vertex_positions",
        INSIDE + "sigma_t.value.value",
    ),
    "box with a table of shadows": (smoke_in_the_sun, "smoke.vertex_positions", INSIDE + "albedo.value.value"),
    "copy": (among_copies, "copy.to_world", INSIDE + "sigma_t.data"),
    "shape of a copy": (among_copies, "group.ball.to_world", INSIDE + "sigma_t.data"),
    "curve": (lambda: among_curves("bsplinecurve"), "curve.control_points", INSIDE + "sigma_t.data"),
    "line": (lambda: among_curves("linearcurve"), "curve.control_points", INSIDE + "albedo.value.value"),
    "box that glows": (lambda: glowing_box(), "smoke.vertex_positions", INSIDE + "albedo.value.value"),
    "floor by a fire": (lambda: fire_on_a_floor(), "floor.to_world", INSIDE + "sigma_t.data"),
    "box of a fire": (lambda: fire_on_a_floor(), "smoke.vertex_positions", INSIDE + "emission_density.data"),
    "box of a grid": (smoke_under, "smoke.vertex_positions", INSIDE + "sigma_t.data"),
}
"""A scene, a parameter that places a shape, and a parameter to differentiate."""


@pytest.mark.parametrize(
    "name", cases(MOVED_SHAPES, slow=set(MOVED_SHAPES) - {"ball", "block", "box of fog", "shape of a copy"})
)
def test_the_place_of_a_shape_is_followed(name: str) -> None:
    """Images to the last bit as traced anew, the last also as by an integrator that has seen no other place; gradients to the
    rounding of their sums."""
    make, key, differentiated = MOVED_SHAPES[name]
    pair, sums = Pair(make(), 4), set()
    start = dr.detach(pair.params[key])
    for x in (0.0, 0.05, 0.1, 0.12, 0.03):
        place_shape(pair, key, start, x)
        image, traced = pair.images(0)
        assert np.array_equal(image, traced)
        found, truth = pair.gradients(differentiated, 1)
        assert np.abs(found - truth).max() <= (200 if truth.size > 3 else 432) * 2**-24 * np.abs(truth).max() > 0
        sums.add(image.sum())
    unprepared = np.array(mi.render(pair.scene, integrator=mi.load_dict(mivol(max_depth=4)), seed=0, spp=2))
    assert np.array_equal(image, unprepared)
    assert len(sums) == 5 and not any(pair.recordings.failures.values())


@pytest.mark.parametrize("name", cases(MOVED_SHAPES, slow=set(MOVED_SHAPES) - {"block", "ball of fog", "copy"}))
def test_shapes_move_without_another_recording(name: str) -> None:
    """After some places, in which numbers become arrays and arrays of one memory are joined."""
    make, key, differentiated = MOVED_SHAPES[name]
    pair, counts = Pair(make(), 3), []
    start = dr.detach(pair.params[key])
    for sixteenths in (0, 0.75, 1.5, 2, 0.5, 1, 0.25, 1.25, 1.75, 2.25, 2.5, 2.75):
        # Sums are exact, so that boxes are equal, or not, whatever the processor rounds.
        place_shape(pair, key, start, sixteenths / 16)
        pair.gradient(pair.recorded, differentiated, 1)
        counts.append(pair.recordings.count)
    assert counts[7] == counts[11] > 0 and not any(pair.recordings.failures.values())


def place_shape(pair: Pair, key: str, start: object, x: float) -> None:
    """Move a shape from its first place."""
    pair.params[key] = start + x if dr.is_array_v(start) else mi.AffineTransform4f().translate([x, x, x]) @ start
    pair.params.update()


def test_a_shape_of_a_copy_moves_out_of_its_box() -> None:
    """Mitsuba keeps the box of the copy. The picture is the one of a scene that was loaded with the shape in its last place."""
    images = []
    for start in (0.0, 1.0):
        ball = {"type": "sphere", "radius": 0.3, "center": [0, 0, start]}
        copy = {"type": "instance", "group": {"type": "ref", "id": "group"}}
        place = mi.ScalarTransform4f().translate([0.9, -1.4, -0.6])
        parts = {"group": {"type": "shapegroup", "ball": ball}, "copy": copy | {"to_world": place}}
        pair = Pair(smoke_under(sky=sky(0.7), **parts), 3)
        pair.assert_same(1)
        pair.params["group.ball.to_world"] = mi.AffineTransform4f().translate([0, 0, 1]).scale(0.3)
        pair.params.update()
        pair.assert_same(1)
        images.append(pair.images(1)[0])
    assert np.array_equal(*images)


def test_a_curve_bends_inside_of_its_bounds() -> None:
    pair, sums = Pair(among_curves("linearcurve"), 3), set()
    # Embree reads points of curves as packets, so they must lie at addresses that Dr.Jit chooses, not NumPy.
    start, middle = dr.detach(pair.params["curve.control_points"]), mi.Float(np.arange(20) == 3 * 4 + 2)
    for z in (0.0, 0.1, 0.15, -0.1):
        pair.params["curve.control_points"] = start + z * middle
        pair.params.update()
        truth = mi.render(pair.scene, integrator=mi.load_dict(mivol(max_depth=3)), seed=1, spp=2)
        assert np.array_equal(pair.images(1)[0], np.array(truth))
        sums.add(pair.images(1)[0].sum())
    assert len(sums) == 4


def chequered_floor() -> mi.Scene:
    """Smoke over a floor with colours that turn with it; half a turn keeps its bounding box."""
    colours = np.random.default_rng(2).uniform(0.1, 0.9, (4, 4, 3)).astype(np.float32)
    texture = {"type": "bitmap", "data": mi.TensorXf(colours), "raw": True, "filter_type": "nearest"}
    place = mi.ScalarTransform4f().translate([0, 0, -1.5]).scale(3)
    return among_shapes(floor={"type": "rectangle", "to_world": place, "bsdf": {"type": "diffuse", "reflectance": texture}})


def glowing_box() -> mi.Scene:
    """A box of constants, whose light paths draw, over a floor."""
    glow = medium("mivol_medium", 1.0, 0.5) | {"emission": {"type": "constvolume", "value": 40.0}}
    floor = {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([0, 0, -1.5]).scale(3)}
    return close_up({"smoke": box_of(glow, np.diag([0.5, 0.5, 0.5, 1.0])), "floor": floor}, res=6)


def inside_a_ball() -> mi.Scene:
    """A ball around everything is black inside, unless its normals are flipped."""
    return smoke_under(lamp=point((0.2, 0.1, 2.0))[0], ball={"type": "sphere", "radius": 6})


PLACED_ANEW: dict[str, tuple[Callable[[], mi.Scene], str, str, list]] = {
    "half a turn": (chequered_floor, "floor.to_world", "scale", [(1,), ([-1, -1, 1],)]),
    "mirrored": (inside_a_ball, "ball.to_world", "scale", [(1,), (0.9,), (0.95,), (0.85,), ([-1, 1, 1],)]),
    "lamp in smoke": (among_shapes, "lamp.to_world", "translate", [([-0.5, 1, z],) for z in (0, -2.9, -0.1)]),
    "tilted": (
        lambda: fog_in({"type": "cube"}),
        "smoke.vertex_positions",
        "rotate",
        [([0, 0, 1], angle) for angle in (0.0, 20.0, 21.0, 0.0)],
    ),
    "glow": (glowing_box, "smoke.vertex_positions", "translate", [([x, 0, 0],) for x in (0, 0.1, 0.2)]),
    "balls apart": (
        lambda: among_shapes(other={"type": "sphere", "center": [1.0, -1.5, 0.9], "radius": 0.2}),
        "other.to_world",
        "translate",
        [([x, 0, x],) for x in (0, 0.3, 0.5, 0)],
    ),
    "flat table of shadows": (
        smoke_in_the_sun,
        "smoke.vertex_positions",
        "scale",
        [([1, 1, z],) for z in (1, 0.9, 0.5, 0.49)],
    ),
}
"""A scene, a parameter that places a shape, and maps of its first place. They change more than the place."""


@pytest.mark.parametrize("name", cases(PLACED_ANEW, slow=("lamp in smoke", "balls apart")))
def test_a_place_that_changes_more_is_met_as_if_it_were_the_first(name: str) -> None:
    """To the last bit: by integrators that have and have not seen the other places."""
    make, key, kind, given = PLACED_ANEW[name]
    pair, sums = Pair(make(), 3), set()
    start = dr.detach(pair.params[key])
    for numbers in given:
        move = getattr(mi.AffineTransform4f(), kind)(*numbers)
        if key.endswith("vertex_positions"):
            pair.params[key] = dr.ravel(move @ dr.unravel(mi.Point3f, start))
        else:
            pair.params[key] = move @ start
        pair.params.update()
        truth = np.array(mi.render(pair.scene, integrator=mi.load_dict(mivol(max_depth=3)), seed=1, spp=2))
        for _ in range(2):
            assert np.array_equal(pair.images(1)[0], truth)
        sums.add(truth.sum())
    assert len(sums) > 1


def test_a_gradient_at_an_earlier_place_follows_an_image_elsewhere() -> None:
    """The arrays of the earlier place are put back beside another albedo: only the last image was made elsewhere."""
    scene, key = among_shapes(), INSIDE + "albedo.value.value"
    params, integrator, found = mi.traverse(scene), mi.load_dict(mivol(max_depth=3)), []
    here = dr.detach(params["floor.to_world"])
    there = mi.AffineTransform4f().translate([0, 0, -1]) @ here
    dr.make_opaque(here, there)
    adjoint = dr.ones(mi.TensorXf, (6, 6, 3))
    fresh = mi.load_dict(mivol(max_depth=3))
    for place, one, albedo in ((here, integrator, 0.8), (there, integrator, 0.8), (here, integrator, 0.7), (here, fresh, 0.7)):
        params["floor.to_world"], params[key] = place, mi.Float(albedo)
        params.update()
        dr.enable_grad(params[key])
        if place is here:
            one.render_backward(scene, params, adjoint, seed=4, spp=2)
            found.append(float(dr.grad(params[key])[0]))
        else:
            one.render(scene, seed=1, spp=2)
    assert found[1] == found[2] != 0


def test_a_boundary_that_moves_into_another_is_refused() -> None:
    """Both are traced, so that nothing but their places changes."""
    ball, glass = {"type": "sphere", "radius": 0.5}, {"type": "thindielectric"}
    fog = medium("homogeneous", 1.0, 0.5)
    pair = Pair(fog_in(ball, bsdf=glass, other=ball | {"center": [3, 0, 0], "bsdf": glass, "interior": fog}), 3)
    pair.assert_same(1)
    start = dr.detach(pair.params["other.to_world"])
    for x, is_apart in ((-1.9, True), (-2.5, False)):
        pair.params["other.to_world"] = mi.AffineTransform4f().translate([x, 0, 0]) @ start
        pair.params.update()
        with contextlib.nullcontext() if is_apart else refused("smoke and other overlap"):
            pair.assert_same(1)


def test_a_lamp_that_moves_into_the_smoke_is_planned_anew() -> None:
    pair, found = Pair(smoke_under(lamp=point((0.1, 0.1, 9.0))[0]), 3), []
    for z in (9.0, 8.0, 0.1, 0.2, 8.0):
        pair.params["lamp.position"] = mi.Point3f(0.1, 0.1, z)
        pair.params.update()
        truth = mi.render(pair.scene, integrator=mi.load_dict(mivol(max_depth=3)), seed=1, spp=2)
        assert np.array_equal(np.array(truth), pair.images(1)[0])
        found.append(pair.recorded.session._opened[True].plan.draws_near_light)
    assert found == [False, False, True, True, False]


def test_a_bad_value_is_refused_after_good_ones() -> None:
    """A kept plan holds for the values that it was made for."""
    pair = Pair(smoke_under("heterogeneous"), 3)
    pair.assert_same(1)
    values = np.array(pair.params[INSIDE + "albedo.value.value"]) * 2
    pair.params[INSIDE + "albedo.value.value"] = mi.Float(values)
    pair.params.update()
    with scenes.refused("the albedo of the medium in smoke lies in"):
        pair.images(1)


@pytest.mark.filterwarnings("ignore:.*values of sigma_t.* are below 0:RuntimeWarning")
def test_negative_voxels_count_as_zero_in_a_recording() -> None:
    pair = Pair(smoke_under(), 1)
    values = np.array(pair.params[INSIDE + "sigma_t.data"])
    for part in (values - 2.0, values - 2.5, values):
        images = []
        for grid in (part, np.maximum(part, 0)):
            pair.params[INSIDE + "sigma_t.data"] = mi.TensorXf(grid)
            pair.params.update()
            images += pair.images(1)
        assert all(np.array_equal(image, images[-1]) for image in images)


def test_a_replay_launches_few_kernels() -> None:
    """At depth 6: kernels, copies and fills of an image, and of a gradient with its image and two updates.

    With two threads, Dr.Jit fills, copies and sums an array of each thread for each scatter of sums.
    """
    pair = Pair(smoke_under(), 6)
    set_thread_count(2)
    key = INSIDE + "sigma_t.data"
    for _ in range(3):
        pair.images(1), pair.gradient(pair.recorded, key, 1)
    image = lambda: dr.eval(mi.render(pair.scene, integrator=pair.recorded, seed=2, spp=2))  # noqa: E731
    assert count_launches(image) <= 14
    assert count_launches(lambda: pair.gradient(pair.recorded, key, 2)) <= 77

    def step() -> None:
        pair.scale(key, 0.99), pair.gradient(pair.recorded, key, 2)

    # A changed grid is read again: its update, one kernel for the extremes of its blocks, and their table.
    assert count_launches(step) <= 89


def test_a_changed_grid_is_read_without_tracing(monkeypatch: pytest.MonkeyPatch) -> None:
    """The distances to occupied blocks are those of the grid of each step, and nothing is traced after the first step."""
    pair, traced = Pair(smoke_under(), 2), []
    find = readings.find_extremes
    monkeypatch.setattr(readings, "find_extremes", lambda *given: traced.append(1) or find(*given))
    shape = pair.params[INSIDE + "sigma_t.data"].shape
    for k, corner in enumerate(((0, 0, 0), (0, 0, -1), (0, -1, 0))):
        grid = np.zeros(shape, np.float32)
        grid[corner] = 2.0 + k
        # Dr.Jit records anew for memory of NumPy at another alignment.
        pair.params[INSIDE + "sigma_t.data"] = mi.TensorXf(mi.Float(copy_aligned(grid.ravel())), shape)
        pair.params.update()
        mi.render(pair.scene, integrator=pair.recorded, seed=1, spp=1)
        survey = pair.recorded.session._surveyed.survey
        (_, found), *_ = survey.distances.values()
        assert np.array_equal(found, find_empty_distances(mi.TensorXf(grid)))
        if k == 0:
            first = len(traced), survey.recorded.count
    assert (len(traced), survey.recorded.count) == first and first[0] > 0


def test_a_changed_grid_keeps_its_plan(monkeypatch: pytest.MonkeyPatch) -> None:
    """Until a fact of the plan changes. Images and gradients are those of an integrator that has seen nothing before."""
    scene, planned = smoke_under(sun=sun([0.3, 0.2, -1.0])[0]), []
    params, key, kept = mi.traverse(scene), INSIDE + "sigma_t.data", mi.load_dict(mivol(max_depth=4))
    find_needs, make_plan = session.find_needs, session.make_plan
    monkeypatch.setattr(session, "find_needs", lambda *given: [planned.append("facts"), find_needs(*given)][1])
    monkeypatch.setattr(session, "make_plan", lambda *given: [planned.append("plan"), make_plan(*given)][1])
    set_thread_count(1)
    grid = np.array(params[key])
    sparse = np.where(np.arange(grid.size).reshape(grid.shape) < 2, 3.0, 0.0)
    for values, plans in ((grid, 2), (0.9 * grid, 0), (0.8 * grid, 0), (sparse, 2), (1.5 * sparse, 0)):
        found, before = [], len(planned)
        for integrator in (kept, mi.load_dict(mivol(max_depth=4))):
            params[key] = mi.TensorXf(values.astype(np.float32))
            params.update()
            dr.enable_grad(params[key])
            image = mi.render(scene, params, integrator=integrator, seed=1, spp=2)
            dr.backward(dr.mean(image, axis=None))
            found.append((np.array(image), np.array(dr.grad(params[key]))))
            if integrator is kept:
                assert planned[before:].count("plan") == plans and planned[before:].count("facts") == min(plans, 1)
        for one, other in zip(*found, strict=True):
            assert np.array_equal(one, other) and np.abs(one).max() > 0


def test_a_new_light_of_media_is_planned_anew() -> None:
    """The table of the light is made from the values."""
    scene, kept, key = fire(), mi.load_dict(mivol(max_depth=3)), INSIDE + "emission_density.data"
    params, tables = mi.traverse(scene), []
    for values in (np.array(params[key]), np.array(params[key])[::-1]):
        params[key] = mi.TensorXf(np.ascontiguousarray(values))
        params.update()
        for integrator in (kept, mi.load_dict(mivol(max_depth=3))):
            mi.render(scene, integrator=integrator, seed=1, spp=2)
            tables.append(np.array(integrator.session._opened[True].arrays.light[0]))
    assert np.array_equal(tables[0], tables[1]) and np.array_equal(tables[2], tables[3])
    assert not np.array_equal(tables[1], tables[2])


def test_a_light_whose_predicted_gain_grows_is_planned_anew(monkeypatch: pytest.MonkeyPatch) -> None:
    gains = iter((0.5, 2.0))
    monkeypatch.setattr(media_light, "predict_gain", lambda *_: next(gains))
    scene, integrator, draws = glowing_box(), mi.load_dict(mivol(max_depth=3)), []
    params = mi.traverse(scene)
    corners = dr.detach(params["smoke.vertex_positions"])
    for growth in (1, 0.7):
        params["smoke.vertex_positions"] = corners * growth
        params.update()
        mi.render(scene, integrator=integrator, seed=1, spp=2)
        draws.append(integrator.session._opened[True].plan.draws_emission)
    assert draws == [False, True]


def test_the_gain_of_a_light_that_hardly_changes_is_predicted_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """A tenth of the light, or of the edge of the box, may move."""
    scene, integrator, key = fire_on_a_floor(), mi.load_dict(mivol(max_depth=3)), INSIDE + "emission_density.data"
    params, calls, predict = mi.traverse(scene), [], media_light.predict_gain
    monkeypatch.setattr(media_light, "predict_gain", lambda *given: calls.append(1) or predict(*given))
    values, corners, counts = np.array(params[key]), dr.detach(params["smoke.vertex_positions"]), []
    half = values * np.linspace(1, 0, len(values), dtype=np.float32)[:, None, None, None]
    for light, growth in ((values, 1), (0.7 * values, 1), (half, 1), (half, 0.98), (half, 0.7)):
        params[key], params["smoke.vertex_positions"] = mi.TensorXf(light), corners * growth
        params.update()
        mi.render(scene, integrator=integrator, seed=1, spp=2)
        counts.append(len(calls))
    assert counts == [1, 1, 2, 2, 3]


# -- What is traced ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("order", ["image, gradient", "image, image, gradient"])
def test_an_image_and_a_gradient_are_recorded_once_in_any_order(order: str) -> None:
    """What was rendered before leaves an image on the film, and numbers in the sampler."""
    scene = smoke_under()
    params, integrator, key = mi.traverse(scene), mi.load_dict(mivol(max_depth=4)), INSIDE + "albedo.value.value"
    mi.load_dict({"type": "volpath", "max_depth": 2}).render(scene, seed=0, spp=1)
    for step in range(3):
        params[key] = mi.Float(0.8 - 0.1 * step)
        params.update()
        dr.enable_grad(params[key])
        for task in order.split(", "):
            if task == "image":
                integrator.render(scene, seed=step, spp=2)
            else:
                integrator.render_backward(scene, params, dr.ones(mi.TensorXf, (6, 6, 3)), seed=step, spp=2)
        assert integrator.session.recordings.count == 2


LENSES = {
    "perspective": [{"fov": 30.0}, {"fov": 31.0, "near_clip": 0.5}, {"fov": 32.0, "principal_point_offset_x": 0.1}],
    "orthographic": [{}, {"near_clip": 0.5}, {"far_clip": 4.0}],
    "thinlens": [
        {"fov": 30.0, "aperture_radius": 0.3, "focus_distance": 4.0},
        {"fov": 31.0, "aperture_radius": 0.1, "focus_distance": 3.0, "near_clip": 0.5},
        {"fov": 32.0, "aperture_radius": 0.3, "focus_distance": 3.0, "far_clip": 4.0},
    ],
}


@pytest.mark.parametrize("kind", LENSES)
def test_the_cameras_of_a_scene_are_recorded_once(kind: str) -> None:
    """Another camera takes their place: images to the last bit, and each on the film of its own camera."""
    angles = (0.0, 1.0, 2.0)
    eyes = [camera((4 * np.sin(a), -4 * np.cos(a), 1.0), (0.0, 0.0, 0.0), res=6) for a in angles]
    for eye, lens in zip(eyes, LENSES[kind], strict=True):
        eye.pop("fov")
        eye |= {"type": kind, "shutter_close": 0.0 if kind == "perspective" else 0.3, **lens}
    pair = Pair(smoke_under(**{"sky": sky(0.7)} | {f"eye{k}": eye for k, eye in enumerate(eyes)}), 3)
    cameras = pair.scene.sensors()
    assert len(cameras) == 4
    for seed in range(2):
        # The last camera is a perspective one.
        for number in (0, 1, 3, 2, 1) if kind == "perspective" else (0, 1, 2, 1):
            pair.assert_same(seed, sensor=number)
            recorded = np.array(mi.render(pair.scene, integrator=pair.recorded, sensor=number, seed=9, spp=2))
            np.testing.assert_array_equal(np.array(cameras[number].film().develop()), recorded)
    assert pair.recordings.count == 1


@pytest.mark.parametrize("kind", cases(LENSES, slow=("thinlens",)))
def test_a_new_camera_in_each_step_is_not_recorded(kind: str) -> None:
    """Nor held: its parts may be freed, and leave their places in memory to the next."""
    pair, counts, eyes = Pair(smoke_under(sky=sky(0.7)), 3), [], []
    for call in range(8):
        eye = camera((4 * np.sin(call), -4 * np.cos(call), 1.0), (0.0, 0.0, 0.0), res=6)
        eye.pop("fov")
        sensor = mi.load_dict(eye | {"type": kind, **LENSES[kind][0]})
        pair.assert_same(call, sensor=sensor)
        counts.append(pair.recordings.count)
        eyes = [*eyes[:2], sensor]
    assert counts[4] == counts[7] > 0
    assert sys.getrefcount(eyes[0]) == sys.getrefcount(object()) + 1


@pytest.mark.slow
def test_cameras_of_two_kinds_in_turns_keep_their_recordings() -> None:
    """A number of the floor becomes an array on the way: it has not moved for either camera."""
    floor = {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([0, 0, -1.2]).scale(4)}
    lens = camera((2, -2, 1), (0, 0, 0), res=6) | {"type": "thinlens", "aperture_radius": 0.1, "focus_distance": 3.0}
    pair, counts = Pair(smoke_under(sky=sky(0.7), floor=floor, lens=lens), 3), []
    for call in range(14):
        pair.assert_same(call, sensor=call % 2)
        counts.append(pair.recordings.count)
    assert counts == sorted(counts) and counts[9] == counts[13] > 0


def test_two_scenes_in_turns_keep_their_recordings() -> None:
    """Also if the image of the other comes before the gradient. A third scene frees them."""
    one, other = (Pair(fog_in({"type": "sphere"}), 3) for _ in range(2))
    other.recorded, key, counts = one.recorded, INSIDE + "sigma_t.value.value", []
    other.scale(key, 2.0)
    for call in range(8):
        for pair in (one, other):
            pair.scale(key, 0.95)
            pair.assert_same(call)
        with one.differentiated(key) as value:
            loss = dr.mean(mi.render(one.scene, one.params, integrator=one.recorded, seed=call, spp=2), axis=None)
            other.assert_same(call + 1)
            dr.backward(loss)
            found = np.array(dr.ravel(dr.grad(value)))
        truth = one.gradient(one.traced, key, call)
        assert np.abs(found - truth).max() <= 432 * 2**-24 * np.abs(truth).max() > 0
        counts.append(one.recordings.count)
    assert counts[4] == counts[7] > 3
    mi.render(lamp_in_fog(), integrator=one.recorded, spp=2)
    assert one.recordings.count < counts[7]


@pytest.mark.parametrize("kind", LENSES)
def test_a_stand_in_has_the_rays_of_the_given_camera(kind: str) -> None:
    """To the last bit, on a cropped film."""
    crop = {"width": 8, "height": 6, "crop_width": 4, "crop_height": 3, "crop_offset_x": 1, "crop_offset_y": 2}
    to_world = mi.ScalarTransform4f().look_at([3, -4, 1], [0.2, 0.1, 0], [0, 0, 1])
    for number, lens in enumerate(LENSES[kind]):
        sensor = mi.load_dict({"type": kind, "to_world": to_world, "film": {"type": "hdrfilm", **crop}, **lens})
        stand_in = StandIn.find(sensor, describe_kind(sensor))
        stand_in.show(sensor, [number])
        numbers = mi.Point2f(0.1, [0.2, 0.7]), mi.Point2f([0.9, 0.3], 0.4)
        (found, weight), (truth, its_weight) = (
            one.sample_ray_differential(mi.Float(0.5), mi.Float(0), *numbers) for one in (stand_in.camera, sensor)
        )
        for name in ("o", "d", "maxt", "time"):
            np.testing.assert_array_equal(np.array(getattr(found, name)), np.array(getattr(truth, name)), name)
        np.testing.assert_array_equal(np.array(weight), np.array(its_weight))


def screen_with_meter() -> dict:
    """A square that faces the smoke and measures the light on it, under a lamp with a size: lamps have rays of their own."""
    place = mi.ScalarTransform4f().translate([0, -1.5, 0]).rotate([1, 0, 0], -90)
    film = {"type": "hdrfilm", "width": 2, "height": 1, "rfilter": {"type": "box"}}
    lamp = {"type": "sphere", "center": [0.3, 1.2, 1.0], "radius": 0.3, "emitter": {"type": "area", "radiance": 3.0}}
    meter = {"type": "irradiancemeter", "film": film}
    return {"screen": {"type": "rectangle", "to_world": place, "meter": meter}, "lamp": lamp}


def single_pixel(kind: str, **more: object) -> dict:
    film = {"type": "hdrfilm", "width": 1, "height": 1, "rfilter": {"type": "box"}}
    return {"meter": {"type": kind, "film": film, **more}}


def views_of_two_kinds() -> dict:
    place = mi.ScalarTransform4f().look_at([1, -3, 1], [0, 0, 0], [0, 0, 1])
    film = {"type": "hdrfilm", "width": 4, "height": 4}
    view = {"to_world": place, "film": film}
    first, second = {"type": "perspective", **view}, {"type": "orthographic", **view}
    return {"type": "batch", "first": first, "second": second, "film": film | {"width": 8}}


METERS: dict[str, Callable[[], dict]] = {
    "radiance meter": lambda: single_pixel("radiancemeter", origin=[0, -3, 0], direction=[0.1, 1, 0.1]),
    "distant": lambda: single_pixel("distant", direction=[0.1, 1, 0.1]),
    "irradiance meter": screen_with_meter,
    "batch": lambda: {"meter": views_of_two_kinds()},
}
"""Sensors whose arrays Mitsuba hides."""


@pytest.mark.parametrize("name", cases(METERS, slow=("distant",)))
def test_a_sensor_whose_arrays_are_hidden_is_recorded(name: str) -> None:
    """Its rays are an input: images to the last bit, gradients but for the rounding of their sums."""
    pair, counts = Pair(smoke_under(sky=sky(0.7), **METERS[name]()), 3), []
    sensor = next(one for one in pair.scene.sensors() if one.class_name() != "PerspectiveCamera")
    show = partial(mi.render, pair.scene, pair.params, sensor=sensor, spp=6)
    for call in range(6):
        pair.scale(INSIDE + "sigma_t.data", 0.9)
        pair.scale("sky.radiance.value", 1.1)
        found, truth = (np.array(show(integrator=one, seed=call)) for one in (pair.recorded, pair.traced))
        assert np.array_equal(found, truth) and truth.max() > 0
        gradients = []
        for integrator in (pair.recorded, pair.traced):
            with pair.differentiated(INSIDE + "sigma_t.data") as value:
                dr.backward(dr.mean(show(integrator=integrator, seed=call), axis=None))
                gradients.append(np.array(dr.ravel(dr.grad(value))))
        assert_close(gradients)
        counts.append(pair.recordings.count)
    assert counts[2] == counts[5] > 0 and not any(pair.recordings.failures.values())


def test_a_batch_samples_rays_beside_a_stand_in_of_a_meter() -> None:
    """Mitsuba's ``batch`` calls all sensors of the process in one function, stand-ins among them."""
    meter = mi.load_dict(METERS["radiance meter"]()["meter"])
    stand_in = StandIn(meter)
    batch = mi.load_dict(views_of_two_kinds())
    for sample in (batch.sample_ray, batch.sample_ray_differential):
        ray, _ = sample(0.0, 0.5, mi.Point2f([0.25, 0.75], [0.5, 0.5]), mi.Point2f(0.5))
        # The middle of either film looks along its camera.
        np.testing.assert_allclose(np.array(ray.d), np.array([-1, 3, -1])[:, None] / np.sqrt(11) * [1, 1], atol=1e-6)
    assert stand_in.takes_rays


def test_a_turn_to_another_camera_launches_nothing_more() -> None:
    """An update of Mitsuba's camera makes 115 launches, and waits for each of 79 numbers."""
    angles = (0.0, 1.0, 2.0)
    eyes = [camera((4 * np.sin(a), -4 * np.cos(a), 1.0), (0.0, 0.0, 0.0), res=6, fov=30.0) for a in angles]
    scene = smoke_under(**{"sky": sky(0.7)} | {f"eye{k}": eye for k, eye in enumerate(eyes)})
    integrator, cameras = mi.load_dict(mivol(max_depth=3)), scene.sensors()[:3]
    show = lambda k: dr.eval(mi.render(scene, sensor=cameras[k], integrator=integrator, seed=2, spp=2))  # noqa: E731
    for k in (0, 1, 2, 2):
        show(k)
    again = count_launches(lambda: show(2))
    # Two facts of a plan are computed for each camera.
    assert count_launches(lambda: show(0)) <= again + 2


@pytest.mark.parametrize("pixel_format", FORMATS.values())
def test_a_stand_in_has_a_film_like_the_given_one(pixel_format: str) -> None:
    film = {"type": "hdrfilm", "width": 1, "height": 1}
    views = {f"view{k}": {"type": kind, "film": film} for k, kind in enumerate(("perspective", "orthographic"))}
    assert describe_kind(mi.load_dict({"type": "batch", **views, "film": film | {"width": 2}})) is not None
    # Dr.Jit finds all arrays of this batch.
    assert describe_kind(mi.load_dict({"type": "batch", "view": views["view0"], "film": film})) is None
    size = {"width": 8, "height": 6, "crop_width": 4, "crop_height": 3, "crop_offset_x": 1, "crop_offset_y": 2}
    film = {"type": "hdrfilm", "rfilter": {"type": "mitchell"}, "sample_border": True, "pixel_format": pixel_format, **size}
    sensor = mi.load_dict({"type": "perspective", "film": film, "sampler": {"type": "independent", "sample_count": 3}})
    kind = describe_kind(sensor)
    stand_in = StandIn.find(sensor, kind)
    assert describe_kind(stand_in.camera) == kind
    assert StandIn.find(sensor, kind) is stand_in and stand_in.camera.film().ptr != sensor.film().ptr


@pytest.mark.parametrize(("albedo", "between", "readings"), [(0.8, False, 1), (0.8, True, 2), (0.0, False, 2)])
def test_derivatives_take_the_facts_of_their_image(
    monkeypatch: pytest.MonkeyPatch, albedo: float, between: bool, readings: int
) -> None:
    """Not if a value changed in between; and a medium without scattering may scatter, for a derivative by its albedo."""
    scene, found, count = smoke_under(), [], []
    params, key = mi.traverse(scene), INSIDE + "albedo.value.value"
    find_needs = session.find_needs
    monkeypatch.setattr(session, "find_needs", lambda *given: [count.append(1), find_needs(*given)][1])
    for renders in (True, False):
        integrator = mi.load_dict(mivol(max_depth=4))
        params[key] = mi.Float(albedo)
        params.update()
        dr.enable_grad(params[key])
        if renders:
            integrator.render(scene, seed=3, spp=2)
        if between:
            params[key] = mi.Float(albedo / 2)
            params.update()
            dr.enable_grad(params[key])
        adjoint = mi.TensorXf(np.linspace(0, 1, 108, dtype=np.float32).reshape(6, 6, 3))
        integrator.render_backward(scene, params, adjoint, seed=4, spp=2)
        found.append(float(dr.grad(params[key])[0]))
        if renders:
            assert len(count) == readings
    assert found[0] != 0
    # Sums of some hundred float32 numbers of one sign, in another order.
    assert found[0] == pytest.approx(found[1], rel=1e-5)


def test_what_cannot_be_recorded_is_named() -> None:
    scene = smoke_under("heterogeneous", phase={"type": "hg", "g": 0.4})
    assert find_hidden_arrays(scene, scene.sensors()[0]) is None
    film = {"type": "hdrfilm", "width": 4, "height": 4}
    lens = {"type": "thinlens", "aperture_radius": 0.1, "focus_distance": 4.0, "film": film}
    assert find_hidden_arrays(scene, mi.load_dict(lens)) is None
    spread = mi.load_dict({**lens, "sampler": {"type": "multijitter"}})
    sentence = "the sensor is a ThinLensCamera with a sampler of the kind MultijitterSampler"
    assert find_hidden_arrays(scene, spread) == sentence
    beam = pencil((0, -4, 0), (0, 1, 0))
    assert find_hidden_arrays(scene, mi.load_dict(batch_of(beam))) is None
    inside = mi.load_dict(beam | {"medium": {"type": "homogeneous"}})
    assert find_hidden_arrays(scene, inside) == "the sensor is a RadianceMeter in a medium"
    for phase in (blend_of_blends(), microflakes()):
        known = smoke_under(phase=phase, other=box_of(medium("homogeneous", 1.0, 0.5, phase={"type": "rayleigh"}), PLACE))
        assert find_hidden_arrays(known, known.sensors()[0]) is None
    lobe = {"type": "hg"}
    for phase, kind in (
        ({"type": "mivol_mixture", "a": blend_of_blends(), "b": lobe}, "BlendPhaseFunction"),
        ({"type": "blendphase", "weight": 0.5, "a": microflakes(2), "b": lobe}, "SGGXPhaseFunction"),
    ):
        hidden = smoke_under(phase=phase)
        sentence = f"Dr.Jit cannot record a call of a {kind} (in a mixture, or with a matrix that varies in space)"
        assert find_hidden_arrays(hidden, hidden.sensors()[0]) == sentence
    params = mi.traverse(scene)
    dr.enable_grad(params[INSIDE + "sigma_t.data"])
    assert find_hidden_arrays(scene, scene.sensors()[0]) is None
    dr.enable_grad(params[INSIDE + "phase_function.g"])
    assert find_hidden_arrays(scene, scene.sensors()[0]) is None
    lobed = smoke_under(phase={"type": "mivol_mixture", "a": {"type": "hg"}, "b": {"type": "isotropic"}})
    key = next(key for key in mi.traverse(lobed).properties if key.endswith(".g"))
    dr.enable_grad(mi.traverse(lobed)[key])
    assert find_hidden_arrays(lobed, lobed.sensors()[0]) == f"a recording does not follow the derivative by {key}"


GAIN = 0.5
"""Read by a plugin, as a constant of its module."""


def tilt(cosine: mi.Float) -> mi.Float:
    return GAIN * cosine


class Unseen:
    """An object that a plugin may keep."""

    gain = 0.5


def load_tilted(**attributes: object) -> tuple[mi.Scene, mi.PhaseFunction]:
    """A scene with a phase function (1 + b c gain cos) / 4 pi, as a user would write it."""

    class Tilted(mi.PhaseFunction):
        factor = 1.0

        def __init__(self, props: mi.Properties) -> None:
            super().__init__(props)
            self.m_flags = int(mi.PhaseFunctionFlags.Anisotropic)
            self.terms, self.b = {"c": [0.5]}, mi.Float(0.9)
            self.__dict__.update(attributes)

        def flags(self, index: object = None, active: mi.Bool = True) -> int:
            return self.m_flags

        def sample(
            self, ctx: object, mei: mi.MediumInteraction3f, _: mi.Float, two: mi.Point2f, active: mi.Bool = True
        ) -> tuple:
            wo = mi.warp.square_to_uniform_sphere(two)
            return wo, self.eval_pdf(ctx, mei, wo, active)[0] * 4 * dr.pi, mi.Float(1 / (4 * dr.pi))

        def eval_pdf(self, ctx: object, mei: mi.MediumInteraction3f, wo: mi.Vector3f, active: mi.Bool = True) -> tuple:
            value = 1 + self.factor * self.b * self.terms["c"][0] * tilt(-dr.dot(mei.wi, wo))
            return mi.Spectrum(value / (4 * dr.pi)), mi.Float(1 / (4 * dr.pi))

        def traverse(self, callback: mi.TraversalCallback) -> None:
            callback.put("b", self.b, mi.ParamFlags.Differentiable)

        def to_string(self) -> str:
            return "Tilted"

    mi.register_phase("test_tilted", Tilted)
    scene = smoke_under(phase={"type": "test_tilted"}, sun=sun([0.3, 0.2, -1.0])[0])
    return scene, scene.shapes()[0].interior_medium().phase_function()


def test_a_python_plugin_is_recorded_while_its_attributes_stay(monkeypatch: pytest.MonkeyPatch) -> None:
    """Arrays are followed; a number anywhere else records anew."""
    scene, phase = load_tilted()
    assert find_hidden_arrays(scene, scene.sensors()[0]) is None
    pair, pictures, counts = Pair(scene, 3), [], []

    def note() -> None:
        for call in range(2):
            pair.assert_same(call)
        pictures.append(pair.images(1)[0])
        counts.append(pair.recordings.count)

    note()
    pair.scale(INSIDE + "phase_function.b", 0.9)
    note()
    pair.scale(INSIDE + "phase_function.b", 0.9)
    note()
    phase.terms["c"][0] = 0.9
    note()
    monkeypatch.setitem(globals(), "GAIN", 0.9)
    note()
    type(phase).factor = 0.1
    note()
    assert all(not np.array_equal(one, other) for one, other in itertools.pairwise(pictures))
    assert counts[2] == counts[1] < counts[3] < counts[4] < counts[5]
    assert not any(pair.recordings.failures.values())
    found, truth = pair.gradients(INSIDE + "phase_function.b", 1)
    # As in assert_same_derivatives.
    assert np.abs(found - truth).max() <= 72 * 3 * 2 * 3 * 2**-24 * np.abs(truth).max() > 0


def test_python_plugins_of_other_kinds_are_recorded() -> None:
    """A BSDF, a texture and an emitter with a parameter each."""

    def own(base: type) -> type:
        class Own(base):
            def __init__(self, props: mi.Properties) -> None:
                super().__init__(props)
                self.value = mi.Float(0.6)
                is_emitter = isinstance(self, mi.Emitter)
                self.m_flags = +mi.EmitterFlags.DeltaPosition if is_emitter else +mi.BSDFFlags.DiffuseReflection
                self.m_components = [self.m_flags]

            def traverse(self, callback: mi.TraversalCallback) -> None:
                callback.put("value", self.value, mi.ParamFlags.Differentiable)

            def to_string(self) -> str:
                return "Own"

        return Own

    class Matte(own(mi.BSDF)):
        def sample(self, ctx: object, si: mi.SurfaceInteraction3f, _: mi.Float, two: mi.Point2f, active: mi.Bool) -> tuple:
            drawn = dr.zeros(mi.BSDFSample3f)
            drawn.wo, drawn.eta = mi.warp.square_to_cosine_hemisphere(two), 1.0
            drawn.pdf, drawn.sampled_type = mi.warp.square_to_cosine_hemisphere_pdf(drawn.wo), mi.UInt32(self.m_flags)
            return drawn, dr.select(active & (si.wi.z > 0), mi.Color3f(self.value), 0)

        def eval(self, ctx: object, si: mi.SurfaceInteraction3f, wo: mi.Vector3f, active: mi.Bool) -> mi.Color3f:
            return mi.Color3f(self.value) * self.pdf(ctx, si, wo, active)

        def pdf(self, ctx: object, si: mi.SurfaceInteraction3f, wo: mi.Vector3f, active: mi.Bool) -> mi.Float:
            return dr.select(active & (si.wi.z > 0) & (wo.z > 0), wo.z / dr.pi, 0)

        def eval_pdf(self, *given: object) -> tuple:
            return self.eval(*given), self.pdf(*given)

    class Stripes(own(mi.Texture)):
        def eval(self, si: mi.SurfaceInteraction3f, active: mi.Bool = True) -> mi.Color3f:
            return mi.Color3f(self.value * (0.5 + 0.4 * dr.sin(9 * si.uv.x)))

    class Bulb(own(mi.Emitter)):
        def sample_direction(self, it: mi.Interaction3f, sample: mi.Point2f, active: mi.Bool = True) -> tuple:
            found, place = dr.zeros(mi.DirectionSample3f, dr.width(it.p)), mi.Point3f(1, -1, 2)
            found.p, found.dist, found.d = place, dr.norm(place - it.p), dr.normalize(place - it.p)
            found.pdf, found.delta, found.emitter = mi.Float(1), mi.Bool(True), mi.EmitterPtr(self)
            return found, mi.Color3f(self.value / dr.square(found.dist))

        def eval_direction(self, it: mi.Interaction3f, found: mi.DirectionSample3f, active: mi.Bool = True) -> mi.Color3f:
            return mi.Color3f(self.value / dr.square(found.dist))

        def pdf_direction(self, it: mi.Interaction3f, found: mi.DirectionSample3f, active: mi.Bool = True) -> mi.Float:
            return mi.Float(0)

        def eval(self, si: mi.SurfaceInteraction3f, active: mi.Bool = True) -> mi.Color3f:
            return mi.Color3f(0)

        def bbox(self) -> mi.ScalarBoundingBox3f:
            return mi.ScalarBoundingBox3f(mi.ScalarPoint3f(1, -1, 2))

    mi.register_bsdf("test_matte", Matte)
    mi.register_texture("test_stripes", Stripes)
    mi.register_emitter("test_bulb", Bulb)
    turn = mi.ScalarTransform4f().translate([0, 0, -1.2]).scale(3)
    floor = {"type": "rectangle", "to_world": turn, "bsdf": {"type": "test_matte"}}
    ball = {"type": "sphere", "radius": 0.4, "bsdf": {"type": "diffuse", "reflectance": {"type": "test_stripes"}}}
    pair = Pair(smoke_under(floor=floor, ball=ball, bulb={"type": "test_bulb"}), 3)
    for call in range(2):
        for key in ("floor.bsdf.value", "ball.bsdf.reflectance.value", "bulb.value"):
            pair.scale(key, 0.9)
            pair.assert_same(call)
            found, truth = pair.gradients(key, 1)
            # As in assert_same_derivatives.
            assert np.abs(found - truth).max() <= 72 * 3 * 2 * 3 * 2**-24 * np.abs(truth).max() > 0
    assert pair.recordings.count > 0 and not any(pair.recordings.failures.values())


def test_a_python_plugin_with_a_hidden_array_is_traced() -> None:
    """Dr.Jit fails to record it, and the images are right."""
    hidden = dr.opaque(mi.Float, 0.9)

    def eval_pdf(ctx: object, mei: mi.MediumInteraction3f, wo: mi.Vector3f, active: mi.Bool = True) -> tuple:
        return mi.Spectrum((1 + hidden * dr.dot(mei.wi, wo)) / (4 * dr.pi)), mi.Float(1 / (4 * dr.pi))

    pair = Pair(load_tilted(eval_pdf=eval_pdf)[0], 3)
    for call in range(4):
        pair.assert_same(call)
    assert len(pair.recordings.failures[render_tasks.ImageTask]) == 2


def test_a_python_plugin_that_may_change_unseen_is_named() -> None:
    scene, _ = load_tilted(box=Unseen())
    sentence = "Tilted is a Python plugin that reads self.box, a Unseen, which may change unseen"
    assert find_hidden_arrays(scene, scene.sensors()[0]) == sentence

    with pytest.raises(UnfollowedStateError, match="Unseen is a Python plugin of a kind whose recordings have not been tried"):
        describe_foreign(Unseen(), ())


def test_only_back_ends_that_were_tried_record(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = smoke_under()
    monkeypatch.setattr(scene_state, "RECORDED_BACK_ENDS", ("none",))
    assert find_hidden_arrays(scene, scene.sensors()[0]) == f"recordings have not been tried with {mi.variant()}"


def test_long_renders_are_traced(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of several passes, between which Ctrl-C ends a render."""
    pair = Pair(smoke_under(), 3)
    monkeypatch.setitem(plan.PASS_RAYS, mi.variant().split("_")[0], 40)
    pair.assert_same(1)
    assert pair.recordings.count == 0


def test_derivatives_with_branches_are_recorded() -> None:
    pair = Pair(smoke_under(), 3)
    found = [pair.gradient(pair.recorded, INSIDE + "sigma_t.data", seed) for seed in (1, 2)]
    assert not np.array_equal(*found)
    assert not any(pair.recordings.failures.values())


def test_a_tangent_that_fails_is_traced(monkeypatch: pytest.MonkeyPatch) -> None:
    """The tangents of the parameters outlive the failure."""
    pair = Pair(smoke_under(), 1)
    truth = pair.tangent(pair.traced, INSIDE + "sigma_t.data", 1)
    work = render_tasks.TangentTask.__call__

    def work_and_fail(self: RecordedTask, *inputs: object) -> mi.TensorXf:
        image = work(self, *inputs)
        if is_recording():
            raise RuntimeError("as Dr.Jit says")
        return image

    monkeypatch.setattr(render_tasks.TangentTask, "__call__", work_and_fail)
    assert np.array_equal(pair.tangent(pair.recorded, INSIDE + "sigma_t.data", 1), truth) and np.abs(truth).max() > 0
    assert pair.recordings.failures[render_tasks.TangentTask] == ["as Dr.Jit says"]


def test_a_task_that_fails_is_traced_and_adds_its_gradient_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """As Dr.Jit fails: at the end, with the gradient in place."""
    pair = Pair(smoke_under(), 3)
    truth = pair.gradient(pair.traced, INSIDE + "sigma_t.data", 1)
    work, calls = render_tasks.GradientTask.__call__, []

    def work_and_fail(self: RecordedTask, *inputs: object) -> None:
        work(self, *inputs)
        calls.append(is_recording())
        if calls[-1]:
            raise RuntimeError("as Dr.Jit says")

    monkeypatch.setattr(render_tasks.GradientTask, "__call__", work_and_fail)
    for _ in range(3):
        assert np.array_equal(pair.gradient(pair.recorded, INSIDE + "sigma_t.data", 1), truth)
    # After two failures nothing is recorded any more.
    assert calls == [True, False, True, False, False]
    assert pair.recordings.failures[render_tasks.GradientTask] == ["as Dr.Jit says"] * 2


# -- Recordings -------------------------------------------------------------------------------------------------------------


class Times(RecordedTask):
    def __init__(self, factor: float) -> None:
        super().__init__()
        self.factor, self.calls = factor, 0

    def __call__(self, x: mi.Float) -> mi.Float:
        self.calls += 1
        return x * self.factor


def test_a_recording_is_kept_by_its_key_and_the_oldest_is_dropped() -> None:
    recordings, made = Recordings(2), []

    def call(key: int, x: float) -> float:
        return float(recordings.call(Times, key, lambda: made.append(Times(key)) or made[-1], dr.opaque(mi.Float, x))[0])

    assert [call(2, 5.0), call(2, 6.0), call(3, 5.0), call(2, 7.0)] == [10, 12, 15, 14]
    assert [task.factor for task in made] == [2, 3]
    assert [call(4, 1.0), call(2, 1.0), call(3, 1.0)] == [4, 2, 3]
    assert [task.factor for task in made] == [2, 3, 4, 3]
    recordings.clear()
    assert call(2, 1.0) == 2 and len(made) == 5


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="the memory of a process is read from /proc")
@pytest.mark.parametrize("other", ["scene", "integrator"])
@pytest.mark.usefixtures("shared_sessions")
def test_the_memory_of_recordings_is_freed(other: str) -> None:
    """60 scenes in a row, each of which frees the recordings of the last, an image and a gradient of about 0.4 MiB; or 60
    integrators, which share them.
    """
    scene, integrator, used = smoke_under(), mi.load_dict(mivol(max_depth=3)), []
    for call in range(60):
        if other == "scene":
            scene = smoke_under()
        elif other == "integrator":
            integrator = mi.load_dict(mivol(max_depth=3))
        params, key = mi.traverse(scene), INSIDE + "sigma_t.data"
        dr.enable_grad(params[key])
        params.update()
        dr.backward(dr.mean(mi.render(scene, params, integrator=integrator, spp=2, seed=call), axis=None))
        params[key] = dr.detach(params[key])
        params.update()
        gc.collect()
        used.append(int(re.search(r"RssAnon:\s+(\d+)", Path("/proc/self/status").read_text()).group(1)) / 1024)
    assert used[-1] - used[15] < 4


@dataclass
class Scaled:
    """An array beside a number."""

    array: mi.Float
    factor: float


def scale(one: Scaled, others: tuple[np.ndarray, dict]) -> mi.Float:
    return one.array * one.factor * float(others[0].sum()) + others[1]["shift"]


def test_a_function_follows_its_arrays_and_is_recorded_anew_for_the_rest() -> None:
    """Arrays in structures are inputs; numbers, NumPy arrays and sizes are part of what was recorded."""
    recorded = RecordedFunctions()
    calls = [(1.0, 2.0, 3.0, 4), (5.0, 2.0, 3.0, 4), (5.0, 7.0, 3.0, 4), (5.0, 7.0, 4.0, 4), (5.0, 7.0, 4.0, 6)]
    counts = []
    for value, factor, number, width in calls:
        for shift in (0.5, 1.5):
            arrays = (dr.full(mi.Float, x, width) for x in (value, shift))
            one, rest = Scaled(next(arrays), factor), (np.array([number]), {"shift": next(arrays)})
            assert np.allclose(recorded.call(scale, one, rest), value * factor * number + shift)
        counts.append(recorded.count)
    assert counts == [1, 1, 2, 3, 4]


def test_an_interrupt_ends_a_recording() -> None:
    class Interrupted(Times):
        def __call__(self, x: mi.Float) -> mi.Float:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        Recordings(2).call(Interrupted, 1, lambda: Interrupted(1), dr.opaque(mi.Float, 1.0))


def test_the_state_of_a_scene_tells_values_from_the_rest() -> None:
    scene = smoke_under("heterogeneous")
    params, sensor = mi.traverse(scene), scene.sensors()[0]
    before = SceneState.of(scene, sensor)
    assert before.is_same(SceneState.of(scene, sensor))
    for key, value, is_followed in (
        (INSIDE + "sigma_t.data", params[INSIDE + "sigma_t.data"] * 2, True),
        (INSIDE + "scale", 3.0, True),
        ("sensor.far_clip", 50.0, False),
    ):
        params[key] = value
        params.update()
        after = SceneState.of(scene, sensor)
        assert not before.is_same(after)
        assert (before.key == after.key) == is_followed
        before = after
    dr.enable_grad(params[INSIDE + "sigma_t.data"])
    after = SceneState.of(scene, sensor)
    assert not before.is_same(after) and before.key != after.key


def test_refusals_of_a_plan_come_before_a_recording() -> None:
    scene = smoke_under()
    integrator = mi.load_dict(mivol(max_depth=4, deterministic=True))
    with pytest.raises(Exception) as caught:
        mi.render(scene, integrator=integrator, spp=1)
    assert isinstance(caught.value, MivolError) or isinstance(caught.value.__cause__, MivolError)
    assert integrator.session.recordings.count == 0


# -- Python's collector ----------------------------------------------------------------------------------------------------


def test_collections_are_put_off_for_a_while() -> None:
    """After an error too; and they stay off where they were."""
    assert gc.isenabled()
    with pytest.raises(ZeroDivisionError), without_garbage_collection():
        assert not gc.isenabled()
        raise ZeroDivisionError
    assert gc.isenabled()
    gc.disable()
    try:
        with without_garbage_collection():
            pass
        assert not gc.isenabled()
    finally:
        gc.enable()


def _look_at_collector(seen: list[bool], x: mi.Float) -> mi.Float:
    seen.append(gc.isenabled())
    return x + 1


@pytest.mark.parametrize("records", [RecordedKernel, lambda *given: partial(RecordedFunctions().call, *given)])
def test_kernels_are_recorded_without_them(variant_rgb: str, records: Callable) -> None:
    """A scene that the collector frees in a recording would end the process."""
    seen: list[bool] = []
    one = records(partial(_look_at_collector, seen))(dr.opaque(mi.Float, 1, 3))
    assert seen == [False] and gc.isenabled() and np.array_equal(one, [2, 2, 2])


@pytest.mark.slow_for("forward", "reverse")
@pytest.mark.parametrize("way", ["picture", "reverse", "forward"])
def test_paths_are_recorded_without_them(variant_rgb: str, monkeypatch: pytest.MonkeyPatch, way: str) -> None:
    seen, name = [], {"picture": "_render_primal", "reverse": "replay_branches", "forward": "_render_tangent"}[way]
    walk = getattr(render_tasks, name)
    monkeypatch.setattr(render_tasks, name, lambda *a, **k: seen.append(gc.isenabled()) or walk(*a, **k))
    scene = close_up({"smoke": smoke(rough_grid(1), 0.5)[0], "sky": scenes.sky(1.0)}, res=2)
    params, integrator = mi.traverse(scene), mi.load_dict(mivol(max_depth=3))
    if way != "picture":
        dr.enable_grad(params[INSIDE + "sigma_t.data"])
    if way == "forward":
        dr.set_grad(params[INSIDE + "sigma_t.data"], 1.0)
        integrator.render_forward(scene, params, seed=0, spp=1)
    elif way == "reverse":
        integrator.render_backward(scene, params, dr.ones(mi.TensorXf, (2, 2, 3)), seed=0, spp=1)
    else:
        mi.render(scene, integrator=integrator, spp=1)
    assert seen and not any(seen)
    assert gc.isenabled()


def test_out_of_memory_is_one_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    scene, integrator = smoke_under(), mi.load_dict(mivol(max_depth=2))

    def fail(*_: object) -> None:
        raise RuntimeError("jit_malloc(): out of memory! Could not allocate 12884901888 bytes (backend=1, shared=0).")

    monkeypatch.setattr(render_tasks.ImageTask, "__call__", fail)
    with refused("a render of 6 x 6 pixels ran out of memory on this machine: render crops"):
        mi.render(scene, integrator=integrator, spp=1)


def scale_by_first(x: mi.Float) -> mi.Float:
    return x * float(x[0])


def double(x: mi.Float) -> mi.Float:
    return 2 * x


def test_a_function_that_cannot_be_recorded_runs_and_says_so(variant_rgb: str) -> None:
    functions, x = RecordedFunctions(), dr.opaque(mi.Float, 3.0, 2)
    assert (np.array(functions.call(double, x)) == 6).all() and functions.describe_failure() == ""
    for _ in range(3):
        assert (np.array(functions.call(scale_by_first, x)) == 9).all()
    assert "it is traced anew in each step and takes longer (scale_by_first: " in functions.describe_failure()
