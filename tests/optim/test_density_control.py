"""Density control of arrays: the new rows of each change, and the moments carried over."""

from __future__ import annotations

import math

import numpy as np
import pytest
from refusals import assert_refused
from scipy.integrate import quad
from scipy.special import expit, logit

from mivol.optim.gaussians import density_control
from mivol.optim.gaussians.density_control import CloudArrays


def cloud(n: int = 6, seed: int = 0) -> CloudArrays:
    """Some Gaussians, all different."""
    rng = np.random.default_rng(seed)
    return {
        "means": rng.normal(size=(n, 3)).astype(np.float32),
        "log_scales": rng.normal(-3, 0.5, (n, 3)).astype(np.float32),
        "quaternions": rng.normal(size=(n, 4)).astype(np.float32),
        "opacity_logits": rng.normal(size=n).astype(np.float32),
        "harmonics": rng.normal(size=(n, 4, 3)).astype(np.float32),
    }


def test_a_clone_is_its_parent_and_starts_without_moments() -> None:
    old = cloud()
    change = density_control.clone_and_split(old, np.array([1, 4]), math.inf, np.random.default_rng(0))
    assert change.parent.tolist() == [0, 1, 2, 3, 4, 5, 1, 4]
    for name, array in change.cloud.items():
        assert np.array_equal(array, old[name][change.parent])
    learnt = change.carry({"means": np.arange(18.0).reshape(6, 3)})["means"]
    assert np.array_equal(learnt[:6], np.arange(18.0).reshape(6, 3))
    assert not learnt[6:].any()


def test_halves_are_drawn_from_the_split_gaussian() -> None:
    """4000 halves of one Gaussian: mean and covariance of their places, by their standard errors.

    With n draws a sample covariance is off by sqrt((s_ii s_jj + s_ij^2) / n) (normal draws); 6 of these for each of 6 entries,
    with a fixed seed, so that the test says the same every time.
    """
    n = 2000
    one = cloud(1, seed=3)
    many = {name: np.repeat(array, n, axis=0) for name, array in one.items()}
    change = density_control.clone_and_split(many, np.arange(n), 0.0, np.random.default_rng(1))
    assert len(change.parent) == 2 * n
    assert change.forgets.all()
    turn = density_control.rotations(one["quaternions"])[0]
    sigma = turn @ np.diag(np.exp(2.0 * one["log_scales"][0].astype(np.float64))) @ turn.T
    offsets = change.cloud["means"].astype(np.float64) - one["means"][0]
    found, error = np.cov(offsets.T), np.sqrt((np.outer(np.diag(sigma), np.diag(sigma)) + sigma**2) / (2 * n))
    assert (np.abs(found - sigma) < 6 * error).all()
    assert (np.abs(offsets.mean(axis=0)) < 6 * np.sqrt(np.diag(sigma) / (2 * n))).all()
    scales = np.exp(many["log_scales"]).repeat(2, axis=0)
    np.testing.assert_allclose(np.exp(change.cloud["log_scales"]) * 1.6, scales, rtol=1e-5)


def test_large_gaussians_are_split_and_small_ones_cloned() -> None:
    old = cloud(3)
    old["log_scales"][:] = np.log([[0.1, 0.1, 0.1], [0.1, 0.1, 0.9], [0.9, 0.9, 0.9]])
    change = density_control.clone_and_split(old, np.array([0, 1]), 0.5, np.random.default_rng(0))
    # 0 stays and has a clone, 1 has become two, 2 was not chosen.
    assert change.parent.tolist() == [0, 2, 0, 1, 1]
    assert change.forgets.tolist() == [False, False, True, True, True]


def test_select_rows_takes_the_highest_scores_up_to_a_limit() -> None:
    slope = np.array([3.0, 1.0, 2.0, 3.0, 0.5])
    assert density_control.select_rows(slope, 1.0, 10).tolist() == [0, 1, 2, 3]
    assert density_control.select_rows(slope, 1.0, 3).tolist() == [0, 2, 3]
    assert density_control.select_rows(slope, 1.0, -5).tolist() == []


