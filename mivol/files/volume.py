"""Volumes: voxel values with their placement in the world, on a dense grid or in bricks.

Conventions. ``values`` is float32, C-contiguous, (Z, Y, X, C): x is the fastest spatial axis. Voxel (i, j, k) of the x, y, z
axes has its centre at ((i + .5)/Nx, (j + .5)/Ny, (k + .5)/Nz) in local coordinates. ``to_world`` (4, 4) float64 maps local
(x, y, z, 1), a column, to the physical frame of the file. ``origin`` is the world position of the *centre* of voxel (0, 0, 0),
as in NRRD, MetaImage, NIfTI and VTK, so the unit cube begins half a voxel before it.

Sparse volumes hold bricks of 8^3 voxels, and 0 everywhere else. Voxel (z, y, x) of the box, counted from 0, lies in the brick
(z + oz) // 8 along z, at (z + oz) % 8 in it; likewise along y and x. ``offset`` = (oz, oy, ox) lets the bricks of a file lie on
the box of its voxels without moving a voxel. A brick at the border of the box has voxels outside it, which nobody reads.

Reference: Museth 2021, "NanoVDB: A GPU-friendly and portable VDB data structure for real-time rendering and simulation".
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from mivol.display import summarize, with_short_repr
from mivol.errors import MivolError
from mivol.files.image_files import slices_html
from mivol.files.source import refusal

#: Smallest side of a box: the reciprocal of a denormal float32 number overflows.
SMALLEST_SIDE = float(np.finfo(np.float32).tiny)

#: Smallest |det| of the three sides divided by the product of their lengths: 16 float32 roundings.
FLATTEST = 16 * float(np.finfo(np.float32).eps)

#: medical frame -> signs of its x, y, z axes relative to right-anterior-superior.
MEDICAL_FRAMES: dict[str, tuple[int, int, int]] = {"RAS": (1, 1, 1), "LPS": (-1, -1, 1), "LAS": (-1, 1, 1)}


@with_short_repr
@dataclasses.dataclass(frozen=True)
class VolumeData:
    """A volume with its placement and the facts of its file.

    Attributes:
        values: float32 (Z, Y, X, C), C-contiguous; negative and non-finite numbers are kept (:func:`check_volume`).
        to_world: unit cube to the physical frame of the file, float64 (4, 4).
        meta: facts of the file, each optional: ``path``, ``format``, ``dtype`` (on disk; default float32), ``space`` ("RAS",
            "LPS" or None), and facts of the format.
    """

    values: np.ndarray
    to_world: np.ndarray
    meta: dict[str, object] = dataclasses.field(default_factory=dict)

    def _repr_html_(self) -> str:
        """Return three middle slices for notebooks."""
        return slices_html(self.values, f"{summarize(self.values)}, from {self.values.min():.4g} to {self.values.max():.4g}")

    @property
    def size(self) -> np.ndarray:
        """Voxels along x, y, z, int (3,)."""
        return np.array(self.values.shape[2::-1])

    @property
    def steps(self) -> np.ndarray:
        """World vectors between neighbouring voxel centres, a column per axis x, y, z, float64 (3, 3) [length]."""
        return self.to_world[:3, :3] / self.size

    @property
    def spacing(self) -> np.ndarray:
        """Distances between neighbouring voxel centres along x, y, z, float64 (3,) [length]."""
        return np.linalg.norm(self.steps, axis=0)

    @property
    def origin(self) -> np.ndarray:
        """World position of the centre of voxel (0, 0, 0), float64 (3,) [length]."""
        return self.to_world[:3, 3] + self.steps.sum(axis=1) / 2


def frame_from_steps(size: Sequence[int], steps: np.ndarray, origin: Sequence[float]) -> np.ndarray:
    """Return the placement of the unit cube from voxel steps and the centre of the first voxel.

    Args:
        size: voxels along x, y, z.
        steps: (3, 3); column a is the world vector between neighbouring voxels along axis a (direction times spacing).
        origin: world position (3,) of the centre of voxel (0, 0, 0).

    Returns:
        float64 (4, 4); it maps the voxel centre (i + .5)/N to origin + steps @ (i, j, k).
    """
    steps = np.asarray(steps, np.float64)
    to_world = np.eye(4)
    to_world[:3, :3] = steps * np.asarray(size, np.float64)
    to_world[:3, 3] = np.asarray(origin, np.float64) - steps.sum(axis=1) / 2
    return to_world


def split_frame(size: Sequence[int], to_world: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return voxel steps (3, 3) and the centre of the first voxel (3,): the inverse of :func:`frame_from_steps`."""
    steps = to_world[:3, :3] / np.asarray(size, np.float64)
    return steps, to_world[:3, 3] + steps.sum(axis=1) / 2


