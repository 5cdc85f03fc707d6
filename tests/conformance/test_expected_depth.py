"""Expected depth of rays: closed forms, the order of its quadrature, and what is refused."""

from __future__ import annotations

import itertools
import math

import mitsuba as mi
import numpy as np
import pytest
from aov_scenes import CUBE, EPS, grid, rays, see
from oracle import depth_twin, tau_twin

from mivol.errors import MivolError
from mivol.transport.line_integrals import expected_depth
from scenes import (
    as_float32,
    ball_of,
    box_of,
    grid_volume,
    medium,
)

pytestmark = pytest.mark.usefixtures("variant_rgb")


@pytest.mark.parametrize("sigma", [1e-8, 1e-3, 0.7, 20.0, 1e3, 1e6])
@pytest.mark.parametrize("kind", ["homogeneous", "grid"])
def test_depth_of_a_slab_at_any_optical_depth(sigma, kind):
    # 1/sigma - L T / (1 - T) behind the entry: L/2 where it is thin, 1/sigma where it is thick.
    """Hard case 1."""
    sigma = float(as_float32(sigma))
    values = np.full((7, 3, 2), sigma)
    inside = medium("heterogeneous", grid_volume("gridvolume", values))
    if kind == "homogeneous":
        inside = medium("homogeneous", sigma)
    image, o, _ = see({"box": box_of(inside, np.eye(4))}, [[0.3, 0.4, -1]], [[0, 0, 1]], "tau,alpha,depth")
    behind = 0.5 - sigma / 12 if sigma < 1e-2 else 1 / sigma - (1 / math.expm1(sigma) if sigma < 500 else 0)
    assert image[0, 0] == pytest.approx(sigma, rel=16 * EPS)
    assert image[0, 1] == pytest.approx(-math.expm1(-sigma), rel=16 * EPS)
    assert image[0, 2] == pytest.approx(-o[0, 2] + behind, rel=16 * EPS)


def test_depth_where_a_medium_never_ends():
    # The camera in a fog without a boundary in front of it, 1/sigma; a surface at 2 cuts it: (1 - T)/sigma.
    sigma = 0.8
    fog = {**medium("homogeneous", sigma), "id": "fog"}
    ball = ball_of({"type": "ref", "id": "fog"}, [0, 0, -50], 1.0)
    wall = {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([0, 0, 2.0]).scale(0.5)}
    o, d = np.zeros((2, 3)), np.array([[0, 0, 1.0], [0, 1.0, 0]])
    image, o, _ = see({"fog": fog, "ball": ball, "wall": wall}, o, d, "depth,alpha", inside="fog")
    length = 2.0 - o[0, 2]
    assert image[0] == pytest.approx([-math.expm1(-sigma * length) / sigma, 1.0], rel=16 * EPS)
    assert image[1] == pytest.approx([1 / sigma, 1.0], rel=16 * EPS)


def test_depth_is_of_sixth_order():
    # A smooth field on a line, twice as fine twice: the error falls by 2^6 = 64 each time. In the cell formula's own
    # terms, in float64, since float32 ends at 1e-7: the very function that the walk calls, on a double variant of lanes.
    def depth(n: int) -> float:
        edges = np.linspace(0, 3, n + 1)
        points = edges[:-1, None] + np.diff(edges)[:, None] * (0.5 + math.sqrt(15) / 10 * np.array([-1, 0, 1]))
        lanes = [mi.Float64(np.ascontiguousarray(c)) for c in (1 + 0.8 * np.sin(2 * points + 0.3)).T]
        stop = expected_depth.integrate_distance_in_cell(mi.Float64(edges[:-1]), mi.Float64(np.diff(edges)), *lanes)
        T, N = np.array(stop.T), np.array(stop.N)
        front = np.cumprod(np.concatenate([[1], T]))
        return float((front[:-1] * N).sum() / (1 - front[-1]))

    _, exact = depth_twin(lambda t: (1 + 0.8 * np.sin(2 * t + 0.3))[:, None], np.linspace(0, 3, 31), n=40_000)
    errors = [abs(depth(n) - exact) for n in (5, 10, 20)]
    orders = [math.log2(a / b) for a, b in itertools.pairwise(errors)]
    assert min(orders) > 5.5, errors


def test_two_grids_that_differ_are_refused_for_depth_only():
    inside = {
        "type": "mivol_medium",
        "sigma_a": grid_volume("mivol_voxels", grid(11), CUBE),
        "sigma_s": grid_volume("mivol_voxels", grid(12, shape=(4, 4, 4)), CUBE),
    }
    parts = {"box": box_of(inside, CUBE)}
    image, o, d = see(parts, *rays(3), "tau,alpha")
    tau = tau_twin(grid(11), CUBE, o, d) + tau_twin(grid(12, shape=(4, 4, 4)), CUBE, o, d)
    assert image[:, :1] == pytest.approx(tau, rel=1e-5)
    with pytest.raises(MivolError, match="depth was asked for and a medium sums grids"):
        see(parts, *rays(3), "depth")
