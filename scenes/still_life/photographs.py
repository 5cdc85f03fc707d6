"""Photographs of a still life that nobody has to download: glossy and matt things on a plinth, rendered by Mitsuba.

    python scenes/still_life/photographs.py [--scene still_life] [-o runs/still_life/photographs]

Spheres, cubes and a knot, half of them rough metal or varnish, the others matt, under a sky with four soft lights, so that
highlights wander as the camera moves. Two more scenes are what no fit is tuned to: `wires` (matt rods, thinner than a voxel of
1/128) and `glossy` (nothing but metal and varnish). Everything follows from one seed. 75 views from above the horizon, spread
evenly over it; every fifth is held out and so lies between the others. They are PNGs with alpha beside a ``transforms.json``,
as any other data set is; the sky is no part of them. All that there is fits into ``BOX``.
"""

from __future__ import annotations

import argparse
import hashlib
from collections.abc import Sequence
from pathlib import Path

import mivol  # noqa: F401  (chooses the LLVM library; call it before the first variant)
from mivol.files import write_png, write_whole_text
from mivol.files.mesh import Mesh, write_mesh
from mivol.photos import Camera, intrinsics
from mivol.photos.camera_path import aim_camera
from mivol.photos.transforms import write_transforms
from mivol.scene.load import content_hash
from mivol.scene.sensors import to_sensor

import mitsuba as mi
import numpy as np

SEED = 20
BOX = np.array([[-1.0, -1.0, -0.2], [1.0, 1.0, 0.6]])
"""Low and high corner of all that there is [length]."""

MIDDLE = BOX.mean(axis=0)
DISTANCE, ANGLE = 3.5, np.radians(38)
"""Of the cameras from the middle, and their field of view."""

LIGHTS = (
    (30, 55, 14, (3.0, 2.6, 1.8)),
    (140, 30, 12, (1.0, 1.7, 3.0)),
    (235, 50, 16, (2.0, 2.0, 1.7)),
    (310, 22, 10, (2.7, 1.0, 0.8)),
)
"""Azimuth, elevation, width [degree] and radiance of the soft lights."""

EVERY, FIRST = 5, 2
"""Of the views, every fifth is held out, beginning with the third."""


# -- What stands there ----------------------------------------------------------------------------------------------------


def metal(colour: Sequence[float], alpha: float) -> dict:
    """A rough conductor that reflects these shares of the light."""
    return {"type": "roughconductor", "material": "none", "alpha": alpha, "specular_reflectance": rgb(colour)}


def varnish(colour: Sequence[float], alpha: float) -> dict:
    """A coloured ground under a rough, clear coat."""
    return {"type": "roughplastic", "alpha": alpha, "nonlinear": True, "diffuse_reflectance": rgb(colour)}


