"""Volumes, scenes and rays of the studies: the tutorial's smoke and other volumes, scenes of stock plugins, a walk of rays.

Conventions. A volume is (Z, Y, X) float32 [1/length] at voxel centres of the box [-1, 1]^3. Files come from MIVOL_DATA
(default: shared/data beside the checkout). A made-up volume of the same size replaces a missing file, and ``origin``, which
the JSON holds, says so. A light is a function that returns the changed parts of a scene: ``emitter``, and ``phase`` of the
medium.

Rays are in world space. Times of long fits are given for a machine that walks ``REFERENCE_RATE`` rays per second through the
smoke of the tutorial. The rate of this machine is measured in the same run, so other work on the machine changes both times
alike.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.bench.harness.contests import Contestant, race
from mivol.fields.procedural import make_procedural
from mivol.files import read_volume
from mivol.optim.events import upsample
from mivol.transport.media.grid_extinction import integrate_tau
from mivol.transport.traversal.grid_blocks import find_empty_distances
from mivol.transport.traversal.lattice import Lattice

__all__ = [
    "CHECKOUT",
    "DATA",
    "DENSITY",
    "REFERENCE_RATE",
    "TO_WORLD",
    "TUTORIAL_SCALE",
    "StudyExtinction",
    "GridRays",
    "ParameterGradient",
    "as_dense_as_smoke",
    "box_scene",
    "camera",
    "camera_rays",
    "constant_light",
    "ct_scan",
    "directional_light",
    "emitter_inside",
    "fine_smoke",
    "glass_under_a_sky",
    "les_cloud",
    "made_up",
    "make_integrator",
    "map_directions",
    "measure_walk_rate",
    "milk_in_a_glass",
    "milky_glass",
    "perspective",
    "point_light",
    "reference_seconds",
    "reference_walk",
    "smoke",
    "square_error",
    "sun_and_sky",
    "sun_before_the_camera",
    "threads_in_space",
]

CHECKOUT = Path(__file__).resolve().parents[2]
DATA = Path(os.environ.get("MIVOL_DATA", CHECKOUT.parent / "shared" / "data"))

TO_WORLD = np.array([[2, 0, 0, -1], [0, 2, 0, -1], [0, 0, 2, -1], [0, 0, 0, 1]], np.float64)
"""Transform from the unit cube to [-1, 1]^3, the box of every volume, as in the tutorial."""

TUTORIAL_SCALE = 40.0
"""Factor on the smoke in the tutorial; optical depths reach 65."""


class StudyExtinction(NamedTuple):
    """An extinction (Z, Y, X) float32 [1/length] and its origin."""

    values: np.ndarray
    origin: str

    def __str__(self) -> str:
        return f"{'x'.join(map(str, self.values.shape[::-1]))}, {self.origin}"


def smoke() -> StudyExtinction:
    """The smoke of the tutorial at its density, or made-up smoke of the same size."""
    path = DATA / "volumes_vol" / "tutorials_volume.vol"
    if path.is_file():
        return StudyExtinction(
            np.float32(TUTORIAL_SCALE) * read_volume(path, frame="unit").values[..., 0], "Mitsuba tutorial, x 40"
        )
    return made_up((53, 45, 44), peak=1.85 * TUTORIAL_SCALE)


def fine_smoke(res: int) -> StudyExtinction:
    """The smoke upsampled to res^3 voxels."""
    coarse = smoke()
    fine = upsample(mi.TensorXf(np.ascontiguousarray(coarse.values[..., None])), (res,) * 3)
    return StudyExtinction(np.array(fine)[..., 0], f"{coarse.origin}, upsampled")


def made_up(shape: tuple[int, int, int], peak: float, why: str = "no data folder") -> StudyExtinction:
    """Made-up soft blobs and filaments (Z, Y, X) with the seed 0; ``why`` is the reason in their origin."""
    return StudyExtinction(make_procedural("tangle", shape, 0, peak)[..., 0], f"procedural ({why})")


def ct_scan(res: int) -> StudyExtinction:
    """The CT scan of a bonsai at 256^3 voxels, 0 to 2 [1/length]; a made-up volume at another resolution."""
    path = DATA / "ct_mri" / "bonsai.vti"
    if res == 256 and path.is_file():
        values = read_volume(path, frame="unit").values[..., 0]
        return StudyExtinction(values * np.float32(2 / values.max()), "bonsai CT")
    return made_up((res,) * 3, 2.0, "no data folder" if res == 256 else "quick")


def threads_in_space(res: int) -> StudyExtinction:
    """Thin curved threads in 1 % of res^3 voxels; all other voxels are exactly 0."""
    rng = np.random.default_rng(0)
    values = np.zeros((res,) * 3, np.float32)
    offsets = np.stack(np.meshgrid(*[np.arange(-3, 4)] * 3, indexing="ij"), -1).reshape(-1, 3)
    stamp = np.maximum(0, 1 - np.sum(offsets**2, axis=1) / 10).astype(np.float32)
    offsets, stamp = offsets[stamp > 0], stamp[stamp > 0]
    s = np.linspace(0, 2 * np.pi, 2 * res)[:, None]
    while np.count_nonzero(values) < 0.01 * values.size:
        a, b, c = rng.uniform(-0.3, 0.3, (3, 3))
        curve = 0.5 + a * np.cos(s) + b * np.sin(s) + c * np.cos(2 * s) / 2
        nodes = np.clip(np.rint(curve * res).astype(int)[:, None] + offsets, 0, res - 1)
        np.maximum.at(values, tuple(nodes.reshape(-1, 3).T), np.tile(stamp, len(curve)))
    return StudyExtinction(20 * values, f"made-up threads, {np.count_nonzero(values) / values.size:.1%} of the voxels not 0")


def les_cloud() -> StudyExtinction:
    """A cloud of a large-eddy simulation, stretched to the box; its optical depth along the vertical stays the same."""
    path = DATA / "clouds_les" / "rico32x37x26.txt"
    if not path.is_file():
        return made_up((26, 37, 32), TUTORIAL_SCALE)
    cloud = read_volume(path)
    height = np.linalg.norm(cloud.to_world[:3, 2])
    return StudyExtinction(cloud.values[..., 0] * np.float32(height / 2), "LES cloud (RICO), stretched to a cube")


def as_dense_as_smoke(volume: StudyExtinction) -> StudyExtinction:
    """Scale a volume to the largest extinction of the smoke, and empty its outermost voxels.

    Mitsuba continues rays (1 + |p|) 9e-5 behind a boundary. A medium that touches the boundary loses this skin, which holds 2 %
    of the light at such an extinction (measured by quadrature in float64, which agrees with mivol).
    """
    values = np.pad(volume.values[1:-1, 1:-1, 1:-1], 1)
    return StudyExtinction(values * np.float32(smoke().values.max() / values.max()), f"{volume.origin}, as dense as the smoke")


# -- Scenes ------------------------------------------------------------------------------------------------------------


def perspective(side: int) -> dict:
    """A camera of the tutorial: distance 4, field of view 45 degrees, turned by 18 degrees; z of the smoke is up."""
    angle = math.radians(18)
    return camera(side, (4 * math.sin(angle), -4 * math.cos(angle), 0), (0, 0, 0), 45)


def camera(
    side: int,
    origin: Sequence[float],
    target: Sequence[float],
    fov: float = 40,
    up: Sequence[float] = (0, 0, 1),
) -> dict:
    """A camera with a square image, a box filter and independent samples; the field of view in degrees."""
    return {
        "type": "perspective",
        "fov": fov,
        "to_world": mi.ScalarTransform4f().look_at(origin=list(origin), target=list(target), up=list(up)),
        "film": {
            "type": "hdrfilm",
            "width": side,
            "height": side,
            "component_format": "float32",
            "rfilter": {"type": "box"},
        },
        "sampler": {"type": "independent"},
    }


def box_scene(values: np.ndarray, side: int, albedo: float | Sequence[float] = 0.0, **more: dict) -> dict:
    """A box with an extinction, seen by a camera of the tutorial.

    Args:
        values: extinction (Z, Y, X), rgb (Z, Y, X, 3), or (3,) of a homogeneous rgb medium [1/length].
        side: edge of the image [pixels].
        albedo: albedo of the medium; rgb for an rgb extinction.
        more: ``phase`` of the medium, ``bsdf`` of the box, and parts of the scene. A scene without parts gets a sky of
            radiance 1.
    """
    medium = liquid(values, albedo) if values.ndim == 1 else grid_medium(values, albedo)
    if "phase" in more:
        medium["phase"] = more.pop("phase")
    bsdf = more.pop("bsdf", {"type": "null"})
    return {
        "type": "scene",
        "box": {"type": "cube", "bsdf": bsdf, "interior": medium},
        "sensor": perspective(side),
        **(more or {"sky": {"type": "constant", "radiance": {"type": "uniform", "value": 1.0}}}),
    }


def grid_medium(values: np.ndarray, albedo: float) -> dict:
    """A medium whose extinction is a grid, (Z, Y, X) or (Z, Y, X, 3) [1/length]."""
    to_world = mi.ScalarTransform4f(np.float32(TO_WORLD))
    nodes = mi.VolumeGrid(values if values.ndim == 4 else values[..., None])
    grid = {"type": "gridvolume", "grid": nodes, "raw": True, "to_world": to_world}
    return {"type": "heterogeneous", "sigma_t": grid, "albedo": albedo}


def liquid(sigma_t: np.ndarray, albedo: Sequence[float]) -> dict:
    """A homogeneous medium of an extinction (3,) [1/length] and an albedo in rgb."""
    # Colours of a scene are at most 1; a scale holds the rest.
    most = float(sigma_t.max())
    share = {"type": "rgb", "value": [float(x) / most for x in sigma_t]}
    return {
        "type": "homogeneous",
        "sigma_t": share,
        "scale": most,
        "albedo": {"type": "rgb", "value": [float(x) for x in albedo]},
    }


def constant_light() -> dict:
    """Radiance 1 from all directions, isotropic scattering."""
    return {"emitter": {"type": "constant"}, "phase": {"type": "isotropic"}}


def point_light(position: tuple[float, float, float]) -> dict:
    """A point light, isotropic scattering."""
    emitter = {"type": "point", "position": list(position), "intensity": {"type": "rgb", "value": [3.0, 2.5, 2.0]}}
    return {"emitter": emitter, "phase": {"type": "isotropic"}}


def sun_and_sky(height: int = 128) -> dict:
    """A sky that brightens upwards, and a sun of 2 degrees' radius with a third of the light; HG g = 0.8.

    Args:
        height: height of the environment map [pixels].
    """
    d = map_directions(height)
    sky = (0.25 + 0.15 * d[..., 2:]) * np.array([0.8, 1.0, 1.3])
    sun = d @ np.array([0.48, 0.6, 0.64]) > math.cos(math.radians(2.0))
    image = np.where(sun[..., None], np.array([420.0, 390.0, 330.0]), sky)
    return _environment(image) | {"phase": {"type": "hg", "g": 0.8}}


def sun_before_the_camera() -> dict:
    """A sun of 4 degrees' radius, 35 degrees off the axis of the camera, in a nearly black sky; HG g = 0.8."""
    d = map_directions(128)
    sun = d @ np.array([-0.253, 0.778, 0.574]) > math.cos(math.radians(4.0))
    return _environment(np.where(sun[..., None], np.array([105.0, 97.0, 82.0]), 0.01)) | {"phase": {"type": "hg", "g": 0.8}}


