r"""One medium in its boundary: its coefficients at a point and its extinction over an interval of a ray, with jvp and vjp.

.. math:: \sigma_t(x, \omega) = s\,A(\omega) \sum_k f_k(x), \qquad A(\omega) = \sqrt{\omega^T S\, \omega}

with the scale s of the medium, its parts f_k (:mod:`mivol.transport.media.extinction`) and the projected area A of microflakes
of the matrix S; A = 1 without microflakes. Each method sums over the parts and multiplies the sum with s and A.

References: Heitz et al. 2015, Eq. 6 (the projected area).
"""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.errors import MivolError
from mivol.transport.media.extinction import (
    ExactExtinction,
    Extinction,
    RayInterval,
    Weight,
    to_part_channels,
    to_scene_channels,
    to_spectrum,
)
from mivol.transport.media.grid_extinction import SummedExtinction, add_to_cell, have_same_cells
from mivol.transport.media.medium_view import MediumView
from mivol.transport.traversal.box import (
    UNIT_CUBE,
    Box,
    clip_to_ball,
    clip_to_box,
    clip_to_faces,
    find_ball,
    find_faces,
    is_in_box,
    opaque_numbers,
)
from mivol.transport.traversal.rays import Ray, point_along

__all__ = [
    "Body",
    "cuts_grids",
    "flight_parts",
    "is_followed",
    "emission_slope",
    "eval_albedo",
    "eval_emission",
    "medium_interaction",
]


