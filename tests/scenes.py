"""Rays, grids and small scenes that the tests share; what they should show is in tests/oracle.py."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from contextlib import contextmanager

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mivol.errors import MivolError

# -- Frames and rays -------------------------------------------------------------------------------------------------


def rotation(axis: np.ndarray, angle: float) -> np.ndarray:
    """Rodrigues' rotation (3, 3) about an axis of any length."""
    k = np.asarray(axis, dtype=np.float64) / np.linalg.norm(axis)
    cross = np.cross(np.eye(3), k)
    return np.eye(3) + math.sin(angle) * -cross + (1 - math.cos(angle)) * cross @ cross


def affine(linear: np.ndarray, shift: np.ndarray = (0.0, 0.0, 0.0)) -> np.ndarray:
    """A 4x4 matrix from a 3x3 one and a shift."""
    matrix = np.eye(4)
    matrix[:3, :3] = linear
    matrix[:3, 3] = shift
    return matrix


def centred(linear: np.ndarray, centre: np.ndarray = (0.0, 0.0, 0.0)) -> np.ndarray:
    """The unit cube moved so that its middle lies at the origin, mapped by `linear`, then moved to `centre`."""
    return affine(linear, np.asarray(centre) - np.asarray(linear) @ np.full(3, 0.5))


FRAMES = {
    "unit": np.eye(4),
    "two_units": centred(2 * np.eye(3)),
    "stretched": centred(np.diag([0.5, 3.0, 1.2]), (0.2, -1, 4)),
    "rotated": centred(rotation([1, 2, 3], 0.7), (1, 0, 0)),
    "sheared": centred(np.array([[1, 0.4, -0.3], [0, 1.5, 0.6], [0.1, 0, 0.8]])),
    "mirrored": centred(np.diag([-1.0, 1, 1]) @ rotation([0, 1, 1], 0.3), (0, 2, 0)),
}
"""Places a grid may be put in, by name."""


def as_float32(x: np.ndarray) -> np.ndarray:
    """The float64 array that a float32 lane holds: both sides of a comparison see the same ray."""
    return np.asarray(x, dtype=np.float32).astype(np.float64)


def random_rays(rng: np.random.Generator, to_world: np.ndarray, n: int, away: float = 3.0) -> tuple[np.ndarray, ...]:
    """Rays (n, 3) through random points of the box, origins up to `away` box diagonals back along the ray."""
    size = np.linalg.norm(to_world[:3, :3] @ np.ones(3))
    inside = rng.uniform(-0.02, 1.02, (n, 3)) @ to_world[:3, :3].T + to_world[:3, 3]
    d = rng.normal(size=(n, 3))
    d = as_float32(d / np.linalg.norm(d, axis=1, keepdims=True))
    return as_float32(inside - d * rng.uniform(0, away, (n, 1)) * size), d


# -- The fast path, on NumPy arrays ----------------------------------------------------------------------------------


def tensor(values: np.ndarray) -> mi.TensorXf:
    """A grid (Z, Y, X) or (Z, Y, X, C) as a float32 tensor (Z, Y, X, C)."""
    values = np.asarray(values, dtype=np.float32)
    return mi.TensorXf(np.ascontiguousarray(values[..., None] if values.ndim == 3 else values))


def skip_recorded_grids_on_a_gpu() -> None:
    """``dr.freeze`` refuses mivol's grids on a GPU (:attr:`mivol.fields.voxels.Voxels.freezable_texture`)."""
    if not mi.variant().startswith("llvm"):
        pytest.skip("mivol_voxels is not recorded on a GPU")


def to_lanes(o: np.ndarray, d: np.ndarray) -> tuple[mi.Point3f, mi.Vector3f]:
    """Rays (n, 3) as Dr.Jit lanes."""
    columns = [np.ascontiguousarray(np.atleast_2d(x).T, dtype=np.float32) for x in (o, d)]
    return mi.Point3f(columns[0]), mi.Vector3f(columns[1])


