"""A ball of burning fuel: simulated, written as a .vdb with density and temperature, and rendered from the file.

    python scenes/explosion/render.py [--cells 80] [--size 384] [-o runs/explosion]

Simulation. Incompressible flow on a periodic box, semi-Lagrangian (Stam 1999), with buoyancy, vorticity confinement (Fedkiw et
al. 2001) and gas that expands where fuel burns. Hot gas cools by radiation, as T^4. A second pass reads the fields on twice the
cells at places that curl noise has moved (Bridson et al. 2007), which adds eddies that the grid cannot hold.

Conventions. Arrays are (Z, Y, X), z is up, the unit of length is the edge of a cell of the simulation. Temperatures are kelvin.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import mivol
from mivol.files import frame_from_steps, read_volume, write_exr, write_png

import drjit as dr
import mitsuba as mi
import numpy as np
import scipy.fft

HEIGHT = 1.5
"""Height of the box over its width."""
STEPS, DT = 46, 0.5
AMBIENT, FLAME = 300.0, 2050.0
"""Temperatures of the air, and of gas that has just burned [K]."""
BURN, EXPANSION, SOOT, COOLING, LIFT, CONFINE = 0.04, 1.2, 2.2, 0.04, 0.55, 0.22
"""Share of fuel that burns in a step; divergence and soot of burned fuel; cooling at FLAME; buoyancy; vorticity confinement."""
SHOWN = 0.85
"""Of white: where the brightest fiftieth of the pixels lies in the picture."""


def smooth_noise(shape: tuple[int, ...], period: float, seed: int) -> np.ndarray:
    """Gaussian noise without structure below a period [cells], of variance 1; periodic."""
    white = np.random.default_rng(seed).normal(size=shape).astype(np.float32)
    k = np.sqrt(sum(np.square(f) for f in np.meshgrid(*(scipy.fft.fftfreq(n) for n in shape[:-1]),
                                                      scipy.fft.rfftfreq(shape[-1]), indexing="ij")))  # fmt: skip
    field = scipy.fft.irfftn(scipy.fft.rfftn(white) * np.exp(-0.5 * np.square(k * period)), s=shape)
    return (field / field.std()).astype(np.float32)


class Flow:
    """A fluid in a periodic box: velocity [cells per unit of time], fuel, soot and temperature [K]."""

    def __init__(self, cells: int, seed: int) -> None:
        self.shape = (int(HEIGHT * cells), cells, cells)
        z, y, x = (np.arange(n, dtype=np.float32) for n in self.shape)
        self.z, self.y, self.x = np.meshgrid(z, y, x, indexing="ij")
        middle = (0.19 * cells, cells / 2, cells / 2)
        away = np.sqrt(sum((c - m) ** 2 for c, m in zip((self.z, self.y, self.x), middle, strict=True)))
        ragged = (
            0.12
            * cells
            * (1 + 0.45 * smooth_noise(self.shape, cells / 9, seed) + 0.25 * smooth_noise(self.shape, cells / 22, seed + 1))
        )
        ball = np.clip(0.5 + (ragged - away) / 3, 0, 1)
        self.fuel, self.soot, self.heat = ball, 0.3 * ball, AMBIENT + (FLAME - AMBIENT) * ball
        aside = np.sqrt((self.x - middle[2]) ** 2 + (self.y - middle[1]) ** 2)
        rough = 0.05 * cells * (1 + 0.5 * smooth_noise(self.shape, cells / 12, seed + 9))
        self.pool = 0.7 * np.clip(0.5 + (rough - aside) / 3, 0, 1) * np.clip((0.14 * cells - self.z) / 4, 0, 1)
        outwards = [(c - m) / np.maximum(away, 1) for c, m in zip((self.x, self.y, self.z), middle[::-1], strict=True)]
        self.size = cells / 64  # the same flow on any number of cells
        self.velocity = [
            self.size * ball * (2.2 * o + 0.6 * smooth_noise(self.shape, cells / 16, seed + 2 + k))
            for k, o in enumerate(outwards)
        ]
        f = [scipy.fft.fftfreq(n) for n in self.shape[:2]] + [scipy.fft.rfftfreq(self.shape[2])]
        self.k = [2 * np.pi * k for k in np.meshgrid(*f, indexing="ij")][::-1]
        self.k2 = sum(np.square(k) for k in self.k)
        self.k2[0, 0, 0] = 1

    def step(self) -> None:
        """Advance by DT: burn, cool, push, project, and carry along."""
        self.fuel, self.pool = np.maximum(self.fuel, self.pool), 0.93 * self.pool
        burned = BURN * DT * self.fuel
        self.fuel = self.fuel - burned
        self.soot = self.soot + SOOT * burned
        self.heat = np.maximum(self.heat, AMBIENT + (FLAME - AMBIENT) * np.clip(burned / (0.2 * BURN * DT), 0, 1))
        self.heat = AMBIENT + (self.heat - AMBIENT) / (1 + COOLING * DT * 3 * (self.heat / FLAME) ** 3) * (1 - 0.006 * DT)
        lift = self.size * LIFT * (self.heat - AMBIENT) / (FLAME - AMBIENT) - 0.03 * self.soot
        self.velocity[2] = self.velocity[2] + DT * lift
        self.confine()
        self.project(EXPANSION * burned / DT)
        moved = self.carry([*self.velocity, self.fuel, self.soot, self.heat])
        self.velocity, (self.fuel, self.soot, heat) = moved[:3], moved[3:]
        # What leaves through the top would come back through the floor, and the other way round.
        stays = np.clip((self.shape[0] - self.z) / 8 - 0.5, 0, 1) * np.clip(self.z / 3, 0, 1)
        self.fuel, self.soot, self.heat = stays * self.fuel, stays * self.soot, AMBIENT + stays * (heat - AMBIENT)

    def project(self, divergence: np.ndarray) -> None:
        """Remove the divergence of the velocity, apart from the given one."""
        hat = [scipy.fft.rfftn(v, workers=2) for v in self.velocity]
        excess = sum(1j * k * v for k, v in zip(self.k, hat, strict=True)) - scipy.fft.rfftn(divergence, workers=2)
        excess[0, 0, 0] = 0
        self.velocity = [
            scipy.fft.irfftn(v + 1j * k * excess / self.k2, s=self.shape, workers=2).astype(np.float32)
            for k, v in zip(self.k, hat, strict=True)
        ]

    def confine(self) -> None:
        """Push eddies around their axes, against the smoothing of the interpolation."""
        u, v, w = self.velocity
        gradient = lambda a, axis: 0.5 * (np.roll(a, -1, axis) - np.roll(a, 1, axis))  # noqa: E731
        curl = [gradient(w, 1) - gradient(v, 0), gradient(u, 0) - gradient(w, 2), gradient(v, 2) - gradient(u, 1)]
        size = np.sqrt(sum(np.square(c) for c in curl))
        way = [gradient(size, axis) for axis in (2, 1, 0)]
        length = np.sqrt(sum(np.square(a) for a in way)) + 1e-5
        n = [a / length for a in way]
        force = [n[1] * curl[2] - n[2] * curl[1], n[2] * curl[0] - n[0] * curl[2], n[0] * curl[1] - n[1] * curl[0]]
        self.velocity = [a + CONFINE * DT * b for a, b in zip(self.velocity, force, strict=True)]

    def carry(self, fields: list[np.ndarray]) -> list[np.ndarray]:
        """Fields where the flow brought them from."""
        return look_up(fields, *(c - DT * v for c, v in zip((self.x, self.y, self.z), self.velocity, strict=True)))


def look_up(fields: list[np.ndarray], x: np.ndarray, y: np.ndarray, z: np.ndarray) -> list[np.ndarray]:
    """Fields (Z, Y, X) at places in cells, linear between them, periodic."""
    shape = fields[0].shape
    texture = mi.Texture3f(mi.TensorXf(np.stack(fields, axis=-1).astype(np.float32)), wrap_mode=dr.WrapMode.Repeat)
    place = mi.Point3f(*(mi.Float((c.ravel() + 0.5) / n) for c, n in zip((x, y, z), shape[::-1], strict=True)))
    return [np.array(channel).reshape(x.shape) for channel in texture.eval(place)]


def refine(flow: Flow, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Soot and temperature on twice the cells, at places moved along the curl of noise, most where the flow turns."""
    shape = tuple(2 * n for n in flow.shape)
    z, y, x = np.meshgrid(*(np.arange(n, dtype=np.float32) / 2 - 0.25 for n in shape), indexing="ij")
    speed = np.sqrt(sum(np.square(v) for v in flow.velocity))
    reach = np.clip(look_up([speed], x, y, z)[0], 0, 1.5)
    for period, size in ((9.0, 0.75), (4.5, 0.4), (2.4, 0.2)):
        potential = [smooth_noise(shape, 2 * period, seed + k) for k in range(3)]
        gradient = lambda a, axis: np.gradient(a, axis=axis)  # noqa: E731
        moves = [gradient(potential[2], 1) - gradient(potential[1], 0), gradient(potential[0], 0) - gradient(potential[2], 2),
                 gradient(potential[1], 2) - gradient(potential[0], 1)]  # fmt: skip
        scale = size * reach / np.std(moves[0])
        x, y, z = (c + scale * m for c, m in zip((x, y, z), moves, strict=True))
        seed += 3
    soot, heat = look_up([flow.soot, flow.heat], x, y, np.clip(z, 0, flow.shape[0] - 1))
    return soot, heat


