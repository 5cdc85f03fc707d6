"""What depth 2 leaves out: the table obeys the laws of scattering orders, and optical depths are those of its lines."""

from __future__ import annotations

import math
import re

import mitsuba as mi
import numpy as np
import pytest
from false_alarms import assert_same_mean, assert_within, fresh
from scattering_scenes import close_up
from scipy import stats

from mivol.experiments.script import explain
from mivol.scene import depth_two
from mivol.scene.depth_two import ALBEDOS, TABLES, TAUS, depth_two_error, sample_lines, scattering_depth
from mivol.scene.needs import mean_cosine
from mivol.transport.media.medium_view import view_medium
from mivol.transport.traversal.box import Box
from mivol.validate.statistics import Moments
from scenes import FRAMES, affine, ball_of, medium, refused, rotation

ROUNDING = 5e-4
"""Of a table of three digits."""
CUBE_DEPTH = 0.8966336
"""E[l^2] / E[l] of lines through the unit cube: 8 / (2 pi) int prod(1 - u_i) / |u|^2 du, which Gauss-Legendre gives below."""


def test_no_number_of_the_table_was_changed() -> None:
    """Sums of what mivol bench depth has printed, which takes an hour: one wrong digit changes one of them."""
    sums = {key: table.sum() for key, table in TABLES.items()}
    expected = {("constant", "isotropic"): 10.824, ("constant", "forward"): 13.608}
    assert sums == pytest.approx({**expected, ("collimated", "isotropic"): 11.414, ("collimated", "forward"): 14.94})


@pytest.mark.parametrize("key", TABLES, ids="-".join)
def test_more_albedo_and_more_matter_leave_out_more(key: tuple[str, str]) -> None:
    """1 / (1 - e) = sum of albedo^(n - 1) s_n / s_1 rises with the albedo in any medium, whatever the noise, for all albedos
    were measured with the same paths; it rises with tau here, where e grows by more than its standard error."""
    table = TABLES[key]
    assert table.shape == (len(ALBEDOS), len(TAUS))
    assert np.all(np.diff(table, axis=0) >= 0)
    assert np.all(np.diff(table, axis=1) > 0)
    assert np.all((table > 0) & (table < 1))


@pytest.mark.parametrize("key", TABLES, ids="-".join)
def test_orders_of_scattering_are_positive(key: tuple[str, str]) -> None:
    """1 / (1 - e) is a power series in the albedo with coefficients s_n / s_1 >= 0 that starts with 1: convex, chords rise.
    Rounding moves 1 / (1 - e) by ROUNDING / (1 - e)^2, and a chord by two of these over its width."""
    for column in TABLES[key].T:
        x, y = np.array([0.0, *ALBEDOS]), 1 / (1 - np.array([0.0, *column]))
        slack = ROUNDING * y**2
        chords = np.diff(y) / np.diff(x)
        error = (slack[1:] + slack[:-1]) / np.diff(x)
        assert np.all(np.diff(chords) >= -(error[1:] + error[:-1]))


@pytest.mark.parametrize("light", ["constant", "collimated"])
def test_thin_matter_leaves_out_half_its_depth(light: str) -> None:
    """e -> albedo tau / 2: attenuation and third orders are of relative order tau (10 % at 0.1), the rounding is."""
    for albedo, e in zip(ALBEDOS, TABLES[light, "isotropic"][:, 0], strict=True):
        assert abs(e - albedo * 0.05) <= 0.1 * albedo * 0.05 + ROUNDING


@pytest.mark.parametrize("key", TABLES, ids="-".join)
def test_interpolation_goes_through_the_table(key: tuple[str, str]) -> None:
    for albedo, row in zip(ALBEDOS, TABLES[key], strict=True):
        for tau, e in zip(TAUS, row, strict=True):
            assert depth_two_error(albedo, tau, *key) == pytest.approx(e, rel=1e-12)
    a, b = TABLES[key][2, 2], TABLES[key][2, 3]
    assert depth_two_error(0.75, math.sqrt(3), *key) == pytest.approx((a + b) / 2, rel=1e-12)
    assert depth_two_error(0.35, 1.0, *key) == pytest.approx(TABLES[key][:2, 2].mean(), rel=1e-12)