class Body:
    """One medium in its boundary.

    Attributes:
        view: extinction of the medium.
        phase: the phase function, ready to be evaluated.
        box: the boundary, if the boundary is a box or a ball; None for a traced boundary.
        edge: mean length of an edge of the box [length], as an opaque array; None without a box.
        exact_parts: the parts with a known integral along a ray.
        flight_parts: the parts from which a single walk draws free flights: constants, and grids that share their cells.
        estimates_shadows: whether shadow rays through grids with known block ranges are estimated instead of exact.
        hole: a box without the medium, in a level of a nested field; None without a hole.
        cuts_grids: whether the boundary is smaller than its content, so intervals must be clipped to the boundary.
        follows: whether each part, and the albedo (``follows_albedo``), is differentiated (:meth:`find_followed`).
        is_thick: whether collisions alone find the derivatives of the extinction (see the probes of free flights).
        has_low_albedo: whether some albedo may be too low for its derivatives to be found at collisions.
        least_albedo: paths follow this albedo where the albedo is lower [1] (:mod:`mivol.transport.path.kept_collisions`).
    """

    def __init__(self, view: MediumView, box: Box | None, estimates_shadows: bool = False, hole: Box | None = None) -> None:
        self.view, self.box, self.estimates_shadows, self.hole = view, box, estimates_shadows, hole
        self.phase = view.phase.prepare()
        self.cuts_grids = cuts_grids(view, box, hole)
        self.rows = box.rows() if box is not None else None
        # Found here, since a ray is clipped inside of loops.
        self.faces = find_faces(self.rows) if box is not None and box.is_upright and not box.is_round else None
        self.ball = find_ball(self.rows) if box is not None and box.is_round else None
        self.hole_rows = hole.rows() if hole is not None else None
        self.edge = mi.Float(opaque_numbers(np.array([box.edge]))[0]) if box is not None else None
        self.exact_parts = [p for p in view.parts if p.exact_line]
        self.flight_parts = flight_parts(view.parts)
        self.follows, self.follows_albedo = [True] * len(view.parts), True
        self.is_thick, self.has_low_albedo, self.least_albedo = False, True, 0.0
        self.gradients: list[Any] = []
        self.tangents: list[Any] = []
        self.has_tangent: list[bool] = []
        self.microflakes_gradient: mi.Float | None = None
        self.microflakes_tangent: list[mi.Float] | None = None

    def clip(self, ray: Ray, t0: mi.Float64, t1: mi.Float64) -> tuple[mi.Float64, mi.Float64]:
        """The part of the interval [t0, t1] of a ray inside the box or ball [length]; t1 <= t0 if the ray misses it."""
        if self.ball is not None:
            return clip_to_ball(*self.ball, ray.o, ray.d, t0, t1)
        if self.faces is not None:
            return clip_to_faces(*self.faces, ray.o, ray.d, t0, t1)
        return clip_to_box(self.rows, *UNIT_CUBE, ray.o, ray.d, t0, t1)[2:]

    def contains(self, p: mi.Point3f) -> mi.Bool:
        """Whether a point lies in the box or ball, and not in the hole."""
        inside = is_in_box(self.rows, self.box.is_round, p)
        return inside if self.hole is None else inside & ~is_in_box(self.hole_rows, False, p)

    @property
    def is_bounded(self) -> bool:
        """Whether some part has no known integral along a ray."""
        return len(self.exact_parts) < len(self.view.parts)

    def by_quadrature(self) -> Body:
        """The same medium, with gradients and tangents, whose bounded parts are integrated by quadrature."""
        body = copy(self)
        body.view = self.view.by_quadrature()
        body.exact_parts, body.flight_parts = body.view.parts, flight_parts(body.view.parts)
        return body

    def find_followed(self) -> None:
        """Find the parts, and whether the albedo, have derivatives enabled, so that only these are differentiated."""
        with dr.resume_grad():
            # A bounded part differentiates its field at points; its product does not tell whether its field is followed.
            self.follows = [not p.exact_line or dr.grad_enabled(p.scaled(self.view.scale)) for p in self.view.parts]
            self.follows_albedo = dr.grad_enabled(self.view.albedo_arrays)

    @property
    def follows_extinction(self) -> bool:
        """Whether some part, or the microflakes, are differentiated."""
        return any(self.follows) or is_followed(self.view.microflakes)

    @property
    def is_followed(self) -> bool:
        """Whether the extinction, the albedo or the phase function is differentiated."""
        with dr.resume_grad():
            return self.follows_extinction or self.follows_albedo or dr.grad_enabled(self.phase)

    @property
    def has_tangents(self) -> bool:
        """Whether some part, or the microflakes, have a tangent in a forward pass."""
        return any(self.has_tangent) or self.microflakes_tangent is not None

    @property
    def needs_probes(self) -> bool:
        """Whether points besides collisions must estimate derivatives: by an extinction that may be thin, or a low albedo."""
        return (self.follows_extinction and not self.is_thick) or (self.follows_albedo and self.has_low_albedo)

    def area(self, d: mi.Vector3f) -> mi.Float | float:
        """A(d) [1], the factor on the extinction for light along the unit vector ``d``; 1 without microflakes."""
        if self.view.microflakes is None:
            return 1.0
        return dr.safe_sqrt(dr.dot(d, self.apply_microflakes(d)))

    def apply_microflakes(self, d: mi.Vector3f) -> mi.Vector3f:
        """S d, the matrix of the microflakes times a direction: half the gradient of A^2 with respect to ``d``."""
        xx, yy, zz, xy, xz, yz = dr.detach(self.view.microflakes)
        return mi.Vector3f(xx * d.x + xy * d.y + xz * d.z, xy * d.x + yy * d.y + yz * d.z, xz * d.x + yz * d.y + zz * d.z)

    def _area_slopes(self, d: mi.Vector3f) -> list[mi.Float]:
        """d log A / d S_k for the six entries (xx, yy, zz, xy, xz, yz); 0 for A = 0. Extinction is proportional to A."""
        square = dr.dot(d, self.apply_microflakes(d))
        half = dr.select(square > 0, 0.5 * dr.rcp(dr.select(square > 0, square, 1)), 0)
        twice = 2 * half
        return [half * d.x * d.x, half * d.y * d.y, half * d.z * d.z, twice * d.x * d.y, twice * d.x * d.z, twice * d.y * d.z]

    def _vjp_microflakes(self, d: mi.Vector3f, weight: list[mi.Float], amount: list[mi.Float], active: mi.Bool) -> None:
        """Add ``weight`` (d loss / d amount of each channel) to the gradient of S, for an ``amount`` proportional to A."""
        change = sum((dr.select(w != 0, w * a, 0) for w, a in zip(weight, amount, strict=True)), mi.Float(0))
        for k, slope in enumerate(self._area_slopes(d)):
            dr.scatter_add(self.microflakes_gradient, change * slope, mi.UInt32(k), active)

    def _jvp_microflakes(self, d: mi.Vector3f) -> mi.Float:
        """Tangent of log A, from the tangent of S."""
        return sum((s * t for s, t in zip(self._area_slopes(d), self.microflakes_tangent, strict=True)), mi.Float(0))

    def extinction(self, ray: Ray, parts: list[ExactExtinction] | None = None) -> SummedExtinction:
        """The sum along a ray of ``parts`` (by default all parts), whose grids share their cells; without derivatives."""
        parts = self.view.parts if parts is None else parts
        scale = dr.detach(self.view.scale) * self.area(ray.d)
        return SummedExtinction(parts, [dr.detach(p.values) for p in parts], scale, ray=ray)

    def optical_depth(
        self,
        interval: RayInterval,
        channels: int,
        parts: list[ExactExtinction] | None = None,
        enough: float | None = None,
    ) -> list[mi.Float]:
        """Optical depth [1] of each channel over an interval.

        Args:
            interval: interval of a ray.
            channels: channels of the scene, 1 or 3.
            parts: parts of the medium; by default all parts.
            enough: number at which the walk of a grid may stop, once the optical depth of the grid exceeds it in every channel.

        Returns:
            ``channels`` numbers a lane, without derivatives.

        Raises:
            MivolError: the default parts include a bounded part.
        """
        if parts is None and self.is_bounded:
            raise MivolError(
                "a medium with a bounded field has no exact optical depth; grids, constants or Gaussians are expected: "
                "estimate its transmittance instead."
            )
        parts = self.view.parts if parts is None else parts
        scale = dr.detach(self.view.scale) * self.area(interval.ray.d)
        bound = None if enough is None else enough / scale
        total = [mi.Float(0) for _ in range(channels)]
        for part in parts:
            total = _add(total, to_scene_channels(part.integrate(interval, bound), channels))
        return [scale * tau for tau in total]

    def jvp_optical_depth(self, interval: RayInterval, channels: int) -> list[mi.Float]:
        """Tangent of the optical depth of the exact parts, from the tangents of :meth:`SceneMedia.start_tangent`."""
        area = self.area(interval.ray.d)
        total = [mi.Float(0) for _ in range(channels)]
        for part, change in self._parts_with_tangents():
            if part.exact_line:
                total = _add(total, to_scene_channels(part.jvp(change, interval), channels))
        rows = [area * row for row in total]
        if self.microflakes_tangent is None:
            return rows
        turned = self._jvp_microflakes(interval.ray.d)
        depths = self.optical_depth(interval, channels, self.exact_parts)
        return [r + t * turned for r, t in zip(rows, depths, strict=True)]

    def vjp_optical_depth(self, interval: RayInterval, weight: Weight) -> None:
        """Add ``weight`` (d loss / d tau of each channel) times this interval to the gradients of the exact parts.

        A weight that depends on the cell is for media of grids that share their cells, without followed microflakes.
        """
        if self.microflakes_gradient is not None:
            amount = self.optical_depth(interval, len(weight), self.exact_parts)
            self._vjp_microflakes(interval.ray.d, weight, amount, interval.active)
        area = self.area(interval.ray.d)
        for part, gradient in self._parts_with_gradients():
            if part.exact_line:
                part.vjp(
                    gradient,
                    _map_weight(weight, lambda rows, n=part.channels: to_part_channels([area * w for w in rows], n)),
                    interval,
                )

    def _parts_with_tangents(self) -> list[tuple[Extinction, Any]]:
        """The parts with a tangent, and their tangents. Other parts are not walked: their derivative is 0."""
        rows = zip(self.view.parts, self.tangents, self.has_tangent, strict=True)
        return [(part, change) for part, change, has_tangent in rows if has_tangent]

    def _parts_with_gradients(self) -> list[tuple[Extinction, Any]]:
        """The parts that are differentiated, and their gradients."""
        return [
            (part, gradient)
            for part, gradient, follows in zip(self.view.parts, self.gradients, self.follows, strict=True)
            if follows
        ]

    def extinction_at(self, ray: Ray, t: mi.Float, channels: int, active: mi.Bool, name: str = "sigma_") -> list[mi.Float]:
        """Coefficient [1/length] of each channel at a point of a ray: of all parts, or of the parts whose name starts with
        ``name``.
        """
        total = [mi.Float(0) for _ in range(channels)]
        for part in self.view.parts:
            if part.name.startswith(name):
                total = _add(total, to_scene_channels(part.eval_at(self.view.scale, ray, t, active), channels))
        return [self.area(ray.d) * row for row in total]

    def jvp_extinction_at(self, ray: Ray, t: mi.Float, channels: int, active: mi.Bool, name: str = "sigma_") -> list[mi.Float]:
        """Tangent of :meth:`extinction_at`, from the tangents of :meth:`SceneMedia.start_tangent`."""
        total = [mi.Float(0) for _ in range(channels)]
        for part, change in self._parts_with_tangents():
            if part.name.startswith(name):
                total = _add(total, to_scene_channels(part.jvp_at(change, ray, t, active), channels))
        rows = [self.area(ray.d) * row for row in total]
        if self.microflakes_tangent is None:
            return rows
        turned = self._jvp_microflakes(ray.d)
        return [r + s * turned for r, s in zip(rows, self.extinction_at(ray, t, channels, active, name), strict=True)]

    def vjp_extinction_at(self, ray: Ray, t: mi.Float, weight: list[mi.Float], active: mi.Bool, name: str = "sigma_") -> None:
        """Add ``weight`` (d loss / d coefficient of each channel) at a point: the transpose of :meth:`jvp_extinction_at`."""
        if self.microflakes_gradient is not None:
            self._vjp_microflakes(ray.d, weight, self.extinction_at(ray, t, len(weight), active, name), active)
        weight = [self.area(ray.d) * w for w in weight]
        for part, gradient in self._parts_with_gradients():
            if part.name.startswith(name):
                part.vjp_at(gradient, to_part_channels(weight, part.channels), ray, t, active)

    def add_to_grid(self, part: ExactExtinction, lower: mi.Vector3i, terms: list[tuple], active: mi.Bool) -> None:
        """Add to the gradient of a grid, in a packet for each channel, at the cell behind a node.

        Args:
            part: the grid.
            lower: lower node of the cell.
            terms: pairs (d loss of each channel of the scene, 8 weights of the corners).
            active: lanes to add.
        """
        gradient = next(g for p, g in zip(self.view.parts, self.gradients, strict=True) if p is part)
        add_to_cell(gradient, lower, [(to_part_channels(weight, part.channels), corners) for weight, corners in terms], active)

    def add_to_constants(self, weight: list[mi.Float], active: mi.Bool) -> None:
        """Add ``weight`` (d loss of each channel of the scene) to the gradients of the constants."""
        for part, gradient in zip(self.view.parts, self.gradients, strict=True):
            if part.is_constant:
                for c, w in enumerate(to_part_channels(weight, part.channels)):
                    dr.scatter_add(gradient, w, mi.UInt32(c), active)


