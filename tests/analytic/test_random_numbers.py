"""Random numbers of lanes: means, squares and correlations; points spread over the samples of a pixel."""

from __future__ import annotations

from itertools import product

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from false_alarms import assert_same_mean, fresh

from mivol.transport.traversal.random_numbers import SpreadSampler, draw_pcg32, seed_pcg32
from mivol.validate.statistics import Moments


def start(number: float) -> mi.Float:
    """A seed in [0, 1) for generators, different in each round of seeds."""
    return mi.Float((number + fresh(0) * 0.6180339887498949) % 1)


@pytest.mark.statistical
def test_numbers_are_uniform():
    """2^16 lanes, 4 numbers each: means of 1/2, squares of 1/3, no correlation within a lane or between neighbours."""
    _, numbers = draw_pcg32(seed_pcg32(start(0.25), 1 << 16), 4)
    u = np.array([np.array(x, dtype=np.float64) for x in numbers])
    assert u.min() > 0 and u.max() < 1
    assert_same_mean(Moments.from_values(u.T), 1 / 2, what="numbers")
    assert_same_mean(Moments.from_values(u.T**2), 1 / 3, what="squares")
    rows = np.vstack([u, np.roll(u[0], 1)]) - 0.5
    pairs = [rows[i] * rows[j] for i in range(5) for j in range(i)]
    assert_same_mean(Moments.from_values(np.array(pairs).T), what="products")


def test_numbers_of_a_generator_are_neither_0_nor_1():
    """The words of these states begin with 24 zeros or 24 ones; they were found among 2^26 states."""
    _, (u,) = draw_pcg32(mi.UInt32([0, 45809007, 36683381, 39019822, 40351736]), 1)
    assert np.array_equal(np.array(u), np.float32([2**-25, 2**-25, 1 - 2**-24, 1 - 2**-24, 1 - 2**-24]))


def spread(pixels: int, samples: int, seed: int = 3) -> SpreadSampler:
    """Samples of pixels side by side, the samples of a pixel in turn."""
    lane = dr.arange(mi.UInt32, pixels * samples)
    pixel = mi.Vector2i(lane // samples % 64, lane // (samples * 64))
    return SpreadSampler.of_pixels(pixel, mi.UInt32(seed), lane % samples, mi.UInt32(samples))


def assert_net(points: np.ndarray) -> None:
    """Of 2^m points (pixels, 2^m, dimensions) each elementary interval of volume 2^-m holds exactly one."""
    n, dimensions = points.shape[1:]
    m = n.bit_length() - 1
    for bits in product(range(m + 1), repeat=dimensions):
        if sum(bits) != m:
            continue
        cell = np.zeros(points.shape[:2], int)
        for x, b in zip(np.moveaxis(points, -1, 0), bits, strict=True):
            cell = (cell << b) + np.floor(x * 2**b).astype(int)
        np.testing.assert_array_equal(np.sort(cell, axis=1), np.broadcast_to(np.arange(n), cell.shape), err_msg=str(bits))


def numbers(*drawn: mi.Float, pixels: int) -> np.ndarray:
    """Numbers of lanes, as (pixels, samples, dimensions) in float64."""
    return np.stack([np.array(x, np.float64).reshape(pixels, -1) for x in drawn], axis=-1)


@pytest.mark.parametrize("samples", [1, 2, 64, 256])
def test_each_elementary_interval_holds_one_sample(samples):
    """The numbers of a draw, alone and with the lead; three draws of two numbers and one of one, in 30 pixels."""
    sampler = spread(30, samples)
    lead = sampler.next_lead()
    draws = [tuple(sampler.next_2d()), (sampler.next_1d(),), tuple(sampler.next_2d()), (sampler.next_lead(),)]
    for draw in draws:
        assert_net(numbers(*draw, pixels=30))
        assert_net(numbers(lead, *draw, pixels=30))


def test_samples_of_any_interval_of_the_lead_are_spread():
    """Samples 16 to 31 of 64, and each two continuations of 8 to 15, have nets of their own."""
    sampler = spread(20, 64)
    sampler.next_lead()
    points = numbers(*sampler.next_2d(), pixels=20)
    assert_net(points[:, 16:32])
    lane = dr.arange(mi.UInt32, 20 * 16)
    ends = spread(20, 64).gather(lane // 16 * 64 + 8 + lane % 16 // 2).branch(lane % 2, mi.UInt32(2))
    assert_net(numbers(*ends.next_2d(), pixels=20))


@pytest.mark.statistical
def test_spread_numbers_are_uniform_and_uncorrelated():
    """2^15 pixels of 2 samples: means of 1/2, squares of 1/3; no correlation of a sample's numbers, of neighbours, of seeds.

    The lead of a sample lies in its own half.
    """
    u, pixels = [], 1 << 15
    for seed in (7, 8):
        sampler = spread(pixels, 2, seed + 2 * fresh(0))
        drawn = (sampler.next_lead(), *sampler.next_2d(), sampler.next_1d(), *sampler.next_2d())
        u.append(numbers(*drawn, draw_pcg32(sampler.next_state(), 1)[1][0], pixels=pixels))
    assert min(x.min() for x in u) >= 0 and max(x[..., :6].max() for x in u) < 1
    assert np.array_equal(np.floor(2 * u[0][..., 0]), np.broadcast_to([0, 1], (pixels, 2)))
    alone = np.concatenate([2 * u[0][:, 1, :1] - 1, u[0][:, 1, 1:]], axis=-1)
    assert_same_mean(Moments.from_values(alone), 1 / 2, what="numbers")
    assert_same_mean(Moments.from_values(alone**2), 1 / 3, what="squares")
    first, second = (x - 0.5 for x in u)
    for x in (first, second):
        x[..., 0] += [0.25, -0.25]
    rows, one = np.arange(7), first[:, 0, :]
    pairs = [one[:, i] * one[:, j] for i in rows for j in rows[:i]]
    pairs += [one[:, i] * np.roll(one[:, j], 1) for i in rows for j in rows]
    pairs += [one[:, i] * second[:, k, j] for i in rows for j in rows for k in range(2)]
    assert_same_mean(Moments.from_values(np.array(pairs).T), 0, what="products")


def test_a_clone_repeats_the_numbers():
    sampler = spread(3, 5)
    sampler.next_2d()
    again = sampler.clone()
    for _ in range(2):
        for name in ("next_lead", "next_1d", "next_2d", "next_state"):
            assert np.array_equal(np.array(getattr(sampler, name)()), np.array(getattr(again, name)()))
