"""Phantoms with known chords, masses and projections; procedural volumes, the same object at every resolution."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest
from refusals import assert_refused

from mivol.fields.procedural import PROCEDURAL, Cumulus, inside, make_cumulus, make_procedural
from mivol.tomography import phantoms
from mivol.tomography.geometry import ConeBeam, ParallelBeam, VoxelGrid
from mivol.tomography.phantoms import SHEPP_LOGAN, EllipsoidPhantom, random_ellipsoids, shepp_logan

# float64: a chord is a dozen operations on numbers of order 1, |o| up to 1e3 in the far test.
ROUNDING = 1e-12


def ball(radius: float, centre: tuple[float, float, float] = (0.0, 0.0, 0.0), value: float = 1.0) -> EllipsoidPhantom:
    return EllipsoidPhantom(np.eye(3)[None] / radius, np.array([centre]), np.array([value]))


def test_chord_of_a_ball_is_two_roots():
    b = np.linspace(-1.5, 1.5, 31)
    o = np.stack([np.full_like(b, -5.0), b, np.zeros_like(b)], -1)
    chords = ball(1.2, value=0.5).integrate_lines(o, np.broadcast_to([1.0, 0.0, 0.0], o.shape))
    np.testing.assert_allclose(chords, 0.5 * 2 * np.sqrt(np.maximum(1.44 - b * b, 0)), atol=ROUNDING)


def test_ray_from_inside_sees_the_rest_only():
    o, d = np.array([[0.3, 0.0, 0.0]]), np.array([[1.0, 0.0, 0.0]])
    assert ball(1.0).integrate_lines(o, d) == pytest.approx(0.7, abs=ROUNDING)
    assert ball(1.0).integrate_lines(o, d, whole_lines=True) == pytest.approx(2.0, abs=ROUNDING)
    assert ball(1.0).integrate_lines(o + np.array([3.0, 0, 0]), d) == 0.0


def test_chord_does_not_cancel_far_away():
    """sqrt(B^2 - A C) has lost 12 of 16 digits 1e6 radii away; the nearest-point form keeps those of o + t d."""
    o = np.array([[-1e6, 0.6, 0.0]])
    chord = ball(1.0).integrate_lines(o, np.array([[1.0, 0.0, 0.0]]))
    assert chord == pytest.approx(1.6, abs=4e-16 * 1e6 * 4)


@pytest.mark.parametrize("variant", SHEPP_LOGAN)
def test_parallel_projections_hold_the_mass(variant):
    """Rationale: a parallel projection summed over the detector is the object's mass, 4/3 pi sum(value a b c).

    Expected: equal but for the midpoint rule, which misses a square-root edge by order pitch^(3/2): (0.01)^1.5 = 1e-3
    of the value per edge.
    """
    phantom = shepp_logan(variant)
    mass = 4 / 3 * np.pi * np.sum(phantom.values / np.abs(np.linalg.det(phantom.to_body)))
    beam = ParallelBeam(np.array([0.0, 0.4, 2.0]), (200, 200), pitch=0.0105)
    sums = phantom.project(beam).sum(axis=(1, 2)) * 0.0105**2
    np.testing.assert_allclose(sums, mass, rtol=2e-3)


def test_voxels_hold_the_mass_and_the_values():
    phantom = shepp_logan("toft-schabel")
    mass = 4 / 3 * np.pi * np.sum(phantom.values / np.abs(np.linalg.det(phantom.to_body)))
    grid = VoxelGrid((40, 48, 44), (2 / 44, 2 / 48, 2 / 40))
    volume = phantom.voxelise(grid, 4)
    # Midpoint rule: 1e5 sub-cells are cut by the surfaces, each wrong by half at most and of random sign: << 1e-3.
    assert volume.sum(dtype=float) * np.prod(grid.voxel_size) == pytest.approx(mass, rel=1e-3)
    assert volume.shape == grid.shape
    assert volume[0, 0, 0] == 0
    assert volume[20, 24, 22] == pytest.approx(0.2, abs=1e-6), "inside the skull, outside the small ellipsoids: 1 - 0.8"


def test_shepp_logan_values_on_paper():
    """Published densities: skull 2.0, brain 1.02, ventricles 1.00 of water (Kak & Slaney p. 102)."""
    head = shepp_logan("kak-slaney")
    points = np.array([[0.0, 0.9, 0.0], [0.0, -0.3, 0.0], [0.22, 0.0, -0.25], [0.0, 0.35, -0.25]])
    np.testing.assert_allclose(head.eval_points(points), [2.0, 1.02, 1.0, 1.04], atol=1e-12)


def test_turned_centre_belongs_to_toft_schabel_only():
    """Its third ellipsoid (phi -18, psi 10) is centred where the turned frame says (0.22, 0, 0)."""
    a = np.radians(-8.0)
    np.testing.assert_allclose(shepp_logan("toft-schabel").centres[2], [0.22 * np.cos(a), 0.22 * np.sin(a), 0], atol=1e-12)
    np.testing.assert_allclose(shepp_logan("kak-slaney").centres[2], [-0.22, 0.0, -0.25])


def test_scaling_the_object_scales_its_lines():
    phantom = random_ellipsoids(5, seed=3)
    beam = ParallelBeam(np.array([0.3]), (20, 20), 0.1)
    large = ParallelBeam(np.array([0.3]), (20, 20), 0.7)
    np.testing.assert_allclose(phantom.scaled(7).project(large), 7 * phantom.project(beam), atol=1e-11)


def test_rotation_of_the_euler_angles():
    """phi = 90 degrees turns the long axis a from x to y, and theta = 90 about the new x then stands b up along z."""
    turned = EllipsoidPhantom(*_one(0.5, 0.2, 0.1, phi=90))
    assert turned.eval_points(np.array([[0, 0.45, 0], [0.45, 0, 0]])).tolist() == [1.0, 0.0]
    tilted = EllipsoidPhantom(*_one(0.1, 0.5, 0.1, theta=90))
    assert tilted.eval_points(np.array([[0, 0, 0.45], [0, 0.45, 0]])).tolist() == [1.0, 0.0]


def test_random_ellipsoids_stay_in_the_ball_and_repeat():
    a, b = random_ellipsoids(20, seed=1, half_width=2.0), random_ellipsoids(20, seed=1, half_width=2.0)
    np.testing.assert_array_equal(a.to_body, b.to_body)
    shell = np.random.default_rng(0).normal(size=(4000, 3))
    shell *= 2.0001 / np.linalg.norm(shell, axis=1, keepdims=True)
    assert not a.eval_points(shell).any()


def test_cone_and_parallel_views_agree_far_away():
    """A source at distance D sees a pixel's line tilted by at most r / D: the two differ by O(r / D) of the value."""
    phantom, angles = ball(1.0), np.array([0.7])
    far = ConeBeam(angles, (9, 9), 1e6, 1e6, pitch=0.15)
    near = ParallelBeam(angles, (9, 9), pitch=0.15)
    np.testing.assert_allclose(phantom.project(far), phantom.project(near), atol=1e-5)


