"""Paths and branches that a lane walks one after the other: each is walked once, as if alone, and a plan takes them where they
pay."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from false_alarms import assert_precise, assert_same_mean, difference, over_pixels
from scattering_scenes import PLACE, close_up, mivol, moments, rough_grid, smoke, sun

from mivol.experiments.script import explain
from mivol.scene import choices, plan, render_tasks
from mivol.scene.needs import find_needs
from mivol.scene.plan import build_estimators, make_plan
from mivol.scene.survey import BranchNoise, survey_scene
from mivol.transport.estimators.scores import Primal
from mivol.transport.path import successive
from mivol.transport.path.estimators import Estimators, Settings
from mivol.transport.path.film import RenderSamples, film_passes
from mivol.transport.path.successive import paths_per_lane, walk_branching, walk_successively
from mivol.transport.path.walk import leave_camera_from_memory, walk_light, walk_path
from mivol.transport.traversal.random_numbers import SpreadSampler
from scenes import ball_of, box_of, camera, grid_volume, medium, sky

ENDLESS = mivol(max_depth=-1)


def radiance(scene: mi.Scene, count: int, walk: Callable = walk_successively) -> np.ndarray:
    """Radiance and alpha (4, 3 * 8 * 8) of three samples per pixel."""
    settings, sensor, survey = Settings(max_depth=-1), scene.sensors()[0], survey_scene(scene)
    with dr.suspend_grad():
        needs = find_needs(scene, sensor, survey, 3)
        estimators = build_estimators(scene, needs, make_plan(needs, settings), settings, survey, for_images=True)
        rays = next(film_passes(RenderSamples(sensor, 5, 3, 1 << 20)))
        L, alpha, *_ = walk(estimators, rays.sampler, rays.ray, count)
    return np.array([*L, alpha])


def peaked(even: bool = False) -> mi.Scene:
    """Smoke or even fog under the sun, with side flights."""
    fog = box_of(medium("mivol_medium", 3.0, 0.99, phase={"type": "hg", "g": 0.8}), PLACE)
    matter = fog if even else smoke(rough_grid(7, 6.0), 0.99, name="hg", g=0.8)[0]
    return close_up({"matter": matter, "sun": sun([0.3, 0.2, -1.0])[0]}, res=8)


def test_a_path_does_not_depend_on_the_others_of_its_lane(monkeypatch: pytest.MonkeyPatch) -> None:
    """A path alone equals, to the last bit, the same path after others in its lane; the last lane has fewer paths. Walks in
    grids and the roulette of shadow rays draw numbers by their lane, so the fog is even and no shadow ray ends early.
    """
    monkeypatch.setattr("mivol.transport.estimators.lighting.shadow_rays.ROULETTE_TAU", 1e9)
    scene = peaked(even=True)
    alone = radiance(scene, 1)
    assert len(np.unique(alone[0])) > 90  # of 192 paths most find the sun
    for count in (5, 16, 500):
        assert np.array_equal(radiance(scene, count), alone)


def test_in_a_white_furnace_every_path_ends_with_the_light_of_the_sky() -> None:
    """An omitted path would be black. The camera stands in the smoke."""
    fog = box_of(medium("mivol_medium", 3.0, 1.0), PLACE)
    scene = close_up({"fog": fog, "sky": sky(1.0)}, res=8, origin=(0.1, 0.2, 0.3), target=(1, 1, 1))
    np.testing.assert_allclose(radiance(scene, 7), 1.0, rtol=1e-5)


def test_lanes_of_all_threads_have_work(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(successive.MIN_LANES, mi.variant().split("_")[0], 100)
    assert [paths_per_lane(16, n) for n in (1, 100, 299, 300, 9900)] == [1, 1, 2, 3, 16]
    assert paths_per_lane(1, 9900) == 1


def test_a_plan_takes_them_where_lengths_differ(monkeypatch: pytest.MonkeyPatch) -> None:
    """Successive paths need unlimited scattering and the independent sampler; others have numbers for one path in each lane
    only.
    """
    scene, counts = peaked(), []
    monkeypatch.setitem(successive.MIN_LANES, mi.variant().split("_")[0], 64)
    walk = walk_successively
    monkeypatch.setattr("mivol.scene.render_tasks.walk_successively", lambda *args: counts.append(args[-1]) or walk(*args))
    for depth in (-1, 5, 4):
        mi.render(scene, integrator=mi.load_dict(mivol(max_depth=depth)), spp=8)
    assert counts == [8, 8]  # 512 paths
    assert "up to 16 paths one after the other" in explain(scene, -1)
    assert "lanes" not in explain(scene, 4)
    facts = find_needs(scene, scene.sensors()[0])
    assert make_plan(facts, Settings(max_depth=-1)).successive_paths == 16
    assert make_plan(replace(facts, are_samples_independent=False), Settings(max_depth=-1)).successive_paths == 1
    stratified = mi.load_dict({"type": "perspective", "sampler": {"type": "stratified", "sample_count": 4}})
    assert facts.are_samples_independent and not find_needs(scene, stratified).are_samples_independent


@pytest.mark.slow
def test_a_recording_repeats_them(monkeypatch: pytest.MonkeyPatch) -> None:
    """A recording with another seed walks as many paths in each lane."""
    monkeypatch.setitem(successive.MIN_LANES, mi.variant().split("_")[0], 64)
    scene, integrator = peaked(), mi.load_dict(ENDLESS)
    mi.render(scene, integrator=integrator, spp=1)  # a recording knows what was read before

    def shoot(scene: mi.Scene, seed: mi.UInt32) -> mi.TensorXf:
        return mi.render(scene, integrator=integrator, spp=8, seed=seed)

    frozen = dr.freeze(shoot)
    for seed in (1, 2, 3):
        found, truth = np.array(frozen(scene, mi.UInt32(seed))), np.array(shoot(scene, mi.UInt32(seed)))
        # The samples of a pixel are summed in any order.
        np.testing.assert_allclose(found, truth, rtol=1e-5, atol=1e-6)
    assert frozen.n_recordings < 3  # the second finds what has become opaque


@pytest.mark.slow
@pytest.mark.statistical
def test_they_keep_the_mean(monkeypatch: pytest.MonkeyPatch) -> None:
    """The mean equals the mean of simultaneous paths."""
    scene = peaked()
    together = over_pixels(moments(scene, ENDLESS, 256))
    monkeypatch.setitem(successive.MIN_LANES, mi.variant().split("_")[0], 64)
    found = over_pixels(moments(scene, ENDLESS, 256, first=100))
    assert_same_mean(found, together, rounding=1e-6, what="radiance")
    assert_precise(difference(found, together), 0.03 * together.mean, what="radiance")


# -- Branches ------------------------------------------------------------------------------------------------------------------


def test_branches_do_not_depend_on_their_lane(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each camera ray has the same light, to the last bit, if a lane walks the branches of 1 or of 16 rays."""
    backend, found = mi.variant().split("_")[0], []
    for lanes in (1000, 10):
        monkeypatch.setitem(successive.MIN_LANES, backend, lanes)
        found.append(radiance(peaked(), 3, walk_branching))
    assert len(np.unique(found[0][0])) > 90
    assert np.array_equal(*found)


