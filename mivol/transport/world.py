"""The media of a scene in their boundaries: what a stretch of a ray passes through, forwards and backwards.

Conventions. A body is one medium behind one boundary. Where the boundary is a box it is cut by a slab test in float64;
elsewhere its stretches are found by tracing. A stretch [t0, t1] is given in world lengths along the camera's own ray, never
from the last boundary on, so that entry points keep the precision of the walk's set-up.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi

from mivol.transport.field import SumField, share_cells
from mivol.transport.lattice import box_nodes, clip, locate
from mivol.transport.medium import Box, MediumView, Part
from mivol.transport.optical_depth import (
    Gradient,
    backproject_activated,
    backproject_segment,
    integrate_activated,
    integrate_segment,
    interpolate,
    upward_frac,
    weights,
)
from mivol.transport.tracking import track

if TYPE_CHECKING:
    from mivol.transport.control import Control
    from mivol.transport.direct import Lights
    from mivol.transport.light_grid import LightGrid, Shade

__all__ = ["Body", "World", "share_flight", "spawn_ray"]


class Body:
    """One medium in its boundary.

    Attributes:
        view: the medium's extinction.
        box: the boundary, where it is a box; None where it has to be traced.
        flight: the parts that free flights are drawn from in one walk: constants, and grids that share their cells.
        trims: whether the boundary is smaller than what lies in it, so that stretches must be cut to it.
    """

    def __init__(self, view: MediumView, box: Box | None) -> None:
        self.view, self.box = view, box
        self.trims = box is not None and (view.glow is not None or not all(_fits(part, box) for part in view.parts))
        self.rows = box.rows() if box is not None else None
        self.flight = share_flight(view.parts)
        self.gradients: list[Gradient | mi.Float] = []
        self.tangents: list[mi.Float] = []
        self.flakes_gradient: mi.Float | None = None
        self.flakes_tangent: list[mi.Float] | None = None

    def area(self, d: mi.Vector3f) -> mi.Float | float:
        """Factor on the extinction for light that travels along ``d``: the projected area of flakes, else 1."""
        if self.view.flakes is None:
            return 1.0
        return dr.safe_sqrt(dr.dot(d, self.facing(d)))

    def facing(self, d: mi.Vector3f) -> mi.Vector3f:
        """The matrix of the flakes times a direction: half the gradient of the squared area."""
        xx, yy, zz, xy, xz, yz = dr.detach(self.view.flakes)
        return mi.Vector3f(
            xx * d.x + xy * d.y + xz * d.z, xy * d.x + yy * d.y + yz * d.z, xz * d.x + yz * d.y + zz * d.z
        )

    def _area_slopes(self, d: mi.Vector3f) -> list[mi.Float]:
        """Derivative of the logarithm of the area by each number of the matrix: of it, extinction is a multiple."""
        square = dr.dot(d, self.facing(d))
        half = dr.select(square > 0, 0.5 * dr.rcp(dr.select(square > 0, square, 1)), 0)
        twice = 2 * half
        return [half * d.x * d.x, half * d.y * d.y, half * d.z * d.z, twice * d.x * d.y, twice * d.x * d.z, twice * d.y * d.z]

    def _pull_flakes(self, d: mi.Vector3f, weight: list[mi.Float], amount: list[mi.Float], active: mi.Bool) -> None:
        """Add ``weight`` (d loss / d amount) to the gradient of the matrix, for amounts in proportion to the area."""
        change = sum((dr.select(w != 0, w * a, 0) for w, a in zip(weight, amount, strict=True)), mi.Float(0))
        for k, slope in enumerate(self._area_slopes(d)):
            dr.scatter_add(self.flakes_gradient, change * slope, mi.UInt32(k), active)

    def _push_flakes(self, d: mi.Vector3f) -> mi.Float:
        """Tangent of the logarithm of the area."""
        return sum((s * t for s, t in zip(self._area_slopes(d), self.flakes_tangent, strict=True)), mi.Float(0))

    def extinction(self, ray: mi.Ray3f, parts: list[Part] | None = None) -> SumField:
        """The sum of parts (all of them, unless told which), which share their cells, along a ray, without derivatives."""
        parts = self.view.parts if parts is None else parts
        return SumField(parts, [dr.detach(_values(p)) for p in parts], dr.detach(self.view.scale) * self.area(ray.d))

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
        pairs = [(p, dr.detach(_values(p))) for p in parts]
        scale = dr.detach(self.view.scale) * self.area(ray.d)
        bound = None if enough is None else enough / scale
        return [scale * tau for tau in self._sum(ray, t0, t1, channels, active, pairs, True, bound)]

    def transmittance(
        self, ray: mi.Ray3f, t0: mi.Float, t1: mi.Float, channels: int, active: mi.Bool, dice: mi.UInt32, enough: float
    ) -> tuple[list[mi.Float], mi.UInt32]:
        """Transmittance [1] of each channel over a stretch, and what is left of the dice.

        Estimated in grids whose blocks are known; exact in all else, which is walked to the optical depth ``enough``.
        """
        tracked = [p for p in self.view.parts if p.lattice is not None and p.lattice.blocks is not None]
        others = [p for p in self.view.parts if not any(p is q for q in tracked)]
        T = [dr.exp(-t) for t in self.optical_depth(ray, t0, t1, channels, active, others, enough)]
        scale = dr.detach(self.view.scale) * self.area(ray.d)
        for part in tracked:
            own, dice = track(part.lattice, clip(part.lattice, ray.o, ray.d, t0, t1), scale, dice, active)
            T = [a * b for a, b in zip(T, as_rows(own, channels), strict=True)]
        return T, dice

    def tangent(self, ray: mi.Ray3f, t0: mi.Float, t1: mi.Float, channels: int, active: mi.Bool) -> list[mi.Float]:
        """Derivative of the optical depth along the tangent that :meth:`World.start_tangent` took from the parameters."""
        pairs = list(zip(self.view.parts, self.tangents, strict=True))
        area = self.area(ray.d)
        rows = [area * change for change in self._sum(ray, t0, t1, channels, active, pairs, False)]
        if self.flakes_tangent is None:
            return rows
        turned = self._push_flakes(ray.d)
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
                lattice = part.lattice if skip else replace(part.lattice, gaps=None)
                segment = clip(lattice, ray.o, ray.d, t0, t1)
                if part.activation is None:
                    rows = integrate_segment(lattice, value, segment, active, enough)
                else:
                    tangent = None if skip else value
                    values = dr.detach(_values(part))
                    rows = integrate_activated(lattice, values, part.activation, segment, active, enough, tangent)
            total = [t + r for t, r in zip(total, as_rows(rows, channels), strict=True)]
        return total

    def backproject(self, ray: mi.Ray3f, t0: mi.Float, t1: mi.Float, weight: list[mi.Float], active: mi.Bool) -> None:
        """Add ``weight`` (d loss / d tau of each channel) times this stretch to the gradients of the parts."""
        if self.flakes_gradient is not None:
            self._pull_flakes(ray.d, weight, self.optical_depth(ray, t0, t1, len(weight), active), active)
        weight = [self.area(ray.d) * w for w in weight]
        for part, gradient in zip(self.view.parts, self.gradients, strict=True):
            w = _for_part(weight, part.channels)
            if part.lattice is None:
                length = _ending(_length(t0, t1, active))
                for c in range(part.channels):
                    dr.scatter_add(gradient, dr.select(w[c] != 0, w[c] * length, 0), mi.UInt32(c), active)
                continue
            segment = clip(part.lattice, ray.o, ray.d, t0, t1)
            if part.activation is None:
                backproject_segment(part.lattice, gradient, w, segment, active)
            else:
                values = dr.detach(_values(part))
                backproject_activated(part.lattice, values, part.activation, gradient, w[0], segment, active)

    def extinction_at(self, ray: mi.Ray3f, t: mi.Float, channels: int, active: mi.Bool, name: str = "sigma_") -> list[mi.Float]:
        """Coefficient [1/length] of each channel at a point of a ray: of all parts, or of those called ``name``."""
        parts = [p for p in self.view.parts if p.name.startswith(name)]
        return self._at(ray, t, channels, active, [(p, self.view.scale * _values(p)) for p in parts], activated=True)

    def tangent_at(self, ray: mi.Ray3f, t: mi.Float, channels: int, active: mi.Bool, name: str = "sigma_") -> list[mi.Float]:
        """As :meth:`extinction_at`, of the tangent that :meth:`World.start_tangent` took from the parameters."""
        pairs = [(p, v) for p, v in zip(self.view.parts, self.tangents, strict=True) if p.name.startswith(name)]
        rows = self._at(ray, t, channels, active, pairs)
        if self.flakes_tangent is None:
            return rows
        turned = self._push_flakes(ray.d)
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
        value = dr.detach(_values(part)) if value is None else value
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
        each = [(_for_part(weight, part.channels), corners) for weight, corners in terms]
        for c in range(part.channels):
            values = [sum(w[c] * corners[q] for w, corners in each) for q in range(8)]
            gradient.add_at(c, lower, values, active)

    def add_to_constants(self, weight: list[mi.Float], active: mi.Bool) -> None:
        """Add ``weight`` (d loss of each channel of the world) to the gradients of the constants."""
        for part, gradient in zip(self.view.parts, self.gradients, strict=True):
            if part.lattice is None:
                for c, w in enumerate(_for_part(weight, part.channels)):
                    dr.scatter_add(gradient, w, mi.UInt32(c), active)

    def deposit(self, ray: mi.Ray3f, t: mi.Float, weight: list[mi.Float], active: mi.Bool, name: str = "sigma_") -> None:
        """Add ``weight`` (d loss / d coefficient of each channel) at a point of a ray: the transpose of :meth:`tangent_at`."""
        if self.flakes_gradient is not None:
            self._pull_flakes(ray.d, weight, self.extinction_at(ray, t, len(weight), active, name), active)
        weight = [self.area(ray.d) * w for w in weight]
        for part, gradient in zip(self.view.parts, self.gradients, strict=True):
            if not part.name.startswith(name):
                continue
            if part.lattice is None:
                for c, w in enumerate(_for_part(weight, part.channels)):
                    dr.scatter_add(gradient, dr.select(active, w, 0), mi.UInt32(c), active)
                continue
            cell, frac, inside = locate(part.lattice, ray.o, ray.d, t)
            self.add_to_grid(part, cell, [(weight, weights(upward_frac(frac, cell, part.lattice.res)))], inside & active)


class World:
    """The media of a scene, and what of Mitsuba's scene has to be traced.

    Args:
        bodies: the media.
        has_surfaces: some shape is more than the boundary of a medium.
        scatters: light may turn at a surface (``max_depth`` above 1 and surfaces to turn at).
        is_veiled: some surface lets part of the light through undeviated, so that a path of depth 1 may pass it.
        start: the medium that the sensor names, or None.
        locates: the camera may be inside a boundary that has to be traced, and the sensor names no medium.
        lights: what lights the media that scatter; None where none does.
        is_deterministic: images of scattered light are made by quadrature; derivatives are still drawn.
        events: points of a camera ray that scatter, in pictures.
        size: of the scene [length], by which rays start anew behind a surface.
    """

    def __init__(
        self,
        bodies: list[Body],
        has_surfaces: bool,
        scatters: bool = False,
        is_veiled: bool = False,
        start: mi.Medium | None = None,
        locates: bool = False,
        lights: Lights | None = None,
        is_deterministic: bool = False,
        events: int = 1,
        size: float = 1.0,
    ) -> None:
        self.boxed = [b for b in bodies if b.box is not None]
        # A traced stretch is recognised by its medium, which several boundaries may share.
        self.traced = list({b.view.medium.ptr: b for b in bodies if b.box is None}.values())
        self.has_surfaces = has_surfaces
        self.traces = has_surfaces or bool(self.traced)
        self.channels = 1 if mi.is_monochromatic else max([b.view.channels for b in bodies], default=1)
        self.scatters, self.is_veiled, self.start, self.locates = scatters, is_veiled, start, locates
        self.lights = lights
        self.control: Control | None = None
        self.level: mi.Spectrum | None = None
        self.shade: Shade | None = None
        self.light_grid: LightGrid | None = None
        self.is_deterministic, self.events = is_deterministic, events
        self.size = dr.opaque(mi.Float, size)
        self.is_tracked = any(p.lattice is not None and p.lattice.blocks is not None for b in bodies for p in b.view.parts)

    @property
    def takes_control(self) -> bool:
        """Whether a control variate for derivatives can be used: one grid in a box that scatters by an albedo."""
        parts = [p for b in self.bodies for p in b.view.parts]
        alone = len(parts) == 1 and not self.traced and parts[0].lattice is not None
        return self.lights is not None and alone and self.bodies[0].view.share is not None and not self.has_flakes

    @property
    def has_flakes(self) -> bool:
        """Whether some phase function has flakes among its lobes."""
        phases = [b.view.medium.phase_function() for b in self.bodies]
        return any(p is not None and int(p.flags()) & int(mi.PhaseFunctionFlags.Microflake) for p in phases)

    @property
    def bodies(self) -> list[Body]:
        """All media."""
        return self.boxed + self.traced

    @property
    def is_single(self) -> bool:
        """Whether one walk passes all extinction in its order."""
        return len(self.bodies) == 1 and len(self.bodies[0].flight) == len(self.bodies[0].view.parts)

    def rows(self, values: list[mi.Float]) -> list[mi.Float]:
        """Numbers of a grey or rgb body, for each channel of the world."""
        return as_rows(values, self.channels)

    def sums(self, rows: list[mi.Float]) -> list[mi.Float]:
        """The derivative of each channel of the world from that of each colour: a grey one gets the sum."""
        return rows if len(rows) == self.channels else [sum(rows[1:], rows[0])]

    @property
    def emits(self) -> bool:
        """Whether some medium is a source of light."""
        return any(b.view.emits for b in self.bodies)

    def vectors(self, values: list[mi.Vector3f]) -> list[mi.Vector3f]:
        """Vectors of a grey or rgb body, for each channel of the world."""
        axes = [self.rows([v[a] for v in values]) for a in range(3)]
        return [mi.Vector3f(*v) for v in zip(*axes, strict=True)]

    def medium_at(self, scene: mi.Scene, ray: mi.Ray3f) -> mi.MediumPtr:
        """The medium around the origin of camera rays."""
        n = dr.width(ray)
        if self.start is not None:
            return dr.select(dr.full(mi.Bool, True, n), mi.MediumPtr(self.start), None)
        if self.locates:
            return _locate(scene, ray, self.size)
        return dr.zeros(mi.MediumPtr, n)

    def start_gradients(self) -> None:
        """Begin a reverse pass: gradients of zero for each part."""
        for body in self.bodies:
            body.flakes_gradient = dr.zeros(mi.Float, 6) if _is_followed(body.view.flakes) else None
            body.gradients = [
                Gradient.zeros(p.lattice) if p.lattice is not None else dr.zeros(mi.Float, p.channels) for p in body.view.parts
            ]

    def push_gradients(self) -> None:
        """End a reverse pass: hand the gradients of the parts to the parameters behind them."""
        total = mi.Float(0)
        for body in self.bodies:
            for part, gradient in zip(body.view.parts, body.gradients, strict=True):
                flat = gradient.fold() if part.lattice is not None else gradient
                dr.eval(flat)
                # The derivative of this product is the gradient, for the values and for the scale alike.
                total += dr.sum(dr.ravel(body.view.scale * _values(part)) * flat)
            if body.flakes_gradient is not None:
                slopes = (dr.gather(mi.Float, body.flakes_gradient, mi.UInt32(k)) for k in range(6))
                total += sum(s * g for s, g in zip(body.view.flakes, slopes, strict=True))
            body.gradients, body.flakes_gradient = [], None
        if dr.grad_enabled(total):
            dr.backward(total)

    def start_tangent(self) -> None:
        """Begin a forward pass: take the tangent of each part from the parameters."""
        for body in self.bodies:
            products = [body.view.scale * _values(p) for p in body.view.parts]
            asked = [p for p in products if dr.grad_enabled(p)]
            if asked:
                # The tangents of the parameters are kept: what else was made of them, such as an albedo, is followed later.
                dr.forward_to(*asked, flags=dr.ADFlag.ClearEdges)
            body.tangents = [dr.detach(dr.grad(p)) for p in products]
            if _is_followed(body.view.flakes):
                dr.forward_to(body.view.flakes, flags=dr.ADFlag.ClearEdges)
                body.flakes_tangent = dr.detach(dr.grad(body.view.flakes))
            dr.eval(body.tangents, body.flakes_tangent)


def _is_followed(flakes: list[mi.Float] | None) -> bool:
    with dr.resume_grad():
        return flakes is not None and dr.grad_enabled(flakes)


LUMINANCE = (0.212671, 0.715160, 0.072169)
"""Share of each channel of an rgb field in the one channel of a mono variant (ITU-R BT.709, as in Mitsuba)."""


def spectrum(rows: list[mi.Float]) -> mi.Spectrum:
    """One number for each channel of the world as a spectrum."""
    return mi.Spectrum(*rows) if len(rows) == 3 else mi.Spectrum(rows[0])


def tangent_of(value: mi.Spectrum) -> mi.Spectrum:
    """The tangent of a value that was computed from parameters; 0 where none of them has one.

    The tangents that it reads are kept: other points and passes read them again.
    """
    return dr.forward_to(value, flags=dr.ADFlag.ClearEdges) if dr.grad_enabled(value) else dr.zeros(type(value))


def by_channel(value: mi.Spectrum, channels: int) -> list[mi.Float]:
    """The derivative of each channel of the extinction from that of each colour: a grey one gets the sum."""
    parts = [value[c] for c in range(dr.size_v(value))]
    return parts if len(parts) == channels else [sum(parts[1:], parts[0])]


def as_rows(values: list[mi.Float], channels: int) -> list[mi.Float]:
    """The values of a grey or rgb part for each channel of the world."""
    if len(values) > channels:
        return _grey(values)
    return [values[c % len(values)] for c in range(channels)]


def share_flight(parts: list[Part]) -> list[Part]:
    """The constants, and the grids that share the cells of the one that scatters."""
    grids = [p for p in parts if p.lattice is not None]
    lead = next((p for p in grids if p.name == "sigma_s"), grids[0] if grids else None)
    return [p for p in parts if p.lattice is None or share_cells(p.lattice, lead.lattice)]


def _grey(rows: list[mi.Float]) -> list[mi.Float]:
    """Three channels as the one of a mono variant."""
    return [sum(share * row for share, row in zip(LUMINANCE, rows, strict=True))]


def _for_part(weight: list[mi.Float], channels: int) -> list[mi.Float]:
    """The derivative of each channel of a part: its own, the sum for a grey part, the share in the grey of a mono variant."""
    if len(weight) == channels:
        return weight
    return [sum(weight)] if channels == 1 else [share * weight[0] for share in LUMINANCE]


def _upward() -> mi.Bool:
    return dr.full(dr.mask_t(mi.Vector3f), True)


def _values(part: Part) -> mi.Float | mi.Color3f:
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


def spawn_ray(si: mi.SurfaceInteraction3f, d: mi.Vector3f, size: mi.Float) -> mi.Ray3f:
    """A ray onward from a surface, which begins a little behind it.

    Mitsuba's own begin 1e-4 of (1 + the largest coordinate) behind it, which passes whole shapes by in scenes that are not much
    larger than that: here, of a quarter of their ``size``, where that is below 1.
    """
    step = (dr.minimum(0.25 * size, 1) + dr.max(dr.abs(si.p))) * mi.math.RayEpsilon
    ray = si.spawn_ray(d)
    ray.o = si.p + si.n * dr.mulsign(step, dr.dot(si.n, d))
    return ray


@dr.syntax
def _locate(scene: mi.Scene, ray: mi.Ray3f, size: mi.Float) -> mi.MediumPtr:
    """Find the medium around a point: the near side of the first boundary along a ray, through all else."""
    probe = mi.Ray3f(ray.o, ray.d, dr.inf, ray.time, ray.wavelengths)  # the boundary may lie beyond the sensor's far_clip
    medium = dr.zeros(mi.MediumPtr, dr.width(ray))
    going = dr.full(mi.Bool, True, dr.width(ray))
    while dr.hint(going, label="the medium around the camera"):
        si = scene.ray_intersect(probe, mi.RayFlags.All, False, going)
        found = going & si.is_valid()
        boundary = found & si.is_medium_transition()
        medium = dr.select(boundary, si.target_medium(-ray.d), medium)
        probe = spawn_ray(si, ray.d, size)
        going = found & ~boundary
    return medium