def test_radon_sinogram_of_an_off_centre_ball():
    """The shadow's middle follows s = x cos(theta) + y sin(theta), row = z: signs of the frame."""
    angles = np.linspace(0, 2 * np.pi, 7)
    beam = ParallelBeam(angles, (64, 64), 0.05)
    projections = ball(0.2, (0.5, -0.3, 0.4)).project(beam)
    u = (np.arange(64) - 31.5) * 0.05
    mass = projections.sum((1, 2))
    # Midpoint moments of a shadow 8 pixels wide: sampled to a few thousandths of its radius.
    np.testing.assert_allclose((projections.sum(1) @ u) / mass, 0.5 * np.cos(angles) - 0.3 * np.sin(angles), atol=2e-3)
    np.testing.assert_allclose((projections.sum(2) @ u) / mass, 0.4, atol=2e-3)


def test_axis_offset_moves_the_shadow_by_whole_columns():
    angles = np.linspace(0, np.pi, 4)
    phantom = random_ellipsoids(4, seed=2)
    centred = phantom.project(ParallelBeam(angles, (10, 50), 0.05))
    moved = phantom.project(ParallelBeam(angles, (10, 50), 0.05, axis_offset=3 * 0.05))
    np.testing.assert_allclose(moved[..., 3:], centred[..., :-3], atol=1e-12)


def test_cone_axis_offset_is_not_magnified():
    """A point on the axis is seen by the ray whose detector position is axis_offset times the magnification."""
    beam = ConeBeam(np.array([0.0, 1.0]), (1, 201), 10.0, 30.0, pitch=0.01, axis_offset=-0.2)
    seen = ball(0.05).project(beam)[:, 0].argmax(axis=1)
    assert (np.abs((seen - 100) * 0.01 - -0.2 * 3) <= 0.005 + 1e-9).all()


def test_unknown_head_is_refused():
    assert_refused("expected one of kak-slaney, yu-ye-wang, toft-schabel", shepp_logan, "logan-shepp")


@pytest.mark.parametrize(
    ("build", "sentence"),
    [
        (lambda: VoxelGrid((4, 0, 4)), "three counts"),
        (lambda: VoxelGrid((4, 4, 4), -1.0), "positive lengths"),
        (lambda: ParallelBeam(np.array([]), (4, 4)), "at least one"),
        (lambda: ParallelBeam(np.array([np.nan]), (4, 4)), "all finite"),
        (lambda: ParallelBeam(np.zeros(2), (4, 4), pitch=0.0), "pixel pitch"),
        (lambda: ConeBeam(np.zeros(2), (4, 4), 0.0, 5.0), "from source to axis"),
        (lambda: ParallelBeam(np.zeros(2), (4, 4)).rays([2]), "views from 0 to 1"),
    ],
)
def test_unusable_geometry_is_refused_in_a_sentence(build, sentence):
    assert_refused(sentence, build)


