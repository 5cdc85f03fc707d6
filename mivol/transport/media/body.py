"""One medium in its boundary: its extinction at a point and along a segment, with derivatives in both directions."""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi

from mivol.transport.media.box import Box
from mivol.transport.media.channels import as_rows, for_part
from mivol.transport.media.grid_integral import (
    Gradient,
    backproject_activated,
    backproject_segment,
    integrate_activated,
    integrate_segment,
)
from mivol.transport.media.medium_view import MediumView, Part
from mivol.transport.media.summed_extinction import SummedExtinction, share_cells
from mivol.transport.traversal.grid_walk import box_nodes
from mivol.transport.traversal.interpolation import interpolate, upward_frac, weights
from mivol.transport.traversal.lattice import clip, locate

__all__ = ["Body", "flight_parts", "is_followed", "part_values"]


class Body:
    """One medium in its boundary.

    Attributes:
        view: the medium's extinction.
        box: the boundary, where it is a box; None where it has to be traced.
        flight_parts: the parts that free flights are drawn from in one walk: constants, and grids that share their cells.
        cuts_grids: whether the boundary is smaller than what lies in it, so that stretches must be cut to it.
    """

    def __init__(self, view: MediumView, box: Box | None) -> None:
        self.view, self.box = view, box
        self.cuts_grids = box is not None and (
            view.emission_density is not None or not all(_fits(part, box) for part in view.parts)
        )
        self.rows = box.rows() if box is not None else None
        self.flight_parts = flight_parts(view.parts)
        self.gradients: list[Gradient | mi.Float] = []
        self.tangents: list[mi.Float] = []
        self.microflakes_gradient: mi.Float | None = None
        self.microflakes_tangent: list[mi.Float] | None = None

    def area(self, d: mi.Vector3f) -> mi.Float | float:
        """Factor on the extinction for light that travels along ``d``: the projected area of flakes, else 1."""
        if self.view.microflakes is None:
            return 1.0
        return dr.safe_sqrt(dr.dot(d, self.facing(d)))

    def facing(self, d: mi.Vector3f) -> mi.Vector3f:
        """The matrix of the flakes times a direction: half the gradient of the squared area."""
        xx, yy, zz, xy, xz, yz = dr.detach(self.view.microflakes)
        return mi.Vector3f(xx * d.x + xy * d.y + xz * d.z, xy * d.x + yy * d.y + yz * d.z, xz * d.x + yz * d.y + zz * d.z)

    def _area_slopes(self, d: mi.Vector3f) -> list[mi.Float]:
        """Derivative of the logarithm of the area by each number of the matrix: of it, extinction is a multiple."""
        square = dr.dot(d, self.facing(d))
        half = dr.select(square > 0, 0.5 * dr.rcp(dr.select(square > 0, square, 1)), 0)
        twice = 2 * half
        return [half * d.x * d.x, half * d.y * d.y, half * d.z * d.z, twice * d.x * d.y, twice * d.x * d.z, twice * d.y * d.z]

    def _vjp_microflakes(self, d: mi.Vector3f, weight: list[mi.Float], amount: list[mi.Float], active: mi.Bool) -> None:
        """Add ``weight`` (d loss / d amount) to the gradient of the matrix, for amounts in proportion to the area."""
        change = sum((dr.select(w != 0, w * a, 0) for w, a in zip(weight, amount, strict=True)), mi.Float(0))
        for k, slope in enumerate(self._area_slopes(d)):
            dr.scatter_add(self.microflakes_gradient, change * slope, mi.UInt32(k), active)

    def _jvp_microflakes(self, d: mi.Vector3f) -> mi.Float:
        """Tangent of the logarithm of the area."""
        return sum((s * t for s, t in zip(self._area_slopes(d), self.microflakes_tangent, strict=True)), mi.Float(0))

    def extinction(self, ray: mi.Ray3f, parts: list[Part] | None = None) -> SummedExtinction:
        """The sum of parts (all of them, unless told which), which share their cells, along a ray, without derivatives."""
        parts = self.view.parts if parts is None else parts
        return SummedExtinction(
            parts, [dr.detach(part_values(p)) for p in parts], dr.detach(self.view.scale) * self.area(ray.d)
        )

    def optical_depth(
        self,
        ray: mi.Ray3f,
        t0: mi.Float,
        t1: mi.Float,
        channels: int,
        active: mi.Bool,
        parts: list[Part] | None = None,
        enough: float | None = None,
    ) -> list[mi.Float]:
        """Optical depth [1] of each channel over a stretch, of all parts unless told which; a grid may stop at ``enough``."""
        parts = self.view.parts if parts is None else parts
        pairs = [(p, dr.detach(part_values(p))) for p in parts]
        scale = dr.detach(self.view.scale) * self.area(ray.d)
        bound = None if enough is None else enough / scale
        return [scale * tau for tau in self._sum(ray, t0, t1, channels, active, pairs, True, bound)]

    def tangent(self, ray: mi.Ray3f, t0: mi.Float, t1: mi.Float, channels: int, active: mi.Bool) -> list[mi.Float]:
        """Derivative of the optical depth along the tangent that :meth:`World.start_tangent` took from the parameters."""
        pairs = list(zip(self.view.parts, self.tangents, strict=True))
        area = self.area(ray.d)
        rows = [area * change for change in self._sum(ray, t0, t1, channels, active, pairs, False)]
        if self.microflakes_tangent is None:
            return rows
        turned = self._jvp_microflakes(ray.d)
        return [r + t * turned for r, t in zip(rows, self.optical_depth(ray, t0, t1, channels, active), strict=True)]

    def _sum(
        self,
        ray: mi.Ray3f,
        t0: mi.Float,
        t1: mi.Float,
        channels: int,
        active: mi.Bool,
        pairs: list[tuple],
        skip: bool,
        enough: mi.Float | None = None,
    ) -> list[mi.Float]:
        """Integrate the values that come with each part in its place."""
        total = [mi.Float(0) for _ in range(channels)]
        for part, value in pairs:
            if part.lattice is None:
                length = _length(t0, t1, active) if skip else _ending(_length(t0, t1, active))
                # A ray that never leaves a medium has infinite length: 0 * inf would be NaN.
                # (A grey value is taken whole: the index of a Dr.Jit array reads it, and bakes it into the kernel.)
                each = [value] if part.channels == 1 else [value.x, value.y, value.z]
                rows = [dr.select(v != 0, v * length, 0) for v in each]
            else:
                lattice = part.lattice if skip else replace(part.lattice, empty_distances=None)
                segment = clip(lattice, ray.o, ray.d, t0, t1)
                if part.activation is None:
                    rows = integrate_segment(lattice, value, segment, active, enough)
                else:
                    tangent = None if skip else value
                    values = dr.detach(part_values(part))
                    rows = integrate_activated(lattice, values, part.activation, segment, active, enough, tangent)
            total = [t + r for t, r in zip(total, as_rows(rows, channels), strict=True)]
        return total

    def backproject(self, ray: mi.Ray3f, t0: mi.Float, t1: mi.Float, weight: list[mi.Float], active: mi.Bool) -> None:
        """Add ``weight`` (d loss / d tau of each channel) times this stretch to the gradients of the parts."""
        if self.microflakes_gradient is not None:
            self._vjp_microflakes(ray.d, weight, self.optical_depth(ray, t0, t1, len(weight), active), active)
        weight = [self.area(ray.d) * w for w in weight]
        for part, gradient in zip(self.view.parts, self.gradients, strict=True):
            w = for_part(weight, part.channels)
            if part.lattice is None:
                length = _ending(_length(t0, t1, active))
                for c in range(part.channels):
                    dr.scatter_add(gradient, dr.select(w[c] != 0, w[c] * length, 0), mi.UInt32(c), active)
                continue
            segment = clip(part.lattice, ray.o, ray.d, t0, t1)
            if part.activation is None:
                backproject_segment(part.lattice, gradient, w, segment, active)
            else:
                values = dr.detach(part_values(part))
                backproject_activated(part.lattice, values, part.activation, gradient, w[0], segment, active)

    def extinction_at(self, ray: mi.Ray3f, t: mi.Float, channels: int, active: mi.Bool, name: str = "sigma_") -> list[mi.Float]:
        """Coefficient [1/length] of each channel at a point of a ray: of all parts, or of those called ``name``."""
        parts = [p for p in self.view.parts if p.name.startswith(name)]
        return self._at(ray, t, channels, active, [(p, self.view.scale * part_values(p)) for p in parts], activated=True)

    def tangent_at(self, ray: mi.Ray3f, t: mi.Float, channels: int, active: mi.Bool, name: str = "sigma_") -> list[mi.Float]:
        """As :meth:`extinction_at`, of the tangent that :meth:`World.start_tangent` took from the parameters."""
        pairs = [(p, v) for p, v in zip(self.view.parts, self.tangents, strict=True) if p.name.startswith(name)]
        rows = self._at(ray, t, channels, active, pairs)
        if self.microflakes_tangent is None:
            return rows
        turned = self._jvp_microflakes(ray.d)
        return [r + s * turned for r, s in zip(rows, self.extinction_at(ray, t, channels, active, name), strict=True)]

    def _at(
        self, ray: mi.Ray3f, t: mi.Float, channels: int, active: mi.Bool, pairs: list[tuple], activated: bool = False
    ) -> list[mi.Float]:
        total = [mi.Float(0) for _ in range(channels)]
        for part, value in pairs:
            rows = self.values_at(part, ray, t, active, dr.detach(value))
            if activated and part.activation is not None:
                rows = [part.activation.value_and_slope(row)[0] for row in rows]
            total = [a + b for a, b in zip(total, as_rows(rows, channels), strict=True)]
        return [self.area(ray.d) * t for t in total]

    def values_at(
        self, part: Part, ray: mi.Ray3f, t: mi.Float, active: mi.Bool, value: mi.Float | mi.Color3f | None = None
    ) -> list[mi.Float]:
        """Each channel of a part (or of a tangent of it, ``value``) at a point of a ray, without the medium's scale."""
        value = dr.detach(part_values(part)) if value is None else value
        if part.lattice is None:
            return [value] if part.channels == 1 else [value.x, value.y, value.z]
        cell, frac, inside = locate(part.lattice, ray.o, ray.d, t)
        nodes, on, n = box_nodes(cell, _upward(), part.lattice.res), inside & active, part.channels
        return [interpolate([dr.gather(mi.Float, value, k * n + c, on) for k in nodes], frac) for c in range(n)]

    def add_to_grid(self, part: Part, lower: mi.Vector3i, terms: list[tuple], active: mi.Bool) -> None:
        """Add to the gradient of a grid, in one packet for each channel, at the cell behind a node.

        Args:
            part: the grid.
            lower: lower node of the cell.
            terms: (d loss of each channel of the world, 8 weights of the corners) pairs.
            active: lanes that add.
        """
        gradient = next(g for p, g in zip(self.view.parts, self.gradients, strict=True) if p is part)
        each = [(for_part(weight, part.channels), corners) for weight, corners in terms]
        for c in range(part.channels):
            values = [sum(w[c] * corners[q] for w, corners in each) for q in range(8)]
            gradient.add_at(c, lower, values, active)

    def add_to_constants(self, weight: list[mi.Float], active: mi.Bool) -> None:
        """Add ``weight`` (d loss of each channel of the world) to the gradients of the constants."""
        for part, gradient in zip(self.view.parts, self.gradients, strict=True):
            if part.lattice is None:
                for c, w in enumerate(for_part(weight, part.channels)):
                    dr.scatter_add(gradient, w, mi.UInt32(c), active)

    def deposit(self, ray: mi.Ray3f, t: mi.Float, weight: list[mi.Float], active: mi.Bool, name: str = "sigma_") -> None:
        """Add ``weight`` (d loss / d coefficient of each channel) at a point of a ray: the transpose of :meth:`tangent_at`."""
        if self.microflakes_gradient is not None:
            self._vjp_microflakes(ray.d, weight, self.extinction_at(ray, t, len(weight), active, name), active)
        weight = [self.area(ray.d) * w for w in weight]
        for part, gradient in zip(self.view.parts, self.gradients, strict=True):
            if not part.name.startswith(name):
                continue
            if part.lattice is None:
                for c, w in enumerate(for_part(weight, part.channels)):
                    dr.scatter_add(gradient, dr.select(active, w, 0), mi.UInt32(c), active)
                continue
            cell, frac, inside = locate(part.lattice, ray.o, ray.d, t)
            self.add_to_grid(part, cell, [(weight, weights(upward_frac(frac, cell, part.lattice.res)))], inside & active)