def glass_under_a_sky() -> dict:
    """A box of smooth glass under a sky that brightens upwards, isotropic scattering."""
    image = (1 + 0.5 * map_directions(16)[..., 2:]) * np.array([0.8, 1.0, 1.2])
    return _environment(image) | {"phase": {"type": "isotropic"}, "bsdf": {"type": "dielectric"}}


def map_directions(height: int) -> np.ndarray:
    """World directions (H, 2 H, 3) of the pixels of an environment map in :func:`_environment`, z up."""
    theta, phi = np.meshgrid((np.arange(height) + 0.5) / height * np.pi, np.arange(2 * height) / height * np.pi, indexing="ij")
    return np.stack([np.sin(theta) * np.sin(phi), np.sin(theta) * np.cos(phi), np.cos(theta)], axis=-1)


def _environment(image: np.ndarray) -> dict:
    """An environment map (H, 2 H, 3). Mitsuba's maps have y up, these scenes have z up."""
    turned = mi.ScalarTransform4f().rotate([1, 0, 0], 90)
    return {"emitter": {"type": "envmap", "bitmap": mi.Bitmap(image.astype(np.float32)), "to_world": turned}}


def directional_light() -> dict:
    """A directional light from above, HG g = 0.8."""
    emitter = {"type": "directional", "direction": [0.3, 0.2, -1.0], "irradiance": {"type": "rgb", "value": [3.0, 2.5, 2.0]}}
    return {"emitter": emitter, "phase": {"type": "hg", "g": 0.8}}


