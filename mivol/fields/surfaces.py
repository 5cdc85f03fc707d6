r"""Surfaces as triangle meshes by marching cubes: of a radiance field at one extinction, and of depth images.

Of a field. The surface of the extinction sigma is

.. math:: \{x : a(\rho(x)) = \sigma\} = \{x : \rho(x) = a^{-1}(\sigma)\}

since the activation a rises. Triangles follow the interpolated density, not the extinction at the nodes. The box is surrounded
by vacuum, so a field that reaches a side is closed there, at most half a voxel outside. The levels of a nested field are meshed
separately: a surface ends one triangle beyond the side of a level's box and continues in the next level.

Of depth images. A voxel centre at depth z on the line to a surface at depth d has the signed distance s = d - z. With the
truncation t, a view contributes

.. math:: v = \min(1, s / t) \quad \text{if} \quad s > -t,

and nothing to voxels further behind, which the surface hides. The mean of v over all contributing views changes sign at the
surface. A pixel without a surface marks its whole line as free. Unseen voxels count as inside, which closes surfaces between
surrounding cameras. A view of a surface near the voxel weighs ten times a view of free space: depths of half-transparent
matter disagree, and a single view through the matter would otherwise tear a hole. Matter thinner than the truncation loses
accuracy: its far side moves outwards, and its rim shrinks if some pixels see the matter and others pass by.

References: Lorensen and Cline 1987 (marching cubes); Lewiner et al. 2003 (without ambiguous cells, as in scikit-image);
Curless, Levoy, A Volumetric Method for Building Complex Models from Range Images, 1996; Newcombe et al., KinectFusion, 2011.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace

import mitsuba as mi
import numpy as np
from scipy.ndimage import map_coordinates

from mivol.errors import MivolError
from mivol.fields.spherical_grid import SphericalGrid
from mivol.files import encode_srgb
from mivol.files.mesh import Atlas, Mesh
from mivol.machine import check_memory
from mivol.photos import Camera, project


def default_level(field: SphericalGrid) -> float:
    """The default extinction of a surface [1/length].

    The smaller of two values: the extinction at which a voxel's longest edge transmits half of the light, and half the mean
    extinction of the nodes, weighted by itself.
    """
    edges = np.linalg.norm(field.to_world[:3, :3], axis=0) / field.res[::-1]
    sigma = np.array(field.activation_function.value_and_slope(mi.Float(field.values()[0]))[0], np.float64)
    total = sigma.sum()
    mean = float((sigma * sigma).sum() / total) if total > 0 else math.inf
    return min(math.log(2) / float(edges.max()), mean / 2)


def extract_surface(field: SphericalGrid, level: float | None = None, textured: bool = False) -> Mesh:
    """The surface of one extinction, with colours as seen from outside along the normal.

    Args:
        field: any field; a sparse field is laid out densely.
        level: extinction [1/length]; None: :func:`default_level`, for each level of a nested field.
        textured: whether the mesh has a texture too.

    Returns:
        A mesh in world coordinates, counterclockwise from outside. Normals are means of the triangles around a point.

    Error: a vertex lies exactly where linear interpolation along an edge of the grid meets the level. Between vertices the
        triangles differ from the trilinear field by O(voxel^2).

    Raises:
        MivolError: a level that is not above 0 or that the field does not reach, or a texture of too many triangles.
    """
    if level is not None and not 0 < level < math.inf:
        raise MivolError(f"the level {level:g} was given for a surface; an extinction above 0 is expected.")
    grids = [field.extract_level(number) for number in range(field.levels)] if field.levels > 1 else [field]
    meshes, sources, largest, last = [], [], 0.0, len(grids) - 1
    for number, grid in enumerate(grids):
        density = grid.to_dense()[0].transpose(2, 1, 0)
        sigma = default_level(grid) if level is None else float(level)
        raw = grid.activation_function.inverse(sigma)
        largest = max(largest, float(np.array(grid.activation_function.value_and_slope(mi.Float(float(density.max())))[0])[0]))
        inner = None if number == 0 else grids[number - 1].to_world
        found = _extract_grid_surface(grid, density, raw, inner, number == last)
        meshes += found
        sources += [grid] * len(found)
    if not meshes:
        raise MivolError(f"no node of the field reaches the extinction {sigma:g}, only {largest:g}; give a lower level.")
    firsts = np.cumsum([0, *(len(mesh.points) for mesh in meshes)])
    faces = np.concatenate([mesh.faces + first for mesh, first in zip(meshes, firsts, strict=False)])
    points, normals, colours = (np.concatenate([getattr(m, k) for m in meshes]) for k in ("points", "normals", "colours"))
    mesh = Mesh(points, faces, normals, colours)
    if not textured:
        return mesh
    ends = np.cumsum([len(one.faces) for one in meshes])

    def colour(numbers: np.ndarray, weights: np.ndarray) -> np.ndarray:
        """Colours of texels, each in the grid of its triangle."""
        places, across = (interpolate_corners(values, faces[numbers], weights) for values in (points, normals))
        across /= np.maximum(np.linalg.norm(across, axis=-1, keepdims=True), 1e-12)
        owner, image = np.searchsorted(ends, numbers, side="right"), np.zeros(places.shape)
        for number, grid in enumerate(sources):
            at = owner == number
            image[at] = _eval_colours(grid, places[at].reshape(-1, 3), across[at].reshape(-1, 3)).reshape(image[at].shape)
        return image

    return replace(mesh, texture=Atlas.of(len(faces)).paint(colour))


def interpolate_corners(values: np.ndarray, faces: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Values (N, T, 3) at the weights (T, 3) of the corners of faces (N, 3), of values (V, 3) at the points."""
    return np.einsum("tc,nck->ntk", weights, values[faces])