def test_branches_in_a_white_furnace_end_with_the_light_of_the_sky() -> None:
    """A branch that is left out would darken its ray; half of the rays miss the fog."""
    fog = box_of(medium("mivol_medium", 3.0, 1.0), PLACE)
    for origin in ((0.1, 0.2, 0.3), (0.0, -4.0, 0.0)):
        found = radiance(close_up({"fog": fog, "sky": sky(1.0)}, res=8, origin=origin, target=(1, 1, 1)), 3, walk_branching)
        np.testing.assert_allclose(found, 1.0, rtol=1e-5)


def whole(estimators: Estimators, sampler: SpreadSampler, ray: mi.Ray3f, _: int) -> tuple:
    """Radiance and alpha of paths that one kernel walks from the camera to their ends."""
    score, alpha = walk_path(estimators, sampler, ray, Primal(dr.zeros(mi.Spectrum, dr.width(ray))))
    return score.L, alpha


def test_branches_keep_the_alpha() -> None:
    """A ray of one path and a ray of branches have the same first flight."""
    alone = radiance(peaked(), 1, whole)[3]
    assert 0 < alone.mean() < 1
    assert np.array_equal(radiance(peaked(), 2, walk_branching)[3], alone)


def test_the_shared_kernel_finds_the_light_of_whole_paths() -> None:
    """Light and alpha of an image that starts from memory equal those of a walk in one kernel, to the last bit."""

    def shared(estimators: Estimators, sampler: SpreadSampler, ray: mi.Ray3f, _: int) -> tuple:
        return walk_light(estimators, leave_camera_from_memory(estimators, sampler, ray), stops=False)[:2]

    floor = {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([0, 0, -1.3]).scale(3)}
    matter = smoke(rough_grid(7, 6.0), 0.9)[0]
    for scene in (peaked(), close_up({"matter": matter, "floor": floor, "sky": sky(1.0)}, res=8)):
        assert np.array_equal(radiance(scene, 1, shared), radiance(scene, 1, whole))


