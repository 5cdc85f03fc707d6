"""Emitters of every kind light a medium as in volpath; random numbers and equiangular distances of their samples."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import scattering_scenes as small
from false_alarms import Estimate, assert_same_mean
from scattering_scenes import assert_same_images, close_up, mivol, moments, rough_grid, smoke
from volpath_scenes import EMITTERS, same

from mivol.transport.estimators.lighting.emitters import (
    EquiangularSampler,
    EventSamples,
    SceneEmitters,
    find_even_share,
    make_ball_sampler,
    read_emitters,
)
from mivol.transport.traversal.random_numbers import fork_state


@pytest.mark.slow_for("envmap", "several")
@pytest.mark.statistical
@pytest.mark.parametrize(
    # Several have a constant sky, a point, a sun and an area among them.
    "name",
    small.cases(EMITTERS, [name for name in EMITTERS if name not in ("envmap", "several")]),
)
def test_emitters(name):
    box, _ = smoke(rough_grid(1), name="hg", g=0.4)
    image, _ = same({"smoke": box, **EMITTERS[name]()}, precision=0.02)
    assert image.mean.min() >= 0


def test_no_emitter_at_all():
    """Without emitters the image is exactly black, and its gradient is 0."""
    box, _ = smoke(rough_grid(1))
    scene = close_up({"smoke": box})
    assert not moments(scene, mivol(), 4, 2).mean.any()
    params = mi.traverse(scene)
    key = "smoke.interior_medium.sigma_t.data"
    dr.enable_grad(params[key])
    dr.backward(dr.mean(mi.render(scene, params, integrator=mi.load_dict(mivol()), spp=4), axis=None))
    assert not np.any(dr.grad(params[key]))


def test_what_is_sampled_and_what_is_seen_through() -> None:
    """Phase samples find a constant sky; a masked panel transmits; directions of the phase function hit an opaque panel."""
    panel = {"type": "rectangle", "emitter": {"type": "area", "radiance": 1.0}}
    masked = {"type": "mask", "opacity": 0.5, "nested": {"type": "diffuse"}}
    sun = {"type": "directional", "direction": [0, 0, -1]}
    near = {"type": "point", "position": [0, 1, 2]}
    scene = mi.load_dict({"type": "scene", "sky": {"type": "constant"}, "a": panel, "b": {**panel, "bsdf": masked}, "sun": sun})
    found = SceneEmitters(scene)
    assert sorted(e.class_name() for e in found.sampled) == ["AreaLight", "AreaLight", "DirectionalEmitter"]
    (seen_through,) = found.transmissive
    assert seen_through is scene.shapes()[1].emitter() or seen_through is scene.shapes()[0].emitter()
    assert mi.has_flag(seen_through.get_shape().bsdf().flags(), mi.BSDFFlags.Null)
    assert found.samples_phase and found.is_near
    assert sum(found.bounding_ball(k) is None for k in range(3)) == 1
    for emitter, at_hand in ((sun, False), (near, True), ({**panel, "bsdf": masked}, True)):
        found = SceneEmitters(mi.load_dict({"type": "scene", "only": emitter}))
        assert not found.samples_phase and found.is_near == at_hand


def samples() -> EventSamples:
    u, uv = mi.Float(0.3), mi.Point2f(0.6, 0.9)
    return EventSamples(mi.UInt32(5), uv, u, uv, u, uv, u)


def test_each_event_draws_directions_from_its_part_of_the_square():
    """Four events: one in each quarter, for emitters and for the phase function."""
    parts = [samples().for_event(mi.UInt32(k), 4) for k in range(4)]
    for name in ("emitter", "direction"):
        cells = [tuple(np.floor(2 * np.array(getattr(p, name)).ravel()).astype(int)) for p in parts]
        assert cells == [(0, 0), (1, 0), (0, 1), (1, 1)]


def test_events_of_a_ray_share_the_emitter_and_little_else():
    first, second = (samples().for_event(mi.UInt32(k), 4) for k in range(2))
    assert first.which_emitter[0] == second.which_emitter[0] == np.float32(0.3)
    assert second.component[0] == pytest.approx((0.3 + 0.6180339887) % 1, abs=2.0**-23)
    assert np.array(second.inside).ravel() == pytest.approx([(0.6 + 0.7548776662) % 1, (0.9 + 0.5698402910) % 1], abs=2.0**-22)


def test_walks_of_a_ray_and_of_its_events_have_generators_of_their_own():
    """Of two events: two for the pieces of the ray, and two for the shadow rays of each event. Of one: one, and two."""
    for count in (1, 2):
        events = [samples().for_event(mi.UInt32(k), count) for k in range(count)]
        states = [fork_state(samples().generator, k) for k in range(count)]
        states += [fork_state(event.generator, k) for event in events for k in range(2)]
        assert len({state[0] for state in states}) == 3 * count
    assert events[0].which_emitter[0] == np.float32(0.3)


ROUNDING = 2.0**-22


def pieces(n: int = 2000) -> tuple[np.ndarray, ...]:
    """Pieces [a, a + dt] of rays, the nearest distance t0 and rho of an emitter, and numbers u, as float32."""
    rng = np.random.default_rng(5)
    a, t0 = rng.uniform(0, 4, (2, n))
    dt, rho = 10 ** rng.uniform([[-2], [-5]], 1, (2, n))
    return tuple(x.astype(np.float32).astype(np.float64) for x in (a, dt, t0, rho, rng.uniform(0.01, 0.99, n)))


def sampler_of(t0: np.ndarray, rho: np.ndarray) -> EquiangularSampler:
    return EquiangularSampler(mi.Float(t0), mi.Float(rho), mi.Bool(True))


def angle_error(a: np.ndarray, dt: np.ndarray, t0: np.ndarray, rho: np.ndarray, theta: np.ndarray) -> np.ndarray:
    near, far = a - t0, a + dt - t0
    return ROUNDING * (theta + (np.abs(near * far) + rho**2) / np.hypot(rho * dt, near * far + rho**2))


def test_samples_divide_the_angle():
    """A distance drawn with u divides the angle in u : 1 - u; a distance rounded by e moves the angle by e rho / r^2."""
    a, dt, t0, rho, u = pieces()
    sampler = sampler_of(t0, rho)
    t = np.array(sampler.sample(mi.Float(a), mi.Float(dt), mi.Float(u)), dtype=np.float64)
    assert (t >= 0).all() and (t <= dt).all()
    begin, there, end = (np.arctan((x - t0) / rho) for x in (a, a + t, a + dt))
    # t = rho sin (1 + x^2) / (cos - x sin): its denominator is cancelled by at most its terms, 1 + |x|, x = (a - t0) / rho.
    x, part = (a - t0) / rho, u * (end - begin)
    lost = ROUNDING * (1 + np.abs(x)) / np.abs(np.cos(part) - x * np.sin(part))
    moved = (4 * ROUNDING + lost) * t * rho / (rho**2 + (a + t - t0) ** 2)
    np.testing.assert_array_less(np.abs(there - begin - part), 2 * (moved + angle_error(a, dt, t0, rho, end - begin)))


def test_density_is_the_derivative_of_the_angle():
    a, dt, t0, rho, u = pieces()
    t = (u * dt).astype(np.float32).astype(np.float64)
    found = np.array(sampler_of(t0, rho).density(mi.Float(a), mi.Float(dt), mi.Float(t)), dtype=np.float64)
    theta = np.arctan((a + dt - t0) / rho) - np.arctan((a - t0) / rho)
    exact = rho / ((rho**2 + (a + t - t0) ** 2) * theta)
    # r^2 has the rounding of (a - t0) + t, whose square it holds.
    off = np.abs(a - t0) + t
    relative = angle_error(a, dt, t0, rho, theta) / theta + ROUNDING * (2 + 2 * off**2 / (rho**2 + (a + t - t0) ** 2))
    np.testing.assert_array_less(np.abs(found - exact), relative * exact)


def test_smallest_distance_and_inverse_square():
    """Before, in and behind the piece [1, 3], and at infinity."""
    t0, rho = np.array([0.5, 1.5, 4.0]), np.array([0.25, 1e-3, 2.0])
    sampler, a, dt = sampler_of(t0, rho), mi.Float(1), mi.Float(2)
    assert np.array(sampler.nearest(a, dt)) == pytest.approx(np.hypot(rho, [0.5, 0, 1]), rel=1e-6)
    mean = (np.arctan((3 - t0) / rho) - np.arctan((1 - t0) / rho)) / (2 * rho)
    assert np.array(sampler.evenness(a, dt)) == pytest.approx(1 / (rho**2 + [6.25, 2.25, 9]) / mean, rel=1e-5)
    assert EquiangularSampler(mi.Float(0), mi.Float(1), mi.Bool(False)).evenness(a, dt)[0] == 1


def test_mean_of_the_inverse_square():
    """theta / (rho dt) where the emitter has a place, 1 where it is at infinity."""
    ray = mi.Ray3f(mi.Point3f(0, 0, 0), mi.Vector3f(0, 0, 1), dr.inf, mi.Float(0), mi.Color0f())
    found = make_ball_sampler(ray, [3.0, 0.0, 4.0, 0.0]).mean(mi.Float(4), mi.Float(3))
    assert found[0] == pytest.approx(np.arctan(1) / 9, rel=1e-5)  # 4e-12 of the squared distance is added to rho^2
    assert make_ball_sampler(ray, None) is None
    assert EquiangularSampler(mi.Float(0), mi.Float(1), mi.Bool(False)).mean(mi.Float(4), mi.Float(3))[0] == 1


# -- Lamps with hidden sides ------------------------------------------------------------------------------------------------


def box_lamp(radiance: float = 2.0, at: tuple = (0.6, -0.4, 2.0)) -> dict:
    """A flat box, turned, that shines from all its sides; by default above a smoke."""
    place = mi.ScalarTransform4f().translate(list(at)).rotate([0.6, 0.8, 0], 50).scale([0.5, 0.3, 0.1])
    black = {"type": "diffuse", "reflectance": 0.0}
    return {"type": "cube", "to_world": place, "bsdf": black, "emitter": {"type": "area", "radiance": radiance}}


def solid_angle(vertices: np.ndarray, faces: np.ndarray, p: np.ndarray) -> float:
    """Of a convex mesh, in float64 (van Oosterom and Strackee 1983): its near side and its far side have the same."""
    a, b, c = (vertices[faces[:, k]] - p for k in range(3))
    volume = np.einsum("ij,ij->i", a, np.cross(b, c))
    x, y, z = (np.linalg.norm(v, axis=1) for v in (a, b, c))
    dots = [np.einsum("ij,ij->i", u, v) for u, v in ((a, b), (b, c), (c, a))]
    angles = 2 * np.arctan2(volume, x * y * z + dots[0] * z + dots[1] * x + dots[2] * y)
    return float(np.abs(angles).sum() / 2)


@pytest.mark.statistical
@pytest.mark.parametrize("p", [(0.0, 0.0, 0.0), (1.3, 0.6, 1.5), (-3.0, 1.0, 6.0)])
def test_the_light_of_a_box_is_its_solid_angle(p: tuple) -> None:
    """One point of four has the mean of all, less than half of the variance, and Mitsuba's density for the power heuristic."""
    scene, n = mi.load_dict({"type": "scene", "lamp": box_lamp(2.0)}), 1 << 16
    (shape,) = scene.shapes()
    params = mi.traverse(shape)
    vertices, faces = (np.array(params[k]).reshape(-1, 3) for k in ("vertex_positions", "faces"))
    found, it = SceneEmitters(scene), dr.zeros(mi.Interaction3f, n)
    it.p = mi.Point3f(*p)
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(3, n)
    u, on = sampler.next_2d(), dr.full(mi.Bool, True, n)
    draw = found.sample_direction(it, u, on)
    light, alone = (np.array(w.x, np.float64) for w in (draw.weight, scene.emitters()[0].sample_direction(it, u, on)[1]))
    truth = 2.0 * solid_angle(vertices.astype(np.float64), faces.astype(int), np.array(p))
    assert_same_mean(Estimate(light.mean(), light.var(ddof=1) / n, n), truth, rounding=1e-5 * truth, what="the light of a box")
    assert light.var() < 0.5 * alone.var()
    lit = light > 0
    density = np.array(found.pdf_direction(it, draw.direct, on))
    np.testing.assert_allclose(np.array(draw.density)[lit], density[lit], rtol=1e-4)
    np.testing.assert_allclose(light[lit], 2.0 / np.array(draw.direct.pdf)[lit], rtol=1e-5)
    # Chosen among others, the lamp has the probability times the density, and its light over the probability.
    chosen = found.draw_direction(it, mi.EmitterPtr(scene.emitters()[0]), mi.Float(0.25), u, on)
    for name, factor in (("density", 0.25), ("weight", 4)):
        np.testing.assert_allclose(np.array(getattr(chosen, name)), factor * np.array(getattr(draw, name)), rtol=1e-5)
    np.testing.assert_allclose(np.array(chosen.direct.pdf), 0.25 * np.array(draw.direct.pdf), rtol=1e-5)