def _map_weight(weight: Weight, change: Callable[[list[mi.Float]], list[mi.Float]]) -> Weight:
    """A weight whose channels are changed by a function."""
    return (lambda lower: change(weight(lower))) if callable(weight) else change(weight)


def is_followed(microflakes: list[mi.Float] | None) -> bool:
    """Whether derivatives of the microflakes are enabled."""
    with dr.resume_grad():
        return microflakes is not None and dr.grad_enabled(microflakes)


def flight_parts(parts: list[Extinction]) -> list[ExactExtinction]:
    """The parts for a single walk of cells: constants, and grids with the cells of ``sigma_s`` (or of the first grid)."""
    grids = [p for p in parts if p.lattice is not None]
    lead = next((p for p in grids if p.name == "sigma_s"), grids[0] if grids else None)
    return [p for p in parts if p.is_constant or (p.lattice is not None and have_same_cells(p.lattice, lead.lattice))]


def _add(a: list[mi.Float], b: list[mi.Float]) -> list[mi.Float]:
    return [x + y for x, y in zip(a, b, strict=True)]


def cuts_grids(view: MediumView, box: Box | None, hole: Box | None) -> bool:
    """Whether a boundary is smaller than its content (``Body.cuts_grids``)."""
    if box is None:
        return False
    is_cut = box.is_round or hole is not None or view.emission_density is not None
    return is_cut or not all(_fits(part, box) for part in view.parts)


