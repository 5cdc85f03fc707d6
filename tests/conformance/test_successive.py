"""Paths that a lane walks one after the other: each is walked once, as if alone, and a plan takes them where they pay."""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from false_alarms import assert_precise, assert_same_mean, difference, over_pixels
from scattering_scenes import PLACE, close_up, mivol, moments, rough_grid, smoke, sun

from mivol.experiments.script import explain
from mivol.scene.needs import find_needs
from mivol.scene.plan import build_estimators, make_plan
from mivol.scene.survey import survey_scene
from mivol.transport.path import successive
from mivol.transport.path.estimators import Settings
from mivol.transport.path.film import RenderSamples, film_passes
from mivol.transport.path.successive import paths_per_lane, walk_successively
from scenes import box_of, medium, sky

pytestmark = pytest.mark.usefixtures("variant_rgb")

ENDLESS = mivol(max_depth=-1)


def radiance(scene: mi.Scene, count: int) -> np.ndarray:
    """Radiance and alpha (4, 3 * 8 * 8) of three samples per pixel."""
    settings, sensor, survey = Settings(max_depth=-1), scene.sensors()[0], survey_scene(scene)
    with dr.suspend_grad():
        needs = find_needs(scene, sensor, survey, 3)
        estimators = build_estimators(scene, needs, make_plan(needs, settings), settings, survey, for_images=True)
        rays = next(film_passes(RenderSamples(sensor, 5, 3, 1 << 20)))
        L, alpha = walk_successively(estimators, rays.sampler, rays.ray, count)
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
    for depth in (-1, 17, 16):
        mi.render(scene, integrator=mi.load_dict(mivol(max_depth=depth)), spp=8)
    assert counts == [8, 8]  # 512 paths
    assert "up to 16 paths one after the other" in explain(scene, -1)
    assert "lanes" not in explain(scene, 16)
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
