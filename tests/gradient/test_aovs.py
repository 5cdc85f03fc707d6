"""Derivatives of the AOVs: forward against reverse, both against finite differences, and behind much extinction."""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mivol.scene import plan
from mivol.transport.line_integrals import expected_depth
from scenes import (
    as_float32,
    ball_of,
    box_of,
    camera,
    centred,
    grid_volume,
    medium,
    pencil,
    rotation,
    sky,
)

pytestmark = pytest.mark.usefixtures("variant_rgb")

NAMES = "tau,tau.G,alpha,depth"
CUBE = centred(np.eye(3))
TURNED = as_float32(centred(rotation([1, 2, 0], 0.5), (0.1, 0, 0)))
FAR = centred(0.8 * np.eye(3), (0.1, 0.05, -1.6))
NEAR = centred(0.6 * np.eye(3), (-0.1, 0, 1.5))
RGB = {"type": "rgb", "value": [0.9, 0.2, 1.7]}
DATA, VALUE = "interior_medium.sigma_t.data", "interior_medium.sigma_t.value.value"


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
        {"box": box_of(medium("heterogeneous", grid_volume("gridvolume", grid(3), CUBE)), CUBE)}, [f"box.{DATA}"]
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


def build(name: str, res: int = 6) -> tuple[mi.Scene, list[str]]:
    """A scene under a sky, and the keys of its parameters."""
    parts, keys = CASES[name]()
    sensor = camera((0.4, 0.3, 4.0), (0.0, 0.0, -0.2), res=res, fov=22.0)
    return mi.load_dict({"type": "scene", "sky": sky(), "sensor": sensor, **parts}), keys


def mivol(aovs: str = NAMES) -> mi.Integrator:
    return mi.load_dict({"type": "mivol", "max_depth": 1, "aovs": aovs})


def directions(params: mi.SceneParameters, keys: list[str], rng: np.random.Generator) -> dict[str, np.ndarray]:
    """A random direction for each parameter."""
    return {k: rng.uniform(0, 1, np.array(params[k]).shape).astype(np.float32) for k in keys}


def pushed(scene: mi.Scene, integrator: mi.Integrator, v: dict[str, np.ndarray], spp: int) -> np.ndarray:
    """J v of the AOVs, (H, W, AOVs)."""
    params = mi.traverse(scene)
    for key, value in v.items():
        dr.enable_grad(params[key])
        dr.set_grad(params[key], type(params[key])(value))
    image = np.array(integrator.render_forward(scene, params, seed=7, spp=spp), dtype=np.float64)
    for key in v:
        dr.disable_grad(params[key])
    return image[..., 3:]


def pulled(scene: mi.Scene, integrator: mi.Integrator, keys: list[str], w: np.ndarray, spp: int) -> dict[str, np.ndarray]:
    """J^T w, w a weight of each AOV."""
    params = mi.traverse(scene)
    for key in keys:
        dr.enable_grad(params[key])
    w = np.concatenate([np.zeros((*w.shape[:2], 3)), w], axis=2)
    integrator.render_backward(scene, params, mi.TensorXf(w.astype(np.float32)), seed=7, spp=spp)
    gradients = {key: np.array(dr.grad(params[key]), dtype=np.float64) for key in keys}
    for key in keys:
        dr.disable_grad(params[key])
    return gradients


def aovs(scene: mi.Scene, integrator: mi.Integrator, spp: int) -> np.ndarray:
    return np.array(integrator.render(scene, seed=7, spp=spp), dtype=np.float64)[..., 3:]


@pytest.mark.parametrize("name", CASES)
def test_forward_against_reverse(name):
    # <J v, w> = <v, J^T w>: both sides are float32 sums of the same numbers, in another order.
    scene, keys = build(name)
    rng = np.random.default_rng(1)
    v = directions(mi.traverse(scene), keys, rng)
    jv = pushed(scene, mivol(), v, 4)
    w = rng.uniform(0, 1, jv.shape)
    jtw = pulled(scene, mivol(), keys, w, 4)
    products = np.concatenate([(v[k] * jtw[k].reshape(v[k].shape)).ravel() for k in keys])
    assert abs((jv * w).sum() - products.sum()) <= 1e-6 * max(np.abs(products).sum(), np.abs(jv * w).sum())
    assert np.all(np.abs(jv).max(axis=(0, 1)) > 1e-3)


@pytest.mark.parametrize("name", CASES)
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
    jv = pushed(scene, mivol(), v, 4)
    for c, aov in enumerate(NAMES.split(",")):
        error = np.abs(jv[..., c] - difference[..., c])
        assert np.all(error <= 1e-3 * np.abs(difference[..., c]).max() + 5e-5), aov