def _extract_grid_surface(
    grid: SphericalGrid, density: np.ndarray, raw: float, inner: np.ndarray | None, closes: bool
) -> list[Mesh]:
    """The surface of one grid; an empty list if the grid does not reach the level or all triangles are left out.

    Args:
        grid: grid of a single level.
        density: raw densities at the nodes, (X, Y, Z).
        raw: raw density of the surface.
        inner: box without triangles; None: no box.
        closes: whether the surface is closed at the sides of the box. Otherwise it is cut there and continues in the next grid.
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
    # Levels overlap by one triangle at the side of a box, which leaves no visible gap.
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
    """World positions of lattice coordinates (x, y, z)."""
    unit = (nodes.astype(np.float64) + 0.5) / field.res[::-1]
    return unit @ field.to_world[:3, :3].T + field.to_world[:3, 3]


def vertex_normals(points: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Unit means of the normals of the triangles at each point, weighted by area."""
    a, b, c = (points[faces[:, k]] for k in range(3))
    across = np.cross(b - a, c - a)
    total = np.zeros_like(points)
    for k in range(3):
        np.add.at(total, faces[:, k], across)
    length = np.linalg.norm(total, axis=1, keepdims=True)
    return np.where(length > 0, total / np.where(length > 0, length, 1), (0.0, 0.0, 1.0))


