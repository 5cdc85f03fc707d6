r"""Where a radiance field begins to be opaque, as triangles: the surface of one extinction.

.. math:: \{x : a(\rho(x)) = \sigma\} = \{x : \rho(x) = a^{-1}(\sigma)\}

since the activation a rises: the triangles follow what is interpolated, not what is shown of its nodes. Around the box is
vacuum, so that a field that reaches a side is closed there, half a voxel outside at most. Levels of a nested field are followed
one by one, each where no other level is: a surface ends a triangle behind the side of a level's box, and goes on in the next.

References: Lorensen and Cline 1987 (marching cubes); Lewiner et al. 2003 (without ambiguous cells, scikit-image's).
"""

from __future__ import annotations

import math
from collections.abc import Callable

import mitsuba as mi
import numpy as np

from mivol.errors import MivolError
from mivol.fields.spherical import SphericalGrid
from mivol.files import encode_srgb
from mivol.files.mesh import Mesh

__all__ = ["INVERSES", "level_of", "mean_normals", "surface_of"]

INVERSES: dict[str, Callable[[float], float]] = {
    "none": lambda sigma: sigma,
    "relu": lambda sigma: sigma,
    "softplus": lambda sigma: sigma + math.log(-math.expm1(-sigma)),
    "exp": math.log,
}
"""Name of an activation -> the stored density of an extinction above 0."""


def level_of(field: SphericalGrid) -> float:
    """The extinction [1/length] of a surface: where a voxel's longest edge lets half of the light through, or, in a field that
    is thinner than that, half of what its matter has (the mean extinction of its nodes, weighted by itself)."""
    edges = np.linalg.norm(field.to_world[:3, :3], axis=0) / field.res[::-1]
    sigma = np.array(field.act.value_and_slope(mi.Float(field.values()[0]))[0], np.float64)
    total = sigma.sum()
    mean = float((sigma * sigma).sum() / total) if total > 0 else math.inf
    return min(math.log(2) / float(edges.max()), mean / 2)


def surface_of(field: SphericalGrid, level: float | None = None) -> Mesh:
    """The surface of one extinction, with its colours as seen from outside along the normal.

    Args:
        field: any; a sparse one is laid out in full.
        level: extinction [1/length]; None: :func:`level_of`, of each of the levels of a nested field.

    Returns:
        World coordinates, counterclockwise from outside; normals are means of the triangles around a point.

    Error: a corner is where linear interpolation along an edge of the grid meets the level, exactly; between corners the
        triangles differ from the trilinear field by O(voxel^2).

    Raises:
        MivolError: a level that is not above 0, or one that the field does not reach.
    """
    if level is not None and not 0 < level < math.inf:
        raise MivolError(f"the level {level:g} was given for a surface; an extinction above 0 is expected.")
    grids = [field.level(number) for number in range(field.levels)] if field.levels > 1 else [field]
    found, most, last = [], 0.0, len(grids) - 1
    for number, grid in enumerate(grids):
        density = grid.to_dense()[0].transpose(2, 1, 0)
        wanted = level_of(grid) if level is None else float(level)
        raw = INVERSES[grid.activation](wanted)
        most = max(most, float(np.array(grid.act.value_and_slope(mi.Float(float(density.max())))[0])[0]))
        inner = None if number == 0 else grids[number - 1].to_world
        found += _surfaces(grid, density, raw, inner, number == last)
    if not found:
        raise MivolError(f"no node of the field reaches the extinction {wanted:g}, only {most:g}; give a lower level.")
    firsts = np.cumsum([0, *(len(mesh.points) for mesh in found)])
    faces = np.concatenate([mesh.faces + first for mesh, first in zip(found, firsts, strict=False)])
    points, normals, colours = (np.concatenate([getattr(m, k) for m in found]) for k in ("points", "normals", "colours"))
    return Mesh(points, faces, normals, colours)


def _surfaces(grid: SphericalGrid, density: np.ndarray, raw: float, inner: np.ndarray | None, closes: bool) -> list[Mesh]:
    """The surface of one grid; none where nothing reaches it, or all of it is left out.

    Args:
        grid: the grid.
        density: its nodes, in the order X Y Z.
        raw: the stored density of the surface.
        inner: a box in which it is left out; None for none.
        closes: whether it is closed at the sides of its box; else it is cut off there, since another grid goes on behind them.
    """
    from skimage.measure import marching_cubes  # slow to import

    around = {"constant_values": min(grid.act.vacuum, raw - 1e-3)} if closes else {"mode": "edge"}
    padded = np.pad(density, 1, **around)
    if not padded.min() <= raw < padded.max():
        return []
    nodes, faces, _, _ = marching_cubes(padded, raw, gradient_direction="ascent")
    points = _world(grid, nodes - 1.0)
    if np.linalg.det(grid.to_world[:3, :3]) < 0:
        faces = faces[:, ::-1]
    normals = mean_normals(points, faces)
    # Levels overlap by a triangle at the side of a box, so that no gap is seen between them.
    kept = np.ones(len(faces), bool) if closes else _lies_in(grid.to_world, points)[faces].any(axis=1)
    if inner is not None:
        kept &= ~_lies_in(inner, points)[faces].all(axis=1)
    if not kept.any():
        return []
    used, flat = np.unique(faces[kept], return_inverse=True)
    return [Mesh(points[used], flat.reshape(-1, 3), normals[used], _colours(grid, points[used], normals[used]))]


def _lies_in(box: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Which points lie in a box, the unit cube under a (4, 4) map."""
    inverse = np.linalg.inv(box)
    local = points @ inverse[:3, :3].T + inverse[:3, 3]
    return ((local >= 0) & (local <= 1)).all(axis=1)


def _world(field: SphericalGrid, nodes: np.ndarray) -> np.ndarray:
    """World places of lattice coordinates (x, y, z), node n at n."""
    unit = (nodes.astype(np.float64) + 0.5) / field.res[::-1]
    return unit @ field.to_world[:3, :3].T + field.to_world[:3, 3]


def mean_normals(points: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Unit means over the triangles at each point, weighted by their areas."""
    a, b, c = (points[faces[:, k]] for k in range(3))
    across = np.cross(b - a, c - a)
    total = np.zeros_like(points)
    for k in range(3):
        np.add.at(total, faces[:, k], across)
    length = np.linalg.norm(total, axis=1, keepdims=True)
    return np.where(length > 0, total / np.where(length > 0, length, 1), (0.0, 0.0, 1.0))


def _colours(field: SphericalGrid, points: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """What a ray that comes in against the normal sees; corners outside the box show the nearest place in it."""
    inverse = np.linalg.inv(field.to_world)
    inside = np.clip(points @ inverse[:3, :3].T + inverse[:3, 3], 1e-6, 1 - 1e-6) @ field.to_world[:3, :3].T
    p, d = (np.ascontiguousarray(v.T, np.float32) for v in (inside + field.to_world[:3, 3], -normals))
    _, colour = field.eval(mi.Point3f(*p), mi.Vector3f(*d))
    return np.clip(np.array(colour).T, 0, 1) if field.space == "srgb" else encode_srgb(np.array(colour).T)
