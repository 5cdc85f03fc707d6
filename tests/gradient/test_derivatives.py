"""Derivatives of paths: replays of stems and branches find the light of the first walk, and means equal the means of whole
paths.
"""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from false_alarms import assert_precise, assert_same_mean, difference, fresh
from scattering_gradients import along, backward, note_ways, upper_half
from scattering_scenes import PLACE, cases, close_up, mivol, rough_grid, sun

from mivol.experiments.script import explain
from mivol.scene import plan
from mivol.scene.needs import find_needs
from mivol.scene.plan import build_estimators, make_plan
from mivol.scene.survey import survey_scene
from mivol.transport.estimators.flights.baseline import BLOCKS, Baseline, BaselineSums
from mivol.transport.estimators.scores import Replay
from mivol.transport.estimators.single_scattering.near_light import NearLightPlace
from mivol.transport.media.scene_media import SceneMedia
from mivol.transport.path import derivatives
from mivol.transport.path.derivatives import count_baseline_paths, count_branches, prepare_derivatives
from mivol.transport.path.estimators import Estimators, Settings
from mivol.transport.path.walk import Path, PathStart, walk_part
from mivol.validate.statistics import Moments
from scenes import ball_of, box_of, camera, centred, grid_volume, medium, skip_recorded_grids_on_a_gpu, sky

MEDIUM = "smoke.interior_medium."
KEYS = {
    "density": MEDIUM + "sigma_t.data",
    "albedo": MEDIUM + "albedo.data",
    "g": MEDIUM + "phase_function.g",
    "sun": "sun.irradiance.value",
    "floor": "floor.bsdf.reflectance.value",
}


def smoky(density: np.ndarray | None = None, **parts: dict) -> mi.Scene:
    """Peaked smoke under the sun; many camera rays miss it or pass it."""
    density = rough_grid(4, 3.0) * (np.arange(6) < 3)[None, None, :, None] if density is None else density
    albedo = grid_volume("mivol_voxels", 0.9 * rough_grid(5, 1.0, (3, 3, 3)), PLACE)
    interior = medium("mivol_medium", grid_volume("mivol_voxels", density, PLACE), albedo, phase={"type": "mivol_hg", "g": 0.8})
    return close_up({"smoke": box_of(interior, PLACE), "sun": sun([0.3, 0.2, -1.0])[0], **parts}, res=8)


def floor() -> dict:
    down = mi.ScalarTransform4f().translate([0, 0, -1.3]).scale(3)
    return {"type": "rectangle", "to_world": down, "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.6}}}


def coloured() -> mi.Scene:
    """An rgb extinction: each flight draws a channel."""
    density = rough_grid(4, 3.0)
    return smoky(np.concatenate([density, 0.2 * density, 2 * density], axis=-1), lit=sky(0.3))


def burning() -> mi.Scene:
    """A medium emits beside a floor; scattering events sample its light."""
    interior = medium(
        "mivol_medium",
        grid_volume("mivol_voxels", rough_grid(4, 3.0), PLACE),
        0.7,
        emission=grid_volume("mivol_voxels", rough_grid(6, 1.0, (3, 3, 3)), PLACE),
    )
    return close_up({"smoke": box_of(interior, PLACE), "floor": floor()}, res=8)


def glassy() -> mi.Scene:
    """A refracting ball beside a box: a path may collide on its first segment, or after a refraction."""
    ball = ball_of(medium("mivol_medium", 1.5, 0.8), (0.3, 1.7, 0.4), 0.5) | {"bsdf": {"type": "dielectric", "int_ior": 1.3}}
    return smoky(ball=ball, lit=sky(0.3))


SCENES = {"sun": smoky, "floor": lambda: smoky(floor=floor()), "rgb": coloured, "fire": burning, "glass": glassy}


def gradient_of_mean_image(scene: mi.Scene, key: str, spp: int, seed: int, depth: int = 5) -> np.ndarray:
    """The derivative of the mean image."""
    return backward(scene, key, np.full((8, 8, 3), 1 / 192), spp, seed, mi.load_dict(mivol(max_depth=depth, rr_depth=3)))


@pytest.fixture
def replays(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, np.ndarray, np.ndarray, np.ndarray]]:
    """For each replay its name, the light before and after the replay, and d loss / d light, with one row for each channel."""
    seen: list[tuple] = []
    monkeypatch.setattr(derivatives, "BALANCE", 1e3)  # as many branches as there are lanes for
    # A recorded loop would hide the values.
    monkeypatch.setattr(derivatives, "replay_in_one_kernel", lambda width, walk: [walk(mi.Bool(k == 0)) for k in range(2)])
    add = derivatives._ProbeList.add

    def add_now(*given: Any) -> None:
        # Outside of a loop, a counter and all that it places must be in one kernel.
        dr.eval()
        add(*given)
        dr.eval()

    monkeypatch.setattr(derivatives._ProbeList, "add", add_now)

    def watched_walk(estimators: Estimators, start: PathStart, score: Replay, stops: mi.Bool, probes: tuple[str, ...]) -> Path:
        path = walk_part(estimators, start, score, stops, probes)
        dr.eval(path.score.L)
        name = "stems" if dr.all(stops) else "branches"
        seen.append((name, np.array(score.L), np.array(path.score.L), np.array(score.dL)))
        return path

    monkeypatch.setattr(derivatives, "walk_part", watched_walk)
    return seen


