"""The work that contestants share: an extinction in the box [-1, 1]^3, and world rays through it."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.bench.extinctions import TO_WORLD
from mivol.bench.harness.timing import Contestant
from mivol.bench.scenes import perspective
from mivol.transport.media.grid_integral import integrate_tau
from mivol.transport.traversal.grid_blocks import find_empty_distances
from mivol.transport.traversal.lattice import Lattice

__all__ = ["Work", "camera_rays", "rays_across", "shuffled"]


@dataclass
class Work:
    """An extinction in the box, and world rays.

    Attributes:
        values: (Z, Y, X) [1/length].
        o, d: rays, evaluated, of float32 like everything that the contestants see.
    """

    values: np.ndarray
    o: mi.Point3f
    d: mi.Vector3f

    def __post_init__(self) -> None:
        self.tensor = mi.TensorXf(np.ascontiguousarray(self.values[..., None]))
        self.n = dr.width(self.d)

    def lattice(self, skip: bool = False) -> Lattice:
        """The grid for mivol's walk, empty blocks skipped or not."""
        return Lattice(self.tensor, TO_WORLD, find_empty_distances(self.tensor) if skip else None)

    def tau(self, skip: bool = False) -> Contestant:
        """The optical depth of each ray by mivol."""
        lattice = self.lattice(skip)
        return lambda _: integrate_tau(lattice, self.o, self.d)

    def spread(self, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Numbers, origins and directions of rays spread evenly over all: (m,), (m, 3), (m, 3) float64."""
        index = np.linspace(0, self.n - 1, min(count, self.n)).astype(int)
        return index, np.array(self.o).T[index].astype(np.float64), np.array(self.d).T[index].astype(np.float64)


def camera_rays(side: int, pixels: np.ndarray | None = None, k: int = 1) -> tuple[mi.Point3f, mi.Vector3f]:
    """Rays through the middles of the k x k parts of each pixel, row by row."""
    pixels = np.arange(side * side) if pixels is None else pixels
    y, x, j, i = (np.broadcast_to(a, (len(pixels), k, k)) for a in (*_pixel(pixels, side), *_part(k)))
    at = mi.Point2f(np.float32((x + (i + 0.5) / k).ravel() / side), np.float32((y + (j + 0.5) / k).ravel() / side))
    ray, _ = mi.load_dict(perspective(side)).sample_ray(0.0, 0.5, at, mi.Point2f(0.5))
    o, d = mi.Point3f(ray.o) + dr.zeros(mi.Point3f, dr.width(ray.d)), mi.Vector3f(ray.d)
    dr.eval(o, d)
    return o, d


def _pixel(pixels: np.ndarray, side: int) -> tuple[np.ndarray, np.ndarray]:
    return (pixels // side)[:, None, None], (pixels % side)[:, None, None]


def _part(k: int) -> tuple[np.ndarray, np.ndarray]:
    return np.arange(k)[None, :, None], np.arange(k)[None, None, :]


def shuffled(o: mi.Point3f, d: mi.Vector3f) -> tuple[mi.Point3f, mi.Vector3f]:
    """The same rays in an order drawn from the seed 0."""
    order = mi.UInt32(np.random.default_rng(0).permutation(dr.width(d)).astype(np.uint32))
    o, d = dr.gather(mi.Point3f, o, order), dr.gather(mi.Vector3f, d, order)
    dr.eval(o, d)
    return o, d


def rays_across(rng: np.random.Generator, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Rays in all directions through points of the box, (3, n) float32; a few along the axes."""
    d = rng.normal(size=(3, n))
    d[:, : n // 8] = np.repeat(np.eye(3), -(-n // 24), axis=1)[:, : n // 8]
    d /= np.linalg.norm(d, axis=0)
    return np.float32(rng.uniform(-1, 1, (3, n)) - rng.uniform(2, 8, n) * d), np.float32(d)