def test_beyond_the_table() -> None:
    """Proportional below it, held above it, nothing for nothing."""
    assert depth_two_error(0.9, 0.05) == pytest.approx(0.5 * depth_two_error(0.9, 0.1), rel=1e-12)
    assert depth_two_error(0.1, 1.0) == pytest.approx(0.5 * depth_two_error(0.2, 1.0), rel=1e-12)
    assert depth_two_error(0.9, 1e4) == depth_two_error(0.9, 30.0)
    assert depth_two_error(0.0, 3.0) == depth_two_error(0.9, 0.0) == 0.0


def test_refusals() -> None:
    for albedo, tau in ((1.2, 1.0), (-0.1, 1.0), (0.5, -1.0), (math.nan, 1.0), (0.5, math.nan)):
        with refused("expected 0 to 1"):
            depth_two_error(albedo, tau)
    with refused('found the light "sun"'):
        depth_two_error(0.5, 1.0, "sun")


SIX = 2 * stats.norm.sf(6)
"""Chance of 6 standard errors of a normal mean, either way."""


@pytest.fixture
def fresh_lines(monkeypatch: pytest.MonkeyPatch) -> None:
    """Depths are means over lines of this round of seeds."""
    monkeypatch.setattr(depth_two, "sample_lines", lambda box, n: sample_lines(box, n, fresh(0)))


@pytest.mark.statistical
@pytest.mark.parametrize("name", FRAMES)
def test_lines_are_even(name: str) -> None:
    """Cauchy: their mean length is 4 V / A in any convex body. Each begins and ends on the boundary (float64: 1e-12), and stays
    inside between."""
    box, n = Box(FRAMES[name]), 20_000
    o, d, length = sample_lines(box, n, fresh(0))
    edges = box.to_world[:3, :3].T
    area = 2 * sum(np.linalg.norm(np.cross(edges[i], edges[j])) for i, j in ((0, 1), (1, 2), (2, 0)))
    wanted = 4 * abs(np.linalg.det(edges)) / area
    assert_same_mean(Moments.from_values(length), wanted, what="lengths")
    assert np.allclose(np.linalg.norm(d, axis=1), 1, atol=1e-12)
    for t, on_border in ((0.0, True), (1.0, True), (0.37, False)):
        q = (o + (t * length)[:, None] * d - box.to_world[:3, 3]) @ np.linalg.inv(edges)
        border = np.abs(np.abs(q - 0.5).max(axis=1) - 0.5)
        assert np.all(np.abs(q - 0.5) <= 0.5 + 1e-12)
        assert np.all(border <= 1e-12) == on_border


@pytest.mark.statistical
def test_depth_of_a_cube(variant_rgb, fresh_lines) -> None:
    """0.8966336 sigma within 6 standard errors (0.25 % of 2^14 lines); the same lines in every call."""
    x, w = np.polynomial.legendre.leggauss(16)
    # By directions (a, b, 1) / |.|, a third of an octant; along one, int_0^1 (1 - s)(1 - a s)(1 - b s) ds is closed.
    a, b = np.meshgrid((x + 1) / 2, (x + 1) / 2)
    along = 1 - (1 + a + b) / 2 + (a + b + a * b) / 3 - a * b / 4
    exact = 24 * float(np.sum(np.outer(w, w) / 4 * along / (1 + a * a + b * b))) / (2 * math.pi)
    assert exact == pytest.approx(CUBE_DEPTH, abs=1e-7)
    found = scattering_depth(view_of(medium("homogeneous", 2.0, 0.5, scale=3.0)), Box(np.eye(4)))
    assert_within(found / (6 * exact) - 1, 6 * 0.0025, chance=SIX, what="depths")
    assert found == scattering_depth(view_of(medium("homogeneous", 2.0, 0.5, scale=3.0)), Box(np.eye(4)))


def view_of(described: dict) -> object:
    return view_medium(mi.load_dict(described), Box(np.eye(4)))


