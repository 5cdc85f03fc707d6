"""The contestants of the study: radiance fields with their views, and the peer.

Fields. A thin shell, a fog, a fitted scene; cameras stand on a ring around the box.

Peer. The method of Mitsuba's tutorial, written from its description. A density (1 channel) and harmonics of degree 2 (27
channels) are two ``mi.Texture3f`` over the unit cube. A ray takes steps of 1 / resolution from its entry point. At each step,
density = max(0, texture), colour = clip(sum of harmonics, 0, 1), opacity = 1 - exp(-density step). The second pass follows the
ray again, subtracts the light of each step from the remaining radiance, and lets Dr.Jit differentiate the step alone (path
replay: Vicini et al. 2021). The fit has 4 stages of doubling resolution up to 128^3 with 105 steps each, in turns over 7 views
of 256 x 256 pixels, all rays of a view in each step, Adam with a rate of 0.05 for both grids, and an L1 loss; it starts from
density 0.01 and coefficients 0.1. No step is skipped, and a ray ends early only at transmittance 0.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.bench.harness.study import Size, amount
from mivol.bench.scenes import DATA, TO_WORLD
from mivol.fields.spherical_grid import SphericalGrid
from mivol.optim.loop import reconstruct
from mivol.optim.photographs.field_view import render_view
from mivol.optim.photographs.radiance_plan import RadiancePlan, RadianceStage
from mivol.optim.photographs.radiance_problem import RadianceProblem
from mivol.optim.photographs.ray_batches import RayBatches
from mivol.photos import Camera, Photo, intrinsics, load_photos, pixel_centres, rays
from mivol.photos.camera_path import aim_camera
from mivol.transport.line_integrals.radiance_field import RayBundle

STOP = 1e-4
"""Transmittance at which mivol's rays end; rays of the peer end at 0."""

BOX = np.array([[-1.0, -1, -1], [1, 1, 1]])
BLACK = np.zeros(3, np.float32)


@dataclass(frozen=True)
class FieldSize(Size):
    """Amount of work of fields and fits."""

    resolution: int = amount(128, 32, "nodes along an edge of the fields")
    fields: tuple[str, ...] = amount(("shell", "fog", "fitted"), doc="fields")
    steps: int = amount(105, 7, "steps of the first stage of a fit")
    chair_steps: int = amount(800, 30, "steps of the fit that makes the fitted field")
    fit_resolution: int = amount(128, 32, "nodes along an edge in fits")
    fit_side: int = amount(256, 32, "edge of the views of fits [pixels]")
    side: int = amount(256, 64, "edge of images [pixels]")


# -- Views ------------------------------------------------------------------------------------------------------------------


def make_camera(k: float, count: int, side: int) -> Camera:
    """Camera k of a ring of ``count``, at distance 3 from the axis and 0.9 above the centre of the box, its target."""
    angle = 2 * np.pi * k / count
    like = Camera(intrinsics(1.2 * side, 1.2 * side, side / 2, side / 2), (side, side), np.eye(4))
    origin = np.array([3 * np.cos(angle), 3 * np.sin(angle), 0.9])
    return aim_camera(like, origin, np.zeros(3), np.array([0.0, 0, 1]), f"camera {k}")


def ring_cameras(side: int, count: int = 7) -> list[Camera]:
    """Cameras of a ring."""
    return [make_camera(k, count, side) for k in range(count)]


def middle_cameras(side: int, count: int = 7) -> list[Camera]:
    """Cameras in the middle between every second pair of a ring."""
    return [make_camera(k + 0.5, count, side) for k in range(0, count, 2)]


def photograph(field: SphericalGrid, cameras: Sequence[Camera]) -> list[Photo]:
    """Render views of a field over black."""
    images = [np.clip(render_view(field, camera, BLACK).image, 0, 1) for camera in cameras]
    return [Photo(camera.name, image, None, None, camera, BLACK) for camera, image in zip(cameras, images, strict=True)]


