r"""Emission of media along a ray (the emission-absorption integral), with tangent and transpose, and its segment estimator.

.. math:: L = \int_0^D T(t) \Big( \sigma_t (1 - \alpha)\, L_e(x_t, \omega) + j(x_t, \omega) \Big) dt

The extinction multiplies the source function (1 - albedo) Le, so an infinitely thick medium without scattering has the radiance
Le. With ``sigma_a`` and ``sigma_s`` the emitted power is sigma_a Le. The emission density j (``emission_density``) does not
depend on the extinction.

Conventions. :mod:`mivol.transport.line_integrals.composite` composites a ray cell by cell. Source function and emission density
are evaluated at the two points of the cell quadrature (:mod:`mivol.transport.traversal.interpolation`). Cells belong to the
grid of the extinction, or to the grid of the emission if the extinction has no grid; an interval outside all grids is one cell.
A cell is cut into equal parts where the voxels of emission or albedo are smaller, or where their box ends inside of cells.
``omega`` is the direction from the point to the camera (``wi``).

References: Max 1995 (the emission-absorption integral).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.numerics import minimum, one_minus_exp
from mivol.transport.estimators.scores import FORWARD, IMAGE
from mivol.transport.estimators.segment import PathSegment, SegmentEstimate, SegmentLight, SegmentTransmittance
from mivol.transport.line_integrals.composite import Composite, composite_ray, vjp_composite
from mivol.transport.line_integrals.integrand import LineIntegral, RayPiece
from mivol.transport.media.body import medium_interaction
from mivol.transport.media.compositing import CellIntegral
from mivol.transport.media.extinction import colours_to_channels, take_tangent, to_spectrum
from mivol.transport.media.medium_view import MediumView
from mivol.transport.media.optical_depth import transmittance
from mivol.transport.media.ray_intervals import RaySegment, find_end
from mivol.transport.media.scene_media import SceneMedia
from mivol.transport.traversal.interpolation import (
    GAUSS_POINT,
    eval_cubic,
    fit_cubic,
    integrate_cubic,
    share_opacity,
    weigh_emission_density,
)
from mivol.transport.traversal.random_numbers import SpreadSampler

__all__ = ["integrate_emission", "vjp_emission", "Emission"]


OPAQUE_DEPTH = 1000.0
"""Redistances an infinite optical depth: exp(-1000) is 0."""


THIN_CELL = 1e-3
"""Half the optical depth of a cell [1] below which random points are uniform in it."""


def integrate_emission(
    media: SceneMedia, ray_segment: RaySegment, active: mi.Bool, tangent: bool = False, u: mi.Float | None = None
) -> Composite:
    """Integrate the emitted light of media along a ray.

    Args:
        media: media of the scene.
        ray_segment: ray and length; world space, unit direction.
        active: lanes to follow.
        tangent: whether to follow tangents, which the media took from the parameters.
        u: uniform random number in [0, 1) of each ray, which places the points in cells; None for the quadrature.

    Returns:
        The composite: ``N`` is the light of each colour [radiance], ``tau`` the optical depth; tangents follow.

    Raises:
        MivolError: a medium whose grids of extinction do not share their cells.

    Bias: of order dt^4 in the length of a part of a cell; none for a constant source function. A box of emission that ends
        inside of cells is met to a part of a cell. With ``u`` none, but of an extinction with an activation, which a cubic
        through four points of a cell stands for.
    Cost: a walk of each medium, and two look-ups of the emission in a part of a cell.
    """
    integrand = _EmissionIntegrand.of(media) if u is None else _SampledIntegrand(**vars(_EmissionIntegrand.of(media)), u=u)
    line = LineIntegral(media, integrand, ray_segment, active)
    return composite_ray(line, [mi.Float(0)] * line.integrand.rows, tangent, skip=not tangent)


def vjp_emission(
    media: SceneMedia,
    ray_segment: RaySegment,
    composite: Composite,
    weight: mi.Spectrum,
    behind: mi.Spectrum,
    active: mi.Bool,
) -> None:
    """Add the derivatives of the light along a ray to the gradients of the media and of the emission.

    Args:
        media, ray_segment, active: as :func:`integrate_emission`, which returned ``composite``.
        composite: result of the forward pass.
        weight: d loss / d light of each colour, at the origin of the ray.
        behind: d loss / d log T of each colour: the derivative times the light behind the ray, attenuated to the camera.
    """
    line = LineIntegral(media, _EmissionIntegrand.of(media), ray_segment, active)
    rows, rest = ([v[c] for c in range(line.integrand.rows)] for v in (weight, behind))
    vjp_composite(line, composite, rows, rest)


@dataclass
class _EmissionIntegrand:
    """The integrand of emitted light: a row for each colour, over ``channels`` of extinction."""

    rows: int
    channels: int
    parts: int
    request: ClassVar[str] = "a medium emits"
    alternative: ClassVar[str] = "take its emission out"

    @classmethod
    def of(cls, media: SceneMedia) -> _EmissionIntegrand:
        return cls(dr.size_v(mi.Spectrum), media.channels, max((count_parts(b.view) for b in media.bodies), default=1))

    @property
    def points(self) -> tuple[float, ...]:
        """Two points in each part of a cell, as fractions of its length."""
        return tuple((part + p) / self.parts for part in range(self.parts) for p in (GAUSS_POINT, 1 - GAUSS_POINT))

    def integrate_cell(self, piece: RayPiece, sigma: list[list[mi.Float]]) -> list[CellIntegral]:
        source, emission_density = self._detached(piece, self.points)
        dt = piece.dt / self.parts
        cells = []
        for part in range(self.parts):
            here = slice(2 * part, 2 * part + 2)
            cells.append(self._integrate_part(dt, [row[here] for row in sigma], source[here], emission_density[here]))
        return cells[0] if self.parts == 1 else [_join_parts(row) for row in zip(*cells, strict=True)]

    def _integrate_part(
        self, dt: mi.Float, sigma: list[list[mi.Float]], source: list[mi.Spectrum], emission_density: list[mi.Spectrum]
    ) -> list[CellIntegral]:
        """Integrate each row over a part of a cell, from extinction [row][point], source function and emission density."""
        shares = [share_opacity(dt, *row) for row in sigma[: self.channels]]
        density_weights = [weigh_emission_density(dt, *row) for row in sigma[: self.channels]] if emission_density else []
        integrals = []
        for r in range(self.rows):
            share = shares[r % self.channels]
            N, dN = mi.Float(0), [mi.Float(0), mi.Float(0)]
            if source:
                c = [value[r] for value in source]
                N, dN = share.radiance(*c), list(share.slopes(*c))
            if emission_density:
                g, j = density_weights[r % self.channels], [value[r] for value in emission_density]
                N += g.weights[0] * j[0] + g.weights[1] * j[1]
                dN = [d + g.slopes[0][q] * j[0] + g.slopes[1][q] * j[1] for q, d in enumerate(dN)]
            integrals.append(CellIntegral(share.tau, share.T, N, [share.half, share.half], dN))
        return integrals

    def integrate_constant(self, piece: RayPiece, sigma: list[mi.Float]) -> list[CellIntegral]:
        finite = dr.isfinite(piece.dt)
        near = RayPiece(piece.body, piece.ray, piece.a, dr.select(finite, piece.dt, 0), piece.on)
        integrals = self.integrate_cell(near, [[s] * len(self.points) for s in sigma])
        source, emission_density = self._detached(near, self.points[:1])
        return [
            _extend_to_infinity(
                integral,
                piece.on & ~finite & (s > 0),
                s,
                source[0][r] if source else 0,
                emission_density[0][r] if emission_density else 0,
            )
            for r, (integral, s) in enumerate(zip(integrals, sigma, strict=True))
        ]

    def vjp(self, piece: RayPiece, sigma: list[list[mi.Float]], weight: list[mi.Float]) -> None:
        body, factor = piece.body, mi.Spectrum(*weight)
        if not body.view.emits:
            return
        by_source, by_density, per_sigma = self._weights(piece, sigma)
        with dr.resume_grad():
            light = self._cell_light(piece, by_source, by_density)
            if dr.grad_enabled(light):
                dr.backward_from(dr.select(piece.on, factor * light, 0))
        if body.view.emission is None or body.view.albedo is not None:
            return
        for t, per in zip(_point_distances(piece, self.points), per_sigma, strict=True):
            Le, fraction = self._emitted(piece, t)
            for name, by in (("sigma_a", 1 - fraction), ("sigma_s", -fraction)):
                rows = factor * per * Le * by
                body.vjp_extinction_at(piece.ray, t, colours_to_channels(rows, self.channels), piece.on, name)

    def jvp(self, piece: RayPiece, sigma: list[list[mi.Float]]) -> list[mi.Float]:
        body = piece.body
        if not body.view.emits:
            return [mi.Float(0)] * self.rows
        by_source, by_density, per_sigma = self._weights(piece, sigma)
        with dr.resume_grad():
            light = self._cell_light(piece, by_source, by_density)
            change = take_tangent(light)
        if body.view.emission is not None and body.view.albedo is None:
            for t, per in zip(_point_distances(piece, self.points), per_sigma, strict=True):
                Le, fraction = self._emitted(piece, t)
                by_a, by_s = (
                    to_spectrum(body.jvp_extinction_at(piece.ray, t, self.channels, piece.on, name))
                    for name in ("sigma_a", "sigma_s")
                )
                change += per * Le * ((1 - fraction) * by_a - fraction * by_s)
        return [change[r] for r in range(self.rows)]

    def lower_bound(self, t1: mi.Float) -> float:
        return 0.0

    def _detached(self, piece: RayPiece, points: Sequence[mi.Float | float]) -> tuple[list[mi.Spectrum], list[mi.Spectrum]]:
        """Source function and emission density at points of a piece; an empty list if the medium has none."""
        view, distances = piece.body.view, _point_distances(piece, points)
        source, emission_density = [], []
        if view.emission is not None:
            source = [dr.detach(self._source(piece, t) * self._absorbed_fraction(piece, t)) for t in distances]
        if view.emission_density is not None:
            emission_density = [dr.detach(_eval_field(view.emission_density, piece, t)) for t in distances]
        return source, emission_density

    def _source(self, piece: RayPiece, t: mi.Float) -> mi.Spectrum:
        """The source function (1 - albedo) Le for a medium with an albedo, otherwise Le; attached."""
        view = piece.body.view
        Le = _eval_field(view.emission, piece, t)
        return Le if view.albedo is None else (1 - _eval_albedo(piece, t)) * Le

    def _absorbed_fraction(self, piece: RayPiece, t: mi.Float) -> mi.Spectrum:
        """sigma_a / sigma_t for a medium with both coefficients (1 in a vacuum), otherwise 1."""
        body = piece.body
        if body.view.albedo is not None:
            return mi.Spectrum(1)
        sigma_a, sigma_t = (
            to_spectrum(body.extinction_at(piece.ray, t, self.channels, piece.on, name)) for name in ("sigma_a", "sigma_")
        )
        return dr.detach(dr.select(sigma_t > 0, sigma_a / dr.select(sigma_t > 0, sigma_t, 1), 1))

    def _emitted(self, piece: RayPiece, t: mi.Float) -> tuple[mi.Spectrum, mi.Spectrum]:
        return dr.detach(_eval_field(piece.body.view.emission, piece, t)), self._absorbed_fraction(piece, t)

    def _weights(self, piece: RayPiece, sigma: list[list[mi.Float]]) -> tuple[list, list, list]:
        """Weights at each point: of the source function, of the emission density, of source function times extinction."""
        finite = dr.isfinite(piece.dt)
        dt = dr.select(finite, piece.dt, 0) / self.parts
        rows = sigma[: self.channels]
        by_source, per_sigma, by_density, ahead = [], [], [], [mi.Float(1)] * self.channels
        for part in range(self.parts):
            here = [row[2 * part : 2 * part + 2] for row in rows]
            shares = [share_opacity(dt, *row) for row in here]
            by_source += _group_by_point([s.weights for s in shares], ahead)
            per_sigma += _group_by_point([s.per_sigma for s in shares], ahead)
            if piece.body.view.emission_density is not None:
                by_density += _group_by_point([weigh_emission_density(dt, *row).weights for row in here], ahead)
            ahead = [T * s.T for T, s in zip(ahead, shares, strict=True)]
        endless = piece.on & ~finite
        if by_density:
            lengths = [dr.rcp(dr.maximum(row[0], 1e-30)) for row in rows]
            by_density[0] = dr.select(endless & (to_spectrum([r[0] for r in rows]) > 0), to_spectrum(lengths), by_density[0])
        by_source[0] = dr.select(endless & (to_spectrum([r[0] for r in rows]) > 0), 1, by_source[0])
        return by_source, by_density, per_sigma

    def _cell_light(self, piece: RayPiece, by_source: list, by_density: list) -> mi.Spectrum:
        """The light of a cell, attached to emission and albedo."""
        total, distances = mi.Spectrum(0), _point_distances(piece, self.points)
        if piece.body.view.emission is not None:
            total += sum(
                (
                    w * self._absorbed_fraction(piece, t) * self._source(piece, t)
                    for w, t in zip(by_source, distances, strict=True)
                )
            )
        if piece.body.view.emission_density is not None:
            total += sum(
                (
                    w * _eval_field(piece.body.view.emission_density, piece, t)
                    for w, t in zip(by_density, distances, strict=True)
                )
            )
        return total


@dataclass
class _SampledIntegrand(_EmissionIntegrand):
    """The same integrand at random points of each cell, for images without bias.

    The extinction is the cubic through four points of the cell. The points are antithetic in pairs, with a density in
    proportion to exp(-tau x / 2) and the optical depth tau of the cell in its clearest channel. Without the half, a cell whose
    extinction grows from 0 would have large weights behind its middle.

    Attributes:
        u: uniform random number in [0, 1) of each ray.
    """

    u: mi.Float

    @property
    def points(self) -> tuple[float, ...]:
        """The points of a cubic."""
        return 0.0, 1 / 3, 2 / 3, 1.0

    def integrate_cell(self, piece: RayPiece, sigma: list[list[mi.Float]]) -> list[CellIntegral]:
        dt, curves, count = piece.dt, [fit_cubic(*row) for row in sigma[: self.channels]], 2 * self.parts
        tau = [integrate_cubic(curve, dt, mi.Float(1)) for curve in curves]
        thinnest = 0.5 * minimum(tau)
        opacity, is_thin = one_minus_exp(thinnest), thinnest < THIN_CELL
        places, weights = [], []
        for number in range(count):
            v = (number + (1 - self.u if number % 2 else self.u)) / count
            left = 1 - v * opacity
            places.append(dr.select(is_thin, v, dr.minimum(-dr.log(left) / dr.select(is_thin, 1, thinnest), 1)))
            weights.append(dt / count * dr.select(is_thin, 1, opacity / dr.select(is_thin, 1, thinnest * left)))
        source, emission_density = self._detached(piece, places)
        integrals = []
        for r in range(self.rows):
            curve, N = curves[r % self.channels], mi.Float(0)
            for k, (x, weight) in enumerate(zip(places, weights, strict=True)):
                light = mi.Float(0)
                if source:
                    light += dr.maximum(eval_cubic(curve, x), 0) * source[k][r]
                if emission_density:
                    light += emission_density[k][r]
                N += weight * dr.exp(-integrate_cubic(curve, dt, x)) * light
            integrals.append(CellIntegral(tau[r % self.channels], dr.exp(-tau[r % self.channels]), N, [], []))
        return integrals


def _point_distances(piece: RayPiece, points: Sequence[mi.Float | float]) -> list[mi.Float]:
    """Distances of points of a piece, which are given as fractions of its length."""
    dt = dr.select(dr.isfinite(piece.dt), piece.dt, 0)
    return [dr.fma(dt, p, piece.a) for p in points]


def _join_parts(parts: list[CellIntegral]) -> CellIntegral:
    """A row of a cell from the row of its parts, the nearest first; derivatives by the points of all parts."""
    joined = parts[-1]
    for near in parts[-2::-1]:
        # More extinction in the near part dims the parts behind.
        dims = near.T * joined.N
        joined = CellIntegral(
            near.tau + joined.tau,
            near.T * joined.T,
            dr.fma(near.T, joined.N, near.N),
            near.dtau + joined.dtau,
            [dN - dims * dtau for dN, dtau in zip(near.dN, near.dtau, strict=True)] + [near.T * dN for dN in joined.dN],
        )
    return joined


def _extend_to_infinity(
    integral: CellIntegral, endless: mi.Bool, sigma: mi.Float, source: mi.Float, emission_density: mi.Float
) -> CellIntegral:
    """The integral over constants. On an endless piece the ray is opaque, with radiance source + density / sigma."""
    mean = dr.rcp(dr.select(endless, sigma, 1))
    return CellIntegral(
        dr.select(endless, OPAQUE_DEPTH, integral.tau),
        dr.select(endless, 0, integral.T),
        dr.select(endless, source + emission_density * mean, integral.N),
        [sum(integral.dtau, mi.Float(0))],
        [dr.select(endless, -emission_density * dr.square(mean), sum(integral.dN, mi.Float(0)))],
    )


def _eval_albedo(piece: RayPiece, t: mi.Float) -> mi.Spectrum:
    """The albedo at a point of a ray, attached. A stock grid repeats its border outside the box."""
    albedo = piece.body.view.albedo
    return albedo.eval(medium_interaction(piece.ray, t), piece.on) if isinstance(albedo, mi.Volume) else mi.Spectrum(albedo)


def _eval_field(field: mi.Volume | mi.Float | mi.Color3f, piece: RayPiece, t: mi.Float) -> mi.Spectrum:
    """A volume or a constant at a point of a ray, attached; 0 outside the box of a grid."""
    if not isinstance(field, mi.Volume):
        return mi.Spectrum(field)
    there = medium_interaction(piece.ray, t)
    on = piece.on & piece.body.view.holds(field, there.p)
    return dr.select(on, field.eval(there, on), 0)


def _group_by_point(pairs: list[tuple[mi.Float, mi.Float]], ahead: list[mi.Float]) -> list[mi.Spectrum]:
    """A spectrum for each of the two points, from the (first, second) pair of each channel and the transmittance ahead."""
    return [to_spectrum([T * pair[q] for T, pair in zip(ahead, pairs, strict=True)]) for q in range(2)]


class Emission:
    """The segment estimator for media that emit and absorb, without scattering.

    Args:
        media: media of the scene.
        is_sampled: the points in cells are random, for images without bias; other purposes have the quadrature.

    Bias and cost: as :func:`integrate_emission`. Variance: none, or the random points in cells.
    """

    ends_in_media = False

    def __init__(self, media: SceneMedia, is_sampled: bool = False) -> None:
        self.media, self.is_sampled = media, is_sampled

    def draw(self, sampler: mi.Sampler | SpreadSampler, active: mi.Bool) -> mi.Float | None:
        """Draw the number that places the points in cells; None for the quadrature."""
        return sampler.next_1d() if self.is_sampled else None

    def prepare_derivatives(self, ray: mi.Ray3f) -> None:
        """Prepare nothing."""

    def replayed(self) -> Emission:
        """Itself: a replay meets the emitted light again."""
        return self

    def estimate(self, segment: PathSegment, purpose: str, active: mi.Bool) -> SegmentEstimate:
        """Follow a segment to the end and sum its emission, for the purpose IMAGE, REVERSE or FORWARD."""
        media = self.media
        end = find_end(media, segment.ray, segment.medium, active)
        passed = RaySegment(segment.ray, segment.medium, end.t)
        u = segment.samples if self.is_sampled and purpose == IMAGE else None
        composite = integrate_emission(media, passed, active, tangent=purpose == FORWARD, u=u)
        shared = _EmittingSegment(media, segment, passed, composite, active)
        light = SegmentLight(shared, dr.select(active, shared.weight * shared.rows(0), 0), is_replayed=True)
        T = transmittance([mi.Float(t) for t in composite.tau[: media.channels]])
        return SegmentEstimate(end, T, light, SegmentTransmittance(shared))


@dataclass
class _EmittingSegment:
    """A segment with its composite, and the derivatives of its light and transmittance (a ``SharedSegment``).

    Rows of the composite hold the light of each colour, then the tangents if tangents are followed.
    """

    media: SceneMedia
    segment: PathSegment
    passed: RaySegment
    composite: Composite
    active: mi.Bool
    dL: mi.Spectrum | None = None

    @property
    def weight(self) -> mi.Spectrum:
        """Factor on the light of the media: throughput times the weight of emission."""
        w_mis = self.segment.emission_weight
        return self.segment.beta if w_mis is None else self.segment.beta * w_mis

    def rows(self, block: int) -> mi.Spectrum:
        """The light (block 0) or its tangent (block 1)."""
        k = dr.size_v(mi.Spectrum)
        return mi.Spectrum(*self.composite.N[block * k : (block + 1) * k])

    def vjp_light(self, dL: mi.Spectrum) -> None:
        """Do nothing: the sweep in :meth:`vjp` finds the derivatives of light and transmittance together."""

    def vjp(self, dlog: mi.Spectrum) -> None:
        vjp_emission(self.media, self.passed, self.composite, self.dL * self.weight, dlog, self.active)

    def jvp_light(self) -> mi.Spectrum:
        return dr.select(self.active, self.weight * self.rows(1), 0)

    def jvp_transmittance(self) -> mi.Spectrum:
        k = dr.size_v(mi.Spectrum)
        dtau = to_spectrum([mi.Float(t) for t in self.composite.tau[k : k + self.media.channels]])
        return -dr.select(self.active, dtau, 0)


# -- Cells ------------------------------------------------------------------------------------------------------------------


MAX_PARTS = 8
"""Largest number of parts of a cell: voxels of an emission may be an eighth of the extinction's."""

