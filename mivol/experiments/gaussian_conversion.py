"""Conversions of Gaussians and points to radiance fields and to meshes, with the errors of the conversions."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import mitsuba as mi
import numpy as np

from mivol.back_end import set_variant
from mivol.fields.field_files import LONGEST_EDGE, read_grid, write_emission_scene, write_field
from mivol.fields.gaussian_field import MAX_OPACITY
from mivol.fields.gaussian_grid import gaussian_box, gaussian_masses, gaussians_to_grid
from mivol.fields.spherical_grid import SphericalGrid
from mivol.fields.surfaces import DepthView, fuse_depths, interpolate_corners
from mivol.files.mesh import MESH_WRITERS, Atlas, Mesh, write_mesh
from mivol.files.source import check_file, refusal, select_by_suffix
from mivol.optim.photographs.field_view import render_view
from mivol.photos import Camera, aim_camera, intrinsics, pixel_centres, project, rays
from mivol.photos.camera_path import HomeView
from mivol.points.cloud import points_to_gaussians, read_points
from mivol.points.gaussian_files import is_gaussian_file, read_gaussian_view, read_gaussians, write_gaussians
from mivol.points.gaussians import Gaussians
from mivol.points.summary import crop_cloud
from mivol.scene_graph import traverse
from mivol.splatting.splatter import Splatter, to_tensors
from mivol.validate.metrics import psnr

VIEWS = 6
"""Number of compared views."""

EDGE = 128
"""Edge of a compared view [pixel]."""

ANGLE = 40.0
"""Field of view of a compared view [degree]."""

VIEWED = (
    f"{VIEWS} views, {EDGE} x {EDGE} pixels each, {ANGLE:g} degrees wide, from a Fibonacci lattice of directions around the box"
)
"""Description of the compared views."""


def convert_to_field(source: Path, target: Path, resolution: int, box: Sequence[float] | None, variant: str) -> str:
    """Write the Gaussians of a file, or points as Gaussians, as a radiance field.

    Args:
        source: file of Gaussians or points in a known format.
        target: file ending in .npz.
        resolution: voxels along the longest edge of the box.
        box: two corners, six numbers [length]; None means three standard deviations around the Gaussians.
        variant: Mitsuba variant of the compared views.

    Returns:
        A summary of file and error, in lines.

    Raises:
        MivolError: as the readers, :func:`mivol.fields.gaussian_grid.gaussians_to_grid` and the disk.
    """
    set_variant(variant)
    cloud = read_as_gaussians(source)
    low, high = corners_of_box(cloud, box)
    view = read_gaussian_view(source)
    write_field(target, gaussians_to_grid(cloud, low, high, resolution), view=view)
    field = read_grid(target)  # as it will be read: half floats
    mass = float(field.values()[0].sum(dtype=np.float64) * np.linalg.det(field.to_world[:3, :3]) / math.prod(field.res))
    lines = [
        f"{target}: {' x '.join(map(str, field.res[::-1]))} nodes, {field.rows - 1} of them stored, degree {field.degree}",
        f"{100 * mass / gaussian_masses(cloud).sum():.4g} % of the extinction lies in the box",
        f"{field_psnr(cloud, field):.1f} dB between the field and splatted Gaussians: {VIEWED}, over black, peak 1",
    ]
    capped = int((cloud.opacities() > MAX_OPACITY).sum())
    if capped:
        lines.append(f"{capped} Gaussians of an opacity above {MAX_OPACITY} were made as opaque as that")
    return "\n".join(lines)


FILTER = 0.3
"""Variance of the low-pass filter of splats [pixel^2]."""

SAMPLES = 4
"""Samples a pixel of a scene of Gaussians: rays do not filter, and a ray among thousands of Gaussians is slow."""


def convert_to_scene(source: Path, target: Path) -> list[Path]:
    """Write Gaussians, or points as Gaussians, and a scene of Mitsuba that traces rays through them (``mivol_gaussians``).

    The camera is the first view of the file, or stands before the middle half of the Gaussians, with up along z. Gaussians are
    widened as splats are at the distance of what the camera looks at.

    Args:
        source: file of Gaussians or points in a known format.
        target: ends in .xml; the Gaussians lie beside it.

    Returns:
        Paths of the files written, the scene first.

    Raises:
        MivolError: as the readers, another suffix, or a full disk.
    """
    if target.suffix.lower() != ".xml":
        found, way_out = f"a file {target.suffix or 'without a suffix'}", f"mivol convert {source} writes other formats"
        raise refusal(target, found, "a scene (.xml) of Gaussians", way_out)
    cloud, view = read_as_gaussians(source), read_gaussian_view(source)
    low, high = gaussian_box(cloud)
    if view is None:
        inner = np.quantile(cloud.means, [0.25, 0.75], axis=0)
        middle, reach = inner.mean(axis=0), 2 * float((inner[1] - inner[0]).max())
        eye = middle + reach * np.array([0.5, -0.8, 0.35])
        view = HomeView((0.0, 0.0, 1.0), tuple(eye.tolist()), tuple(middle.tolist()), 60.0, (4, 3))
    focal = view.scaled(LONGEST_EDGE)[0] / 2 / math.tan(math.radians(view.fov) / 2)
    blur = math.sqrt(FILTER) * math.dist(view.origin, view.target) / focal
    file = target.with_name(f"{target.stem}-gaussians.ply")
    write_gaussians(file, cloud, view)
    more = f'\n                <float name="blur" value="{blur:.6g}"/>'
    given = {"kind": "Gaussians", "volume": "mivol_gaussians", "file": file.name, "more": more, "sky": "", "samples": SAMPLES}
    write_emission_scene(target, box_to_world(low, high), view, **given)
    return [target, file]


def corners_of_box(cloud: Gaussians, box: Sequence[float] | None) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper corner (3,) of a given box [length]; None means three standard deviations around the Gaussians."""
    return gaussian_box(cloud) if box is None else (np.array(box[:3]), np.array(box[3:]))


