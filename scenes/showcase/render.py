"""One table with everything that mivol renders: a scattering smoke, a radiance field from photographs, Gaussians, and glass.

    python scenes/still_life/photographs.py --size 320                      # 75 photographs of a still life
    mivol optimize scenes/still_life/fit.toml --set field.longest=128       # the radiance field: runs/still_life/fit
    python scenes/showcase/render.py [-o runs/showcase]                     # the picture of the README

The right half of the picture is a derivative: how each pixel changes when the smoke becomes denser, by forward differentiation of
the same scattering paths. It shows that the smoke's shadow, its image in the glass ball and its reflection in the table all depend
on the density.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import mivol  # noqa: F401  (chooses the LLVM library; call it before the first variant)
from mivol.files import write_exr, write_png
from mivol.points.gaussian_files import write_gaussians
from mivol.points.gaussians import Gaussians, logit

import drjit as dr
import mitsuba as mi
import numpy as np
from smoke import make_plume

FIELD = Path("runs/still_life/fit")
DENSITY = "smoke.interior_medium.sigma_t.data"


def make_needles(count: int = 5000, seed: int = 0) -> Gaussians:
    """Needles along a trefoil knot within the heights -0.3 and 0.3; the scene gives them their albedo."""
    rng = np.random.default_rng(seed)

    def trefoil(angle: np.ndarray) -> np.ndarray:
        wide = 2 + np.cos(3 * angle)
        return 0.3 * np.stack([wide * np.cos(2 * angle), wide * np.sin(2 * angle), np.sin(3 * angle)], axis=1)

    angle = rng.uniform(0, 2 * np.pi, count)
    means = trefoil(angle) + 0.05 * rng.normal(size=(count, 3))
    along = trefoil(angle + 1e-3) - trefoil(angle - 1e-3)
    along = along / np.linalg.norm(along, axis=1, keepdims=True) + 0.25 * rng.normal(size=(count, 3))
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    x_to_needle = np.stack([1 + along[:, 0], np.zeros(count), -along[:, 2], along[:, 1]], axis=1)
    log_scales = np.log(np.tile([0.05, 0.009, 0.009], (count, 1)))
    return Gaussians(means, log_scales, x_to_needle, logit(rng.uniform(0.3, 0.9, count)), np.zeros((count, 1, 3)))


def build_scene(field: Path, needles: Path, width: int, height: int) -> dict:
    """The table, its four things, two lights and the camera, for ``mitsuba.load_dict``; z is up.

    Args:
        field: file of the radiance field.
        needles: file of the Gaussians.
        width, height: of the image [pixel].
    """
    T = mi.ScalarTransform4f
    smoke = mi.TensorXf(24 * make_plume()[..., None])
    return {
        "type": "scene",
        "sensor": {
            "type": "perspective", "fov": 44,
            "to_world": T().look_at([0.5, -6.4, 1.7], [0.1, 0, 0.52], [0, 0, 1]),
            "film": {"type": "hdrfilm", "width": width, "height": height, "rfilter": {"type": "gaussian"}},
            "sampler": {"type": "independent"},
        },
        "key": {
            "type": "rectangle",
            "to_world": T().look_at([-3.4, 2.6, 4.4], [-0.6, 0, 0.5], [0, 0, 1]).scale(0.9),
            "emitter": {"type": "area", "radiance": {"type": "rgb", "value": [44, 38, 28]}},
        },
        "sky": {"type": "constant", "radiance": {"type": "rgb", "value": [0.10, 0.13, 0.20]}},
        "table": {
            "type": "rectangle", "to_world": T().translate([0, 0, -0.2]).scale(9),
            "bsdf": {"type": "roughplastic", "alpha": 0.12, "diffuse_reflectance": {"type": "rgb", "value": [0.13, 0.12, 0.12]}},
        },
        "wall": {
            "type": "rectangle", "to_world": T().translate([0, 4.5, 0]).rotate([1, 0, 0], 90).scale(12),
            "bsdf": {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.22, 0.25, 0.30]}}},
        },
        "smoke": {
            "type": "cube", "to_world": T().translate([-1.75, 0.45, 0.81]).scale([0.6, 0.6, 1.0]),
            "bsdf": {"type": "null"},
            "interior": {
                "type": "mivol_medium",
                "sigma_t": {"type": "mivol_voxels", "data": smoke, "to_world": T().translate([-2.35, -0.15, -0.19]).scale([1.2, 1.2, 2.0])},
                "albedo": {"type": "rgb", "value": [0.95, 0.95, 0.95]},
                "phase": {"type": "hg", "g": 0.3},
            },
        },
        "still_life": {
            "type": "cube", "to_world": T().translate([0.1, 0.25, 0.2]).scale([1, 1, 0.4]),
            "bsdf": {"type": "null"},
            "interior": {"type": "mivol_medium", "emission": {"type": "mivol_sh", "filename": str(field)}},
        },
        "needles": {
            "type": "cube", "to_world": T().translate([2.15, 0.3, 0.58]).rotate([0, 0, 1], 20).rotate([1, 0, 0], 75).scale([0.74, 0.74, 0.37]),
            "bsdf": {"type": "null"},
            "interior": {
                "type": "mivol_medium",
                "sigma_t": {
                    "type": "mivol_gaussians", "filename": str(needles),
                    "to_world": T().translate([2.15, 0.3, 0.58]).rotate([0, 0, 1], 20).rotate([1, 0, 0], 75).scale(0.7),
                },
                "albedo": {"type": "rgb", "value": [0.95, 0.72, 0.42]},
                "phase": {"type": "mivol_hg", "g": 0.2},
            },
        },
        "glass": {
            "type": "sphere", "center": [-0.75, -1.35, 0.24], "radius": 0.44, "bsdf": {"type": "dielectric"},
        },
    }  # fmt: skip


def main() -> None:
    """Render the image and the derivative, and write both."""
    args = parse_arguments()
    mi.set_variant("llvm_ad_rgb")
    args.output.mkdir(parents=True, exist_ok=True)
    needles = args.output / "needles.ply"
    write_gaussians(needles, make_needles())
    scene = mi.load_dict(build_scene(args.field, needles, 9 * args.size // 4, args.size))
    integrator = mi.load_dict({"type": "mivol", "max_depth": args.depth})
    image = np.array(mi.render(scene, integrator=integrator, spp=args.spp))
    write_exr(args.output / "image.exr", {"": image})
    write_png(args.output / "image.png", image)

    params = mi.traverse(scene)
    # d image / d s for the density s * sigma_t, at s = 1: the tangent of every voxel is the voxel itself.
    dr.enable_grad(params[DENSITY])
    dr.set_grad(params[DENSITY], dr.detach(params[DENSITY]))
    params.update()
    tangent = np.array(integrator.render_forward(scene, params, spp=args.tangent_spp))
    write_exr(args.output / "tangent.exr", {"": tangent})
    print(args.output / "image.png")


def parse_arguments() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--field", type=Path, default=FIELD / "field.npz", help="the radiance field")
    parser.add_argument("--size", type=int, default=320, help="height of the image [pixel]")
    parser.add_argument("--spp", type=int, default=256, help="samples a pixel of the image")
    parser.add_argument("--tangent-spp", type=int, default=128, help="samples a pixel of the derivative")
    parser.add_argument("--depth", type=int, default=10, help="max_depth of the paths")
    parser.add_argument("-o", "--output", type=Path, default=Path("runs/showcase"))
    return parser.parse_args()


if __name__ == "__main__":
    main()
