"""Derivatives of emitted light: forward against reverse, both against differences and, behind walls, against the twin."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import oracle_emission as twins
import pytest
from emission_scenes import (
    PLACE,
    B,
    aimed,
    changes,
    colours,
    directions,
    emitting,
    find,
    gradients,
    interior,
    light,
    moved,
    pencils,
    rough,
)

from mivol.scene import plan
from scenes import affine, as_float32, box_of, camera, centred, grid_volume

pytestmark = pytest.mark.usefixtures("traced_balls")

DATA = ("sigma_t.data", "albedo.data", "emission.data", "emission_density.data")
VALUE = ("sigma_t.value.value", "albedo.value.value", "emission.value.value", "emission_density.value.value")


def grids(channels: int, **more) -> twins.Medium:
    """Every coefficient a grid, none near the end of its domain."""
    tops = {"sigma": 2.0, "source": 1.0, "emission_density": 1.0, "albedo": 0.8}
    return twins.Medium(**{k: (rough(i, 0.1 * v, v, channels), PLACE) for i, (k, v) in enumerate(tops.items())} | more)


def constants() -> twins.Medium:
    return twins.Medium(as_float32([0.3, 0.6, 1.2]), as_float32([0.7, 0.4, 0.2]), as_float32([0.2, 0.3, 0.1]), 0.4)


def absorbing() -> dict:
    """sigma_a and sigma_s, as grids, with an emission."""
    parts = {"sigma_a": rough(1, 0.2, 2), "sigma_s": rough(2, 0.2, 2), "emission": rough(3, 0.2, 1, 3)}
    return {"type": "mivol_medium", **{k: grid_volume("mivol_voxels", v, PLACE) for k, v in parts.items()}}


CASES = {
    "one channel": (lambda: emitting(grids(1), scale=1.3), (*DATA, "scale")),
    "three channels": (lambda: emitting(grids(3)), DATA),
    "stock": (lambda: emitting(grids(3), kind="gridvolume"), DATA),
    "constants in a traced ball": (lambda: emitting(constants(), "ball"), VALUE),
    "constant extinction, gridded light": (
        lambda: emitting(grids(1, sigma=0.8, albedo=0.3), "larger"),
        (VALUE[0], VALUE[1], DATA[2], DATA[3]),
    ),
    "sigma_a and sigma_s": (
        lambda: pencils({"box": box_of(absorbing(), PLACE), "sky": colours(B)}, *aimed(1, 12)),
        ("sigma_a.data", "sigma_s.data", "emission.data"),
    ),
}
SLOW = ("three channels", "stock", "constant extinction, gridded light")


@pytest.mark.slow_for("constants in a traced ball", "one channel", "sigma_a and sigma_s")
@pytest.mark.parametrize("name", [pytest.param(n, marks=pytest.mark.slow if n in SLOW else ()) for n in CASES])
def test_every_coefficient(name):
    """J v = differences, and <J^T w, v> = <w, differences>, for each parameter by itself."""
    build, ends = CASES[name]
    seen = build()
    along = directions(seen.scene, ends)
    weight = np.random.default_rng(5).uniform(size=(12, 3))
    found = dict(zip(ends, gradients(seen, list(ends), weight), strict=True))
    jv = changes(seen, along)
    total, size = np.zeros((12, 3)), 0
    for end, v in along.items():
        truth = moved(seen.scene, {end: v}, lambda: light(seen))
        total, size = total + truth, max(size, np.abs(truth).max())
        assert np.abs(truth).max() > 1e-3, end
        # Rounding: 1.5 x 2e-7 / 0.05 = 6e-6 of an image of size 1; a derivative is a tenth of that.
        assert abs((found[end] * v).sum() - (truth * weight).sum()) <= 1e-4 * np.abs(truth * weight).sum(), end
    assert np.abs(jv - total).max() <= 1e-4 * size
    both = sum((found[end] * v).sum() for end, v in along.items())
    assert abs(both - (jv * weight).sum()) <= 2e-6 * sum(np.abs(found[end] * v).sum() for end, v in along.items())


@pytest.mark.slow_for("gridvolume")
@pytest.mark.parametrize("kind", [pytest.param("mivol_voxels", marks=pytest.mark.slow), "gridvolume"])
def test_a_texture_need_not_be_told(kind):
    """dr.enable_grad without params.update() leaves a texture without the derivative, which it must have all the same."""
    found = []
    for is_told in (False, True):
        seen = emitting(grids(3), kind=kind)
        params, integrator = mi.traverse(seen.scene), mi.load_dict({"type": "mivol", "max_depth": 1})
        key = find(params, "emission.data")
        dr.enable_grad(params[key])
        if is_told:
            params.update()
        integrator.render_backward(seen.scene, params, dr.ones(mi.TensorXf, (1, 12, 3)), seed=0, spp=1)
        found.append(np.array(dr.grad(params[key])))
    assert np.abs(found[0] - found[1]).max() <= 1e-5 * np.abs(found[1]).max() > 0


def picture(medium: dict, **more) -> mi.Scene:
    view = camera((2.0, 1.5, 3.0), (0.0, 0.0, 0.0), res=6, fov=40.0)
    return mi.load_dict({"type": "scene", "box": box_of(medium, PLACE), "sky": colours(B), "sensor": view, **more})


def in_passes(monkeypatch, passes: int, spp: int) -> None:
    monkeypatch.setitem(plan.PASS_RAYS, mi.variant().split("_")[0], 6 * 6 * spp // passes)


@pytest.mark.slow
@pytest.mark.parametrize(("ends", "channels", "depth"), [(DATA, 1, 1), (DATA, 3, 1), (DATA[1:2], 1, 2), (DATA[1:2], 3, 2)])
def test_several_passes_are_one(ends, channels, depth, monkeypatch):
    """A grid of three channels is padded inside its texture: its edge to the parameter can be passed but once.

    Of the four parameters together, each has a tenth of the sum or more.
    """
    medium = interior(grids(channels, **({"source": 0.0, "emission_density": 0.0} if depth == 2 else {})))
    scene, spp = picture(medium), 4
    w = np.random.default_rng(3).uniform(size=(6, 6, 3))
    along = directions(scene, ends)
    vjps, jvps = [], []
    for passes in (1, 4):
        in_passes(monkeypatch, passes, spp)
        vjps.append(gradients(scene, list(ends), w, spp, 3, max_depth=depth))
        jvps.append(changes(scene, along, spp, 3, max_depth=depth))
    # Each pass has its own numbers: what is the same is the sum that they make of their own.
    for found, jv in zip(vjps, jvps, strict=True):
        terms = [np.sum(g * v) for g, v in zip(found, along.values(), strict=True)]
        assert abs(sum(terms) - (jv * w).sum()) <= 5e-6 * np.abs(jv * w).sum()
        assert min(map(abs, terms)) > 0.1 * abs(sum(terms)) or len(terms) == 1
    # The jitter of four samples in 36 pixels; all passes but one lost would leave a quarter.
    for one, several in zip(*vjps, strict=True):
        assert abs(several.sum() / one.sum() - 1) < 0.3
    assert abs(jvps[1].sum() / jvps[0].sum() - 1) < 0.3


@pytest.mark.slow
def test_two_bodies_that_share_their_light():
    """One volume emits in two media: its gradient is that of both."""
    shared = mi.load_dict(grid_volume("mivol_voxels", rough(3, 0.2, 1, 3), centred(4 * np.eye(3))))
    places = [centred(0.9 * np.eye(3), (0, 0, z)) for z in (-0.6, 0.6)]
    media = [
        {"type": "mivol_medium", "sigma_t": grid_volume("mivol_voxels", rough(4 + i, 0, 3), p), "emission": shared}
        for i, p in enumerate(places)
    ]
    parts = {f"box{i}": box_of(m, p) for i, (m, p) in enumerate(zip(media, places, strict=True))}
    seen = pencils(parts | {"sky": colours(B)}, *aimed(2, 12))
    params = mi.traverse(seen.scene)
    keys = [k for k, _ in params if k.endswith("emission.data")]
    v = rough(8, 0.02, 0.18, 3)
    start = np.array(params[keys[0]])

    def at(k):
        for key in keys:
            params[key] = mi.TensorXf(as_float32(start + k * v).astype(np.float32))
        params.update()
        return light(seen)

    truth = (at(1) - at(-1)) / 2  # linear
    at(0)
    params = mi.traverse(seen.scene)
    w = np.random.default_rng(6).uniform(size=(12, 3))
    found = gradients(seen, [keys[0]], w)[0]
    assert len(keys) == 1 or np.abs(truth).max() > 0
    assert abs((found * v).sum() - (truth * w).sum()) <= 1e-5 * np.abs(truth * w).sum()


@pytest.mark.slow
def test_parameter_of_a_parameter():
    """Volumes whose values are computed from something else: the derivative passes on to that, in both modes."""
    seen = emitting(grids(3))
    scene, params, integrator = seen.scene, mi.traverse(seen.scene), mi.load_dict({"type": "mivol", "max_depth": 1})
    start = {end: np.array(params[find(params, end)]) for end in DATA}
    w = np.random.default_rng(6).uniform(size=(1, 12, 3)).astype(np.float32)

    def shoot(factor: mi.Float) -> mi.TensorXf:
        for end in DATA:
            params[find(params, end)] = mi.TensorXf(start[end]) * factor
        params.update()
        return mi.render(scene, params, integrator=integrator, spp=1)

    def images(value: float) -> np.ndarray:
        return np.array(shoot(mi.Float(value)), dtype=np.float64)

    truth = (8 * (images(1.05) - images(0.95)) - (images(1.1) - images(0.9))) / 0.6
    factor = mi.Float(1)
    dr.enable_grad(factor)
    dr.backward(dr.sum(shoot(factor) * mi.TensorXf(w), axis=None))
    assert float(dr.grad(factor)[0]) == pytest.approx((truth * w).sum(), rel=2e-4)
    factor = mi.Float(1)
    dr.enable_grad(factor)
    image = shoot(factor)
    dr.forward(factor)
    assert np.abs(np.array(dr.grad(image)) - truth).max() <= 2e-4 * np.abs(truth).max()


CORRIDOR = affine(np.diag([6.0, 1, 1]), (-3, -0.5, -0.5))


def corridor(wall: float) -> twins.Medium:
    """Twelve voxels in a row, the fifth a wall of a given optical depth."""
    values = rough(1, 0.2, 0.6, shape=(1, 1, 12)).astype(np.float64)
    values[0, 0, 4] = wall / 0.5
    light = [(rough(i, 0.2, 1, 3, (1, 1, 12)), CORRIDOR) for i in (2, 3)]
    return twins.Medium((as_float32(values), CORRIDOR), *light)


@pytest.mark.slow
@pytest.mark.parametrize("depth", [1, 3])
@pytest.mark.parametrize("wall", [50.0, 1e6])
def test_no_phantom_gradient_behind_a_wall(wall, depth):
    """Hidden voxels get their e^-50 (or their 0), where what is left of a subtraction would be 1e-7.

    At depth 3 the light from behind the field is what a replay has left: before a black floor it is 0.
    """
    medium, bright = corridor(wall), np.full(3, 5.0)
    more = {"floor": _floor()} if depth == 3 else {}
    seen = pencils({"box": box_of(interior(medium), CORRIDOR), "sky": colours(bright), **more}, [[-5, 0.1, 0.1]], [[1, 0, 0]])
    found = gradients(seen, ["sigma_t.data", "emission.data", "emission_density.data"], np.ones((1, 3)), max_depth=depth)
    if wall > 100:
        for g in found:
            assert not np.any(g[0, 0, 6:]) and np.all(np.isfinite(g)) and np.any(g[0, 0, :5])
        return
    # From the plane of voxel centres behind the wall on, dimmed by all in front of it.
    edge = -3 + 0.5 * 6.5
    o, d, before = np.array([edge, 0.1, 0.1]), np.array([1.0, 0, 0]), np.array([-5, 0.1, 0.1])
    front = np.exp(-twins_tau(medium, before, d, edge + 5))
    back = {"background": bright if depth == 1 else 0.0}

    def rest(**changed) -> float:
        fields = {"sigma": medium.sigma, "source": medium.source, "emission_density": medium.emission_density} | changed
        return float(twins.cell_radiance(twins.Medium(**fields), o, d, **back).sum())

    for name, g in zip(("sigma", "source", "emission_density"), found, strict=True):
        values = getattr(medium, name)[0].astype(np.float64)
        truth = front * twins.differences(lambda v, name=name: rest(**{name: (v, CORRIDOR)}), values)
        # An optical depth of 50 is known to 4e-6, float32's half ulp.
        assert np.abs(g - truth)[0, 0, 7:].max() <= 1e-4 * np.abs(truth[0, 0, 7:]).max()
        assert 0 < np.abs(truth[0, 0, 7:]).max() < 1e-20


def twins_tau(medium: twins.Medium, o, d, end: float) -> float:
    from oracle import tau_twin

    return float(tau_twin(*medium.sigma, o, d, 0, end)[0])


def _floor() -> dict:
    turn = mi.ScalarTransform4f().look_at([5, 0, 0], [0, 0, 0], [0, 0, 1]).scale(50)
    return {"type": "rectangle", "to_world": turn, "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.0}}}


@pytest.mark.slow
@pytest.mark.parametrize("depth", [1, 2, 3])
def test_surfaces_in_and_behind_the_field(depth):
    """A ball in the field and a floor behind it, which the field lights at depth 3 as much as an emitter does."""
    turn = mi.ScalarTransform4f().translate([0, -1.2, 0]).rotate([1, 0, 0], -90).scale(5)
    red = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.8, 0.3, 0.2]}}
    ball, floor = {"type": "sphere", "radius": 0.4}, {"type": "rectangle", "to_world": turn}
    solid = {"ball": ball | {"bsdf": red}, "floor": floor | {"bsdf": red}}
    ends, spp = ("sigma_t.data", "emission.data", "emission_density.data", "albedo.data"), 2
    # At depth 2 a medium that scatters is lit, which is refused beside emission.
    medium, ends = (grids(3), ends) if depth == 1 else (grids(3, albedo=0.0), ends[:3])
    scene = picture(interior(medium), **solid)
    # Draws go by a table of the emission, which moves with it: renders of the same seeds would differ by their noise.
    more = {"max_depth": depth, "rr_depth": 100, "media_light": "met"}
    along = directions(scene, ends)
    integrator = mi.load_dict({"type": "mivol", **more})
    truth = moved(scene, along, lambda: np.array(integrator.render(scene, seed=4, spp=spp), dtype=np.float64))
    jv = changes(scene, along, spp, 4, **more)
    w = np.random.default_rng(9).uniform(size=truth.shape)
    found = gradients(scene, list(ends), w, spp, 4, **more)
    # Paths are up to twice as long as a pencil's.
    assert np.abs(jv - truth).max() <= 4e-4 * np.abs(truth).max()
    total, size = (sum(op(g * v).sum() for g, v in zip(found, along.values(), strict=True)) for op in (np.array, np.abs))
    assert abs(total - (jv * w).sum()) <= 5e-6 * size
    assert np.abs(truth).max() > 0.01
