"""Filtered back-projection and FDK of objects whose line integrals are known on paper; weights of redundant rays."""

from __future__ import annotations

import numpy as np
import pytest
from refusals import assert_refused

from mivol.tomography.filtered import (
    BLEND_COLUMNS,
    WINDOWS,
    angle_steps,
    backproject_layers,
    backproject_voxels,
    covers_circle,
    feldkamp,
    filter_ramp,
    filtered_backprojection,
    full_turn_weights,
    have_layers,
    parker_weights,
    pixel_matrices,
    widest_gap,
)
from mivol.tomography.geometry import ConeBeam, ParallelBeam, PencilRays, VoxelGrid
from mivol.tomography.phantoms import EllipsoidPhantom
from mivol.tomography.preprocess import interpolate_gaps
from mivol.tomography.projector import Projector

GRID = VoxelGrid((1, 48, 48))
RADIUS, CENTRE, VALUE = 14.0, (4.0, -2.5), 2.0


def turn(n: int, degrees: float) -> np.ndarray:
    return np.radians(degrees) * np.arange(n) / n


def cone(angles: np.ndarray, columns: int = 76, **more: object) -> ConeBeam:
    return ConeBeam(angles, (1, columns), source_to_axis=150.0, source_to_detector=225.0, pitch=1.5, **more)


def parallel(angles: np.ndarray, columns: int = 60, **more: object) -> ParallelBeam:
    return ParallelBeam(angles, (1, columns), **more)


SHUFFLED = np.random.default_rng(0).permutation(turn(96, 180.0))
SCANS = {
    "half a turn": parallel(turn(96, 180)),
    "both ends of half a turn": parallel(np.radians(np.linspace(0, 180, 97))),
    "three quarters": parallel(turn(144, 270)),
    "golden angles": parallel(np.arange(96) * np.pi * (np.sqrt(5) - 1) / 2),
    "backwards and shuffled": parallel(-SHUFFLED),
    "axis beside the middle": parallel(turn(96, 180), axis_offset=4.25),
    "displaced": parallel(turn(192, 360), 48, axis_offset=13.0),
    "displaced to the left": parallel(turn(192, 360), 48, axis_offset=-13.0),
    "cone": cone(turn(144, 360)),
    "cone, half scan": cone(turn(110, 217)),
    "cone, half scan backwards": cone(1.0 - turn(110, 217)),
    "cone, most of a turn": cone(turn(140, 320) + 2.0),
    "cone, displaced": cone(turn(192, 360), 52, detector_offset=(0.0, 24.0)),
    "cone, displaced to the left": cone(turn(192, 360), 52, detector_offset=(0.0, -24.0)),
    "cone, axis beside the central ray": cone(turn(144, 360), 84, axis_offset=8.0),
    "cone, half scan, axis beside the central ray": cone(turn(120, 230), 84, axis_offset=8.0),
}


@pytest.mark.parametrize("name", SCANS)
def test_a_ball_is_found_in_the_plane_of_the_source(variant_rgb: str, name: str) -> None:
    """A ball off the axis, its chords exact: its value inside and 0 outside, in every kind of scan.

    In the source's plane the formulas are exact for continuous data. What is sampled ends at the Nyquist frequency: an edge
    of height V rings by at most V / (pi^2 d) at d pixels from it (the tail of the sine integral) with a sign that alternates
    from pixel to pixel, so that the mean over rings 4 pixels and more from the edge is below V / (4 pi^2) over their number,
    10 inside: 0.0051, and less outside. Aliasing of 96 views over half a turn begins 60 pixels away from the edge.
    """
    beam = SCANS[name]
    ball = EllipsoidPhantom(np.eye(3)[None] / RADIUS, np.array([[*CENTRE, 0.0]]), np.array([VALUE]))
    method = filtered_backprojection if isinstance(beam, ParallelBeam) else feldkamp
    x = method(Projector(beam, GRID), ball.project(beam))
    distance = np.hypot(GRID.axis("x") - CENTRE[0], GRID.axis("y")[:, None] - CENTRE[1])
    assert x.shape == GRID.shape
    assert x[0][distance < RADIUS - 4].mean() == pytest.approx(VALUE, abs=0.0051)
    assert abs(x[0][distance > RADIUS + 4].mean()) < 0.0051
    assert np.abs(x[0][distance < RADIUS - 4] - VALUE).max() < VALUE / (4 * np.pi**2)


