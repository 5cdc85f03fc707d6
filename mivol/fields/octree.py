r"""A radiance field in an octree: leaves of constant extinction and of colour in spherical harmonics.

.. math:: \sigma(x) = \sigma_i, \qquad c(x, \omega) = h\Big(o + \sum_b Y_b(\omega)\, k_{ib}\Big) \qquad \text{in leaf } i

The map h is max(0, .) or the sigmoid (PlenOctrees), and o is the offset. A leaf holds its extinction (at least 0), without an
activation.

Conventions. ``to_world`` maps the unit cube to the world, and the cube is divided into 2^depth cells along each axis. A leaf is
the cube of 2^(3 size) cells that begins at its *code*: the number of its first cell, with the bits of x, y and z interleaved
(x lowest). Leaves are stored in ascending order of their codes, which is the order of a depth-first traversal; everything else
is vacuum. The inner nodes of the tree follow from the leaves. Directions and bases are those of
:mod:`mivol.fields.spherical_grid`.

References: Gargantini 1982 (linear octrees); Morton 1966 (interleaved bits); Yu et al. 2021 (PlenOctrees: the model).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.back_end import check_memory
from mivol.display import with_short_repr
from mivol.errors import MivolError
from mivol.fields.harmonics import SPACES, basis_size, harmonic_degree, local_frame, rotate_direction, row_width
from mivol.fields.spherical_grid import SphericalGrid
from mivol.kernel_recording import copy_aligned
from mivol.space import check_affine

__all__ = ["COLOUR_MAPS", "MAX_DEPTH", "MAX_LEAVES", "Octree", "interleave", "separate"]

MAX_DEPTH = 12
"""Largest depth: 4096 cells along an axis."""

MAX_LEAVES = 2**27 - 4096
"""Largest number of leaves: an entry of the walk has 27 bits for a row and for the distances of vacuum."""

COLOUR_MAPS = ("clamp", "sigmoid")
"""Maps from sums of harmonics to colours: max(0, .), as for grids and Gaussians, and 1 / (1 + exp(-.)), as for PlenOctrees."""

SETTINGS = ("to_world", "colours", "offset", "space")


@with_short_repr
@dataclass
class Octree:
    """Leaves of constant extinction and directional colour.

    Attributes:
        depth: levels below the root, 0 to ``MAX_DEPTH``.
        to_world: (4, 4) float64, unit cube to world.
        degree: degree of the harmonics, 0 to 4.
        codes: (n,) uint64, ascending; first cell of each leaf.
        sizes: (n,) uint8, base-2 logarithm of the edge of each leaf [cells].
        density: Float (n,), extinction of each leaf [1/length], at least 0.
        harmonics: Float, ``row_width`` numbers a leaf, [basis][rgb].
        colours: map of ``COLOUR_MAPS``.
        offset: constant added to the sum of the harmonics.
        space: meaning of colours: "srgb" (code values, as in photographs) or "linear" (radiance).

    Raises:
        MivolError: a depth out of range, leaves that overlap or leave the cube, none or too many, or arrays of other sizes.
    """

    depth: int
    to_world: np.ndarray
    degree: int
    codes: np.ndarray
    sizes: np.ndarray
    density: mi.Float
    harmonics: mi.Float
    colours: str = "clamp"
    offset: float = 0.5
    space: str = "srgb"

    def __post_init__(self) -> None:
        self.to_world = check_affine(self.to_world)
        check_depth(self.depth)
        if self.colours not in COLOUR_MAPS or self.space not in SPACES:
            raise MivolError(
                f"an octree with colours {self.colours!r} in the space {self.space!r} was given; "
                f"{' or '.join(COLOUR_MAPS)} and {' or '.join(SPACES)} are expected: give those."
            )
        n = len(self.codes)
        if not 1 <= n <= MAX_LEAVES:
            raise MivolError(f"an octree of {n} leaves was given; 1 to {MAX_LEAVES} are expected: choose a smaller depth.")
        if len(self.sizes) != n or dr.width(self.density) != n or dr.width(self.harmonics) != n * self.width:
            found = f"{len(self.sizes)} sizes, {dr.width(self.density)} densities and {dr.width(self.harmonics)} coefficients"
            raise MivolError(f"{found} were given for {n} leaves; 1, 1 and {self.width} a leaf are expected.")
        self._check_places()

    def _check_places(self) -> None:
        """Refuse leaves that overlap, lie outside the cube or do not begin at a multiple of their size."""
        if int(self.sizes.max()) > self.depth:
            raise MivolError(
                f"a leaf of size 2^{self.sizes.max()} was given in an octree of depth {self.depth}: build it again."
            )
        volume = cells_of(self.sizes)
        ends = self.codes + volume
        if (self.codes % volume).any() or (ends[:-1] > self.codes[1:]).any() or int(ends[-1]) > 8**self.depth:
            raise MivolError("the leaves of an octree overlap, are out of order or leave its cube: build it again.")

    @classmethod
    def from_rows(
        cls, depth: int, to_world: np.ndarray, codes: np.ndarray, sizes: np.ndarray, density: np.ndarray, sh: np.ndarray,
        colours: str = "clamp", offset: float = 0.5, space: str = "srgb",
    ) -> Octree:  # fmt: skip
        """Make an octree from arrays.

        Args:
            depth, to_world, codes, sizes, colours, offset, space: see the attributes.
            density: (n,) extinctions [1/length].
            sh: (n, basis, 3).

        Raises:
            MivolError: as :class:`Octree`, a value that is not finite, or a negative extinction.
        """
        density, sh = np.asarray(density, np.float32), np.asarray(sh, np.float32)
        degree = harmonic_degree(sh.shape[1])
        bad = ~np.isfinite(density) | ~np.isfinite(sh).all(axis=(1, 2))
        if bad.any():
            raise MivolError(f"the values of leaf {np.flatnonzero(bad)[0]} of an octree are not finite: give finite numbers.")
        if (density < 0).any():
            raise MivolError(f"an octree with an extinction of {density.min():g} was given; numbers from 0 are expected.")
        rows = np.zeros((len(sh), row_width(sh.shape[1])), np.float32)
        rows[:, : 3 * sh.shape[1]] = sh.reshape(len(sh), -1)
        packed = mi.Float(copy_aligned(np.ascontiguousarray(density))), mi.Float(copy_aligned(rows.reshape(-1)))
        topology = np.asarray(codes, np.uint64), np.asarray(sizes, np.uint8)
        return cls(depth, to_world, degree, *topology, *packed, colours, offset, space)

    @property
    def leaves(self) -> int:
        """Number of leaves."""
        return len(self.codes)

    @property
    def basis(self) -> int:
        """Number of harmonics."""
        return basis_size(self.degree)

    @property
    def width(self) -> int:
        """Size of a row of harmonics."""
        return row_width(self.basis)

    @property
    def bytes(self) -> int:
        """Size of the leaves in memory [bytes]: values, codes and sizes."""
        return self.leaves * (4 * (1 + self.width) + 9)

    @property
    def middle(self) -> np.ndarray:
        """(3,) middle of the cube, world."""
        return self.to_world[:3] @ np.array([0.5, 0.5, 0.5, 1])

    @property
    def cell(self) -> float:
        """Edge of a cell: the cube root of its volume [length]."""
        return float(abs(np.linalg.det(self.to_world[:3, :3])) ** (1 / 3)) / 2**self.depth

    def corners(self) -> np.ndarray:
        """(n, 3) first cell of each leaf along x, y, z, int64."""
        return separate(self.codes, self.depth)

    def middles(self) -> np.ndarray:
        """(n, 3) middle of each leaf in the unit cube, float64."""
        return (self.corners() + 0.5 * edges_of(self.sizes)[:, None]) / 2**self.depth

    def values(self) -> tuple[np.ndarray, np.ndarray]:
        """Extinctions (n,) and harmonics (n, basis, 3)."""
        rows = np.array(dr.detach(self.harmonics)).reshape(self.leaves, self.width)
        return np.array(dr.detach(self.density)), rows[:, : 3 * self.basis].reshape(self.leaves, self.basis, 3)

    def with_values(self, density: mi.Float, harmonics: mi.Float) -> Octree:
        """The octree with other values in the same leaves."""
        return replace(self, density=density, harmonics=harmonics)

    def scale_colours(self, factor: float) -> Octree:
        """The octree with all colours multiplied by a factor.

        Raises:
            MivolError: a factor other than 1 and colours of a sigmoid, which stay below 1.
        """
        if factor == 1:
            return self
        if self.colours == "sigmoid":
            raise MivolError(f"colours of a sigmoid cannot be multiplied by {factor:g}: use an octree with colours clamp.")
        return replace(self, harmonics=self.harmonics * factor, offset=self.offset * factor)

    def select(self, keep: np.ndarray) -> Octree:
        """The octree with only the leaves (n,) bool, or in the ascending order of indices.

        Raises:
            MivolError: no leaf is left.
        """
        density, sh = self.values()
        return self.with_leaves(self.codes[keep], self.sizes[keep], density[keep], sh[keep])

    def with_leaves(self, codes: np.ndarray, sizes: np.ndarray, density: np.ndarray, sh: np.ndarray) -> Octree:
        """The octree with other leaves in the same cube, in the order of their codes."""
        settings = {name: getattr(self, name) for name in SETTINGS}
        return self.from_rows(self.depth, codes=codes, sizes=sizes, density=density, sh=sh, **settings)

    def with_colours(self, colours: str) -> Octree:
        """The octree with another map of colours, fitted to the present colours by least squares over all directions.

        Colours of a sigmoid stay between 0 and 1: present colours are cut to ``CODE_RANGE`` first.
        """
        if colours == self.colours:
            return self
        basis = _spread_basis(self.degree)
        inverse = np.linalg.pinv(basis)
        density, sh = self.values()
        made = np.empty_like(sh)
        for start in range(0, self.leaves, BATCH):
            sums = np.einsum("db,nbk->ndk", basis, sh[start : start + BATCH]) + self.offset
            if colours == "sigmoid":
                codes = np.clip(sums, *CODE_RANGE)
                wanted = np.log(codes / (1 - codes))
            else:
                wanted = 1 / (1 + np.exp(-sums)) - 0.5
            made[start : start + BATCH] = np.einsum("bd,ndk->nbk", inverse, wanted)
        settings = {"colours": colours, "offset": 0.0 if colours == "sigmoid" else 0.5, "space": self.space}
        return self.from_rows(self.depth, self.to_world, self.codes, self.sizes, density, made, **settings)

    def local_rotation(self) -> np.ndarray:
        """(3, 3) map of world directions to the frame of the harmonics."""
        return local_frame(self.to_world)

    def eval_basis(self, d: mi.Vector3f) -> list[mi.Float]:
        """Harmonics of unit directions of travel in the world."""
        return dr.sh_eval(rotate_direction(self.local_rotation(), d), self.degree)

    def map_colours(self, sums: list[mi.Float]) -> list[mi.Float]:
        """Colours of sums of harmonics with their offset."""
        if self.colours == "clamp":
            return [dr.maximum(s, 0) for s in sums]
        return [dr.rcp(1 + dr.exp(-s)) for s in sums]

    def colour_slopes(self, colours: list[mi.Float]) -> list[mi.Float]:
        """Derivatives of :meth:`map_colours`, from the colours."""
        if self.colours == "clamp":
            return [dr.select(c > 0, mi.Float(1), 0) for c in colours]
        return [c * (1 - c) for c in colours]

    # -- Grids ---------------------------------------------------------------------------------------------------------

    def to_grid(self) -> SphericalGrid:
        """The field as a sparse grid with a node in the middle of each smallest cell, trilinear between the nodes.

        Large leaves become many nodes. Constant leaves become ramps of a cell's width, so views change a little.

        Raises:
            MivolError: too many nodes.
        """
        if self.colours == "sigmoid":
            return self.with_colours("clamp").to_grid()
        smallest = int(self.sizes.min())
        counts = cells_of(self.sizes - smallest).astype(np.int64)
        if counts.sum() > MAX_LEAVES:
            raise MivolError(
                f"an octree of {counts.sum()} cells would be a grid of as many nodes; at most {MAX_LEAVES} are expected: "
                "keep it as an octree."
            )
        needed = int(counts.sum()) * (PLACE_BYTES + 3 * 4 * 3 * self.basis)  # three copies of the coefficients
        on_gpu = int(counts.sum()) * 4 * (2 + 3 * self.basis)  # row, density and coefficients of a node
        check_memory(needed, f"a grid of an octree of {counts.sum()} cells", "keep it as an octree", on_gpu=on_gpu)
        owner = np.repeat(np.arange(self.leaves), counts)
        within = np.arange(len(owner)) - np.repeat(np.cumsum(counts) - counts, counts)
        first = self.codes >> np.uint64(3 * smallest)
        place = separate(first[owner] + within.astype(np.uint64), self.depth - smallest)
        lowest, highest = place.min(axis=0), place.max(axis=0) + 1
        n = highest - lowest
        number = ((place[:, 2] - lowest[2]) * n[1] + place[:, 1] - lowest[1]) * n[0] + place[:, 0] - lowest[0]
        if np.prod(n, dtype=np.float64) >= 2**31:
            raise MivolError(
                f"an octree over {' x '.join(map(str, n))} cells is too large for a grid; at most 2^31 are expected: keep it."
            )
        order = np.argsort(number)
        density, sh = self.values()
        cells = 2 ** (self.depth - smallest)
        box = np.diag([*(n / cells), 1.0])
        box[:3, 3] = lowest / cells
        rows = density[owner[order]], sh[owner[order]]
        nodes = mi.UInt32(number[order].astype(np.uint32))
        res = (int(n[2]), int(n[1]), int(n[0]))
        return SphericalGrid.from_rows(res, self.to_world @ box, *rows, nodes, "relu", self.offset, space=self.space)


PLACE_BYTES = 80
"""Memory of a node's place while a grid is made [bytes]: its leaf, cell and order."""

