"""Small scenes in which light of media reaches surfaces and other media."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
from scattering_scenes import close_up, rough_grid

from scenes import affine, as_float32, ball_of, box_of, centred, grid_volume, medium, tensor, transform

PLACE = as_float32(affine(np.diag([0.7, 0.5, 0.8]), [-0.3, -0.2, -0.5]))
"""Of a fire."""


def drawn(depth: int, **more: object) -> dict:
    """Our integrator, which draws points of the media that emit."""
    return {"type": "mivol", "max_depth": depth, "rr_depth": 100, "media_light": "drawn", **more}


def met(depth: int, **more: object) -> dict:
    """Our integrator, which meets them by chance."""
    return drawn(depth, **more) | {"media_light": "met"}


def floor(z: float = -0.6) -> dict:
    """A diffuse square below."""
    at = mi.ScalarTransform4f().translate([0, 0, z]).scale(1.5)
    return {"type": "rectangle", "to_world": at, "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.6}}}


def wall(bsdf: dict) -> dict:
    """A square at the back."""
    at = mi.ScalarTransform4f().translate([0, 1.1, 0]).rotate([1, 0, 0], 90).scale(1.5)
    return {"type": "rectangle", "to_world": at, "bsdf": bsdf}


def burning(**more: object) -> dict:
    """A medium whose one half is empty, and which emits as it absorbs."""
    density = rough_grid(4, 6.0) * (np.arange(6) < 4)[None, None, :, None]
    light = rough_grid(6, 9.0, (3, 3, 3)) * as_float32([1.0, 0.6, 0.3])
    sigma, emission = (grid_volume("mivol_voxels", as_float32(v), PLACE) for v in (density, light))
    return {"type": "mivol_medium", "sigma_t": sigma, "emission": emission, "albedo": 0.0, **more}


def over_a_floor() -> dict:
    """Nothing scatters in media; the wall is glossy, so both techniques find its light."""
    return {"fire": box_of(burning(), PLACE), "floor": floor(), "wall": wall({"type": "roughconductor", "alpha": 0.3})}


def in_fog() -> dict:
    """A boundary that is traced, around it a medium that scatters, below it a floor."""
    haze = {"type": "homogeneous", "sigma_t": 0.6, "albedo": 0.9, "id": "haze"}
    fire = box_of(burning(), PLACE) | {"exterior": {"type": "ref", "id": "haze"}}
    bank = box_of({"type": "ref", "id": "haze"}, centred(2.2 * np.eye(3), [0, 0, 0.51]))
    return {"haze": haze, "fire": fire, "bank": bank, "floor": floor()}


def by_itself() -> dict:
    """A medium that scatters its own light: grids of everything, and no surface."""
    place = centred(2 * np.eye(3))
    albedo = grid_volume("mivol_voxels", 0.9 * rough_grid(5, 1.0, (3, 3, 3)), place)
    light = grid_volume("mivol_voxels", as_float32(rough_grid(7, 4.0) ** 4), place)
    density = grid_volume("mivol_voxels", rough_grid(4, 2.0), place)
    interior = medium("mivol_medium", density, albedo, emission_density=light, phase={"type": "mivol_hg", "g": 0.3})
    return {"fire": box_of(interior, place)}


def radiance_field() -> dict:
    """A field whose colour depends on the direction."""
    rng = np.random.default_rng(2)
    density, sh = rng.normal(0, 3, (5, 6, 7, 1)), rng.normal(0, 0.6, (5, 6, 7, 4, 3))
    volume = {"type": "mivol_sh", "density": tensor(density), "sh": tensor(sh), "to_world": transform(PLACE)}
    return {"fire": box_of({"type": "mivol_medium", "emission": volume}, PLACE), "floor": floor()}


def balls() -> dict:
    """Two balls, of constants, one behind a square that lets half of the light through."""

    def ball(radiance: list[float], density: float) -> dict:
        light = {"type": "rgb", "value": radiance}
        return {"type": "mivol_medium", "sigma_t": density, "albedo": 0.0, "emission": light}

    mask = {"type": "mask", "opacity": 0.5, "bsdf": {"type": "diffuse"}}
    at = mi.ScalarTransform4f().translate([0.5, 0, -0.3]).scale(0.4)
    return {
        "fire": ball_of(ball([9.0, 5.0, 2.0], 3.0), [0.5, 0, 0.1], 0.25),
        "ember": ball_of(ball([3.0, 1.0, 0.5], 8.0), [-0.5, 0.2, -0.1], 0.3),
        "pane": {"type": "rectangle", "to_world": at, "bsdf": mask},
        "floor": floor(),
    }


SCENES = {
    "over a floor": over_a_floor,
    "in fog": in_fog,
    "by itself": by_itself,
    "radiance field": radiance_field,
    "balls": balls,
}


def seen(name: str, res: int = 8) -> mi.Scene:
    """One of them before a small camera."""
    return close_up(SCENES[name](), res=res, fov=45)