def test_rows_and_axes_are_where_they_are(variant_rgb: str) -> None:
    """A small ball high above the plane and off the axis comes out with its middle where it is, with unequal voxels."""
    grid = VoxelGrid((20, 24, 22), (0.6, 0.5, 0.8), centre=(0.4, -0.3, 0.2))
    middle = np.array([2.0, -1.5, 3.0])
    ball = EllipsoidPhantom(np.eye(3)[None] / 2.0, middle[None], np.ones(1))
    # The detector sees the whole grid; the cone opens by 4 degrees, whose effect on the middle of a ball is second order.
    for beam in (
        ParallelBeam(turn(60, 180), (40, 44), (0.5, 0.4), axis_offset=0.3, detector_offset=(0.7, 0.0)),
        ConeBeam(turn(90, 360), (44, 44), 90.0, 120.0, (0.6, 0.5), detector_offset=(0.5, 0.0)),
    ):
        method = filtered_backprojection if isinstance(beam, ParallelBeam) else feldkamp
        x = method(Projector(beam, grid), ball.project(beam)).astype(float)
        inside = np.where(x > 0.5, x, 0.0)
        places = np.meshgrid(*(grid.axis(name) for name in "zyx"), indexing="ij")
        found = np.array([np.sum(inside * place) / inside.sum() for place in reversed(places)])
        # Voxels are counted whole: the middle of 130 of them is known to a voxel over the root of their number.
        assert np.abs(found - middle).max() < 0.8 / np.sqrt(130)


@pytest.mark.parametrize("window", WINDOWS)
def test_a_wave_is_multiplied_by_its_frequency_and_the_window(window: str) -> None:
    """cos(2 pi f s) in the middle of a long row: |f| W(f / (cutoff f_Nyquist)) times it.

    What the row's ends, N = 2000 columns away and more, cut off the ramp's kernel is at most 2 sum_{n > N, odd} 1 / (pi n)^2
    = 1 / (pi^2 N) = 5e-5 over the pitch. Where a window ends in a jump of J its kernel goes on as J sin(2 pi c n) / (pi n):
    by Dirichlet's bound the wave of w cycles a column leaves J / (pi N) (1 / sin(pi |c - w|) + 1 / sin(pi (c + w))), two ends
    together; c = 0.4, J = 0.4: 1.5e-4; c = 0.1, J = 0.1: 2.3e-4.
    """
    pitch, f, cutoff = 0.5, 0.25, 0.8
    s = pitch * np.arange(4096)
    wave = np.cos(2 * np.pi * f * s)
    kept = WINDOWS[window](np.array([f * 2 * pitch / cutoff]))[0]
    middle = slice(2000, 2096)
    filtered = filter_ramp(wave, pitch, window, cutoff)
    assert np.abs(filtered - f * kept * wave)[middle].max() < 2.8e-4 / pitch
    assert np.abs(filter_ramp(wave, pitch, window, 0.2)[middle]).max() < 2.8e-4 / pitch


def test_shares_of_a_line_add_up_to_one() -> None:
    """Both rays of a line, (beta, gamma) and (beta + pi - 2 gamma, -gamma), on random lines; one not taken counts 0."""
    rng = np.random.default_rng(1)
    excess, gamma = 0.5, np.linspace(-0.4, 0.4, 41)
    for beta in rng.uniform(0, np.pi + 2 * excess, 50):
        first = parker_weights(np.array([beta]), gamma, excess)[0]
        for k, g in enumerate(gamma):
            other = np.mod(beta + np.pi - 2 * g, 2 * np.pi)
            seen = other <= np.pi + 2 * excess
            second = parker_weights(np.array([other]), -gamma[k : k + 1], excess)[0, 0] if seen else 0.0
            assert first[k] + second == pytest.approx(1.0, abs=1e-12)
    shares = full_turn_weights(np.linspace(-0.1, 0.4, 501))
    assert np.abs(shares[:201] + shares[200::-1] - 1).max() < 1e-12
    assert (shares[201:] == 1).all()
    assert (full_turn_weights(np.linspace(-0.4, 0.4, 9)) == 0.5).all()


