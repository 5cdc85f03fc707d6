"""Scenes in which light turns once, the same for the integrators and for the twins, and means of many renders."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable
from dataclasses import dataclass, replace

import mitsuba as mi
import numpy as np
import oracle_scattering as twins
import pytest
from false_alarms import Estimate, assert_precise, assert_same_mean, difference, fresh, over_pixels

from mivol.validate.statistics import Moments
from scenes import as_float32, box_of, camera, centred, film, grid_volume, medium, pencil, pixel_rays

KINDS = {"stock": ("heterogeneous", "gridvolume"), "own": ("mivol_medium", "mivol_voxels")}
PLACE = centred(2 * np.eye(3))
"""The box [-1, 1]^3."""


def rough_grid(seed: int, top: float = 2.0, shape: tuple[int, ...] = (5, 4, 6)) -> np.ndarray:
    """Random values (Z, Y, X, 1) between 0 and `top`, some near 0."""
    return as_float32(top * np.random.default_rng(seed).uniform(0, 1, (*shape, 1)) ** 2)


def cases(names: Iterable, slow: Collection = ()) -> list:
    """Parameters of a test, those in `slow` marked so: they say the same of another kind of medium or in another place."""
    return [pytest.param(*n, marks=pytest.mark.slow if n in slow else ()) if isinstance(n, tuple) else
            pytest.param(n, marks=pytest.mark.slow if n in slow else ()) for n in names]  # fmt: skip


# -- Means of renders --------------------------------------------------------------------------------------------------


def moments(scene: mi.Scene, integrator: dict | mi.Integrator, spp: int, batches: int = 16, first: int = 0) -> Moments:
    """Mean and variance of an image over independent renders."""
    integrator = mi.load_dict(integrator) if isinstance(integrator, dict) else integrator
    seeds = range(first, first + batches)
    return Moments.from_values(
        np.stack([np.array(mi.render(scene, integrator=integrator, spp=spp, seed=fresh(s))) for s in seeds])
    )


def mivol(**more: object) -> dict:
    """Our integrator, at depth 2."""
    return {"type": "mivol", "max_depth": 2, **more}


def volpath(**more: object) -> dict:
    """The judge, at depth 2."""
    return {"type": "volpath", "max_depth": 2, "rr_depth": 100, **more}


def assert_same_images(
    scene: mi.Scene,
    spp: tuple[int, int] = (32, 128),
    batches: int = 8,
    tile: int = 4,
    rounding: float = 0.0,
    ours: dict | None = None,
    stock: dict | None = None,
    channels: int = 3,
    precision: float = 0.015,
) -> tuple[Moments, Moments]:
    """mivol and volpath have the same mean in tiles of `tile` pixels, and over the whole image.

    The variance of a tile of 16 pixels of 8 batches has up to 112 degrees of freedom: bounds of 7 (an image of 48 tiles and
    channels) and 6 standard errors. `precision` is what the standard error of the whole image may be of its mean.
    """
    a = moments(scene, ours or mivol(), spp[0], batches)
    b = moments(scene, stock or volpath(), spp[1], batches, first=1000)
    image, judge = (replace(m, mean=m.mean[..., :channels], m2=m.m2[..., :channels]) for m in (a, b))
    assert_same_mean(image, judge, tile=tile, rounding=rounding, what="tiles")
    return assert_same_whole(image, judge, rounding, precision)


def assert_same_whole(image: Moments, judge: Moments, rounding: float = 0.0, precision: float = 0.01) -> tuple:
    """The mean of each channel over all pixels."""
    a, b = over_pixels(image), over_pixels(judge)
    assert_same_mean(a, b, rounding=rounding, what="whole images")
    assert_precise(difference(a, b), precision * np.abs(b.mean) + 1e-12, what="whole images")
    return image, judge


# -- Pencils: one ray a pixel, held against a twin -----------------------------------------------------------------------------


COPIES = 4


@dataclass
class Pencils:
    """A scene seen along rays (n, 3), one pixel for each."""

    scene: mi.Scene
    o: np.ndarray
    d: np.ndarray
    copies: dict
    """A sensor of ``COPIES`` pixels for each ray."""

    def moments(self, integrator: dict, spp: int, batches: int = 16, first: int = 0) -> Moments:
        """Of (n, channels), over ``batches`` means.

        The copies of a ray share no random numbers, so each is a batch of its own. Most of the time that a render of so few
        rays takes does not depend on their number: it is spent once for ``COPIES`` batches.
        """
        made, sensor = mi.load_dict(integrator), mi.load_dict(self.copies)
        seeds = (fresh(first + s) for s in range(batches // COPIES))
        images = [np.array(mi.render(self.scene, integrator=made, sensor=sensor, spp=spp, seed=seed)) for seed in seeds]
        return Moments.from_values(np.reshape(images, (batches, len(self.o), -1)))


def pencils(parts: dict, o: np.ndarray, d: np.ndarray) -> Pencils:
    """A scene with a pencil along each ray; the rays are those that the sensor sends out, to the last bit."""
    o, d = np.broadcast_arrays(np.atleast_2d(o), np.atleast_2d(d))
    scene = mi.load_dict({"type": "scene", **parts, "sensor": _row_of_pencils(o, d)})
    copies = _row_of_pencils(np.tile(o, (COPIES, 1)), np.tile(d, (COPIES, 1)))
    return Pencils(scene, *(x[0, :, 0] for x in pixel_rays(scene.sensors()[0], 1)), copies)


def _row_of_pencils(o: np.ndarray, d: np.ndarray) -> dict:
    rays = {f"ray{i:03d}": pencil(p, w) for i, (p, w) in enumerate(zip(o, d, strict=True))}
    return {"type": "batch", **rays, "film": film(len(o), 1), "sampler": {"type": "independent"}}


def aimed(seed: int, n: int = 8, size: float = 0.8, away: float = 3.0) -> tuple[np.ndarray, np.ndarray]:
    """Rays from `away` towards points of a cube of half-edge `size` about the origin."""
    rng = np.random.default_rng([seed, 5])
    o = rng.normal(size=(n, 3))
    o = as_float32(away * o / np.linalg.norm(o, axis=1, keepdims=True))
    d = rng.uniform(-size, size, (n, 3)) - o
    return o, as_float32(d / np.linalg.norm(d, axis=1, keepdims=True))


# -- The same emitter for Mitsuba and for the twins -----------------------------------------------------------------------


def point(position: np.ndarray, intensity: float = 3.0) -> tuple[dict, twins.Emitter]:
    return {"type": "point", "position": list(map(float, position)), "intensity": intensity}, twins.Point(
        as_float32(position), intensity
    )


def sun(direction: np.ndarray, irradiance: float = 2.0) -> tuple[dict, twins.Emitter]:
    return {"type": "directional", "direction": list(map(float, direction)), "irradiance": irradiance}, twins.Directional(
        np.asarray(direction), irradiance
    )


def spot(
    position: np.ndarray, target: np.ndarray, intensity: float = 3.0, cutoff: float = 30.0, beam: float = 20.0
) -> tuple[dict, twins.Emitter]:
    """Angles in degrees."""
    position, target = np.asarray(position, dtype=np.float64), np.asarray(target, dtype=np.float64)
    place = mi.ScalarTransform4f().look_at(list(position), list(target), [0.1, 0.9, 0.3])
    emitter = {"type": "spot", "to_world": place, "intensity": intensity, "cutoff_angle": cutoff, "beam_width": beam}
    return emitter, twins.Spot(position, intensity, target - position, math.radians(cutoff), math.radians(beam))


def phase(name: str, g: float = 0.0) -> tuple[dict, object]:
    """A stock phase function and its twin."""
    return {
        "isotropic": ({"type": "isotropic"}, twins.isotropic),
        "rayleigh": ({"type": "rayleigh"}, twins.rayleigh),
        "hg": ({"type": "hg", "g": g}, twins.hg(g)),
    }[name]


def smoke(
    values: np.ndarray,
    albedo: float = 0.7,
    kind: str = "stock",
    to_world: np.ndarray = PLACE,
    name: str = "isotropic",
    g: float = 0.0,
) -> tuple[dict, twins.Medium]:
    """A grid in its own box, and its twin."""
    medium_type, volume_type = KINDS[kind]
    stock, own = phase(name, g)
    interior = medium(medium_type, grid_volume(volume_type, values, to_world), albedo, phase=stock)
    return box_of(interior, to_world), twins.Medium(twins.Grid(values, to_world), albedo, own)


def fog(
    sigma_t: float, albedo: float = 0.7, to_world: np.ndarray = PLACE, name: str = "isotropic", g: float = 0
) -> tuple[dict, twins.Medium]:
    """A homogeneous box, and its twin."""
    stock, own = phase(name, g)
    interior = medium("homogeneous", sigma_t, albedo, phase=stock)
    return box_of(interior, to_world), twins.Medium(twins.Box(sigma_t, to_world), albedo, own)


def assert_twin(
    seen: Pencils,
    media: list,
    emitters: list,
    integrator: dict,
    spp: int,
    batches: int = 16,
    background: float = 0.0,
    rounding: float = 0.0,
    precision: float = 0.02,
    quadrature: float = 1e-5,
    **more: object,
) -> None:
    """The mean of renders along pencils is the radiance of the twin, each ray by Student's t.

    `quadrature`: relative error of the twin; `rounding`: absolute error of float32. `precision` is what the median
    standard error may be of the radiance.
    """
    truth = twins.radiance(media, emitters, seen.o, seen.d, background=background, **more)
    m = seen.moments(integrator, spp, batches)
    truth = np.broadcast_to(truth, m.mean.shape)
    allowed = rounding + quadrature * np.abs(truth).max()
    assert_same_mean(m, truth, rounding=allowed, what="rays")
    bright = truth > 0.1 * truth.max()
    seen_there = Estimate(m.mean[bright], m.variance_of_mean[bright], batches - 1)
    assert_precise(seen_there, precision * truth[bright], of=np.median, what="rays")


def close_up(
    parts: dict, res: int = 16, fov: float = 40.0, origin: tuple = (1.5, -2.5, 1.2), target: tuple = (0, 0, 0)
) -> mi.Scene:
    """A scene seen by one small camera."""
    return mi.load_dict({"type": "scene", **parts, "sensor": camera(origin, target, res=res, fov=fov)})
