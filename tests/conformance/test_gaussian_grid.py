"""Gaussians to a grid and back: optical depths against the closed form, mass, colours, and refused inputs."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest
from refusals import assert_refused
from scipy.ndimage import map_coordinates

from mivol.fields import gaussian_field, gaussian_grid
from mivol.fields.gaussian_grid import (
    MAX_OPACITY,
    MIN_OPACITY,
    gaussian_box,
    gaussian_masses,
    gaussians_to_grid,
    gaussians_to_nested,
    grid_to_gaussians,
)
from mivol.fields.spherical_grid import SphericalGrid
from mivol.files import encode_srgb
from mivol.points.gaussians import CONSTANT_HARMONIC, Gaussians, concatenate, logit


def one(scales: tuple[float, ...] = (1.0, 1.0, 1.0), opacity: float = 0.7, mean: tuple[float, ...] = (0, 0, 0)) -> Gaussians:
    """A turned Gaussian with a directional colour."""
    harmonics = np.linspace(-0.5, 0.8, 12).reshape(1, 4, 3)
    return Gaussians([mean], np.log([scales]), [[0.9, 0.2, -0.3, 0.1]], [logit(opacity)], harmonics)


def total(field: gaussian_grid.SphericalGrid) -> float:
    """The integral of the extinction, float64."""
    return float(field.values()[0].sum(dtype=np.float64) * np.linalg.det(field.to_world[:3, :3]) / np.prod(field.res))


def test_a_mass_is_the_mean_over_directions_weighed_by_the_area_seen() -> None:
    """The mass equals a sum over directions of optical depth times area, divided by the sum of areas.

    The quadrature is exact to degree 60. The integrand is analytic, and with a ratio of axes of 4 the 64 x 128 points have an
    error below 1e-6.
    """
    gaussians = one((0.5, 1.0, 2.0))
    cosine, weight = np.polynomial.legendre.leggauss(64)
    turn = np.arange(128) * (2 * np.pi / 128)
    sine = np.sqrt(1 - cosine**2)[:, None]
    d = np.stack([sine * np.cos(turn), sine * np.sin(turn), np.broadcast_to(cosine[:, None], (64, 128))], axis=-1)
    covariance = gaussians.covariances()[0].astype(np.float64)
    area = np.sqrt(np.linalg.det(covariance) * np.einsum("abi,ij,abj->ab", d, np.linalg.inv(covariance), d))
    depth = gaussian_masses(gaussians)[0] / (2 * np.pi * area)
    mean = np.average((depth * area).mean(axis=1), weights=weight) / np.average(area.mean(axis=1), weights=weight)
    assert mean == pytest.approx(-np.log(0.3), rel=1e-5)  # the pre-images are float32: 1e-7 each
    round_one = gaussian_masses(one((2.0, 2.0, 2.0)))[0]
    assert round_one == pytest.approx(-np.log(0.3) * 2 * np.pi * 4, rel=1e-5)


def test_optical_depths_along_lines_are_those_of_the_widened_gaussian() -> None:
    """Lines through the centre and beside it, in three directions, have the optical depth m / (2 pi A) exp(-q / 2).

    The low-pass filter adds a variance of 1/4 voxel^2. Trilinear interpolation adds f (1 - f) on a line at the fraction f
    between two nodes, in the mean 1/6 over the fractions of a slanting line (the ripple is 3e-4 of 0.01). The remaining error
    is the fourth cumulant of the tent, 1/60 voxel^4, which gives 1 / (60 8 s^4) = 4e-4 for each axis at s of at least 1.5
    voxels, and 2e-4 beyond the reach; 2e-3 in total.
    """
    gaussians = one((0.5, 0.6, 0.9))
    field = gaussians_to_grid(gaussians, np.full(3, -5.0), np.full(3, 5.0), 30)
    density, h = field.to_dense()[0].astype(np.float64), 10 / 30
    covariance = gaussians.covariances()[0] + (1 / 4 + 1 / 6) * h**2 * np.eye(3)
    inverse, mass = np.linalg.inv(covariance), gaussian_masses(gaussians)[0]
    t = np.linspace(-5, 5, 4001)
    for d in np.array([[0.36, 0.48, 0.8], [0.8, -0.36, 0.48], [-0.48, 0.64, 0.6]]):
        for beside in (np.zeros(3), 0.5 * np.cross(d, [0.3, 0.2, 0.9])):
            p = beside + t[:, None] * d
            inside = (np.abs(p) < 4.8).all(axis=1)
            values = map_coordinates(density, ((p + 5) / h - 0.5).T[::-1], order=1, mode="nearest")
            found = np.trapezoid(np.where(inside, values, 0), t)
            q = beside @ inverse @ beside - (d @ inverse @ beside) ** 2 / (d @ inverse @ d)
            area = np.sqrt(np.linalg.det(covariance) * (d @ inverse @ d))
            assert found == pytest.approx(mass / (2 * np.pi * area) * np.exp(-q / 2), rel=2e-3)


def test_mass_is_kept_however_small_gaussians_are() -> None:
    """Gaussians of a thousandth of a voxel, a flat one, and one of some voxels keep their mass to 1e-6, the rounding of
    float32.
    """
    for scales in ((1e-4,) * 3, (0.3, 0.3, 1e-6), (0.2, 0.3, 0.4)):
        gaussians = one(scales, mean=(0.013, -0.021, 0.037))
        field = gaussians_to_grid(gaussians, np.full(3, -2.0), np.full(3, 2.0), 32)
        assert total(field) == pytest.approx(gaussian_masses(gaussians)[0], rel=1e-6)


def test_a_gaussian_on_a_face_gives_half_of_its_mass() -> None:
    """Nodes are symmetric about the face; a deviation of two voxels makes the sum an integral."""
    gaussians = one((0.5, 0.5, 0.5), mean=(2, 0, 0))
    field = gaussians_to_grid(gaussians, np.full(3, -2.1), np.array([2.0, 2.1, 2.1]), 16)
    assert total(field) == pytest.approx(0.5 * gaussian_masses(gaussians)[0], rel=1e-3)  # 4 deviations: 2e-4


def test_nested_boxes_hold_what_lies_far_away() -> None:
    """Boxes double until one of them holds a Gaussian 24 away. Each mass is stored once, in the first box that holds it."""
    near, far = one((0.05, 0.05, 0.05), mean=(0.1, 0, 0)), one((0.5, 0.5, 0.5), mean=(0, 24, 0))
    field = gaussians_to_nested(concatenate([near, far]), np.full(3, -1.0), np.full(3, 1.0), 24)
    found = [total(field.extract_level(level)) for level in range(field.levels)]
    expected = [gaussian_masses(near)[0], 0, 0, 0, 0, gaussian_masses(far)[0]]
    assert found == pytest.approx(expected, rel=1e-5)  # sums of a thousand float32 densities
    beyond = gaussians_to_nested(concatenate([near, one(mean=(0, 1e5, 0))]), np.full(3, -1.0), np.full(3, 1.0), 8)
    assert beyond.levels == 8 and total(beyond.extract_level(0)) == pytest.approx(expected[0], rel=1e-5)
    assert_refused("none of the Gaussians reaches", gaussians_to_nested, far, np.full(3, -1.0), np.full(3, 1.0), 24)


def test_parts_of_a_set_and_the_set_are_one(monkeypatch: pytest.MonkeyPatch) -> None:
    """Densities add, colours are means weighted by density, and the size of chunks changes sums only by rounding."""
    parts = [one((0.3, 0.2, 0.4), 0.5), one((0.4, 0.2, 0.3), 0.9, (0.5, 0, 0))]
    parts[1] = Gaussians(
        *(getattr(parts[1], n) for n in ("means", "log_scales", "quaternions", "opacity_logits")), -parts[1].harmonics
    )
    box = np.full(3, -3.0), np.full(3, 3.0), 20
    (a, ka), (b, kb) = (gaussians_to_grid(part, *box).to_dense() for part in parts)
    own = np.broadcast_to(parts[0].harmonics, ka[a > 0].shape)
    np.testing.assert_allclose(ka[a > 0], own, rtol=1e-6)
    monkeypatch.setattr(gaussian_field, "MAX_CHUNK_PAIRS", 100)
    both, k = gaussians_to_grid(concatenate(parts), *box).to_dense()
    np.testing.assert_allclose(both, a + b, rtol=1e-6)
    np.testing.assert_allclose(k * both[..., None, None], a[..., None, None] * ka + b[..., None, None] * kb, atol=1e-6)


def test_an_opacity_of_one_is_capped_and_the_box_holds_three_deviations() -> None:
    assert gaussian_masses(one(opacity=1.0)) == gaussian_masses(one(opacity=0.9995))
    assert gaussian_masses(one(opacity=0.0)) == 0
    assert gaussian_masses(one(opacity=1.0))[0] == pytest.approx(-2 * np.pi * np.log1p(-MAX_OPACITY), rel=1e-6)
    low, high = gaussian_box(one((2.0, 2.0, 2.0), mean=(1, 0, 0)))
    np.testing.assert_allclose([low, high], [[-5, -6, -6], [7, 6, 6]], atol=1e-5)


def test_what_cannot_be_a_grid_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    low, high = np.zeros(3), np.ones(3)
    assert_refused("a corner above the other, and at least 2 voxels", gaussians_to_grid, one(), high, low, 8)
    assert_refused("give a box that holds them", gaussians_to_grid, one((0.1, 0.1, 0.1), mean=(9, 0, 0)), low, high, 8)
    assert_refused("nothing to put a box around", gaussian_box, one().select(slice(0)))
    free = gaussian_grid.PAIR_BYTES * gaussian_grid.MAX_CHUNK_PAIRS + (16 * 13 + gaussian_grid.PAIR_BYTES) * 50**3
    monkeypatch.setattr("mivol.machine.available_memory", lambda: free + 1)
    assert_refused("a resolution of at most 50 fits", gaussians_to_grid, one(), low, high, 100)


def field_of(density: np.ndarray, to_world: np.ndarray, seed: int = 1, degree: int = 1, **kind: object) -> SphericalGrid:
    """A field of the given densities, with colours in all directions."""
    sh = np.random.default_rng(seed).uniform(-0.3, 0.3, (*density.shape, (degree + 1) ** 2, 3))
    return SphericalGrid.from_dense(density, sh, to_world, **kind)


def test_one_block_of_one_gaussian_is_this_gaussian() -> None:
    """A Gaussian to a grid and back keeps mass, mean and colour; its covariance grows by the two kernels, 1/4 + 1/6 voxel^2.

    For a Gaussian of at least 1.5 voxels, sums over nodes equal integrals to exp(-2 pi^2 1.5^2). Beyond the cut at four
    deviations lie 2e-4 of the mass and 16 times this share of the variance: 4e-3.
    """
    harmonics = np.linspace(-0.5, 0.8, 12).reshape(1, 4, 3)
    one = Gaussians([[0.1, -0.2, 0.3]], np.log([[0.5, 0.6, 0.9]]), [[0.9, 0.2, -0.3, 0.1]], [logit(0.7)], harmonics)
    field = gaussians_to_grid(one, np.full(3, -5.0), np.full(3, 5.0), 30)
    made = grid_to_gaussians(field, 1)
    assert made.count == 1
    np.testing.assert_allclose(made.means, one.means, atol=2e-4 * 4 * 0.9)
    np.testing.assert_allclose(made.harmonics, harmonics, atol=1e-5)
    assert gaussian_masses(made)[0] == pytest.approx(gaussian_masses(one)[0], rel=1e-5)
    expected = one.covariances() + (1 / 4 + 1 / 6) * (10 / 30) ** 2 * np.eye(3)
    np.testing.assert_allclose(made.covariances(), expected, atol=4e-3 * expected.max())


def test_masses_are_those_of_the_voxels_in_blocks_that_need_not_divide_the_grid() -> None:
    """5 x 6 x 7 nodes in blocks of 3. Tolerance 1e-5: logits are float32."""
    rng = np.random.default_rng(2)
    to_world = np.diag([0.7, 1.2, 0.5, 1.0])
    density = rng.uniform(0.2, 3, (5, 6, 7))
    made = grid_to_gaussians(field_of(density, to_world), 3)
    assert made.count == 2 * 2 * 3
    assert gaussian_masses(made).sum() == pytest.approx(density.sum() * 0.7 * 1.2 * 0.5 / (5 * 6 * 7), rel=1e-5)
    assert grid_to_gaussians(field_of(density, to_world)).count == 3 * 3 * 4


def test_a_layer_of_voxels_makes_flat_gaussians_in_a_sheared_grid() -> None:
    """A layer in a block of 4 x 4 x 4: across the layer the variance is the tent's, along the layer 4 nodes add theirs.

    In a sheared frame the covariance is A (variance) A^T, with the voxel edges as columns of A.
    """
    to_world = np.eye(4)
    to_world[:3, :3] = [[0.4, 0.1, 0.0], [0.0, 0.4, 0.2], [0.0, 0.0, -0.4]]
    density = np.zeros((4, 4, 4))
    density[1] = 3.0
    made = grid_to_gaussians(field_of(density, to_world), 1)
    edges = to_world[:3, :3] / 4
    expected = edges @ np.diag([5 / 4 + 1 / 6, 5 / 4 + 1 / 6, 1 / 6]) @ edges.T
    np.testing.assert_allclose(made.covariances()[0], expected, rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(made.means[0], to_world[:3, :3] @ [0.5, 0.5, 1.5 / 4], atol=1e-6)


@pytest.mark.parametrize("degree", [0, 2])
def test_colours_of_a_turned_grid_are_those_of_the_world(degree: int) -> None:
    """One voxel seen along four directions. Tolerance 1e-5: harmonics are float32. Field and Gaussians differ in offset."""
    c, s = np.cos(0.7), np.sin(0.7)
    to_world = np.eye(4)
    to_world[:3, :3] = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ np.array([[1, 0, 0], [0, c, s], [0, -s, c]])
    field = field_of(np.full((1, 1, 1), 0.5), to_world, degree=degree, offset=0.8)
    made = grid_to_gaussians(field)
    d = np.array([[0.36, 0.48, 0.8], [0.8, -0.36, 0.48], [-0.48, 0.64, 0.6], [0, 0, -1]], np.float32)
    where = [mi.Float(np.full(4, v)) for v in made.means[0]]
    _, expected = field.eval(mi.Point3f(*where), mi.Vector3f(*d.T))
    np.testing.assert_allclose(colours_along(made, d), np.array(expected).T, atol=1e-5)


def colours_along(made: Gaussians, d: np.ndarray) -> np.ndarray:
    """(directions, 3) colours of the first Gaussian, by the model of published files."""
    import drjit as dr

    basis = [np.broadcast_to(np.array(y), len(d)) for y in dr.sh_eval(mi.Vector3f(*d.T), made.degree)]
    return np.maximum(0.5 + np.stack(basis, axis=1) @ made.harmonics[0], 0)


def test_radiance_becomes_code_values() -> None:
    """A colour of degree 0 is encoded. Tolerance 1e-5: harmonics are float32."""
    light = np.array([0.02, 0.2, 0.7])
    sh = ((light - 0.5) / CONSTANT_HARMONIC).reshape(1, 1, 1, 1, 3)
    field = SphericalGrid.from_dense(np.full((1, 1, 1), 0.5), sh, np.eye(4), space="linear")
    np.testing.assert_allclose(grid_to_gaussians(field).base_colours()[0], encode_srgb(light), atol=1e-5)


def test_degrees_above_the_highest_of_files_are_left_out() -> None:
    assert grid_to_gaussians(field_of(np.full((1, 1, 1), 0.5), np.eye(4), degree=4)).degree == 3


def test_what_makes_no_gaussians_is_refused() -> None:
    grid = field_of(np.full((2, 2, 2), 0.5), np.eye(4))
    outer = np.diag([2.0, 2, 2, 1])
    outer[:3, 3] = -0.5
    nested = SphericalGrid.from_levels([grid, field_of(np.full((2, 2, 2), 0.5), outer)])
    thin = field_of(np.full((2, 2, 2), 0.5 * MIN_OPACITY), np.eye(4))
    for field, resolution, said in (
        (nested, None, "2 nested levels"),
        (grid, 0, "a resolution of 0 blocks"),
        (field_of(np.zeros((2, 2, 2)), np.eye(4)), None, "holds nothing"),
        (thin, None, "give a lower resolution"),
    ):
        assert_refused(said, grid_to_gaussians, field, resolution)