def _fits(part: Extinction, box: Box) -> bool:
    """Whether a grid lies inside its boundary, up to the rounding of the float32 vertices of the boundary."""
    if part.lattice is None:
        return False
    return box.contains(part.lattice.to_world, 1e-6)


def medium_interaction(ray: Ray, t: mi.Float | mi.Float64, medium: mi.Medium | None = None) -> mi.MediumInteraction3f:
    """A point of a ray for Mitsuba's volumes and phase functions, found in float64 and rounded once."""
    mei = dr.zeros(mi.MediumInteraction3f, dr.width(ray))
    mei.t, mei.p, mei.wi = mi.Float(t), mi.Point3f(point_along(ray, t)), -ray.d
    mei.sh_frame = mi.Frame3f(mei.wi)
    mei.time, mei.wavelengths = ray.time, ray.wavelengths
    if medium is not None:
        mei.medium = dr.select(dr.full(mi.Bool, True, dr.width(ray)), mi.MediumPtr(medium), None)
    return mei


def eval_albedo(body: Body, mei: mi.MediumInteraction3f, on: mi.Bool) -> mi.Spectrum:
    """The single-scattering albedo of a body at a point [1], with its derivative."""
    albedo = body.view.albedo
    return albedo.eval(mei, on) if isinstance(albedo, mi.Volume) else mi.Spectrum(albedo)


