"""SHA-256 of images, gradients and tangents of fixed scenes, with one Dr.Jit thread.

A change that only moves or renames code leaves every line as it was:

    scripts/fingerprint.py > before.txt;  (the change);  scripts/fingerprint.py | diff before.txt -

Only what users touch is named here (plugins, keys, `mi.render`), so that the script runs on both sides of a renaming. Two
threads add float gradients in an order that changes from run to run; with one the sums have a fixed order.
"""

from __future__ import annotations

import argparse
import fnmatch
import hashlib
import sys
from collections.abc import Callable, Iterator

import mivol  # noqa: F401  (before Mitsuba: it chooses the LLVM library)

# isort: split
import drjit as dr
import mitsuba as mi
import numpy as np

RES, SPP = 24, 8


def main(argv: list[str] | None = None) -> int:
    """Print a line for each case that is asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", default="*", metavar="GLOB", help="cases whose name matches")
    parser.add_argument("--values", action="store_true", help="print sums beside the hashes, to see how far two differ")
    args = parser.parse_args(argv)
    mi.set_variant("llvm_ad_rgb")
    dr.set_thread_count(1)
    for name, build in CASES.items():
        if fnmatch.fnmatch(name, args.only):
            for what, values in build():
                total = f"  {np.abs(values, dtype=np.float64).sum():.9g}" if args.values else ""
                print(f"{name:28s} {what:44s} {digest(values)}{total}", flush=True)
    return 0


def digest(values: np.ndarray) -> str:
    """The first 16 digits of the SHA-256 of an array's bytes."""
    return hashlib.sha256(np.ascontiguousarray(values).tobytes()).hexdigest()[:16]


# -- What is done with a scene -----------------------------------------------------------------------------------------


def follow(scene: dict, ends: tuple[str, ...], **settings: object) -> Iterator[tuple[str, np.ndarray]]:
    """The image, the gradient of each parameter whose key ends so, and the tangent along all of them."""
    scene = mi.load_dict({"type": "scene", **scene})
    integrator = mi.load_dict({"type": "mivol", **settings})
    image = mi.render(scene, integrator=integrator, spp=SPP, seed=3)
    yield "image", np.array(image)
    weight = mi.TensorXf(np.random.default_rng(1).normal(size=image.shape).astype(np.float32))
    params = mi.traverse(scene)
    # Sorted: the order in which Mitsuba lists the parameters of a scene can change from run to run.
    keys = sorted(key for key, _ in params if key.endswith(ends))
    for key in keys:
        dr.enable_grad(params[key])
        params[key] = params[key]
    params.update()
    integrator.render_backward(scene, params, weight, seed=5, spp=SPP)
    for key in keys:
        yield f"gradient {key}", np.array(dr.grad(params[key]))
        dr.set_grad(params[key], 0)
    for key in keys:
        dr.set_grad(params[key], dr.full(type(dr.detach(params[key])), 1, dr.shape(params[key])) if
                    dr.is_tensor_v(params[key]) else 1)  # fmt: skip
    tangent = integrator.render_forward(scene, params, seed=7, spp=SPP)
    yield "tangent", np.array(tangent)


# -- Scenes ------------------------------------------------------------------------------------------------------------


def rough(seed: int, shape: tuple[int, ...], top: float = 3.0, empty: float = 0.0) -> mi.TensorXf:
    """Random values (Z, Y, X, C) between 0 and ``top``, a share ``empty`` of them 0 in one half."""
    rng = np.random.default_rng(seed)
    values = top * rng.uniform(0, 1, shape) ** 2
    values[: int(empty * shape[0])] = 0
    return mi.TensorXf(values.astype(np.float32))


def camera(**more: object) -> dict:
    place = mi.ScalarTransform4f().look_at([1.5, -3, 1.2], [0, 0, 0], [0, 0, 1])
    film = {"type": "hdrfilm", "width": RES, "height": RES, "rfilter": {"type": "box"}, **more}
    return {"type": "perspective", "to_world": place, "fov": 40, "film": film, "sampler": {"type": "independent"}}


def grid(values: mi.TensorXf, size: float = 1.0) -> dict:
    place = mi.ScalarTransform4f().translate(-size).scale(2 * size)
    return {"type": "mivol_voxels", "data": values, "to_world": place}