EDGE_PARTS = 4
"""Parts of a cell if the box of an emission ends inside of cells."""


def voxel_to_cell_ratio(volume: mi.Volume, view: MediumView) -> float:
    """Edge of a voxel of the volume over the longest edge of a walked cell, both in the volume's lengths."""
    voxels = _cells_in_voxels(volume, view)
    return 1 / float(np.linalg.norm(voxels[:3, :3], axis=0).max())


def count_parts(view: MediumView) -> int:
    """Number of equal parts into which the cells of a medium are cut, for its emission and its albedo."""
    parts = 1
    for volume in (view.emission, view.albedo) if view.emission is not None and view.walked_lattice is not None else ():
        if not isinstance(volume, mi.Volume) or volume.class_name() == "ConstVolume":
            continue
        # 1e-4: the place of a stock grid is known to 5e-6.
        parts = max(parts, int(np.ceil(1 / voxel_to_cell_ratio(volume, view) - 1e-4)))
        if volume is view.emission:
            parts = max(parts, _edge_parts(volume, view))
    return min(parts, MAX_PARTS)


def _cells_in_voxels(volume: mi.Volume, view: MediumView) -> np.ndarray:
    """The matrix (4, 4) from the walked cells, counted along their axes, to the voxels of a volume."""
    cells = view.walked_lattice
    place = volume.mivol_to_world if hasattr(volume, "mivol_to_world") else view.stock_boxes[volume.ptr].to_world
    to_cells = cells.to_world @ np.diag([*(1 / np.array(cells.res[::-1])), 1.0])
    return np.diag([*np.array(volume.resolution(), dtype=np.float64), 1.0]) @ np.linalg.solve(place, to_cells)


def _edge_parts(volume: mi.Volume, view: MediumView) -> int:
    """Parts of a cell with which the faces of a volume's box fall between parts; at most ``EDGE_PARTS``."""
    cells, size = np.linalg.inv(_cells_in_voxels(volume, view)), np.array(volume.resolution(), dtype=np.float64)
    if not _is_upright(cells[:3, :3]):
        return EDGE_PARTS
    faces = np.sort(np.stack([cells[:3, 3], cells[:3, :3] @ size + cells[:3, 3]]), axis=0)
    # Cells lie between voxel centres; beyond the last of them matter is constant up to the box.
    faces = faces[(faces > 1e-4) & (faces < np.array(view.walked_lattice.res[::-1]) - 1e-4)] - 0.5
    return next(n for n in (1, 2, EDGE_PARTS) if n == EDGE_PARTS or (np.abs(n * faces - np.round(n * faces)) < 1e-4).all())


def _is_upright(steps: np.ndarray) -> bool:
    """Whether each axis of one grid runs along an axis of the other."""
    return bool((np.count_nonzero(np.abs(steps) > 1e-6 * np.abs(steps).max(), axis=0) == 1).all())
