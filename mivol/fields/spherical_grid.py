r"""A radiance field on a grid: density, and colour in spherical harmonics of the viewing direction.

.. math:: c(x, \omega) = \max\Big(0,\; o + \sum_b Y_b(\omega)\, k_b(x)\Big), \qquad \sigma(x) = a\big(\rho(x)\big)

The coefficients k and the density rho are trilinear between nodes; o is the offset (0.5), a the activation.

Conventions. Nodes are voxel centres. Values are constant in the outer half voxel, and outside the box is vacuum. Directions
are directions of camera rays, not of light. They are taken in the grid's own frame: the rotation (and mirror image) of
``to_world`` is removed, scale and shear have no effect, so a rotated field keeps its look. The basis is real, in the order and
with the signs of ``dr.sh_eval``, as in PlenOctrees, Plenoxels and 3D Gaussian splatting.

Levels. The boxes of a nested field share the middle m and the number of nodes, and each has twice the extent of the one before.
A level holds the matter of the box outside the box of the level before. Level l is level 0 seen from 2^l times as far,

.. math:: \sigma(x) = 2^{-l} a\big(\rho(y)\big), \qquad y = m + 2^{-l} (x - m),

so the box, the walk and the size of stored numbers are the same for all levels, and a learning rate or a prior that suits one
level suits all. Nodes are numbered level by level.

Colours. With ``space`` "srgb" colours are sRGB code values, and rays composite the code values, as photographs show them. With
"linear" colours are radiance. A scene with other objects decodes the codes (:func:`mivol.fields.harmonics.decode_srgb_code`).

Storage. Rows, one a node: ``density``, and apart from it ``harmonics``, whose rows are [basis][rgb], padded to a multiple of 4
numbers. A dense grid has a row for each node in Z Y X order. A sparse grid lists its ``nodes`` in this order and ends in one
more row for the vacuum around them.

References: Sloan 2008, 2013 (harmonics); Yu et al. 2021, Fridovich-Keil, Yu et al. 2022 (the model).
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.display import with_short_repr
from mivol.errors import MivolError
from mivol.fields.activation import Activation, select_activation
from mivol.fields.bricks import SparseIndex
from mivol.fields.harmonics import (
    SPACES,
    basis_size,
    decode_srgb_code,
    harmonic_degree,
    local_frame,
    rotate_direction,
    row_width,
)
from mivol.files.image_files import slices_html
from mivol.kernel_recording import copy_aligned
from mivol.space import check_affine, lattice_from_world

HOMOGENEOUS = ("none", "relu")
"""Activations of nested fields: an n times larger density gives an n times larger extinction."""

SETTINGS = ("activation", "offset", "clamp", "levels", "space")


def is_covered_by_inner(node: mi.UInt32, res: tuple[int, int, int]) -> mi.Bool:
    """Whether rays need no value at nodes of nested grids, since all cells about a node lie in the box of the level before.

    Args:
        node: numbers of the nodes, of all levels.
        res: nodes (Z, Y, X) of each level.
    """
    z, y, x = res
    covered = node >= math.prod(res)
    for index, n in ((node % x, x), (node // x % y, y), (node // (x * y) % z, z)):
        # The inner box ends n / 4 from the middle (n - 1) / 2; the neighbours on both sides must lie in it.
        covered &= 2 * dr.abs(2 * mi.Int32(index) - (n - 1)) <= n - 4
    return covered


@with_short_repr
@dataclass
class SphericalGrid:
    """A grid of density and directional colour.

    Attributes:
        res: nodes (Z, Y, X).
        to_world: (4, 4) float64, unit cube to world.
        degree: degree of the harmonics, 0 to 4.
        density: Float, one raw density a row.
        harmonics: Float, ``row_width`` numbers a row.
        nodes: UInt32, ascending numbers of the stored nodes; None: a dense grid.
        activation: name in ``ACTIVATIONS``.
        offset: constant added to the sum of the harmonics.
        clamp: whether colours below 0 count as 0.
        levels: number of nested boxes, each of twice the extent; ``res`` and ``to_world`` belong to the innermost box.
        space: meaning of colours: "srgb" (code values, as in photographs) or "linear" (radiance).
        index: rows of the nodes, made by :meth:`sparse_index` at the first call.
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

    def __post_init__(self) -> None:
        self.to_world = check_affine(self.to_world)
        if self.levels > 1 and self.activation not in HOMOGENEOUS:
            known = " or ".join(HOMOGENEOUS)
            raise MivolError(f"a nested field with the activation {self.activation} was given; {known} are expected.")
        select_activation(self.activation)
        if self.space not in SPACES:
            raise MivolError(f"the space of a field's colours is {self.space!r}; {' or '.join(SPACES)} is expected.")
        self._check_rows()

    def _check_rows(self) -> None:
        expected = self.rows
        if dr.width(self.density) != expected or dr.width(self.harmonics) != expected * self.width:
            raise MivolError(
                f"{dr.width(self.density)} densities and {dr.width(self.harmonics)} coefficients were given; "
                f"{expected} rows of 1 and {self.width} are expected."
            )

    def _repr_html_(self) -> str:
        """Three middle slices of the density, for notebooks."""
        return slices_html(np.array(self.to_dense()[0]), repr(self))

    @property
    def basis(self) -> int:
        """Number of harmonics."""
        return basis_size(self.degree)

    @property
    def width(self) -> int:
        """Size of a row of harmonics."""
        return row_width(self.basis)

    @property
    def rows(self) -> int:
        """Number of rows; a sparse grid counts the row of its vacuum."""
        return self.node_count if self.nodes is None else dr.width(self.nodes) + 1

    @property
    def node_count(self) -> int:
        """Number of nodes on all levels, stored or not."""
        return self.levels * math.prod(self.res)

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of values at all nodes: (Z, Y, X), or (levels, Z, Y, X) for a nested field."""
        return self.res if self.levels == 1 else (self.levels, *self.res)

    @property
    def bytes(self) -> int:
        """Size of the values and of the list of nodes [bytes]."""
        return 4 * (self.rows * (1 + self.width) + (0 if self.nodes is None else self.rows - 1))

    @property
    def activation_function(self) -> Activation:
        """The activation."""
        return select_activation(self.activation)

    # -- From arrays and back ------------------------------------------------------------------------------------------

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
        """Make a field of a single level from arrays.

        Args:
            density: (Z, Y, X) or (Z, Y, X, 1), raw.
            sh: (Z, Y, X, basis, 3).
            to_world: (4, 4) affine map of the unit cube.
            keep: (Z, Y, X) bool, nodes to store; None: a dense grid.
            activation, offset, clamp, space: see the attributes.

        Raises:
            MivolError: shapes that disagree, a value that is not finite, or a negative density without an activation.
        """
        density, sh = np.asarray(density, np.float32), np.asarray(sh, np.float32)
        density = density[..., 0] if density.ndim == 4 and density.shape[3] == 1 else density
        if density.ndim != 3 or sh.ndim != 5 or sh.shape[:3] != density.shape or sh.shape[4] != 3 or density.size == 0:
            found = f"densities {density.shape} and harmonics {sh.shape}"
            raise MivolError(f"{found} were given; (Z, Y, X) and (Z, Y, X, basis, 3) are expected.")
        stored = slice(None) if keep is None else np.flatnonzero(keep)
        nodes = None if keep is None else mi.UInt32(stored.astype(np.uint32))
        rows = density.reshape(-1)[stored], sh.reshape(-1, *sh.shape[3:])[stored]
        return cls.from_rows(density.shape, to_world, *rows, nodes, activation, offset, clamp, space=space)

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
        """Make a field from the values (n,) and (n, basis, 3) at its stored nodes; a sparse field gets its row of vacuum.

        Raises:
            MivolError: as :meth:`from_dense`.
        """
        degree, function = harmonic_degree(sh.shape[1]), select_activation(activation)
        bad = ~np.isfinite(density) | ~np.isfinite(sh).all(axis=(1, 2))
        if bad.any():
            raise MivolError(f"the values at node {np.flatnonzero(bad)[0]} of the field are not finite; give finite numbers.")
        if not function.signed and (density < 0).any():
            raise MivolError(f"a density of {density.min()} was given; without an activation none may be negative: use relu.")
        width, vacuum = row_width(sh.shape[1]), nodes is not None
        rows = np.zeros((len(density) + vacuum, width), np.float32)
        rows[: len(density), : 3 * sh.shape[1]] = sh.reshape(len(density), 3 * sh.shape[1])
        flat = np.append(density, np.float32(function.vacuum)) if vacuum else density
        # Dr.Jit reads NumPy's memory in place, and gathers rows as packets only from aligned memory.
        packed = mi.Float(copy_aligned(np.ascontiguousarray(flat))), mi.Float(copy_aligned(rows.reshape(-1)))
        return cls(tuple(res), to_world, degree, *packed, nodes, activation, offset, clamp, levels, space)

    @classmethod
    def from_levels(cls, grids: Sequence[SphericalGrid]) -> SphericalGrid:
        """Make a nested field from grids of a single level, the innermost first, each of twice the extent of the one before.

        Raises:
            MivolError: grids that differ in more than their place and values, or do not nest.
        """
        first, nodes, values = grids[0], [], []
        for level, grid in enumerate(grids):
            shared = ("res", "degree", "activation", "offset", "clamp", "space")
            if grid.levels != 1 or any(getattr(grid, name) != getattr(first, name) for name in shared):
                raise MivolError(f"grid {level} of a nested field is of another kind than the first: give grids of one kind.")
            if not np.allclose(grid.to_world, first.level_to_world(level), rtol=0, atol=1e-9 * np.abs(grid.to_world).max()):
                found = f"grid {level} of a nested field is not 2^{level} times the first one about its middle"
                raise MivolError(f"{found}: place it so.")
            density, sh = grid.values()
            values.append((np.float32(density * 2.0**level), sh))
            nodes.append(grid.stored_nodes() + level * math.prod(first.res))
        rows = [np.concatenate(part) for part in zip(*values, strict=True)]
        return first.with_rows(*rows, mi.UInt32(np.concatenate(nodes).astype(np.uint32)), levels=len(grids))

    def with_rows(
        self, density: np.ndarray, sh: np.ndarray, nodes: mi.UInt32 | None, **changes: np.ndarray | str | float
    ) -> SphericalGrid:
        """Make a field in the same box with other rows.

        Args:
            density, sh, nodes: as :meth:`from_rows`.
            changes: other values of ``to_world``, ``activation``, ``offset``, ``clamp``, ``levels`` and ``space``.
        """
        settings = {name: getattr(self, name) for name in ("to_world", *SETTINGS)} | changes
        return self.from_rows(self.res, density=density, sh=sh, nodes=nodes, **settings)

    def extract_level(self, number: int) -> SphericalGrid:
        """A level as a field of a single level that fills its whole box; the box of the level before is not cut out.

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
        return self.with_rows(scaled, sh[own], nodes, to_world=self.level_to_world(number), levels=1)

    def values(self) -> tuple[np.ndarray, np.ndarray]:
        """Raw densities (n,) and harmonics (n, basis, 3) at the stored nodes."""
        n = self.rows - (self.nodes is not None)
        rows = np.array(dr.detach(self.harmonics)).reshape(self.rows, self.width)
        return np.array(dr.detach(self.density))[:n], rows[:n, : 3 * self.basis].reshape(n, self.basis, 3)

    def to_dense(self) -> tuple[np.ndarray, np.ndarray]:
        """Raw densities (Z, Y, X) and harmonics (Z, Y, X, basis, 3); nodes that are not stored hold the vacuum.

        Raises:
            MivolError: a nested field; :meth:`extract_level` gives one grid of it.
        """
        if self.levels > 1:
            raise MivolError(f"a field of {self.levels} nested levels is no one grid: take one of its levels.")
        density, sh = self.values()
        if self.nodes is not None:
            nodes, stored = np.array(self.nodes), (density, sh)
            density = np.full(math.prod(self.res), self.activation_function.vacuum, np.float32)
            sh = np.zeros((math.prod(self.res), self.basis, 3), np.float32)
            density[nodes], sh[nodes] = stored
        return density.reshape(self.res), sh.reshape(*self.res, self.basis, 3)

    def select_nodes(self, keep: np.ndarray) -> SphericalGrid:
        """A sparse field of the stored nodes for which ``keep`` (Z, Y, X), or (levels, Z, Y, X), holds."""
        stored = self.stored_nodes()
        kept = np.flatnonzero(np.asarray(keep, bool).reshape(-1)[stored])
        density, sh = self.values()
        return self.with_rows(density[kept], sh[kept], mi.UInt32(stored[kept].astype(np.uint32)))

    def with_degree(self, degree: int) -> SphericalGrid:
        """The field with harmonics up to another degree: new coefficients are 0, higher ones are dropped."""
        if degree == self.degree:
            return self
        density, sh = self.values()
        rows = np.zeros((len(sh), basis_size(degree), 3), np.float32)
        shared = min(sh.shape[1], rows.shape[1])
        rows[:, :shared] = sh[:, :shared]
        return self.with_rows(density, rows, self.nodes)

    def scale_colours(self, factor: float) -> SphericalGrid:
        """The field with all colours multiplied by a factor."""
        if factor == 1:
            return self
        return replace(self, harmonics=self.harmonics * factor, offset=self.offset * factor)

    def with_values(self, density: mi.Float, harmonics: mi.Float) -> SphericalGrid:
        """The field with other rows at the same nodes.

        Raises:
            MivolError: values for another number of rows.
        """
        other = copy.copy(self)  # the place and the settings are checked
        other.density, other.harmonics = density, harmonics
        other._check_rows()
        return other

    def with_tensors(self, density: mi.TensorXf, sh: mi.TensorXf) -> SphericalGrid:
        """The field with the values of two tensors, as a scene's parameters hold them; derivatives pass through.

        Args:
            density: (Z, Y, X, 1), with the levels first for a nested field; (nodes, 1) for a sparse field.
            sh: (Z, Y, X, basis, 3), with the levels first for a nested field; (nodes, basis, 3) for a sparse field. Its degree
                may differ from the field's.

        Raises:
            MivolError: other shapes.
        """
        nodes = self.shape if self.nodes is None else (dr.width(self.nodes),)
        if tuple(density.shape) != (*nodes, 1) or tuple(sh.shape[:-2]) != nodes or sh.shape[-1] != 3:
            found, expected = (tuple(density.shape), tuple(sh.shape)), ((*nodes, 1), (*nodes, "basis", 3))
            raise MivolError(f"density {found[0]} and sh {found[1]} were given; {expected[0]} and {expected[1]} are expected.")
        basis = sh.shape[-2]
        count, width = math.prod(nodes), row_width(basis)
        vacuum = self.nodes is not None
        flat = density.array
        if vacuum:
            row = dr.arange(mi.UInt32, count + 1)
            stored = dr.gather(mi.Float, flat, dr.minimum(row, count - 1))
            flat = dr.select(row < count, stored, self.activation_function.vacuum)
        entry = dr.arange(mi.UInt32, (count + vacuum) * width)
        row, column = entry // width, entry % width
        is_stored = (row < count) & (column < 3 * basis)
        harmonics = dr.gather(mi.Float, sh.array, row * (3 * basis) + column, is_stored)
        return replace(self, degree=harmonic_degree(basis), density=flat, harmonics=harmonics)

    def dense_densities(self) -> list[mi.TensorXf]:
        """Raw densities (Z, Y, X, 1) at every node of each level, with the vacuum at nodes that are not stored.

        Densities are per length of the world: 2^-l times the stored density of level l. Derivatives pass through.
        """
        if self.nodes is None and self.levels == 1:
            return [mi.TensorXf(self.density, (*self.res, 1))]
        node = dr.arange(mi.UInt32, math.prod(self.res))
        rows = [self.look_up_rows(node + k * dr.width(node)) for k in range(self.levels)]
        parts = [dr.gather(mi.Float, self.density, row) * 2.0**-k for k, row in enumerate(rows)]
        return [mi.TensorXf(part, (*self.res, 1)) for part in parts]

    # -- Rows of nodes -------------------------------------------------------------------------------------------------

    def stored_nodes(self) -> np.ndarray:
        """Numbers of the stored nodes, int64."""
        return np.arange(self.node_count) if self.nodes is None else np.array(self.nodes).astype(np.int64)

    def node_positions(self) -> np.ndarray:
        """(N, 3) positions of the stored nodes in the world, in the order of their rows."""
        z, y, x = self.res
        level, node = np.divmod(self.stored_nodes(), x * y * z)
        cell = np.stack([node % x, node // x % y, node // (x * y)], axis=1)
        places = (cell + 0.5) / (x, y, z) @ self.to_world[:3, :3].T + self.to_world[:3, 3]
        return self.middle + 2.0 ** level[:, None] * (places - self.middle)

    def look_up_rows(self, node: mi.UInt32, active: mi.Bool = True) -> mi.UInt32:
        """Rows of nodes of all levels; nodes that are not stored have the row of the vacuum.

        The first call makes the index, so it must not happen inside a traced loop.
        """
        if self.nodes is None:
            return node
        row, stored = self.sparse_index().rank(node, active)
        return dr.select(stored, row, self.rows - 1)

    def sparse_index(self) -> SparseIndex:
        """The index of the stored nodes of a sparse field: two bits a node of the box; made once."""
        if self.index is None:
            self.index = SparseIndex.from_sorted(self.nodes, self.node_count)
        return self.index

    # -- Place and directions ------------------------------------------------------------------------------------------

    @property
    def middle(self) -> np.ndarray:
        """(3,) middle of all boxes, world."""
        return self.to_world[:3] @ np.array([0.5, 0.5, 0.5, 1])

    def level_to_world(self, number: int) -> np.ndarray:
        """(4, 4) float64, unit cube to the box of a level."""
        place = self.to_world.copy()
        place[:3, :3] *= 2.0**number
        place[:3, 3] = self.middle + 2.0**number * (self.to_world[:3, 3] - self.middle)
        return place

    def eval_basis(self, d: mi.Vector3f) -> list[mi.Float]:
        """Harmonics of unit directions of travel in the world."""
        return dr.sh_eval(rotate_direction(local_frame(self.to_world), d), self.degree)

    def offsets_from(self, points: np.ndarray) -> mi.Float:
        """Offsets of the middle of the boxes from world points (V, 3), in the grid's frame, and a 0: 3 V + 1 numbers."""
        # A difference in float64.
        offsets = (local_frame(self.to_world) @ (self.middle - np.asarray(points, np.float64)).T).T
        return mi.Float(copy_aligned(np.append(np.float32(offsets).reshape(-1), np.float32(0))))

    def make_view_basis(self, offsets: mi.Float) -> Callable[[mi.UInt32, mi.UInt32], list[mi.Float]]:
        """A function of node numbers and point numbers that returns the harmonics of the directions from points to nodes.

        Args:
            offsets: of the points, from :meth:`offsets_from`.
        """
        z, y, x = self.res
        frame, per_level = local_frame(self.to_world), math.prod(self.res)
        linear = frame @ self.to_world[:3, :3] / np.array([x, y, z], np.float64)
        rows = [[dr.opaque(mi.Float, float(v)) for v in row] for row in linear]

        def basis(node: mi.UInt32, view: mi.UInt32) -> list[mi.Float]:
            inner = node % per_level
            scale = mi.Float(mi.UInt32(1) << (node // per_level))
            indices = (inner % x, x), (inner // x % y, y), (inner // (x * y), z)
            q = [scale * (mi.Float(index) + (0.5 - 0.5 * n)) for index, n in indices]
            from_point = [dr.gather(mi.Float, offsets, view * 3 + a) for a in range(3)]
            d = mi.Vector3f(*(_affine(row, q, s) for row, s in zip(rows, from_point, strict=True)))
            length = dr.norm(d)
            return dr.sh_eval(dr.select(length > 0, d / length, mi.Vector3f(0, 0, 1)), self.degree)

        return basis

    # -- Values at points ----------------------------------------------------------------------------------------------

    def eval(self, p: mi.Point3f, d: mi.Vector3f, active: mi.Bool = True) -> tuple[mi.Float, mi.Color3f]:
        """Extinction and colour at world points, seen along unit world directions; 0 outside the box.

        Cost: 8 rows a point. :mod:`mivol.transport.line_integrals.radiance_field` follows rays with fewer reads.
        """
        z, y, x = self.res
        rows = [[dr.opaque(mi.Float, float(v)) for v in row] for row in lattice_from_world(self.to_world, self.res)]
        q = [_affine(row, p, row[3]) for row in rows]
        level, scale = self._find_level(q)
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
                    coefficients = dr.gather(mi.ArrayXf, self.harmonics, row, inside, shape=(self.width, 1))
                    for a in range(3):
                        total = sum((coefficients[3 * b + a] * value for b, value in enumerate(basis)), mi.Float(0))
                        colour[a] = dr.fma(w, total, colour[a])
        if self.clamp:
            colour = [dr.maximum(c, 0) for c in colour]
        extinction, _ = self.activation_function.value_and_slope(sigma)
        return dr.select(inside, extinction * scale, 0), mi.Color3f(*(dr.select(inside, c, 0) for c in colour))

    def eval_radiance(self, p: mi.Point3f, d: mi.Vector3f, active: mi.Bool = True) -> mi.Color3f:
        """Radiance at world points, seen along unit world directions, in either colour space; 0 outside the box."""
        colour = self.eval(p, d, active)[1]
        return colour if self.space == "linear" else mi.Color3f(*(decode_srgb_code(c) for c in colour))

    def _find_level(self, q: list[mi.Float]) -> tuple[mi.Int32, mi.Float]:
        """Innermost level whose box holds lattice points (the last level outside of all boxes), and 2^-level."""
        level = mi.Int32(0)
        for number in range(self.levels - 1):
            outside = mi.Bool(False)
            for value, n in zip(q, self.res[::-1], strict=True):
                outside |= dr.abs(value - 0.5 * (n - 1)) > 0.5 * n * 2**number
            level += dr.select(outside, 1, 0)
        return level, 1 / mi.Float(mi.Int32(1) << level)


def _affine(row: list[mi.Float], v: mi.Vector3f, rest: mi.Float) -> mi.Float:
    return dr.fma(row[0], v[0], dr.fma(row[1], v[1], dr.fma(row[2], v[2], rest)))