def from_lanes(tau: object) -> np.ndarray:
    """An optical depth, Float or Color3f, as (n, C)."""
    array = np.asarray(tau)
    return array[:, None] if array.ndim == 1 else array.T


def make_lattice(values: np.ndarray | mi.TensorXf, to_world: np.ndarray, skip: bool | str = False) -> object:
    """A lattice of the fast path, whose walk skips no empty blocks, all (True), or those at the "ends" of a ray."""
    from mivol.transport.traversal.grid_blocks import find_empty_distances
    from mivol.transport.traversal.lattice import Lattice

    values = values if isinstance(values, mi.TensorXf) else tensor(values)
    return Lattice(values, to_world, find_empty_distances(values) if skip else None, trims=skip == "ends")


def tau_fast(
    values: np.ndarray,
    to_world: np.ndarray,
    o: np.ndarray,
    d: np.ndarray,
    t_max: float | np.ndarray = math.inf,
    skip: bool | str = False,
) -> np.ndarray:
    """Optical depth (n, C) of rays (n, 3) by the code under test."""
    from mivol.transport.media.grid_extinction import integrate_tau

    o, d = np.broadcast_arrays(np.atleast_2d(o), np.atleast_2d(d))
    ends = mi.Float(np.broadcast_to(np.float32(t_max), len(o)).copy())
    return from_lanes(integrate_tau(make_lattice(values, to_world, skip), *to_lanes(o, d), ends, mi.Bool(True)))


def tau_and_row(
    shape: tuple[int, ...],
    to_world: np.ndarray,
    o: np.ndarray,
    d: np.ndarray,
    t_max: float = math.inf,
    skip: bool | str = False,
) -> tuple[np.ndarray, np.ndarray]:
    """Optical depth through a grid of ones, and the sum over rays of its gradient (Z, Y, X), by the code under test."""
    from mivol.transport.media.grid_extinction import integrate_tau

    o, d = np.broadcast_arrays(np.atleast_2d(o), np.atleast_2d(d))
    values = tensor(np.ones(shape))
    dr.enable_grad(values)
    ends = mi.Float(np.broadcast_to(np.float32(t_max), len(o)).copy())
    tau = integrate_tau(make_lattice(values, to_world, skip), *to_lanes(o, d), ends, mi.Bool(True))
    dr.backward(dr.sum(tau))
    return np.asarray(dr.detach(tau)), np.asarray(dr.grad(values))[..., 0]


# -- Scenes for mi.load_dict -------------------------------------------------------------------------------------------


def transform(to_world: np.ndarray) -> mi.ScalarTransform4f:
    """A 4x4 array as Mitsuba's transform (float32 in the variants used here)."""
    return mi.ScalarTransform4f(np.asarray(to_world, dtype=np.float32))


def grid_volume(kind: str, values: np.ndarray, to_world: np.ndarray = None) -> dict:
    """A grid as a `gridvolume` or a `mivol_voxels` in the place `to_world` gives the unit cube."""
    place = transform(np.eye(4) if to_world is None else to_world)
    if kind == "gridvolume":
        values = np.asarray(values, dtype=np.float32)
        return {"type": "gridvolume", "grid": mi.VolumeGrid(values), "raw": True, "to_world": place}
    return {"type": "mivol_voxels", "data": tensor(values), "to_world": place}


def medium(kind: str, sigma_t: object, albedo: object = 0.0, **more: object) -> dict:
    """A `homogeneous`, `heterogeneous` or `mivol_medium`."""
    return {"type": kind, "sigma_t": sigma_t, "albedo": albedo, **more}


def box_of(interior: dict, to_world: np.ndarray) -> dict:
    """The unit cube, placed, as an invisible boundary with a medium inside."""
    half = affine(0.5 * np.eye(3), np.full(3, 0.5))  # Mitsuba's cube is [-1, 1]^3
    return {"type": "cube", "to_world": transform(np.asarray(to_world) @ half), "bsdf": {"type": "null"}, "interior": interior}


