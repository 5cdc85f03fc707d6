"""Volumes that are sparse in memory: bricks of 8^3 voxels, and 0 everywhere else.

Conventions. Voxel (z, y, x) of the box, counted from 0, lies in the brick (z + oz) // 8 along z, at (z + oz) % 8 in it;
likewise along y and x. ``offset`` = (oz, oy, ox) lets the bricks of a file lie on the box of its voxels without moving a voxel.
A brick at the border of the box has voxels outside of the box, which nobody reads.

Reference: Museth 2021, "NanoVDB: A GPU-friendly and portable VDB data structure for real-time rendering and simulation".
"""

from __future__ import annotations

import dataclasses

import numpy as np

from mivol.display import with_short_repr
from mivol.files.source import refusal
from mivol.files.volume import find_bad_voxel, refuse_voxel

EDGE = 8
"""Voxels along the edge of a brick."""

VOXELS = EDGE**3
"""Voxels of a brick."""


@with_short_repr
@dataclasses.dataclass(frozen=True)
class SparseVolumeData:
    """A volume in bricks, with its placement and the facts of its file.

    Attributes:
        values: float32 (bricks, 8, 8, 8, C), in the order z, y, x in a brick.
        bricks: int32 (bricks, 3), the place (z, y, x) of each brick among the bricks of the box, in ascending order.
        shape: voxels of the box (Z, Y, X).
        to_world: unit cube to world, float64 (4, 4).
        offset: voxels of the first brick before the box (Z, Y, X), 0 to 7.
        meta: as of :class:`mivol.files.volume.VolumeData`.
    """

    values: np.ndarray
    bricks: np.ndarray
    shape: tuple[int, int, int]
    to_world: np.ndarray
    offset: tuple[int, int, int] = (0, 0, 0)
    meta: dict[str, object] = dataclasses.field(default_factory=dict)

    @classmethod
    def from_dense(cls, values: np.ndarray, to_world: np.ndarray | None = None) -> SparseVolumeData:
        """Keep the bricks of a dense volume with a value other than 0.

        Args:
            values: float32 (Z, Y, X, C).
            to_world: unit cube to world (4, 4), by default the identity.
        """
        shape, counts = values.shape[:3], count_bricks(values.shape[:3])
        places, bricks = [], []
        # A slab of bricks at a time: no second copy of the whole volume.
        for z in range(counts[0]):
            slab = values[EDGE * z : EDGE * (z + 1)]
            margins = [(0, EDGE * n - m) for n, m in zip((1, *counts[1:]), slab.shape, strict=False)]
            cut = np.pad(slab, (*margins, (0, 0))).reshape(EDGE, counts[1], EDGE, counts[2], EDGE, -1)
            cut = cut.transpose(1, 3, 0, 2, 4, 5)
            held = np.argwhere((cut != 0).any(axis=(2, 3, 4, 5)))
            bricks.append(np.ascontiguousarray(cut[held[:, 0], held[:, 1]], np.float32))
            places.append(np.column_stack([np.full(len(held), z), held]))
        place = np.eye(4) if to_world is None else to_world
        return cls(np.concatenate(bricks), np.concatenate(places).astype(np.int32), tuple(shape), place)

    def dense(self) -> np.ndarray:
        """The values of all voxels of the box, float32 (Z, Y, X, C)."""
        counts = count_bricks(self.shape, self.offset)
        values = np.zeros((counts[0], EDGE, counts[1], EDGE, counts[2], EDGE, self.channels), np.float32)
        z, y, x = self.bricks.T
        values[z, :, y, :, x] = self.values
        values = values.reshape(*(EDGE * n for n in counts), self.channels)
        return np.ascontiguousarray(values[tuple(slice(o, o + n) for o, n in zip(self.offset, self.shape, strict=True))])

    @property
    def channels(self) -> int:
        """Values of each voxel."""
        return self.values.shape[4]

    @property
    def size(self) -> np.ndarray:
        """Voxels along x, y, z, int (3,)."""
        return np.array(self.shape[::-1])

    @property
    def spacing(self) -> np.ndarray:
        """Distances between neighbouring voxel centres along x, y, z, float64 (3,) [length]."""
        return np.linalg.norm(self.to_world[:3, :3] / self.size, axis=0)

    @property
    def numbers(self) -> np.ndarray:
        """Number of each brick among all bricks of the box (z, y, x), uint32, ascending."""
        return np.ravel_multi_index(self.bricks.T, count_bricks(self.shape, self.offset)).astype(np.uint32)

    @property
    def dense_bytes(self) -> int:
        """Size of the values of all voxels of the box [bytes]."""
        return 4 * int(np.prod(self.shape, dtype=np.int64)) * self.channels