def eval_emission(body: Body, ray: Ray, t: mi.Float64, channels: int, on: mi.Bool) -> mi.Spectrum:
    """The light emitted by a body at a point of a ray towards the origin of the ray [radiance/length].

    The result carries the derivatives of the emission and of the albedo; :func:`emission_slope` has the derivatives of the
    extinction.
    """
    total = mi.Spectrum(0)
    if body.view.emission is not None:
        name, slope = emission_slope(body, ray, t, on)
        total += to_spectrum(body.extinction_at(ray, dr.select(on, t, 0), channels, on, name)) * slope
    if body.view.emission_density is not None:
        total += _at(body, body.view.emission_density, ray, t, on)
    return total


def emission_slope(body: Body, ray: Ray, t: mi.Float64, on: mi.Bool) -> tuple[str, mi.Spectrum]:
    """The name of the coefficient proportional to the ``emission`` of a body, and the derivative of the light by it
    [radiance].
    """
    Le = _at(body, body.view.emission, ray, t, on)
    if body.view.albedo is None:
        return "sigma_a", Le
    return "sigma_", Le * (1 - eval_albedo(body, medium_interaction(ray, t, body.view.medium), on))


def _at(body: Body, value: mi.Volume | mi.Float | mi.Color3f, ray: Ray, t: mi.Float64, on: mi.Bool) -> mi.Spectrum:
    if not isinstance(value, mi.Volume):
        return mi.Spectrum(value)
    mei = medium_interaction(ray, dr.select(on, t, 0), body.view.medium)
    return dr.select(body.view.holds(value, mei.p), value.eval(mei, on), 0)