def emitter_inside() -> dict:
    """A small ball of light in the medium, isotropic scattering."""
    emitter = {"type": "sphere", "center": [0.2, 0.1, 0.3], "radius": 0.2, "emitter": {"type": "area", "radiance": 9.0}}
    return {"emitter": emitter, "phase": {"type": "isotropic"}}


def milky_glass() -> dict:
    """A box of smooth glass under a large emitter and a faint sky, isotropic scattering."""
    emitter = {"type": "sphere", "center": [1.2, -1.5, 2.2], "radius": 0.6, "emitter": {"type": "area", "radiance": 9.0}}
    sky = {"type": "constant", "radiance": 0.5}
    return {"emitter": emitter, "sky": sky, "phase": {"type": "isotropic"}, "bsdf": {"type": "dielectric"}}


def milk_in_a_glass() -> dict:
    """The light of :func:`milky_glass`; a liquid with the index of water in a glass of a twentieth of the box on each side."""
    water, glass, air = 1.333, 1.5, 1.0
    wall = {"type": "dielectric", "int_ior": glass, "ext_ior": air}
    outside = {"type": "cube", "to_world": mi.ScalarTransform4f().scale(1.1), "bsdf": wall}
    return milky_glass() | {"bsdf": {"type": "dielectric", "int_ior": water, "ext_ior": glass}, "glass": outside}