def _one(a: float, b: float, c: float, phi: float = 0.0, theta: float = 0.0):
    from mivol.tomography.phantoms import _euler_matrix

    rotation = _euler_matrix(np.radians(phi), np.radians(theta), 0.0)
    return (rotation / np.array([a, b, c])[:, None])[None], np.zeros((1, 3)), np.ones(1)


def test_no_number_of_the_tables_was_changed():
    """Sums of what was typed from the papers, by columns: one wrong digit changes one of them."""
    sums = {name: np.sum(getattr(phantoms, name), axis=0) for name in ("_KAK_SLANEY", "_TOFT_SCHABEL")}
    np.testing.assert_allclose(
        sums["_KAK_SLANEY"], [2.5324, 2.502, 2.996, 0.04, -0.855, -0.25, 360, 0, 0, 1.04], rtol=0, atol=1e-9
    )
    np.testing.assert_allclose(
        sums["_TOFT_SCHABEL"], [2.0164, 2.948, 2.69, -0.02, -1.4844, 0.35, 0, 0, 20, 0.4], rtol=0, atol=1e-9
    )


def test_procedural_points_are_voxel_centres(monkeypatch: pytest.MonkeyPatch) -> None:
    """A recipe that returns one of its coordinates: x along the last axis, z along the first, centres at (i + 1/2) / n."""
    for axis, name in enumerate("xyz"):
        monkeypatch.setitem(PROCEDURAL, name, lambda p, rng, axis=axis: p[..., axis])
        values = make_procedural(name, (2, 3, 4), seed=0, peak=2.0)[..., 0]
        n = (4, 3, 2)[axis]
        line = np.moveaxis(values, 2 - axis, 0)[:, 0, 0]
        assert np.allclose(line, 2 * (np.arange(n) + 0.5) / n)


@pytest.mark.parametrize("shape", [4, (4, 4), (4, -4, 4), (4, 0, 4), (4, 4.5, 4)])
def test_a_procedural_volume_has_three_edges(shape: object) -> None:
    assert_refused("expected numbers of voxels along z, y and x", make_procedural, "tangle", shape, seed=0, peak=1.0)


def test_procedural_volumes_are_the_same_object_at_every_resolution() -> None:
    """Fine voxels averaged over coarse ones against coarse voxels: they differ by the curvature inside a voxel only; with two
    axes exchanged they would differ by the object's own contrast. And another seed is another object."""
    coarse = make_procedural("tangle", (8, 10, 12), seed=1, peak=2.0)[..., 0]
    fine = make_procedural("tangle", (24, 30, 36), seed=1, peak=2.0)[..., 0]
    mean = fine.reshape(8, 3, 10, 3, 12, 3).mean(axis=(1, 3, 5))
    assert np.corrcoef(mean.ravel(), coarse.ravel())[0, 1] > 0.9
    assert np.corrcoef(make_procedural("tangle", (8, 10, 12), seed=2, peak=2.0).ravel(), coarse.ravel())[0, 1] < 0.8
    assert fine.max() <= 2.0
    assert fine.min() >= 0.0


def test_a_seed_is_the_same_object_on_every_machine() -> None:
    """Mean, spread, largest value and three voxels, as recorded; elementary functions differ by 1e-15 between machines."""
    values = make_procedural("tangle", (9, 10, 11), seed=5, peak=2.0)[..., 0]
    found = [values.mean(), values.std(), values.max(), values[4, 5, 6], values[2, 7, 3], values[6, 3, 8]]
    np.testing.assert_allclose(found, [0.08407, 0.23891, 1.84418, 1.44317, 0.5357, 0.00068], atol=1e-5)
    assert_refused('"tangel": known are tangle', make_procedural, "tangel", (2, 2, 2), seed=0, peak=1.0)


def test_an_object_ends_before_its_box() -> None:
    """1 up to 0.42 of the middle, 0 from 0.48 on, a ramp between, along every axis."""
    for axis in range(3):
        points = np.full((5, 3), 0.5)
        points[:, axis] += [-0.42, 0.45, 0.48, -0.5, 0.1]
        np.testing.assert_allclose(inside(points), [1, 0.5, 0, 0, 1], atol=1e-12)


def test_a_cumulus_in_bricks_is_the_whole_cloud(variant_rgb: str) -> None:
    """Its depth at every voxel centre of the box: no brick is left out."""
    n, cumulus = 64, Cumulus(balls=9, seed=3)
    cloud = make_cumulus(n, 150.0, cumulus)
    z, y, x = np.meshgrid(*[(np.arange(n, dtype=np.float32) + 0.5) / n] * 3, indexing="ij")
    depth = np.array(cumulus.depth(mi.Point3f(x.ravel(), y.ravel(), z.ravel()))).reshape(n, n, n, 1)
    whole = 150 * np.clip(depth * n / 4, 0, 1)
    assert 0.005 < np.count_nonzero(whole) / n**3 < 0.1 and len(cloud.values) < 8**3 / 2
    # Half an ulp of a coordinate of 1, times the steepest slope: 150 n / 4, and at most 10 by the noise.
    assert np.abs(cloud.dense() - whole).max() <= 150 * n / 4 * 10 * 2.0**-24
