"""Rendering of a radiance field from a camera."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.fields.octree import Octree
from mivol.fields.sampled_field import SampledField
from mivol.fields.sky import Sky
from mivol.fields.spherical_grid import SphericalGrid
from mivol.photos import Camera, pixel_centres, rays
from mivol.transport.line_integrals.leaf_radiance import LeafPlaces, LeafRays, make_leaf_colours, render_leaves
from mivol.transport.line_integrals.radiance_field import (
    MAX_DEPTH,
    RayBundle,
    RenderedRays,
    find_occupied_cells,
    make_model,
    render_rays,
)
from mivol.transport.line_integrals.radiance_source import bake
from mivol.transport.line_integrals.sampled_rays import SampledModel, SampledRays, render_samples
from mivol.transport.traversal.octree_walk import LeafIndex


@dataclass(frozen=True)
class FieldView:
    """A rendered view of a field: ``image`` (H, W, 3) over its background, ``opacity`` (H, W), ``depth`` (H, W) [length].

    ``depth`` is the mean distance of visible matter from the camera; NaN for empty pixels.
    """

    image: np.ndarray
    opacity: np.ndarray
    depth: np.ndarray


PASS = 1 << 20
"""Maximum number of rays in one pass."""

SAMPLED_PASS = 1 << 15
"""Maximum number of rays in one pass through a field that is sampled: a ray takes about 700 bytes a sample."""


def render_view(
    field: SphericalGrid | SampledField | Octree, camera: Camera, background: np.ndarray | Sky, stop: float = 0.0
) -> FieldView:
    """Render the view of a camera.

    Args:
        field: the radiance field.
        camera: with or without distortion.
        background: background of the field: a colour (3,), or a sky.
        stop: transmittance at which a ray ends.

    Bias: of a grid, O(h^4) in a cell, and the bias of :func:`mivol.transport.line_integrals.radiance_source.bake`; of a
        field known at points, the bias of :mod:`mivol.transport.line_integrals.sampled_rays`; of an octree, the bias of
        :func:`mivol.transport.line_integrals.leaf_radiance.make_leaf_colours`.
    """
    render = prepare_view(field, camera, stop)
    width, height = camera.size
    order = order_by_tiles(width, height)
    pixels = pixel_centres(camera.size).reshape(-1, 2)[order]
    values = np.empty((width * height, 5), np.float32)
    at_once = SAMPLED_PASS if isinstance(field, SampledField) else PASS
    for start in range(0, len(order), at_once):
        o, d = rays(camera, pixels[start : start + at_once])
        o = np.broadcast_to(o, d.shape)
        bundle = RayBundle(*(kind(np.ascontiguousarray(np.float32(a.T))) for kind, a in ((mi.Point3f, o), (mi.Vector3f, d))))
        rendered = render(bundle)
        behind = background.eval(bundle.d) if isinstance(background, Sky) else mi.Color3f(*map(float, background))
        colour = rendered.colour + rendered.T * behind
        dr.eval(colour, rendered.T, rendered.distance)
        values[order[start : start + at_once]] = np.stack([*map(np.array, (*colour, rendered.T, rendered.distance))], axis=1)
    values = values.reshape(height, width, 5)
    opacity = 1 - values[..., 3]
    with np.errstate(invalid="ignore", divide="ignore"):
        depth = np.where(opacity > 0, values[..., 4] / opacity, np.nan)
    return FieldView(values[..., :3], opacity, depth)


def prepare_view(
    field: SphericalGrid | SampledField | Octree, camera: Camera, stop: float
) -> Callable[[RayBundle], RenderedRays | SampledRays | LeafRays]:
    """Prepare a field for the rays of a camera, which end at the transmittance ``stop``; returns the renderer of rays."""
    if isinstance(field, Octree):
        depth = MAX_DEPTH if stop == 0 else -math.log(stop)
        index, places = INDEXED.find(field)
        leaves = make_leaf_colours(field, places, camera.origin[None], mi.UInt32(0))
        return lambda bundle: render_leaves(index, leaves, bundle, depth, distances=True)
    if isinstance(field, SampledField):
        sampled = SampledModel.from_field(field, stop)
        return lambda bundle: render_samples(sampled, bundle)
    cells, model = find_occupied_cells(field), make_model(field, stop)
    source = bake(field, cells, camera.origin[None], mi.UInt32(0))
    return lambda bundle: render_rays(cells, source, model, bundle)


class IndexedLeaves:
    """The index and the places of the leaves seen last: the views of a film show the same leaves."""

    tree: Octree | None = None
    variant: str | None = None
    found: tuple[LeafIndex, LeafPlaces] | None = None

    def find(self, tree: Octree) -> tuple[LeafIndex, LeafPlaces]:
        """Index and places of the leaves of an octree."""
        if not (self.tree is not None and mi.variant() == self.variant and have_same_leaves(tree, self.tree)):
            self.tree, self.variant = tree, mi.variant()
            self.found = LeafIndex.find(tree), LeafPlaces.find(tree)
        return self.found


def have_same_leaves(a: Octree, b: Octree) -> bool:
    """Whether two octrees share the arrays of their leaves, in the same place."""
    same = a.codes is b.codes and a.sizes is b.sizes and a.depth == b.depth
    return same and np.array_equal(a.to_world, b.to_world)


INDEXED = IndexedLeaves()


def order_by_tiles(width: int, height: int) -> np.ndarray:
    """Flat numbers of pixels, tile by tile of 4 x 4."""
    row, column = np.divmod(np.arange(width * height), width)
    return np.lexsort((column % 4, row % 4, column // 4, row // 4))
