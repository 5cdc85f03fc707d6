"""A loop that makes a new integrator in each step replays the recordings of earlier steps; scenes are freed all the same."""

from __future__ import annotations

from weakref import ref

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scattering_scenes import close_up, mivol, rough_grid, smoke

from mivol.scene.session import MAX_KEPT
from mivol.threads import set_thread_count
from scenes import sky

pytestmark = pytest.mark.usefixtures("cpu_back_end", "shared_sessions")

KEY = "smoke.interior_medium.sigma_t.data"


def smoke_in_the_sky() -> mi.Scene:
    return close_up({"smoke": smoke(rough_grid(4, 3.0), 0.8)[0], "sky": sky(0.7)}, res=4)


def render(scene: mi.Scene, integrator: mi.Integrator, seed: int = 0) -> np.ndarray:
    return np.array(mi.render(scene, integrator=integrator, seed=seed, spp=2))


def load(**more: object) -> mi.Integrator:
    return mi.load_dict(mivol(**{"max_depth": 3, **more}))


def test_a_new_integrator_in_each_step_replays() -> None:
    """Images and gradients equal those of an integrator that has rendered nothing else."""
    scene, counts = smoke_in_the_sky(), []
    params = mi.traverse(scene)
    set_thread_count(1)  # sums over lanes then have one order

    def step(integrator: mi.Integrator, seed: int) -> tuple[np.ndarray, np.ndarray]:
        value = type(params[KEY])(dr.detach(params[KEY]))
        dr.enable_grad(value)
        params[KEY] = value
        params.update()
        image = mi.render(scene, params, integrator=integrator, seed=seed, spp=2)
        dr.backward(dr.mean(image, axis=None))
        return np.array(image), np.array(dr.grad(value))

    for seed in range(6):
        image, gradient = step(integrator := load(), seed)
        counts.append(integrator.session.recordings.count)
        # Paths of three vertices end before these depths of Russian roulette, which no other integrator has.
        truth, its_gradient = step(load(rr_depth=100 + seed), seed)
        assert np.array_equal(image, truth) and truth.max() > 0
        # Kernels of other inputs may sum in another order: some 200 terms in a voxel.
        assert np.abs(gradient - its_gradient).max() <= 200 * 2**-24 * np.abs(its_gradient).max() > 0
        params[KEY] = type(params[KEY])(dr.detach(params[KEY]) * 0.9)
        params.update()
    assert counts[3] == counts[5] > 0


def test_only_a_freed_integrator_with_equal_settings_gives_its_session() -> None:
    scene, other = smoke_in_the_sky(), smoke_in_the_sky()
    first = load()
    session = first.session
    render(scene, first)
    second = load()
    render(scene, second)
    assert second.session is not session
    del first
    for given, where in (({"aovs": "tau"}, scene), ({}, other)):
        third = load(**given)
        render(where, third)
        assert third.session is not session
    # An integrator with a session in use keeps it.
    own = second.session
    render(scene, second)
    assert second.session is own
    third = load()
    render(scene, third)
    assert third.session is session
    third.render_backward(scene, None, dr.ones(mi.TensorXf, (4, 4, 3)), spp=2)
    assert third.session is session


@pytest.mark.parametrize("order", ["scene first", "integrator first", "scene with its own integrator"])
def test_a_scene_that_nobody_else_holds_is_freed(order: str) -> None:
    """With its recordings: a session is an object in Python, which takes weak references."""
    scene, integrator = smoke_in_the_sky(), load()
    if order.startswith("scene with"):
        scene = close_up({"sky": sky(0.7), "integrator": integrator}, res=4)
    session = ref(integrator.session)
    render(scene, integrator)
    if order == "integrator first":
        del integrator
        assert session() is not None
        del scene
        # The next integrator that renders.
        render(smoke_in_the_sky(), load())
    elif order == "scene first":
        del scene
        assert session() is not None
        del integrator
    else:
        del scene, integrator
    assert session() is None


def test_few_scenes_are_kept() -> None:
    """Scenes that somebody holds are released too, the one that was rendered least recently first."""
    held, sessions = [smoke_in_the_sky() for _ in range(MAX_KEPT + 1)], []
    for scene in held:
        integrator = load()
        render(scene, integrator)
        sessions.append(ref(integrator.session))
        del integrator
    assert [session() is None for session in sessions] == [True] + [False] * MAX_KEPT