@pytest.mark.statistical
@pytest.mark.parametrize("depth", [2, pytest.param(4, marks=pytest.mark.slow)])
def test_a_box_over_a_smoke_and_a_floor(variant_rgb: str, depth: int) -> None:
    """The floor close to the box is lit by emitter samples and by directions that meet the box, in about equal parts."""
    box, _ = smoke(rough_grid(1), name="hg", g=0.4)
    floor = {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([0, 0, -1]).scale(4)}
    scene, depths = close_up({"smoke": box, "lamp": box_lamp(3.0, (0.9, -0.9, -0.4)), "floor": floor}), {"max_depth": depth}
    assert_same_images(scene, (64, 256), tile=2, ours=mivol(**depths), stock=small.volpath(**depths), precision=0.01)


@pytest.mark.statistical
def test_the_derivative_by_the_radiance_of_a_box(variant_rgb: str) -> None:
    """The image is in proportion to the radiance."""
    box, _ = smoke(rough_grid(1))
    scene, ours = close_up({"smoke": box, "lamp": box_lamp(30.0)}), mi.load_dict(mivol(max_depth=3))
    params, means, key = mi.traverse(scene), [], "lamp.emitter.radiance.value"
    for seed in range(32):
        dr.enable_grad(params[key])
        dr.set_grad(params[key], 0)
        image = dr.mean(mi.render(scene, params, integrator=ours, spp=16, seed=2 * seed, seed_grad=2 * seed + 1), axis=None)
        dr.backward(image)
        means.append((float(np.ravel(image)[0]), 30.0 * float(np.sum(dr.grad(params[key])))))
    image, along = np.array(means).T
    assert_same_mean(*(Estimate(v.mean(), v.var(ddof=1) / len(v), len(v)) for v in (along, image)), what="along the radiance")
    assert along.std(ddof=1) / len(along) ** 0.5 < 0.02 * along.mean()


def test_the_even_share_follows_sampling_weights(variant_rgb: str) -> None:
    """A sky with the share s has w s / (w s + 1 - s) with the weight w, whether the weights are read before or not."""
    shares = []
    for weight in (1.0, 3.0):
        sky = {"type": "constant", "radiance": 0.2, "sampling_weight": weight}
        scene = mi.load_dict({"type": "scene", "sky": sky, "sun": {"type": "directional", "irradiance": 2.0}})
        shares.append([float(find_even_share(scene, numbers)[0]) for numbers in (None, read_emitters(scene))])
    (share, read), (weighted, read_weighted) = shares
    assert 0.1 < share < 0.9 and (share, weighted) == (read, read_weighted)
    assert weighted == pytest.approx(3 * share / (3 * share + 1 - share), rel=1e-5)