CODE_RANGE = 1 / 512, 511 / 512
"""Colours that a sigmoid shows without coefficients of more than 6.2: half a step of 8 bits from black and white."""

DIRECTIONS = 64
"""Directions of a fit of colours, from a Fibonacci lattice."""

BATCH = 1 << 16
"""Leaves of a fit of colours at a time."""


def _spread_basis(degree: int) -> np.ndarray:
    """Harmonics (directions, basis) of evenly spread directions."""
    height = 1 - (2 * np.arange(DIRECTIONS) + 1) / DIRECTIONS
    turn, flat = math.pi * (3 - math.sqrt(5)) * np.arange(DIRECTIONS), np.sqrt(1 - height**2)
    d = mi.Vector3f(*(mi.Float(np.float32(v)) for v in (flat * np.cos(turn), flat * np.sin(turn), height)))
    return np.stack([np.broadcast_to(np.array(y), DIRECTIONS) for y in dr.sh_eval(d, degree)], axis=1).astype(np.float64)


def check_depth(depth: int) -> None:
    """Refuse a depth beyond 0 to ``MAX_DEPTH``."""
    if not 0 <= depth <= MAX_DEPTH:
        raise MivolError(f"an octree of depth {depth} was given; 0 to {MAX_DEPTH} are expected: choose fewer levels.")


def cells_of(sizes: np.ndarray) -> np.ndarray:
    """Cells in leaves, uint64, from the logarithms of their edges."""
    return np.uint64(1) << (np.uint64(3) * sizes.astype(np.uint64))


def edges_of(sizes: np.ndarray) -> np.ndarray:
    """Edges of leaves [cells], int64, from their logarithms."""
    return np.int64(1) << sizes.astype(np.int64)


def interleave(cells: np.ndarray, bits: int) -> np.ndarray:
    """Codes (n,), uint64, of cells (n, 3) along x, y, z with ``bits`` bits each."""
    code = np.zeros(len(cells), np.uint64)
    for bit in range(bits):
        for axis in range(3):
            code |= (cells[:, axis].astype(np.uint64) >> np.uint64(bit) & np.uint64(1)) << np.uint64(3 * bit + axis)
    return code


def separate(codes: np.ndarray, bits: int) -> np.ndarray:
    """Cells (n, 3), int64, of codes: the inverse of :func:`interleave`."""
    cells = np.zeros((len(codes), 3), np.int64)
    for bit in range(bits):
        for axis in range(3):
            cells[:, axis] |= (codes >> np.uint64(3 * bit + axis) & np.uint64(1)).astype(np.int64) << bit
    return cells