def is_followed(microflakes: list[mi.Float] | None) -> bool:
    """Whether a derivative of the microflakes is asked for."""
    with dr.resume_grad():
        return microflakes is not None and dr.grad_enabled(microflakes)


def flight_parts(parts: list[Part]) -> list[Part]:
    """The constants, and the grids that share the cells of the one that scatters."""
    grids = [p for p in parts if p.lattice is not None]
    lead = next((p for p in grids if p.name == "sigma_s"), grids[0] if grids else None)
    return [p for p in parts if p.lattice is None or share_cells(p.lattice, lead.lattice)]


def _upward() -> mi.Bool:
    return dr.full(dr.mask_t(mi.Vector3f), True)


def part_values(part: Part) -> mi.Float | mi.Color3f:
    """Flat node values of a grid, or a constant."""
    return part.constant if part.lattice is None else part.lattice.values.array


def _length(t0: mi.Float, t1: mi.Float, active: mi.Bool) -> mi.Float:
    return dr.select(active & (t1 > t0), mi.Float(t1 - t0), 0)


def _ending(length: mi.Float) -> mi.Float:
    """A length for derivatives: a stretch without end lets nothing through, and nothing behind it changes."""
    return dr.select(length < 1e30, length, 0)


def _fits(part: Part, box: Box) -> bool:
    """Whether a grid lies inside its boundary, to the rounding of the boundary's float32 vertices."""
    if part.lattice is None:
        return False
    return box.contains(part.lattice.to_world, 1e-6)