def read_as_gaussians(source: Path) -> Gaussians:
    """Read Gaussians, or make a Gaussian for each point.

    Raises:
        MivolError: as the readers.
    """
    check_file(source)
    return read_gaussians(source) if is_gaussian_file(source) else points_to_gaussians(read_points(source))


def field_psnr(cloud: Gaussians, field: SphericalGrid) -> float:
    """PSNR between views of a field and splatted Gaussians [dB]: code values over black, peak 1.

    Args:
        cloud: source of the field, or Gaussians made from the field.
        field: single-level field, in code values.
    """
    splatter, reals = Splatter(EDGE, EDGE, cloud.degree), to_tensors(cloud)
    truth, images = [], []
    for camera in cameras_around(field.to_world, EDGE):
        truth.append(np.array(splatter.forward(reals, camera, derivatives=False)[0])[..., :3])
        images.append(render_view(field, camera, np.zeros(3)).image)
    return psnr(np.stack(images), np.stack(truth), 1.0)


def cameras_around(to_world: np.ndarray, edge: int, views: int = VIEWS) -> list[Camera]:
    """Square views of a whole box from evenly spread directions (a Fibonacci lattice)."""
    middle = to_world[:3] @ np.array([0.5, 0.5, 0.5, 1])
    radius = 0.5 * float(np.linalg.norm(to_world[:3, :3].sum(axis=1)))
    distance = radius / math.sin(math.radians(ANGLE) / 2)
    focal = edge / (2 * math.tan(math.radians(ANGLE) / 2))
    template = Camera(intrinsics(focal, focal, edge / 2, edge / 2), (edge, edge), np.eye(4))
    height = 1 - (2 * np.arange(views) + 1) / views
    turn = math.pi * (3 - math.sqrt(5)) * np.arange(views)
    flat = np.sqrt(1 - height**2)
    towards = np.stack([flat * np.cos(turn), flat * np.sin(turn), height], axis=1)
    return [aim_camera(template, middle + distance * one, middle, np.array([0.0, 0, 1])) for one in towards]


FUSED = 64
"""Number of fused views, from a Fibonacci lattice of directions around the box."""

FINENESS = 2
"""Pixels of a fused view over voxels, both along the longest edge of the box."""


