r"""Where a radiance field begins to be opaque, as triangles: the surface of one extinction.

.. math:: \{x : a(\rho(x)) = \sigma\} = \{x : \rho(x) = a^{-1}(\sigma)\}

since the activation a rises: the triangles follow what is interpolated, not what is shown of its nodes. Around the box is
vacuum, so that a field that reaches a side is closed there, half a voxel outside at most. Levels of a nested field are followed
one by one, each where no other level is: a surface ends a triangle behind the side of a level's box, and goes on in the next.

References: Lorensen and Cline 1987 (marching cubes); Lewiner et al. 2003 (without ambiguous cells, scikit-image's).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import mitsuba as mi
import numpy as np
from scipy.ndimage import map_coordinates

from mivol.errors import MivolError
from mivol.fields.spherical_grid import SphericalGrid
from mivol.files import encode_srgb
from mivol.files.mesh import Mesh
from mivol.machine import available_memory
from mivol.photos import Camera, project

__all__ = ["INVERSES", "default_level", "vertex_normals", "extract_surface", "DepthView", "fuse_depths"]

INVERSES: dict[str, Callable[[float], float]] = {
    "none": lambda sigma: sigma,
    "relu": lambda sigma: sigma,
    "softplus": lambda sigma: sigma + math.log(-math.expm1(-sigma)),
    "exp": math.log,
}
"""Name of an activation -> the stored density of an extinction above 0."""


def default_level(field: SphericalGrid) -> float:
    """The extinction [1/length] of a surface: where a voxel's longest edge lets half of the light through, or, in a field that
    is thinner than that, half of what its matter has (the mean extinction of its nodes, weighted by itself)."""
    edges = np.linalg.norm(field.to_world[:3, :3], axis=0) / field.res[::-1]
    sigma = np.array(field.activation_function.value_and_slope(mi.Float(field.values()[0]))[0], np.float64)
    total = sigma.sum()
    mean = float((sigma * sigma).sum() / total) if total > 0 else math.inf
    return min(math.log(2) / float(edges.max()), mean / 2)


def extract_surface(field: SphericalGrid, level: float | None = None) -> Mesh:
    """The surface of one extinction, with its colours as seen from outside along the normal.

    Args:
        field: any; a sparse one is laid out in full.
        level: extinction [1/length]; None: :func:`default_level`, of each of the levels of a nested field.

    Returns:
        World coordinates, counterclockwise from outside; normals are means of the triangles around a point.

    Error: a corner is where linear interpolation along an edge of the grid meets the level, exactly; between corners the
        triangles differ from the trilinear field by O(voxel^2).

    Raises:
        MivolError: a level that is not above 0, or one that the field does not reach.
    """
    if level is not None and not 0 < level < math.inf:
        raise MivolError(f"the level {level:g} was given for a surface; an extinction above 0 is expected.")
    grids = [field.extract_level(number) for number in range(field.levels)] if field.levels > 1 else [field]
    found, most, last = [], 0.0, len(grids) - 1
    for number, grid in enumerate(grids):
        density = grid.to_dense()[0].transpose(2, 1, 0)
        wanted = default_level(grid) if level is None else float(level)
        raw = INVERSES[grid.activation](wanted)
        most = max(most, float(np.array(grid.activation_function.value_and_slope(mi.Float(float(density.max())))[0])[0]))
        inner = None if number == 0 else grids[number - 1].to_world
        found += _extract_grid_surface(grid, density, raw, inner, number == last)
    if not found:
        raise MivolError(f"no node of the field reaches the extinction {wanted:g}, only {most:g}; give a lower level.")
    firsts = np.cumsum([0, *(len(mesh.points) for mesh in found)])
    faces = np.concatenate([mesh.faces + first for mesh, first in zip(found, firsts, strict=False)])
    points, normals, colours = (np.concatenate([getattr(m, k) for m in found]) for k in ("points", "normals", "colours"))
    return Mesh(points, faces, normals, colours)


def _extract_grid_surface(
    grid: SphericalGrid, density: np.ndarray, raw: float, inner: np.ndarray | None, closes: bool
) -> list[Mesh]:
    """The surface of one grid; none where nothing reaches it, or all of it is left out.

    Args:
        grid: the grid.
        density: its nodes, in the order X Y Z.
        raw: the stored density of the surface.
        inner: a box in which it is left out; None for none.
        closes: whether it is closed at the sides of its box; else it is cut off there, since another grid goes on behind them.
    """
    from skimage.measure import marching_cubes  # slow to import

    around = {"constant_values": min(grid.activation_function.vacuum, raw - 1e-3)} if closes else {"mode": "edge"}
    padded = np.pad(density, 1, **around)
    if not padded.min() <= raw < padded.max():
        return []
    nodes, faces, _, _ = marching_cubes(padded, raw, gradient_direction="ascent")
    points = _to_world(grid, nodes - 1.0)
    if np.linalg.det(grid.to_world[:3, :3]) < 0:
        faces = faces[:, ::-1]
    normals = vertex_normals(points, faces)
    # Levels overlap by a triangle at the side of a box, so that no gap is seen between them.
    kept = np.ones(len(faces), bool) if closes else _find_inside(grid.to_world, points)[faces].any(axis=1)
    if inner is not None:
        kept &= ~_find_inside(inner, points)[faces].all(axis=1)
    if not kept.any():
        return []
    used, flat = np.unique(faces[kept], return_inverse=True)
    return [Mesh(points[used], flat.reshape(-1, 3), normals[used], _eval_colours(grid, points[used], normals[used]))]


def _find_inside(box: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Which points lie in a box, the unit cube under a (4, 4) map."""
    inverse = np.linalg.inv(box)
    local = points @ inverse[:3, :3].T + inverse[:3, 3]
    return ((local >= 0) & (local <= 1)).all(axis=1)


