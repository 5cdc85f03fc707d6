"""Gaussians on a grid: optical depths along lines against the closed form, mass, colours, and what is refused."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from mivol.errors import MivolError
from mivol.fields import box_places, gaussian_grid
from mivol.fields.gaussian_grid import MOST_OPAQUE, box_of_gaussians, grid_of_gaussians, masses_of_gaussians
from mivol.points.gaussians import Gaussians, concatenate, logit


@pytest.fixture(autouse=True)
def variant() -> None:
    mi.set_variant("llvm_ad_rgb")


def one(scales: tuple[float, ...] = (1.0, 1.0, 1.0), opacity: float = 0.7, mean: tuple[float, ...] = (0, 0, 0)) -> Gaussians:
    """A turned Gaussian of a colour that depends on the direction."""
    harmonics = np.linspace(-0.5, 0.8, 12).reshape(1, 4, 3)
    return Gaussians([mean], np.log([scales]), [[0.9, 0.2, -0.3, 0.1]], [logit(opacity)], harmonics)


def total(field: gaussian_grid.SphericalGrid) -> float:
    """The integral of the extinction, float64."""
    return float(field.values()[0].sum(dtype=np.float64) * np.linalg.det(field.to_world[:3, :3]) / np.prod(field.res))


def test_a_mass_is_the_mean_over_directions_weighed_by_the_area_seen() -> None:
    """Against a sum over directions of optical depth times area over the area, with a rule exact to degree 60 and more.

    The integrand is analytic with a ratio of axes of 4: 64 x 128 points leave less than 1e-6 of it.
    """
    gaussians = one((0.5, 1.0, 2.0))
    cosine, weight = np.polynomial.legendre.leggauss(64)
    turn = np.arange(128) * (2 * np.pi / 128)
    sine = np.sqrt(1 - cosine**2)[:, None]
    d = np.stack([sine * np.cos(turn), sine * np.sin(turn), np.broadcast_to(cosine[:, None], (64, 128))], axis=-1)
    covariance = gaussians.covariances()[0].astype(np.float64)
    area = np.sqrt(np.linalg.det(covariance) * np.einsum("abi,ij,abj->ab", d, np.linalg.inv(covariance), d))
    depth = masses_of_gaussians(gaussians)[0] / (2 * np.pi * area)
    mean = np.average((depth * area).mean(axis=1), weights=weight) / np.average(area.mean(axis=1), weights=weight)
    assert mean == pytest.approx(-np.log(0.3), rel=1e-5)  # the pre-images are float32: 1e-7 each
    round_one = masses_of_gaussians(one((2.0, 2.0, 2.0)))[0]
    assert round_one == pytest.approx(-np.log(0.3) * 2 * np.pi * 4, rel=1e-5)


def test_optical_depths_along_lines_are_those_of_the_widened_gaussian() -> None:
    """Through the centre and beside it, in three directions: m / (2 pi A) exp(-q / 2).

    The low-pass filter adds 1/4 voxel^2; trilinear interpolation adds f (1 - f) where a line lies at the fraction f between two
    nodes, 1/6 in the mean over the fractions that a slanting line takes (the ripple is 3e-4 of 0.01).
    What is left: the fourth cumulant of the tent, 1/60 voxel^4, by 1 / (60 8 s^4) = 4e-4 for each axis at s = 1.5 voxels
    and more, and 2e-4 beyond the reach; 2e-3 in all.
    """
    gaussians = one((0.5, 0.6, 0.9))
    field = grid_of_gaussians(gaussians, np.full(3, -5.0), np.full(3, 5.0), 30)
    density, h = field.to_dense()[0].astype(np.float64), 10 / 30
    covariance = gaussians.covariances()[0] + (1 / 4 + 1 / 6) * h**2 * np.eye(3)
    inverse, mass = np.linalg.inv(covariance), masses_of_gaussians(gaussians)[0]
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
    """A thousandth of a voxel, a flat one, and one of some voxels: float32 densities, 1e-6."""
    for scales in ((1e-4,) * 3, (0.3, 0.3, 1e-6), (0.2, 0.3, 0.4)):
        gaussians = one(scales, mean=(0.013, -0.021, 0.037))
        field = grid_of_gaussians(gaussians, np.full(3, -2.0), np.full(3, 2.0), 32)
        assert total(field) == pytest.approx(masses_of_gaussians(gaussians)[0], rel=1e-6)


def test_a_gaussian_on_a_face_gives_half_of_its_mass() -> None:
    """Nodes are symmetric about the face; a deviation of two voxels makes the sum an integral."""
    gaussians = one((0.5, 0.5, 0.5), mean=(2, 0, 0))
    field = grid_of_gaussians(gaussians, np.full(3, -2.1), np.array([2.0, 2.1, 2.1]), 16)
    assert total(field) == pytest.approx(0.5 * masses_of_gaussians(gaussians)[0], rel=1e-3)  # 4 deviations: 2e-4


def test_parts_of_a_set_and_the_set_are_one(monkeypatch: pytest.MonkeyPatch) -> None:
    """Densities add, colours are means weighed by them, and no cut of the work changes a sum by more than rounding."""
    parts = [one((0.3, 0.2, 0.4), 0.5), one((0.4, 0.2, 0.3), 0.9, (0.5, 0, 0))]
    parts[1] = Gaussians(
        *(getattr(parts[1], n) for n in ("means", "log_scales", "quaternions", "opacity_logits")), -parts[1].harmonics
    )
    box = np.full(3, -3.0), np.full(3, 3.0), 20
    (a, ka), (b, kb) = (grid_of_gaussians(part, *box).to_dense() for part in parts)
    own = np.broadcast_to(parts[0].harmonics, ka[a > 0].shape)
    np.testing.assert_allclose(ka[a > 0], own, rtol=1e-6)
    monkeypatch.setattr(box_places, "PAIRS", 100)
    both, k = grid_of_gaussians(concatenate(parts), *box).to_dense()
    np.testing.assert_allclose(both, a + b, rtol=1e-6)
    np.testing.assert_allclose(k * both[..., None, None], a[..., None, None] * ka + b[..., None, None] * kb, atol=1e-6)


def test_an_opacity_of_one_is_capped_and_the_box_holds_three_deviations() -> None:
    assert masses_of_gaussians(one(opacity=1.0)) == masses_of_gaussians(one(opacity=0.9995))
    assert masses_of_gaussians(one(opacity=0.0)) == 0
    assert masses_of_gaussians(one(opacity=1.0))[0] == pytest.approx(-2 * np.pi * np.log1p(-MOST_OPAQUE), rel=1e-6)
    low, high = box_of_gaussians(one((2.0, 2.0, 2.0), mean=(1, 0, 0)))
    np.testing.assert_allclose([low, high], [[-5, -6, -6], [7, 6, 6]], atol=1e-5)


def test_what_cannot_be_a_grid_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    low, high = np.zeros(3), np.ones(3)
    with pytest.raises(MivolError, match="a corner above the other, and at least 2 voxels"):
        grid_of_gaussians(one(), high, low, 8)
    with pytest.raises(MivolError, match="give a box that holds them"):
        grid_of_gaussians(one((0.1, 0.1, 0.1), mean=(9, 0, 0)), low, high, 8)
    with pytest.raises(MivolError, match="nothing to put a box around"):
        box_of_gaussians(one().select(slice(0)))
    free = gaussian_grid.PAIR_BYTES * gaussian_grid.PAIRS + (16 * 13 + gaussian_grid.PAIR_BYTES) * 50**3
    monkeypatch.setattr(gaussian_grid, "available_memory", lambda: free + 1)
    with pytest.raises(MivolError, match="a resolution of at most 50 fits"):
        grid_of_gaussians(one(), low, high, 100)