def box(medium: dict, size: float = 1.0) -> dict:
    place = mi.ScalarTransform4f().scale(size)
    return {"type": "cube", "to_world": place, "bsdf": {"type": "null"}, "interior": medium}


def ball(medium: dict, centre: tuple, radius: float) -> dict:
    return {"type": "sphere", "center": centre, "radius": radius, "bsdf": {"type": "null"}, "interior": medium}


def medium(sigma_t: object, albedo: object = None, phase: dict | None = None, **more: object) -> dict:
    given = {} if albedo is None else {"albedo": albedo}
    return {"type": "mivol_medium", "sigma_t": sigma_t, **given, "phase": phase or {"type": "isotropic"}, **more}


def rgb(*value: float) -> dict:
    return {"type": "rgb", "value": list(value)}


SKY = {"type": "constant", "radiance": 0.8}
EMITTER = {"type": "point", "position": [0.3, -0.2, 2.2], "intensity": 4.0}
SUN = {"type": "directional", "direction": [0.3, 0.5, -1], "irradiance": 2.0}
HG = {"type": "mivol_hg", "g": 0.6}


def envmap() -> dict:
    pixels = np.random.default_rng(4).uniform(0, 1, (8, 16, 3)).astype(np.float32) ** 3
    return {"type": "envmap", "bitmap": mi.Bitmap(pixels), "scale": 2.0}


def floor() -> dict:
    place = mi.ScalarTransform4f().translate([0, 0, -1.3]).scale(3)
    return {"type": "rectangle", "to_world": place, "bsdf": {"type": "diffuse", "reflectance": rgb(0.6, 0.4, 0.3)}}


def absorption() -> Iterator:
    scene = {"body": box(medium(grid(rough(1, (12, 10, 11, 1))))), "sky": SKY, "sensor": camera()}
    yield from follow(scene, ("sigma_t.data", "scale", "radiance.value"), max_depth=1, aovs="tau,alpha,depth")


def absorption_rgb() -> Iterator:
    scene = {"body": box(medium(grid(rough(2, (6, 9, 8, 3), empty=0.5)))), "sky": envmap(), "sensor": camera()}
    yield from follow(scene, ("sigma_t.data",), max_depth=1, aovs="tau.R,tau.G,alpha,depth")


def constant_light() -> Iterator:
    values = rough(3, (14, 12, 13, 1), top=5.0, empty=0.4)
    albedo = grid(rough(4, (14, 12, 13, 1), top=1.0))
    scene = {"body": box(medium(grid(values), albedo)), "sky": SKY, "sensor": camera()}
    yield from follow(scene, ("sigma_t.data", "albedo.data", "scale"), max_depth=2)


def emitter_and_sky() -> Iterator:
    body = medium(grid(rough(5, (9, 9, 9, 1), top=4.0)), rgb(0.9, 0.7, 0.5), HG)
    scene = {"body": box(body), "emitter": EMITTER, "sky": envmap(), "sensor": camera()}
    yield from follow(scene, ("sigma_t.data", "albedo.value.value", ".g", "intensity.value", "position"), max_depth=2)


def sun_by_sums() -> Iterator:
    body = medium(grid(rough(6, (9, 8, 9, 1), top=4.0, empty=0.3)), 0.8, HG)
    scene = {"body": box(body), "sun": SUN, "emitter": EMITTER, "sensor": camera()}
    yield from follow(scene, ("sigma_t.data",), max_depth=2, deterministic=True)


def sun_by_sums_in_a_lattice() -> Iterator:
    body = medium(grid(rough(6, (9, 8, 9, 1), top=4.0, empty=0.3)), 0.8, HG)
    scene = {"body": box(body), "sun": SUN, "sensor": camera()}
    yield from follow(scene, ("sigma_t.data",), max_depth=2, deterministic=True, shadows="grid")


def estimated_shadows() -> Iterator:
    body = medium(grid(rough(7, (40, 40, 40, 1), top=4.0, empty=0.3)), 0.8, HG)
    scene = {"body": box(body), "emitter": EMITTER, "sky": envmap(), "sensor": camera()}
    yield from follow(scene, ("sigma_t.data",), max_depth=2, shadows="estimated")


