r"""The slow, obvious twins of emission: the light that media send along a ray, in float64 NumPy, written for reading.

.. math:: L = \int_0^D T(t) \sum_m \Big( \sigma_m (1 - \alpha_m) L_{e,m} + j_m \Big) dt + T(D) B, \qquad
          T(t) = \exp\Big(-\int_0^t \sum_m \sigma_m\Big)

Conventions. Those of tests/oracle.py. A field is a number, an rgb triple, or a (grid, to_world) pair, which is 0 outside its
box. :func:`radiance` is the integral itself, to 1e-10; :func:`cell_radiance` is what the rule of
mivol/transport/traversal/interpolation.py makes of it, cell by cell, so that its derivatives may be had by differences.

Nothing here knows Dr.Jit, Mitsuba or mivol.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from oracle import GAUSS_2, crossings, overlap, to_lattice, trilinear, with_channels

Interval = Callable[[np.ndarray, np.ndarray], tuple[float, float]]


@dataclass(frozen=True)
class Ray:
    """o + t d."""

    o: np.ndarray
    d: np.ndarray

    def at(self, field: object, t: np.ndarray) -> np.ndarray:
        """A field at distances t (m,), as (m, 3)."""
        if not isinstance(field, tuple):
            return np.broadcast_to(np.asarray(field, dtype=np.float64), (len(t), 3))
        values, to_world = field
        q, dq = to_lattice(values, to_world, self.o, self.d)
        points = q + np.asarray(t)[:, None] * dq
        n = np.array(values.shape[2::-1])
        inside = np.all((points >= -0.5 - 1e-9) & (points <= n - 0.5 + 1e-9), axis=1)
        found = trilinear(values, np.clip(points, -0.5, n - 0.5)) * inside[:, None]
        return np.broadcast_to(found, (len(t), 3))

    def breaks(self, field: object, t0: float, t1: float) -> np.ndarray:
        """Distances between t0 and t1 at which a field may have a kink or a step."""
        if not isinstance(field, tuple):
            return np.empty(0)
        return crossings(with_channels(field[0]), field[1], self.o, self.d, t0, t1)


@dataclass(frozen=True)
class Medium:
    """A medium in the interval(o, d) of its boundary; `albedo` takes its share off the source; the rule cuts cells."""

    sigma: object
    source: object = 0.0
    emission_density: object = 0.0
    albedo: object = 0.0
    interval: Interval = lambda o, d: (-math.inf, math.inf)
    parts: int = 1

    @property
    def fields(self) -> tuple:
        return self.sigma, self.source, self.emission_density, self.albedo

    def at(self, ray: Ray, t: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Extinction, source function and density at distances t."""
        return ray.at(self.sigma, t), (1 - ray.at(self.albedo, t)) * ray.at(self.source, t), ray.at(self.emission_density, t)


# -- The integral itself -------------------------------------------------------------------------------------------------

NODES, WEIGHTS = (x / 2 for x in np.polynomial.legendre.leggauss(8))
NODES = NODES + 0.5
# Integral of each Lagrange polynomial from 0 to each node.
BASIS = np.linalg.inv(np.vander(NODES, increasing=True))
RUNNING = np.array([[sum(c * x ** (k + 1) / (k + 1) for k, c in enumerate(BASIS[:, n])) for n in range(8)] for x in NODES])


def radiance(media: list[Medium], o: np.ndarray, d: np.ndarray, background: object = 0.0, end: float = math.inf) -> np.ndarray:
    """Light (n, 3) that arrives along rays (n, 3) from up to `end`, where `background` begins."""
    rays = zip(np.atleast_2d(o), np.atleast_2d(d), strict=True)
    return np.array([_radiance(media, Ray(*ray), background, end) for ray in rays])


def _radiance(media: list[Medium], ray: Ray, background: object, end: float) -> np.ndarray:
    inside = [overlap((0, end), m.interval(ray.o, ray.d)) for m in media]
    edges = [np.array(i) for i in inside] + [
        ray.breaks(f, *i) for m, i in zip(media, inside, strict=True) for f in m.fields if i[1] > i[0]
    ]
    edges = _finite(np.concatenate(edges))
    L, tau = np.zeros(3), np.zeros(3)
    for a, b in itertools.pairwise(edges):
        here = [m for m, i in zip(media, inside, strict=True) if i[0] <= (a + b) / 2 <= i[1]]
        if not here or b - a < 1e-12:
            continue
        peak = max(sum(m.at(ray, np.linspace(a, b, 5))[0] for m in here).max(), 0)
        pieces = np.linspace(a, b, 2 + math.ceil(2 * peak * (b - a)))
        for lo, hi in itertools.pairwise(pieces):
            h, found = hi - lo, [m.at(ray, lo + (hi - lo) * NODES) for m in here]
            sigma = sum(s for s, _, _ in found)
            power = sum(s * c + j for s, c, j in found)
            depth = tau + h * RUNNING @ sigma
            L += h * WEIGHTS @ (np.exp(-depth) * power)
            tau += h * WEIGHTS @ sigma
    return L + np.exp(-tau) * np.asarray(background, dtype=np.float64)


