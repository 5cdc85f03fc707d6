r"""A radiance field on a grid: density, and colour in spherical harmonics of the direction in which light is seen.

.. math:: c(x, \omega) = \max\Big(0,\; o + \sum_b Y_b(\omega)\, k_b(x)\Big), \qquad \sigma(x) = a\big(\rho(x)\big)

with k and rho trilinear between nodes, o the offset (0.5) and a the activation.

Conventions. Nodes are voxel centres, borders are clamped, and outside the box is vacuum, as for every grid. Directions are
those in which a camera ray travels (not those of the light), in the grid's own frame: the rotation (and mirror image) in
``to_world`` is taken off, scale and shear are not felt, so a rotated field looks as the field did. The basis is real, in the
order and with the signs of ``dr.sh_eval`` (those of PlenOctrees, Plenoxels and 3D Gaussian splatting).

Storage. Rows, one a node: ``density`` apart from ``harmonics``, whose rows are [basis][rgb], filled up to a multiple of 4. A
dense grid has a row for each node in Z Y X order; a sparse one lists its ``nodes`` in that order and ends in one more row, the
vacuum around them.

References: Sloan 2008, 2013 (harmonics); Yu et al. 2021, Fridovich-Keil, Yu et al. 2022 (the model); Higham 1986 (the polar
factor).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.errors import MivolError
from mivol.fields.activation import Activation, activation_of
from mivol.files.notebook import slices_html
from mivol.shown import briefly
from mivol.space import check_affine, lattice_from_world

__all__ = ["MAX_DEGREE", "SphericalGrid", "basis_size", "degree_of", "row_width"]

MAX_DEGREE = 4


def basis_size(degree: int) -> int:
    """Number of harmonics up to a degree."""
    return (degree + 1) ** 2


def degree_of(basis: int) -> int:
    """The degree of so many harmonics.

    Raises:
        MivolError: not 1, 4, 9, 16 or 25.
    """
    degree = math.isqrt(max(basis, 0)) - 1
    if degree < 0 or degree > MAX_DEGREE or basis_size(degree) != basis:
        raise MivolError(f"{basis} harmonics were given; 1, 4, 9, 16 or 25 (degrees 0 to {MAX_DEGREE}) are expected.")
    return degree


def row_width(basis: int) -> int:
    """Numbers of a row of harmonics: 3 for each, filled up to a multiple of 4, so that rows move as packets."""
    return -(-3 * basis // 4) * 4


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
        links: the row of each node, once :meth:`node_rows` has made it.
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
    links: mi.UInt32 | None = None

    def _repr_html_(self) -> str:
        """Three middle slices of the density, for notebooks."""
        return slices_html(np.array(self.to_dense()[0]), repr(self))

    def __post_init__(self) -> None:
        self.to_world = check_affine(self.to_world)
        activation_of(self.activation)
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
        return math.prod(self.res) if self.nodes is None else dr.width(self.nodes) + 1

    @property
    def bytes(self) -> int:
        """Memory that its values take."""
        return 4 * (self.rows * (1 + self.width) + (0 if self.nodes is None else self.rows - 1))

    @property
    def act(self) -> Activation:
        """The activation itself."""
        return activation_of(self.activation)

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
    ) -> SphericalGrid:
        """Make a field of arrays.

        Args:
            density: (Z, Y, X) or (Z, Y, X, 1), raw.
            sh: (Z, Y, X, basis, 3).
            to_world: (4, 4) affine map of the unit cube.
            keep: (Z, Y, X) bool, the nodes to store; None for a dense field.
            activation, offset, clamp: as the attributes.

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
        return cls.from_rows(density.shape, to_world, *flat, nodes, activation, offset, clamp)

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
    ) -> SphericalGrid:
        """Make a field of the values (n,) and (n, basis, 3) at its nodes; a sparse one gets its row of vacuum.

        Raises:
            MivolError: as :meth:`from_dense`.
        """
        degree, act = degree_of(sh.shape[1]), activation_of(activation)
        bad = ~np.isfinite(density) | ~np.isfinite(sh).all(axis=(1, 2))
        if bad.any():
            raise MivolError(f"the values at node {np.flatnonzero(bad)[0]} of the field are not finite; give finite numbers.")
        if not act.signed and (density < 0).any():
            raise MivolError(f"a density of {density.min()} was given; without an activation none may be negative: use relu.")
        width, vacuum = row_width(sh.shape[1]), nodes is not None
        rows = np.zeros((len(density) + vacuum, width), np.float32)
        rows[: len(density), : 3 * sh.shape[1]] = sh.reshape(len(density), -1)
        flat = np.append(density, np.float32(act.vacuum)) if vacuum else density
        packed = mi.Float(np.ascontiguousarray(flat)), mi.Float(rows.reshape(-1))
        return cls(tuple(res), to_world, degree, *packed, nodes, activation, offset, clamp)

    def values(self) -> tuple[np.ndarray, np.ndarray]:
        """Raw densities (n,) and harmonics (n, basis, 3) at the nodes that have a row."""
        n = self.rows - (self.nodes is not None)
        rows = np.array(dr.detach(self.harmonics)).reshape(self.rows, self.width)
        return np.array(dr.detach(self.density))[:n], rows[:n, : 3 * self.basis].reshape(n, self.basis, 3)

    def to_dense(self) -> tuple[np.ndarray, np.ndarray]:
        """Raw densities (Z, Y, X) and harmonics (Z, Y, X, basis, 3), with the vacuum where nothing is stored."""
        density, sh = self.values()
        if self.nodes is not None:
            where = np.array(self.nodes)
            packed = density, sh
            density = np.full(math.prod(self.res), self.act.vacuum, np.float32)
            sh = np.zeros((math.prod(self.res), self.basis, 3), np.float32)
            density[where], sh[where] = packed
        return density.reshape(self.res), sh.reshape(*self.res, self.basis, 3)

    def sparse(self, keep: np.ndarray) -> SphericalGrid:
        """The nodes for which ``keep`` (Z, Y, X) holds, of those that are stored."""
        stored = self.listed()
        picked = np.flatnonzero(np.asarray(keep, bool).reshape(-1)[stored])
        density, sh = self.values()
        nodes = mi.UInt32(stored[picked].astype(np.uint32))
        return self.from_rows(
            self.res, self.to_world, density[picked], sh[picked], nodes, self.activation, self.offset, self.clamp
        )

    def with_degree(self, degree: int) -> SphericalGrid:
        """The same field with harmonics up to another degree: new ones are 0, dropped ones are lost."""
        if degree == self.degree:
            return self
        density, sh = self.values()
        rows = np.zeros((len(sh), basis_size(degree), 3), np.float32)
        shared = min(sh.shape[1], rows.shape[1])
        rows[:, :shared] = sh[:, :shared]
        return self.from_rows(self.res, self.to_world, density, rows, self.nodes, self.activation, self.offset, self.clamp)

    def listed(self) -> np.ndarray:
        """Flat numbers of the nodes that have a row, int64."""
        return np.arange(math.prod(self.res)) if self.nodes is None else np.array(self.nodes).astype(np.int64)

    def node_rows(self) -> mi.UInt32:
        """The row of each node of the grid, flat; made once (not inside a loop that is being traced)."""
        if self.links is None:
            self.links = dr.arange(mi.UInt32, math.prod(self.res))
            if self.nodes is not None:
                self.links = dr.full(mi.UInt32, self.rows - 1, math.prod(self.res))
                dr.scatter(self.links, dr.arange(mi.UInt32, self.rows - 1), self.nodes)
            dr.eval(self.links)
        return self.links

    # -- Where it lies -----------------------------------------------------------------------------------------------------

    def own_frame(self) -> np.ndarray:
        """(3, 3) map of world directions to the grid's own frame: the inverse of the polar factor of ``to_world``."""
        left, _, right = np.linalg.svd(self.to_world[:3, :3])
        return (left @ right).T

    def turn(self, d: mi.Vector3f) -> mi.Vector3f:
        """World directions in the grid's own frame."""
        rows = [[dr.opaque(mi.Float, float(v)) for v in row] for row in self.own_frame()]
        return mi.Vector3f(*(dr.fma(r[0], d.x, dr.fma(r[1], d.y, r[2] * d.z)) for r in rows))

    def harmonics_of(self, d: mi.Vector3f) -> list[mi.Float]:
        """The basis for unit directions of travel in the world."""
        return dr.sh_eval(self.turn(d), self.degree)

    def viewer(self, points: np.ndarray) -> Callable[[mi.UInt32, mi.UInt32], list[mi.Float]]:
        """The basis for directions from world points (V, 3) to nodes: a function of flat node numbers and of which point."""
        z, y, x = self.res
        frame = self.own_frame()
        linear = frame @ self.to_world[:3, :3] / np.array([x, y, z], np.float64)
        # The corner of the box in the own frame, less the point: a difference in float64.
        start = (frame @ (self.to_world[:3, 3] - np.asarray(points, np.float64)).T).T
        starts = mi.Float(np.append(np.float32(start).reshape(-1), np.float32(0)))
        rows = [[dr.opaque(mi.Float, float(v)) for v in row] for row in linear]

        def basis(node: mi.UInt32, view: mi.UInt32) -> list[mi.Float]:
            q = [mi.Float(node % x) + 0.5, mi.Float(node // x % y) + 0.5, mi.Float(node // (x * y)) + 0.5]
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
        inside = mi.Bool(active)
        pairs = []
        for value, n in zip(q, (x, y, z), strict=True):
            inside &= (value >= -0.5) & (value <= n - 0.5)
            low = dr.floor(value)
            i = mi.Int32(low)
            pairs.append([(dr.clip(i, 0, n - 1), 1 - (value - low)), (dr.clip(i + 1, 0, n - 1), value - low)])
        rows, basis = self.node_rows(), self.harmonics_of(d)
        sigma, colour = mi.Float(0), [mi.Float(self.offset)] * 3
        for k, wz in pairs[2]:
            for j, wy in pairs[1]:
                for i, wx in pairs[0]:
                    row = dr.gather(mi.UInt32, rows, mi.UInt32((k * y + j) * x + i), inside)
                    w = wx * wy * wz
                    sigma = dr.fma(w, dr.gather(mi.Float, self.density, row, inside), sigma)
                    held = dr.gather(mi.ArrayXf, self.harmonics, row, inside, shape=(self.width, 1))
                    for a in range(3):
                        seen = sum((held[3 * b + a] * value for b, value in enumerate(basis)), mi.Float(0))
                        colour[a] = dr.fma(w, seen, colour[a])
        if self.clamp:
            colour = [dr.maximum(c, 0) for c in colour]
        extinction, _ = self.act.value_and_slope(sigma)
        return dr.select(inside, extinction, 0), mi.Color3f(*(dr.select(inside, c, 0) for c in colour))

    def with_values(self, density: mi.Float, harmonics: mi.Float) -> SphericalGrid:
        """The same nodes with other rows."""
        return replace(self, density=density, harmonics=harmonics)


def _affine(row: list[mi.Float], v: mi.Vector3f, rest: mi.Float) -> mi.Float:
    return dr.fma(row[0], v[0], dr.fma(row[1], v[1], dr.fma(row[2], v[2], rest)))
