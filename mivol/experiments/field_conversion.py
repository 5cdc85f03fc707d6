"""Conversions of radiance fields and Gaussians into each other, each with its loss, and the description of a file.

An octree takes leaves where views of the source show matter. A hash grid or a NeRF is fitted to views of the source, as to
photographs with alpha. These views look at the boxes of the source from evenly spread directions. Other views, from directions
of their own, give the loss. Both look at the innermost box of a nested grid, through what lies around it; its sky is left out.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.back_end import set_variant
from mivol.errors import MivolError
from mivol.experiments.gaussian_conversion import EDGE, VIEWED, box_to_world, cameras_around, read_as_gaussians
from mivol.fields.field_archives import read_field_view
from mivol.fields.field_files import read_field, write_field
from mivol.fields.gaussian_grid import (
    gaussian_box,
    gaussians_to_grid,
    gaussians_to_nested,
    grid_to_gaussians,
    nested_to_gaussians,
)
from mivol.fields.octree import MAX_DEPTH, Octree
from mivol.fields.resampling import GRID_NODES, sample_to_grid
from mivol.fields.sampled_field import SampledField
from mivol.fields.spherical_grid import SphericalGrid
from mivol.files.source import check_file, select_by_suffix
from mivol.optim.loop import begin_fit
from mivol.optim.photographs.field_view import PixelRays, prepare_view, render_view
from mivol.optim.photographs.octree_building import (
    OctreeRecipe,
    ViewRays,
    build_octree,
    build_octree_of_levels,
    build_octree_of_points,
)
from mivol.optim.photographs.ray_batches import RayBatches
from mivol.optim.photographs.sampled_problem import PRESETS, SampledPlan, SampledProblem
from mivol.photos import Camera, Photo
from mivol.photos.camera_path import HomeView
from mivol.points.gaussian_files import GAUSSIAN_WRITERS, read_gaussian_view, write_gaussians
from mivol.points.gaussians import Gaussians
from mivol.scene.explain import Explanation
from mivol.space import bounds_of
from mivol.splatting.splatter import Splatter, to_tensors
from mivol.threads import set_thread_count
from mivol.transport.line_integrals.radiance_field import RayBundle
from mivol.validate.metrics import psnr

MOST_NODES = 256
"""Default number of nodes along the longest edge of the grid of a nested grid, whose finest voxels may need more."""

NESTED_NODES = 64
"""Default number of nodes along the longest edge of each box of a nested grid, as in fits."""

LEAF_VIEWS, LEAF_EDGE = 48, 512
"""Number of views that decide which leaves are seen, and their largest edge [pixel]."""

FITTED_VIEWS, FITTED_EDGE = 60, 160
"""Number of views to which a network is fitted, and their edge [pixel]."""

NETWORK_PRESETS = {"hash": "minute", "nerf": "minutes"}
"""Presets of the fits, by the kind of the target."""

ConvertibleField = SphericalGrid | Octree | SampledField


@dataclass(frozen=True)
class Representation:
    """What is converted, or what it became.

    Attributes:
        model: field, or Gaussians.
        boxes: (4, 4) unit cube to the world: the box, or those of a nested grid, the innermost first.
        view: from which the file is shown.
    """

    model: ConvertibleField | Gaussians
    boxes: list[np.ndarray]
    view: HomeView | None

    @classmethod
    def open(cls, path: Path) -> Representation:
        """Read a field (.npz), or Gaussians or points of another file.

        Raises:
            MivolError: as the readers.
        """
        if path.suffix.lower() != ".npz":
            cloud = read_as_gaussians(path)
            return cls(cloud, [box_to_world(*gaussian_box(cloud))], read_gaussian_view(path))
        return cls.from_field(read_field(check_file(path)), read_field_view(path))

    @classmethod
    def from_field(cls, field: ConvertibleField, view: HomeView | None = None) -> Representation:
        """A field as a source."""
        boxes = [field.level_to_world(k) for k in range(field.levels)] if isinstance(field, SphericalGrid) else [field.to_world]
        return cls(field, boxes, view)

    @property
    def is_nested(self) -> bool:
        """Whether it is a grid of several boxes."""
        return len(self.boxes) > 1

    def show(self, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
        """A view: colours (H, W, 3) over black, and opacity (H, W)."""
        if isinstance(self.model, Gaussians):
            splatter = Splatter(*camera.size, self.model.degree)
            rgba = np.array(splatter.forward(to_tensors(self.model), camera, derivatives=False)[0])
            return rgba[..., :3], rgba[..., 3]
        seen = render_view(self.model, camera, np.zeros(3))
        return seen.image, seen.opacity

    def cameras(self, edge: int, views: int) -> list[Camera]:
        """Views of all boxes, as many of each, from all sides."""
        return [camera for box in self.boxes for camera in cameras_around(box, edge, max(views // len(self.boxes), 1))]


def describe_loss(path: Path, source: Representation, target: Path) -> str:
    """PSNR between views of a file and its source; colours of radiance are compared with colours of radiance only."""
    written = Representation.open(target)  # as it will be read: rounded values
    if isinstance(written.model, Gaussians) and not isinstance(source.model, Gaussians) and source.model.space == "linear":
        return "their colours are code values of the field's radiance, so views of the two do not compare"
    loss = views_psnr(written, source)
    return f"{loss:.1f} dB between views of {target.name} and {path.name}: {VIEWED}, over black, peak 1"


def views_psnr(one: Representation, other: Representation) -> float:
    """PSNR between views [dB], of the innermost box of ``other``, over black, peak 1."""
    cameras = cameras_around(other.boxes[0], EDGE)
    images, truth = (np.stack([source.show(camera)[0] for camera in cameras]) for source in (one, other))
    return psnr(images, truth, 1.0)


def describe_sizes(path: Path, target: Path) -> str:
    """Bytes of a file, and over those of its source."""
    sizes = [p.stat().st_size for p in (path, target)]
    return f"{sizes[1]} bytes, {sizes[1] / sizes[0]:.2f} of {path.name}"


# -- Octrees and grids ------------------------------------------------------------------------------------------------------


def convert_to_octree(path: Path, target: Path, resolution: int | None, variant: str) -> str:
    """Write a radiance field or Gaussians as an octree.

    Args:
        path: a field (.npz), or Gaussians, which become a grid of ``GRID_NODES`` first. An octree of svox is read as it is.
        target: file ending in .npz, or .svox.npz.
        resolution: leaves along the edge of the octree's cube, rounded up to a power of two; None means two leaves a voxel of
            a grid (of the innermost box of a nested grid), and 128 leaves for a hash grid or a NeRF.
        variant: Mitsuba variant of the views.

    Returns:
        A summary of file and error, in lines.

    Raises:
        MivolError: as :func:`mivol.fields.field_files.read_field`,
            :func:`mivol.optim.photographs.octree_building.build_octree` and the disk.
    """
    set_variant(variant)
    source = Representation.open(path)
    if resolution is not None:
        if isinstance(source.model, Octree):
            raise MivolError(f"{path} is an octree, whose leaves stay as they are: leave out --resolution.")
        if not 1 <= resolution <= 2**MAX_DEPTH:
            raise MivolError(f"--resolution {resolution} is no number of leaves along an edge: give 1 to {2**MAX_DEPTH}.")
    depth = 0 if resolution is None else max((resolution - 1).bit_length(), 1)
    tree = make_octree(source, OctreeRecipe(depth))
    write_field(target, tree, view=source.view)
    lines = [f"{target}: {describe_leaves(tree)}", describe_loss(path, source, target), describe_sizes(path, target)]
    if isinstance(source.model, SphericalGrid | Octree) and not source.is_nested:
        lines.append(describe_speed(read_field(target), source.model, path.name))
    return "\n".join(lines)


def make_octree(source: Representation, recipe: OctreeRecipe) -> Octree:
    """The octree of any source."""
    model = source.model
    if isinstance(model, Octree):
        return model
    if isinstance(model, Gaussians):
        model = gaussians_to_grid(model, *gaussian_box(model), GRID_NODES)
    if isinstance(model, SampledField):
        return build_octree_of_points(model, look_around(source, LEAF_EDGE), recipe)
    rays = look_around(source, min(LEAF_EDGE, 4 * max(model.res)))  # a pixel a half voxel
    return (build_octree_of_levels if source.is_nested else build_octree)(model, rays, recipe)


def look_around(source: Representation, edge: int) -> ViewRays:
    """Rays from all sides of the boxes of a source, view by view."""
    cameras = source.cameras(edge, LEAF_VIEWS)

    def rays() -> Iterator[RayBundle]:
        for camera in cameras:
            view = PixelRays.from_camera(camera)
            yield view.make(0, view.count)[1]

    return rays


def convert_to_grid(path: Path, target: Path, resolution: int | None, variant: str) -> str:
    """Write an octree, a nested grid, a hash grid or a NeRF as a grid of one box; result as :func:`convert_to_octree`.

    Args:
        path: a field (.npz) other than a grid of one box.
        target: file ending in .npz.
        resolution: nodes along the longest edge, of the outermost box of a nested grid; not for an octree. None means
            ``GRID_NODES`` for a hash grid or a NeRF, and for a nested grid its finest voxels, at most ``MOST_NODES``.
        variant: Mitsuba variant of the views.

    Raises:
        MivolError: a source that is a grid, a resolution for an octree, too many nodes, or as the readers and the disk.
    """
    set_variant(variant)
    source = Representation.open(path)
    if isinstance(source.model, SphericalGrid) and not source.is_nested:
        raise MivolError(f"{path} is a grid of one box already: use it as it is, or make it an octree, a hash grid or a NeRF.")
    if resolution is not None and isinstance(source.model, Octree):
        raise MivolError(f"{target}: the grid of an octree has a node in each of its smallest cells: leave out --resolution.")
    grid = make_grid(source, resolution)
    write_field(target, grid, view=source.view)
    lines = [f"{target}: {describe_nodes(grid)}", describe_loss(path, source, target), describe_sizes(path, target)]
    if isinstance(source.model, Octree):
        lines.append(describe_speed(read_field(target), source.model, path.name))
    return "\n".join(lines)


def convert_to_nested(path: Path, target: Path, resolution: int | None, box: Sequence[float] | None, variant: str) -> str:
    """Write Gaussians or points as a nested grid; result as :func:`convert_to_octree`.

    Args:
        path: Gaussians or points.
        target: file ending in .npz.
        resolution: nodes along the longest edge of each box; None means ``NESTED_NODES``.
        box: two corners of the innermost box, six numbers [length]; None means the box of the middle half of the Gaussians
            along each axis.
        variant: Mitsuba variant of the views.

    Raises:
        MivolError: as :func:`mivol.fields.gaussian_grid.gaussians_to_nested`, the readers and the disk.
    """
    set_variant(variant)
    source = Representation.open(path)
    low, high = np.quantile(source.model.means, [0.25, 0.75], axis=0) if box is None else np.reshape(box, (2, 3))
    grid = gaussians_to_nested(source.model, low, high, resolution or NESTED_NODES)
    write_field(target, grid, view=source.view)
    loss = views_psnr(source, Representation.open(target))
    between = (
        f"{loss:.1f} dB between views of the innermost box, in {target.name} and {path.name}: {VIEWED}, over black, peak 1"
    )
    return f"{target}: {grid.levels} nested boxes of {describe_nodes(grid)}\n{between}"


def make_grid(source: Representation, resolution: int | None = None) -> SphericalGrid:
    """The grid of any source: a grid of one box unchanged, other sources by :func:`convert_to_grid`.

    Raises:
        MivolError: no matter in the box, fewer than 2 nodes, or too many nodes.
    """
    model = source.model
    if isinstance(model, Gaussians):
        return gaussians_to_grid(model, *gaussian_box(model), resolution or GRID_NODES)
    if isinstance(model, Octree):
        return model.to_grid()
    if isinstance(model, SampledField):
        return sample_to_grid(model, GRID_NODES if resolution is None else resolution)
    if not source.is_nested:
        return model
    finest = max(model.res) << (model.levels - 1)
    return sample_to_grid(model, min(finest, MOST_NODES) if resolution is None else resolution)


def grid_of_network(field: SampledField) -> tuple[SphericalGrid, str]:
    """The grid of a hash grid or a NeRF with ``GRID_NODES`` nodes along its longest edge, and lines with its size and loss.

    Raises:
        MivolError: no matter in the box.
    """
    grid = sample_to_grid(field, GRID_NODES)
    loss = views_psnr(Representation.from_field(grid), Representation.from_field(field))
    between = f"{loss:.1f} dB between views of the grid and of the {field.noun}: {VIEWED}, over black, peak 1"
    return grid, f"{describe_nodes(grid)}\n{between}"


def describe_nodes(grid: SphericalGrid) -> str:
    """Nodes and degree of a grid."""
    return f"{' x '.join(map(str, grid.res[::-1]))} nodes, {len(grid.stored_nodes())} of them stored, degree {grid.degree}"


def convert_to_gaussians(path: Path, target: Path, resolution: int | None, variant: str) -> str:
    """Write a radiance field as Gaussians; result as :func:`convert_to_octree`.

    Args:
        path: a field (.npz). An octree, a hash grid or a NeRF becomes a grid first; each level of a nested grid its Gaussians.
        target: file of Gaussians.
        resolution: blocks of voxels along the longest edge of the grid, with a Gaussian per block; None means blocks of 2
            voxels (4 smallest leaves of an octree).
        variant: Mitsuba variant of the compared views.

    Raises:
        MivolError: as :func:`mivol.fields.field_files.read_field`, :func:`mivol.fields.gaussian_grid.grid_to_gaussians` and the
            disk.
    """
    select_by_suffix(target, GAUSSIAN_WRITERS)
    set_variant(variant)
    source = Representation.open(path)
    if source.is_nested:
        made = nested_to_gaussians(source.model, resolution)
    else:
        grid = make_grid(source)
        if resolution is None and isinstance(source.model, Octree):
            resolution = -(-max(grid.res) // 4)
        made = grid_to_gaussians(grid, resolution)
    write_gaussians(target, made, source.view)
    return "\n".join([f"{target}: {made.count} Gaussians", describe_loss(path, source, target)])


# -- Networks ---------------------------------------------------------------------------------------------------------------


def convert_to_network(path: Path, target: Path, kind: str, variant: str, plan: SampledPlan | None = None) -> str:
    """Write a radiance field or Gaussians as a hash grid or a NeRF; result as :func:`convert_to_octree`.

    Args:
        path: a field (.npz), or Gaussians.
        target: file ending in .npz.
        kind: "hash" or "nerf".
        variant: Mitsuba variant of the fit.
        plan: of the fit; None takes the preset of ``NETWORK_PRESETS``.

    Raises:
        MivolError: colours of radiance, as the readers and the disk.
    """
    set_variant(variant)
    plan = plan or PRESETS[kind][NETWORK_PRESETS[kind]]
    source = Representation.open(path)
    if not isinstance(source.model, Gaussians) and source.model.space == "linear":
        raise MivolError(f"{path} has colours of radiance, and views of code values are fitted: fit the photographs instead.")
    cameras = source.cameras(FITTED_EDGE, FITTED_VIEWS)
    photos = [take_view(source, camera, number) for number, camera in enumerate(cameras)]
    problem = SampledProblem(RayBatches.from_photos(photos), bounds_of(source.boxes[-1]), plan)
    begin_fit(problem, plan.optimizer, plan.course()).complete()
    write_field(target, problem.field, view=source.view)
    fitted = f"a {problem.field.noun} of {problem.field.numbers} numbers, fitted to {len(photos)} views of {path.name}"
    return "\n".join([f"{target}: {fitted}", describe_loss(path, source, target), describe_sizes(path, target)])


def take_view(source: Representation, camera: Camera, number: int) -> Photo:
    """A view as a photograph with alpha, in front of black."""
    image, opacity = source.show(camera)
    alpha = np.clip(opacity, 0, 1).astype(np.float32)
    colour = np.clip(image, 0, alpha[..., None]).astype(np.float32)
    return Photo(f"view {number}", colour, alpha, None, replace(camera), np.zeros(3, np.float32))


# -- Speed and description --------------------------------------------------------------------------------------------------


TIMED_EDGE, TURNS = 800, 5
"""Edge of a timed view [pixel], and turns of which the median ratio counts."""


def compare_speed(field: SphericalGrid | Octree, other: SphericalGrid | Octree) -> tuple[tuple[float, float], float]:
    """Pixels a second of two fields: ``VIEWS`` views of the whole box, ready to render, by the processor time of one thread.

    A second thread would count as work while it waits for the last pixels of a view, which takes long on a busy machine.

    Returns:
        The two rates [pixel/s], and the median of the ratios of all turns, first over second.
    """
    cameras = cameras_around(other.to_world, TIMED_EDGE)
    views = [PixelRays.from_camera(camera) for camera in cameras]
    renders = [[prepare_view(one, camera, stop=1e-3) for camera in cameras] for one in (field, other)]
    seconds, threads = np.empty((TURNS + 1, 2)), dr.thread_count()
    set_thread_count(1)
    try:
        for turn, which in np.ndindex(seconds.shape):
            begun = time.process_time()
            for render, view in zip(renders[which], views, strict=True):
                rendered = render(view.make(0, view.count)[1])
                dr.eval(rendered.colour, rendered.T)
            dr.sync_thread()
            seconds[turn, which] = time.process_time() - begun
    finally:
        set_thread_count(threads)
    first, second = (float(v) for v in len(views) * TIMED_EDGE**2 / np.median(seconds[1:], axis=0))  # turn 0 compiles
    return (first, second), float(np.median(seconds[1:, 1] / seconds[1:, 0]))


def describe_speed(field: SphericalGrid | Octree, other: SphericalGrid | Octree, other_name: str) -> str:
    """Pixels a second of two fields and their ratio (:func:`compare_speed`)."""
    rates, ratio = compare_speed(field, other)
    first, second = (rate / 1e6 for rate in rates)
    return f"{first:.1f} M pixels per second of processor time, {ratio:.2f} times the rate of {other_name} ({second:.1f} M)"


def describe_leaves(tree: Octree) -> str:
    """Number, sizes and degree of the leaves of an octree."""
    sizes = np.bincount(tree.sizes)
    edges = ", ".join(f"{n} of {2**k}" for k, n in enumerate(sizes) if n)
    return f"{tree.leaves} leaves in {2**tree.depth} cells along each axis; edges [cells]: {edges}; degree {tree.degree}"


def describe_field(path: Path, variant: str) -> Explanation:
    """Facts about the file of a radiance field: kind, size, place, values and memory.

    Raises:
        MivolError: as :func:`mivol.fields.field_files.read_field`.
    """
    set_variant(variant)
    field = read_field(check_file(path))
    corners = field_place(field)[:3] @ np.array([[0, 0, 0, 1], [1, 1, 1, 1]], np.float64).T
    low, high = (", ".join(f"{v:.4g}" for v in corner) for corner in np.sort(corners.T, axis=0))
    file_size = f"{path.stat().st_size / 2**20:.2f} MiB in the file"
    box = f"box         ({low}) to ({high}) [length]"
    if isinstance(field, SampledField):
        memory = f"memory      {4 * field.numbers / 2**20:.1f} MiB, {file_size}"
        return Explanation((*_describe_network(field, box), memory, WAYS))
    density, _ = field.values()
    if isinstance(field, Octree):
        kind = f"octree      {describe_leaves(field)}"
        look = f"colours     {field.colours}, offset {field.offset:g}, {field.space}"
    else:
        counts, stored = " x ".join(map(str, field.res[::-1])), len(field.stored_nodes())
        levels = f"{field.levels} nested levels of " if field.levels > 1 else ""
        kind = f"grid        {levels}{counts} nodes, {stored} of them stored, degree {field.degree}"
        density = np.array(field.activation_function.value_and_slope(mi.Float(density))[0])
        look = f"colours     {'clamp' if field.clamp else 'no clamp'}, offset {field.offset:g}, {field.space}"
    spread = f"extinction  {density.min():.4g} to {density.max():.4g} [1/length], median {np.median(density):.4g}"
    return Explanation((kind, box, spread, look, f"memory      {field.bytes / 2**20:.1f} MiB, {file_size}", WAYS))


SAMPLED_TWICE = "samples     where the coarse network has weight"

MOST_POINTS = 1 << 16
"""Most points at which ``mivol explain`` evaluates a network."""

WAYS = "mivol render draws it; mivol convert and mivol export write it in other formats"


def field_place(field: SphericalGrid | Octree | SampledField) -> np.ndarray:
    """(4, 4) unit cube to the whole box of a field."""
    return field.level_to_world(field.levels - 1) if isinstance(field, SphericalGrid) else field.to_world


def _describe_network(field: SampledField, box: str) -> list[str]:
    """Facts about a hash grid or a NeRF: sizes, box, occupied cells, steps, extinction and colours."""
    (model, numbers), occupied = field.sizes.describe(field.edges), np.flatnonzero(np.array(field.region.occupied))
    places = field.region.middles(occupied[:: len(occupied) // MOST_POINTS + 1]).T.astype(np.float32)
    density = np.array(field.density(mi.Point3f(np.ascontiguousarray(places)))) if occupied.size else np.zeros(1)
    cells = dr.width(field.region.occupied)
    return [
        f"{field.noun:<12}{model}; {numbers}",
        box,
        f"occupied    {occupied.size} of {cells} cells ({occupied.size / cells:.1%}), outside of which it is 0",
        f"samples     at most {field.region.step:.4g} [length] apart" if field.coarse is None else SAMPLED_TWICE,
        f"extinction  {density.min():.4g} to {density.max():.4g} [1/length], median {np.median(density):.4g}, in their middles",
        f"colours     {field.space}",
    ]
