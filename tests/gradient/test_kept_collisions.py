"""Derivatives by albedos alone, from collisions in memory: those of replays, also where an albedo is 0."""

from __future__ import annotations

from types import SimpleNamespace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from false_alarms import Estimate, assert_precise, assert_same_mean, difference, fresh
from scattering_gradients import BATCHES, backward, note_ways, upper_half
from scattering_scenes import PLACE, cases, close_up, mivol, rough_grid, sun

from mivol.scene import render_tasks
from mivol.transport.path import derivatives
from mivol.transport.path.kept_collisions import KeptCollisions
from mivol.validate.statistics import Moments
from scenes import ball_of, box_of, grid_volume, medium, sky

SMOKE = "smoke.interior_medium."
DENSITY, ALBEDO = SMOKE + "sigma_t.data", SMOKE + "albedo.data"
SUN, FLOOR = "sun.irradiance.value", "floor.bsdf.reflectance.value"


def smoky(least: float = 0.3, g: float = 0.0, rgb: bool = False, **parts: dict) -> mi.Scene:
    """A grid under the sun; its albedo grid has values from ``least`` on."""
    density = 0.1 + rough_grid(4, 3.0)
    density = np.concatenate([density, 0.2 * density, 2 * density], axis=-1) if rgb else density
    albedo = grid_volume("mivol_voxels", least + 0.5 * rough_grid(5, 1.0, (3, 3, 3)), PLACE)
    interior = medium("mivol_medium", grid_volume("mivol_voxels", density, PLACE), albedo, phase={"type": "mivol_hg", "g": g})
    return close_up({"smoke": box_of(interior, PLACE), "sun": sun([0.3, 0.2, -1.0])[0], **parts}, res=8)


def floor() -> dict:
    down = mi.ScalarTransform4f().translate([0, 0, -1.3]).scale(3)
    return {"type": "rectangle", "to_world": down, "bsdf": {"type": "diffuse", "reflectance": 0.6}}


def ball() -> dict:
    """A ball of fog in glass, whose boundary is traced."""
    return ball_of(medium("mivol_medium", 1.5, 0.8), (0.3, -1.7, 0.4), 0.5) | {"bsdf": {"type": "dielectric"}}


def half_black() -> mi.Scene:
    """Albedos of 0 in half of a grid, and for one colour in another quarter."""
    albedo = 0.2 + 0.7 * np.random.default_rng(3).random((4, 3, 3, 3))
    albedo[:2], albedo[2, :, :, 1] = 0, 0
    interior = medium("mivol_medium", 2.0, grid_volume("mivol_voxels", albedo, PLACE))
    return close_up({"smoke": box_of(interior, PLACE), "lit": sky(0.3), "floor": floor()}, res=8)


SCENES = {
    "floor": lambda: smoky(floor=floor(), lit=sky(0.3)),
    "rgb": lambda: smoky(rgb=True, floor=floor()),
    "beside fog in glass": lambda: smoky(fog=ball(), lit=sky(0.3)),
}
WEIGHT = np.full((8, 8, 3), 1 / 192)