def _finite(edges: np.ndarray) -> np.ndarray:
    """Each distance once; a medium without a boundary begins and ends with its grids."""
    return np.unique(edges[np.isfinite(edges)])


# -- The rule, cell by cell ------------------------------------------------------------------------------------------------


def share(dt: np.ndarray, s1: np.ndarray, s2: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Weights of the source function at the two Gauss points of a cell: its opacity, shared out."""
    x = 0.5 * dt * (s1 + s2) / math.sqrt(3)
    first = s1 * (1 + x + x * x / 2 + x**3 / (6 + 3 * x))
    f = np.where(first + s2 > 0, first / np.where(first + s2 > 0, first + s2, 1), 0.5)
    alpha = -np.expm1(-0.5 * dt * (s1 + s2))
    return alpha * f, alpha * (1 - f)


def weigh_emission_density(dt: np.ndarray, s1: np.ndarray, s2: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Weights of the emission density at the two Gauss points: what exp(-tau u + lean u (1 - u)) lets out, and from where."""
    tau, lean = np.asarray(0.5 * dt * (s1 + s2)), np.asarray(0.5 * math.sqrt(3) * dt * (s2 - s1))
    u, w = np.polynomial.legendre.leggauss(16)
    ends = np.append(0, np.geomspace(1e-8, 1, 24))
    u = np.concatenate([a + (b - a) * (u + 1) / 2 for a, b in itertools.pairwise(ends)])
    w = np.concatenate([(b - a) / 2 * w for a, b in itertools.pairwise(ends)])
    fade, bend = np.exp(-tau[..., None] * u) * w, lean[..., None] * u * (1 - u)
    total = (fade * (1 + bend + bend**2 / 2)).sum(-1)
    # The mean of u to first order in the slope.
    E0, E1, D0, D1 = ((fade * f).sum(-1) for f in (1, u, bend, u * bend))
    place = E1 / E0 + D1 / E0 - D0 * E1 / E0**2
    v = np.clip((place - GAUSS_2[0]) / (GAUSS_2[1] - GAUSS_2[0]), 0, 1)
    return dt * total * (1 - v), dt * total * v


def cell_radiance(medium: Medium, o: np.ndarray, d: np.ndarray, background: object = 0.0, end: float = math.inf) -> np.ndarray:
    """As :func:`radiance`, of one medium, by the rule: cells are those of its extinction's grid, or of its light's."""
    return chain_radiance([medium], o, d, background, end)


def chain_radiance(
    media: list[Medium], o: np.ndarray, d: np.ndarray, background: object = 0.0, end: float = math.inf
) -> np.ndarray:
    """As :func:`cell_radiance`, of media that do not overlap, in any order: each is the background of what is before it."""
    found = []
    for ray in itertools.starmap(Ray, zip(np.atleast_2d(o), np.atleast_2d(d), strict=True)):
        light = background
        for medium in sorted(media, key=lambda m, ray=ray: -overlap((0, end), m.interval(ray.o, ray.d))[0]):
            light = _cell_radiance(medium, ray, light, end)
        found.append(light)
    return np.array(found)


def _cell_radiance(medium: Medium, ray: Ray, background: object, end: float) -> np.ndarray:
    t0, t1 = overlap((0, end), medium.interval(ray.o, ray.d))
    guide = next((f for f in medium.fields if isinstance(f, tuple)), None)
    edges = _finite(np.concatenate([[t0, t1], ray.breaks(guide, t0, t1)]))
    L, T = np.zeros(3), np.ones(3)
    cut = [np.linspace(a, b, medium.parts + 1) for a, b in itertools.pairwise(edges)]
    for a, b in itertools.chain.from_iterable(map(itertools.pairwise, cut)):
        sigma, source, j = medium.at(ray, a + (b - a) * np.array(GAUSS_2))
        w = share(b - a, *sigma)
        L += T * (w[0] * source[0] + w[1] * source[1])
        if np.any(j):
            g = weigh_emission_density(b - a, *sigma)
            L += T * (g[0] * j[0] + g[1] * j[1])
        T *= np.exp(-0.5 * (b - a) * (sigma[0] + sigma[1]))
    return L + T * np.asarray(background, dtype=np.float64)


def differences(f: Callable[[np.ndarray], float], x: np.ndarray, step: float = 1e-4) -> np.ndarray:
    """The gradient of a function of an array, by central differences of fourth order, element by element."""
    gradient = np.zeros(x.shape)
    for index in np.ndindex(x.shape):
        unit = np.zeros(x.shape)
        unit[index] = step
        near, far = f(x + unit) - f(x - unit), f(x + 2 * unit) - f(x - 2 * unit)
        gradient[index] = (8 * near - far) / (12 * step)
    return gradient