def _eval_colours(field: SphericalGrid, points: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Colours seen by rays against the normals; points outside the box show the nearest point inside."""
    inverse = np.linalg.inv(field.to_world)
    inside = np.clip(points @ inverse[:3, :3].T + inverse[:3, 3], 1e-6, 1 - 1e-6) @ field.to_world[:3, :3].T
    p, d = (np.ascontiguousarray(v.T, np.float32) for v in (inside + field.to_world[:3, 3], -normals))
    _, colour = field.eval(mi.Point3f(*p), mi.Vector3f(*d))
    return np.clip(np.array(colour).T, 0, 1) if field.space == "srgb" else encode_srgb(np.array(colour).T)


FREE_SPACE_WEIGHT = 0.1
"""Weight of a view of free space; a view of a near surface has weight 1."""

TRUNCATION = 4.0
"""Distance in front of a surface beyond which space counts as free [voxel]."""


@dataclass(frozen=True)
class DepthView:
    """A depth image of a posed camera.

    Attributes:
        camera: camera without lens distortion.
        depth: (H, W) depth along the axis of the camera [length]; infinite without a surface.
        colour: (H, W, 3) in 0..1.
    """

    camera: Camera
    depth: np.ndarray
    colour: np.ndarray


def fuse_depths(views: Iterable[DepthView], low: np.ndarray, high: np.ndarray, resolution: int) -> Mesh:
    """The common surface of depth images.

    Args:
        views: depth images from all sides; the iterable is read once.
        low, high: (3,) corners of a box [length]; surfaces outside are left out.
        resolution: voxels along the longest edge; voxels are cubes.

    Returns:
        A mesh with colours, counterclockwise from outside, closed except at the sides of the box.

    Raises:
        MivolError: a box without volume, a resolution below 2, a grid larger than the free memory (the message has the
            resolution that fits), or no surface in the box.
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
        raise MivolError("no surface was seen in the box; give a box with a surface, and views of the surface.")
    nodes, faces, _, _ = marching_cubes(distance, 0.0, gradient_direction="descent")
    points = low + (nodes + 0.5) * voxel
    colours = np.stack([map_coordinates(channel, nodes.T, order=1, mode="nearest") for channel in fused.colours()], axis=1)
    return Mesh(points, faces, vertex_normals(points, faces), np.clip(colours, 0, 1))


VOXEL_BYTES = 64
"""Memory of a voxel [bytes]: six sums, their means, and the distances for marching cubes."""


def _check_memory(extent: np.ndarray, resolution: int) -> None:
    needed = VOXEL_BYTES * resolution**3 * float(np.prod(extent / extent.max()))

    def advise(free: float) -> str:
        return f"a resolution of at most {int(resolution * (free / needed) ** (1 / 3))} fits"

    check_memory(needed, f"a grid of {resolution} voxels along the longest edge", advise)


class _FusedDepths:
    """Sums over views at voxel centres, (X, Y, Z)."""

    def __init__(self, low: np.ndarray, voxel: float, size: np.ndarray) -> None:
        self.low, self.voxel, self.size = low, voxel, size
        self.total, self.weight = np.zeros(size, np.float32), np.zeros(size, np.float32)
        self.colour, self.colour_weight = np.zeros((3, *size), np.float32), np.zeros(size, np.float32)

    def add(self, view: DepthView) -> None:
        """Add a view, slab by slab."""
        y, z = (self.low[a] + (np.arange(self.size[a]) + 0.5) * self.voxel for a in (1, 2))
        for i in range(self.size[0]):
            x = self.low[0] + (i + 0.5) * self.voxel
            positions = np.stack(np.broadcast_arrays(x, *np.meshgrid(y, z, indexing="ij")), axis=-1).reshape(-1, 3)
            self._add_slab(i, view, positions)

    def _add_slab(self, i: int, view: DepthView, positions: np.ndarray) -> None:
        pixel, depth = project(view.camera, positions)
        with np.errstate(invalid="ignore"):
            visible = np.flatnonzero((depth > 0) & ((pixel >= 0) & (pixel < view.camera.size)).all(axis=1))
        column, row = pixel[visible].astype(int).T
        distance = (view.depth[row, column] - depth[visible]) / (TRUNCATION * self.voxel)
        in_front = distance > -1
        visible, row, column, distance = visible[in_front], row[in_front], column[in_front], distance[in_front]
        near = distance < 1
        weight = np.where(near, 1, FREE_SPACE_WEIGHT)
        self.total[i].reshape(-1)[visible] += weight * np.minimum(distance, 1)
        self.weight[i].reshape(-1)[visible] += weight
        self.colour_weight[i].reshape(-1)[visible[near]] += 1
        for channel in range(3):
            self.colour[channel, i].reshape(-1)[visible[near]] += view.colour[row[near], column[near], channel]

    def distance(self) -> np.ndarray:
        """Mean signed distance [truncation], positive outside; -1 without a view."""
        return np.where(self.weight > 0, self.total / np.maximum(self.weight, 1), -1)

    def colours(self) -> np.ndarray:
        """(3, X, Y, Z) mean colours near the surface."""
        return self.colour / np.maximum(self.colour_weight, 1)
