r"""The slow, obvious twins of single scattering: light that turns once, in float64 NumPy, written for reading.

.. math:: L = \sum_m \int T(0,t)\,\sigma_m(x_t)\,\alpha_m(x_t) \int p_m(\omega\cdot\omega')\,L_i(x_t,\omega')\,d\omega'\,dt
    + T(0,D)\,B, \qquad T = \exp\Big(-\sum_m\int\sigma_m\Big)

Conventions. Those of tests/oracle.py: grids (Z, Y, X[, C]) at voxel centres in the unit cube under `to_world`, vacuum
outside, points ordered (x, y, z), |d| = 1 so that t is a world length. A ray runs along d; light comes to a point x from
the direction w (from x towards the emitter), so that the cosine of the scattering angle is -(-d).w = d.w: 1 is forward.
Many rays (n, 3) at once; colours are (n, C), and one channel stands for all that are equal.

Nothing here knows Dr.Jit, Mitsuba or mivol. Closed forms are at the end, with their sources.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from oracle import GAUSS_2, corner_weights, grid_shape, with_channels
from scipy.special import exp1

# -- Phase functions, of the cosine of the scattering angle ----------------------------------------------------------------


def isotropic(c: np.ndarray) -> np.ndarray:
    """1/(4 pi)."""
    return np.full_like(np.asarray(c, dtype=np.float64), 1 / (4 * math.pi))


def rayleigh(c: np.ndarray) -> np.ndarray:
    """3/(16 pi) (1 + c^2)."""
    return 3 / (16 * math.pi) * (1 + np.square(c))


def hg(g: float) -> Callable[[np.ndarray], np.ndarray]:
    """Henyey, Greenstein 1941: g > 0 is forward."""
    return lambda c: (1 - g * g) / (4 * math.pi * (1 + g * g - 2 * g * np.asarray(c)) ** 1.5)


def hg_slope(g: float) -> Callable[[np.ndarray], np.ndarray]:
    """d p / d g of :func:`hg`."""

    def slope(c: np.ndarray) -> np.ndarray:
        D = 1 + g * g - 2 * g * np.asarray(c)
        return (-2 * g * D**-1.5 - 1.5 * (1 - g * g) * (2 * g - 2 * c) * D**-2.5) / (4 * math.pi)

    return slope


# -- Fields: what is where, and how deep -----------------------------------------------------------------------------------


class Field(Protocol):
    """An extinction that many rays can be sent through at once."""

    def sigma(self, x: np.ndarray) -> np.ndarray:
        """(n, C) at points (n, 3)."""

    def edges(self, o: np.ndarray, d: np.ndarray) -> np.ndarray:
        """(n, K) distances between which the field is smooth along rays (n, 3), sorted, not clipped."""

    def tau(self, o: np.ndarray, d: np.ndarray, t_max: np.ndarray) -> np.ndarray:
        """(n, C) optical depth of [0, t_max]."""


def slab_intervals(o: np.ndarray, d: np.ndarray, low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Intervals of t of rays (n, 3) inside a box along the axes; (0, 0) where a ray misses it."""
    with np.errstate(divide="ignore", invalid="ignore"):
        a, b = (low - o) / d, (high - o) / d
    flat = d == 0
    inside = (o >= low) & (o <= high)
    first = np.where(flat, np.where(inside, -np.inf, np.inf), np.minimum(a, b)).max(axis=1)
    last = np.where(flat, np.where(inside, np.inf, -np.inf), np.maximum(a, b)).min(axis=1)
    hit = first < last
    return np.where(hit, first, 0.0), np.where(hit, last, 0.0)


