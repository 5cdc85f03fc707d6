"""Gaussians of a radiance field: masses, shapes and colours are those of its matter; what is refused."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from mivol.errors import MivolError
from mivol.fields.gaussian_grid import grid_of_gaussians, masses_of_gaussians
from mivol.fields.grid_gaussians import FAINTEST, gaussians_of_grid
from mivol.fields.spherical import SphericalGrid
from mivol.files import encode_srgb
from mivol.points.gaussians import CONSTANT_HARMONIC, Gaussians, logit


@pytest.fixture(autouse=True)
def variant() -> None:
    mi.set_variant("llvm_ad_rgb")


def field_of(density: np.ndarray, to_world: np.ndarray, seed: int = 1, degree: int = 1, **kind: object) -> SphericalGrid:
    """A field of these densities, with colours of all directions."""
    sh = np.random.default_rng(seed).uniform(-0.3, 0.3, (*density.shape, (degree + 1) ** 2, 3))
    return SphericalGrid.from_dense(density, sh, to_world, **kind)


def test_one_block_of_one_gaussian_is_this_gaussian() -> None:
    """There and back: mass, mean, colour, and the covariance with that of the two kernels, 1/4 + 1/6 of a voxel^2.

    Sums over nodes of a Gaussian of 1.5 voxels and more are its integrals to exp(-2 pi^2 1.5^2) of it; at four deviations,
    where it is cut off, lie 2e-4 of its mass and 16 times as much of its variance: 4e-3.
    """
    harmonics = np.linspace(-0.5, 0.8, 12).reshape(1, 4, 3)
    one = Gaussians([[0.1, -0.2, 0.3]], np.log([[0.5, 0.6, 0.9]]), [[0.9, 0.2, -0.3, 0.1]], [logit(0.7)], harmonics)
    field = grid_of_gaussians(one, np.full(3, -5.0), np.full(3, 5.0), 30)
    made = gaussians_of_grid(field, 1)
    assert made.count == 1
    np.testing.assert_allclose(made.means, one.means, atol=2e-4 * 4 * 0.9)
    np.testing.assert_allclose(made.harmonics, harmonics, atol=1e-5)
    assert masses_of_gaussians(made)[0] == pytest.approx(masses_of_gaussians(one)[0], rel=1e-5)
    expected = one.covariances() + (1 / 4 + 1 / 6) * (10 / 30) ** 2 * np.eye(3)
    np.testing.assert_allclose(made.covariances(), expected, atol=4e-3 * expected.max())


def test_masses_are_those_of_the_voxels_in_blocks_that_need_not_divide_the_grid() -> None:
    """5 x 6 x 7 nodes in blocks of 3; float32 logits: 1e-5."""
    rng = np.random.default_rng(2)
    to_world = np.diag([0.7, 1.2, 0.5, 1.0])
    density = rng.uniform(0.2, 3, (5, 6, 7))
    made = gaussians_of_grid(field_of(density, to_world), 3)
    assert made.count == 2 * 2 * 3
    assert masses_of_gaussians(made).sum() == pytest.approx(density.sum() * 0.7 * 1.2 * 0.5 / (5 * 6 * 7), rel=1e-5)
    assert gaussians_of_grid(field_of(density, to_world)).count == 3 * 3 * 4


def test_a_layer_of_voxels_makes_flat_gaussians_in_a_sheared_grid() -> None:
    """One layer of a block of 4 x 4 x 4: the variance across it is the tent's, along it that of 4 places more.

    In a sheared frame a covariance is A (variance) A^T with the edges of a voxel as the columns of A.
    """
    to_world = np.eye(4)
    to_world[:3, :3] = [[0.4, 0.1, 0.0], [0.0, 0.4, 0.2], [0.0, 0.0, -0.4]]
    density = np.zeros((4, 4, 4))
    density[1] = 3.0
    made = gaussians_of_grid(field_of(density, to_world), 1)
    edges = to_world[:3, :3] / 4
    expected = edges @ np.diag([5 / 4 + 1 / 6, 5 / 4 + 1 / 6, 1 / 6]) @ edges.T
    np.testing.assert_allclose(made.covariances()[0], expected, rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(made.means[0], to_world[:3, :3] @ [0.5, 0.5, 1.5 / 4], atol=1e-6)


@pytest.mark.parametrize("degree", [0, 2])
def test_colours_of_a_turned_grid_are_those_of_the_world(degree: int) -> None:
    """One voxel, seen along four directions: float32 harmonics, 1e-5. The offset of the field is not that of Gaussians."""
    c, s = np.cos(0.7), np.sin(0.7)
    to_world = np.eye(4)
    to_world[:3, :3] = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ np.array([[1, 0, 0], [0, c, s], [0, -s, c]])
    field = field_of(np.full((1, 1, 1), 0.5), to_world, degree=degree, offset=0.8)
    made = gaussians_of_grid(field)
    d = np.array([[0.36, 0.48, 0.8], [0.8, -0.36, 0.48], [-0.48, 0.64, 0.6], [0, 0, -1]], np.float32)
    where = [mi.Float(np.full(4, v)) for v in made.means[0]]
    _, expected = field.eval(mi.Point3f(*where), mi.Vector3f(*d.T))
    np.testing.assert_allclose(colours_along(made, d), np.array(expected).T, atol=1e-5)


def colours_along(made: Gaussians, d: np.ndarray) -> np.ndarray:
    """(directions, 3) of the first Gaussian, by the model that published files have."""
    import drjit as dr

    basis = [np.broadcast_to(np.array(y), len(d)) for y in dr.sh_eval(mi.Vector3f(*d.T), made.degree)]
    return np.maximum(0.5 + np.stack(basis, axis=1) @ made.harmonics[0], 0)


def test_radiance_becomes_code_values() -> None:
    """A colour of degree 0 is encoded; harmonics of float32: 1e-5."""
    light = np.array([0.02, 0.2, 0.7])
    sh = ((light - 0.5) / CONSTANT_HARMONIC).reshape(1, 1, 1, 1, 3)
    field = SphericalGrid.from_dense(np.full((1, 1, 1), 0.5), sh, np.eye(4), space="linear")
    np.testing.assert_allclose(gaussians_of_grid(field).base_colours()[0], encode_srgb(light), atol=1e-5)


def test_degrees_above_the_highest_of_files_are_left_out() -> None:
    assert gaussians_of_grid(field_of(np.full((1, 1, 1), 0.5), np.eye(4), degree=4)).degree == 3


def test_what_makes_no_gaussians_is_refused() -> None:
    grid = field_of(np.full((2, 2, 2), 0.5), np.eye(4))
    outer = np.diag([2.0, 2, 2, 1])
    outer[:3, 3] = -0.5
    nested = SphericalGrid.nested([grid, field_of(np.full((2, 2, 2), 0.5), outer)])
    thin = field_of(np.full((2, 2, 2), 0.5 * FAINTEST), np.eye(4))
    for field, resolution, said in (
        (nested, None, "2 nested levels"),
        (grid, 0, "a resolution of 0 blocks"),
        (field_of(np.zeros((2, 2, 2)), np.eye(4)), None, "holds nothing"),
        (thin, None, "give a lower resolution"),
    ):
        with pytest.raises(MivolError, match=said):
            gaussians_of_grid(field, resolution)
