"""Gradients through compositing: voxels and media hidden behind others."""

from __future__ import annotations

import math

import mitsuba as mi
import numpy as np
import pytest
from aov_gradients import DATA, VALUE, mivol, vjp

from scenes import as_float32, ball_of, box_of, centred, grid_volume, medium, pencil

pytestmark = pytest.mark.usefixtures("traced_balls")


def column(sigma: np.ndarray, boundary: dict | None = None) -> mi.Scene:
    """A ray from z = -1 through the middle of a column of voxels in the unit cube."""
    values = np.asarray(sigma, dtype=np.float32).reshape(-1, 1, 1, 1)
    interior = medium("mivol_medium", grid_volume("mivol_voxels", values))
    shape = {**boundary, "bsdf": {"type": "null"}, "interior": interior} if boundary else box_of(interior, np.eye(4))
    return mi.load_dict({"type": "scene", "box": shape, "sensor": pencil([0.5, 0.5, -1], [0, 0, 1])})


def depth_gradient(sigma: np.ndarray, origin: float, n: int = 4000) -> np.ndarray:
    """d depth / d voxel in float64: the hat of each voxel against (T t - N behind - depth T_end) / alpha, by midpoints."""
    z = (np.arange(n * len(sigma)) + 0.5) / (n * len(sigma))
    nodes = (np.arange(len(sigma)) + 0.5) / len(sigma)
    s, dz, t = np.interp(z, nodes, sigma), z[1] - z[0], z - origin
    tau = np.concatenate([[0], np.cumsum(s) * dz])
    T = np.exp(-tau)
    steps = t * (T[:-1] - T[1:])
    behind = np.cumsum(steps[::-1])[::-1] - steps / 2
    alpha = -math.expm1(-tau[-1])
    slope = (np.exp(-(tau[:-1] + tau[1:]) / 2) * t - behind - steps.sum() / alpha * T[-1]) / alpha
    return np.array([(np.interp(z, nodes, hat) * slope).sum() * dz for hat in np.eye(len(sigma))])


PROFILES = {
    "thin": 0.3 + 0.2 * np.sin(np.arange(24)),
    "smooth": 4 + 3 * np.sin(np.arange(24) / 3),
    "nearly nothing": np.full(24, 1e-8),
    "hidden": np.where(np.arange(64) < 32, 100.0, 1 + 0.5 * np.sin(np.arange(64))),
    "hidden behind a rise": np.where(np.arange(64) < 8, 0.01, 57.0),
}

START = -1 + 8.94e-5
"""Where the rays of a radiancemeter at z = -1 begin: Mitsuba moves them on by its RayEpsilon."""

BALL = {"type": "sphere", "center": [0.5, 0.5, 0.5], "radius": 0.9}
"""A boundary that has to be traced and holds the whole unit cube."""


@pytest.mark.slow_for("traced-hidden behind a rise", "traced-hidden")
@pytest.mark.parametrize("name", PROFILES)
@pytest.mark.parametrize("boundary", [None, BALL], ids=["box", "traced"])
def test_every_voxel_has_its_gradient(name, boundary):
    """Each voxel by itself, also those whose gradient is e^-50 of the largest: where it changes its sign it is a difference of
    two numbers of the size of its neighbours'. The scheme errs by the sixth power of a cell's optical depth, at most 1.6 here
    and where the extinction jumps: 3e-4."""
    sigma = PROFILES[name]
    got = vjp(column(sigma, boundary), mivol("depth"), [f"box.{DATA}"], np.ones((1, 1, 1)), 1)[f"box.{DATA}"].ravel()
    exact = depth_gradient(as_float32(sigma), START)
    nearby = np.convolve(np.abs(exact), np.ones(3), "same")
    assert np.all(np.abs(got - exact) <= 3e-4 * nearby)
    assert np.abs(exact).max() > 1e-5
    assert not name.startswith("hidden") or np.abs(got[-1]) < 1e-20


@pytest.mark.slow_for("ball")
@pytest.mark.parametrize("shape", ["box", "ball"])
def test_media_hidden_behind_another(shape):
    """A homogeneous medium of optical depth 50 hides two more: d depth / d sigma = T (m' - ...) with T = e^-50. Of boxes it is
    a sum and right to 1e-4; of balls the last digits of N are clamped to T times the distances left: at most 5 T."""

    def at(z: float, sigma: float) -> dict:
        inside = medium("homogeneous", sigma)
        return box_of(inside, centred(np.eye(3), (0, 0, z))) if shape == "box" else ball_of(inside, [0, 0, z], 0.5)

    parts = {"a": at(0, 50.0), "b": at(2, 1.3), "c": at(4, 0.7)}
    scene = mi.load_dict({"type": "scene", **parts, "sensor": pencil([0, 0, -1], [0, 0, 1])})
    keys = [f"{k}.{VALUE}" for k in parts]
    got = vjp(scene, mivol("depth"), keys, np.ones((1, 1, 1)), 1)
    first, second, third = (float(got[k].ravel()[0]) for k in keys)
    assert first == pytest.approx(-1 / 50**2, rel=1e-4)
    if shape == "box":
        exact = [hidden_slope(m) for m in (1, 2)]
        assert [second, third] == pytest.approx(exact, rel=1e-4)
    assert 0 < abs(second) <= 5 * math.exp(-50)
    assert 0 < abs(third) <= 5 * math.exp(-50)


def hidden_slope(which: int) -> float:
    """d depth / d sigma of the second or third box of the test above: a central difference of the closed form, over e^-50."""

    def beyond(sigma: list[float]) -> float:
        moment, left, opaque = 0.0, 1.0, 0.0
        for begin, s in zip((1.5 - START, 3.5 - START), sigma, strict=True):
            T = math.exp(-s)
            moment += left * ((begin + 1 / s) * (1 - T) - T)
            opaque += left * (1 - T)
            left *= T
        mean = -0.5 - START + 1 / 50
        return moment - mean * opaque

    h, sigma = 1e-4, [1.3, 0.7]
    up, down = list(sigma), list(sigma)
    up[which - 1] += h
    down[which - 1] -= h
    return math.exp(-50) * (beyond(up) - beyond(down)) / (2 * h)


def test_a_black_cell_does_not_disturb_what_is_in_front_of_it():
    # Behind the visible half lies an optical depth of 1e6 a cell: what is ahead of a cell must not be what is left of it.
    sigma = np.where(np.arange(48) < 32, 1.0, 5e7)
    got = vjp(column(sigma), mivol("depth"), [f"box.{DATA}"], np.ones((1, 1, 1)), 1)[f"box.{DATA}"].ravel()
    nodes = (np.arange(48) + 0.5) / 48
    # Nothing gets past z0, the rise to the wall: d depth / d sigma = T t - N behind, N behind = int t T dt + z0 T.
    z0 = nodes[31]
    exact = np.array([np.exp(-z) * z - ((1 + z) * np.exp(-z) - (1 + z0) * np.exp(-z0)) - z0 * np.exp(-z0) for z in nodes])
    # The first voxel reaches half a voxel further; the others are means over a hat 1/24 wide: (1/24)^2 / 6, and the rise.
    assert np.all(np.abs(got[1:30] * 48 / exact[1:30] - 1) < 2e-2)
    assert np.all(np.isfinite(got))
    assert got[32:] == pytest.approx(np.zeros(16), abs=1e-6)