@pytest.mark.parametrize("name", cases(SCENES, slow=("floor", "rgb", "fire", "glass")))
def test_a_replay_finds_the_light_that_was_found(name: str, replays: list) -> None:
    """Replayed branches, in another order, leave only rounding; replayed stems leave the mean light of their branches."""
    gradient_of_mean_image(SCENES[name](), KEYS["density"], 16, fresh(3), depth=7)
    # An attempt to record may have run up to its end before it is given up.
    (first, whole, left, dL), (second, light, rest, scaled) = replays[-2:]
    assert (first, second) == ("stems", "branches")
    assert len(np.unique(light[0])) > 100
    # Some 20 terms of a path are subtracted one by one.
    assert np.abs(rest).max() <= 20 * 2**-24 * np.abs(light).max()
    assert np.count_nonzero(left.sum(axis=0) > 20 * 2**-24 * whole.max()) > 100
    # All rays count alike. More than half of the camera rays collide, or more than a third.
    share = scaled / dL.max()
    k = 1 if name in ("rgb", "fire") else 2
    assert set(np.round(share[light > 0], 5)) == ({0.5, 1.0} if name == "glass" else {1 / k})
    np.testing.assert_allclose(left.sum(axis=1), (share * light).sum(axis=1), rtol=1e-5)


@pytest.mark.parametrize("depth", [3, 6])
def test_light_is_linear_in_the_sun(depth: int, replays: list) -> None:
    """The derivative by the sun, times the sun, is the light of all stems, up to float32 sums in another order."""
    scene = smoky()
    bright = float(np.mean(mi.traverse(scene)[KEYS["sun"]]))
    found = bright * np.sum(gradient_of_mean_image(scene, KEYS["sun"], 16, fresh(3), depth))
    _, light, _, dL = replays[0]
    assert found == pytest.approx(np.sum(light * dL), rel=1e-4)