def tiled_pixels(side: int) -> np.ndarray:
    """Pixels of a view (row, column), in the order of tiles of 4 x 4."""
    i = np.arange(side * side)
    tile, within = i // 16, i % 16
    return np.stack([tile // (side // 4) * 4 + within // 4, tile % (side // 4) * 4 + within % 4], axis=1)


def trace(camera: Camera, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Origins and directions (N, 3) of rays through the centres of pixels (row, column)."""
    o, d = rays(camera, pixel_centres(camera.size)[pixels[:, 0], pixels[:, 1]])
    return np.broadcast_to(o, d.shape), d


def to_bundle(o: np.ndarray, d: np.ndarray) -> RayBundle:
    """Rays on the device, from origins and directions (N, 3)."""
    bundle = RayBundle(*(kind(np.ascontiguousarray(np.float32(a.T))) for kind, a in ((mi.Point3f, o), (mi.Vector3f, d))))
    dr.eval(bundle.o, bundle.d)
    return bundle


# -- Fields -----------------------------------------------------------------------------------------------------------------


def node_positions(n: int) -> list[np.ndarray]:
    """z, y and x of n^3 nodes in [-1, 1]^3, (n, n, n) each."""
    g = (np.arange(n) + 0.5) / n * 2 - 1
    return np.meshgrid(g, g, g, indexing="ij")


def make_colours(n: int, seed: int = 0) -> np.ndarray:
    """Smooth harmonics (n, n, n, 9, 3): colours around 0.5, a fifth of them view-dependent."""
    z, y, x = (a.astype(np.float32) for a in node_positions(n))
    rng = np.random.default_rng(seed)
    sh = np.empty((n, n, n, 9, 3), np.float32)
    for b in range(9):
        for c in range(3):
            k, phase = rng.uniform(-4, 4, 3), rng.uniform(0, 6)
            sh[..., b, c] = (0.8 if b == 0 else 0.15) * np.sin(k[0] * x + k[1] * y + k[2] * z + phase)
    return sh


def make_shell(size: FieldSize) -> tuple[SphericalGrid, str]:
    """A sphere of radius 0.7 with a nearly opaque skin of two voxels."""
    n = size.resolution
    z, y, x = node_positions(n)
    density = np.clip(2.5 * n * (1 - np.abs(np.sqrt(x * x + y * y + z * z) - 0.7) * n / 2.5), -10, None)
    return SphericalGrid.from_dense(density, make_colours(n), TO_WORLD, density > -10), "a shell of radius 0.7"


def make_fog(size: FieldSize) -> tuple[SphericalGrid, str]:
    """A fog that fills the box."""
    n = size.resolution
    z, y, x = node_positions(n)
    density = 1 + 0.5 * np.sin(5 * x) * np.sin(4 * y + z)
    return SphericalGrid.from_dense(density, make_colours(n, 1), TO_WORLD), "a fog of extinction 1"


def fit_field(size: FieldSize) -> tuple[SphericalGrid, str]:
    """The chair of NeRF's synthetic scenes, fitted for a minute; without the data, views of the shell."""
    quarter = size.chair_steps // 4
    stages = tuple(RadianceStage(size.resolution // k, quarter * s, k, 8, 128) for k, s in ((4, 1), (2, 1), (1, 2)))
    path = DATA / "multiview" / "chair"
    if path.is_dir():
        photos = load_photos(path, split="train", background="white", scale=0.5)
        views, box, origin = RayBatches.from_photos(photos.views, (1, 2, 4)), photos.silhouette_box(), "NeRF's chair"
    else:
        photos = photograph(make_shell(size)[0], ring_cameras(size.side, 24))
        views, box, origin = RayBatches.from_photos(photos, (1, 2, 4)), BOX, "views of the shell (no data folder)"
    plan = RadiancePlan(stages)
    problem = RadianceProblem(views, box, plan)
    reconstruct(problem, plan.optimizer, plan.course())
    # Put the field into the box of the other fields, as a dense grid: the peer has no other kind.
    density, sh = problem.field.to_dense()
    density, sh = (centre(a, size.resolution) for a in (density * problem.unit, sh))
    keep = density > 0
    keep |= np.roll(keep, 1, 0) | np.roll(keep, -1, 0) | np.roll(keep, 1, 1) | np.roll(keep, -1, 1)
    return SphericalGrid.from_dense(density, sh, TO_WORLD, keep), f"{origin}, fitted in {size.chair_steps} steps"


def centre(values: np.ndarray, n: int) -> np.ndarray:
    """Put an array into the centre of n^3 nodes."""
    out = np.zeros((n, n, n, *values.shape[3:]), np.float32)
    low = [(n - s) // 2 for s in values.shape[:3]]
    out[tuple(slice(a, a + s) for a, s in zip(low, values.shape[:3], strict=True))] = values[:n, :n, :n]
    return out


FIELDS: dict[str, Callable[[FieldSize], tuple[SphericalGrid, str]]] = {
    "shell": make_shell,
    "fog": make_fog,
    "fitted": fit_field,
}


@cache
def load_field(name: str, size: FieldSize) -> tuple[SphericalGrid, str]:
    """A field and its origin, made once."""
    return FIELDS[name](size)


# -- Peer -------------------------------------------------------------------------------------------------------------------


DEGREE, CHANNELS = 2, 27
LEARNING_RATE = 0.05
START_DENSITY, START_COEFFICIENT = 0.01, 0.1


@dataclass
class Peer:
    """A field in two textures.

    Attributes:
        density: (n, n, n, 1) [1/length].
        harmonics: (n, n, n, 27).
    """

    density: mi.TensorXf
    harmonics: mi.TensorXf

    def __post_init__(self) -> None:
        self.resolution = self.density.shape[0]

    @classmethod
    def start(cls, resolution: int) -> Peer:
        """The initial field of the tutorial."""
        made = [(START_DENSITY, 1), (START_COEFFICIENT, CHANNELS)]
        return cls(*(dr.full(mi.TensorXf, value, (*(resolution,) * 3, channels)) for value, channels in made))

    def textures(self) -> tuple[mi.Texture3f, mi.Texture3f]:
        """Textures that propagate derivatives to the tensors."""
        how = {"wrap_mode": dr.WrapMode.Clamp, "use_accel": False, "migrate": False}
        return mi.Texture3f(self.density, **how), mi.Texture3f(self.harmonics, **how)

    @dr.syntax
    def follow(
        self, textures: tuple, o: mi.Point3f, d: mi.Vector3f, left: mi.Color3f | None = None, by: mi.Color3f | None = None
    ) -> mi.Color3f:
        """Radiance along rays of the unit cube; with ``left`` (the radiance) and ``by`` (its derivative), the reverse pass."""
        density, harmonics = textures
        primal = by is None
        box = mi.ScalarBoundingBox3f([0, 0, 0], [1, 1, 1])
        hit, t, far = box.ray_intersect(mi.Ray3f(o, d))
        step = 1.0 / self.resolution
        basis = dr.sh_eval(d, DEGREE)
        L = mi.Color3f(0) if primal else mi.Color3f(left)
        weight = mi.Float(1)
        active = mi.Bool(hit)
        t = dr.maximum(t, 0)
        while dr.hint(active, exclude=[density, harmonics]):
            p = o + t * d
            with dr.resume_grad(when=not primal):
                opacity = 1 - dr.exp(-dr.maximum(density.eval(p, active)[0], 0) * step)
                values = harmonics.eval(p, active)
                colour = mi.Color3f(0)
                for b, y in enumerate(basis):
                    colour += mi.Color3f(values[3 * b], values[3 * b + 1], values[3 * b + 2]) * y
                colour = dr.clip(colour, 0, 1)
                shown = weight * opacity * colour
                if dr.hint(primal, mode="scalar"):
                    L = dr.select(active, L + shown, L)
                else:
                    L = dr.select(active, L - dr.detach(shown), L)
                    through = 1 - opacity
                    ahead = dr.select(dr.detach(through) > 0, through / dr.detach(through), 1) * L
                    dr.backward_from(dr.select(active, dr.dot(by, shown + ahead), 0))
            weight *= dr.detach(1 - opacity)
            t += step
            active &= (t < far) & (weight > 0)
        return L

    def render(self, o: mi.Point3f, d: mi.Vector3f) -> mi.Color3f:
        """Radiance along rays."""
        with dr.suspend_grad():
            return self.follow(self.textures(), o, d)

    def backward(self, o: mi.Point3f, d: mi.Vector3f, radiance: mi.Color3f, by: mi.Color3f) -> tuple[mi.Float, mi.Float]:
        """Derivatives of a scalar by density and harmonics, from its derivative by the radiance."""
        for tensor in (self.density, self.harmonics):
            dr.enable_grad(tensor)
            dr.set_grad(tensor, 0)
        textures = self.textures()
        with dr.suspend_grad():
            self.follow(textures, o, d, radiance, by)
        slopes = dr.grad(self.density).array, dr.grad(self.harmonics).array
        dr.disable_grad(self.density, self.harmonics)
        return slopes

    def fit(self, views: list[tuple[mi.Point3f, mi.Vector3f, mi.Color3f]], steps: int) -> Iterator[None]:
        """Take steps with one view each; yields after each step."""
        adam = mi.ad.Adam(lr=LEARNING_RATE)
        adam["density"], adam["harmonics"] = self.density, self.harmonics
        for step in range(steps):
            o, d, target = views[step % len(views)]
            L = self.render(o, d)
            dr.eval(L)
            by = dr.sign(L - target) / (3 * dr.width(o))
            for name, slope in zip(("density", "harmonics"), self.backward(o, d, L, by), strict=True):
                dr.set_grad(adam[name], mi.TensorXf(slope, adam[name].shape))
            adam.step()
            self.density, self.harmonics = (dr.detach(adam[name]) for name in ("density", "harmonics"))
            yield

    def refined(self) -> Peer:
        """The field of the next stage, with twice the resolution."""
        n = 2 * self.resolution
        return Peer(*(dr.resample(t, (n, n, n, t.shape[3]), filter="linear") for t in (self.density, self.harmonics)))