def convert_to_mesh(source: Path, target: Path, resolution: int, box: Sequence[float] | None, variant: str) -> str:
    """Write the Gaussians of a file, or points as Gaussians, as a mesh with colours.

    Args:
        source: file of Gaussians or points in a known format.
        target: file ending in .ply or .obj, or in .glb, which has a texture.
        resolution: voxels of the fused distances along the longest edge of the box.
        box: two corners, six numbers [length], of the Gaussians that become the mesh; None means three standard deviations
            around all of them.
        variant: Mitsuba variant.

    Returns:
        A summary of file and error, in lines.

    Raises:
        MivolError: as the readers, :func:`mivol.fields.depth_fusion.fuse_depths` and the disk.
    """
    select_by_suffix(target, MESH_WRITERS)
    set_variant(variant)
    cloud = read_as_gaussians(source)
    low, high = corners_of_box(cloud, box)
    if box is not None:
        # What stands around the box would hide it from the views.
        cloud = crop_cloud(cloud, box, source)
    mesh, view = mesh_of_gaussians(cloud, low, high, resolution), read_gaussian_view(source)
    if target.suffix.lower() == ".glb":
        mesh = replace(mesh, texture=paint_mesh(cloud, mesh, low, high, resolution))
    write_mesh(target, mesh if view is None else replace(mesh, up=view.up))
    loss, voxel = measure_mesh_error(cloud, mesh, low, high), float((high - low).max()) / resolution
    nine_tenths = f"{loss.most:.3g} for nine tenths of the pixels ({loss.most / voxel:.2g} voxels)"
    lines = [
        f"{target}: {len(mesh.points)} points, {len(mesh.faces)} triangles, fused from {FUSED} views",
        f"distance from the depth of the splats: median {loss.median:.3g} ({loss.median / voxel:.2g} voxels), {nine_tenths}",
        f"{100 * loss.missed:.2g} % of the pixels that show splats show no mesh; "
        f"{100 * loss.invented:.2g} % of the other pixels show the mesh",
        VIEWED,
    ]
    return "\n".join(lines)


def mesh_of_gaussians(cloud: Gaussians, low: np.ndarray, high: np.ndarray, resolution: int) -> Mesh:
    """Return the surface of opacity 0.5 in splatted views of Gaussians.

    Args:
        cloud: Gaussians.
        low, high: corners (3,) of the box [length].
        resolution: voxels along the longest edge of the box.

    Raises:
        MivolError: as :func:`mivol.fields.depth_fusion.fuse_depths`.
    """
    cameras = cameras_around(box_to_world(low, high), FINENESS * resolution, FUSED)
    return fuse_depths(_splat_depths(cloud, cameras), low, high, resolution)


PAINTED = 4
"""Views that paint a triangle: the views nearest to its normal."""

SLANT = 0.1
"""Least cosine between the normal of a triangle and the direction to a view that paints it."""

DEEP = 2.0
"""Largest distance between a texel and the depth of a view that paints it [voxel]."""


def paint_mesh(cloud: Gaussians, mesh: Mesh, low: np.ndarray, high: np.ndarray, resolution: int) -> np.ndarray:
    """The texture of a mesh from splatted views: means of the views that see a texel, weighted by squared cosines.

    Views have twice the pixels of the views of the mesh. Texels that no view sees have the colours of the points.

    Args:
        cloud: Gaussians.
        mesh: mesh of the Gaussians, with colours.
        low, high: corners (3,) of the box [length].
        resolution: voxels along the longest edge of the box.

    Returns:
        Image of the atlas, uint8 (H, W, 3).

    Raises:
        MivolError: more triangles than a texture holds.
    """
    atlas, deep = Atlas.of(len(mesh.faces)), DEEP * float((high - low).max()) / resolution
    corners = mesh.points[mesh.faces]
    middles, across = corners.mean(axis=1), np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-30)
    views, best, cosines = [], np.zeros((len(corners), PAINTED), int), np.zeros((len(corners), PAINTED))
    cameras = cameras_around(box_to_world(low, high), 2 * FINENESS * resolution, FUSED)
    for number, view in enumerate(_splat_depths(cloud, cameras)):
        views.append(replace(view, depth=view.depth.astype(np.float32), colour=np.rint(255 * view.colour).astype(np.uint8)))
        towards = view.camera.origin - middles
        cosine = (across * towards).sum(axis=1) / np.maximum(np.linalg.norm(towards, axis=1), 1e-30)
        cosine = np.where((cosine > SLANT) & _look_up(view, middles, deep)[1], cosine, 0)
        worst = cosines.argmin(axis=1)
        better = np.flatnonzero(cosine > cosines[np.arange(len(worst)), worst])
        best[better, worst[better]], cosines[better, worst[better]] = number, cosine[better]

    def colour(numbers: np.ndarray, weights: np.ndarray) -> np.ndarray:
        """Colours of texels."""
        total = 1e-6 * interpolate_corners(mesh.colours, mesh.faces[numbers], weights)
        sums = np.full((*total.shape[:2], 1), 1e-6)
        places = interpolate_corners(mesh.points, mesh.faces[numbers], weights)
        for number, view in enumerate(views):
            for rank in range(PAINTED):
                at = np.flatnonzero((best[numbers, rank] == number) & (cosines[numbers, rank] > 0))
                seen, is_seen = _look_up(view, places[at].reshape(-1, 3), deep)
                share = (cosines[numbers[at], rank] ** 2)[:, None, None] * is_seen.reshape(len(at), len(weights), 1)
                total[at] += share * seen.reshape(len(at), len(weights), 3)
                sums[at] += share
        return total / sums

    return atlas.paint(colour)