def test_steps_share_the_circle() -> None:
    """Every view stands for what is nearest to it; equal ones share; all of it is shared out."""
    steps = angle_steps(np.array([0.0, 3.0, 1.0, np.pi]), np.pi)
    gap = np.pi - 3.0
    assert steps == pytest.approx([gap / 2, (2 + gap) / 2, 1.5, 0.5])
    assert steps.sum() == pytest.approx(np.pi)


def test_unused_pixels_are_bridged() -> None:
    y, weights = np.array([[[7.0, 1.0, 9.0, 3.0, 8.0]], [[5.0] * 5]]), np.array([[[0.0, 1, 0, 2, 0]], [[0.0] * 5]])
    assert interpolate_gaps(y, weights).tolist() == [[[1.0, 1.0, 2.0, 3.0, 3.0]], [[0.0] * 5]]
    assert interpolate_gaps(y, weights + 1) is y


def test_scans_that_miss_directions_are_refused(variant_rgb: str) -> None:
    y = np.zeros((40, 1, 76))
    pencil = PencilRays(np.zeros((40, 3)), np.ones((40, 3)))
    for method, beam, sentence in (
        (filtered_backprojection, parallel(turn(40, 120), 76), "a gap of 63.0 degrees among the directions"),
        (filtered_backprojection, cone(turn(40, 360)), "fdk is filtered back-projection of a ConeBeam"),
        (feldkamp, parallel(turn(40, 180), 76), "fbp is for parallel beams"),
        (feldkamp, pencil, "choose an iterative solver"),
        (feldkamp, cone(turn(40, 190)), "over 185.2 degrees, expected half a turn and the fan of 18.4"),
        (feldkamp, cone(turn(40, 360), detector_offset=(0.0, 70.0)), "wholly on one side of the rotation axis"),
    ):
        assert_refused(sentence, method, Projector(beam, GRID), y)
    for settings, sentence in (({"window": "box"}, '"box", expected one of ram-lak'), ({"cutoff": 0.0}, "cutoff of 0.0")):
        assert_refused(sentence, filter_ramp, y, 1.0, **settings)


def test_the_widest_gap_and_where_it_ends() -> None:
    """Views anywhere on the circle, in any order; the gap may lie across its end, and ends at the view after it."""
    assert widest_gap(np.array([4.0, 0.5, 1.0]), 6.0) == (3.0, 4.0)
    assert widest_gap(np.array([1.0, 2.0, 3.0]), 6.0) == (4.0, 1.0)
    assert widest_gap(np.array([-1.0, 7.0]), 6.0) == (4.0, 5.0)
    assert widest_gap(np.array([2.0]), 6.0) == (6.0, 2.0)
    assert widest_gap(np.array([0.0, 3.0]), 6.0) == (3.0, 3.0)


@pytest.mark.parametrize(("missing", "covered"), [(3, True), (4, False)])
def test_four_steps_may_lie_between_two_views(missing: int, covered: bool) -> None:
    """Of 16 views on a circle of 16 so many lie elsewhere: a gap of one more; exactly four steps are enough."""
    angles = np.concatenate([np.arange(16.0 - missing), np.full(missing, 0.5)])
    assert covers_circle(angles, 16.0) == covered


def test_steps_of_one_view_and_of_equal_ones() -> None:
    assert angle_steps(np.array([2.0]), 6.0).tolist() == [6]
    assert angle_steps(np.array([2.0, 2.0]), 6.0).tolist() == [3, 3]
    assert angle_steps(np.array([5.0, -5.0, 3.0]), 6.0).tolist() == [2.0, 2.0, 2.0]


