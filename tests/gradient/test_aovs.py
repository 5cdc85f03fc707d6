"""Derivatives of the AOVs: forward against reverse, both against finite differences, and behind much extinction."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from aov_gradients import DATA, NAMES, VALUE, aovs, mivol, vjp
from scattering_scenes import cases

from mivol.scene import plan
from mivol.transport.line_integrals.aovs import integrate_distance_in_cell
from mivol.transport.media.compositing import CellIntegral
from scenes import as_float32, ball_of, box_of, camera, centred, grid_volume, medium, pencil, rotation, sky

pytestmark = pytest.mark.usefixtures("traced_balls")

CUBE = centred(np.eye(3))
TURNED = as_float32(centred(rotation([1, 2, 0], 0.5), (0.1, 0, 0)))
FAR = centred(0.8 * np.eye(3), (0.1, 0.05, -1.6))
NEAR = centred(0.6 * np.eye(3), (-0.1, 0, 1.5))
RGB = {"type": "rgb", "value": [0.9, 0.2, 1.7]}


def grid(seed: int, channels: int = 1, top: float = 2.0) -> np.ndarray:
    """A rough grid, nowhere near 0, so that a finite difference cannot leave the domain."""
    return as_float32(np.random.default_rng(seed).uniform(0.1 * top, top, (4, 5, 3, channels)))


def own(values: np.ndarray, place: np.ndarray) -> dict:
    return medium("mivol_medium", grid_volume("mivol_voxels", values, place), scale=1.5)


def parted(sigma_a: object, sigma_s: object) -> dict:
    """Two coefficients whose sum is the extinction."""
    return {"type": "mivol_medium", "sigma_a": sigma_a, "sigma_s": sigma_s, "scale": 1.3}


def voxels(seed: int, channels: int = 1, place: np.ndarray = CUBE) -> dict:
    return grid_volume("mivol_voxels", grid(seed, channels), place)


# Parts of a scene seen from (0.4, 0.3, 4), and the parameters that are differentiated.
CASES = {
    "grid": lambda: ({"box": box_of(own(grid(1), TURNED), TURNED)}, [f"box.{DATA}", "box.interior_medium.scale"]),
    "rgb": lambda: ({"box": box_of(own(grid(2, 3), CUBE), CUBE)}, [f"box.{DATA}", "box.interior_medium.scale"]),
    "stock": lambda: (
        {"box": box_of(medium("heterogeneous", grid_volume("gridvolume", grid(3), CUBE)), CUBE)},
        [f"box.{DATA}"],
    ),
    "constant": lambda: ({"box": box_of(medium("homogeneous", 1.2), TURNED)}, [f"box.{VALUE}"]),
    "rgb constant": lambda: ({"box": box_of(medium("mivol_medium", RGB), CUBE)}, [f"box.{VALUE}"]),
    "grid and constant": lambda: (
        {"box": box_of(parted(voxels(4, place=TURNED), RGB), centred(2 * np.eye(3)))},
        [f"box.interior_medium.{k}" for k in ("sigma_a.data", "sigma_s.value.value", "scale")],
    ),
    "two grids": lambda: (
        {"box": box_of(parted(voxels(5, 3), voxels(6)), CUBE)},
        [f"box.interior_medium.{k}.data" for k in ("sigma_a", "sigma_s")],
    ),
    "wall": lambda: (
        {"box": box_of(own(grid(7, 3), CUBE), CUBE), "wall": {"type": "sphere", "center": [0.1, 0.2, 0], "radius": 0.3}},
        [f"box.{DATA}"],
    ),
    "cut grid": lambda: ({"box": box_of(own(grid(8), TURNED), centred(0.5 * np.eye(3)))}, [f"box.{DATA}"]),
    "boxes": lambda: (
        {
            "a": box_of(own(grid(9), FAR), FAR),
            "b": box_of(medium("mivol_medium", RGB), NEAR),
            "c": box_of(own(grid(10, 3), CUBE), CUBE),
        },
        [f"a.{DATA}", f"b.{VALUE}", f"c.{DATA}"],
    ),
    "traced": lambda: ({"ball": ball_of(own(grid(11), CUBE), [0, 0, 0], 0.6)}, [f"ball.{DATA}"]),
    "traced grid and constant": lambda: (
        {"ball": ball_of(parted(voxels(12), 0.4), [0, 0, 0], 1.0)},
        [f"ball.interior_medium.{k}" for k in ("sigma_a.data", "sigma_s.value.value")],
    ),
    "boxes and balls": lambda: (
        {
            "a": box_of(own(grid(13), FAR), FAR),
            "ball": ball_of(own(grid(14, 3), CUBE), [0, 0, 0], 0.5),
            "b": box_of(medium("homogeneous", 0.8), NEAR),
            "other": ball_of(medium("homogeneous", 0.7), [0, 0, -2.6], 0.5),
            "wall": {"type": "sphere", "center": [0.0, 0.0, -4], "radius": 0.9},
        },
        [f"a.{DATA}", f"ball.{DATA}", f"b.{VALUE}", f"other.{VALUE}"],
    ),
}

SLOW = ("rgb constant", "two grids", "cut grid", "boxes", "traced")
"""What is in these, other cases combine."""


def build(name: str, res: int = 6) -> tuple[mi.Scene, list[str]]:
    """A scene under a sky, and the keys of its parameters."""
    parts, keys = CASES[name]()
    sensor = camera((0.4, 0.3, 4.0), (0.0, 0.0, -0.2), res=res, fov=22.0)
    return mi.load_dict({"type": "scene", "sky": sky(), "sensor": sensor, **parts}), keys


def directions(params: mi.SceneParameters, keys: list[str], rng: np.random.Generator) -> dict[str, np.ndarray]:
    """A random direction for each parameter."""
    return {k: rng.uniform(0, 1, np.array(params[k]).shape).astype(np.float32) for k in keys}


def jvp(scene: mi.Scene, integrator: mi.Integrator, v: dict[str, np.ndarray], spp: int) -> np.ndarray:
    """J v of the AOVs, (H, W, AOVs)."""
    params = mi.traverse(scene)
    for key, value in v.items():
        dr.enable_grad(params[key])
        dr.set_grad(params[key], type(params[key])(value))
    image = np.array(integrator.render_forward(scene, params, seed=7, spp=spp), dtype=np.float64)
    for key in v:
        dr.disable_grad(params[key])
    return image[..., 3:]


@pytest.mark.slow_for("boxes and balls", "grid and constant", "grid", "rgb", "stock", "traced grid and constant", "wall")
@pytest.mark.parametrize("name", cases(CASES, SLOW))
def test_forward_against_reverse(name):
    # <J v, w> = <v, J^T w>: both sides are float32 sums of the same numbers, in another order.
    scene, keys = build(name)
    rng = np.random.default_rng(1)
    v = directions(mi.traverse(scene), keys, rng)
    jv = jvp(scene, mivol(), v, 4)
    w = rng.uniform(0, 1, jv.shape)
    jtw = vjp(scene, mivol(), keys, w, 4)
    products = np.concatenate([(v[k] * jtw[k].reshape(v[k].shape)).ravel() for k in keys])
    assert abs((jv * w).sum() - products.sum()) <= 1e-6 * max(np.abs(products).sum(), np.abs(jv * w).sum())
    assert np.all(np.abs(jv).max(axis=(0, 1)) > 1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("name", cases(CASES, (*SLOW, "rgb", "stock", "constant", "wall")))
def test_forward_against_finite_differences(name):
    # Central differences with common random numbers, extrapolated once (Richardson): what is left is of order h^4, and the
    # rounding of a difference of numbers of about 4 (a depth), 5e-7 / h, three times that with the extrapolation.
    scene, keys = build(name)
    params = mi.traverse(scene)
    start = {k: np.array(params[k]) for k in keys}
    v = directions(params, keys, np.random.default_rng(2))

    def at(h: float) -> np.ndarray:
        for k in keys:
            params[k] = type(params[k])((start[k] + h * v[k]).astype(np.float32))
        params.update()
        return aovs(scene, mivol(), 4)

    h = 0.03
    one, two = (at(h) - at(-h)) / (2 * h), (at(2 * h) - at(-2 * h)) / (4 * h)
    at(0)
    difference = (4 * one - two) / 3
    jv = jvp(scene, mivol(), v, 4)
    for c, aov in enumerate(NAMES.split(",")):
        error = np.abs(jv[..., c] - difference[..., c])
        assert np.all(error <= 1e-3 * np.abs(difference[..., c]).max() + 5e-5), aov


@pytest.mark.slow
@pytest.mark.parametrize("passes", [1, 3])
@pytest.mark.parametrize("rfilter", ["box", "gaussian"])
def test_through_mi_render_with_a_crop(passes, rfilter, monkeypatch):
    # Through the loss of an optimisation: a crop of 3 pixels, a filter and passes change nothing in <J v, w> = <v, J^T w>.
    if passes > 1:
        monkeypatch.setitem(plan.PASS_RAYS, mi.variant().split("_")[0], 1)
    parts, keys = CASES["rgb"]()
    sensor = camera((0.4, 0.3, 4.0), (0.0, 0.0, 0.0), res=8, fov=22.0)
    sensor["film"] |= {"crop_width": 3, "crop_height": 1, "crop_offset_x": 2, "crop_offset_y": 4, "rfilter": {"type": rfilter}}
    scene = mi.load_dict({"type": "scene", "sky": sky(), "sensor": sensor, **parts})
    rng = np.random.default_rng(5)
    params = mi.traverse(scene)
    v = directions(params, keys[:1], rng)
    jv = jvp(scene, mivol(), v, 3)
    assert jv.shape == (1, 3, 4)
    w = rng.uniform(0, 1, jv.shape)
    dr.enable_grad(params[keys[0]])
    image = mi.render(scene, params, integrator=mivol(), spp=3, seed=3, seed_grad=7)
    dr.backward(dr.sum(image[..., 3:] * mi.TensorXf(w.astype(np.float32))))
    products = np.array(dr.grad(params[keys[0]]), dtype=np.float64) * v[keys[0]]
    assert abs((jv * w).sum() - products.sum()) <= 1e-6 * max(np.abs(products).sum(), np.abs(jv * w).sum())


@pytest.mark.parametrize("size", [0.0, 1e-3, 0.3, 3.0, 40.0])
def test_derivatives_of_a_cell(size):
    # Central differences of the formula itself: of order h^2 = 1e-8 in the scale on which it bends, and the 5e-10 to which
    # the moments are known, over h.
    rng = np.random.default_rng([6, int(size * 1000)])
    a, dt = rng.uniform(-2, 2, 200), rng.uniform(0.1, 1, 200)
    sigma = size * rng.uniform(0, 1, (3, 200))

    def stop(sigma: np.ndarray) -> CellIntegral:
        return integrate_distance_in_cell(*(mi.Float64(x) for x in (a, dt, *sigma)))

    exact, h = stop(sigma), 1e-4 * (1 + size)
    for q in range(3):
        step = h * np.eye(3)[q][:, None]
        up, down = stop(sigma + step), stop(sigma - step)
        for slope, f in ((exact.dtau[q], "tau"), (exact.dN[q], "N")):
            difference = (np.array(getattr(up, f)) - np.array(getattr(down, f))) / (2 * h)
            assert np.array(slope) == pytest.approx(difference, abs=2e-5 * np.abs(difference).max())


WALL = {"type": "rectangle", "bsdf": {"type": "twosided", "bsdf": {"type": "diffuse"}}}
SLABS = {
    # Depth behind the entry: 1/s - 1/(e^s - 1).
    "alone": (lambda s: -1 / s**2 + np.exp(s) / np.expm1(s) ** 2, 1),
    # Entered at 1, left at 2, with a wall at 3.5: 1 + (1 - e^-s)/s + 1.5 e^-s, since the slab dims the wall.
    "before a wall": (lambda s: ((1 + s) * np.exp(-s) - 1) / s**2 - 1.5 * np.exp(-s), 3),
}
"""Derivative of the depth by the extinction, and the size of the depths."""


@pytest.mark.parametrize("sigma", [0.7, 4.0])
@pytest.mark.parametrize("name", SLABS)
def test_derivatives_of_a_slab(name: str, sigma: float) -> None:
    """In reverse and forward."""
    derivative, level = SLABS[name]
    box = box_of(medium("homogeneous", sigma), np.eye(4))
    wall = {"wall": WALL | {"to_world": mi.ScalarTransform4f().translate([0.5, 0.5, 2.5]).scale(2)}} if level == 3 else {}
    scene = mi.load_dict({"type": "scene", "box": box, "sensor": pencil([0.3, 0.4, -1], [0, 0, 1]), **wall})
    key, integrator, slope = f"box.{VALUE}", mivol("depth"), derivative(sigma)
    found = vjp(scene, integrator, [key], np.ones((1, 1, 1)), 1)[key]
    # Differences of numbers of size `level`, each of some roundings.
    assert found.sum() == pytest.approx(slope, abs=level * 32 * 2.0**-23)
    params = mi.traverse(scene)
    dr.enable_grad(params[key])
    dr.set_grad(params[key], 0.5)
    tangent = np.array(integrator.render_forward(scene, params, seed=1, spp=1))
    assert tangent[0, 0, 3] == pytest.approx(0.5 * slope, abs=level * 32 * 2.0**-23)