@pytest.mark.statistical
@pytest.mark.parametrize("fewest", [1, 1 << 30])
def test_paths_in_a_white_rgb_medium_have_the_light_of_the_sky(fewest: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Everything is as bright as the sky: each channel has a third of the mean, with segments in memory or without."""
    monkeypatch.setattr(derivatives, "MIN_LISTED", fewest)
    density = rough_grid(4, 3.0)
    values = np.concatenate([density, 0.2 * density, 2 * density], axis=-1)
    interior = medium("mivol_medium", grid_volume("mivol_voxels", values, PLACE), 1.0)
    lit = {"type": "constant", "radiance": {"type": "rgb", "value": [1.0, 1.0, 1.0]}}
    scene = close_up({"smoke": box_of(interior, PLACE), "lit": lit}, res=8)
    integrator, weight = mi.load_dict(mivol(max_depth=-1, rr_depth=1000)), np.full((8, 8, 3), 1 / 192)
    found = [backward(scene, "lit.radiance.value", weight, 256, fresh(k), integrator) for k in range(16)]
    assert_same_mean(Moments.from_values(np.array(found).reshape(16, 3)), 1 / 3, rounding=1e-6, what="light of each channel")


@pytest.mark.parametrize("name", cases(SCENES, slow=("rgb", "fire", "glass")))
def test_listed_probes_add_what_probes_add_in_their_lanes(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The same probes with the same random numbers: the same terms in another order."""
    found = []
    for fewest in (1, 1 << 30):
        monkeypatch.setattr(derivatives, "MIN_LISTED", fewest)
        found.append(gradient_of_mean_image(SCENES[name](), KEYS["density"], 64, fresh(3)))
    # A voxel has at most 4096 float32 terms of both signs.
    np.testing.assert_allclose(*found, rtol=1e-4, atol=1e-5 * np.abs(found[1]).max())


def test_listed_probes_have_the_baseline_of_their_flights(monkeypatch: pytest.MonkeyPatch) -> None:
    """In a box without a grid it is that of the block in which a flight begins, here another number in each block."""
    monkeypatch.setattr(Baseline, "_read", lambda self, block, active: mi.Spectrum(0.1 * mi.Float(block % 5)))
    monkeypatch.setattr(SceneMedia, "find_only_constant", lambda self: None)
    smoke, found = box_of(medium("homogeneous", 0.3, 0.8), PLACE), []
    for fewest in (1, 1 << 30):
        monkeypatch.setattr(derivatives, "MIN_LISTED", fewest)
        scene, integrator = close_up({"smoke": smoke, "lit": sky(0.3)}, res=8), mi.load_dict(mivol(max_depth=5))
        found.append(backward(scene, MEDIUM + "sigma_t.value.value", np.ones((8, 8, 3)), 64, fresh(3), integrator))
    # 4096 float32 terms of both signs.
    np.testing.assert_allclose(*found, rtol=1e-4)


@pytest.mark.parametrize("lamp", ["sun", "inside"])
def test_a_fit_may_start_from_an_empty_grid_of_one_literal(lamp: str) -> None:
    """The derivatives are those by zeros in memory."""
    found = []
    for zeros in (lambda shape: mi.TensorXf(np.zeros(shape, np.float32)), lambda shape: dr.zeros(mi.TensorXf, shape)):
        scene = smoky() if lamp == "sun" else lit_inside(BULB)
        params = mi.traverse(scene)
        params[KEYS["density"]] = zeros(params[KEYS["density"]].shape)
        params.update()
        found.append(gradient_of_mean_image(scene, KEYS["density"], 4, 3))
    np.testing.assert_allclose(*found, rtol=1e-5, atol=1e-6 * np.abs(found[0]).max())
    assert np.abs(found[0]).max() > 0


def lit_inside(lamp: dict, rgb: bool = False) -> mi.Scene:
    """A lamp inside of smoke: segments draw its light."""
    values = 0.5 + rough_grid(4, 3.0)
    density = grid_volume("mivol_voxels", np.concatenate([values, 0.3 * values, 2 * values], -1) if rgb else values, PLACE)
    return close_up({"smoke": box_of(medium("mivol_medium", density, 0.8), PLACE), "lamp": lamp}, res=8)


BULB = {"type": "point", "position": [0.2, 0.1, 0.3], "intensity": 4.0}
BALL = {"type": "sphere", "center": [0.2, 0.1, 0.3], "radius": 0.1, "emitter": {"type": "area", "radiance": 30.0}}
LAMPS = {
    "density": (BULB, KEYS["density"], 5),
    "some": (BULB, "lamp.position", 1),
    "ball": (BALL, KEYS["density"], 5),
    "rgb": (BULB, KEYS["density"], 5),
}


@pytest.mark.parametrize("name", cases(LAMPS, slow=("ball",)))
def test_a_replay_reads_where_the_walk_has_found_near_light(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """With places of near light in memory for no, some or all segments: the same terms, up to rounding of the weights."""
    (lamp, key, most), found = LAMPS[name], []
    monkeypatch.setattr(derivatives, "MIN_LISTED", 1)
    for places in (0, most):
        monkeypatch.setattr(derivatives, "MAX_SEGMENTS", places)
        found.append(gradient_of_mean_image(lit_inside(lamp, name == "rgb"), key, 64, fresh(3)))
    # 4096 float32 terms of both signs.
    np.testing.assert_allclose(*found, rtol=1e-4, atol=1e-5 * np.abs(found[0]).max())


def test_a_replay_walks_no_near_light_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """Places without light, in the place of those in memory, leave no derivative by the lamp."""
    real = NearLightPlace.at
    monkeypatch.setattr(derivatives, "MIN_LISTED", 1)
    monkeypatch.setattr(NearLightPlace, "at", lambda *given: replace(real(*given), reach=mi.Float(0)))
    assert not np.any(gradient_of_mean_image(lit_inside(BULB), "lamp.intensity.value", 64, fresh(3)))


@pytest.mark.parametrize(("density", "share"), [(0.0, 1.0), (8.0, 4 * 0.3 / 8.3)])
def test_dense_media_keep_few_probes(density: float, share: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """In a box with an edge of 2, kappa is 0.3, and a probe survives with the probability min(1, 4 kappa / (sigma + kappa))."""
    lists, add = [], derivatives._ProbeList.add_derivatives
    monkeypatch.setattr(derivatives, "MIN_LISTED", 1)
    monkeypatch.setattr(derivatives._ProbeList, "add_derivatives", lambda *given: (lists.append(given[0]), add(*given)))
    interior = medium("mivol_medium", grid_volume("mivol_voxels", np.full((4, 5, 6, 1), density), PLACE), 0.8)
    scene = close_up({"smoke": box_of(interior, PLACE), "lit": sky(1.0)}, res=8, fov=8.0)
    gradient_of_mean_image(scene, KEYS["density"], 2048, fresh(3))
    first, rays = int(lists[0].counts[0][0]), 64 * 2048
    # Every ray meets the box, and has a first probe. A binomial count is off by 6 standard deviations with a chance of 2e-9.
    assert abs(first - share * rays) <= 6 * np.sqrt(rays * share * (1 - share))


def test_branches_of_a_stem_differ(monkeypatch: pytest.MonkeyPatch) -> None:
    """The random numbers of any two branches differ, and of any two stems."""
    made = []
    real = derivatives._Branching.of
    monkeypatch.setattr(derivatives._Branching, "of", lambda *args: made.append(real(*args)) or made[0])
    monkeypatch.setattr(derivatives, "BALANCE", 1e3)
    gradient_of_mean_image(smoky(), KEYS["density"], 64, fresh(3))
    number = dr.arange(mi.UInt32, dr.width(made[0].collided))
    (stem, branches), share = made[0].gather(number), made[0].share_of(number)
    on = np.array(branches.active)
    stem, sampler = np.array(stem)[on], branches.sampler
    numbers = np.array([sampler.state, sampler.bits])[:, on]
    assert share[0] == 0.5
    assert np.array_equal(np.unique(stem, return_counts=True)[1], np.full(len(stem) // 2, 2))
    assert np.unique(numbers, axis=1).shape[1] == numbers.shape[1]


def test_stems_branch_in_media_with_derivatives(monkeypatch: pytest.MonkeyPatch) -> None:
    """A collision in a medium without derivatives has one branch beside others with three; each stem sums its own branches."""
    made = []
    real = derivatives._Branching.of
    monkeypatch.setattr(derivatives._Branching, "of", lambda *args: made.append((real(*args), args[0].media)) or made[0][0])
    monkeypatch.setattr(derivatives, "BALANCE", 1e3)
    fog = box_of(medium("mivol_medium", 2.0, 0.8), centred(np.eye(3), (0.3, -1.6, 0.4)))
    gradient_of_mean_image(smoky(fog=fog), KEYS["density"], 64, fresh(3))
    ((found, media),) = made
    n = dr.width(found.collided)
    number = dr.arange(mi.UInt32, n)
    stem, branches = found.gather(number)
    on, body = np.array(branches.active), np.array(branches.flight.body)
    stems, counts = np.unique(np.array(stem)[on], return_counts=True)
    of = dict(zip(np.array(stem)[on].tolist(), body[on].tolist(), strict=True))
    in_smoke = np.array([media.bodies[of[k]].box.edge > 1.5 for k in stems.tolist()])
    assert len(in_smoke) > np.count_nonzero(in_smoke) > 100
    assert np.array_equal(counts, np.where(in_smoke, 3, 1))
    assert np.array_equal(np.flatnonzero(np.array(found.start.active)), stems)
    light, share = np.random.default_rng(0).random(n).astype(np.float32), np.array(found.share_of(number))
    expected = np.bincount(np.array(stem)[on], (share * light)[on], n)
    summed = found.add_light(dr.zeros(mi.Spectrum, n), mi.Spectrum(mi.Float(light)))
    np.testing.assert_allclose(np.array(summed)[0], expected, rtol=1e-6)


def test_branches_walk_side_by_side_by_their_length() -> None:
    """The longest first; all lengths above a bound count as equal; each branch appears once."""
    depth = np.array([3, 1, 200, 3, 0, 12, 70_000, 11, 65_536, 4000])
    lengths = derivatives._Lengths.of(mi.UInt32(depth))
    dr.eval(lengths)
    order = np.array(lengths.sort())
    assert sorted(order.tolist()) == list(range(10))
    assert np.all(np.diff(np.minimum(depth[order], derivatives.MAX_SORTED_LENGTH)) <= 0)


@pytest.mark.parametrize(
    ("collided", "noise", "near", "single", "count"),
    [(1000, 0.5, 0, 0, 1), (400, 0.5, 0, 0, 2), (400, 0.03, 0, 0, 1), (200, 0.03, 0, 0, 2), (1, 0.5, 0, 0, 3),
     (0, 0.5, 0, 0, 3), (100, 0.05, 1, 0, 2), (250, None, 0, 0, 3), (100, None, 1, 0, 2), (600, None, 1, 0, 1),
     (250, None, 0, 300, 2), (250, None, 0, 600, 1), (0, 0.5, 0, 1000, 1)],
)  # fmt: skip
def test_fewer_collisions_and_more_noise_need_more_branches(
    collided: int, noise: float | None, near: int, single: int, count: int
) -> None:
    """sqrt(26 noise / share) rounded, at most 3; beside near light on segments sqrt(5 noise / share), at most 2. A noise of .15
    without a baseline; never more branches than stems, of which some have one branch."""
    baseline = None if noise is None else SimpleNamespace(noise=mi.Float(noise))
    estimators = SimpleNamespace(segment=SimpleNamespace(baseline=baseline), near=near or None)
    assert int(count_branches(estimators, 1000, mi.UInt32(collided), mi.UInt32(single))[0]) == count
    assert count * collided + single <= 1000


def test_without_collisions_probes_give_the_derivative(replays: list) -> None:
    """A density of 0 has no light behind branches, and derivatives from probes."""
    found = gradient_of_mean_image(smoky(np.zeros((4, 5, 6, 1))), KEYS["density"], 64, fresh(3))
    assert not replays[1][1].any()
    assert np.abs(found).max() > 0


def test_plan_branches_paths_with_free_flights() -> None:
    """Branches need free flights and the independent sampler."""
    scene = smoky()
    facts = find_needs(scene, scene.sensors()[0])
    choose = lambda facts, depth, segment="free_flight": plan.choose_branches(facts, Settings(max_depth=depth), segment)[0]  # noqa: E731
    assert choose(facts, 3) and choose(facts, -1)
    assert not choose(facts, 1) and not choose(facts, 3, "single_scattering")
    assert not choose(replace(facts, are_samples_independent=False), 3)
    assert "paths branch where they first collide" in explain(scene, 6)


@pytest.mark.slow
@pytest.mark.statistical
@pytest.mark.parametrize(
    ("name", "key", "depth"),
    [("sun", "albedo", 4), ("sun", "g", 4), ("floor", "floor", 4), ("rgb", "density", 4), ("glass", "density", 5)],
)
def test_branches_keep_the_mean(name: str, key: str, depth: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """The mean derivative equals the mean of whole paths, along a random direction in the upper half."""
    scene, integrator = SCENES[name](), mi.load_dict(mivol(max_depth=depth, rr_depth=3))
    v = upper_half(scene, KEYS[key])
    monkeypatch.setattr(derivatives, "BALANCE", 1e3)
    found = along(scene, KEYS[key], v, integrator, 64)
    monkeypatch.setattr(plan, "choose_branches", lambda *_: (False, []))
    whole = along(scene, KEYS[key], v, integrator, 128)
    assert_same_mean(found, whole, rounding=1e-4 * np.abs(whole.mean), what="derivative")
    assert_precise(difference(found, whole), 0.1 * np.abs(whole.mean), what="derivative")


@pytest.mark.slow
def test_a_recorded_step_has_branches() -> None:
    """A recorded step with changing seeds gives the gradient of an ordinary step."""
    skip_recorded_grids_on_a_gpu()
    values = rough_grid(4, 3.0).astype(np.float32)
    interior = medium("mivol_medium", grid_volume("mivol_voxels", values, PLACE), 0.8)
    sensor = camera((2.0, 1.5, 3.0), (0.0, 0.0, 0.0), res=8, fov=45.0)
    scene = mi.load_dict({"type": "scene", "smoke": box_of(interior, PLACE), "lit": sky(1.0), "sensor": sensor})
    integrator, params = mi.load_dict(mivol(max_depth=4)), mi.traverse(scene)

    def step(scene: mi.Scene, integrator: mi.Integrator, params: mi.SceneParameters, x: mi.TensorXf, seed: mi.UInt32):
        dr.enable_grad(x)
        params[KEYS["density"]] = x
        params.update()
        dr.backward(dr.mean(dr.square(mi.render(scene, params, integrator=integrator, spp=16, seed=seed)), axis=None))
        return dr.grad(x)

    mi.render(scene, integrator=integrator, spp=1)  # a recording knows what was read before
    frozen = dr.freeze(step)
    replayed = [np.array(frozen(scene, integrator, params, mi.TensorXf(values), mi.UInt32(call))) for call in range(3)]
    for call, found in enumerate(replayed):
        plain = np.array(step(scene, integrator, params, mi.TensorXf(values), mi.UInt32(call)))
        # The order of sums over threads is not fixed: float32 sums of some ten thousand terms.
        assert np.abs(found - plain).max() <= 1e-4 * np.abs(plain).max()


# -- One number, or one for each channel ------------------------------------------------------------------------------------


def fog(*constants: object, boundary: dict | None = None, **more: object) -> mi.Scene:
    """A medium of constants with a lamp, beside a floor and a ball of the same medium in glass."""
    interior = medium("mivol_medium", *constants, phase={"type": "mivol_hg", "g": 0.4}, **more)
    glass = {"type": "sphere", "radius": 0.4, "center": (0.3, 1.5, 0.4), "bsdf": {"type": "dielectric", "int_ior": 1.3}}
    lamp, shared = {"type": "point", "position": [1.3, -0.6, 1.9], "intensity": 3.0}, {"type": "ref", "id": "fog"}
    parts = {"fog": interior | {"id": "fog"}, "lamp": lamp, "lit": sky(0.3), "floor": floor()}
    box = box_of({}, PLACE) | {"interior": shared}
    return close_up(parts | {"smoke": box | (boundary or {}), "ball": glass | {"interior": shared}}, res=8)


COLOURS = {"type": "rgb", "value": [0.9, 0.7, 0.04]}
SIGMA_T, OWN_ALBEDO = "fog.sigma_t.value.value", "fog.albedo.value.value"
CONSTANTS = {
    "thick": (lambda: fog(1.2, 0.8), SIGMA_T),
    "thin": (lambda: fog(0.1, 0.8), SIGMA_T),
    "rgb": (lambda: fog({"type": "rgb", "value": [2.0, 1.0, 0.5]}, 0.8), SIGMA_T),
    "albedo": (lambda: fog(1.2, 0.8), OWN_ALBEDO),
    "dark": (lambda: fog(0.3, COLOURS), OWN_ALBEDO),
    "scale": (lambda: fog(1.2, COLOURS, scale=0.7), "fog.scale"),
    "glass": (lambda: fog(1.2, COLOURS, boundary={"bsdf": {"type": "roughdielectric", "alpha": 0.2}}), SIGMA_T),
}
"""Scenes with one followed coefficient: collisions alone, probes, channels, an albedo below the bound of collisions, the scale,
and a traced boundary."""


@pytest.fixture
def walked(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The ways by which derivatives are found."""
    return note_ways(monkeypatch, "replay_branches", "carry_tangents")


def assert_tangents_are_replays(scene: mi.Scene, key: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The derivative by tangents and by replays, with the same random numbers: the same terms in another order."""
    w, found = np.random.default_rng(1).uniform(0.5, 1.5, (8, 8, 3)), []
    for find in (SceneMedia.find_only_constant, lambda self: None):
        monkeypatch.setattr(SceneMedia, "find_only_constant", find)
        found.append(backward(scene, key, w, 64, fresh(3), mi.load_dict(mivol(max_depth=5, rr_depth=3))))
    # Sums in float32 of 4096 paths with some ten terms of both signs each: the sum of sizes is up to 20 times the sum.
    np.testing.assert_allclose(*found, rtol=2e-4)
    assert np.all(found[0] != 0)


@pytest.mark.parametrize("name", cases(CONSTANTS, slow=("rgb", "dark", "scale", "glass")))
def test_tangents_give_the_derivative_of_replays(name: str, walked: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    build, key = CONSTANTS[name]
    assert_tangents_are_replays(build(), key, monkeypatch)
    assert walked == ["carry_tangents", "replay_branches"]


def test_tangents_read_the_baseline_where_a_flight_enters(monkeypatch: pytest.MonkeyPatch) -> None:
    """A baseline that differs between the blocks of a box."""
    monkeypatch.setattr(Baseline, "_read", lambda self, block, active: mi.Spectrum(0.1 * mi.Float(block % 5)))
    smoke = box_of(medium("homogeneous", 1.2, 0.8), PLACE)
    assert_tangents_are_replays(close_up({"smoke": smoke, "lit": sky(0.3)}, res=8), MEDIUM + "sigma_t.value.value", monkeypatch)


def test_tangents_are_for_one_constant_alone(walked: list[str]) -> None:
    """Two coefficients, a surface, both, a grid, an AOV and a fire are replayed."""

    def differentiate(scene: mi.Scene, *keys: str, **more: object) -> None:
        params = mi.traverse(scene)
        for key in keys:
            dr.enable_grad(params[key])
        grad_in = dr.ones(mi.TensorXf, (8, 8, 4 if more else 3))
        mi.load_dict(mivol(max_depth=3, **more)).render_backward(scene, params, grad_in, seed=0, spp=1)

    differentiate(fog(1.2, 0.8), SIGMA_T)
    assert walked == ["carry_tangents"]
    differentiate(fog(1.2, 0.8), SIGMA_T, OWN_ALBEDO)
    differentiate(fog(1.2, 0.8), KEYS["floor"])
    differentiate(fog(1.2, 0.8), KEYS["floor"], SIGMA_T)
    differentiate(fog(1.2, 0.8), SIGMA_T, aovs="depth")
    differentiate(fog(1.2, 0.8, emission=0.1), SIGMA_T)
    differentiate(smoky(), KEYS["density"])
    differentiate(smoky(), KEYS["albedo"])
    assert walked[1:] == ["replay_branches"] * 7


def test_tangents_add_to_what_a_latent_number_has() -> None:
    """albedo = x / 2 in two images, beside a loss of x itself: all derivatives reach x."""
    scene, integrator = fog(1.2, 0.8), mi.load_dict(mivol(max_depth=4))
    params = mi.traverse(scene)
    x = mi.Float(1.6)
    dr.enable_grad(x)
    params[OWN_ALBEDO] = x / 2
    params.update()
    images = [mi.render(scene, params, integrator=integrator, spp=4, seed=fresh(k)) for k in range(2)]
    dr.backward(3 * x + sum(dr.sum(image, axis=None) for image in images))
    alone = [backward(scene, OWN_ALBEDO, np.ones((8, 8, 3)), 4, find_gradient_seed(fresh(k)), integrator) for k in range(2)]
    assert dr.grad(x)[0] == pytest.approx(3 + 0.5 * float(np.sum(alone)), rel=1e-5)


def find_gradient_seed(seed: int) -> int:
    """The seed of derivatives that ``mi.render`` takes for an image of this seed."""
    return int(mi.sample_tea_32(seed, 1)[0])


ALBEDO, SIGMA = 0.8, 0.05
FAR, POWER = 200.0, 3e4
MISSED = 40.0
"""Where a ray passes all boxes."""


def find_sums(emitter: dict, *interiors: dict, depth: int = 3, at: tuple = (0, MISSED, 0.5, MISSED)) -> list[tuple]:
    """The sums and the baseline for boxes with these media, 5 apart, the first at [-1, 1]^3; rays pass x = ``at``."""
    boxes = {f"box{k}": box_of(interior, PLACE + 5 * k * np.eye(4, k=3)) for k, interior in enumerate(interiors)}
    scene = mi.load_dict({"type": "scene", **boxes, "emitter": emitter, "sensor": camera([0, -1, 6], [0, 0, 0])})
    survey, settings = survey_scene(scene), Settings(max_depth=depth)
    o = mi.Point3f(mi.Float(at), 0, -4)
    ray = mi.Ray3f(o, mi.Vector3f(0, 0, 1), dr.inf, dr.zeros(mi.Float, len(at)), mi.Color0f())
    found: list[tuple] = []
    finish = BaselineSums.finish
    with dr.suspend_grad(), pytest.MonkeyPatch.context() as patch:
        patch.setattr(derivatives, "MIN_PATHS", derivatives.FEW_PATHS)
        patch.setattr(BaselineSums, "finish", lambda sums: found.append((sums, finish(sums))) or found[0][1])
        needs = find_needs(scene, scene.sensors()[0], survey)
        plan = make_plan(needs, settings)
        assert plan.segment == "free_flight"
        estimators = build_estimators(scene, needs, plan, settings, survey, for_images=False)
        prepare_derivatives(estimators, ray)
    return found


def find_mean(*args: dict, **options: object) -> np.ndarray:
    """The mean of the baseline over all collisions."""
    return np.array(find_sums(*args, **options)[0][1].mean)


def test_small_passes_have_few_paths_for_the_baseline():
    """Two paths a ray from 256 up to 2048, then one for 64 rays, up to 32768; with a table 24 for the root of the rays."""
    assert [count_baseline_paths(n) for n in (16, 256, 1 << 12, 1 << 20, 1 << 22)] == [256, 512, 2048, 1 << 14, 1 << 15]
    assert [count_baseline_paths(n, True) for n in (1 << 12, 1 << 16, 1 << 20, 1 << 22)] == [2048, 6144, 24576, 1 << 15]


def test_baseline_in_a_white_furnace_is_the_light_of_the_sky():
    """Every path finds the light of the sky, up to the rounding of sums of some thousand numbers."""
    ((_, baseline),) = find_sums(sky(0.5), medium("homogeneous", SIGMA, 1.0), depth=-1)
    np.testing.assert_allclose(np.array(baseline.values), 0.5, rtol=1e-4)
    assert baseline.noise[0] < 1e-4


def test_collisions_count_as_their_derivatives_weigh():
    """A white box of sigma 3, which is thick and needs no probes, and a black box of 0.25, with kappa = 0.6 / 2.

    The light behind collisions is that of the sky, or 0, and the numbers of collisions are read from the sums. At most 3 % of
    the paths from the white box meet the black one, as a square of 2 x 2 at a distance of 4 (1.6 % of all directions), and
    1 - exp(-0.5) of them end there.
    """
    sigma, light, kappa = np.array([3.0, 0.25]), np.array([0.5, 0.0]), np.array([0.0, 0.3])
    boxes = [medium("homogeneous", s, albedo) for s, albedo in zip(sigma, (1.0, 0.0), strict=True)]
    ((sums, baseline),) = find_sums(sky(0.5), *boxes, depth=-1, at=(0, 5, 0, 5))
    collisions = np.array(sums.sums)[-2 * BLOCKS**3 - 3 : -3].reshape(2, -1).sum(axis=1)
    extinctions = [float(own.body.view.parts[0].values[0]) for own in sums.blocks]
    collisions = collisions[np.argsort(extinctions)[::-1]]
    assert collisions.min() > 300
    weight = collisions / (sigma + kappa) ** 2
    np.testing.assert_allclose(np.array(baseline.mean), np.sum(weight * light) / weight.sum(), rtol=0.03 * 0.4)


def test_baseline_without_collisions_is_the_mean_of_all_rays():
    np.testing.assert_allclose(find_mean(sky(0.5), medium("homogeneous", SIGMA, 1.0), at=(MISSED, MISSED)), 0.5, rtol=1e-6)


def test_baseline_under_an_emitter_is_the_mean_of_colliding_paths():
    """Albedo times I / (4 pi r^2), of the one path in twenty that collides.

    Shadows take 1 - exp(-0.17) of it at most, since no way through the box is longer than 3.5, and a second scattering adds
    less than that share; the emitter is 200 away, give or take 1. The paths are always the same.
    """
    emitter = {"type": "point", "position": [0.0, 0.0, FAR], "intensity": POWER}
    once = ALBEDO * POWER / (4 * np.pi * FAR**2)
    found = find_mean(emitter, medium("homogeneous", SIGMA, ALBEDO))
    assert np.all((0.82 * once < found) & (found < 1.19 * once))


def test_no_baseline_with_sigma_s():
    """With ``sigma_s`` the terms of absorption do not have the mean 0."""
    parts = {"type": "mivol_medium", "sigma_a": 0.1, "sigma_s": 0.2}
    assert not find_sums(sky(0.5), parts)
