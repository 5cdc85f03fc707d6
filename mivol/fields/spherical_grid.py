r"""A radiance field on a grid: density, and colour in spherical harmonics of the direction in which light is seen.

.. math:: c(x, \omega) = \max\Big(0,\; o + \sum_b Y_b(\omega)\, k_b(x)\Big), \qquad \sigma(x) = a\big(\rho(x)\big)

with k and rho trilinear between nodes, o the offset (0.5) and a the activation.

Conventions. Nodes are voxel centres, borders are clamped, and outside the box is vacuum, as for every grid. Directions are
those in which a camera ray travels (not those of the light), in the grid's own frame: the rotation (and mirror image) in
``to_world`` is taken off, scale and shear are not felt, so a rotated field looks as the field did. The basis is real, in the
order and with the signs of ``dr.sh_eval`` (those of PlenOctrees, Plenoxels and 3D Gaussian splatting).

Levels. A field may be nested: each level is a grid of the same nodes in a box of twice the extent about the same middle m, and
holds what lies in its box and not in that of the level before. Level l is level 0 seen from 2^l times as far: the box, the walk
through it and the size of its numbers are those of level 0,

.. math:: \sigma(x) = 2^{-l} a\big(\rho(y)\big), \qquad y = m + 2^{-l} (x - m),

so that a rate or a prior that suits one level suits all. Nodes are counted level by level.

Colours are what photographs show: code values of sRGB (``space`` is ``srgb``), which rays composite as they are. A field of
``linear`` radiance is its own light; :func:`decode_srgb_code` makes light of codes, where a scene shows a field among others.

Storage. Rows, one a node: ``density`` apart from ``harmonics``, whose rows are [basis][rgb], filled up to a multiple of 4. A
dense grid has a row for each node in Z Y X order; a sparse one lists its ``nodes`` in that order and ends in one more row, the
vacuum around them.

References: Sloan 2008, 2013 (harmonics); Yu et al. 2021, Fridovich-Keil, Yu et al. 2022 (the model); Higham 1986 (the polar
factor).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.device_arrays import aligned
from mivol.errors import MivolError
from mivol.fields.activation import Activation, select_activation
from mivol.fields.harmonics import (
    SPACES,
    basis_size,
    decode_srgb_code,
    harmonic_degree,
    local_frame,
    rotate_direction,
    row_width,
)
from mivol.fields.sparse_index import SparseIndex
from mivol.files.notebook import slices_html
from mivol.shown import briefly
from mivol.space import check_affine, lattice_from_world

__all__ = ["SphericalGrid", "is_covered_by_inner", "with_tensors", "dense_densities"]


HOMOGENEOUS = ("none", "relu")
"""Activations of nested fields: a density n times as large is an extinction n times as large."""


def is_covered_by_inner(node: mi.UInt32, res: tuple[int, int, int]) -> mi.Bool:
    """Whether nodes of nested grids of ``res`` are of no use: all cells about them lie in the box of the level before."""
    z, y, x = res
    inside = node >= math.prod(res)
    for place, n in ((node % x, x), (node // x % y, y), (node // (x * y) % z, z)):
        # The next node on either side is at most n / 4 from the middle (n - 1) / 2, where the inner box ends.
        inside &= 2 * dr.abs(2 * mi.Int32(place) - (n - 1)) <= n - 4
    return inside


@briefly
@dataclass
class SphericalGrid:
    """A field of density and directional colour.

    Attributes:
        res: nodes (Z, Y, X).
        to_world: (4, 4) float64, unit cube to world.
        degree: of the harmonics, 0 to 4.
        density: Float, raw, one a row.
        harmonics: Float, ``row_width`` numbers a row.
        nodes: UInt32, ascending flat numbers of the nodes that have a row; None where all have.
        activation: name in ``ACTIVATIONS``.
        offset: added to the sum of the harmonics.
        clamp: whether colours below 0 are shown as 0.
        levels: boxes that are nested, each of twice the extent; ``res`` and ``to_world`` are those of the innermost.
        space: what colours are: "srgb" (code values, as in photographs) or "linear" (radiance).
        index: made by :meth:`sparse_index` at its first call.
    """

    res: tuple[int, int, int]
    to_world: np.ndarray
    degree: int
    density: mi.Float
    harmonics: mi.Float
    nodes: mi.UInt32 | None = None
    activation: str = "relu"
    offset: float = 0.5
    clamp: bool = True
    levels: int = 1
    space: str = "srgb"
    index: SparseIndex | None = None

    def _repr_html_(self) -> str:
        """Three middle slices of the density, for notebooks."""
        return slices_html(np.array(self.to_dense()[0]), repr(self))

    def __post_init__(self) -> None:
        self.to_world = check_affine(self.to_world)
        if self.levels > 1 and self.activation not in HOMOGENEOUS:
            known = " or ".join(HOMOGENEOUS)
            raise MivolError(f"a nested field with the activation {self.activation} was given; {known} are expected.")
        select_activation(self.activation)
        if self.space not in SPACES:
            raise MivolError(f"the space of a field's colours is {self.space!r}; {' or '.join(SPACES)} is expected.")
        expected = self.rows
        if dr.width(self.density) != expected or dr.width(self.harmonics) != expected * self.width:
            raise MivolError(
                f"{dr.width(self.density)} densities and {dr.width(self.harmonics)} coefficients were given; "
                f"{expected} rows of 1 and {self.width} are expected."
            )

    @property
    def basis(self) -> int:
        """Number of harmonics."""
        return basis_size(self.degree)

    @property
    def width(self) -> int:
        """Numbers of a row of harmonics."""
        return row_width(self.basis)

    @property
    def rows(self) -> int:
        """Number of rows, that of the vacuum included."""
        return self.node_count if self.nodes is None else dr.width(self.nodes) + 1

    @property
    def node_count(self) -> int:
        """Number of nodes of all levels, stored or not."""
        return self.levels * math.prod(self.res)

    @property
    def shape(self) -> tuple[int, ...]:
        """Of values at all nodes: (Z, Y, X), or (levels, Z, Y, X) where the field is nested."""
        return self.res if self.levels == 1 else (self.levels, *self.res)

    @property
    def bytes(self) -> int:
        """Memory that its values take."""
        return 4 * (self.rows * (1 + self.width) + (0 if self.nodes is None else self.rows - 1))

    @property
    def activation_function(self) -> Activation:
        """The activation itself."""
        return select_activation(self.activation)

    @classmethod
    def from_dense(
        cls,
        density: np.ndarray,
        sh: np.ndarray,
        to_world: np.ndarray,
        keep: np.ndarray | None = None,
        activation: str = "relu",
        offset: float = 0.5,
        clamp: bool = True,
        space: str = "srgb",
    ) -> SphericalGrid:
        """Make a field of arrays.

        Args:
            density: (Z, Y, X) or (Z, Y, X, 1), raw.
            sh: (Z, Y, X, basis, 3).
            to_world: (4, 4) affine map of the unit cube.
            keep: (Z, Y, X) bool, the nodes to store; None for a dense field.
            activation, offset, clamp, space: as the attributes.

        Raises:
            MivolError: shapes that do not agree, a value that is not finite, or a negative one without an activation.
        """
        density, sh = np.asarray(density, np.float32), np.asarray(sh, np.float32)
        density = density[..., 0] if density.ndim == 4 and density.shape[3] == 1 else density
        if density.ndim != 3 or sh.ndim != 5 or sh.shape[:3] != density.shape or sh.shape[4] != 3 or density.size == 0:
            found = f"densities {density.shape} and harmonics {sh.shape}"
            raise MivolError(f"{found} were given; (Z, Y, X) and (Z, Y, X, basis, 3) are expected.")
        picked = slice(None) if keep is None else np.flatnonzero(keep)
        nodes = None if keep is None else mi.UInt32(picked.astype(np.uint32))
        flat = density.reshape(-1)[picked], sh.reshape(-1, *sh.shape[3:])[picked]
        return cls.from_rows(density.shape, to_world, *flat, nodes, activation, offset, clamp, space=space)

    @classmethod
    def from_rows(
        cls,
        res: tuple[int, int, int],
        to_world: np.ndarray,
        density: np.ndarray,
        sh: np.ndarray,
        nodes: mi.UInt32 | None = None,
        activation: str = "relu",
        offset: float = 0.5,
        clamp: bool = True,
        levels: int = 1,
        space: str = "srgb",
    ) -> SphericalGrid:
        """Make a field of the values (n,) and (n, basis, 3) at its nodes; a sparse one gets its row of vacuum.

        Raises:
            MivolError: as :meth:`from_dense`.
        """
        degree, act = harmonic_degree(sh.shape[1]), select_activation(activation)
        bad = ~np.isfinite(density) | ~np.isfinite(sh).all(axis=(1, 2))
        if bad.any():
            raise MivolError(f"the values at node {np.flatnonzero(bad)[0]} of the field are not finite; give finite numbers.")
        if not act.signed and (density < 0).any():
            raise MivolError(f"a density of {density.min()} was given; without an activation none may be negative: use relu.")
        width, vacuum = row_width(sh.shape[1]), nodes is not None
        rows = np.zeros((len(density) + vacuum, width), np.float32)
        rows[: len(density), : 3 * sh.shape[1]] = sh.reshape(len(density), -1)
        flat = np.append(density, np.float32(act.vacuum)) if vacuum else density
        # Dr.Jit reads NumPy's memory in place, and rows as packets only where it is aligned.
        packed = mi.Float(aligned(np.ascontiguousarray(flat))), mi.Float(aligned(rows.reshape(-1)))
        return cls(tuple(res), to_world, degree, *packed, nodes, activation, offset, clamp, levels, space)

    @classmethod
    def from_levels(cls, grids: Sequence[SphericalGrid]) -> SphericalGrid:
        """One field of grids of one level, the innermost first, each of twice the extent of the one before.

        Raises:
            MivolError: grids that differ in more than their place and values, or do not nest.
        """
        first, stored, values = grids[0], [], []
        for level, grid in enumerate(grids):
            same = ("res", "degree", "activation", "offset", "clamp", "space")
            if grid.levels != 1 or any(getattr(grid, name) != getattr(first, name) for name in same):
                raise MivolError(f"grid {level} of a nested field is of another kind than the first: give grids of one kind.")
            if not np.allclose(grid.to_world, first.level_to_world(level), rtol=0, atol=1e-9 * np.abs(grid.to_world).max()):
                found = f"grid {level} of a nested field is not 2^{level} times the first one about its middle"
                raise MivolError(f"{found}: place it so.")
            density, sh = grid.values()
            values.append((np.float32(density * 2.0**level), sh))
            stored.append(grid.stored_nodes() + level * math.prod(first.res))
        nodes = mi.UInt32(np.concatenate(stored).astype(np.uint32))
        rows = [np.concatenate(part) for part in zip(*values, strict=True)]
        how = first.activation, first.offset, first.clamp
        return cls.from_rows(first.res, first.to_world, *rows, nodes, *how, len(grids), first.space)

    def extract_level(self, number: int) -> SphericalGrid:
        """A level as a field of its own, in the whole of its box; what the level before covers is not cut out.

        Raises:
            MivolError: no such level.
        """
        if not 0 <= number < self.levels:
            raise MivolError(f"level {number} of a field of {self.levels} was asked for; count from 0, the innermost.")
        count, stored = math.prod(self.res), self.stored_nodes()
        own = np.flatnonzero(stored // count == number)
        density, sh = self.values()
        nodes = None if self.nodes is None else mi.UInt32((stored[own] % count).astype(np.uint32))
        scaled = np.float32(density[own] / 2.0**number)
        how = self.activation, self.offset, self.clamp
        return self.from_rows(self.res, self.level_to_world(number), scaled, sh[own], nodes, *how, space=self.space)

    def values(self) -> tuple[np.ndarray, np.ndarray]:
        """Raw densities (n,) and harmonics (n, basis, 3) at the nodes that have a row."""
        n = self.rows - (self.nodes is not None)
        rows = np.array(dr.detach(self.harmonics)).reshape(self.rows, self.width)
        return np.array(dr.detach(self.density))[:n], rows[:n, : 3 * self.basis].reshape(n, self.basis, 3)

    def to_dense(self) -> tuple[np.ndarray, np.ndarray]:
        """Raw densities (Z, Y, X) and harmonics (Z, Y, X, basis, 3), with the vacuum where nothing is stored.

        Raises:
            MivolError: a nested field: its levels are grids, and it is none (:meth:`level`).
        """
        if self.levels > 1:
            raise MivolError(f"a field of {self.levels} nested levels is no one grid: take one of its levels.")
        density, sh = self.values()
        if self.nodes is not None:
            where = np.array(self.nodes)
            packed = density, sh
            density = np.full(math.prod(self.res), self.activation_function.vacuum, np.float32)
            sh = np.zeros((math.prod(self.res), self.basis, 3), np.float32)
            density[where], sh[where] = packed
        return density.reshape(self.res), sh.reshape(*self.res, self.basis, 3)

    def select_nodes(self, keep: np.ndarray) -> SphericalGrid:
        """The nodes for which ``keep`` (Z, Y, X), or (levels, Z, Y, X), holds, of those that are stored."""
        stored = self.stored_nodes()
        picked = np.flatnonzero(np.asarray(keep, bool).reshape(-1)[stored])
        density, sh = self.values()
        nodes = mi.UInt32(stored[picked].astype(np.uint32))
        how = self.activation, self.offset, self.clamp, self.levels, self.space
        return self.from_rows(self.res, self.to_world, density[picked], sh[picked], nodes, *how)

    def with_degree(self, degree: int) -> SphericalGrid:
        """The same field with harmonics up to another degree: new ones are 0, dropped ones are lost."""
        if degree == self.degree:
            return self
        density, sh = self.values()
        rows = np.zeros((len(sh), basis_size(degree), 3), np.float32)
        shared = min(sh.shape[1], rows.shape[1])
        rows[:, :shared] = sh[:, :shared]
        how = self.activation, self.offset, self.clamp, self.levels, self.space
        return self.from_rows(self.res, self.to_world, density, rows, self.nodes, *how)

    def scale_colours(self, factor: float) -> SphericalGrid:
        """The same field, its colours so many times as bright."""
        if factor == 1:
            return self
        return replace(self, harmonics=self.harmonics * factor, offset=self.offset * factor)

    def stored_nodes(self) -> np.ndarray:
        """Flat numbers of the nodes that have a row, int64."""
        return np.arange(self.node_count) if self.nodes is None else np.array(self.nodes).astype(np.int64)

    def look_up_rows(self, node: mi.UInt32, active: mi.Bool = True) -> mi.UInt32:
        """The row of nodes of all levels, by their flat numbers: the vacuum's where a node is not stored.

        What it looks up is made when it is first asked (not inside a loop that is being traced).
        """
        if self.nodes is None:
            return node
        row, stored = self.sparse_index().rank(node, active)
        return dr.select(stored, row, self.rows - 1)

    def sparse_index(self) -> SparseIndex:
        """Which nodes have a row, of a sparse field: two bits a node of the box; made once."""
        if self.index is None:
            self.index = SparseIndex.from_sorted(self.nodes, self.node_count)
        return self.index

    # -- Where it lies -----------------------------------------------------------------------------------------------------

    @property
    def middle(self) -> np.ndarray:
        """(3,) of all its boxes."""
        return self.to_world[:3] @ np.array([0.5, 0.5, 0.5, 1])

    def level_to_world(self, number: int) -> np.ndarray:
        """(4, 4) float64, the unit cube to the box of a level."""
        place = self.to_world.copy()
        place[:3, :3] *= 2.0**number
        place[:3, 3] = self.middle + 2.0**number * (self.to_world[:3, 3] - self.middle)
        return place

    def local_frame(self) -> np.ndarray:
        """(3, 3) map of world directions to the grid's own frame: the inverse of the polar factor of ``to_world``."""
        return local_frame(self.to_world)

    def turn(self, d: mi.Vector3f) -> mi.Vector3f:
        """World directions in the grid's own frame."""
        return rotate_direction(self.local_frame(), d)

    def eval_basis(self, d: mi.Vector3f) -> list[mi.Float]:
        """The basis for unit directions of travel in the world."""
        return dr.sh_eval(self.turn(d), self.degree)

    def make_view_basis(self, points: np.ndarray) -> Callable[[mi.UInt32, mi.UInt32], list[mi.Float]]:
        """The basis for directions from world points (V, 3) to nodes: a function of flat node numbers and of which point."""
        z, y, x = self.res
        frame, per_level = self.local_frame(), math.prod(self.res)
        linear = frame @ self.to_world[:3, :3] / np.array([x, y, z], np.float64)
        # The middle of the boxes in the own frame, less the point: a difference in float64.
        start = (frame @ (self.middle - np.asarray(points, np.float64)).T).T
        starts = mi.Float(np.append(np.float32(start).reshape(-1), np.float32(0)))
        rows = [[dr.opaque(mi.Float, float(v)) for v in row] for row in linear]

        def basis(node: mi.UInt32, view: mi.UInt32) -> list[mi.Float]:
            inner = node % per_level
            far = mi.Float(mi.UInt32(1) << (node // per_level))
            places = (inner % x, x), (inner // x % y, y), (inner // (x * y), z)
            q = [far * (mi.Float(place) + (0.5 - 0.5 * n)) for place, n in places]
            from_point = [dr.gather(mi.Float, starts, view * 3 + a) for a in range(3)]
            d = mi.Vector3f(*(_affine(row, q, s) for row, s in zip(rows, from_point, strict=True)))
            length = dr.norm(d)
            return dr.sh_eval(dr.select(length > 0, d / length, mi.Vector3f(0, 0, 1)), self.degree)

        return basis

    def eval(self, p: mi.Point3f, d: mi.Vector3f, active: mi.Bool = True) -> tuple[mi.Float, mi.Color3f]:
        """Extinction and colour at world points, seen along unit world directions; 0 outside the box.

        Cost: 8 rows a point. Rays are followed by :mod:`mivol.transport.line_integrals.radiance_field`, which reads less.
        """
        z, y, x = self.res
        rows = [[dr.opaque(mi.Float, float(v)) for v in row] for row in lattice_from_world(self.to_world, self.res)]
        q = [_affine(row, p, row[3]) for row in rows]
        level, scale = self._level_of(q)
        middles = [0.5 * (n - 1) for n in (x, y, z)]
        q = [dr.fma(value - middle, scale, middle) for value, middle in zip(q, middles, strict=True)]
        inside = mi.Bool(active)
        pairs = []
        for value, n in zip(q, (x, y, z), strict=True):
            inside &= (value >= -0.5) & (value <= n - 0.5)
            low = dr.floor(value)
            i = mi.Int32(low)
            pairs.append([(dr.clip(i, 0, n - 1), 1 - (value - low)), (dr.clip(i + 1, 0, n - 1), value - low)])
        basis = self.eval_basis(d)
        sigma, colour = mi.Float(0), [mi.Float(self.offset)] * 3
        for k, wz in pairs[2]:
            for j, wy in pairs[1]:
                for i, wx in pairs[0]:
                    row = self.look_up_rows(mi.UInt32(((level * z + k) * y + j) * x + i), inside)
                    w = wx * wy * wz
                    sigma = dr.fma(w, dr.gather(mi.Float, self.density, row, inside), sigma)
                    held = dr.gather(mi.ArrayXf, self.harmonics, row, inside, shape=(self.width, 1))
                    for a in range(3):
                        seen = sum((held[3 * b + a] * value for b, value in enumerate(basis)), mi.Float(0))
                        colour[a] = dr.fma(w, seen, colour[a])
        if self.clamp:
            colour = [dr.maximum(c, 0) for c in colour]
        extinction, _ = self.activation_function.value_and_slope(sigma)
        return dr.select(inside, extinction * scale, 0), mi.Color3f(*(dr.select(inside, c, 0) for c in colour))

    def _level_of(self, q: list[mi.Float]) -> tuple[mi.Int32, mi.Float]:
        """The innermost level whose box holds points of the lattice, and 2^-level; the last one outside of all."""
        level = mi.Int32(0)
        for number in range(self.levels - 1):
            out = mi.Bool(False)
            for value, n in zip(q, self.res[::-1], strict=True):
                out |= dr.abs(value - 0.5 * (n - 1)) > 0.5 * n * 2**number
            level += dr.select(out, 1, 0)
        return level, 1 / mi.Float(mi.Int32(1) << level)

    def eval_radiance(self, p: mi.Point3f, d: mi.Vector3f, active: mi.Bool = True) -> mi.Color3f:
        """Radiance at world points, seen along unit world directions, whatever the colours are stored as; 0 outside the box."""
        colour = self.eval(p, d, active)[1]
        return colour if self.space == "linear" else mi.Color3f(*(decode_srgb_code(c) for c in colour))

    def with_values(self, density: mi.Float, harmonics: mi.Float) -> SphericalGrid:
        """The same nodes with other rows."""
        return replace(self, density=density, harmonics=harmonics)


def _affine(row: list[mi.Float], v: mi.Vector3f, rest: mi.Float) -> mi.Float:
    return dr.fma(row[0], v[0], dr.fma(row[1], v[1], dr.fma(row[2], v[2], rest)))


def with_tensors(field: SphericalGrid, density: mi.TensorXf, sh: mi.TensorXf) -> SphericalGrid:
    """The same field with other values; ``sh`` may have another degree.

    Raises:
        MivolError: shapes that are not those of the field.
    """
    nodes = field.shape if field.nodes is None else (dr.width(field.nodes),)
    if tuple(density.shape) != (*nodes, 1) or tuple(sh.shape[:-2]) != nodes or sh.shape[-1] != 3:
        raise MivolError(
            f"density {tuple(density.shape)} and sh {tuple(sh.shape)} were given; {(*nodes, 1)} and {(*nodes, 'basis', 3)} are "
            "expected."
        )
    basis = sh.shape[-2]
    count, width = math.prod(nodes), row_width(basis)
    vacuum = field.nodes is not None
    flat = density.array
    if vacuum:
        row = dr.arange(mi.UInt32, count + 1)
        flat = dr.select(row < count, dr.gather(mi.Float, flat, dr.minimum(row, count - 1)), field.activation_function.vacuum)
    entry = dr.arange(mi.UInt32, (count + vacuum) * width)
    row, column = entry // width, entry % width
    held = (row < count) & (column < 3 * basis)
    harmonics = dr.gather(mi.Float, sh.array, row * (3 * basis) + column, held)
    return replace(field, degree=harmonic_degree(basis), density=flat, harmonics=harmonics)


def dense_densities(field: SphericalGrid) -> list[mi.TensorXf]:
    """The raw density at every node of each level, (Z, Y, X, 1), with the vacuum where nothing is stored.

    They are those of each level in lengths of the world: 2^-l of what level l stores.
    """
    if field.nodes is None and field.levels == 1:
        return [mi.TensorXf(field.density, (*field.res, 1))]
    node = dr.arange(mi.UInt32, math.prod(field.res))
    rows = [field.look_up_rows(node + k * dr.width(node)) for k in range(field.levels)]
    parts = [dr.gather(mi.Float, field.density, row) * 2.0**-k for k, row in enumerate(rows)]
    return [mi.TensorXf(part, (*field.res, 1)) for part in parts]
