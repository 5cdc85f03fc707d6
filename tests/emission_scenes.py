"""Media that emit, the same for the integrator and for the twin."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
from oracle import box_interval, sphere_interval
from oracle_emission import Medium
from scattering_scenes import PLACE, Pencils, aimed, pencils

from scenes import as_float32, ball_of, box_of, centred, grid_volume, rotation

LE, B = as_float32([0.7, 0.4, 0.2]), as_float32([0.1, 0.5, 0.3])
"""A source function and a background, of colours that no other number here has."""

TURNED = as_float32(centred(1.1 * rotation([1, 2, 1], 0.5)))

BOUNDARIES = {
    "box": (lambda inside: box_of(inside, PLACE), lambda o, d: box_interval(PLACE, o, d)),
    "ball": (lambda inside: ball_of(inside, [0.1, 0, 0], 0.8), lambda o, d: sphere_interval([0.1, 0, 0], 0.8, o, d)),
    "larger": (lambda inside: box_of(inside, centred(3 * np.eye(3))), lambda o, d: box_interval(centred(3 * np.eye(3)), o, d)),
    "smaller": (lambda inside: box_of(inside, TURNED), lambda o, d: box_interval(TURNED, o, d)),
}
"""Boundaries of a grid in PLACE, with the interval(o, d) of each; the ball is traced."""


def rough(seed: int, low: float, high: float, channels: int = 1, shape: tuple[int, ...] = (5, 4, 6)) -> np.ndarray:
    """Random values (Z, Y, X, C)."""
    return as_float32(np.random.default_rng(seed).uniform(low, high, (*shape, channels)))


def colours(radiance: np.ndarray) -> dict:
    """The same light from everywhere."""
    return {"type": "constant", "radiance": {"type": "rgb", "value": list(map(float, np.broadcast_to(radiance, 3)))}}


def _given(field: object, kind: str) -> object:
    if isinstance(field, tuple):
        return grid_volume(kind, *field)
    return float(field) if np.ndim(field) == 0 else {"type": "rgb", "value": list(map(float, field))}


def interior(medium: Medium, kind: str = "mivol_voxels", **more: object) -> dict:
    """The twin's medium as a `mivol_medium`."""
    light = {"emission": medium.source, "emission_density": medium.emission_density}
    given = {"sigma_t": medium.sigma, "albedo": medium.albedo, **light}
    absent = [k for k, v in given.items() if not isinstance(v, tuple) and k != "sigma_t" and not np.any(v)]
    return {"type": "mivol_medium", **{k: _given(v, kind) for k, v in given.items() if k not in absent}, **more}


def body(medium: Medium, boundary: str = "box", kind: str = "mivol_voxels", **more: object) -> tuple[dict, Medium]:
    """The same medium in the same boundary, for Mitsuba and for the twin."""
    build, interval = BOUNDARIES[boundary]
    return build(interior(medium, kind, **more)), replace(medium, interval=interval)


def emitting(
    medium: Medium, boundary: str = "box", background: object = B, rays: tuple | None = None, **more: object
) -> Pencils:
    """A medium before a background, along pencils."""
    shape, _ = body(medium, boundary, **more)
    return pencils({"box": shape, "sky": colours(background)}, *(rays or aimed(1, 12)))


def light(seen: Pencils | mi.Scene, **more: object) -> np.ndarray:
    """What pencils (n, 3) or a camera (H, W, 3) see."""
    scene = seen if isinstance(seen, mi.Scene) else seen.scene
    integrator = mi.load_dict({"type": "mivol", "max_depth": 1, **more})
    image = np.array(mi.render(scene, integrator=integrator, spp=1), dtype=np.float64)
    return image if isinstance(seen, mi.Scene) else image[0]


def put(scene: mi.Scene, **values: object) -> mi.SceneParameters:
    """Set parameters by the ends of their keys (`sigma_t_data` for ...sigma_t.data)."""
    params = mi.traverse(scene)
    for name, value in values.items():
        key = find(params, name)
        params[key] = like(params[key], value)
    params.update()
    return params


def like(parameter: object, value: object) -> object:
    """Numbers as the type of a parameter."""
    kind, value = type(parameter), np.asarray(value, dtype=np.float32)
    if kind is mi.Color3f:
        return kind(*map(float, value.ravel()))
    return kind(value) if value.ndim else kind(float(value))


def find(params: mi.SceneParameters, end: str) -> str:
    """The one key that ends so."""
    (key,) = [k for k, _ in params if k.endswith(end)]
    return key


def gradients(
    seen: Pencils | mi.Scene, ends: list[str], weight: np.ndarray, spp: int = 1, seed: int = 0, **more: object
) -> list[np.ndarray]:
    """J^T weight of each parameter."""
    scene = seen if isinstance(seen, mi.Scene) else seen.scene
    weight = weight if isinstance(seen, mi.Scene) else weight[None]
    params = mi.traverse(scene)
    keys = [find(params, end) for end in ends]
    for key in keys:
        dr.enable_grad(params[key])
        params[key] = params[key]  # Mitsuba's textures learn of a derivative by an update only
    params.update()
    integrator = mi.load_dict({"type": "mivol", "max_depth": 1, **more})
    integrator.render_backward(scene, params, mi.TensorXf(np.asarray(weight, np.float32)), seed=seed, spp=spp)
    found = [np.array(dr.grad(params[key]), dtype=np.float64) for key in keys]
    let_go(params, keys)
    return found


def let_go(params: mi.SceneParameters, keys: list[str]) -> None:
    """Follow no derivative any more, in what was computed of the parameters neither."""
    for key in keys:
        dr.disable_grad(params[key])
        params[key] = params[key]
    params.update()


def changes(seen: Pencils | mi.Scene, along: dict[str, np.ndarray], spp: int = 1, seed: int = 0, **more: object) -> np.ndarray:
    """J v: the derivative of what is seen as parameters move along v."""
    scene = seen if isinstance(seen, mi.Scene) else seen.scene
    params = mi.traverse(scene)
    keys = {find(params, end): v for end, v in along.items()}
    for key, v in keys.items():
        dr.enable_grad(params[key])
        dr.set_grad(params[key], like(params[key], v))
        params[key] = params[key]
    params.update()
    integrator = mi.load_dict({"type": "mivol", "max_depth": 1, **more})
    image = np.array(integrator.render_forward(scene, params, seed=seed, spp=spp), dtype=np.float64)
    let_go(params, keys)
    return image if isinstance(seen, mi.Scene) else image[0]


def directions(scene: mi.Scene, ends: tuple[str, ...]) -> dict[str, np.ndarray]:
    """Where each parameter is to move: up by a random share of what it is, so that none leaves its domain."""
    params, rng = mi.traverse(scene), np.random.default_rng(7)
    values = {end: np.array(params[find(params, end)], dtype=np.float64) for end in ends}
    return {end: 0.5 * v * rng.uniform(0.2, 1, v.shape) for end, v in values.items()}


def moved(scene: mi.Scene, along: dict[str, np.ndarray], look: Callable[[], np.ndarray]) -> np.ndarray:
    """The derivative of an image along a direction, by differences of fourth order: h^4 f'''''/30 is below 1e-6 of it, and
    a float32 image is known to 1e-7, over h."""
    params, h = mi.traverse(scene), 0.05
    start = {end: np.array(params[find(params, end)], dtype=np.float64) for end in along}

    def at(k: float) -> np.ndarray:
        put(scene, **{end: (start[end] + k * h * v).astype(np.float32) for end, v in along.items()})
        return look()

    found = (8 * (at(1) - at(-1)) - (at(2) - at(-2))) / (12 * h)
    at(0)
    return found
