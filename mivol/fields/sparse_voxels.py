"""A sparse grid of values at voxel centres: the function of the dense grid (:mod:`mivol.fields.voxels`), from bricks alone.

Conventions. Trilinear between centres, constant in the outer half voxel, vacuum outside, 0 at voxels that are not stored.
``mi.traverse`` hands out ``data`` (bricks, 8, 8, 8, C), the stored values, and ``bricks``, the ascending numbers (z, y, x) of
the stored bricks among those of the box. To store other bricks, replace both.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.fields.bricks import Bricks, Nodes
from mivol.fields.protocol import EXACT_LINE, GridValues
from mivol.files import SparseVolumeData, check_bricks
from mivol.files.source import refusal
from mivol.files.sparse_volume import EDGE, count_bricks
from mivol.kernel_recording import copy_aligned, is_recording
from mivol.space import check_affine

MOST_SLOTS = 1 << 31
"""Stored values are fewer than this."""

MOST_BRICKS = 1 << 23
"""Bricks of the box are at most this many: the address of a node has 32 bits."""


class SparseVoxels(GridValues):
    """A trilinear grid in the world, of which bricks of 8^3 voxels are stored.

    Args:
        volume: stored values, 1 or 3 channels, finite, and not negative unless ``signed``. Its placement is not read.
        to_world: (4, 4) affine map of the unit cube to the world.
        name: name of the grid in messages.
        to_local: Mitsuba's inverse of ``to_world``, with Mitsuba's rounding; None: computed here.
        signed: whether values may be negative.

    Attributes:
        tensor: the stored values (bricks, 8, 8, 8, C).
        bricks: where they are.

    Raises:
        MivolError: values, bricks or a placement that no medium can have; the message names the first bad voxel.
    """

    line = EXACT_LINE
    freezable_texture = None

    def __init__(
        self,
        volume: SparseVolumeData,
        to_world: np.ndarray,
        name: str,
        to_local: np.ndarray | None = None,
        signed: bool = False,
    ) -> None:
        self.name = name
        self.to_world = check_affine(to_world, f"to_world of {name}")
        check_bricks(volume, name=name, minimum=None if signed else 0.0)
        self.channels, self.res, self.offset = volume.channels, tuple(map(int, volume.shape)), tuple(map(int, volume.offset))
        self._check_size(volume.values.size)
        values = np.ascontiguousarray(volume.values, np.float32).ravel()
        # Dr.Jit reads the memory of NumPy in place.
        self.tensor = mi.TensorXf(
            mi.Float(values if values.ctypes.data % 64 == 0 else copy_aligned(values)), volume.values.shape
        )
        self.stored = mi.UInt32(volume.numbers)
        # A copy: mi.traverse changes its parameter in place.
        self.bricks = Bricks.from_numbers(self.res, self.offset, mi.UInt32(self.stored))
        to_local = np.linalg.inv(self.to_world) if to_local is None else to_local
        self.to_local = mi.ScalarAffineTransform4f(mi.ScalarMatrix4f(to_local), mi.ScalarMatrix4f(self.to_world.T))

    def _check_size(self, values: int) -> None:
        bricks = int(np.prod(count_bricks(self.res, self.offset), dtype=np.int64))
        if values >= MOST_SLOTS or bricks > MOST_BRICKS:
            found, expected = f"{values} values in a box of {bricks} bricks", "fewer than 2^31 values and at most 2^23 bricks"
            raise refusal(self.name, found, expected, "coarsen or crop it")

    def eval(self, p: mi.Point3f, w: mi.Vector3f | None = None, active: mi.Bool = True) -> list[mi.Float]:
        """Values at world points, a list of channels; 0 outside the box. The direction ``w`` has no effect."""
        q = mi.AffineTransform4f(self.to_local) @ p
        inside = mi.Bool(active) & dr.all((q >= 0) & (q <= 1))
        place = dr.fma(mi.Vector3f(q), mi.Vector3f(*self.res[::-1]), -0.5)
        low = dr.floor(place)
        nodes = self.bricks.find_corners(mi.Vector3i(low), dr.full(dr.mask_t(mi.Vector3f), True), inside)
        return [_interpolate(self._read(nodes, c, inside), place - low) for c in range(self.channels)]

    def _read(self, nodes: Nodes, channel: int, active: mi.Bool) -> list[mi.Float]:
        rows, on = [k * self.channels + channel for k in nodes.index], nodes.select(active)
        return [dr.gather(mi.Float, self.tensor.array, k, lanes) for k, lanes in zip(rows, on, strict=True)]

    def bound(self) -> list[float]:
        """Largest value of each channel, at least 0."""
        values = np.array(dr.detach(self.tensor), copy=False)
        return [max(float(v), 0.0) for v in values.reshape(-1, self.channels).max(axis=0)]

    def refresh(self) -> None:
        """Update the table after values or bricks were replaced.

        Raises:
            MivolError: NaN or infinite values, another number of values than bricks, or bricks that do not ascend or lie
                outside of the box; not checked while ``dr.freeze`` records.
        """
        if is_recording():
            # A recording cannot read values.
            return
        count = dr.width(self.stored)
        if tuple(self.tensor.shape) != (count, EDGE, EDGE, EDGE, self.channels):
            found, expected = tuple(self.tensor.shape), (count, EDGE, EDGE, EDGE, self.channels)
            found = f"data of shape {found} for {count} bricks"
            raise refusal(self.name, found, f"{expected}", "replace data and bricks together")
        self._check_size(dr.width(self.tensor.array))
        if self.stored.index != self.bricks.stored.index:
            numbers = np.array(self.stored, dtype=np.int64)
            if not (np.diff(numbers, prepend=-1) > 0).all() or numbers[-1] >= np.prod(self.bricks.counts):
                expected = f"ascending numbers below {np.prod(self.bricks.counts)}"
                raise refusal(self.name, "bricks out of order, twice or outside of the box", expected, "sort or correct them")
            self.bricks = Bricks.from_numbers(self.res, self.offset, mi.UInt32(self.stored))
        if not dr.all(dr.isfinite(dr.detach(self.tensor.array))):
            check_bricks(self.volume(), name=self.name, minimum=None)

    def volume(self) -> SparseVolumeData:
        """The stored values as NumPy arrays, on the unit cube."""
        numbers = np.array(self.stored, dtype=np.int64)
        places = np.stack(np.unravel_index(numbers, count_bricks(self.res, self.offset)), axis=1).astype(np.int32)
        return SparseVolumeData(np.array(dr.detach(self.tensor)), places, self.res, np.eye(4), self.offset)

    def __repr__(self) -> str:
        z, y, x = self.res
        share = dr.width(self.stored) / np.prod(self.bricks.counts)
        return f"mivol_voxels[{x}x{y}x{z}, {self.channels} channels, {dr.width(self.stored)} bricks, {share:.1%}]"


def _interpolate(corners: list[mi.Float], frac: mi.Vector3f) -> mi.Float:
    for t in (frac.x, frac.y, frac.z):
        corners = [dr.fma(t, b - a, a) for a, b in zip(corners[::2], corners[1::2], strict=True)]
    return corners[0]
