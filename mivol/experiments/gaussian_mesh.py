"""Gaussians as a mesh: depths of splatted views are fused, and the mesh is looked at from other places to say what it loses."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import mitsuba as mi
import numpy as np

from mivol.experiments.back_end import set_variant
from mivol.experiments.gaussian_conversion import EDGE, VIEWED, cameras_around, read_as_gaussians
from mivol.fields.gaussian_grid import box_of_gaussians
from mivol.fields.surfaces import DepthView, fuse_depths
from mivol.files.mesh import MESH_WRITERS, Mesh, write_mesh
from mivol.files.source import select_by_suffix
from mivol.photos import Camera, pixel_centres, rays
from mivol.points.gaussians import Gaussians
from mivol.splatting.splatter import Splatter, tensors_of

__all__ = ["MeshLoss", "convert_to_mesh", "loss_of_mesh", "mesh_of_gaussians"]

FUSED = 64
"""Views that are fused: from a Fibonacci lattice of directions around the box."""

FINENESS = 2
"""Pixels of a fused view along the box's longest edge, over the voxels there."""


def convert_to_mesh(source: Path, target: Path, resolution: int, box: Sequence[float] | None, variant: str) -> str:
    """Write the Gaussians of a file, or points as Gaussians, as a mesh with colours.

    Args:
        source: any format of Gaussians or points.
        target: ends in .ply or .obj.
        resolution: voxels of the fused distances along the longest edge of the box.
        box: two corners, six numbers [length]; None: what holds three standard deviations of all Gaussians.
        variant: of Mitsuba.

    Returns:
        What was written and what it lost, in lines.

    Raises:
        MivolError: as the readers, :func:`mivol.fields.surfaces.fuse_depths` and the disk.
    """
    select_by_suffix(target, MESH_WRITERS)
    set_variant(variant)
    cloud = read_as_gaussians(source)
    low, high = box_of_gaussians(cloud) if box is None else (np.array(box[:3]), np.array(box[3:]))
    mesh = mesh_of_gaussians(cloud, low, high, resolution)
    write_mesh(target, mesh)
    loss, voxel = loss_of_mesh(cloud, mesh, low, high), float((high - low).max()) / resolution
    nine_tenths = f"{loss.most:.3g} for nine tenths of the pixels ({loss.most / voxel:.2g} voxels)"
    lines = [
        f"{target}: {len(mesh.points)} points, {len(mesh.faces)} triangles, fused from {FUSED} views",
        f"distance from the depth of the splats: median {loss.median:.3g} ({loss.median / voxel:.2g} voxels), {nine_tenths}",
        f"{100 * loss.missed:.2g} % of the pixels that splats hide show no mesh, {100 * loss.invented:.2g} % of the others do",
        VIEWED,
    ]
    return "\n".join(lines)


def mesh_of_gaussians(cloud: Gaussians, low: np.ndarray, high: np.ndarray, resolution: int) -> Mesh:
    """The surface where splatted views of Gaussians become half opaque.

    Args:
        cloud: any.
        low, high: (3,) corners of the box that is looked at [length].
        resolution: voxels along its longest edge.

    Raises:
        MivolError: as :func:`mivol.fields.surfaces.fuse_depths`.
    """
    return fuse_depths(_seen(cloud, cameras_around(placed(low, high), FINENESS * resolution, FUSED)), low, high, resolution)


@dataclass(frozen=True)
class MeshLoss:
    """How far a mesh lies from what splats show.

    Attributes:
        median, most: of the distance along rays, and what nine tenths of them stay below [length].
        missed: share of the pixels where splats are opaque and no mesh is.
        invented: share of the other pixels where one is.
    """

    median: float
    most: float
    missed: float
    invented: float


def loss_of_mesh(cloud: Gaussians, mesh: Mesh, low: np.ndarray, high: np.ndarray, edge: int = EDGE) -> MeshLoss:
    """Compare a mesh with splatted views, ray by ray.

    Args:
        cloud: what the mesh was made of.
        mesh: in the same world.
        low, high: (3,) corners of the box that the views show.
        edge: of a view [pixel].
    """
    scene = mi.load_dict({"type": "scene", "mesh": _shape_of(mesh)})
    apart, missed, invented = [], [], []
    for view in _seen(cloud, cameras_around(placed(low, high), edge)):
        met = _depth_in(scene, view.camera)
        is_there = np.isfinite(view.depth)
        both = is_there & np.isfinite(met)
        apart.append(np.abs(met[both] - view.depth[both]))
        missed.append(~np.isfinite(met[is_there]))
        invented.append(np.isfinite(met[~is_there]))
    all_apart = np.concatenate(apart)
    median, most = np.quantile(all_apart, [0.5, 0.9]) if len(all_apart) else (math.inf, math.inf)
    return MeshLoss(float(median), float(most), *(float(np.concatenate(part).mean()) for part in (missed, invented)))


def placed(low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """(4, 4) unit cube to a box."""
    to_world = np.diag([*(high - low), 1.0])
    to_world[:3, 3] = low
    return to_world


def _seen(cloud: Gaussians, cameras: Sequence[Camera]) -> Iterator[DepthView]:
    """What cameras of one size see of Gaussians."""
    splatter, reals = Splatter(*cameras[0].size, cloud.degree, median=True), tensors_of(cloud)
    for camera in cameras:
        picture = np.array(splatter.forward(reals, camera, derivatives=False)[0], np.float64)
        alpha = picture[..., 4:]
        colour = np.clip(picture[..., :3] / np.maximum(alpha, 1e-9), 0, 1)
        yield DepthView(camera, np.where(picture[..., 3] > 0, picture[..., 3], np.inf), colour)


def _shape_of(mesh: Mesh) -> mi.Mesh:
    shape = mi.Mesh("mesh", len(mesh.points), len(mesh.faces))
    params = mi.traverse(shape)
    params["vertex_positions"] = mi.Float(np.ascontiguousarray(mesh.points, np.float32).ravel())
    params["faces"] = mi.UInt32(np.ascontiguousarray(mesh.faces, np.uint32).ravel())
    params.update()
    return shape


def _depth_in(scene: mi.Scene, camera: Camera) -> np.ndarray:
    """(H, W) depth along the camera's axis of what its pixels meet [length]; infinite where they meet nothing."""
    o, d = rays(camera, pixel_centres(camera.size))
    ray = mi.Ray3f(*(mi.Point3f(*np.float32(np.broadcast_to(v, d.shape).reshape(-1, 3)).T) for v in (o, d)))
    t = np.array(scene.ray_intersect_preliminary(ray).t).reshape(camera.size[::-1])
    return np.where(np.isfinite(t), t, np.inf) * (d @ -camera.to_world[:3, 2])