def test_images_and_gradients_share_their_kernels() -> None:
    """One kernel finds the first flights of an image, of stems and of the baseline; one walks image, stems and branches."""
    scene = close_up({"matter": smoke(rough_grid(7, 6.0), 0.9)[0], "sky": sky(1.0)}, res=8)
    params = mi.traverse(scene)
    dr.enable_grad(params["matter.interior_medium.sigma_t.data"])
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        dr.backward(dr.mean(mi.render(scene, params, integrator=mi.load_dict(mivol(max_depth=6)), spp=1), axis=None))
        large = [k["hash"] for k in dr.kernel_history() if k["type"] == dr.KernelType.JIT and k["operation_count"] > 500]
    replay_and_baseline, flights_and_light = [1, 1], [3, 3]
    assert sorted(Counter(large).values()) == replay_and_baseline + flights_and_light


def count_of(stem: float, branch: float, share: float, events: float, samples: int = 1 << 20, near: bool = False) -> int:
    """Branches chosen for a measured scene."""
    facts = SimpleNamespace(
        branch_noise=BranchNoise(stem, branch, share, events),
        media=(SimpleNamespace(is_scattering=True),),
        are_samples_independent=True,
        film_samples=samples,
    )
    return choices.choose_image_branches(facts, Settings(max_depth=9), "free_flight", near)[0]


def test_the_number_of_branches_follows_noise_and_time() -> None:
    """(A + B / k)(1 + r k) with r = share (1 + events) / 2, at most twice the time of k = 1, and a gain of 1.1.

    B = 9 A, r = 0.1: least at k = sqrt(90), so 4, at 1.4 / 1.1 of the time. r = 1: at k = 3, at 4 / 2 of the time. r = 4: k of
    2 has 9 / 5 of the time and (1 + 4.5) / 10 of the noise, a gain of 1.01. B = A / 9: no k pays.
    """
    assert count_of(1.0, 9.0, 0.1, 1.0) == 4
    assert count_of(1.0, 9.0, 0.5, 3.0) == 3
    assert count_of(1.0, 9.0, 1.0, 7.0) == 1
    assert count_of(9.0, 1.0, 0.1, 1.0) == 1
    assert count_of(0.0, 0.0, 0.1, 1.0) == 1
    assert count_of(1.0, 9.0, 0.1, 1.0, samples=1 << 15) == 1


def test_near_light_on_segments_makes_branches_dear() -> None:
    """An event costs 1.2, at most 1.6 times the time of k = 1.

    B = 9 A, r = 0.17: at k = 4 1.44 times the time. r = 0.85: 1.46 times at k = 2, 1.92 at 3. A = B, r = 2: k = 2 has 5 / 3 of
    the time; r = 0.65: (1 + 0.5) / 2 of the noise in 2.3 / 1.65 of the time, a gain of 0.96.
    """
    assert count_of(1.0, 9.0, 0.1, 1.0, near=True) == 4
    assert count_of(1.0, 9.0, 0.5, 1.0, near=True) == 2
    assert count_of(1.0, 9.0, 0.5, 3.0, near=True) == 1
    assert count_of(1.0, 1.0, 0.223, 2.0, near=True) == 1


def test_a_preview_finds_the_noise_behind_collisions(monkeypatch: pytest.MonkeyPatch) -> None:
    """An image of enough samples is measured, and a smaller one is not."""
    scene = peaked(even=True)
    assert "paths in images" not in explain(scene, 6)
    monkeypatch.setattr(choices, "MIN_BRANCHING_SAMPLES", 64)
    assert "2 branches behind their first collision" in explain(scene, 6)