def _look_up(view: DepthView, points: np.ndarray, deep: float) -> tuple[np.ndarray, np.ndarray]:
    """Colours (N, 3) of a view at points, linear between pixels, and whether the view sees each point."""
    pixel, depth = project(view.camera, points)
    inside = (depth > 0) & ((pixel >= 0) & (pixel < view.camera.size)).all(axis=1)
    pixel = np.where(inside[:, None], pixel, 0.5)
    column, row = pixel.astype(int).T
    inside &= np.abs(view.depth[row, column] - depth) < deep
    low = np.clip(np.floor(pixel - 0.5).astype(int), 0, np.array(view.camera.size) - 2)
    x, y = np.clip(pixel - 0.5 - low, 0, 1).T[..., None]
    (i, j), codes = low.T[::-1], view.colour
    top, bottom = ((1 - x) * codes[i + k, j] + x * codes[i + k, j + 1] for k in (0, 1))
    return ((1 - y) * top + y * bottom) / 255, inside


@dataclass(frozen=True)
class MeshLoss:
    """Distance between a mesh and splatted views.

    Attributes:
        median, most: median and 0.9 quantile of the distance along rays [length].
        missed: share of the opaque pixels without mesh.
        invented: share of the other pixels with mesh.
    """

    median: float
    most: float
    missed: float
    invented: float


def measure_mesh_error(cloud: Gaussians, mesh: Mesh, low: np.ndarray, high: np.ndarray) -> MeshLoss:
    """Compare a mesh with splatted views, ray by ray.

    Args:
        cloud: Gaussians from which the mesh was made.
        mesh: mesh in the same world.
        low, high: corners (3,) of the box in the views.
    """
    scene = mi.load_dict({"type": "scene", "mesh": _shape_of(mesh)})
    distances, missed, invented = [], [], []
    for view in _splat_depths(cloud, cameras_around(box_to_world(low, high), EDGE)):
        mesh_depth = _depth_in(scene, view.camera)
        is_opaque = np.isfinite(view.depth)
        both = is_opaque & np.isfinite(mesh_depth)
        distances.append(np.abs(mesh_depth[both] - view.depth[both]))
        missed.append(~np.isfinite(mesh_depth[is_opaque]))
        invented.append(np.isfinite(mesh_depth[~is_opaque]))
    all_distances = np.concatenate(distances)
    median, most = np.quantile(all_distances, [0.5, 0.9]) if len(all_distances) else (math.inf, math.inf)
    return MeshLoss(float(median), float(most), *(float(np.concatenate(part).mean()) for part in (missed, invented)))


def box_to_world(low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Transform (4, 4) from the unit cube to a box."""
    to_world = np.diag([*(high - low), 1.0])
    to_world[:3, 3] = low
    return to_world


def _splat_depths(cloud: Gaussians, cameras: Sequence[Camera]) -> Iterator[DepthView]:
    """Depths and colours of Gaussians for cameras of equal size."""
    splatter, reals = Splatter(*cameras[0].size, cloud.degree, median=True), to_tensors(cloud)
    for camera in cameras:
        picture = np.array(splatter.forward(reals, camera, derivatives=False)[0], np.float64)
        alpha = picture[..., 4:]
        colour = np.clip(picture[..., :3] / np.maximum(alpha, 1e-9), 0, 1)
        yield DepthView(camera, np.where(picture[..., 3] > 0, picture[..., 3], np.inf), colour)


def _shape_of(mesh: Mesh) -> mi.Mesh:
    shape = mi.Mesh("mesh", len(mesh.points), len(mesh.faces))
    params = traverse(shape)
    params["vertex_positions"] = mi.Float(np.ascontiguousarray(mesh.points, np.float32).ravel())
    params["faces"] = mi.UInt32(np.ascontiguousarray(mesh.faces, np.uint32).ravel())
    params.update()
    return shape


def _depth_in(scene: mi.Scene, camera: Camera) -> np.ndarray:
    """Depth (H, W) along the camera's axis of the nearest surface [length]; infinite without a surface."""
    o, d = rays(camera, pixel_centres(camera.size))
    ray = mi.Ray3f(*(mi.Point3f(*np.float32(np.broadcast_to(v, d.shape).reshape(-1, 3)).T) for v in (o, d)))
    t = np.array(scene.ray_intersect_preliminary(ray).t).reshape(camera.size[::-1])
    return np.where(np.isfinite(t), t, np.inf) * (d @ -camera.to_world[:3, 2])