@pytest.mark.parametrize("turned", [False, True])
def test_shares_of_a_displaced_detector(turned: bool) -> None:
    """Over a fifth of the shorter side, or 20 columns, or all of it, whichever is wider and there: a half up to its beginning,
    3/4 in its middle, 1 from the end of the shorter side on; and what is left of 1 on that side."""
    for short, column in ((100, 0.01), (200, 0.01), (10, 0.01)):
        gamma = np.arange(-short, 2 * short + 1) * column
        width = min(short, max(short / 5, BLEND_COLUMNS)) * column
        shares = full_turn_weights(gamma)
        if turned:
            shares = full_turn_weights(-gamma[::-1])[::-1]
        begin = short * column - width
        wanted = np.sin(np.pi / 2 * np.clip((np.abs(gamma) - begin) / width, 0, 1)) ** 2
        np.testing.assert_allclose(shares, 0.5 * (1 + np.where(gamma < 0, -1, 1) * wanted), atol=1e-9)
        assert shares[0] == pytest.approx(0, abs=1e-9) and shares[-1] == 1


def test_detectors_that_are_centred_or_miss_the_axis() -> None:
    """Within a column of the middle all count a half; the axis must be seen."""
    assert full_turn_weights(np.array([-2.0, -1, 0, 1, 2.9])).tolist() == [0.5] * 5
    assert full_turn_weights(np.arange(-2.0, 4.0))[-1] == 1
    for gamma in (np.array([0.0, 0.1, 0.2]), np.array([0.1, 0.2]), np.array([-0.3, -0.2, -0.1]), np.array([0.3])):
        assert_refused("wholly on one side of the rotation axis", full_turn_weights, gamma)


def test_parkers_shares() -> None:
    """His formula with gamma the other way round (Parker 1982, equation 12): rise, 1, and fall, for each ray."""
    excess, gamma = 0.4, np.array([-0.6, -0.4, -0.1, 0.0, 0.3, 0.4, 0.5])
    beta = np.linspace(0, np.pi + 2 * excess, 23)
    found = parker_weights(beta, gamma, excess)
    for i, b in enumerate(beta):
        for j, g in enumerate(-np.clip(gamma, -excess, excess)):
            if b < 2 * (excess - g):
                wanted = np.sin(np.pi / 4 * b / (excess - g)) ** 2
            elif b <= np.pi - 2 * g:
                wanted = 1.0
            else:
                wanted = np.sin(np.pi / 4 * (np.pi + 2 * excess - b) / (excess + g)) ** 2
            assert found[i, j] == pytest.approx(wanted, abs=1e-12)


@pytest.mark.parametrize("grid", [VoxelGrid((19, 11, 9), (1.3, 0.9, 1.0), (2.0, 1.0, 0.3)), VoxelGrid((3, 7, 40), 1.5)])
def test_layers_at_once_equal_voxel_by_voxel(variant_rgb: str, grid: VoxelGrid) -> None:
    """Sixteen layers share their columns, with layers between rows, beyond the detector, and left over from sixteen.

    Tolerance: both sum at most 12 readings below 1, interpolated in another order: 12 sums of 4 rounding errors of 2^-24.
    """
    beam = ParallelBeam(turn(12, 180), (9, 17), (0.75, 1.0), 1.25)
    images = np.random.default_rng(3).random(beam.shape).astype(np.float32)
    matrices = pixel_matrices(beam, grid)
    expected = backproject_voxels(matrices, images, grid, weighted=False)
    assert np.abs(backproject_layers(matrices, images, grid) - expected).max() < 12 * 4 * 12 * 2.0**-24
    assert (expected > 1).any() and have_layers(matrices)


def test_a_tilt_leaves_the_layers(variant_rgb: str) -> None:
    """With a tilt of .05 a shadow's row depends on x and y: each voxel is read by itself, and the tilted ball is found."""
    beam = ParallelBeam(turn(96, 360), (60, 60), tilt=0.05)
    assert not have_layers(pixel_matrices(beam, VoxelGrid((48, 48, 48))))
    ball = EllipsoidPhantom(np.eye(3)[None] / 6.0, np.array([[14.0, 0.0, 5.0]]), np.array([1.0]))
    grid = VoxelGrid((48, 48, 48))
    volume = filtered_backprojection(Projector(beam, grid), ball.project(beam))
    z, y, x = np.indices(grid.shape)[:, volume > 0.5].mean(1) - 23.5
    assert np.abs([x - 14, y, z - 5]).max() < 0.1