def several_media() -> Iterator:
    split = {"type": "mivol_medium", "sigma_a": grid(rough(8, (6, 6, 6, 1))), "sigma_s": grid(rough(9, (6, 6, 6, 3)))}
    fog = {"type": "homogeneous", "sigma_t": 1.5, "albedo": rgb(0.9, 0.5, 0.3)}
    place = mi.ScalarTransform4f().translate([1.1, -0.4, -0.4]).scale(0.8)
    volume = {"type": "gridvolume", "grid": mi.VolumeGrid(np.array(rough(10, (5, 5, 5, 1)))), "to_world": place}
    stock = {"type": "heterogeneous", "sigma_t": volume, "albedo": 0.6, "scale": 2.0}
    around = mi.ScalarTransform4f().translate([1.5, 0, 0]).scale(0.4)
    shell = {"type": "cube", "bsdf": {"type": "null"}, "interior": stock, "to_world": around}
    scene = {
        "body": box(split, 0.9), "ball": ball(fog, (-1.4, 0.2, 0.1), 0.45), "shell": shell, "floor": floor(),
        "emitter": EMITTER, "sky": SKY, "sensor": camera(),
    }  # fmt: skip
    ends = ("sigma_a.data", "sigma_s.data", "sigma_t.value.value", "albedo.value.value", "sigma_t.data", "reflectance.value")
    yield from follow(scene, ends, max_depth=2, aovs="tau")


def surfaces() -> Iterator:
    mirror = {"type": "sphere", "center": (0.5, 0.6, -0.5), "radius": 0.4, "bsdf": {"type": "roughconductor", "alpha": 0.1}}
    haze = {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([0, -1.5, 0.3]).rotate([1, 0, 0], 90).scale(0.4),
            "bsdf": {"type": "mask", "opacity": 0.4, "nested": {"type": "diffuse"}}}  # fmt: skip
    body = box(medium(grid(rough(11, (7, 7, 7, 1), top=1.0))), 1.1)
    lit = {"emitter": EMITTER, "sky": envmap()}
    scene = {"body": body, "mirror": mirror, "haze": haze, "floor": floor(), **lit, "sensor": camera()}
    yield from follow(scene, ("sigma_t.data", "reflectance.value"), max_depth=5, rr_depth=3)


def emission() -> Iterator:
    emitting = medium(grid(rough(12, (8, 7, 8, 1))), emission=grid(rough(13, (8, 7, 8, 3))),
                     emission_density=grid(rough(14, (8, 7, 8, 3), top=0.5)))  # fmt: skip
    fog = medium(0.7, emission=rgb(0.2, 0.1, 0.4))
    scene = {"body": box(emitting), "ball": ball(fog, (-1.4, 0, 0), 0.4), "floor": floor(), "sky": SKY, "sensor": camera()}
    yield from follow(scene, ("sigma_t.data", "emission.data", "emission_density.data"), max_depth=2, aovs="tau,depth")


def radiance_field() -> Iterator:
    rng = np.random.default_rng(15)
    density = mi.TensorXf(rng.uniform(-1, 3, (9, 8, 9, 1)).astype(np.float32))
    harmonics = mi.TensorXf(rng.normal(0, 0.3, (9, 8, 9, 9, 3)).astype(np.float32))
    place = mi.ScalarTransform4f().translate(-1).scale(2)
    field = {"type": "mivol_sh", "density": density, "sh": harmonics, "to_world": place}
    scene = {"body": box({"type": "mivol_medium", "emission": field}), "sky": SKY, "sensor": camera()}
    yield from follow(scene, ("density", "sh"), max_depth=1)


def emitters_of_every_kind() -> Iterator:
    body = medium(grid(rough(17, (8, 8, 9, 3), top=3.0)), grid(rough(18, (8, 8, 9, 3), top=1.0)), HG)
    panel = mi.ScalarTransform4f().look_at([-1.6, 0.5, 1.5], [0, 0, 0], [0, 0, 1]).scale(0.5)
    area = {"type": "rectangle", "to_world": panel, "emitter": {"type": "area", "radiance": rgb(9, 6, 2)}}
    lit = {"emitter": EMITTER, "second": {**EMITTER, "position": [-1.5, -1.4, 0.8]}, "sun": SUN, "area": area, "sky": SKY}
    scene = {"body": box(body), **lit, "sensor": camera()}
    yield from follow(scene, ("sigma_t.data", "albedo.data", ".g", "radiance.value", "intensity.value"), max_depth=2)