def ball_of(interior: dict, centre: np.ndarray, radius: float) -> dict:
    """A sphere as an invisible boundary with a medium inside."""
    return {
        "type": "sphere",
        "center": list(map(float, centre)),
        "radius": float(radius),
        "bsdf": {"type": "null"},
        "interior": interior,
    }


def film(width: int, height: int) -> dict:
    """A float32 film with a box filter: a pixel is the mean of its own rays."""
    return {
        "type": "hdrfilm",
        "width": width,
        "height": height,
        "pixel_format": "rgb",
        "component_format": "float32",
        "rfilter": {"type": "box"},
        "sample_border": False,
    }


def camera(origin: np.ndarray, target: np.ndarray, res: int = 12, fov: float = 30.0) -> dict:
    """A perspective camera."""
    up = [0.0, 0.0, 1.0] if abs(origin[0] - target[0]) + abs(origin[1] - target[1]) > 1e-6 else [0.0, 1.0, 0.0]
    return {
        "type": "perspective",
        "fov": fov,
        "to_world": mi.ScalarTransform4f().look_at(origin=list(origin), target=list(target), up=up),
        "film": film(res, res),
        "sampler": {"type": "independent"},
    }


def pencil(o: np.ndarray, d: np.ndarray) -> dict:
    """One ray as a sensor of one pixel: nothing is averaged."""
    return {
        "type": "radiancemeter",
        "origin": list(map(float, o)),
        "direction": list(map(float, d)),
        "film": film(1, 1),
        "sampler": {"type": "independent"},
    }


def sky(radiance: float = 1.0) -> dict:
    """The same radiance from everywhere."""
    return {"type": "constant", "radiance": {"type": "uniform", "value": radiance}}


def render(scene: mi.Scene, integrator: dict | mi.Integrator, spp: int, seed: int = 0, sensor: int = 0) -> np.ndarray:
    """Image (H, W, C) of a scene by an integrator."""
    integrator = mi.load_dict(integrator) if isinstance(integrator, dict) else integrator
    return np.asarray(mi.render(scene, integrator=integrator, spp=spp, seed=seed, sensor=sensor))


def media_of(scene: mi.Scene) -> object:
    """The media of a scene as transport walks through them, planned for the first sensor at depth 2."""
    from mivol.scene.needs import find_needs
    from mivol.scene.plan import build_media, make_plan
    from mivol.scene.survey import survey_scene
    from mivol.transport.path.estimators import Settings

    survey = survey_scene(scene)
    needs = find_needs(scene, scene.sensors()[0], survey)
    return build_media(scene, needs, make_plan(needs, Settings(max_depth=2)), survey)


def pixel_rays(sensor: mi.Sensor, k: int) -> tuple[np.ndarray, np.ndarray]:
    """The rays through the middles of k x k parts of each pixel, o and d (H, W, k * k, 3), float64."""
    w, h = sensor.film().size()
    y, x, j, i = np.meshgrid(np.arange(h), np.arange(w), np.arange(k), np.arange(k), indexing="ij")
    u, v = (x + (i + 0.5) / k) / w, (y + (j + 0.5) / k) / h
    position = mi.Point2f(u.ravel().astype(np.float32), v.ravel().astype(np.float32))
    ray, _ = sensor.sample_ray(0.0, 0.5, position, mi.Point2f(0.5))
    shape = (h, w, k * k, 3)
    return tuple(np.array(x).T.reshape(shape).astype(np.float64) for x in (ray.o + 0 * ray.d, ray.d))


@contextmanager
def refused(match: str) -> Iterator[None]:
    """A MivolError with this text ends the block, bare or as the cause of what Mitsuba makes of it."""
    with pytest.raises(Exception) as info:
        yield
    error, found = info.value, []
    while error is not None:
        found.append(error)
        error = error.__cause__ or error.__context__
    refusals = [str(e) for e in found if isinstance(e, MivolError)]
    assert any(re.search(match, text) for text in refusals), f"{found} holds no refusal about {match!r}"