def make_file(path: Path, cells: int, seed: int) -> None:
    """Simulate, and write the grids ``density`` (soot, 0 to about 1) and ``temperature`` [K]; the box is 10 m wide."""
    flow = Flow(cells, seed)
    for _ in range(STEPS):
        flow.step()
    soot, heat = refine(flow, seed + 20)
    soot, heat = np.where(soot > 0.004, soot, 0), np.where(heat > AMBIENT + 150, heat, 0)
    n, edge = soot.shape[::-1], 10 / soot.shape[2]
    place = frame_from_steps(n, edge * np.eye(3), [-5 + edge / 2, -5 + edge / 2, edge / 2])
    grids = {"density": soot, "temperature": heat}
    mivol.write_grids(
        path, {k: mivol.SparseVolumeData.from_dense(v[..., None].astype(np.float32), place) for k, v in grids.items()}
    )


def make_scene(path: Path, size: int, spp: int) -> mi.Scene:
    """The explosion over a plain at dusk."""
    to_world = mi.ScalarTransform4f
    box = np.array(read_volume(path, "density").to_world)
    file = {"filename": str(path), "use_grid_bbox": True}
    soot = {
        "type": "mivol_medium",
        "sigma_t": {"type": "mivol_voxels", "grid": "density", **file},
        "albedo": 0.55,
        "scale": 14.0,
        "emission": {"type": "mivol_blackbody", "grid": "temperature", **file},
        "phase": {"type": "mivol_hg", "g": 0.3},
    }
    film = {"type": "hdrfilm", "width": size, "height": int(1.25 * size), "rfilter": {"type": "gaussian"}}
    view = to_world().look_at([0, -25, 2.0], [0, 0, 5.9], [0, 0, 1])
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "mivol", "max_depth": 8},
            "sensor": {"type": "perspective", "fov": 25, "to_world": view, "film": film,
                       "sampler": {"type": "independent", "sample_count": spp}},
            "sky": {"type": "constant", "radiance": {"type": "rgb", "value": [0.08, 0.125, 0.22]}},
            "sun": {"type": "directional", "direction": [0.9, 0.35, -0.25],
                    "irradiance": {"type": "rgb", "value": [3.0, 1.6, 0.7]}},
            "floor": {"type": "rectangle", "to_world": to_world().scale(400),
                      "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.30, 0.27, 0.23]}}},
            "fire": {"type": "cube", "to_world": to_world(box) @ to_world().scale(0.5).translate(1),
                     "bsdf": {"type": "null"}, "interior": soot},
        }
    )  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--cells", type=int, default=80, help="cells of the simulation along the width; the file has twice as many"
    )
    parser.add_argument("--size", type=int, default=384, help="width of the picture [pixel]")
    parser.add_argument("--spp", type=int, default=128, help="samples a pixel")
    parser.add_argument("--seed", type=int, default=4, help="of the noise")
    parser.add_argument("--exposure", type=float, help="factor on radiance [W^-1 m^2 sr]; default: from the picture")
    parser.add_argument("-o", "--output", type=Path, default=Path("runs/explosion"))
    given = parser.parse_args()
    mi.set_variant("llvm_ad_rgb")
    given.output.mkdir(parents=True, exist_ok=True)
    path, start = given.output / "fire.vdb", time.perf_counter()
    make_file(path, given.cells, given.seed)
    heat = read_volume(path, "temperature").values
    print(f"{path}: {path.stat().st_size / 1e6:.1f} MB, up to {heat.max():.0f} K, made in {time.perf_counter() - start:.1f} s")
    start = time.perf_counter()
    image = np.array(mi.render(make_scene(path, given.size, given.spp)))
    write_exr(given.output / "explosion.exr", {"": image})
    exposure = given.exposure or float(-np.log1p(-SHOWN) / np.quantile(image.max(axis=-1), 0.98))
    write_png(given.output / "explosion.png", 1 - np.exp(-exposure * image))
    print(
        f"rendered in {time.perf_counter() - start:.1f} s: {given.output}/explosion.png shows 1 - exp(-{exposure:.3g} radiance)"
    )


if __name__ == "__main__":
    main()
