"""A walk of rays through a grid of extinctions: contestant of several studies, and measure of the speed of a machine.

Conventions. The grid fills the box [-1, 1]^3; rays are in world space. Times of long fits are given for a machine that walks
``REFERENCE_RATE`` rays per second through the smoke of the tutorial. The rate of this machine is measured in the same run, so
other work on the machine changes both times alike.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.bench.extinctions import TO_WORLD, smoke
from mivol.bench.harness.timing import Contestant, race
from mivol.bench.scenes import perspective
from mivol.transport.media.grid_integral import integrate_tau
from mivol.transport.traversal.grid_blocks import find_empty_distances
from mivol.transport.traversal.lattice import Lattice

__all__ = ["REFERENCE_RATE", "GridRays", "camera_rays", "measure_walk_rate", "reference_seconds", "reference_walk"]

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