# -- One cell, in float64 -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("size", [0.0, 1e-3, 0.3, 3.0, 40.0])
def test_derivatives_of_a_cell(size):
    # Central differences of the formula itself: of order h^2 = 1e-8 in the scale on which it bends, and the 5e-10 to which
    # the moments are known, over h.
    rng = np.random.default_rng([6, int(size * 1000)])
    a, dt = rng.uniform(-2, 2, 200), rng.uniform(0.1, 1, 200)
    sigma = size * rng.uniform(0, 1, (3, 200))

    def stop(sigma: np.ndarray) -> expected_depth.Stop:
        return expected_depth.stop_in_cell(*(mi.Float64(x) for x in (a, dt, *sigma)))

    exact, h = stop(sigma), 1e-4 * (1 + size)
    for q in range(3):
        step = h * np.eye(3)[q][:, None]
        up, down = stop(sigma + step), stop(sigma - step)
        for slope, f in ((exact.dtau[q], "tau"), (exact.dN[q], "N")):
            difference = (np.array(getattr(up, f)) - np.array(getattr(down, f))) / (2 * h)
            assert np.array(slope) == pytest.approx(difference, abs=2e-5 * np.abs(difference).max())


# -- One ray along a column of voxels -----------------------------------------------------------------------------------------


def column(sigma: np.ndarray, boundary: dict | None = None) -> mi.Scene:
    """A ray from z = -1 up the middle of a column of voxels in the unit cube."""
    values = np.asarray(sigma, dtype=np.float32).reshape(-1, 1, 1, 1)
    interior = medium("mivol_medium", grid_volume("mivol_voxels", values))
    shape = {**boundary, "bsdf": {"type": "null"}, "interior": interior} if boundary else box_of(interior, np.eye(4))
    return mi.load_dict({"type": "scene", "box": shape, "sensor": pencil([0.5, 0.5, -1], [0, 0, 1])})


def depth_gradient(sigma: np.ndarray, origin: float, n: int = 4000) -> np.ndarray:
    """d depth / d voxel in float64: the hat of each voxel against (T t - N behind - depth T_end) / alpha, by midpoints."""
    z = (np.arange(n * len(sigma)) + 0.5) / (n * len(sigma))
    nodes = (np.arange(len(sigma)) + 0.5) / len(sigma)
    s, dz, t = np.interp(z, nodes, sigma), z[1] - z[0], z - origin
    tau = np.concatenate([[0], np.cumsum(s) * dz])
    T = np.exp(-tau)
    steps = t * (T[:-1] - T[1:])
    behind = np.cumsum(steps[::-1])[::-1] - steps / 2
    alpha = -math.expm1(-tau[-1])
    slope = (np.exp(-(tau[:-1] + tau[1:]) / 2) * t - behind - steps.sum() / alpha * T[-1]) / alpha
    return np.array([(np.interp(z, nodes, hat) * slope).sum() * dz for hat in np.eye(len(sigma))])


PROFILES = {
    "thin": 0.3 + 0.2 * np.sin(np.arange(24)),
    "smooth": 4 + 3 * np.sin(np.arange(24) / 3),
    "nearly nothing": np.full(24, 1e-8),
    "hidden": np.where(np.arange(64) < 32, 100.0, 1 + 0.5 * np.sin(np.arange(64))),
    "hidden behind a rise": np.where(np.arange(64) < 8, 0.01, 57.0),
}


START = -1 + 8.94e-5
"""Where the rays of a radiancemeter at z = -1 begin: Mitsuba moves them on by its RayEpsilon."""

BALL = {"type": "sphere", "center": [0.5, 0.5, 0.5], "radius": 0.9}
"""A boundary that has to be traced and holds the whole unit cube."""


@pytest.mark.parametrize("name", PROFILES)
@pytest.mark.parametrize("boundary", [None, BALL], ids=["box", "traced"])
def test_every_voxel_has_its_gradient(name, boundary):
    # Each voxel by itself, also those whose gradient is e^-50 of the largest: where it changes its sign it is a difference
    # of two numbers of the size of its neighbours'. The scheme errs by the sixth power of a cell's optical depth, at most
    # 1.6 here and where the extinction jumps: 3e-4.
    """Hard case 37."""
    sigma = PROFILES[name]
    got = pulled(column(sigma, boundary), mivol("depth"), [f"box.{DATA}"], np.ones((1, 1, 1)), 1)[f"box.{DATA}"].ravel()
    exact = depth_gradient(as_float32(sigma), START)
    nearby = np.convolve(np.abs(exact), np.ones(3), "same")
    assert np.all(np.abs(got - exact) <= 3e-4 * nearby)
    assert np.abs(exact).max() > 1e-5
    assert not name.startswith("hidden") or np.abs(got[-1]) < 1e-20