def free_flights() -> Iterator:
    stock = {"type": "heterogeneous", "albedo": 0.9, "phase": {"type": "hg", "g": 0.3}}
    place = mi.ScalarTransform4f().translate(-1).scale(2)
    stock["sigma_t"] = {"type": "gridvolume", "grid": mi.VolumeGrid(np.array(rough(19, (7, 6, 7, 3)))), "to_world": place}
    fog = {"type": "homogeneous", "sigma_t": 1.5, "albedo": rgb(0.9, 0.5, 0.3)}
    scene = {
        "body": box(stock), "ball": ball(fog, (-1.5, 0.2, 0.1), 0.45), "floor": floor(), "emitter": EMITTER, "sky": envmap(),
        "sensor": camera(),
    }  # fmt: skip
    ends = ("sigma_t.data", "sigma_t.value.value", "albedo.value.value", "reflectance.value")
    yield from follow(scene, ends, max_depth=6, rr_depth=3)


def side_flights() -> Iterator:
    body = medium(grid(rough(20, (7, 7, 7, 1), top=4.0)), rgb(0.95, 0.8, 0.6), {"type": "mivol_hg", "g": 0.8})
    scene = {"body": box(body), "sun": SUN, "sky": envmap(), "sensor": camera()}
    yield from follow(scene, ("sigma_t.data", "albedo.value.value", ".g", "irradiance.value"), max_depth=5, rr_depth=3)


def white_sky() -> Iterator:
    first = medium(grid(rough(21, (6, 6, 6, 1))), rgb(0.9, 0.6, 0.3))
    fog = {"type": "homogeneous", "sigma_t": 1.5, "albedo": 0.5}
    scene = {"body": box(first), "ball": ball(fog, (-1.5, 0.2, 0.1), 0.45), "sky": SKY, "sensor": camera()}
    yield from follow(scene, ("sigma_t.data", "sigma_t.value.value", "albedo.value.value"), max_depth=2)


def refraction() -> Iterator:
    fog = {"type": "homogeneous", "sigma_t": 2.0, "albedo": rgb(0.95, 0.8, 0.6), "phase": {"type": "hg", "g": 0.4}}
    glass = {"type": "sphere", "center": (0.2, -0.1, 0.1), "radius": 0.8, "bsdf": {"type": "dielectric", "int_ior": 1.8}}
    smoke = ball(medium(0.8, 0.7), (-1.3, 0.2, 0.1), 0.45)
    scene = {"glass": {**glass, "interior": fog}, "smoke": smoke, "floor": floor(), "sky": envmap(), "sensor": camera()}
    yield from follow(scene, ("sigma_t.value.value", "albedo.value.value", "reflectance.value"), max_depth=9, rr_depth=1)


def projector() -> Iterator:
    from mivol.tomography.geometry import ConeBeam, VoxelGrid
    from mivol.tomography.projector import Projector

    grid = VoxelGrid((12, 10, 11), 0.2)
    beam = ConeBeam(np.linspace(0, 5, 7), (9, 13), source_to_axis=4.0, source_to_detector=7.0, pitch=0.3)
    A, rng = Projector(beam, grid), np.random.default_rng(16)
    yield "A x", np.array(A @ rng.uniform(0, 1, A.shape[1]).astype(np.float32))
    yield "A^T y", np.array(A.T @ rng.uniform(0, 1, A.shape[0]).astype(np.float32))


CASES: dict[str, Callable[[], Iterator[tuple[str, np.ndarray]]]] = {
    case.__name__: case
    for case in (
        absorption, absorption_rgb, constant_light, emitter_and_sky, sun_by_sums, sun_by_sums_in_a_lattice, estimated_shadows,
        several_media, surfaces, emission, radiance_field, emitters_of_every_kind, free_flights, side_flights, white_sky,
        refraction, projector,
    )
}  # fmt: skip

if __name__ == "__main__":
    sys.exit(main())
