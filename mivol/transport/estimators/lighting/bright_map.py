r"""The bright part of an environment map, for emitter samples.

.. math:: p(\omega) \propto \max( L(\omega) - c\,\bar L,\; 0 )

Sampled directions of BSDFs and phase functions meet an even light without noise. Therefore emitter samples draw only the
radiance L above a share c of the mean (MIS compensation). Sampled directions alone find the light where this density is 0.

Conventions. As in Mitsuba's ``envmap``: rows from the pole +y down, the first and the last at the poles; columns around it,
with the middle of the map at +z. Radiance and density are bilinear between the nodes of the map.

References: Karlík et al. 2019 (MIS compensation).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mivol.kernel_recording import copy_aligned
from mivol.scene_graph import traverse

__all__ = ["BrightMap", "MapReading"]

SHARE = 0.5
"""Share c of the mean radiance that emitter samples leave to sampled directions [1]. At 1/2, an emitter sample and an isotropic
direction together have a density in proportion to the radiance, wherever the radiance exceeds the share. (Variance over
c = 0: 0.74 in a fog under a map of a museum, 0.62 on surfaces under this map. c = 0.75 has 1.03 and 1.0 times the variance of
c = 0.5.)"""

MIN_SINE = 1e-6
"""Smallest sine of the angle to a pole, a divisor."""


@dataclass
class BrightMap:
    """The bright part of an environment map.

    Attributes:
        columns, rows: nodes around the map, and from pole to pole.
        density: density over the unit square of the map at each node, row by row [1].
        sums: density of blocks of cells (:func:`_sum_blocks`).
        to_world: rotation from the map to the world (3 x 3), row by row.
        ball: centre and radius of a ball around the scene [length].
        focus: direction and angular radius [rad] of the part that causes the noise of chance (:func:`_find_focus`).
    """

    columns: int
    rows: int
    density: mi.Float
    sums: mi.Float
    to_world: mi.Float
    ball: mi.Float
    focus: mi.Float

    @classmethod
    def from_radiance(cls, light: NDArray, to_world: NDArray, ball: NDArray) -> BrightMap | None:
        """Make the table from the luminance (rows, columns) of the nodes of a map; returns None if the map is black."""
        rows, columns = light.shape
        weight = np.sin(np.linspace(0, np.pi, rows))[:, None] * np.ones(columns)
        excess = np.maximum(light - SHARE * np.average(light, weights=weight), 0) * weight
        pairs = excess + np.roll(excess, -1, axis=1)
        cells = (pairs[1:] + pairs[:-1]) / 4
        if not cells.sum() > 0:
            return None
        numbers = excess / cells.mean(), _sum_blocks(cells / cells.sum()), to_world, ball, _find_focus(light, to_world)
        return cls(columns, rows, *(mi.Float(copy_aligned(n.astype(np.float32).ravel())) for n in numbers))

    def sample(
        self, it: mi.Interaction3f, emitter: mi.EmitterPtr, u: mi.Point2f, active: mi.Bool
    ) -> tuple[mi.DirectionSample3f, mi.Spectrum]:
        """Sample a direction from a point by two numbers in [0, 1): the sample, and the radiance over its density."""
        column, row, rest = self._choose_cell(u, active)
        place, pdf = mi.warp.square_to_bilinear(*self._corners(column, row, active), rest)
        uv = mi.Point2f((mi.Float(column) + place.x + 0.5) / self.columns, (mi.Float(row) + place.y) / (self.rows - 1))
        uv.x = dr.select(uv.x < 1, uv.x, uv.x - 1)
        (sin_phi, cos_phi), (sin, cos) = dr.sincos(2 * dr.pi * uv.x), dr.sincos(dr.pi * uv.y)
        local = mi.Vector3f(sin_phi * sin, cos, -cos_phi * sin)
        axes = self._axes()
        direct = dr.zeros(mi.DirectionSample3f, dr.width(u))
        direct.d = dr.normalize(mi.Vector3f(*(dr.dot(axis, local) for axis in axes)))
        *centre, radius = (dr.gather(mi.Float, self.ball, mi.UInt32(k)) for k in range(4))
        # Beyond the whole scene, also from a point outside.
        direct.dist = 2 * dr.maximum(radius, dr.norm(it.p - mi.Point3f(*centre)))
        direct.p, direct.n = mi.Point3f(it.p) + direct.d * direct.dist, -direct.d
        direct.pdf = dr.select(active, _per_solid_angle(pdf, sin), 0)
        direct.uv, direct.time, direct.emitter, direct.delta = uv, it.time, emitter, mi.Bool(False)
        light = emitter.eval_direction(it, direct, active)
        return direct, dr.select(direct.pdf > 0, light / direct.pdf, 0)

    def pdf(self, d: mi.Vector3f, active: mi.Bool) -> mi.Float:
        """Density of a direction in :meth:`sample` [1/sr]."""
        local = sum((axis * c for axis, c in zip(self._axes(), d, strict=True)), mi.Vector3f(0))
        x = dr.atan2(local.x, -local.z) * (0.5 / dr.pi) * self.columns - 0.5
        y = dr.clip(dr.safe_acos(local.y) * (1 / dr.pi) * (self.rows - 1), 0, self.rows - 1)
        column, row = dr.floor(x), dr.minimum(dr.floor(y), self.rows - 2)
        x, y = x - column, y - row
        column = dr.select(column < 0, column + self.columns, column)
        v00, v10, v01, v11 = self._corners(mi.UInt32(column), mi.UInt32(row), active)
        pdf = dr.lerp(dr.lerp(v00, v10, x), dr.lerp(v01, v11, x), y)
        return dr.select(active, _per_solid_angle(pdf, dr.hypot(local.x, local.z)), 0)

    def _choose_cell(self, u: mi.Point2f, active: mi.Bool) -> tuple[mi.UInt32, mi.UInt32, mi.Point2f]:
        """Choose a cell: its column and row, and two uniform numbers in [0, 1).

        Each turn halves a block along both axes: near numbers choose near cells. A choice of rows and then of
        columns has 1.3 times the variance with spread samples on a floor under a map.
        """
        x_bits, y_bits = _count_halvings(self.rows - 1, self.columns)
        column, row, first = mi.UInt32(0), mi.UInt32(0), 0
        x, y = mi.Float(u.x), mi.Float(u.y)
        for left in reversed(range(x_bits)):
            width, splits_rows = 1 << (x_bits - left), left < y_bits
            column, row = column << 1, row << int(splits_rows)
            place = first + row * width + column
            pair = dr.gather(mi.Array2f, self.sums, place >> 1, active)
            if splits_rows:
                lower = dr.gather(mi.Array2f, self.sums, (place + width) >> 1, active)
                is_lower, y = _choose_half(pair.x + pair.y, lower.x + lower.y, y)
                row, pair = dr.select(is_lower, row + 1, row), dr.select(is_lower, lower, pair)
            is_right, x = _choose_half(pair.x, pair.y, x)
            column = dr.select(is_right, column + 1, column)
            first += width << max(y_bits - left, 0)
        return column, row, mi.Point2f(x, y)

    def _axes(self) -> list[mi.Vector3f]:
        """Rows of the rotation from the map to the world."""
        return [mi.Vector3f(*(dr.gather(mi.Float, self.to_world, mi.UInt32(3 * k + j)) for j in range(3))) for k in range(3)]

    def _corners(self, column: mi.UInt32, row: mi.UInt32, active: mi.Bool) -> list[mi.Float]:
        """Density at the corners of a cell: two in the first row, and two in the next."""
        following = dr.select(column + 1 < self.columns, column + 1, 0)
        places = (j * self.columns + k for j in (row, row + 1) for k in (column, following))
        return [dr.gather(mi.Float, self.density, place, active) for place in places]


def _find_focus(light: NDArray, to_world: NDArray) -> NDArray:
    """Mean direction of a map (rows, columns) in the world, and the root mean square angle around this direction [rad].

    Directions count by the square of their radiance: paths that meet the map by chance have this second moment.
    """
    rows, columns = light.shape
    theta, phi = np.linspace(0, np.pi, rows)[:, None], (np.arange(columns) + 0.5) * (2 * np.pi / columns)
    weight = np.square(light) * np.sin(theta)
    local = np.array([np.sin(phi) * np.sin(theta), np.cos(theta) * np.ones(columns), -np.cos(phi) * np.sin(theta)])
    mean = (local * weight).sum((1, 2)) / weight.sum()
    length = np.linalg.norm(mean)
    d = to_world @ (mean / max(length, 1e-9))
    return np.array([*d, np.sqrt(max(2 - 2 * length, 0.0))])


def _count_halvings(rows: int, columns: int) -> tuple[int, int]:
    """How often a square of cells is halved along x (each time) and along y."""
    y_bits = (rows - 1).bit_length()
    return max((columns - 1).bit_length(), y_bits, 1), y_bits


def _sum_blocks(cells: NDArray) -> NDArray:
    """Sums of blocks of cells (rows, columns), from the largest blocks to single cells, each by rows; padded by zeros."""
    x_bits, y_bits = _count_halvings(*cells.shape)
    levels = [np.zeros((1 << y_bits, 1 << x_bits))]
    levels[0][: cells.shape[0], : cells.shape[1]] = cells
    while levels[-1].shape[1] > 2:
        finer = levels[-1]
        halved = finer[:, ::2] + finer[:, 1::2]
        levels.append(halved[::2] + halved[1::2] if len(halved) > 1 else halved)
    return np.concatenate([level.ravel() for level in reversed(levels)])


def _choose_half(one: mi.Float, other: mi.Float, u: mi.Float) -> tuple[mi.Bool, mi.Float]:
    """Choose between two weights by ``u``: whether the second is chosen, and a uniform number in [0, 1)."""
    chance = one / dr.maximum(one + other, 1e-37)
    is_other = u >= chance
    rest = dr.select(is_other, (u - chance) / dr.maximum(1 - chance, 1e-37), u / dr.maximum(chance, 1e-37))
    return is_other, dr.clip(rest, 0, dr.one_minus_epsilon(mi.Float))


def _per_solid_angle(pdf: mi.Float, sine: mi.Float) -> mi.Float:
    """A density over directions [1/sr], from the density over the unit square of a map."""
    return pdf * dr.rcp(2 * dr.pi**2 * dr.maximum(sine, MIN_SINE))


@dataclass
class MapReading:
    """The bright part of the map of a scene, and the arrays of this map, by which a change is noticed.

    Attributes:
        source: indices of the arrays in Dr.Jit, and the ball around the scene.
        held: the arrays. Dr.Jit would give the index of a freed array to another array.
        table: the bright part; None if the scene has no map, if the map is black, or if the map has gradients enabled.
    """

    source: tuple = ()
    held: Any = None
    table: BrightMap | None = None

    def follow(self, scene: mi.Scene) -> MapReading:
        """Return this reading if it still holds for a scene, and read the map again otherwise."""
        emitter = scene.environment()
        if emitter is None or emitter.class_name() != "EnvironmentMapEmitter" or mi.is_spectral:
            return MapReading()
        params = traverse(emitter)
        data, placed = params["data"], params["to_world"].matrix
        with dr.resume_grad():  # images suspend gradients, and then nothing seems to have any
            is_differentiated = dr.grad_enabled(data)
        if is_differentiated:
            return MapReading()
        held, box = (dr.detach(data), dr.detach(placed)), scene.bbox()
        # Mitsuba's ball of a scene without shapes has no numbers.
        ball = box.bounding_sphere() if box.valid() else mi.ScalarBoundingSphere3f([0, 0, 0], 1)
        source = *dr.detail.collect_indices(held), *ball.center, ball.radius
        if source == self.source:
            return self
        # Mitsuba repeats a column at either side.
        pixels = np.array(held[0], np.float64)[:, 1:-1]
        light = pixels @ LUMINANCE if pixels.shape[2] == 3 else pixels[..., 0]
        turn = np.array(held[1], np.float64).reshape(4, 4)[:3, :3]
        if not np.allclose(turn @ turn.T, np.eye(3), atol=1e-4):
            return MapReading(source, held)
        around = np.array([*ball.center, ball.radius])
        return MapReading(source, held, BrightMap.from_radiance(light, turn, around))


LUMINANCE = np.array([0.212671, 0.715160, 0.072169])
"""Luminance of linear Rec. 709 colours."""
