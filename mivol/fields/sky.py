r"""Light from infinity by direction: the background of a radiance field.

.. math:: u = \mathrm{atan2}(d_x, -d_z) / 2\pi, \qquad v = \arccos(d_y) / \pi

Conventions. Mitsuba 3.9's ``envmap`` without a ``to_world`` uses the same map, so the image of a sky is an environment map:
columns lie at the middle of their share of u, periodic; rows lie at v = j / (rows - 1), from pole to pole. Values between
texels are linear.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.errors import MivolError
from mivol.files import read_exr

TEXEL = 4
"""Numbers of a texel: rgb, and one number that fills a packet."""


@dataclass(frozen=True)
class Sky:
    """Radiance by direction.

    Attributes:
        rows: rows from pole to pole, at least 2; the image has twice as many columns.
        texels: Float, rgb and a 0 for each texel, row by row.
    """

    rows: int
    texels: mi.Float

    @classmethod
    def uniform(cls, rows: int, colour: np.ndarray | float) -> Sky:
        """Make a sky of one colour: (3,), or one number for a grey.

        Raises:
            MivolError: fewer than 2 rows.
        """
        if rows < 2:
            raise MivolError(f"a sky of {rows} rows was asked for; at least 2 are expected, one a pole.")
        return cls.from_image(np.broadcast_to(colour, (rows, 2 * rows, 3)))

    @classmethod
    def from_image(cls, image: np.ndarray) -> Sky:
        """Make a sky from an image (n, 2 n, 3)."""
        texels = np.zeros((*image.shape[:2], TEXEL), np.float32)
        texels[..., :3] = image
        return cls(image.shape[0], mi.Float(texels.reshape(-1)))

    def image(self) -> np.ndarray:
        """The image (rows, 2 rows, 3), float32."""
        return np.array(self.texels).reshape(self.rows, 2 * self.rows, TEXEL)[..., :3]

    def with_texels(self, texels: mi.Float) -> Sky:
        """The sky with other texels."""
        return replace(self, texels=texels)

    def smooth(self, share: float) -> Sky:
        """Move each texel by a share towards the mean of its four neighbours.

        Repeated steps give texels without rays the light of the texels around.
        """
        columns = 2 * self.rows
        entry = dr.arange(mi.UInt32, dr.width(self.texels))
        texel, part = entry // TEXEL, entry % TEXEL
        row, column = mi.Int32(texel // columns), mi.Int32(texel % columns)

        def read(row: mi.Int32, column: mi.Int32) -> mi.Float:
            at = dr.clip(row, 0, self.rows - 1) * columns + (column + columns) % columns
            return dr.gather(mi.Float, self.texels, mi.UInt32(at) * TEXEL + part)

        around = read(row - 1, column) + read(row + 1, column) + read(row, column - 1) + read(row, column + 1)
        return self.with_texels(dr.lerp(self.texels, around / 4, dr.opaque(mi.Float, share)))

    def _corners(self, d: mi.Vector3f) -> list[tuple[mi.UInt32, mi.Float]]:
        """The 4 texels around directions, and their weights."""
        columns = 2 * self.rows
        wide, high = dr.opaque(mi.Float, columns), dr.opaque(mi.Float, self.rows - 1)
        u, v = dr.atan2(d.x, -d.z) * dr.inv_two_pi, dr.safe_acos(d.y) * dr.inv_pi
        x, y = dr.fma(u, wide, -0.5), v * high
        i, j = dr.floor(x), dr.minimum(dr.floor(y), high - 1)
        fx, fy = x - i, y - j
        last = dr.opaque(mi.Int32, columns)
        left = mi.Int32(i)
        left = dr.select(left < 0, left + last, left)
        right = dr.select(left + 1 == last, 0, left + 1)
        top = mi.Int32(j) * last
        corners = []
        for row, wy in ((top, 1 - fy), (top + last, fy)):
            corners += [(mi.UInt32(row + left), wy * (1 - fx)), (mi.UInt32(row + right), wy * fx)]
        return corners

    def eval(self, d: mi.Vector3f) -> mi.Color3f:
        """Radiance from unit directions, which point to the sky."""
        colour = mi.Color3f(0)
        for texel, weight in self._corners(d):
            packet = dr.gather(mi.ArrayXf, self.texels, texel, shape=(TEXEL, 1))
            colour += mi.Color3f(packet[0], packet[1], packet[2]) * weight
        return colour

    def texel_gradient(self, d: mi.Vector3f, by: mi.Color3f) -> mi.Float:
        """Derivatives of a scalar by ``texels``, from its derivatives by the radiance of :meth:`eval`."""
        total = dr.zeros(mi.Float, dr.width(self.texels))
        for texel, weight in self._corners(d):
            packet = mi.ArrayXf([by.x * weight, by.y * weight, by.z * weight, mi.Float(0)])
            dr.scatter_add(total, packet, texel)
        return total


def read_sky(path: Path) -> Sky:
    """Read the sky that a fit wrote.

    Raises:
        MivolError: an image of another kind.
    """
    channels, _ = read_exr(path)
    image = np.stack([channels[name] for name in "RGB"], axis=-1) if {"R", "G", "B"} <= channels.keys() else np.zeros((1, 1, 3))
    if image.shape[0] < 2 or image.shape[1] != 2 * image.shape[0]:
        raise MivolError(f"{path} is no sky of R, G and B, twice as wide as high: take it away, or fit the field again.")
    return Sky.from_image(image)
