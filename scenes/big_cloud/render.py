"""A cumulus of 1024^3 voxels that is sparse in memory, under a sun and a sky.

    python scenes/big_cloud/render.py [--voxels 1024] [--gradient] [-o runs/big_cloud]

The cloud is a heap of balls whose surface octaves of noise erode. It is made in bricks of 8^3 voxels: no array of the whole box
exists at any time. Printed: bricks, their size beside that of a dense grid, seconds, and the peak memory of the process.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import mivol
from mivol.fields.procedural import make_cumulus
from mivol.files import write_png
from mivol.machine import peak_memory

import drjit as dr
import mitsuba as mi
import numpy as np

EXTINCTION = 240.0
"""Extinction [1/length] in the cloud, whose box has the edge 1."""


def make_scene(cloud: mivol.SparseVolumeData, size: int, spp: int) -> mi.Scene:
    """The cloud under a sun and a blue sky, seen from the ground."""
    to_world = mi.ScalarTransform4f
    grid = {
        "type": "mivol_voxels",
        "data": mi.TensorXf(cloud.values),
        "bricks": mi.UInt32(cloud.numbers),
        "resolution": list(cloud.shape[::-1]),
    }
    droplets = {"type": "mivol_medium", "sigma_t": grid, "albedo": 0.999, "phase": {"type": "mivol_hg", "g": 0.8}}
    film = {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}}
    view = to_world().look_at([0.5, -1.05, 0.12], [0.5, 0.5, 0.4], [0, 0, 1])
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "mivol", "max_depth": 48},
            "sensor": {"type": "perspective", "fov": 29, "to_world": view, "film": film,
                       "sampler": {"type": "independent", "sample_count": spp}},
            "sky": {"type": "constant", "radiance": {"type": "rgb", "value": [0.06, 0.15, 0.38]}},
            "sun": {"type": "directional", "direction": [0.8, 0.45, -0.5],
                    "irradiance": {"type": "rgb", "value": [6.6, 5.9, 5.0]}},
            "cloud": {"type": "cube", "to_world": to_world().scale(0.5).translate(1), "bsdf": {"type": "null"},
                      "interior": droplets},
        }
    )  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--voxels", type=int, default=1024, help="voxels along each edge of the box")
    parser.add_argument("--size", type=int, default=384, help="pixels a side")
    parser.add_argument("--spp", type=int, default=64, help="samples a pixel")
    parser.add_argument("--gradient", action="store_true", help="also compute the derivative by every stored voxel")
    parser.add_argument("--vdb", action="store_true", help="also write cloud.vdb")
    parser.add_argument("-o", "--output", type=Path, default=Path("runs/big_cloud"))
    given = parser.parse_args()
    mi.set_variant("llvm_ad_rgb")
    given.output.mkdir(parents=True, exist_ok=True)

    before, start = peak_memory(), time.perf_counter()
    cloud = make_cumulus(given.voxels, EXTINCTION)
    share = np.count_nonzero(cloud.values) / given.voxels**3
    print(
        f"{len(cloud.values)} bricks, {share:.1%} of {given.voxels}^3 voxels above 0: {cloud.values.nbytes / 1e6:.0f} MB, a "
        f"dense grid takes {cloud.dense_bytes / 1e6:.0f} MB; made in {time.perf_counter() - start:.1f} s"
    )
    if given.vdb:
        mivol.write_volume(given.output / "cloud.vdb", cloud)
    start = time.perf_counter()
    scene = make_scene(cloud, given.size, given.spp)
    del cloud
    image = mi.render(scene)
    write_png(given.output / "cloud.png", np.array(image))
    seconds, more = time.perf_counter() - start, (peak_memory() - before) / 1e6
    print(f"rendered in {seconds:.1f} s, {more:.0f} MB more than before: {given.output}/cloud.png")
    if given.gradient:
        params = mi.traverse(scene)
        key = "cloud.interior_medium.sigma_t.data"
        dr.enable_grad(params[key])
        dr.backward(dr.mean(mi.render(scene, params, spp=1), axis=None))
        derivative = dr.grad(params[key])
        print(f"derivatives by {dr.width(derivative.array)} voxels, {(peak_memory() - before) / 1e6:.0f} MB more than before")


if __name__ == "__main__":
    main()