def make_integrator(name: str, depth: int, hide_emitters: bool = False, roulette: int = 64) -> mi.Integrator:
    """An integrator with a ``max_depth``, to be made anew for each scene: ``prbvolpath`` keeps flags of its first scene.

    Russian roulette begins at the depth ``roulette``. In absorbing scenes, paths beyond a depth of 64 hardly count.
    """
    return mi.load_dict({"type": name, "max_depth": depth, "rr_depth": roulette, "hide_emitters": hide_emitters})


DENSITY = "box.interior_medium.sigma_t.data"
"""Key of the voxels of :func:`mivol.bench.scenes.box_scene` in ``mi.traverse``."""


@dataclass
class ParameterGradient:
    """Gradients with respect to one parameter of a scene, by one integrator made for this scene."""

    scene: mi.Scene
    integrator: mi.Integrator
    key: str = DENSITY

    def __post_init__(self) -> None:
        self.params = mi.traverse(self.scene)

    def _collect(self, backward: Callable[[], None]) -> mi.Float:
        values = self.params[self.key]
        values = type(values)(values)
        dr.enable_grad(values)
        self.params[self.key] = values
        self.params.update()
        backward()
        gradient = dr.ravel(dr.grad(self.params[self.key]))
        dr.eval(gradient)
        dr.disable_grad(self.params[self.key])
        return gradient

    def of_mean(self, seed: int, spp: int) -> mi.Float:
        """Gradient of the mean of the image."""
        width, height = self.scene.sensors()[0].film().size()
        ones = dr.full(mi.TensorXf, 1 / (3 * height * width), (height, width, 3))
        return self._collect(lambda: self.integrator.render_backward(self.scene, self.params, ones, seed=seed, spp=spp))

    def of_loss(self, loss: Callable[[mi.TensorXf], mi.Float], seed: int, spp: int) -> mi.Float:
        """Gradient of a loss of the image, with the render of the image."""

        def backward() -> None:
            dr.backward(loss(mi.render(self.scene, self.params, integrator=self.integrator, seed=seed, spp=spp)))

        return self._collect(backward)

    def mean(self, values: np.ndarray, seed: int, spp: int) -> float:
        """Mean of the image for other values (Z, Y, X) of a grid."""
        self.params[self.key] = mi.TensorXf(np.float32(values)[..., None])
        self.params.update()
        return float(np.mean(np.array(mi.render(self.scene, integrator=self.integrator, seed=seed, spp=spp), np.float64)))


