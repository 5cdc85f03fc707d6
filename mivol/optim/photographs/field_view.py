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
from mivol.optim.photographs.ray_batches import TILE
from mivol.photos import Camera, pixel_centres, rays
from mivol.transport.line_integrals.leaf_radiance import HalfColours, LeafPlaces, LeafRays, make_leaf_colours, render_leaves
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
from mivol.transport.traversal.box import map_point, opaque_rows
from mivol.transport.traversal.leaf_index import LeafIndex


@dataclass(frozen=True)
class PixelRays:
    """Rays through the pixel centres of a camera, by tiles of ``TILE`` x ``TILE``; tiles at the border repeat border pixels.

    Attributes:
        camera: with any lens.
        directions: Float, x, y and z of the direction of each pixel in the world, row by row; None for a lens without
            distortion, whose rays are computed where they are used.
    """

    camera: Camera
    directions: mi.Float | None

    @classmethod
    def from_camera(cls, camera: Camera) -> PixelRays:
        """The rays of a camera."""
        if not camera.distortion:
            return cls(camera, None)
        _, d = rays(camera, pixel_centres(camera.size))
        return cls(camera, mi.Float(d.astype(np.float32).reshape(-1)))

    @property
    def count(self) -> int:
        """Number of rays."""
        return math.prod(-(-n // TILE) for n in self.camera.size) * TILE * TILE

    def make(self, start: int, count: int) -> tuple[mi.UInt32, RayBundle]:
        """Pixels, numbered row by row, and world rays of the lanes from ``start``."""
        width, height = (dr.opaque(mi.UInt32, n) for n in self.camera.size)
        across = -(-self.camera.size[0] // TILE)
        lane = dr.arange(mi.UInt32, count) + dr.opaque(mi.UInt32, start)
        tile, within = lane // (TILE * TILE), lane % (TILE * TILE)
        # There is no vector instruction for quotients of whole numbers. The product is off by 2^-51 of the quotient, which is
        # at least half of 1 / across away from a whole number.
        line = mi.UInt32((mi.Float64(tile) + 0.5) * dr.opaque(mi.Float64, 1 / across))
        column = dr.minimum((tile - line * dr.opaque(mi.UInt32, across)) * TILE + within % TILE, width - 1)
        row = dr.minimum(line * TILE + within // TILE, height - 1)
        pixel = row * width + column
        o = mi.Point3f(*(dr.opaque(mi.Float, float(v)) for v in self.camera.origin))
        if self.directions is not None:
            return pixel, RayBundle(o, dr.gather(mi.Vector3f, self.directions, pixel))
        place = mi.Float64(column) + 0.5, mi.Float64(row) + 0.5, 0
        d = [map_point(numbers, place) for numbers in self._pixels_to_world()]
        # One step by Newton turns the reciprocal root in float32 into one in float64, without a division.
        square = d[0] * d[0] + d[1] * d[1] + d[2] * d[2]
        guess = mi.Float64(dr.rsqrt(mi.Float(square)))
        scale = guess * (1.5 - 0.5 * square * guess * guess)
        return pixel, RayBundle(o, mi.Vector3f(*(mi.Float(v * scale) for v in d)))

    def _pixels_to_world(self) -> list[list[mi.Float64]]:
        """The (3, 4) map from columns and rows of pixels, counted from the corner of the image, to unnormalised directions."""
        (fx, _, cx), (_, fy, cy) = self.camera.K[:2]
        return opaque_rows(self.camera.to_world[:3, :3] @ [[1 / fx, 0, 0, -cx / fx], [0, -1 / fy, 0, cy / fy], [0, 0, 0, -1]])


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
    render, view = prepare_view(field, camera, stop), PixelRays.from_camera(camera)
    width, height = camera.size
    values, distance = dr.zeros(mi.Float, 4 * width * height), dr.zeros(mi.Float, width * height)
    at_once = SAMPLED_PASS if isinstance(field, SampledField) else PASS
    for start in range(0, view.count, at_once):
        pixel, bundle = view.make(start, min(at_once, view.count - start))
        rendered = render(bundle)
        behind = background.eval(bundle.d) if isinstance(background, Sky) else mi.Color3f(*map(float, background))
        colour = rendered.colour + rendered.T * behind
        dr.scatter(values, mi.ArrayXf([*colour, rendered.T]), pixel)
        dr.scatter(distance, rendered.distance, pixel)
        dr.eval(values, distance)
    values, distance = np.array(values).reshape(height, width, 4), np.array(distance).reshape(height, width)
    opacity = 1 - values[..., 3]
    with np.errstate(invalid="ignore", divide="ignore"):
        depth = np.where(opacity > 0, distance / opacity, np.nan)
    return FieldView(values[..., :3], opacity, depth)


def prepare_view(
    field: SphericalGrid | SampledField | Octree, camera: Camera, stop: float
) -> Callable[[RayBundle], RenderedRays | SampledRays | LeafRays]:
    """Prepare a field for the rays of a camera, which end at the transmittance ``stop``; returns the renderer of rays."""
    if isinstance(field, Octree):
        depth = MAX_DEPTH if stop == 0 else -math.log(stop)
        index, places = INDEXED.find(field)
        leaves = HalfColours.round(make_leaf_colours(field, places, camera.origin[None], mi.UInt32(0)), field.cell)
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
