"""How exact the light along a ray is for each activation: against the same field cut finely along the ray, in float64.

``pytest -s tests/analytic/test_activation_quadrature.py`` prints the table that stands in :mod:`mivol.fields.activation`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from oracle_radiance import ACTIVATIONS as APPLY
from oracle_radiance import ROOT3, Twin, shares
from radiance_rays import see
from sampled_fields import CUBE
from scipy.ndimage import gaussian_filter, map_coordinates

from mivol.fields import activation
from mivol.fields.activation import ACTIVATIONS
from mivol.fields.spherical_grid import SphericalGrid

N, RAYS = 16, 150
DEPTHS = (0.01, 0.1, 1.0, 10.0)
"""Median optical depths of a voxel's edge."""
Y0 = 0.28209479177387814


def smooth(rng: np.random.Generator, channels: int) -> np.ndarray:
    """Noise of variance 1 without what varies over less than some two voxels: (channels, N, N, N)."""
    noise = gaussian_filter(rng.normal(size=(channels, N, N, N)), (0, 1, 1, 1), mode="nearest")
    return noise / noise.std(axis=(1, 2, 3), keepdims=True)


def densities(name: str, tau: float, u: np.ndarray) -> np.ndarray:
    """What is stored for extinctions of (tau a voxel) exp(u); for a ReLU, which would leave these as they are, 2 u instead."""
    sigma = tau * N / 2 * np.exp(u)
    return {
        "none": lambda: sigma,
        "relu": lambda: tau * N * u,
        "softplus": lambda: sigma + np.log(-np.expm1(-sigma)),
        "exp": lambda: np.log(sigma),
    }[name]()


GAUSS, MIDDLE = (0.5 - ROOT3 / 6, 0.5 + ROOT3 / 6), (0.5,)


@dataclass
class Cut:
    """Rays whose cells are cut into parts ``dt`` (rays, parts): lattice points (3, rays * parts) and colours at each place."""

    dt: np.ndarray
    points: list[np.ndarray]
    colours: list[np.ndarray]

    def render(self, density: np.ndarray, name: str) -> np.ndarray:
        """Light (rays, 3), by collocation for two places in a part and the midpoint rule for one."""
        density = np.float64(density)
        first, second = (APPLY[name](looked_up(density, at).reshape(self.dt.shape)) for at in (self.points[0], self.points[-1]))
        tau, share = shares(self.dt, first, second) if len(self.points) > 1 else (self.dt * first, np.ones_like(first))
        weight = np.exp(-(np.cumsum(tau, axis=1) - tau)) * -np.expm1(-tau)
        near, far = self.colours[0], self.colours[-1]
        return np.einsum("rp,crp->rc", weight * share, near) + np.einsum("rp,crp->rc", weight * (1 - share), far)


def looked_up(values: np.ndarray, at: np.ndarray) -> np.ndarray:
    return map_coordinates(values, at, order=1, mode="nearest")


def cut(o: np.ndarray, d: np.ndarray, colour: np.ndarray, parts: int, places: tuple[float, ...]) -> Cut:
    """Cut rays at planes through nodes, and their cells into equal parts; each ray is filled up with cells of no length."""
    twin = Twin(np.zeros((N, N, N)), np.zeros((N, N, N, 1, 3)), CUBE)
    unit = np.float64(d) / np.linalg.norm(np.float64(d), axis=1, keepdims=True)
    q, v, t = zip(*(twin.cuts(np.float64(a), b) for a, b in zip(o, unit, strict=True)), strict=True)
    t = np.array([np.pad(a, (0, max(map(len, t)) - len(a)), mode="edge") for a in t])
    dt = np.repeat(np.diff(t) / parts, parts, axis=1)
    start = np.repeat(t[:, :-1], parts, axis=1) + dt * np.tile(np.arange(parts), t.shape[1] - 1)
    points = []
    for place in places:
        at = np.array(q)[:, None] + np.array(v)[:, None] * (start + dt * place)[..., None]
        points.append(at[..., ::-1].reshape(-1, 3).T)
    return Cut(dt, points, [np.stack([looked_up(c, at).reshape(dt.shape) for c in colour]) for at in points])


@dataclass
class Work:
    """Rays, noise for densities, harmonics for colours between 0.1 and 0.9, and the rays' cells cut in all ways asked for."""

    o: np.ndarray
    d: np.ndarray
    u: np.ndarray
    sh: np.ndarray
    by: dict[int, Cut]
    midpoints: Cut


@pytest.fixture(scope="module")
def work() -> Work:
    rng = np.random.default_rng(0)
    u, colour = smooth(rng, 1)[0], 0.5 + 0.4 * np.tanh(smooth(rng, 3))
    o = np.float32(rng.normal(size=(RAYS, 3)))
    o *= 4 / np.linalg.norm(o, axis=1, keepdims=True)
    d = rng.uniform(-0.8, 0.8, (RAYS, 3)) - o
    d = np.float32(d / np.linalg.norm(d, axis=1, keepdims=True))
    sh = np.ascontiguousarray(np.moveaxis((colour - 0.5) / Y0, 0, -1))[..., None, :]
    by = {parts: cut(o, d, colour, parts, GAUSS) for parts in (1, 8, 16, 64)}
    return Work(o, d, u, sh, by, cut(o, d, colour, 2, MIDDLE))


def printed(name: str) -> list[float]:
    """The row of an activation in the table of its module: our error and that of midpoints at each depth, then the order."""
    (row,) = (line for line in activation.__doc__.splitlines() if line.split()[:1] == [name])
    return [float(number) for number in row.replace("/", " ").split()[1:]]


@pytest.mark.slow
@pytest.mark.parametrize("name", ACTIVATIONS)
def test_errors_are_those_of_the_table(variant_rgb: str, work: Work, name: str) -> None:
    row, order = [], 0.0
    for tau in DEPTHS:
        density = np.float32(densities(name, tau, work.u))
        truth = work.by[64].render(density, name)

        def error(found: np.ndarray, truth: np.ndarray = truth) -> float:
            return float(np.sqrt(np.mean((found - truth) ** 2) / np.mean(truth**2)))

        ours = error(see(SphericalGrid.from_dense(density, work.sh, CUBE, activation=name), work.o, work.d)[0])
        rule = error(work.by[1].render(density, name))
        # float32 adds its rounding, 1e-6 of the light, to the rule's own error.
        assert abs(ours - rule) < 1e-6 + 1e-3 * rule
        row += [ours, error(work.midpoints.render(density, name))]
        if tau == 0.1:
            order = float(np.log2(error(work.by[8].render(density, name)) / error(work.by[16].render(density, name))))
    pairs = "  ".join(f"{a:.1e} / {b:.1e}" for a, b in zip(row[::2], row[1::2], strict=True))
    print(f"\n{name:8}  {pairs}  {order:.1f}")
    # Two digits are printed, and float32 changes the last.
    np.testing.assert_allclose([*row, order], printed(name), rtol=0.06)
    # Fourth order where cells are thin, second at kinks. Terms of the fourth and the fifth order partly cancel here: 4.2 from 8
    # to 16 parts is 4.1 from 32 to 64. A few hundred kinks lie anywhere in their cells, and their truth errs, too.
    assert order == pytest.approx(2 if name == "relu" else 4, abs=0.3)
    assert all(ours < midpoints for ours, midpoints in zip(row[:-2:2], row[1:-2:2], strict=True))