def test_a_constant_grid_is_a_homogeneous_medium(variant_rgb) -> None:
    """Line by line to float32 rounding of the walk, 2e-6; and sums of parts are sums."""
    grid = {"type": "mivol_voxels", "data": mi.TensorXf(np.full((3, 2, 4, 1), 1.5, np.float32))}
    walked = scattering_depth(view_of({"type": "mivol_medium", "sigma_t": grid, "albedo": 0.5}), Box(np.eye(4)))
    closed = scattering_depth(view_of(medium("homogeneous", 1.5, 0.5)), Box(np.eye(4)))
    assert walked == pytest.approx(closed, rel=1e-5)


@pytest.mark.statistical
def test_depth_of_a_ball(variant_rgb, fresh_lines) -> None:
    """A boundary that is traced: chords have the mean 4R/3 and the mean square 2R^2, so 1.5 sigma R, whatever box is around."""
    bulb = {"type": "point", "position": [3, 3, 3]}
    scene = close_up({"ball": ball_of(medium("homogeneous", 2.0, 0.5), (0.1, 0.2, -0.1), 0.7), "bulb": bulb})
    said = re.search(r"that ball scatters \(albedo 0.50, optical depth ([\d.]+)", explain(scene, max_depth=2))
    # 2^14 lines, of which half meet the ball: 0.3 %, of which 8 are allowed; two digits are said.
    depth = 1.5 * 2.0 * 0.7
    assert_within(float(said.group(1)) - depth, 8 * 0.003 * depth + 0.05, chance=SIX, what="depths")


@pytest.mark.statistical
def test_clumps_count_for_what_they_scatter(variant_rgb, fresh_lines) -> None:
    """The same mass in one octant: lines that miss it weigh nothing. Half the length and 8 times the extinction make the depth
    4 times that of the full cube; a quarter of the lines meet it, which makes the standard error 0.5 %, 6 allowed. On three of
    its six sides the grid fades out over one of 16 voxels, which smooths squares by at most 1 / 32 each way: 3 %."""
    values = np.zeros((32, 32, 32, 1), np.float32)
    values[:16, :16, :16] = 8.0
    grid = {"type": "mivol_voxels", "data": mi.TensorXf(values)}
    found = scattering_depth(view_of({"type": "mivol_medium", "sigma_t": grid, "albedo": 0.5}), Box(np.eye(4)))
    assert_within(found / (4 * CUBE_DEPTH) - 1, 0.06, chance=SIX, what="depths")


@pytest.mark.statistical
def test_depth_is_that_of_the_placed_grid(variant_rgb, fresh_lines) -> None:
    """A cube twice as large, turned and moved, has twice the depth, by other lines: 6 standard errors of 0.25 % each."""
    large = Box(affine(2 * rotation([1, 2, 3], 0.7), (5, -1, 2)))
    view = view_of(medium("homogeneous", 1.0, 0.5))
    ratio = scattering_depth(view, large) / scattering_depth(view, Box(np.eye(4)))
    assert_within(ratio / 2 - 1, 6 * math.sqrt(2) * 0.0025, chance=SIX, what="depths")


def test_the_densest_channel_and_nothing(variant_rgb) -> None:
    rgb = scattering_depth(view_of(medium("homogeneous", {"type": "rgb", "value": [0.2, 0.9, 0.5]}, 0.5)), Box(np.eye(4)))
    grey = scattering_depth(view_of(medium("homogeneous", 0.9, 0.5)), Box(np.eye(4)))
    assert rgb == pytest.approx(grey, rel=1e-5)
    assert scattering_depth(view_of(medium("homogeneous", 0.0, 0.5)), Box(np.eye(4))) == 0.0


@pytest.mark.parametrize("weight", [0.0, 0.25, 1.0])
def test_mean_cosine_of_a_blend(variant_rgb: str, weight: float) -> None:
    """(1 - w) 0.8 - w 0.6, to the promise of 1 / sqrt(n)."""
    parts = {"first": {"type": "hg", "g": 0.8}, "second": {"type": "hg", "g": -0.6}}
    phase = mi.load_dict({"type": "blendphase", "weight": weight, **parts})
    assert mean_cosine(phase) == pytest.approx((1 - weight) * 0.8 - weight * 0.6, abs=1 / 64)