@pytest.mark.parametrize("shape", ["box", "ball"])
def test_media_hidden_behind_another(shape):
    # A homogeneous medium of optical depth 50 hides two more: d depth / d sigma = T (m' - ...) with T = e^-50. Of boxes it
    # is a sum and right to 1e-4; of balls the last digits of N are clamped to T times the distances left: at most 5 T.
    """Hard case 37."""
    def at(z: float, sigma: float) -> dict:
        inside = medium("homogeneous", sigma)
        return box_of(inside, centred(np.eye(3), (0, 0, z))) if shape == "box" else ball_of(inside, [0, 0, z], 0.5)

    parts = {"a": at(0, 50.0), "b": at(2, 1.3), "c": at(4, 0.7)}
    scene = mi.load_dict({"type": "scene", **parts, "sensor": pencil([0, 0, -1], [0, 0, 1])})
    keys = [f"{k}.{VALUE}" for k in parts]
    got = pulled(scene, mivol("depth"), keys, np.ones((1, 1, 1)), 1)
    first, second, third = (float(got[k].ravel()[0]) for k in keys)
    assert first == pytest.approx(-1 / 50**2, rel=1e-4)
    if shape == "box":
        exact = [hidden_slope(m) for m in (1, 2)]
        assert [second, third] == pytest.approx(exact, rel=1e-4)
    assert 0 < abs(second) <= 5 * math.exp(-50)
    assert 0 < abs(third) <= 5 * math.exp(-50)


def hidden_slope(which: int) -> float:
    """d depth / d sigma of the second or third box of the test above, by a central difference of the closed form / e^-50."""

    def beyond(sigma: list[float]) -> float:
        moment, left, opaque = 0.0, 1.0, 0.0
        for begin, s in zip((1.5 - START, 3.5 - START), sigma, strict=True):
            T = math.exp(-s)
            moment += left * ((begin + 1 / s) * (1 - T) - T)
            opaque += left * (1 - T)
            left *= T
        mean = -0.5 - START + 1 / 50
        return moment - mean * opaque

    h, sigma = 1e-4, [1.3, 0.7]
    up, down = list(sigma), list(sigma)
    up[which - 1] += h
    down[which - 1] -= h
    return math.exp(-50) * (beyond(up) - beyond(down)) / (2 * h)


def test_a_black_cell_does_not_disturb_what_is_in_front_of_it():
    # Behind the visible half lies an optical depth of 1e6 a cell: what is ahead of a cell must not be what is left of it.
    sigma = np.where(np.arange(48) < 32, 1.0, 5e7)
    got = pulled(column(sigma), mivol("depth"), [f"box.{DATA}"], np.ones((1, 1, 1)), 1)[f"box.{DATA}"].ravel()
    nodes = (np.arange(48) + 0.5) / 48
    # Nothing gets past z0, the rise to the wall: d depth / d sigma = T t - N behind, N behind = int t T dt + z0 T.
    z0 = nodes[31]
    exact = np.array([np.exp(-z) * z - ((1 + z) * np.exp(-z) - (1 + z0) * np.exp(-z0)) - z0 * np.exp(-z0) for z in nodes])
    # The first voxel reaches half a voxel further; the others are means over a hat 1/24 wide: (1/24)^2 / 6, and the rise.
    assert np.all(np.abs(got[1:30] * 48 / exact[1:30] - 1) < 2e-2)
    assert np.all(np.isfinite(got))
    assert got[32:] == pytest.approx(np.zeros(16), abs=1e-6)


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
    jv = pushed(scene, mivol(), v, 3)
    assert jv.shape == (1, 3, 4)
    w = rng.uniform(0, 1, jv.shape)
    dr.enable_grad(params[keys[0]])
    image = mi.render(scene, params, integrator=mivol(), spp=3, seed=3, seed_grad=7)
    dr.backward(dr.sum(image[..., 3:] * mi.TensorXf(w.astype(np.float32))))
    products = np.array(dr.grad(params[keys[0]]), dtype=np.float64) * v[keys[0]]
    assert abs((jv * w).sum() - products.sum()) <= 1e-6 * max(np.abs(products).sum(), np.abs(jv * w).sum())