def into(to_world: np.ndarray, o: np.ndarray, d: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rays (n, 3) in the frame where the box is the unit cube, with the same t."""
    to_world = np.asarray(to_world, dtype=np.float64)
    inverse = np.linalg.inv(to_world[:3, :3]).T
    return (o - to_world[:3, 3]) @ inverse, d @ inverse


@dataclass
class Grid:
    """A trilinear grid: `values` (Z, Y, X[, C]) times `scale` in the unit cube under `to_world`."""

    values: np.ndarray
    to_world: np.ndarray
    scale: float = 1.0

    def _lattice(self, o: np.ndarray, d: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        n = np.array(grid_shape(self.values), dtype=np.float64)
        u, du = into(self.to_world, o, d)
        return u * n - 0.5, du * n

    def sigma(self, x: np.ndarray) -> np.ndarray:
        q, _ = self._lattice(x, np.zeros_like(x))
        n = np.array(grid_shape(self.values))
        inside = np.all((q >= -0.5) & (q <= n - 0.5), axis=1)
        return self.scale * self.read(q) * inside[:, None]

    def read(self, q: np.ndarray) -> np.ndarray:
        """Values (n, C) at lattice coordinates, borders going on for ever."""
        values = with_channels(self.values)
        return sum(weight[:, None] * values[node] for node, weight in corner_weights(grid_shape(values), q))

    def edges(self, o: np.ndarray, d: np.ndarray) -> np.ndarray:
        n = np.array(grid_shape(self.values))
        q, dq = self._lattice(o, d)
        a, b = slab_intervals(q, dq, np.full(3, -0.5), n - 0.5)
        planes = [a, b]
        for axis in range(3):
            with np.errstate(divide="ignore", invalid="ignore"):
                t = (np.arange(n[axis])[None] - q[:, axis : axis + 1]) / dq[:, axis : axis + 1]
            # A plane outside [a, b], or one that is never crossed, becomes a point at the entry: an interval of length 0.
            planes += list(np.where((t > a[:, None]) & (t < b[:, None]), t, a[:, None]).T)
        return np.sort(np.stack(planes, axis=1), axis=1)

    def nodes(self, o: np.ndarray, d: np.ndarray, t_max: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Ray (m,), lattice point (m, 3) and weight (m,): two Gauss points a cell, exact for a cubic."""
        t = np.clip(self.edges(o, d), 0, np.asarray(t_max)[:, None])
        # Most intervals are empty: ends of planes that the ray does not cross.
        ray, cell = np.nonzero(t[:, 1:] > t[:, :-1])
        start, length = t[ray, cell], t[ray, cell + 1] - t[ray, cell]
        q, dq = self._lattice(o, d)
        points = np.concatenate([q[ray] + (start + g * length)[:, None] * dq[ray] for g in GAUSS_2])
        return np.tile(ray, 2), points, np.tile(length / 2, 2)

    def tau(self, o: np.ndarray, d: np.ndarray, t_max: np.ndarray) -> np.ndarray:
        ray, q, weight = self.nodes(o, d, t_max)
        sigma = self.read(q)
        return self.scale * np.stack([np.bincount(ray, weight * s, len(o)) for s in sigma.T], axis=1)

    def weigh(self, row: np.ndarray, x: np.ndarray, weight: np.ndarray) -> None:
        """Add sum_i weight_i d sigma(x_i) / d values to `row` (Z, Y, X)."""
        q, _ = self._lattice(x, np.zeros_like(x))
        inside = np.all((q >= -0.5) & (q <= np.array(grid_shape(self.values)) - 0.5), axis=1)
        self._add(row, q, weight * inside)

    def weigh_tau(self, row: np.ndarray, o: np.ndarray, d: np.ndarray, t_max: np.ndarray, weight: np.ndarray) -> None:
        """Add sum_i weight_i d tau_i / d values to `row` (Z, Y, X)."""
        ray, q, length = self.nodes(o, d, t_max)
        self._add(row, q, weight[ray] * length)

    def _add(self, row: np.ndarray, q: np.ndarray, weight: np.ndarray) -> None:
        """Add weights (m,) at lattice points (m, 3): the transpose of :meth:`read`."""
        for node, corner in corner_weights(grid_shape(self.values), q):
            index = np.ravel_multi_index(node, row.shape)
            row += np.bincount(index, self.scale * weight * corner, row.size).reshape(row.shape)


class Constant:
    """A constant extinction (C,) between two ``edges`` of each ray."""

    def tau(self, o: np.ndarray, d: np.ndarray, t_max: np.ndarray) -> np.ndarray:
        t = np.clip(self.edges(o, d), 0, np.asarray(t_max)[:, None])
        return (t[:, 1:] - t[:, :1]) * np.atleast_1d(self.constant)


@dataclass
class Box(Constant):
    """A constant extinction (C,) in the unit cube under `to_world`."""

    constant: np.ndarray
    to_world: np.ndarray

    def edges(self, o: np.ndarray, d: np.ndarray) -> np.ndarray:
        return np.stack(slab_intervals(*into(self.to_world, o, d), np.zeros(3), np.ones(3)), axis=1)

    def sigma(self, x: np.ndarray) -> np.ndarray:
        u, _ = into(self.to_world, x, np.zeros_like(x))
        return np.all((u >= 0) & (u <= 1), axis=1)[:, None] * np.atleast_1d(self.constant)


@dataclass
class Ball(Constant):
    """A constant extinction (C,) in a sphere."""

    constant: np.ndarray
    centre: np.ndarray
    radius: float

    def edges(self, o: np.ndarray, d: np.ndarray) -> np.ndarray:
        m = o - np.asarray(self.centre)
        b = np.sum(m * d, axis=1)
        root = b * b - np.sum(m * m, axis=1) + self.radius**2
        half = np.sqrt(np.maximum(root, 0))
        return np.stack([np.where(root > 0, -b - half, 0.0), np.where(root > 0, -b + half, 0.0)], axis=1)

    def sigma(self, x: np.ndarray) -> np.ndarray:
        inside = np.sum((x - np.asarray(self.centre)) ** 2, axis=1) <= self.radius**2
        return inside[:, None] * np.atleast_1d(self.constant)


def box_edges(to_world: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A point on each of the 12 edges of a placed unit cube, and the direction of each, (12, 3)."""
    points, along = [], []
    for axis in range(3):
        for corner in np.ndindex(2, 2):
            points.append(np.insert(np.array(corner, dtype=np.float64), axis, 0.0))
            along.append(np.eye(3)[axis])
    linear, shift = np.asarray(to_world)[:3, :3], np.asarray(to_world)[:3, 3]
    return np.array(points) @ linear.T + shift, np.array(along) @ linear.T


def shadow_kinks(field: Field, emitter: Emitter, o: np.ndarray, d: np.ndarray) -> np.ndarray:
    """(n, K) distances at which the way to an emitter begins to leave a box by another face: its depth has a kink there.

    The planes through an edge of the box and the emitter; a sky has no such places, only many of them, averaged.
    """
    if not hasattr(field, "to_world") or not hasattr(emitter, "place"):
        return np.zeros((len(o), 0))
    a, e = box_edges(field.to_world)
    where, is_far = emitter.place
    normal = np.cross(e, np.asarray(where) - (0 if is_far else a))
    with np.errstate(divide="ignore", invalid="ignore"):
        t = (np.sum(normal * a, axis=1) - o @ normal.T) / (d @ normal.T)
    return np.where(np.isfinite(t), t, 0.0)


@dataclass
class Medium:
    """A field, its albedo (a number, (C,), or a callable x -> (n, C)) and its phase function of the cosine."""

    field: Field
    albedo: object
    phase: Callable[[np.ndarray], np.ndarray] = isotropic

    def albedo_at(self, x: np.ndarray) -> np.ndarray:
        return self.albedo(x) if callable(self.albedo) else np.broadcast_to(self.albedo, (len(x), np.size(self.albedo)))


def trilinear_albedo(values: np.ndarray, to_world: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
    """An albedo read from a grid."""
    return Grid(values, to_world).sigma


# -- Emitters: for each point the directions that light comes from, how far that is, and how much (weights included) ----------


class Emitter(Protocol):
    """Light that arrives at points (n, 3) if nothing is in the way."""

    def shine(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Towards the emitter (n, K, 3), distance (n, K), radiance times solid angle (n, K, C) of K directions."""

    def edges(self, o: np.ndarray, d: np.ndarray) -> np.ndarray:
        """(n, J) distances along rays at which the light changes fast."""


@dataclass
class Point:
    """Intensity (C,) [W/sr] at a point."""

    position: np.ndarray
    intensity: object = 1.0

    @property
    def place(self) -> tuple[np.ndarray, bool]:
        return self.position, False

    def shine(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        away = np.asarray(self.position, dtype=np.float64) - x
        r = np.linalg.norm(away, axis=1)
        w = away / r[:, None]
        light = np.atleast_1d(self.intensity) * (self.falloff(-w) / r**2)[:, None]
        return w[:, None], r[:, None], light[:, None]

    def falloff(self, w: np.ndarray) -> np.ndarray:
        return np.ones(len(w))

    def edges(self, o: np.ndarray, d: np.ndarray) -> np.ndarray:
        away = np.asarray(self.position, dtype=np.float64) - o
        middle = np.sum(away * d, axis=1)
        h = np.sqrt(np.maximum(np.sum(away * away, axis=1) - middle**2, 1e-300))
        steps = np.concatenate([[0], np.geomspace(0.25, 2**14, 17)])
        steps = np.unique(np.concatenate([-steps, steps]))
        return middle[:, None] + h[:, None] * steps


@dataclass
class Spot(Point):
    """A point whose intensity is full within `beam`, 0 beyond `cutoff`, linear in the angle between [rad]; along `axis`."""

    axis: np.ndarray = (0.0, 0.0, 1.0)
    cutoff: float = 0.5
    beam: float = 0.3

    def falloff(self, w: np.ndarray) -> np.ndarray:
        axis = np.asarray(self.axis) / np.linalg.norm(self.axis)
        angle = np.arccos(np.clip(w @ axis, -1, 1))
        return np.clip((self.cutoff - angle) / (self.cutoff - self.beam), 0, 1)

    def edges(self, o: np.ndarray, d: np.ndarray) -> np.ndarray:
        # Where the ray meets the cones of both angles: a quadratic in t.
        axis = np.asarray(self.axis) / np.linalg.norm(self.axis)
        m = o - np.asarray(self.position)
        roots = [super().edges(o, d)]
        for angle in (self.cutoff, self.beam):
            k = math.cos(angle) ** 2
            da, ma = d @ axis, m @ axis
            a, b, c = da * da - k, da * ma - k * np.sum(m * d, 1), ma * ma - k * np.sum(m * m, 1)
            root = np.sqrt(np.maximum(b * b - a * c, 0))
            roots += [((-b - root) / a)[:, None], ((-b + root) / a)[:, None]]
        return np.concatenate(roots, axis=1)


@dataclass
class Directional:
    """Irradiance (C,) across the direction of travel."""

    direction: np.ndarray
    irradiance: object = 1.0

    @property
    def place(self) -> tuple[np.ndarray, bool]:
        return self.direction, True

    def shine(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        w = -np.asarray(self.direction, dtype=np.float64)
        w = np.broadcast_to(w / np.linalg.norm(w), (len(x), 1, 3))
        light = np.broadcast_to(np.atleast_1d(self.irradiance), (len(x), 1, np.size(self.irradiance)))
        return w, np.full((len(x), 1), np.inf), light

    def edges(self, o: np.ndarray, d: np.ndarray) -> np.ndarray:
        return np.zeros((len(o), 0))


@dataclass
class Sky:
    """Radiance from everywhere: (C,), or a callable w (k, 3) -> (k, C); `n` Gauss nodes in z times 2 n in the azimuth."""

    radiance: object = 1.0
    n: int = 16

    def directions(self) -> tuple[np.ndarray, np.ndarray]:
        """(K, 3) and their solid angles (K,)."""
        z, weight = np.polynomial.legendre.leggauss(self.n)
        azimuth = (np.arange(2 * self.n) + 0.5) * math.pi / self.n
        z, azimuth = (a.ravel() for a in np.meshgrid(z, azimuth, indexing="ij"))
        s = np.sqrt(1 - z * z)
        return np.stack([s * np.cos(azimuth), s * np.sin(azimuth), z], axis=1), np.repeat(weight, 2 * self.n) * math.pi / self.n

    def shine(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        w, solid = self.directions()
        light = self.radiance(w) if callable(self.radiance) else np.atleast_1d(self.radiance)
        light = np.broadcast_to(light * solid[:, None], (len(x), len(w), np.shape(light)[-1]))
        return np.broadcast_to(w, (len(x), *w.shape)), np.full((len(x), len(w)), np.inf), light

    def edges(self, o: np.ndarray, d: np.ndarray) -> np.ndarray:
        return np.zeros((len(o), 0))


# -- The integral ------------------------------------------------------------------------------------------------------------


def nodes_along(
    media: Sequence[Medium],
    emitters: Sequence[Emitter],
    o: np.ndarray,
    d: np.ndarray,
    t0: np.ndarray,
    t1: np.ndarray,
    order: int,
) -> tuple[np.ndarray, np.ndarray]:
    """Distances and weights (n, K): Gauss-Legendre of an order between every two edges of media and emitters."""
    cuts = [m.field.edges(o, d) for m in media] + [emitter.edges(o, d) for emitter in emitters] + [t0[:, None], t1[:, None]]
    cuts += [shadow_kinks(m.field, emitter, o, d) for m in media for emitter in emitters]
    t = np.sort(np.clip(np.concatenate(cuts, axis=1), t0[:, None], t1[:, None]), axis=1)
    x, w = np.polynomial.legendre.leggauss(order)
    length = np.diff(t, axis=1)
    at = t[:, :-1, None] + length[..., None] * (x + 1) / 2
    return at.reshape(len(o), -1), (length[..., None] * w / 2).reshape(len(o), -1)


def as_rays(o: np.ndarray, d: np.ndarray, *ends: object) -> list[np.ndarray]:
    """Rays (n, 3) and numbers (n,), float64."""
    o, d = np.broadcast_arrays(*(np.atleast_2d(np.asarray(v, dtype=np.float64)) for v in (o, d)))
    return [o, d, *(np.broadcast_to(np.asarray(e, dtype=np.float64), len(o)) for e in ends)]


def total_tau(media: Sequence[Medium], o: np.ndarray, d: np.ndarray, t_max: np.ndarray) -> np.ndarray:
    """(n, C) through all media."""
    return sum(m.field.tau(o, d, t_max) for m in media)


@dataclass
class Turned:
    """Every turn of light that the quadrature sees: one row for each ray, distance and direction to an emitter.

    Attributes:
        ray: index of the ray.
        t, x: where the light turns.
        w, r: towards the emitter, and how far it is.
        light: T(camera) p Li T(shadow) times the quadrature weight (n, C), without sigma and albedo of the medium.
        medium: index of the medium that turns it.
    """

    ray: np.ndarray
    t: np.ndarray
    x: np.ndarray
    w: np.ndarray
    r: np.ndarray
    light: np.ndarray
    medium: int

    def contribution(self, media: Sequence[Medium]) -> np.ndarray:
        """(n, C) of the radiance."""
        m = media[self.medium]
        return self.light * m.field.sigma(self.x) * m.albedo_at(self.x)


def turns(
    media: Sequence[Medium],
    emitters: Sequence[Emitter],
    o: np.ndarray,
    d: np.ndarray,
    t0: object = 0.0,
    t1: object = math.inf,
    order: int = 6,
    phases: Sequence[Callable] | None = None,
    blocked: Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray] | None = None,
) -> list[Turned]:
    """All turns along rays (n, 3) between t0 and t1.

    Args:
        phases: in the place of the media's own (a derivative, say).
        blocked: (x, w, r) -> (n,), True where something opaque stands between a point and an emitter.
    """
    o, d, t0, t1 = as_rays(o, d, t0, t1)
    ends = np.concatenate([m.field.edges(o, d) for m in media], axis=1)
    t0, t1 = np.maximum(t0, np.maximum(ends.min(axis=1), 0)), np.minimum(t1, np.maximum(ends.max(axis=1), 0))
    found = []
    for emitter in emitters:
        t, weight = nodes_along(media, [emitter], o, d, t0, np.maximum(t0, t1), order)
        ray = np.repeat(np.arange(len(o)), t.shape[1])
        t, weight = t.ravel(), weight.ravel()
        on = weight > 0
        ray, t, weight = ray[on], t[on], weight[on]
        x = o[ray] + t[:, None] * d[ray]
        w, r, light = emitter.shine(x)
        k = w.shape[1]
        ray, t, x, weight = (np.repeat(a, k, axis=0) for a in (ray, t, x, weight))
        w, r, light = w.reshape(-1, 3), r.ravel(), light.reshape(len(x), -1)
        tau = np.repeat(total_tau(media, o[ray[::k]], d[ray[::k]], t[::k]), k, axis=0) + total_tau(media, x, w, r)
        through = light * np.exp(-tau) * weight[:, None]
        if blocked is not None:
            through = through * ~blocked(x, w, r)[:, None]
        cosine = np.sum(d[ray] * w, axis=1)
        for i, m in enumerate(media):
            phase = (m.phase if phases is None else phases[i])(cosine)
            found.append(Turned(ray, t, x, w, r, through * phase[:, None], i))
    return found


def radiance(
    media: Sequence[Medium],
    emitters: Sequence[Emitter],
    o: np.ndarray,
    d: np.ndarray,
    t0: object = 0.0,
    t1: object = math.inf,
    background: object = 0.0,
    order: int = 6,
    **more: object,
) -> np.ndarray:
    """Radiance (n, C) that arrives along rays (n, 3): what turned once, and the background through all media."""
    o, d, t0, t1 = as_rays(o, d, t0, t1)
    L = np.atleast_1d(background) * np.exp(-total_tau(media, o, d, t1))
    for turned in turns(media, emitters, o, d, t0, t1, order, **more):
        part = turned.contribution(media)
        L = L + np.stack([np.bincount(turned.ray, part[:, c], len(o)) for c in range(part.shape[1])], axis=1)
    return L


def radiance_gradient(
    medium: Medium,
    emitters: Sequence[Emitter],
    o: np.ndarray,
    d: np.ndarray,
    weight: object = 1.0,
    background: float = 0.0,
    **more,
) -> tuple[np.ndarray, float]:
    """d/d values (Z, Y, X) and d/d albedo of sum_i weight_i L_i, for one grey medium: a grid and a constant albedo.

    Three terms: more light turns at x; less comes from x to the camera; less comes from the emitter to x. Exact derivatives
    of the very quadrature that :func:`radiance` is.
    """
    o, d, weight = as_rays(o, d, weight)
    grid, t_max = medium.field, np.full(len(o), math.inf)
    row, slope = np.zeros(grid.values.shape[:3]), 0.0
    for turned in turns([medium], emitters, o, d, **more):
        light = weight[turned.ray] * turned.light[:, 0]
        grid.weigh(row, turned.x, light * float(medium.albedo))
        lost = -light * float(medium.albedo) * grid.sigma(turned.x)[:, 0]
        grid.weigh_tau(row, o[turned.ray], d[turned.ray], turned.t, lost)
        grid.weigh_tau(row, turned.x, turned.w, turned.r, lost)
        slope += float(np.sum(light * grid.sigma(turned.x)[:, 0]))
    grid.weigh_tau(row, o, d, t_max, -weight * background * np.exp(-grid.tau(o, d, t_max)[:, 0]))
    return row, slope


# -- Closed forms ------------------------------------------------------------------------------------------------------------


def angular_integral(u: float, v: float) -> float:
    """F(u, v), integral of exp(-u tan x) over [0, v], v in [0, pi/2) (Sun et al. 2005, their Eq. 10), for u > 0.

    Im{e^{-iu} [E1(-iu) - E1(u (tan v - i))]}.
    """
    return float(np.imag(np.exp(-1j * u) * (exp1(-1j * u) - exp1(u * (math.tan(v) - 1j)))))


def point_in_fog(sigma_s: float, sigma_t: float, intensity: float, t0: float, h: float, D: float) -> float:
    """Isotropic single scattering in a homogeneous medium without end: an emitter at distance h from the ray, beside its t0.

    L = sigma_s I / (2 pi h) e^{-sigma t0} [F(sigma h, xi1) - F(sigma h, xi0)], xi = pi/4 + atan((t - t0)/h)/2 at both ends
    of [0, D] (Sun et al. 2005; Pegoraro 2010).
    """
    first, last = (math.pi / 4 + 0.5 * math.atan((t - t0) / h) for t in (0.0, D))
    F = [angular_integral(sigma_t * h, v) for v in (first, last)]
    return sigma_s * intensity / (2 * math.pi * h) * math.exp(-sigma_t * t0) * (F[1] - F[0])


def point_thin(sigma_s: float, intensity: float, t0: float, h: float, D: float, phase: str = "isotropic") -> float:
    """The same with no extinction to speak of: sigma_s I / h times the integral of the phase over the angle of the turn."""
    a, b = math.atan(-t0 / h), math.atan((D - t0) / h)
    if phase == "isotropic":
        return sigma_s * intensity * (b - a) / (4 * math.pi * h)
    swing = 1.5 * (b - a) - 0.25 * (math.sin(2 * b) - math.sin(2 * a))
    return 3 * sigma_s * intensity / (16 * math.pi * h) * swing


def slab_reflected(albedo: float, p: float, E0: float, mu: float, mu0: float, tau: float) -> float:
    """Collimated light (irradiance E0 across its direction) turned back by a slab of normal depth tau (Chandrasekhar 1960)."""
    return albedo * p * E0 * mu0 / (mu + mu0) * -math.expm1(-tau * (1 / mu + 1 / mu0))


def slab_transmitted(albedo: float, p: float, E0: float, mu: float, mu0: float, tau: float) -> float:
    """Collimated light turned once on its way through a slab; by phi1, so that mu = mu0 is no special case."""
    x = tau * (1 / mu - 1 / mu0)
    phi = -math.expm1(-x) / x if abs(x) > 1e-12 else 1 - x / 2
    return albedo * p * E0 * tau / mu * math.exp(-tau / mu0) * phi


def cube_from_the_side(albedo: float, p: float, E0: float, sigma: float, depth: float, D: float) -> float:
    """A cube lit from straight above, seen along a horizontal ray of length D inside it, `depth` below its top."""
    return albedo * p * E0 * math.exp(-sigma * depth) * -math.expm1(-sigma * D)


def ball_in_sky(albedo: float, sigma: float, R: float, b: float, B: float = 1.0, n: int = 200) -> float:
    """A homogeneous ball in a constant sky, isotropic, seen along a ray at distance b from its middle.

    By symmetry the light that reaches a point depends on its radius only: two nested Gauss-Legendre integrals, smooth.
    """
    x, w = np.polynomial.legendre.leggauss(n)
    chord = 2 * math.sqrt(R * R - b * b)
    t = chord * (x + 1) / 2
    r2 = (t - chord / 2) ** 2 + b * b
    way = -np.sqrt(r2)[:, None] * x + np.sqrt(R * R - r2[:, None] * (1 - x * x))
    S = 0.5 * np.exp(-sigma * way) @ w * B
    return float(np.sum(w * chord / 2 * sigma * albedo * np.exp(-sigma * t) * S) + B * math.exp(-sigma * chord))