def test_pruning_keeps_moments_and_refuses_to_leave_nothing() -> None:
    change = density_control.prune(cloud(), np.array([True, False, True, False, False, True]))
    assert change.parent.tolist() == [0, 2, 5]
    assert change.carry({"a": np.arange(6.0)})["a"].tolist() == [0, 2, 5]
    assert_refused("no Gaussian remains", density_control.prune, cloud(), np.zeros(6, bool))


def test_composed_changes_equal_successive_changes() -> None:
    """Clones, some of which are pruned: rows and what is forgotten are those of the first cloud."""
    first = density_control.clone_and_split(cloud(), np.array([2]), math.inf, np.random.default_rng(0))
    both = first.then(density_control.prune(first.cloud, np.arange(7) % 2 == 0))
    assert both.parent.tolist() == [0, 2, 4, 2]
    assert both.forgets.tolist() == [False, False, False, True]


def test_opacities_are_reset_from_above_only() -> None:
    old = cloud()
    old["opacity_logits"][:2] = [-9, 9]
    made = expit(density_control.reset_opacities(old, 0.01)["opacity_logits"].astype(np.float64))
    assert made[0] == pytest.approx(expit(-9.0))
    assert (made <= 0.01 * (1 + 1e-6)).all()  # float32 logits: 2^-24 of 4.6 is 3e-7
    assert np.array_equal(old["opacity_logits"][:2], [-9, 9])


@pytest.mark.parametrize("copies", [1, 2, 5, 20])
@pytest.mark.parametrize("opacity", [0.02, 0.6, 0.99])
def test_copies_compose_to_the_replaced_gaussian(opacity: float, copies: int) -> None:
    """At the middle the composite of N copies is the old opacity; along a line through it, it has the same integral.

    quad is asked for 1e-10; the alternating sums lose at most 2^20 ulps of float64 with 20 copies: 1e-9 bounds both.
    """
    each, factor = density_control.split_opacity_and_scale(np.array([opacity]), np.array([copies]))

    def composite(x: float) -> float:
        return 1 - (1 - each[0] * math.exp(-0.5 * (x / factor[0]) ** 2)) ** copies

    assert composite(0) == pytest.approx(opacity, rel=1e-12)
    # Beyond 20 standard deviations there is nothing left in float64.
    area = quad(composite, -20 * factor[0], 20 * factor[0], epsabs=0, epsrel=1e-10, limit=200)[0]
    assert area == pytest.approx(opacity * math.sqrt(2 * math.pi), rel=1e-9)
    # Beside others that have more copies it is the same.
    beside = density_control.split_opacity_and_scale(np.array([opacity, 0.5]), np.array([copies, 25]))
    assert beside[0][0] == each[0] and beside[1][0] == pytest.approx(factor[0], rel=1e-12)


def test_unused_gaussians_move_to_used_ones() -> None:
    """Rows that are transparent become copies, whose parent gives up as much; rows that nobody joined stay as they are."""
    old = cloud(5)
    old["opacity_logits"][:] = logit([0.5, 0.001, 0.9, 0.002, 1e-9 + 0.005])
    change = density_control.relocate(old, 0.005, np.random.default_rng(0))
    assert {0, 2, 4} >= set(change.parent[[1, 3]])
    assert change.parent[[0, 2, 4]].tolist() == [0, 2, 4]
    opacity = expit(change.cloud["opacity_logits"].astype(np.float64))
    for row in range(5):
        at = np.flatnonzero(change.parent == row)
        if len(at) == 0:
            continue
        assert change.forgets[at].all() == (len(at) > 1)
        # float32 logits: a relative 2^-22 of 1 - opacity each.
        assert 1 - np.prod(1 - opacity[at]) == pytest.approx(expit(float(old["opacity_logits"][row])), rel=1e-5)
        assert np.array_equal(change.cloud["means"][at], old["means"][[row] * len(at)])


def test_growth_adds_copies_and_relocation_without_unused_ones_does_nothing() -> None:
    old = cloud()
    same = density_control.relocate(old, 1e-6, np.random.default_rng(0))
    assert np.array_equal(same.parent, np.arange(6))
    assert not same.forgets.any()
    more = density_control.grow(old, 4, 0.005, np.random.default_rng(0))
    assert len(more.parent) == 10
    assert np.array_equal(more.parent[:6], np.arange(6))
    assert set(np.flatnonzero(more.forgets)) == {i for i in range(10) if (more.parent == more.parent[i]).sum() > 1}