def allocate_bricks(count: int, channels: int) -> np.ndarray:
    """Allocate values (count, 8, 8, 8, channels) at an address that Dr.Jit reads in place: a multiple of 64 bytes."""
    size = count * VOXELS * channels * 4
    buffer = np.empty(size + 64, np.uint8)
    start = -buffer.ctypes.data % 64
    return buffer[start : start + size].view(np.float32).reshape(count, EDGE, EDGE, EDGE, channels)


def measure_stored_share(volume: np.ndarray | SparseVolumeData) -> float:
    """Share of the bricks of a box that are stored, or would be for a dense volume (Z, Y, X, C)."""
    if isinstance(volume, SparseVolumeData):
        return len(volume.values) / int(np.prod(count_bricks(volume.shape, volume.offset)))
    held = (volume != 0).any(axis=3)
    for axis in range(3):
        held = np.logical_or.reduceat(held, np.arange(0, held.shape[axis], EDGE), axis=axis)
    return float(held.mean())


def count_bricks(shape: tuple[int, int, int], offset: tuple[int, int, int] = (0, 0, 0)) -> tuple[int, int, int]:
    """Bricks (Z, Y, X) that hold a box of voxels."""
    return tuple(-(-(n + o) // EDGE) for n, o in zip(shape, offset, strict=True))


def check_bricks(volume: SparseVolumeData, *, name: str, minimum: float | None = 0.0) -> None:
    """Refuse a sparse volume that cannot be a coefficient of a medium.

    Args:
        volume: the volume.
        name: parameter or file, the subject of the refusal.
        minimum: smallest allowed value; None allows all finite numbers.

    Raises:
        MivolError: another shape or number of channels; no brick; bricks out of order, repeated or outside of the box; a NaN,
            an Inf or a value below ``minimum`` (with the index of the first such voxel).
    """
    values, bricks, counts = volume.values, volume.bricks, count_bricks(volume.shape, volume.offset)
    if values.ndim != 5 or values.shape[1:4] != (EDGE,) * 3 or values.shape[4] not in (1, 3):
        found, expected = f"bricks of shape {values.shape}", "(bricks, 8, 8, 8, 1) or (bricks, 8, 8, 8, 3)"
        raise refusal(name, found, expected, "cut a dense array with SparseVolumeData.from_dense")
    if bricks.shape != (len(values), 3) or not len(values):
        found = f"places of shape {bricks.shape} for {len(values)} bricks"
        raise refusal(name, found, "at least one brick, and a row (z, y, x) for each", "give one place for each brick")
    if (bricks < 0).any() or (bricks >= counts).any():
        row = bricks[np.flatnonzero(((bricks < 0) | (bricks >= counts)).any(axis=1))[0]]
        found = f"a brick at {tuple(map(int, row))} (z, y, x)"
        raise refusal(name, found, f"places below {counts} in a box of {volume.shape} voxels", "enlarge the box")
    numbers = volume.numbers.astype(np.int64)
    if not (np.diff(numbers) > 0).all():
        raise refusal(name, "bricks out of order or twice", "ascending places (z, y, x)", "sort the bricks by their place")
    bad = find_bad_voxel(values, minimum)
    if bad is not None:
        first, count = bad
        place = bricks[first[0]] * EDGE + first[1:4] - np.array(volume.offset)
        raise refuse_voxel(name, float(values[first]), (*map(int, place), first[4]), count, minimum)