@pytest.fixture
def walked(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The ways by which derivatives are found."""
    return note_ways(monkeypatch, "replay_branches", "collect_albedo_derivatives")


@pytest.mark.usefixtures("traced_balls")
@pytest.mark.parametrize("name", cases(SCENES, slow=("rgb", "beside fog in glass")))
def test_collisions_give_the_derivative_of_replays(name: str, walked: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """With the same random numbers: the same terms in another order; also in parts, with room for one path in eight."""
    found = []
    for keeps, most in ((True, 1 << 22), (True, 1 << 11), (False, 1 << 22)):
        monkeypatch.setattr(derivatives, "MAX_KEPT_COLLISIONS", most)
        if not keeps:
            monkeypatch.setattr(render_tasks, "keeps_collisions", lambda estimators: False)
        found.append(backward(SCENES[name](), ALBEDO, WEIGHT, 64, fresh(3), mi.load_dict(mivol(max_depth=5, rr_depth=3))))
    assert walked == ["collect_albedo_derivatives"] * 2 + ["replay_branches"]
    assert np.abs(found[0]).max() > 0
    for other in found[1:]:
        # A voxel has at most 4096 float32 terms of both signs.
        np.testing.assert_allclose(other, found[0], rtol=1e-4, atol=1e-5 * np.abs(found[0]).max())


def along_albedo(scene: mi.Scene, v: np.ndarray, beside: str | None = None) -> Estimate:
    """The derivative of the mean image along a change of the albedo, with derivatives by another parameter beside it."""
    integrator, params, found = mi.load_dict(mivol(max_depth=6, rr_depth=3)), mi.traverse(scene), []
    for k in range(BATCHES):
        followed = {}
        for key in [ALBEDO, beside] if beside else [ALBEDO]:
            followed[key] = params[key] = type(params[key])(dr.detach(params[key]))
            dr.enable_grad(params[key])
        params.update()
        seed = fresh(k + 100 * bool(beside))
        integrator.render_backward(scene, params, mi.TensorXf(WEIGHT.astype(np.float32)), seed=seed, spp=256)
        found.append(np.sum(np.array(dr.grad(params[ALBEDO]), np.float64) * v))
        for key in followed:
            dr.disable_grad(params[key])
    return Estimate.from_result(Moments.from_values(np.array(found)[:, None]))


@pytest.mark.slow
@pytest.mark.statistical
def test_an_albedo_of_zero_has_the_derivative_of_probes(walked: list[str]) -> None:
    """Beside derivatives by a floor, replays find those by low albedos from points beside the collisions."""
    scene = half_black()
    low = np.array(mi.traverse(scene)[ALBEDO]) < 0.1
    for v in (upper_half(scene, ALBEDO) * low, upper_half(scene, ALBEDO) * ~low):
        found, probes = along_albedo(scene, v), along_albedo(scene, v, FLOOR)
        assert_same_mean(found, probes, rounding=1e-4 * np.abs(probes.mean), what="derivative")
        assert_precise(difference(found, probes), 0.03 * np.abs(probes.mean), what="derivative")
    assert set(walked) == {"collect_albedo_derivatives", "replay_branches"}


def test_later_gradients_are_those_of_their_seeds() -> None:
    """A replayed recording keeps the collisions of its own call."""
    scene, integrator = half_black(), mi.load_dict(mivol(max_depth=4))
    later = [backward(scene, ALBEDO, WEIGHT, 16, seed, integrator) for seed in (1, 2, 3, 4)]
    for seed, found in enumerate(later, 1):
        alone = backward(half_black(), ALBEDO, WEIGHT, 16, seed, mi.load_dict(mivol(max_depth=4)))
        np.testing.assert_allclose(found, alone, rtol=1e-4, atol=1e-5 * np.abs(alone).max())
    assert np.abs(later[0] - later[3]).max() > 1e-3 * np.abs(later[0]).max()


def test_replays_follow_whatever_else_depends_on_an_albedo(walked: list[str]) -> None:
    """The sun or the density beside the albedo, no limit of the depth, side flights, and near light."""

    def differentiate(scene: mi.Scene, *keys: str, depth: int = 3) -> None:
        params = mi.traverse(scene)
        for key in keys:
            dr.enable_grad(params[key])
        mi.load_dict(mivol(max_depth=depth)).render_backward(scene, params, dr.ones(mi.TensorXf, (8, 8, 3)), seed=0, spp=1)

    differentiate(smoky(), ALBEDO)
    assert walked == ["collect_albedo_derivatives"]
    differentiate(smoky(), ALBEDO, DENSITY)
    differentiate(smoky(), ALBEDO, SUN)
    differentiate(smoky(), ALBEDO, depth=-1)
    differentiate(smoky(g=0.8), ALBEDO)
    differentiate(smoky(lamp={"type": "point", "position": [0.3, 0.1, 0.2], "intensity": 1.0}), ALBEDO)
    assert walked[1:] == ["replay_branches"] * 5


def test_the_loop_over_collisions_is_the_product_rule() -> None:
    """Two paths through media of constant albedos, with zeros; each derivative in float64 by the formula of the module."""
    albedos = np.array([[0.9, 0.0, 0.5], [0.7, 0.02, 0.0], [0.0, 0.3, 0.05]])
    rows = [mi.Color3f(*row.tolist()) for row in albedos]
    dr.enable_grad(rows)
    media = SimpleNamespace(
        bodies=[
            SimpleNamespace(view=SimpleNamespace(albedo=a), follows_albedo=True, has_low_albedo=True, least_albedo=0.0)
            for a in rows
        ],
        medium_of=lambda number, on: dr.zeros(mi.MediumPtr, dr.width(number)),
    )
    media.bodies_at = lambda index, on: [(body, on & (index == k)) for k, body in enumerate(media.bodies)]
    paths, lights = [[0, 1, 0], [2]], np.random.default_rng(1).uniform(0.5, 1.5, (2, 4, 3))
    dL = np.array([[1.0, 2.0, 3.0], [0.5, 1.5, 2.5]])
    kept = KeptCollisions.empty(media, 2, 3)
    assert {body.least_albedo for body in media.bodies} == {0.1}
    followed = np.maximum(albedos, 0.1)
    for i, path in enumerate(paths):
        index = mi.UInt32(i)
        for k, body in enumerate(path):
            # A walk multiplies its light by the albedos that it follows.
            met = lights[i, k] * np.prod(followed[path[:k]], axis=0)
            point, on = mi.Point3f(0), mi.Bool(True)
            index, written = kept.keep(index, point, mi.UInt32(body), mi.Color3f(*met.tolist()), on)
            assert written[0]
    last = [lights[i, len(path)] * np.prod(followed[path], axis=0) for i, path in enumerate(paths)]
    L = mi.Color3f(*(mi.Float(np.float32([row[c] for row in last])) for c in range(3)))
    weight = mi.Color3f(*(mi.Float(np.float32(dL[:, c])) for c in range(3)))
    with dr.suspend_grad(), dr.isolate_grad():
        kept.add_derivatives(mi.UInt32([0, 1]), mi.UInt32([6, 3]), L, weight)
    expected = np.zeros((3, 3))
    for i, path in enumerate(paths):
        for k, body in enumerate(path):
            before = np.prod(albedos[path[:k]], axis=0)
            behind = lights[i, len(path)]
            for later in range(len(path) - 1, k, -1):
                behind = lights[i, later] + albedos[path[later]] * behind
            expected[body] += dL[i] * before * behind
    found = np.array([np.array(dr.grad(row)).ravel() for row in rows], np.float64)
    np.testing.assert_allclose(found, expected, rtol=1e-5)