def square_error(target: mi.TensorXf) -> Callable[[mi.TensorXf], mi.Float]:
    """The mean squared difference of an image to a target."""
    return lambda image: dr.mean(dr.square(image - target), axis=None)


# -- Rays through a volume ---------------------------------------------------------------------------------------------

REFERENCE_RATE = 25e6
"""Rate of the reference machine [rays/s]."""

ROUNDS = 8
"""Walks of which the median is taken."""


@dataclass
class GridRays:
    """An extinction grid in the box, and rays.

    Attributes:
        values: (Z, Y, X) [1/length].
        o, d: evaluated origins and directions, float32.
    """

    values: np.ndarray
    o: mi.Point3f
    d: mi.Vector3f

    def __post_init__(self) -> None:
        self.tensor = mi.TensorXf(np.ascontiguousarray(self.values[..., None]))
        self.n = dr.width(self.d)

    def lattice(self, skip_empty: bool = False) -> Lattice:
        """Lattice of the grid; ``skip_empty`` lets rays leap over empty blocks."""
        return Lattice(self.tensor, TO_WORLD, find_empty_distances(self.tensor) if skip_empty else None)

    def optical_depths(self, skip_empty: bool = False) -> Contestant:
        """Contestant that integrates the optical depth of each ray by mivol."""
        lattice = self.lattice(skip_empty)
        return lambda _: integrate_tau(lattice, self.o, self.d)

    def select(self, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Indices, origins and directions of evenly spaced rays: (m,), (m, 3), (m, 3) float64."""
        index = np.linspace(0, self.n - 1, min(count, self.n)).astype(int)
        return index, np.array(self.o).T[index].astype(np.float64), np.array(self.d).T[index].astype(np.float64)


def camera_rays(side: int, pixels: np.ndarray | None = None, k: int = 1) -> tuple[mi.Point3f, mi.Vector3f]:
    """Rays through the centres of the k x k parts of each pixel, row by row.

    Args:
        side: edge of the image [pixels].
        pixels: indices of pixels; None: all.
        k: parts of a pixel along an axis.
    """
    pixels = (np.arange(side * side) if pixels is None else pixels)[:, None, None]
    part = (np.arange(k) + 0.5) / k
    shape = (len(pixels), k, k)
    x = np.broadcast_to(pixels % side + part, shape).ravel() / side
    y = np.broadcast_to(pixels // side + part[:, None], shape).ravel() / side
    at = mi.Point2f(np.float32(x), np.float32(y))
    ray, _ = mi.load_dict(perspective(side)).sample_ray(0.0, 0.5, at, mi.Point2f(0.5))
    o, d = mi.Point3f(ray.o) + dr.zeros(mi.Point3f, dr.width(ray.d)), mi.Vector3f(ray.d)
    dr.eval(o, d)
    return o, d


def reference_walk(side: int) -> Contestant:
    """Contestant that walks the camera rays of an image through the smoke; ``side`` squared rays."""
    return GridRays(smoke().values, *camera_rays(side)).optical_depths()


def measure_walk_rate(side: int) -> float:
    """Rays per second of the reference walk on all threads, by processor time."""
    walk = race({"walk": reference_walk(side)}, ROUNDS)["walk"]
    return side**2 * dr.thread_count() / float(np.median(walk.processor))


def reference_seconds(processor: float, rate: float) -> float:
    """Convert processor time of all threads to seconds of the reference machine; ``rate`` is the rate of this machine."""
    return processor / dr.thread_count() * rate / REFERENCE_RATE
