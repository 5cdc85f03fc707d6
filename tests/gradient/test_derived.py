"""What plugins make of their parameters passes derivatives on, in whichever of Dr.Jit's ways these are asked for."""

from __future__ import annotations

from collections.abc import Callable

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import scattering_scenes as small
from scattering_scenes import PLACE, mivol, point, rough_grid

from scenes import box_of, grid_volume, medium

INSIDE = "smoke.interior_medium."
TABLE = "0.3, 1, 0.2, 0.6, 2.5"


def picture(shape: tuple[int, ...], low: float = 0.2, high: float = 2.0) -> dict:
    texels = np.random.default_rng(3).uniform(low, high, shape).astype(np.float32)
    return {"type": "bitmap", "bitmap": mi.Bitmap(texels), "raw": True}


def smoke(albedo: object = 0.7, sigma_t: dict | None = None, **more: object) -> dict:
    grid = grid_volume("mivol_voxels", 0.3 + rough_grid(1), PLACE) if sigma_t is None else sigma_t
    return {"smoke": box_of(medium("mivol_medium", grid, albedo, **more), PLACE)}


def shared(grid: dict) -> dict:
    both = {"type": "ref", "id": "both"}
    return {"both": grid, "smoke": box_of(medium("mivol_medium", both, both), PLACE)}


def emitter_above(radiance: dict) -> dict:
    place = mi.ScalarTransform4f().translate([0, 0, 2.5]).rotate([1, 0, 0], 180)
    return {"type": "rectangle", "to_world": place, "emitter": {"type": "area", "radiance": radiance}}


def transfer() -> dict:
    scan = mi.TensorXf(rough_grid(5, 1.0))
    return {"type": "mivol_transfer", "data": scan, "table": "0, 0.5, 2", "to_world": mi.ScalarTransform4f(PLACE)}


def projector() -> dict:
    place = mi.ScalarTransform4f().look_at([2, 2, 2], [0, 0, 0], [0, 0, 1])
    return {"type": "projector", "to_world": place, "irradiance": picture((3, 5, 3)), "scale": 9.0}


MADE: dict[str, tuple[str, Callable[[], dict]]] = {
    "mivol_tabulated": (INSIDE + "phase_function.values", lambda: smoke(phase={"type": "mivol_tabulated", "values": TABLE})),
    "tabphase": (INSIDE + "phase_function.values", lambda: smoke(phase={"type": "tabphase", "values": TABLE})),
    "albedo": (INSIDE + "albedo.data", lambda: smoke(grid_volume("gridvolume", rough_grid(4, 0.9), PLACE))),
    "extinction and albedo in one": ("both.data", lambda: shared(grid_volume("mivol_voxels", rough_grid(4, 0.9), PLACE))),
    "transfer": (INSIDE + "sigma_t.table", lambda: smoke(sigma_t=transfer())),
    "sky": ("emitter.data", lambda: smoke() | {"emitter": {"type": "envmap", "bitmap": picture((4, 7, 3))["bitmap"]}}),
    "area": ("emitter.emitter.radiance.data", lambda: smoke() | {"emitter": emitter_above(picture((3, 5, 3)))}),
    "projector": ("emitter.irradiance.data", lambda: smoke() | {"emitter": projector()}),
    "floor": ("floor.bsdf.reflectance.data", smoke),
}


def scene_of(parts: dict) -> mi.Scene:
    """With a floor, so that paths are followed in a loop, and an emitter where none is given."""
    place = mi.ScalarTransform4f().translate([0, 0, -1.3]).scale(3)
    reflectance = picture((2, 3, 3), 0.2, 0.8)
    floor = {"type": "rectangle", "to_world": place, "bsdf": {"type": "diffuse", "reflectance": reflectance}}
    return small.close_up({"emitter": point([1.5, 1, 2.0])[0], "floor": floor} | parts, res=6)


def derivative(parts: dict, key: str, mode: str, updates: bool) -> float:
    """d <w, image> along v, with the same random numbers in all modes."""
    scene = scene_of(parts)
    params = mi.traverse(scene)
    if updates:
        params[key] = type(params[key])(params[key])
        dr.enable_grad(variable := type(params[key])(params[key]))
        params[key] = variable
        params.update()
    else:
        dr.enable_grad(variable := params[key])
    rng = np.random.default_rng(2)
    v = rng.uniform(0.2, 1, np.array(variable).shape).astype(np.float32)
    image = mi.render(scene, params, integrator=mi.load_dict(mivol()), spp=8, seed=1, seed_grad=5)
    w = mi.TensorXf(rng.uniform(0.2, 1, image.shape).astype(np.float32))
    if mode == "backward":
        dr.backward(dr.sum(image * w, axis=None))
        return float((np.array(dr.grad(variable), dtype=np.float64) * v).sum())
    dr.set_grad(variable, type(variable)(v))
    if mode == "forward to the image":
        change = dr.forward_to(image)
    else:
        dr.enqueue(dr.ADMode.Forward, variable)
        dr.traverse(dr.ADMode.Forward)
        change = dr.grad(image)
    return float((np.array(change, dtype=np.float64) * np.array(w)).sum())


@pytest.mark.slow
@pytest.mark.parametrize("name", small.cases(MADE, [name for name in MADE if name != "sky"]))
def test_every_way_of_asking(name):
    """Backward and forward, from the parameter or to the image, with and without params.update(): one number.

    float32 sums of some 1e4 terms of one sign: 1e-5.
    """
    key, parts = MADE[name]
    truth = derivative(parts(), key, "backward", updates=True)
    assert abs(truth) > 1e-3
    for mode in ("backward", "forward to the image", "forward from the parameter"):
        for updates in (True, False)[mode == "backward" :]:
            assert derivative(parts(), key, mode, updates) == pytest.approx(truth, rel=1e-5), (mode, updates)


@pytest.mark.slow
def test_a_spot_is_carried_forward_as_often_as_back():
    """A transform is no array: its matrix is led. Each pass follows another number, over a floor that paths turn at."""
    place = mi.ScalarTransform4f().look_at([1.6, -1.3, 2.5], [0, 0, 0], [0, 0, 1])
    scene = scene_of(smoke() | {"emitter": {"type": "spot", "to_world": place, "intensity": 5.0, "cutoff_angle": 50}})
    params, integrator = mi.traverse(scene), mi.load_dict(mivol())
    key = next(k for k in params.keys() if k.endswith("emitter.to_world"))  # noqa: SIM118  (iteration gives pairs)
    start, found = params[key], []
    for mode in ("forward", "backward") * 2:
        x = mi.Float(0)
        dr.enable_grad(x)
        params[key] = type(start)(mi.Transform4f().translate(mi.Vector3f(0.3 * x, 0.1 * x, 0.2 * x)) @ mi.Transform4f(start))
        params.update()
        total = dr.sum(mi.render(scene, params, integrator=integrator, spp=8, seed=1, seed_grad=5), axis=None)
        if mode == "forward":
            dr.forward(x)
            found.append(dr.grad(total).array[0])
        else:
            dr.backward(total)
            found.append(dr.grad(x)[0])
    assert abs(found[0]) > 1e-3
    assert found == pytest.approx([found[0]] * 4, rel=1e-5)