def _to_world(field: SphericalGrid, nodes: np.ndarray) -> np.ndarray:
    """World places of lattice coordinates (x, y, z), node n at n."""
    unit = (nodes.astype(np.float64) + 0.5) / field.res[::-1]
    return unit @ field.to_world[:3, :3].T + field.to_world[:3, 3]


def vertex_normals(points: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Unit means over the triangles at each point, weighted by their areas."""
    a, b, c = (points[faces[:, k]] for k in range(3))
    across = np.cross(b - a, c - a)
    total = np.zeros_like(points)
    for k in range(3):
        np.add.at(total, faces[:, k], across)
    length = np.linalg.norm(total, axis=1, keepdims=True)
    return np.where(length > 0, total / np.where(length > 0, length, 1), (0.0, 0.0, 1.0))


def _eval_colours(field: SphericalGrid, points: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """What a ray that comes in against the normal sees; corners outside the box show the nearest place in it."""
    inverse = np.linalg.inv(field.to_world)
    inside = np.clip(points @ inverse[:3, :3].T + inverse[:3, 3], 1e-6, 1 - 1e-6) @ field.to_world[:3, :3].T
    p, d = (np.ascontiguousarray(v.T, np.float32) for v in (inside + field.to_world[:3, 3], -normals))
    _, colour = field.eval(mi.Point3f(*p), mi.Vector3f(*d))
    return np.clip(np.array(colour).T, 0, 1) if field.space == "srgb" else encode_srgb(np.array(colour).T)


FREE_SPACE_WEIGHT = 0.1
"""Weight of a view that says no more than "in front", over that of one that sees a surface near."""

TRUNCATION = 4.0
"""Distance beyond which a view says no more than "in front" [voxel]."""


@dataclass(frozen=True)
class DepthView:
    """What a camera saw.

    Attributes:
        camera: without a distorting lens.
        depth: (H, W) along the axis of the camera [length]; infinite where nothing is.
        colour: (H, W, 3) in 0..1.
    """

    camera: Camera
    depth: np.ndarray
    colour: np.ndarray


def fuse_depths(views: Iterable[DepthView], low: np.ndarray, high: np.ndarray, resolution: int) -> Mesh:
    """The surface that pictures of distances agree on.

    Args:
        views: from all around; each is looked at once.
        low, high: (3,) corners of a box [length]; what lies outside is left out.
        resolution: voxels along its longest edge; they are cubes.

    Returns:
        A mesh with colours, closed but where it is cut by the box; counterclockwise from outside.

    Raises:
        MivolError: a box without volume, a resolution below 2, more memory than is free, with the resolution that fits, or
            pictures that show no surface in the box.
    """
    low, high = np.asarray(low, np.float64), np.asarray(high, np.float64)
    if not (np.isfinite([low, high]).all() and (high > low).all()) or resolution < 2:
        found = f"a box from {low.tolist()} to {high.tolist()} of {resolution} voxels"
        raise MivolError(f"{found} was given; a corner above the other, and at least 2 voxels, are expected.")
    from skimage.measure import marching_cubes  # slow to import

    _check_memory(high - low, resolution)
    voxel = float((high - low).max()) / resolution
    size = np.maximum(np.ceil((high - low) / voxel - 1e-6), 2).astype(int)
    fused = _FusedDepths(low, voxel, size)
    for view in views:
        fused.add(view)
    distance = fused.distance()
    if not distance.min() < 0 < distance.max():
        raise MivolError("no surface was seen in the box; give a box that holds one, and views that see it.")
    nodes, faces, _, _ = marching_cubes(distance, 0.0, gradient_direction="descent")
    points = low + (nodes + 0.5) * voxel
    colours = np.stack([map_coordinates(channel, nodes.T, order=1, mode="nearest") for channel in fused.colours()], axis=1)
    return Mesh(points, faces, vertex_normals(points, faces), np.clip(colours, 0, 1))


VOXEL_BYTES = 64
"""Of a voxel: six sums, their means, and the distances as marching cubes takes them."""


def _check_memory(extent: np.ndarray, resolution: int) -> None:
    needed, free = VOXEL_BYTES * resolution**3 * float(np.prod(extent / extent.max())), available_memory()
    if free is not None and needed > free:
        fitting = int(resolution * (free / needed) ** (1 / 3))
        raise MivolError(
            f"A grid of {resolution} voxels along the longest edge takes {needed / 2**30:.1f} GiB, and {free / 2**30:.1f} GiB "
            f"are free; a resolution of at most {fitting} fits."
        )


class _FusedDepths:
    """Sums over views at the centres of voxels, (X, Y, Z)."""

    def __init__(self, low: np.ndarray, voxel: float, size: np.ndarray) -> None:
        self.low, self.voxel, self.size = low, voxel, size
        self.total, self.said = np.zeros(size, np.float32), np.zeros(size, np.float32)
        self.colour, self.coloured = np.zeros((3, *size), np.float32), np.zeros(size, np.float32)

    def add(self, view: DepthView) -> None:
        """Take a view into account, slab by slab."""
        y, z = (self.low[a] + (np.arange(self.size[a]) + 0.5) * self.voxel for a in (1, 2))
        for i in range(self.size[0]):
            x = self.low[0] + (i + 0.5) * self.voxel
            places = np.stack(np.broadcast_arrays(x, *np.meshgrid(y, z, indexing="ij")), axis=-1).reshape(-1, 3)
            self._add_slab(i, view, places)

    def _add_slab(self, i: int, view: DepthView, places: np.ndarray) -> None:
        pixel, depth = project(view.camera, places)
        with np.errstate(invalid="ignore"):
            seen = np.flatnonzero((depth > 0) & ((pixel >= 0) & (pixel < view.camera.size)).all(axis=1))
        column, row = pixel[seen].astype(int).T
        away = (view.depth[row, column] - depth[seen]) / (TRUNCATION * self.voxel)
        told = away > -1
        seen, row, column, away = seen[told], row[told], column[told], away[told]
        near = away < 1
        weight = np.where(near, 1, FREE_SPACE_WEIGHT)
        self.total[i].reshape(-1)[seen] += weight * np.minimum(away, 1)
        self.said[i].reshape(-1)[seen] += weight
        self.coloured[i].reshape(-1)[seen[near]] += 1
        for channel in range(3):
            self.colour[channel, i].reshape(-1)[seen[near]] += view.colour[row[near], column[near], channel]

    def distance(self) -> np.ndarray:
        """Mean signed distance [truncation], above 0 outside; -1 where no view says anything."""
        return np.where(self.said > 0, self.total / np.maximum(self.said, 1), -1)

    def colours(self) -> np.ndarray:
        """(3, X, Y, Z) mean colours near the surface."""
        return self.colour / np.maximum(self.coloured, 1)
