"""The model of Gaussians: shapes, activations, rotations, and messages that name the first wrong index."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from gaussian_sets import random_gaussians
from refusals import assert_refused

from mivol.points.gaussians import Gaussians, concatenate, logit


def test_a_quarter_turn_about_z_takes_x_to_y() -> None:
    """(w, x, y, z) = (1, 0, 0, 1) has length sqrt(2); the first axis, of scale 2, points along y.

    The norm and the products of the quaternion are rounded about ten times in float32; 2^-20 of the largest entry, 4, is a
    bound.
    """
    one = Gaussians(np.zeros((1, 3)), np.log([[2, 1, 0.5]]), [[1, 0, 0, 1]], [0], np.zeros((1, 1, 3)))
    assert np.abs(one.rotations()[0] - [[0, -1, 0], [1, 0, 0], [0, 0, 1]]).max() <= 2**-20
    assert np.abs(one.covariances()[0] - np.diag([1, 4, 0.25])).max() <= 4 * 2**-20


def test_opacities_of_0_and_1_have_logits() -> None:
    ends = Gaussians(np.zeros((3, 3)), np.zeros((3, 3)), np.ones((3, 4)), logit([0, 0.5, 1]), np.zeros((3, 1, 3)))
    assert ends.check().opacities().tolist() == [0, 0.5, 1]


def test_selection_and_concatenation_keep_every_number() -> None:
    flat, bent = random_gaussians(5, 0), random_gaussians(4, 2, seed=2)
    both = concatenate([flat, bent])
    assert (both.count, both.degree) == (9, 2)
    again = both.select(np.arange(9) >= 5)
    for name in ("means", "log_scales", "quaternions", "opacity_logits", "harmonics"):
        assert np.array_equal(getattr(again, name), getattr(bent, name))
    assert np.array_equal(both.select(slice(5)).with_degree(0).harmonics, flat.harmonics)
    assert not both.harmonics[:5, 1:].any()


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"means": np.zeros((4, 2))}, "means of shape"),
        ({"opacity_logits": np.zeros((4, 1))}, r"opacity_logits of shape \(4, 1\)"),
        ({"harmonics": np.zeros((4, 5, 3))}, "K = 1, 4, 9 or 16"),
    ],
)
def test_shapes_that_do_not_fit_are_refused(change: dict[str, np.ndarray], said: str) -> None:
    assert_refused(said, Gaussians, **{**vars(random_gaussians(4, 0)), **change})


@pytest.mark.parametrize(
    ("name", "value", "said"),
    [
        ("means", np.nan, "means that are not finite in Gaussian 2 "),
        ("harmonics", np.inf, "harmonics that are not finite in Gaussian 2 "),
        ("opacity_logits", np.nan, "opacity_logits of NaN in Gaussian 2 "),
        ("quaternions", 0.0, "quaternions of length 0 in Gaussian 2 "),
    ],
)
def test_numbers_that_cannot_be_drawn_are_named_by_index(name: str, value: float, said: str) -> None:
    values = np.array(getattr(random_gaussians(4, 1), name))
    values[2:] = value
    assert_refused(rf"{said}\(the first of 2\)", Gaussians(**{**vars(random_gaussians(4, 1)), name: values}).check)


def test_the_basis_is_that_of_published_files(variant_rgb: str) -> None:
    """Published files define their basis by constants; Dr.Jit has the same basis in the same order.

    Each function is a polynomial of at most 8 rounded operations on numbers below 4; 8 * 4 * 2^-24 is a bound of its rounding.
    """
    d = np.random.default_rng(3).normal(size=(3, 20))
    x, y, z = d = (d / np.linalg.norm(d, axis=0)).astype(np.float32).astype(np.float64)
    a, b, c, e = np.sqrt(np.array([3, 15, 5, 7]) / np.pi) / 2
    f, g = np.sqrt(np.array([35 / 2, 21 / 2]) / np.pi) / 4
    published = [
        *(np.full_like(x, 0.5 / np.sqrt(np.pi)), -a * y, a * z, -a * x),
        *(b * x * y, -b * y * z, c / 2 * (2 * z**2 - x**2 - y**2), -b * x * z, b / 2 * (x**2 - y**2)),
        *(-f * y * (3 * x**2 - y**2), np.sqrt(105 / np.pi) / 2 * x * y * z, -g * y * (4 * z**2 - x**2 - y**2)),
        *(e / 2 * z * (2 * z**2 - 3 * x**2 - 3 * y**2), -g * x * (4 * z**2 - x**2 - y**2)),
        *(np.sqrt(105 / np.pi) / 4 * z * (x**2 - y**2), -f * x * (x**2 - 3 * y**2)),
    ]
    basis = dr.sh_eval(mi.Vector3f(d.astype(np.float32)), 3)
    ours = np.array([np.broadcast_to(np.array(one), x.shape) for one in basis])
    assert np.abs(ours - np.array(published)).max() <= 8 * 4 * 2**-24
