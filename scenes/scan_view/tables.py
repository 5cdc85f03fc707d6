"""A CT scan through a table of opacity and one of colour, and both tables found again from pictures.

    python scenes/scan_view/tables.py [--scan data:tooth] [--iterations 120] [--flat] [-o runs/scan_view]

Conventions. A table has sixteen entries, at values 0, 16, ... 240 of the scan; opacity is extinction per voxel, colour the
radiance that an opaque thickness of the value shows, linear sRGB. The pictures are mivol's own, from four sides; the fit
starts from a grey ramp and knows the scan, not the tables (Adam on all entries, clipped at 0). What it looks at is the tables'
own colours; the pictures that are kept are lit from the camera, their boundaries stressed, unless ``--flat`` is given.
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path

import mivol  # noqa: F401  (chooses the LLVM library; call it before the first variant)
from mivol.experiments.examples import ProceduralData
from mivol.files import write_png

import drjit as dr
import mitsuba as mi
import numpy as np

HERE = Path(__file__).parent
STAND_IN = ProceduralData("tooth", "scan", (161, 94, 103), 240.0)
"""Of the size of the scan, which the camera of the scene looks at, up to the last value of the scene's tables."""
KEYS = {"opacity": "tooth.interior_medium.sigma_t.table", "colour": "tooth.interior_medium.emission.table"}
FLAT = {"shade": "false", "boundaries": "1, 1"}
"""The tables' own colours and opacities: no light on surfaces, no regard to gradients."""
MOST = {"opacity": 0.01, "colour": 0.3}
"""The start's entry at the upper end of the scan's values."""


def sides(size: int, count: int = 4) -> list[mi.Sensor]:
    """Cameras around the tooth."""
    film = {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}}
    turns = [2 * math.pi * (i + 0.3) / count for i in range(count)]
    eyes = [[52 + 270 * math.cos(a), 47 + 270 * math.sin(a), 78 + 60 * math.sin(2 * a)] for a in turns]
    look = [mi.ScalarTransform4f().look_at(origin=eye, target=[52, 47, 78], up=[0, 0, 1]) for eye in eyes]
    return [mi.load_dict({"type": "perspective", "fov": 36, "to_world": t, "film": film}) for t in look]


def fit(scene: mi.Scene, cameras: list[mi.Sensor], iterations: int, spp: int) -> dict[str, np.ndarray]:
    """Tables whose pictures are those of the scene's own tables."""
    integrator, params = mi.load_dict({"type": "mivol", "max_depth": 1}), mi.traverse(scene)
    photographs = [mi.render(scene, sensor=c, integrator=integrator, spp=4 * spp, seed=1000 + i) for i, c in enumerate(cameras)]
    dr.eval(photographs)
    shapes = {name: params[key].shape for name, key in KEYS.items()}
    ramps = {name: np.linspace(0, MOST[name], shape[0])[:, None] for name, shape in shapes.items()}
    adam = mi.ad.Adam(lr=0.01)
    for name, shape in shapes.items():
        adam[KEYS[name]] = mi.TensorXf(np.ascontiguousarray(np.broadcast_to(ramps[name], shape), dtype=np.float32))
    adam.set_learning_rate({KEYS["opacity"]: 0.002, KEYS["colour"]: 0.03})
    params.update(adam)
    for step in range(iterations):
        i = step % len(cameras)
        image = mi.render(scene, params, sensor=cameras[i], integrator=integrator, spp=spp, seed=step)
        loss = dr.mean(dr.square(image - photographs[i]), axis=None)
        dr.backward(loss)
        adam.step()
        for key in KEYS.values():
            adam[key] = dr.maximum(adam[key], 0)
        params.update(adam)
        if step % 20 == 0 or step == iterations - 1:
            print(f"step {step}: rms {float(loss.array[0]) ** 0.5:.4f}")
    return {name: np.array(params[key]) for name, key in KEYS.items()}


def show(scene: mi.Scene, tables: dict[str, np.ndarray], path: Path) -> None:
    """Write the picture of a scene through given tables."""
    params = mi.traverse(scene)
    for name, key in KEYS.items():
        params[key] = mi.TensorXf(tables[name])
    params.update()
    write_png(path, np.array(mi.render(scene)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scan", default="data:tooth", help="a scan of 103 x 94 x 161 voxels; mivol fetch tooth brings it")
    parser.add_argument("--size", type=int, default=384, help="pixels a side of the view; a sixth of it for the fit")
    parser.add_argument("--spp", type=int, default=16, help="samples a pixel")
    parser.add_argument("--iterations", type=int, default=120)
    parser.add_argument("--flat", action="store_true", help="no light on surfaces, opacity by value alone")
    parser.add_argument("-o", "--output", type=Path, default=Path("runs/scan_view"))
    given = parser.parse_args()
    mi.set_variant("llvm_ad_rgb")
    given.output.mkdir(parents=True, exist_ok=True)

    scan = str(STAND_IN.place(given.scan, given.output))
    source, sizes = str(HERE / "scene.xml"), {"scan": scan, "size": given.size, "spp": given.spp}
    scene = mi.load_file(source, **sizes, **FLAT)
    truth = {name: np.array(mi.traverse(scene)[key]) for name, key in KEYS.items()}
    before = np.array(mi.render(scene))
    found = fit(scene, sides(max(given.size // 6, 8)), given.iterations, max(given.spp // 4, 1))
    after = np.array(mi.render(scene))
    shown = scene if given.flat else mi.load_file(source, **sizes)
    show(shown, truth, given.output / "tooth.png")
    show(shown, found, given.output / "tooth_found.png")
    psnr = -10 * math.log10(np.mean((after - before) ** 2))
    off = np.abs(found["opacity"] - truth["opacity"]).mean() / truth["opacity"].mean()
    print(f"{given.output / 'tooth.png'}; by the tables that were found: {psnr:.1f} dB, opacity off by {off:.0%}")


if __name__ == "__main__":
    main()
