"""Conversions into grids, octrees, hash grids and NeRFs with their loss, and the description of a file.

A hash grid or a NeRF is fitted to views of the source, as to photographs with alpha. The views look at the source's box from
evenly spread directions. Other views, from directions of their own, give the loss.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.back_end import set_variant
from mivol.errors import MivolError
from mivol.experiments.gaussian_conversion import EDGE, VIEWED, cameras_around, read_as_gaussians
from mivol.fields.field_archives import read_field_view
from mivol.fields.field_files import read_field, write_field
from mivol.fields.gaussian_grid import gaussian_box
from mivol.fields.octree import Octree, check_depth
from mivol.fields.resampling import sample_field
from mivol.fields.sampled_field import SampledField
from mivol.fields.spherical_grid import SphericalGrid
from mivol.files.source import check_file
from mivol.optim.loop import begin_fit
from mivol.optim.photographs.field_view import CameraRays, prepare_view, render_view
from mivol.optim.photographs.octree_building import OctreeRecipe, build_octree, build_octree_of_points
from mivol.optim.photographs.radiance_plan import place_grid
from mivol.optim.photographs.ray_batches import RayBatches
from mivol.optim.photographs.sampled_problem import PRESETS, SampledPlan, SampledProblem
from mivol.photos import Camera, Photo
from mivol.points.gaussian_files import read_gaussian_view
from mivol.scene.explain import Explanation
from mivol.splatting.splatter import Splatter, to_tensors
from mivol.transport.line_integrals.radiance_field import RayBundle
from mivol.validate.metrics import psnr

GRID_NODES = 128
"""Default number of nodes along the longest edge of the grid of a hash grid or a NeRF."""

LOOKS = 48
"""Number of views that decide which leaves are seen."""

LOOK_EDGE = 512
"""Largest edge of such a view [pixel]."""


def convert_to_octree(source: Path, target: Path, resolution: int | None, variant: str) -> str:
    """Write a radiance field as an octree.

    Args:
        source: grid with a single level, hash grid or NeRF (.npz), or an octree of svox, which is read as it is.
        target: file ending in .npz, or .svox.npz.
        resolution: leaves along the edge of the octree's cube, rounded up to a power of two; None means two leaves a voxel of
            a grid, and 128 leaves for a hash grid or a NeRF.
        variant: Mitsuba variant of the views.

    Returns:
        A summary of file and error, in lines.

    Raises:
        MivolError: as :func:`mivol.fields.field_files.read_field`,
            :func:`mivol.optim.photographs.octree_building.build_octree` and the disk.
    """
    set_variant(variant)
    field = read_field(source)
    if resolution is not None:
        if isinstance(field, Octree):
            raise MivolError(f"{source} is an octree, whose leaves stay as they are: leave out --resolution.")
        check_depth((resolution - 1).bit_length())
    depth = 0 if resolution is None else max((resolution - 1).bit_length(), 1)
    if isinstance(field, Octree):
        tree = field
    else:
        build = build_octree_of_points if isinstance(field, SampledField) else build_octree
        tree = build(field, LookAround(field), OctreeRecipe(depth))
    write_field(target, tree, view=read_field_view(source))
    written = read_field(target)  # as it will be read: rounded values
    return "\n".join([f"{target}: {describe_leaves(tree)}", *_describe_loss(source, field, target, written)])


def convert_to_grid(source: Path, target: Path, resolution: int | None, variant: str) -> str:
    """Write an octree, a hash grid or a NeRF as a radiance field on a grid; result as :func:`convert_to_octree`.

    Args:
        source: octree, hash grid or NeRF (.npz).
        target: file ending in .npz.
        resolution: nodes along the longest edge, for a hash grid or a NeRF; None means ``GRID_NODES``.
        variant: Mitsuba variant of the views.

    Raises:
        MivolError: a source that is a grid, a resolution for an octree, too many nodes, or as the readers and the disk.
    """
    set_variant(variant)
    tree = read_field(source)
    if isinstance(tree, SampledField):
        grid, lines = sample_to_grid(tree, GRID_NODES if resolution is None else resolution)
        write_field(target, grid, view=read_field_view(source))
        return f"{target}: {lines}"
    if not isinstance(tree, Octree):
        raise MivolError(f"{source} is a grid: mivol convert --to grid makes a grid from an octree, a hash grid or a NeRF.")
    if resolution is not None:
        raise MivolError(f"{target}: the grid of an octree has a node in each of its smallest cells: leave out --resolution.")
    grid = tree.to_grid()
    write_field(target, grid, view=read_field_view(source))
    head = f"{target}: {' x '.join(map(str, grid.res[::-1]))} nodes, {grid.rows - 1} of them stored, degree {grid.degree}"
    return "\n".join([head, *_describe_loss(source, tree, target, read_field(target))])


def sample_to_grid(field: SampledField, resolution: int) -> tuple[SphericalGrid, str]:
    """The grid of a hash grid or a NeRF with ``resolution`` nodes along the longest edge, and lines with its size and its loss.

    Raises:
        MivolError: no matter in the box, or fewer than 2 nodes.
    """
    if resolution < 2:
        raise MivolError(f"found a grid of {resolution} nodes along its longest edge, expected at least 2: raise --resolution.")
    box = np.array([field.to_world[:3, 3], field.to_world[:3, 3] + field.edges])
    grid = sample_field(field, *place_grid(box, resolution))
    size = f"{' x '.join(map(str, grid.res[::-1]))} nodes, {grid.rows - 1} of them stored, degree {grid.degree}"
    loss = f"{views_psnr(grid, field):.1f} dB between views of the grid and of the {field.noun}: {VIEWED}, over black, peak 1"
    return grid, f"{size}\n{loss}"


def _describe_loss(
    source: Path, field: SphericalGrid | Octree | SampledField, target: Path, written: SphericalGrid | Octree
) -> list[str]:
    """Difference between views of two fields, and the sizes of their files, in lines."""
    sizes = [path.stat().st_size for path in (source, target)]
    speeds = [] if isinstance(field, SampledField) else [describe_speed(written, field, source.name)]
    return [
        f"{views_psnr(written, field):.1f} dB between views of {target.name} and {source.name}: {VIEWED}, over black, peak 1",
        f"{sizes[1]} bytes, {sizes[1] / sizes[0]:.2f} of {source.name}",
        *speeds,
    ]


TIMED_EDGE, TURNS = 800, 7
"""Edge of a timed view [pixel], and turns of which the median ratio counts."""


def describe_speed(field: SphericalGrid | Octree, other: SphericalGrid | Octree, other_name: str) -> str:
    """Pixels a second of two fields and their ratio: a view of the whole box, ready to render, by processor time."""
    camera = cameras_around(other.to_world, TIMED_EDGE)[1]
    view = CameraRays.from_camera(camera)
    _, bundle = view.make(0, view.count)
    dr.eval(bundle)
    renders = [prepare_view(one, camera, stop=1e-3) for one in (field, other)]
    seconds = np.empty((TURNS + 1, 2))
    for turn, which in np.ndindex(seconds.shape):
        begun = time.process_time()
        rendered = renders[which](bundle)
        dr.eval(rendered.colour, rendered.T)
        dr.sync_thread()
        seconds[turn, which] = time.process_time() - begun
    rates = TIMED_EDGE**2 / np.median(seconds[1:], axis=0) / 1e6  # the first turn compiles
    ratio = np.median(seconds[1:, 1] / seconds[1:, 0])
    return f"{rates[0]:.1f} M pixels a second of processor time, {other_name} {rates[1]:.1f}: {ratio:.2f} times as many"


def views_psnr(field: SphericalGrid | Octree, other: SphericalGrid | Octree | SampledField) -> float:
    """PSNR between views of two fields [dB], of the box of ``other``, over black, peak 1."""
    cameras = cameras_around(other.to_world, EDGE)
    images, truth = ([render_view(one, camera, np.zeros(3)).image for camera in cameras] for one in (field, other))
    return psnr(np.stack(images), np.stack(truth), 1.0)


class LookAround:
    """Rays from all sides of the box of a field, view by view: a pixel a half voxel, at most ``LOOK_EDGE`` along an edge."""

    def __init__(self, field: SphericalGrid | SampledField) -> None:
        edge = min(LOOK_EDGE, 4 * max(field.res)) if isinstance(field, SphericalGrid) else LOOK_EDGE
        self.cameras = cameras_around(field.to_world, edge, LOOKS)

    def __call__(self) -> Iterator[RayBundle]:
        for camera in self.cameras:
            view = CameraRays.from_camera(camera)
            yield view.make(0, view.count)[1]


def describe_leaves(tree: Octree) -> str:
    """Number, sizes and degree of the leaves of an octree."""
    sizes = np.bincount(tree.sizes)
    kinds = ", ".join(f"{n} of {2**k}" for k, n in enumerate(sizes) if n)
    return f"{tree.leaves} leaves in 2^{tree.depth} cells along an axis ({kinds} cells an edge), degree {tree.degree}"


def describe_field(path: Path, variant: str) -> Explanation:
    """Facts about the file of a radiance field: kind, size, place, values and memory.

    Raises:
        MivolError: as :func:`mivol.fields.field_files.read_field`.
    """
    set_variant(variant)
    field = read_field(check_file(path))
    if isinstance(field, SampledField):
        return Explanation((f"{field.noun:<12}{field!r}", f"memory      {path.stat().st_size / 2**20:.2f} MiB in the file"))
    density, _ = field.values()
    if isinstance(field, Octree):
        place, kind = field.to_world, f"octree      {describe_leaves(field)}"
        look = f"colours     {field.colours}, offset {field.offset:g}, {field.space}"
    else:
        counts, stored = " x ".join(map(str, field.res[::-1])), len(field.stored_nodes())
        levels = f"{field.levels} nested levels of " if field.levels > 1 else ""
        place = field.level_to_world(field.levels - 1)
        kind = f"grid        {levels}{counts} nodes, {stored} of them stored, degree {field.degree}"
        density = np.array(field.activation_function.value_and_slope(mi.Float(density))[0])
        look = f"colours     {'clamp' if field.clamp else 'no clamp'}, offset {field.offset:g}, {field.space}"
    corners = place[:3] @ np.array([[0, 0, 0, 1], [1, 1, 1, 1]], np.float64).T
    low, high = (", ".join(f"{v:.4g}" for v in corner) for corner in np.sort(corners.T, axis=0))
    return Explanation(
        (
            kind,
            f"box         ({low}) to ({high}) [length]",
            f"extinction  {density.min():.4g} to {density.max():.4g} [1/length], median {np.median(density):.4g}",
            look,
            f"memory      {field.bytes / 2**20:.1f} MiB, {path.stat().st_size / 2**20:.2f} MiB in the file",
            "mivol render draws it; mivol convert and mivol export write it in other formats",
        )
    )


# -- Networks ---------------------------------------------------------------------------------------------------------------


NETWORK_PRESETS = {"hash": "minute", "nerf": "minutes"}
"""Presets of the fits, by the kind of the target."""

LOOKS, LOOK_EDGE = 60, 160
"""Number of fitted views, and their edge [pixel]."""

Show = Callable[[Camera], tuple[np.ndarray, np.ndarray]]
"""Renders a view: colours (H, W, 3) over black, and opacity (H, W)."""


def convert_to_network(source: Path, target: Path, kind: str, variant: str, plan: SampledPlan | None = None) -> str:
    """Write a radiance field or Gaussians as a hash grid or a NeRF.

    Args:
        source: a field (.npz: grid, nested grid, octree, hash grid or NeRF), or Gaussians.
        target: file ending in .npz.
        kind: "hash" or "nerf".
        variant: Mitsuba variant of the fit.
        plan: of the fit; None takes the preset of ``NETWORK_PRESETS``.

    Returns:
        A summary of file and error, in lines.

    Raises:
        MivolError: colours of radiance, as the readers and the disk.
    """
    set_variant(variant)
    plan = plan or PRESETS[kind][NETWORK_PRESETS[kind]]
    show, place, view = open_source(source)
    photos = [take_view(show, camera, number) for number, camera in enumerate(cameras_around(place, LOOK_EDGE, LOOKS))]
    box = bounds_of(place)
    problem = SampledProblem(RayBatches.from_photos(photos), box, plan)
    begin_fit(problem, plan.optimizer, plan.course()).complete()
    write_field(target, problem.field, view=view)
    written = read_field(target)  # as it will be read: rounded values
    cameras = cameras_around(place, EDGE)
    images = np.stack([render_view(written, camera, np.zeros(3)).image for camera in cameras])
    loss = psnr(images, np.stack([show(camera)[0] for camera in cameras]), 1.0)
    return "\n".join(
        [
            f"{target}: a {written.noun} of {written.numbers} numbers, fitted to {LOOKS} views of {source.name}",
            f"{loss:.1f} dB between views of {target.name} and {source.name}: {VIEWED}, over black, peak 1",
            f"{target.stat().st_size} bytes, {target.stat().st_size / source.stat().st_size:.2f} of {source.name}",
        ]
    )


def open_source(source: Path) -> tuple[Show, np.ndarray, object]:
    """The views of a field or of Gaussians, its box (4, 4), and the view in the file."""
    if source.suffix.lower() != ".npz":
        cloud = read_as_gaussians(source)
        low, high = gaussian_box(cloud)
        place = np.diag([*(high - low), 1.0])
        place[:3, 3] = low
        reals = to_tensors(cloud)

        def splat(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
            rgba = np.array(Splatter(*camera.size, cloud.degree).forward(reals, camera, derivatives=False)[0])
            return rgba[..., :3], rgba[..., 3]

        return splat, place, read_gaussian_view(source)
    field = read_field(source)
    if field.space == "linear":
        raise MivolError(f"{source} has colours of radiance, and views of code values are fitted: fit the photographs instead.")

    def render(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
        seen = render_view(field, camera, np.zeros(3))
        return seen.image, seen.opacity

    place = field.level_to_world(field.levels - 1) if isinstance(field, SphericalGrid) else field.to_world
    return render, place, read_field_view(source)


def take_view(show: Show, camera: Camera, number: int) -> Photo:
    """A view as a photograph with alpha, in front of black."""
    image, opacity = show(camera)
    alpha = np.clip(opacity, 0, 1).astype(np.float32)
    colour = np.clip(image, 0, alpha[..., None]).astype(np.float32)
    return Photo(f"view {number}", colour, alpha, None, replace(camera), np.zeros(3, np.float32))


def bounds_of(place: np.ndarray) -> np.ndarray:
    """The upright box (2, 3) around the unit cube under a map to the world."""
    corners = np.array([[x, y, z, 1.0] for x in (0, 1) for y in (0, 1) for z in (0, 1)]) @ place.T
    return np.array([corners[:, :3].min(axis=0), corners[:, :3].max(axis=0)])