def is_upright(steps: np.ndarray) -> bool:
    """Whether the axes of a grid equal the axes of the world, to 1e-9 of the largest step."""
    return bool(np.allclose(steps, np.diag(np.abs(np.diag(steps))), rtol=0, atol=1e-9 * np.abs(steps).max()))


def frame_from_box(low: Sequence[float], high: Sequence[float]) -> np.ndarray:
    """Return the placement (4, 4) of the unit cube on the axis-aligned box from corner ``low`` to corner ``high``."""
    low, high = np.asarray(low, np.float64), np.asarray(high, np.float64)
    to_world = np.diag([*(high - low), 1.0])
    to_world[:3, 3] = low
    return to_world


def check_frame(to_world: np.ndarray, name: object) -> None:
    """Refuse a placement that flattens the unit cube.

    Args:
        to_world: (4, 4).
        name: file or parameter, the subject of the refusal.

    Raises:
        MivolError: another shape, a number that is not finite, a last row other than (0, 0, 0, 1), a side shorter than the
            smallest normal float32 number, or three sides in a plane (det 0 in float32).
    """
    to_world = np.asarray(to_world, np.float64)
    if to_world.shape != (4, 4) or not np.array_equal(to_world[3], (0, 0, 0, 1)):
        raise refusal(name, f"a transform of shape {to_world.shape}", "an affine 4x4 matrix", "its last row must be 0 0 0 1")
    if not np.isfinite(to_world).all():
        raise refusal(name, "a transform with NaN or Inf", "finite numbers", "correct the header or pass to_world")
    sides = np.linalg.norm(to_world[:3, :3], axis=0)
    if sides.min() < SMALLEST_SIDE:
        listed = " x ".join(f"{side:.4g}" for side in sides)
        raise refusal(
            name,
            f"a degenerate box ({listed})",
            "three sides above 0",
            'correct its bounds or spacing, or read it on the unit cube with frame="unit"',
        )
    if abs(np.linalg.det(to_world[:3, :3] / sides)) < FLATTEST:
        raise refusal(
            name,
            "a transform with determinant 0",
            "three independent axes",
            'correct its axes, or read it on the unit cube with frame="unit"',
        )


def to_space(volume: VolumeData, space: str) -> VolumeData:
    """Return the volume in another medical frame.

    In NIfTI x points to the right and y forwards (RAS); in medical NRRD and MetaImage x points to the left and y backwards
    (LPS).

    Args:
        volume: volume with a key of :data:`MEDICAL_FRAMES` in ``meta["space"]``.
        space: key of :data:`MEDICAL_FRAMES`.

    Raises:
        MivolError: an unknown frame.
    """
    current = volume.meta.get("space")
    for name in (current, space):
        if name not in MEDICAL_FRAMES:
            expected = f"one of {', '.join(MEDICAL_FRAMES)}"
            raise refusal(volume.meta.get("path", "volume"), f"the frame {name!r}", expected, "set to_world by hand")
    return dataclasses.replace(
        volume, to_world=turn_frame(volume.to_world, current, space), meta={**volume.meta, "space": space}
    )


def turn_frame(to_world: np.ndarray, current: str | None, space: str) -> np.ndarray:
    """Return a placement (4, 4) in another key of :data:`MEDICAL_FRAMES`; without a current one, it stays."""
    if current is None:
        return to_world
    signs = np.array(MEDICAL_FRAMES[current]) * np.array(MEDICAL_FRAMES[space])
    return np.diag([*signs, 1.0]) @ to_world