@pytest.mark.parametrize("even", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_a_crop_has_the_pixels_of_the_whole_picture(even: bool) -> None:
    """Its branches and tables are those of the whole film, though the crop alone has too few samples for a preview.

    Mitsuba rounds positions on a crop otherwise, by which a path may turn: pixels agree to rounding, but for one in fifty.
    """
    matter, images = peaked(even).shapes()[0], []
    for crop in ({}, {"crop_width": 10, "crop_height": 9, "crop_offset_x": 7, "crop_offset_y": 8}):
        sensor = camera((1.5, -2.5, 1.2), (0, 0, 0), res=24, fov=40)
        sensor["film"] |= crop
        sensor["sampler"]["sample_count"] = 128
        scene = mi.load_dict({"type": "scene", "matter": matter, "sun": sun([0.3, 0.2, -1.0])[0], "sensor": sensor})
        images.append(np.array(mi.render(scene, integrator=mi.load_dict(mivol(max_depth=6)))))
    assert ("2 branches" in explain(scene, 6)) == even
    assert np.isclose(images[0][8:17, 7:17], images[1], rtol=1e-4).mean() > 0.98


def lit_from_inside() -> dict:
    """Smoke with a lamp inside, and the sun, over a floor."""
    down = mi.ScalarTransform4f().translate([0, 0, -1.3]).scale(3)
    floor = {"type": "rectangle", "to_world": down, "bsdf": {"type": "diffuse"}}
    lamp = {"type": "point", "position": [0.1, 0.2, 0.1], "intensity": 1.0}
    return {"matter": smoke(rough_grid(5, 4.0), 0.9)[0], "floor": floor, "lamp": lamp, "sun": sun([0.3, 0.2, -1.0])[0]}


def coloured_beside_glass() -> dict:
    """An rgb extinction beside a refracting ball of fog."""
    values = np.concatenate([rough_grid(4, 3.0) * k for k in (1, 0.2, 2)], axis=-1)
    box = box_of(medium("mivol_medium", grid_volume("mivol_voxels", values, PLACE), 0.9), PLACE)
    ball = ball_of(medium("mivol_medium", 1.5, 0.8), (0.3, 1.7, 0.4), 0.5) | {"bsdf": {"type": "dielectric", "int_ior": 1.3}}
    return {"box": box, "ball": ball, "sky": sky(0.5), "sun": sun([0.3, 0.2, -1.0])[0]}


@pytest.mark.slow
@pytest.mark.statistical
@pytest.mark.parametrize("parts", [lit_from_inside, coloured_beside_glass])
def test_branches_keep_the_mean(parts: Callable[[], dict], monkeypatch: pytest.MonkeyPatch) -> None:
    """The mean equals the mean of whole paths."""
    scene, found = close_up(parts(), res=8), []
    for first, count in ((0, 1), (100, 3)):
        monkeypatch.setattr(plan, "choose_image_branches", lambda *_, count=count: (count, []))
        # An integrator keeps its plan.
        found.append(over_pixels(moments(scene, mivol(max_depth=8), 512, first=first)))
    whole, branched = found
    assert_same_mean(branched, whole, rounding=1e-6, what="radiance")
    assert_precise(difference(branched, whole), 0.03 * whole.mean, what="radiance")


def test_a_large_image_has_a_kernel_of_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its paths are those of the kernel that smaller images share with stems and branches, and pass through no memory."""
    calls = []
    monkeypatch.setattr(render_tasks, "walk_light", lambda *given, **more: calls.append(1) or walk_light(*given, **more))
    scene = close_up({"matter": smoke(rough_grid(7, 6.0), 0.9)[0], "sky": sky()}, res=8)
    pictures = []
    for least in (1 << 16, 1):
        monkeypatch.setattr(render_tasks, "OWN_KERNEL", least)
        pictures.append(np.array(mi.render(scene, integrator=mi.load_dict(mivol(max_depth=5)), spp=4, seed=3)))
    assert len(calls) == 1
    # Sums of 4 samples a pixel of some ten factors each.
    np.testing.assert_allclose(pictures[1], pictures[0], rtol=4 * 10 * 2.0**-24)
