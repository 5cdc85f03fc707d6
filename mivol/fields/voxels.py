"""A grid of values at voxel centres, dense or sparse: trilinear between centres, constant in the outer half voxel.

Conventions. The model of Mitsuba's ``gridvolume`` with clamped borders, equal to the last bit: values (Z, Y, X, C) over the
unit cube under ``to_world``. ``mi.traverse`` hands out the very tensor that is evaluated. Outside the box is vacuum.

A sparse grid is the same function, from bricks alone; voxels that are not stored are 0. ``mi.traverse`` hands out ``data``
(bricks, 8, 8, 8, C), the stored values, and ``bricks``, the ascending numbers (z, y, x) of the stored bricks among those of the
box. To store other bricks, replace both.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.errors import MivolError
from mivol.fields.bricks import Bricks, Nodes
from mivol.fields.protocol import EXACT_LINE, GridValues
from mivol.files import SparseVolumeData, check_bricks, check_volume, is_sparse_file, read_sparse_volume, read_volume
from mivol.files.source import refusal
from mivol.files.volume import EDGE, count_bricks, measure_stored_share
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


# -- A dense grid ------------------------------------------------------------------------------------------------------


class Voxels(GridValues):
    """A trilinear grid in the world.

    Args:
        values: (Z, Y, X, C), 1 or 3 channels, finite, and not negative unless ``signed``.
        to_world: (4, 4) affine map of the unit cube to the world.
        name: name of the grid in messages.
        to_local: Mitsuba's inverse of ``to_world``, with Mitsuba's rounding; None: computed here.
        signed: whether values may be negative, as the ``g`` of a phase function. A reader that needs an extinction clamps them
            to 0.

    Raises:
        MivolError: values or a placement that no medium can have; the message names the first bad voxel.
    """

    line = EXACT_LINE
    bricks = None

    def __init__(
        self,
        values: np.ndarray | mi.TensorXf,
        to_world: np.ndarray,
        name: str,
        to_local: np.ndarray | None = None,
        signed: bool = False,
    ) -> None:
        self.name = name
        self.to_world = check_affine(to_world, f"to_world of {name}")
        tensor = values if isinstance(values, mi.TensorXf) else mi.TensorXf(np.ascontiguousarray(values, dtype=np.float32))
        check_volume(np.array(dr.detach(tensor)), name=name, minimum=None if signed else 0.0)
        # No hardware texture of a GPU: its interpolation weights have 8 bits.
        self.texture = mi.Texture3f(tensor, use_accel=False, migrate=False)
        to_local = np.linalg.inv(self.to_world) if to_local is None else to_local
        self.to_local = mi.ScalarAffineTransform4f(mi.ScalarMatrix4f(to_local), mi.ScalarMatrix4f(self.to_world.T))

    @property
    def freezable_texture(self) -> mi.Texture3f | None:
        """The texture as an attribute of a plugin; ``dr.freeze`` finds arrays only among a plugin's own attributes.

        None on a GPU, where Dr.Jit 1.5 would read uninitialised memory as the handle of a hardware texture and abort the
        process ("unknown variable"; ``Texture::traverse_1_cb_ro``).
        """
        return self.texture if dr.backend_v(mi.Float) == dr.JitBackend.LLVM else None

    @property
    def tensor(self) -> mi.TensorXf:
        """The values, (Z, Y, X, C).

        Raises:
            MivolError: ``dr.freeze`` records and cannot follow the values.
        """
        if self.freezable_texture is None and is_recording():
            advice = "render without it, use llvm_ad_rgb, or a gridvolume of Mitsuba's"
            raise MivolError(f"dr.freeze records {self.name} in {mi.variant()}, and cannot follow its values there: {advice}.")
        return self.texture.tensor()

    @property
    def channels(self) -> int:
        """Number of channels."""
        return self.tensor.shape[3]

    @property
    def res(self) -> tuple[int, int, int]:
        """Resolution (Z, Y, X)."""
        return tuple(self.tensor.shape[:3])

    def eval(self, p: mi.Point3f, w: mi.Vector3f | None = None, active: mi.Bool = True) -> list[mi.Float]:
        """Values at world points, a list of channels; 0 outside the box. The direction ``w`` has no effect."""
        q = mi.AffineTransform4f(self.to_local) @ p
        inside = mi.Bool(active) & dr.all((q >= 0) & (q <= 1))
        return [dr.select(inside, v, 0) for v in self.texture.eval(q, inside)]

    def bound(self) -> list[float]:
        """Largest value of each channel."""
        values = np.array(dr.detach(self.tensor))
        return [float(v) for v in values.reshape(-1, self.channels).max(axis=0)]

    def corners(self) -> np.ndarray:
        """The 8 corners of the box in the world, (8, 3)."""
        unit = np.array([[x, y, z, 1] for z in (0, 1) for y in (0, 1) for x in (0, 1)], dtype=np.float64)
        return (unit @ self.to_world.T)[:, :3]

    def replace(self, values: mi.TensorXf) -> None:
        """Replace the values by others of the same shape, also in a ``tensor`` that was read before."""
        self.texture.set_tensor(values)
        self.texture.tensor()  # until it is read again, a tensor of before keeps its old values

    def refresh(self) -> None:
        """Update the texture after values were replaced.

        Negative values are accepted, since optimizer steps overshoot. An extinction clamps them to 0; other readers refuse
        invalid values.

        Raises:
            MivolError: NaN or infinite values; not checked while ``dr.freeze`` records.
        """
        self.texture.update_inplace()
        if is_recording():
            # A recording cannot read values.
            return
        check_volume(np.array(dr.detach(self.tensor)), name=self.name, minimum=None)

    def __repr__(self) -> str:
        z, y, x = self.res
        return f"mivol_voxels[{x}x{y}x{z}, {self.channels} channels]"


STORAGES = ("auto", "dense", "sparse")
"""Values of the property ``storage``."""

LEAST_SPARSE_BYTES = 128 << 20
"""Size of a dense grid [bytes] from which ``auto`` stores a sparse one: below, memory is cheap."""

MAX_STORED_SHARE = 0.5
"""Share of stored bricks up to which ``auto`` stores a sparse grid."""


def read_voxels(props: mi.Properties, convert: Callable[[np.ndarray], np.ndarray] | None = None) -> Voxels | SparseVoxels:
    """Make a grid from plugin parameters: ``filename`` (with the name of its ``grid``), ``grid`` or ``data`` (with ``bricks``
    and ``resolution`` if it is sparse); storage, box and sign options, and a factor ``scale``.

    Args:
        props: parameters of the plugin.
        convert: function of the values (..., C) before the factor; None keeps them.

    Raises:
        MivolError: none or several sources, an unknown storage, or what the source or the grid refuses.
    """
    names_grid = "filename" in props and "grid" in props and isinstance(props["grid"], str)
    sources = ["filename"] if names_grid else [k for k in ("filename", "grid", "data") if k in props]
    name = f"mivol_voxels {props.id()}".strip()
    if len(sources) != 1:
        found = " and ".join(sources) or "none of them"
        raise MivolError(f"{name} was given {found}; give exactly one of filename, grid or data.")
    storage = props.get("storage", "auto")
    if storage not in STORAGES:
        raise refusal(name, f"storage {storage!r}", f"one of {', '.join(STORAGES)}", "choose one")
    transform = props.get("to_world", mi.ScalarTransform4f())
    to_world = np.array(transform.matrix, dtype=np.float64)
    to_local = np.array(transform.inverse_transpose, dtype=np.float64).T
    own_box = props.get("use_grid_bbox", False)
    values, place = _read_source(props, sources[0], own_box, storage, name)
    if convert is not None:
        values = _convert(values, convert)
    if "scale" in props:
        factor = parse_factor(props["scale"], name)
        if isinstance(values, mi.TensorXf):
            raise refusal(name, "scale beside data", "data alone", "multiply the array")
        values = _convert(values, lambda array: _multiply(array, factor, name))
    if "filename" in props:
        name = f"{name} ({props['filename']})"
    _check_inverse(check_affine(to_world, f"to_world of {name}"), to_local, f"to_world of {name}")
    kind = SparseVoxels if isinstance(values, SparseVolumeData) else Voxels
    return kind(values, to_world @ place, name, np.linalg.inv(place) @ to_local, props.get("signed", False))


def _read_source(
    props: mi.Properties, source: str, own_box: bool, storage: str, name: str
) -> tuple[np.ndarray | mi.TensorXf | SparseVolumeData, np.ndarray]:
    """The values, dense or sparse as ``storage`` says, and their own place."""
    if source == "filename":
        path, frame = str(mi.file_resolver().resolve(props["filename"])), "file" if own_box else "unit"
        if storage != "dense" and is_sparse_file(path):
            sparse = read_sparse_volume(path, props.get("grid"), frame=frame)
            return _store(sparse, storage), sparse.to_world
        volume = read_volume(path, props.get("grid"), frame=frame)
        return _store(volume.values, storage), volume.to_world
    if own_box and source == "data":
        raise MivolError("mivol_voxels was given data and use_grid_bbox; a bare tensor has no box: give to_world.")
    grid = props[source]
    if source == "data":
        if "bricks" in props or "resolution" in props:
            return _given_bricks(props, grid, name), np.eye(4)
        # A program that gives an array expects the same array among the parameters.
        return (SparseVolumeData.from_dense(_as_grid(grid, name)) if storage == "sparse" else grid), np.eye(4)
    values = np.array(grid)
    place = np.eye(4)
    if own_box:
        low, high = np.array(grid.bbox().min), np.array(grid.bbox().max)
        place[:3, :3], place[:3, 3] = np.diag(high - low), low
    return _store(values.reshape((*values.shape[:3], -1)), storage), place


def _convert(
    values: np.ndarray | mi.TensorXf | SparseVolumeData, convert: Callable[[np.ndarray], np.ndarray]
) -> np.ndarray | SparseVolumeData:
    """The values through a function; bricks stay bricks if the function keeps 0."""
    if isinstance(values, SparseVolumeData):
        if convert(np.zeros((1, values.channels), np.float32)).any():
            values = values.dense()
        else:
            return dataclasses.replace(values, values=convert(values.values))
    return convert(np.array(values))


def parse_factor(value: object, name: str) -> np.ndarray:
    """A factor (1,) or (3,) from a number, an rgb triple or a text of either.

    Raises:
        MivolError: anything else, or a factor that is negative or not finite.
    """
    if isinstance(value, mi.Texture):
        value = np.array(mi.traverse(value)["value"])
    try:
        factor = np.array([float(v) for v in value.replace(",", " ").split()] if isinstance(value, str) else value, np.float64)
    except ValueError:
        factor = np.array([np.nan])
    factor = factor.ravel()
    if len(factor) not in (1, 3) or not (np.isfinite(factor) & (factor >= 0)).all():
        raise refusal(name, f"scale {value!r}", "a number or three numbers of at least 0", 'write it as "2" or "1, 0.5, 0.2"')
    return factor.astype(np.float32)


def _multiply(array: np.ndarray, factor: np.ndarray, name: str) -> np.ndarray:
    if len(factor) == 3 and array.shape[-1] not in (1, 3):
        raise refusal(name, f"scale of 3 numbers for {array.shape[-1]} channels", "1 or 3 channels", "give one number")
    return array * factor


def _as_grid(values: mi.TensorXf, name: str) -> np.ndarray:
    if dr.grad_enabled(values):
        found, way_out = "data with gradients and storage sparse", "enable the gradients of its parameter data"
        raise refusal(name, found, "data without gradients", way_out)
    host = np.array(values)
    check_volume(host, name=name, minimum=None)
    return host


def is_worth_bricks(values: np.ndarray | SparseVolumeData) -> bool:
    """Whether ``storage = "auto"`` stores values (Z, Y, X, C) in bricks."""
    size = values.dense_bytes if isinstance(values, SparseVolumeData) else values.nbytes
    return size >= LEAST_SPARSE_BYTES and measure_stored_share(values) <= MAX_STORED_SHARE


def _store(values: np.ndarray | SparseVolumeData, storage: str) -> np.ndarray | SparseVolumeData:
    """The values as they are stored in memory."""
    is_sparse = isinstance(values, SparseVolumeData)
    if storage == "auto":
        storage = "sparse" if is_worth_bricks(values) else "dense"
    if storage == "sparse":
        return values if is_sparse else SparseVolumeData.from_dense(values)
    return values.dense() if is_sparse else values


def _given_bricks(props: mi.Properties, data: mi.TensorXf, name: str) -> SparseVolumeData:
    missing = [k for k in ("bricks", "resolution") if k not in props]
    if missing:
        raise refusal(name, f"sparse data without {missing[0]}", "bricks and resolution", "give both")
    shape = tuple(int(n) for n in np.array(props["resolution"])[::-1])
    offset = tuple(int(n) for n in np.array(props.get("offset", mi.ScalarVector3f(0)))[::-1])
    if min(shape) < 1 or not all(0 <= o < EDGE for o in offset):
        found = f"resolution {shape[::-1]} and offset {offset[::-1]}"
        raise refusal(name, found, "voxels of at least 1 and offsets of 0 to 7", "correct them")
    if dr.grad_enabled(data):
        found, way_out = "data with gradients", "enable the gradients of its parameter data"
        raise refusal(name, found, "data without gradients", way_out)
    numbers, counts = np.array(dr.ravel(props["bricks"]), dtype=np.int64), count_bricks(shape, offset)
    if len(numbers) and not 0 <= numbers.min() <= numbers.max() < np.prod(counts):
        found = f"bricks {numbers.min()} to {numbers.max()}"
        raise refusal(name, found, f"numbers below {np.prod(counts)} in a box of {counts} bricks", "correct them")
    places = np.stack(np.unravel_index(numbers, counts), axis=1).astype(np.int32)
    return SparseVolumeData(np.array(data, copy=False), places, shape, np.eye(4), offset)


def _check_inverse(to_world: np.ndarray, to_local: np.ndarray, name: str) -> None:
    """Refuse a transform whose inverse in Mitsuba disagrees.

    Tolerance 1e-2: a float32 inverse has a relative error of 1e-6 for orthogonal edges, and 1e-3 for a box sheared by 1000.
    """
    edges = np.linalg.norm(to_world[:3, :3], axis=0)
    back = edges[:, None] * (to_local[:3, :3] @ to_world[:3, :3]) / edges
    if not np.abs(back - np.eye(3)).max() < 1e-2:
        raise MivolError(f"{name} and the inverse that Mitsuba keeps of it do not agree; rotate about an axis of length 1.")