def matt(colour: Sequence[float]) -> dict:
    """Lambert's surface, lit on both sides."""
    return {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": rgb(colour)}}


def rgb(colour: Sequence[float]) -> dict:
    """A colour for Mitsuba."""
    return {"type": "rgb", "value": [float(c) for c in colour]}


def still_life(tube: Path) -> dict:
    """The scene without cameras, for ``mitsuba.load_dict``.

    Args:
        tube: the mesh of :func:`knot`, a ``.ply``.
    """
    rng = np.random.default_rng(SEED)
    place = mi.ScalarTransform4f
    things: dict = {"type": "scene", "integrator": {"type": "path", "max_depth": 4, "hide_emitters": True}, "sky": sky()}
    things["knot"] = {
        "type": "ply", "filename": str(tube), "to_world": place().translate([0, 0, 0.38]).scale(0.36),
        "bsdf": metal((0.95, 0.72, 0.35), 0.3),
    }  # fmt: skip
    things["stand"] = {"type": "cylinder", "p0": [0, 0, -0.2], "p1": [0, 0, 0], "radius": 0.97, "bsdf": matt((0.5, 0.46, 0.42))}
    things["top"] = {
        "type": "disk", "to_world": place().scale(0.97),
        "bsdf": {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": patches(rng)}},
    }  # fmt: skip
    looks = [
        varnish((0.7, 0.08, 0.06), 0.15), matt((0.12, 0.25, 0.65)), metal((0.75, 0.8, 0.85), 0.25),
        matt((0.85, 0.6, 0.12)), varnish((0.06, 0.4, 0.16), 0.25), metal((0.85, 0.45, 0.35), 0.2),
    ]  # fmt: skip
    for number, look in enumerate(looks):
        azimuth = 360 * (number + rng.uniform(-0.15, 0.15)) / len(looks)
        size, turn = rng.uniform(0.15, 0.2), rng.uniform(0, 90)
        shape = ("sphere", "cube")[number // 2 % 2]
        at = place().rotate([0, 0, 1], azimuth).translate([0.66, 0, size]).rotate([0, 0, 1], turn).scale(size)
        things[f"{shape}_{number}"] = {"type": shape, "to_world": at, "bsdf": look}
    return things


def wires(tube: Path) -> dict:
    """A bundle of thin matt rods on a stand, which one sees through everywhere; ``tube`` is of no use here."""
    rng = np.random.default_rng(SEED)
    things: dict = {"type": "scene", "integrator": {"type": "path", "max_depth": 4, "hide_emitters": True}, "sky": sky()}
    grey, place = matt((0.45, 0.45, 0.45)), mi.ScalarTransform4f()
    things["stand"] = {"type": "cylinder", "p0": [0, 0, -0.2], "p1": [0, 0, -0.15], "radius": 0.9, "bsdf": grey}
    things["top"] = {"type": "disk", "to_world": place.translate([0, 0, -0.15]).scale(0.9), "bsdf": grey}
    for number in range(48):
        around, height = rng.uniform(0, 2 * np.pi, 2), (-0.15, rng.uniform(0.2, 0.58))
        ends = [[r * np.cos(a), r * np.sin(a), z] for r, a, z in zip((0.8, 0.7), around, height, strict=True)]
        look = matt(rng.uniform(0.1, 0.8, 3))
        things[f"rod_{number}"] = {"type": "cylinder", "p0": ends[0], "p1": ends[1], "radius": 0.006, "bsdf": look}
    return things


def glossy(tube: Path) -> dict:
    """The still life with nothing matt in it: the knot, balls, cubes and plinth are metal and varnish of little roughness."""
    things = still_life(tube)
    things["stand"]["bsdf"] = things["top"]["bsdf"] = varnish((0.3, 0.27, 0.25), 0.1)
    looks = [
        metal((0.9, 0.9, 0.9), 0.08), varnish((0.5, 0.05, 0.05), 0.05), metal((0.95, 0.7, 0.3), 0.1),
        varnish((0.05, 0.1, 0.5), 0.08), metal((0.8, 0.5, 0.4), 0.12), varnish((0.05, 0.4, 0.1), 0.05),
    ]  # fmt: skip
    for name in things:
        if name.startswith(("sphere_", "cube_")):
            things[name]["bsdf"] = looks[int(name.rpartition("_")[2])]
    return things


SCENES = {"still_life": still_life, "wires": wires, "glossy": glossy}
"""Scenes without cameras, by name; each fits into ``BOX``."""


def sky(size: tuple[int, int] = (128, 256)) -> dict:
    """A grey sky with soft lights in it, as seen in latitude and longitude; it is no part of the pictures."""
    rows, columns = size
    elevation = np.radians(90 - 180 * (np.arange(rows) + 0.5) / rows)[:, None]
    azimuth = np.radians(360 * (np.arange(columns) + 0.5) / columns)[None, :]
    light = np.broadcast_to((0.15 + 0.1 * np.sin(elevation))[..., None], (rows, columns, 3)).copy()
    for around, above, width, colour in LIGHTS:
        a, e = np.radians(around), np.radians(above)
        cosine = np.sin(elevation) * np.sin(e) + np.cos(elevation) * np.cos(e) * np.cos(azimuth - a)
        light += np.exp((cosine - 1) / np.radians(width) ** 2)[..., None] * colour
    turned = mi.ScalarTransform4f().rotate([1, 0, 0], 90)
    return {"type": "envmap", "bitmap": mi.Bitmap(light.astype(np.float32)), "to_world": turned}


def patches(rng: np.random.Generator, count: int = 9) -> dict:
    """A painted cloth: rings, each cut into pieces, since the texture coordinates of a disk are radius and angle."""
    colours = rng.uniform(0.1, 0.6, (count, count, 3)).astype(np.float32)
    return {"type": "bitmap", "bitmap": mi.Bitmap(colours), "raw": True, "filter_type": "nearest"}


def knot(around: int = 24, along: int = 240) -> Mesh:
    """A trefoil knot as a tube, in a sphere of radius 1.2 or so."""
    t = 2 * np.pi * np.arange(along) / along
    curve = np.stack([np.sin(t) + 2 * np.sin(2 * t), np.cos(t) - 2 * np.cos(2 * t), -np.sin(3 * t)], axis=1) / 3
    ahead = np.roll(curve, -1, axis=0) - np.roll(curve, 1, axis=0)
    side = np.cross(ahead, curve)
    up = np.cross(ahead, side)
    side, up = (v / np.linalg.norm(v, axis=1, keepdims=True) for v in (side, up))
    angle = 2 * np.pi * np.arange(around)[:, None] / around
    points = curve[:, None] + 0.2 * (np.cos(angle) * side[:, None] + np.sin(angle) * up[:, None])
    here = np.arange(along * around).reshape(along, around)
    right, ahead = np.roll(here, -1, axis=1), np.roll(here, -1, axis=0)
    across = np.roll(right, -1, axis=0)
    faces = np.concatenate([np.stack(f, axis=-1).reshape(-1, 3) for f in ((here, right, across), (here, across, ahead))])
    return Mesh(points.reshape(-1, 3), faces)


# -- Who looks ------------------------------------------------------------------------------------------------------------


def cameras(count: int, size: int) -> list[Camera]:
    """Cameras spread evenly over the sky between 8 and 65 degrees of elevation, a golden angle apart."""
    f = size / 2 / np.tan(ANGLE / 2)
    like = Camera(intrinsics(f, f, size / 2, size / 2), (size, size), np.eye(4))
    height = np.linspace(np.sin(np.radians(8)), np.sin(np.radians(65)), count)
    azimuth = np.pi * (3 - np.sqrt(5)) * np.arange(count)
    flat = np.sqrt(1 - height**2)
    places = MIDDLE + DISTANCE * np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), height], axis=1)
    return [aim_camera(like, place, MIDDLE, np.array([0, 0, 1]), f"view {n}") for n, place in enumerate(places)]