def to_values(array: np.ndarray, path: object) -> np.ndarray:
    """Convert a real array (Z, Y, X) or (Z, Y, X, C) to C-contiguous float32 (Z, Y, X, C).

    Integers above 2^24 are rounded to the nearest float32.

    Raises:
        MivolError: another rank, an empty axis, numbers that are not real, or finite numbers beyond float32.
    """
    array = np.asarray(array)
    if array.dtype.kind not in "biuf":
        raise refusal(path, f"numbers of type {array.dtype}", "real numbers", "convert them to float32 first")
    if array.ndim not in (3, 4):
        way_out = "reshape it or choose one time step first"
        raise refusal(path, f"an array of shape {array.shape}", "(Z, Y, X) or (Z, Y, X, C)", way_out)
    if array.size == 0:
        raise refusal(path, f"an empty array of shape {array.shape}", "at least one voxel", "write it again")
    if array.ndim == 3:
        array = array[..., None]
    with np.errstate(over="ignore"):
        values = np.ascontiguousarray(array, dtype=np.float32)
    if array.dtype.kind == "f" and array.dtype.itemsize > 4:
        lost = np.isinf(values) & np.isfinite(array)
        if lost.any():
            index = tuple(int(i) for i in np.argwhere(lost)[0])
            found = f"{array[index]:.4g} at voxel {_voxel(index)}"
            raise refusal(path, found, "numbers within float32 (3.4e38)", "rescale the data")
    return values


def check_volume(values: np.ndarray, *, name: str, channels: Sequence[int] = (1, 3), minimum: float | None = 0.0) -> None:
    """Refuse a grid that cannot be a coefficient of a medium.

    Args:
        values: (Z, Y, X, C).
        name: parameter or file, the subject of the refusal.
        channels: allowed numbers of channels.
        minimum: smallest allowed value; None allows all finite numbers.

    Raises:
        MivolError: another rank or number of channels, an empty axis, numbers that are not real, or a NaN, an Inf or a value
            below ``minimum`` (with the index of the first such voxel).
    """
    values = np.asarray(values)
    if values.ndim != 4:
        raise refusal(
            name,
            f"an array of rank {values.ndim} and shape {values.shape}",
            "rank 4 (Z, Y, X, C)",
            "add the missing axis with values[..., None] or drop the surplus one",
        )
    if values.size == 0:
        raise refusal(name, f"an empty grid of shape {values.shape}", "at least one voxel", "check how it was made")
    if values.shape[3] not in channels:
        raise refusal(
            name,
            f"{values.shape[3]} channels",
            " or ".join(map(str, channels)),
            "choose channels with values[..., :1] or values[..., :3]",
        )
    if values.dtype.kind not in "biuf":
        raise refusal(name, f"numbers of type {values.dtype}", "real numbers", "convert them to float32")
    if (bad := find_bad_voxel(values, minimum)) is not None:
        index, count = bad
        raise refuse_voxel(name, float(values[index]), index, count, minimum)


def find_bad_voxel(values: np.ndarray, minimum: float | None) -> tuple[tuple[int, ...], int] | None:
    """The index of the first number that is NaN, infinite or below ``minimum``, and how many there are; None without one."""
    low, high = values.min(), values.max()
    if np.isfinite(low) and np.isfinite(high) and (minimum is None or low >= minimum):
        return None
    bad = ~np.isfinite(values)
    if minimum is not None:
        bad |= values < minimum
    return tuple(int(i) for i in np.unravel_index(np.argmax(bad), values.shape)), int(bad.sum())


def refuse_voxel(name: str, value: float, index: Sequence[int], count: int, minimum: float | None) -> MivolError:
    """Return the error that names the first of ``count`` bad values, at the index (z, y, x, channel)."""
    expected = "finite numbers" if minimum is None else f"finite numbers of at least {minimum:g}"
    more = f" and {count - 1} more bad values" if count > 1 else ""
    way_out = "repair them (for instance with numpy.clip or numpy.nan_to_num) or choose another array"
    return refusal(name, f"{value:g} at voxel {_voxel(index)}{more}", expected, way_out)


def _voxel(index: Sequence[int]) -> str:
    z, y, x, channel = index
    return f"(z={z}, y={y}, x={x}, channel={channel})"


# -- Sparse volumes ----------------------------------------------------------------------------------------------------

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
