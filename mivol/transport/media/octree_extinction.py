r"""An extinction of constant leaves in an octree: rays cross it exactly, from leaf to leaf.

.. math:: \sigma(x) = s\, v_i \quad \text{in leaf } i, \qquad \tau = s \sum_i v_i\, \ell_i

with the length of the ray in each leaf. Everything outside of the leaves is vacuum. The optical depth, its derivatives and the
distance at which a ray reaches an optical depth are closed forms in each leaf, so nothing is biased.

Conventions. Leaves are those of :class:`mivol.fields.octree.Octree`: a leaf has a code (its first cell) and a size. ``data``
holds the values (leaves, C) in the order of the codes. Leaves stay in place while their values are fitted.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.errors import MivolError
from mivol.fields.field_files import read_field
from mivol.fields.octree import MAX_DEPTH, MAX_LEAVES, Octree, interleave
from mivol.fields.octree_files import is_octree, is_svox
from mivol.fields.protocol import EXACT_LINE, accumulate_tracked
from mivol.files import check_volume, read_volume
from mivol.kernel_recording import is_recording
from mivol.transport.media.extinction import RayInterval
from mivol.transport.traversal.leaf_index import LeafIndex
from mivol.transport.traversal.octree_walk import VisitedLeaf, clip_to_octree, walk_leaves
from mivol.transport.traversal.rays import Ray

__all__ = ["LeafField", "OctreeExtinction", "merge_voxels"]


class LeafField:
    """Values of the leaves of an octree (:class:`mivol.fields.protocol.Field`).

    Attributes:
        depth: levels below the root.
        to_world: (4, 4) float64, unit cube of the octree to world.
        codes, sizes: (n,) uint64 and uint8, the leaves.
        values: (n, C), 1 or 3 channels, not negative.
        index: the leaves as a ray finds them.
    """

    line: ClassVar[str] = EXACT_LINE

    def __init__(self, depth: int, to_world: np.ndarray, codes: np.ndarray, sizes: np.ndarray, values: mi.TensorXf) -> None:
        zeros = np.zeros((len(codes), 1, 3), np.float32)
        # The octree checks its depth, its place and its leaves.
        tree = Octree.from_rows(depth, to_world, codes, sizes, zeros[:, 0, 0], zeros)
        self.depth, self.to_world, self.codes, self.sizes = depth, tree.to_world, tree.codes, tree.sizes
        self.values, self.index = values, LeafIndex.find(tree)
        self.check()

    @classmethod
    def from_props(cls, props: mi.Properties) -> LeafField:
        """Make a field from plugin parameters: ``filename`` or ``data``, ``tolerance`` and ``to_world``.

        Raises:
            MivolError: no source or two, a tolerance out of range, values that no medium can have, or a file of another kind.
        """
        sources = [name for name in ("filename", "data") if name in props]
        if len(sources) != 1:
            raise MivolError(f"mivol_octree was given {' and '.join(sources) or 'no values'}: give filename or data.")
        place = np.array(props["to_world"].matrix, np.float64) if "to_world" in props else None
        tolerance = float(props.get("tolerance", 0.0))
        if not 0 <= tolerance < 1:
            raise MivolError(f"mivol_octree was given a tolerance of {tolerance:g}: 0 to 1 of the largest value is expected.")
        path = Path(str(props["filename"])) if sources == ["filename"] else None
        if path is not None and path.suffix == ".npz" and _holds_octree(path):
            tree = read_field(path)
            values = mi.TensorXf(tree.values()[0][:, None])
            return cls(tree.depth, tree.to_world if place is None else place, tree.codes, tree.sizes, values)
        dense = np.array(props["data"], np.float32) if path is None else read_volume(path, frame="unit").values
        dense = dense[..., None] if dense.ndim == 3 else dense
        check_volume(dense, name="mivol_octree", minimum=0.0)
        depth, codes, sizes, values = merge_voxels(dense, tolerance)
        cells = np.diag([*(2.0**depth / np.array(dense.shape[2::-1], np.float64)), 1.0])
        return cls(depth, (np.eye(4) if place is None else place) @ cells, codes, sizes, mi.TensorXf(values))

    @property
    def channels(self) -> int:
        """1 (grey) or 3 (rgb)."""
        return self.values.shape[1]

    @property
    def leaves(self) -> int:
        """Number of leaves."""
        return len(self.codes)

    @property
    def bytes(self) -> int:
        """Memory of values, leaves and index [bytes]."""
        return self.leaves * (4 * self.channels + 9) + self.index.bytes

    def check(self) -> None:
        """Refuse values of another shape, or that no medium can have; not while ``dr.freeze`` records.

        Raises:
            MivolError: with what was found.
        """
        shape = tuple(self.values.shape)
        if len(shape) != 2 or shape[0] != self.leaves or shape[1] not in (1, 3):
            raise MivolError(f"mivol_octree was given data of the shape {shape}; ({self.leaves}, 1 or 3) is expected.")
        if is_recording():
            return
        values = np.array(dr.detach(self.values))
        bad = ~(np.isfinite(values) & (values >= 0)).all(axis=1)
        if bad.any():
            leaf = int(np.flatnonzero(bad)[0])
            raise MivolError(
                f"leaf {leaf} of a mivol_octree has the value {values[leaf].tolist()}; finite numbers of at least 0 are "
                "expected: clip them after each step."
            )

    def find_rows(self, p: mi.Point3f | mi.Point3d, active: mi.Bool) -> tuple[mi.UInt32, mi.Bool]:
        """The leaf of points of the world, and whether there is one."""
        index, cell, inside = self.index, mi.Vector3i(), mi.Bool(active)
        for axis, row in enumerate(index.from_world):
            at = mi.Float64(row[3])
            for weight, x in zip(row, p, strict=False):
                at = dr.fma(weight, mi.Float64(x), at)
            inside &= (at >= index.low[axis]) & (at <= index.high[axis])
            # A point in the upper face of the box belongs to the last cell.
            cell[axis] = mi.Int32(dr.clip(dr.floor(at), index.low[axis], index.high[axis] - 1))
        row, is_leaf, _, _ = index.look_up(cell, mi.UInt32(0), inside)
        return row, inside & is_leaf

    def eval(self, p: mi.Point3f, w: mi.Vector3f | None, active: mi.Bool) -> list[mi.Float]:
        """Values at world points, a list of channels; 0 outside of the leaves."""
        row, on = self.find_rows(p, mi.Bool(active))
        return read_leaf(self.values.array, self.channels, row, on)

    def accumulate(self, p: mi.Point3f, w: mi.Vector3f | None, d: list[mi.Float], active: mi.Bool) -> None:
        """Add derivatives by the values at points to the gradient of the leaves."""
        accumulate_tracked(self, p, w, d, active)

    def bound(self) -> list[float]:
        """Largest value of each channel."""
        return [float(v) for v in np.array(dr.detach(self.values)).max(axis=0)]

    def parameters(self) -> dict[str, Any]:
        """The values of the leaves, as ``data``."""
        return {"data": self.values}


def _holds_octree(path: Path) -> bool:
    """Whether an ``.npz`` holds an octree, of mivol or of svox, and no volume."""
    try:
        with np.load(path) as arrays:
            return is_octree(arrays) or is_svox(arrays)
    except (OSError, ValueError):
        return False  # the reader of volumes says what is wrong with the file


def merge_voxels(dense: np.ndarray, tolerance: float) -> tuple[int, np.ndarray, np.ndarray, np.ndarray]:
    """The leaves of a grid (Z, Y, X, C): voxels above 0, eight of which become one as long as they hardly differ.

    Args:
        dense: values of at least 0.
        tolerance: largest difference within a leaf over the largest value; 0 joins equal voxels only.

    Returns:
        Depth, codes, sizes and values (n, C): means over the leaves.

    Raises:
        MivolError: too many voxels, or no value above 0.
    """
    depth = max(int(max(dense.shape[:3]) - 1).bit_length(), 0)
    filled = np.argwhere((dense > 0).any(axis=3))
    if depth > MAX_DEPTH or len(filled) > MAX_LEAVES:
        size = " x ".join(map(str, dense.shape[2::-1]))
        raise MivolError(
            f"mivol_octree was given {size} voxels, {len(filled)} of them above 0; at most {2**MAX_DEPTH} along an axis and "
            f"{MAX_LEAVES} above 0 are expected."
        )
    if not len(filled):
        raise MivolError("mivol_octree was given no value above 0: an octree of vacuum has no leaf.")
    codes = interleave(filled[:, ::-1], depth)
    order = np.argsort(codes)
    codes, values = codes[order], np.ascontiguousarray(dense[tuple(filled[order].T)], np.float32)
    sizes, low, high = np.zeros(len(codes), np.uint8), values, values
    limit = tolerance * float(dense.max())
    for size in range(depth):
        own = np.flatnonzero(sizes == size)
        parent = codes[own] >> np.uint64(3 * (size + 1))
        _, first, count = np.unique(parent, return_index=True, return_counts=True)
        first = first[count == 8]
        group = own[first][:, None] + np.arange(8)
        least, most = low[group].min(axis=1), high[group].max(axis=1)
        group = group[((most - least) <= limit).all(axis=1)]
        if not len(group):
            break
        kept = np.ones(len(codes), bool)
        kept[group[:, 1:].reshape(-1)] = False
        head = group[:, 0]
        sizes, values, low, high = sizes.copy(), values.copy(), low.copy(), high.copy()
        values[head], low[head], high[head] = values[group].mean(axis=1), low[group].min(axis=1), high[group].max(axis=1)
        sizes[head] = size + 1
        codes, sizes, values, low, high = (a[kept] for a in (codes, sizes, values, low, high))
    return depth, codes, sizes, values


def read_leaf(values: mi.Float, channels: int, row: mi.UInt32, on: mi.Bool) -> list[mi.Float]:
    """Values of each channel of a leaf; 0 for lanes without one."""
    mode = dr.ReduceMode.Expand if dr.backend_v(mi.Float) == dr.JitBackend.LLVM else dr.ReduceMode.Auto
    return [dr.gather(mi.Float, values, row * channels + c, on, mode=mode) for c in range(channels)]


@dataclass
class OctreeExtinction:
    """Constant leaves, grey or rgb (:class:`mivol.transport.media.extinction.ExactExtinction`).

    Attributes:
        name: ``sigma_t``, ``sigma_a`` or ``sigma_s``.
        field: the leaves.
    """

    name: str
    field: LeafField
    exact_line: ClassVar[bool] = True
    is_constant: ClassVar[bool] = False
    lattice: ClassVar[None] = None
    rough: ClassVar[None] = None

    @property
    def channels(self) -> int:
        """1 (grey) or 3 (rgb)."""
        return self.field.channels

    @property
    def values(self) -> mi.Float:
        """Values, channels fastest, without derivatives."""
        return dr.detach(self.field.values.array)

    def scaled(self, scale: mi.Float) -> mi.Float:
        return scale * self.field.values.array

    def start_gradient(self, rays: float = math.inf) -> mi.Float:
        return dr.zeros(mi.Float, self.field.leaves * self.channels)

    def fold_gradient(self, gradient: mi.Float) -> mi.Float:
        return gradient

    def integrate(self, interval: RayInterval, enough: mi.Float | None = None) -> list[mi.Float]:
        return self._sum_along(self.values, interval, enough)

    def jvp(self, tangent: mi.Float, interval: RayInterval) -> list[mi.Float]:
        return self._sum_along(tangent, interval)

    def vjp(self, gradient: mi.Float, weight: list[mi.Float], interval: RayInterval) -> None:
        def visit(state: list, leaf: VisitedLeaf, on: mi.Bool) -> list:
            self._add(gradient, [w * leaf.dt for w in weight], leaf.row, on)
            return state

        self._walk(interval, visit, [mi.Float(0)])

    def eval_at(self, scale: mi.Float, ray: Ray, t: mi.Float, active: mi.Bool) -> list[mi.Float]:
        return [dr.detach(scale) * value for value in self._read_at(self.values, ray, t, active)]

    def jvp_at(self, tangent: mi.Float, ray: Ray, t: mi.Float, active: mi.Bool) -> list[mi.Float]:
        return self._read_at(tangent, ray, t, active)

    def vjp_at(self, gradient: mi.Float, weight: list[mi.Float], ray: Ray, t: mi.Float, active: mi.Bool) -> None:
        row, on = self.field.find_rows(ray(t), active)
        self._add(gradient, weight, row, on)

    def find_collision(self, scale: mi.Float, interval: RayInterval, goal: mi.Float, channel: mi.UInt32) -> mi.Float64:
        """Distance of the point at which a ray reaches an optical depth [length]; infinite if it does not.

        Args:
            scale: factor on the values.
            interval: interval of the ray.
            goal: optical depth [1].
            channel: channel of an rgb extinction.

        Bias: none but rounding. Cost: one walk up to the point.
        """

        def visit(state: list, leaf: VisitedLeaf, on: mi.Bool) -> list:
            remaining, t, collides = state
            on &= ~collides  # the walk ends a leaf later
            rows = read_leaf(self.values, self.channels, leaf.row, on)
            sigma = scale * rows[0]
            for c, row in enumerate(rows[1:], 1):
                sigma = dr.select(channel == c, scale * row, sigma)
            own = sigma * leaf.dt
            ends = on & (sigma > 0) & (own >= remaining)
            t = dr.select(ends, leaf.t + remaining / dr.select(sigma > 0, sigma, 1), t)
            return [dr.select(on & ~ends, remaining - own, remaining), t, collides | ends]

        state = [mi.Float(goal), mi.Float(0), mi.Bool(False)]
        segment, (_, t, collides) = self._walk(interval, visit, state, lambda s: s[2])
        return dr.select(collides, segment.start + mi.Float64(t), dr.inf)

    def _walk(self, interval: RayInterval, visit: Any, state: list, until: Any = None) -> tuple[Any, list]:
        ray, index = interval.ray, self.field.index
        segment = clip_to_octree(index, ray.o, ray.d, interval.t1, interval.t0)
        state = [value + dr.zeros(type(value), dr.width(ray)) if type(value) is mi.Float else value for value in state]
        return segment, walk_leaves(index, segment, visit, state, interval.active, until)[0]

    def _sum_along(self, values: mi.Float, interval: RayInterval, enough: mi.Float | None = None) -> list[mi.Float]:
        def visit(tau: list, leaf: VisitedLeaf, on: mi.Bool) -> list:
            rows = read_leaf(values, self.channels, leaf.row, on)
            return [t + dr.select(on, row * leaf.dt, 0) for t, row in zip(tau, rows, strict=True)]

        def is_enough(tau: list) -> mi.Bool:
            reached = mi.Bool(True)
            for t in tau:
                reached &= t > enough
            return reached

        zeros = [mi.Float(0) for _ in range(self.channels)]
        return self._walk(interval, visit, zeros, None if enough is None else is_enough)[1]

    def _read_at(self, values: mi.Float, ray: Ray, t: mi.Float, active: mi.Bool) -> list[mi.Float]:
        row, on = self.field.find_rows(ray(t), active)
        return read_leaf(values, self.channels, row, on)

    def _add(self, gradient: mi.Float, weight: list[mi.Float], row: mi.UInt32, on: mi.Bool) -> None:
        mode = dr.ReduceMode.Expand if dr.backend_v(mi.Float) == dr.JitBackend.LLVM else dr.ReduceMode.Auto
        for c, w in enumerate(weight):
            dr.scatter_add(gradient, w, row * self.channels + c, on, mode=mode)