def make(folder: Path, views: int = 75, size: int = 128, spp: int = 64, scene: str = "still_life") -> list[str]:
    """Render the set into ``folder``, or leave what is there if it is the same set; the names of its PNGs."""
    folder.mkdir(parents=True, exist_ok=True)
    write_mesh(folder / "knot.ply", knot())
    things = SCENES[scene](folder / "knot.ply")
    looks = {f"view_{number:03d}.png": look for number, look in enumerate(cameras(views, size))}
    names = list(looks)
    shows = what_is_shown(things, list(looks.values()), spp)
    if (folder / "shows.txt").is_file() and (folder / "shows.txt").read_text() == shows:
        return names
    (folder / "shows.txt").unlink(missing_ok=True)
    loaded = mi.load_dict(things)
    for number, (name, look) in enumerate(looks.items()):
        sensor = mi.load_dict(to_sensor(look, pixel_format="rgba") | {"sampler": {"type": "multijitter"}})
        shown = np.array(mi.render(loaded, sensor=sensor, spp=spp, seed=SEED + number))
        colour, alpha = shown[..., :3], shown[..., 3:]
        write_png(folder / name, np.concatenate([colour / np.where(alpha > 0, alpha, 1), alpha], axis=2))
    write_transforms(folder / "transforms.json", looks, names[FIRST::EVERY])
    write_whole_text(folder / "shows.txt", shows)
    return names


def what_is_shown(things: dict, looks: Sequence[Camera], spp: int) -> str:
    """A hash of the scene, the cameras and the samples: other photographs have another."""
    h = hashlib.sha256(f"{content_hash(things)} {spp} {SEED} {FIRST} {EVERY}".encode())
    for look in looks:
        h.update(look.to_world.tobytes() + look.K.tobytes() + bytes(str(look.size), "ascii"))
    return h.hexdigest()


def main() -> None:
    """Render the set and say how well it is known."""
    given = arguments()
    mi.set_variant("llvm_ad_rgb")
    names = make(given.output, given.views, given.size, given.spp, given.scene)
    print(f"{len(names)} views, {len(names[FIRST::EVERY])} of them held out, in the box {BOX.tolist()}")
    print(given.output)


def arguments() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scene", choices=SCENES, default="still_life")
    parser.add_argument("--views", type=int, default=75, help="every fifth is held out")
    parser.add_argument("--size", type=int, default=128, help="pixels along a side")
    parser.add_argument("--spp", type=int, default=64, help="samples a pixel")
    parser.add_argument("-o", "--output", type=Path, default=Path("runs/still_life/photographs"))
    return parser.parse_args()


if __name__ == "__main__":
    main()
