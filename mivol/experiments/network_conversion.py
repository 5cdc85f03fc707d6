"""Conversions into hash grids and NeRFs: a network is fitted to views of the source, as to photographs with alpha.

The views look at the source's box from evenly spread directions. Other views, from directions of their own, give the loss.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from mivol.back_end import set_variant
from mivol.errors import MivolError
from mivol.experiments.gaussian_conversion import EDGE, VIEWED, cameras_around, read_as_gaussians
from mivol.fields.field_archives import read_field_view
from mivol.fields.field_files import read_field, write_field
from mivol.fields.gaussian_grid import gaussian_box
from mivol.fields.spherical_grid import SphericalGrid
from mivol.optim.loop import begin_fit
from mivol.optim.photographs.field_view import render_view
from mivol.optim.photographs.ray_batches import RayBatches
from mivol.optim.photographs.sampled_problem import PRESETS, SampledPlan, SampledProblem
from mivol.photos import Camera, Photo
from mivol.points.gaussian_files import read_gaussian_view
from mivol.splatting.splatter import Splatter, to_tensors
from mivol.validate.metrics import psnr

__all__ = ["NETWORK_PRESETS", "convert_to_network"]

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
