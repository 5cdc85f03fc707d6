"""Figures are readable, and their rules hold: one scale for one quantity, no axis without a unit."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.image import imread
from photo_sets import look_at, ring
from PIL import Image
from readable_figures import assert_readable, find_unreadable
from refusals import assert_refused

from mivol.errors import MivolError
from mivol.photos import Camera, PhotoSurvey, intrinsics, pixel_centres, rays
from mivol.photos.survey import PhotoFrame
from mivol.report.cameras import plot_cameras
from mivol.report.figures import (
    Series,
    central_line,
    inline_svg,
    plot_curve,
    plot_error_against_time,
    plot_image_row,
    plot_profile,
    save_figure,
)
from mivol.report.pixel_scale import EDGE, GAP, depth_pixels, is_preview_due, normal_pixels, normals_from_depth, write_preview


def falling_curve() -> Figure:
    return plot_curve([{"iteration": k, "seconds": 0.5 * k, "loss": 4.0 / 2**k} for k in range(9)], "loss")


def long_curve() -> Figure:
    return plot_curve([{"iteration": k, "seconds": 0.5 * k, "psnr": 20.0 + k} for k in range(31)], "psnr")


def reaching_the_noise() -> Figure:
    return plot_curve([{"iteration": k, "discrepancy": 1 + 8.0 / 2**k} for k in range(9)], "discrepancy")


def profile() -> Figure:
    found, truth = ramps()
    return plot_profile({"reconstruction": found, "truth": truth}, "y", (-1.0, 2.0), "sigma_t [1/length]")


def methods() -> Figure:
    t = np.array([4.0, 1.0, 16.0])
    series = [
        Series("ours", t / 8, 1 / t),
        Series("tracking", t, t**-0.5),
        Series("exact", [5e4], [1e-6]),
        Series("even", t, 0.3 / t),
    ]
    return plot_error_against_time(series, title="Which is sooner?")


def ramps() -> tuple[np.ndarray, np.ndarray]:
    z, y, x = np.meshgrid(*(np.arange(n) for n in (3, 4, 5)), indexing="ij")
    return z + y / 4 + x / 20, (z + x) / 7


def row() -> Figure:
    reference = ramps()[0][0]
    return plot_image_row(reference, reference[:, ::-1], (reference[:, ::-1] - reference) / 0.1, unit="W")


def row_in_colour() -> Figure:
    reference = np.stack([ramps()[0][k] for k in range(3)], axis=-1)
    return plot_image_row(reference, 0.9 * reference)


def cameras(part: str | None = None, corner: tuple[float, float, float] = (1, 1, 1)) -> Figure:
    views = [Camera(np.array([[20.0, 0, 6], [0, 20, 4], [0, 0, 1]]), (12, 8), pose) for pose in ring(5)]
    splits = ("train", "held_out", "val", "test", "train")
    frames = tuple(PhotoFrame(Path(f"{k}.png"), view, split) for k, (view, split) in enumerate(zip(views, splits, strict=True)))
    box = np.outer([-1.0, 1.0], corner)
    survey = PhotoSurvey(Path("ring"), "COLMAP", frames, (), box, "points", (1.0, 9.0), np.zeros((1, 3)))
    return plot_cameras(survey, part=part)


def flat_ring() -> Figure:
    """The side view of a page, around a flat box."""
    return cameras("side", (9, 9, 1))


@pytest.mark.parametrize("ends", [(0.0574, 0.13), (0.0090, 0.0125), (1.01, 4.9), (2.01, 10.1), (3.0, 299.0)])
def test_a_log_axis_has_two_labels_at_least(ends: tuple[float, float]) -> None:
    rows = [{"iteration": k, "seconds": k, "loss": value} for k, value in enumerate(ends)]
    axes = plot_curve(rows, "loss").axes[0]
    low, high = axes.get_ylim()
    assert sum(low <= tick <= high for tick in axes.get_yticks()) >= 2


DRAWN = [cameras, flat_ring, falling_curve, long_curve, reaching_the_noise, profile, methods, row, row_in_colour]


@pytest.mark.parametrize("draw", DRAWN, ids=lambda draw: draw.__name__)
def test_a_figure_is_readable(draw: Callable[[], Figure]) -> None:
    assert_readable(draw())


@pytest.mark.parametrize(
    ("draw", "title", "x", "scales"),
    [
        (falling_curve, "Loss", "iteration", ("linear", "log")),
        (long_curve, "PSNR of the fitted views [dB]", "iteration", ("linear", "linear")),
        (reaching_the_noise, "RMS of residual over noise (noise level: 1)", "iteration", ("linear", "log")),
        (profile, "sigma_t [1/length]", "y [length]", ("linear", "linear")),
        (methods, "Which is sooner?", "time of a call after the first [s]", ("log", "log")),
    ],
)
def test_curves_name_their_quantities_with_units(draw: Callable[[], Figure], title: str, x: str, scales: tuple) -> None:
    (axes,) = draw().axes
    assert (axes.get_title("left"), axes.get_xlabel(), (axes.get_xscale(), axes.get_yscale())) == (title, x, scales)


def test_pictures_of_one_quantity_share_a_scale() -> None:
    """White is the largest value of the reference, a difference is symmetric about 0, and z ends at 4 standard errors."""
    reference, render, difference, z = [axes.get_xlim() for axes in row().axes if axes.get_xlabel()]
    assert reference == render and reference[0] == 0
    assert difference[0] == -difference[1] and z == (-4, 4)


def test_a_picture_has_160_pixels_an_inch(tmp_path: Path) -> None:
    """A curve of 4.4 x 2.75 inches."""
    with Image.open(save_figure(long_curve(), tmp_path / "curve.png")) as image:
        assert image.size == (704, 440)


def test_a_figure_in_a_page_has_the_colours_of_the_page() -> None:
    """Nothing is filled or drawn but in colours of the page's theme: a white ground would stand out on a dark page."""
    colours = {f"var(--{c})" for c in ("ink", "faint", "rule", "series-0")}
    text = inline_svg(falling_curve(), 'a "label"')
    assert set(re.findall(r"(?:fill|stroke): ([^;\"]*)", text)) - {"none"} == colours
    assert 'aria-label="a &quot;label&quot;"' in text and "<metadata>" not in text


def test_profiles_run_through_the_middle_voxel() -> None:
    """Of 3 x 4 x 5 voxels that is (1, 2, 2), as in the slices; places are the middles of voxels in the box."""
    values = np.arange(60.0).reshape(3, 4, 5)
    assert central_line(values, "x").tolist() == values[1, 2].tolist()
    assert central_line(values, "y").tolist() == values[1, :, 2].tolist()
    assert central_line(values, "z").tolist() == values[:, 2, 2].tolist()
    (line, _) = profile().axes[0].lines
    np.testing.assert_allclose(line.get_xdata(), [-0.75, -0.25, 0.25, 0.75])
    assert profile().axes[0].get_xlabel() == "y [length]"


def test_normals_of_a_sphere(artefacts: Path) -> None:
    camera = Camera(intrinsics(400, 400, 100, 80), (200, 160), look_at(np.array([3.0, -2, 1.5])))
    o, d = rays(camera, pixel_centres(camera.size))
    b = np.sum(o * d, axis=-1)
    with np.errstate(invalid="ignore"):
        distance = -b - np.sqrt(b**2 - np.sum(o * o, axis=-1) + 0.25)
    hit = np.isfinite(distance)
    normals = normals_from_depth(distance, camera)
    inner = np.isfinite(normals).all(axis=-1) & (np.sum(normals * d, axis=-1) < -0.3)
    truth = 2 * (o + distance[..., None] * d)
    # Central differences of z = sqrt(1 - x^2) err by h^2/6 z''' = h^2/(2 z^5) in slope, h^2/(2 z^3) in angle: with pixels of
    # h = 3.4/400 on a radius of 1/2 and z = 0.3 it is 5.4e-3 along each axis, 7.6e-3 for both.
    assert inner.sum() > 5000
    np.testing.assert_allclose(normals[inner], truth[inner], atol=7.6e-3)
    depth = depth_pixels(distance, (2.5, 4.5))
    assert (depth[~hit] == 255).all() and (depth[hit] < 255).any(axis=-1).all()
    Image.fromarray(np.hstack([depth, normal_pixels(normals)])).save(artefacts / "sphere.png")


def test_near_is_light_far_is_dark_and_transparent_is_white() -> None:
    distance = np.array([[1.0, 2, 3, np.inf], [1, 2, 3, 0]])
    colours = depth_pixels(distance, (1, 3), np.array([[1, 1, 1, 1], [1, 0.5, 0, 1]]))
    brightness = colours.astype(float).mean(axis=-1)
    assert brightness[0, 0] > brightness[0, 1] > brightness[0, 2]
    assert (colours[0, 3] == 255).all() and (colours[1, 2] == 255).all()
    np.testing.assert_array_equal(colours[1, 3], colours[1, 0])  # a distance below near has the colour of near
    np.testing.assert_allclose(colours[1, 1], (colours[0, 1] + 255.0) / 2, atol=1)
    np.testing.assert_array_equal(normal_pixels(np.array([[[0.0, 0, 1], [-1, 0, 0]]]))[0], [[128, 128, 255], [0, 128, 128]])
    for shape, span, message in (((3,), (0, 1), "give \\(height, width\\)"), ((2, 2), (1, 1), "give near below far")):
        assert_refused(message, depth_pixels, np.ones(shape), span)
    with pytest.raises(MivolError, match="do not fit a camera"):
        normals_from_depth(np.ones((5, 5)), Camera(intrinsics(90, 100, 30, 20), (64, 48), np.eye(4)))


def test_a_preview_shows_three_slices_on_one_scale(tmp_path: Path) -> None:
    """A box of 1 x 2 x 0.5: xy, xz and yz from 0 to the largest value, the second axis up."""
    volume = np.zeros((2, 4, 2), np.float32)
    volume[1, 0, 0] = 4.0  # the middle layer z = 1: low y, low x
    volume[0, 2, 1] = 2.0  # the middle y = 2 and x = 1: low z
    path = write_preview(tmp_path, volume, (1.0, 2.0, 0.5))
    image = np.round(255 * imread(path)[..., 0]).astype(int)
    x, y, z = EDGE // 2, EDGE, EDGE // 4
    assert image.shape == (y, x + x + y + 2 * GAP)
    xy, xz, yz = image[:, :x], image[y - z :, x + GAP : x + GAP + x], image[y - z :, -y:]
    assert (image[: y - z, x + GAP :] == 255).all() and (image[:, x : x + GAP] == 255).all()
    assert (xy[-y // 4 :, : x // 2] == 255).all() and (xy[: -y // 4] == 0).all() and (xy[:, x // 2 :] == 0).all()
    half = int(np.round(255 * 2 / np.percentile([4.0] + 7 * [0.0] + [2.0] + 3 * [0.0] + [2.0] + 7 * [0.0], 99.8)))
    assert (xz[z // 2 :, x // 2 :] == half).all() and (xz[: z // 2] == 0).all() and (xz[:, : x // 2] == 0).all()
    assert (yz[z // 2 :, y // 2 : 3 * y // 4] == half).all() and (yz[: z // 2] == 0).all() and (yz[:, : y // 2] == 0).all()


def test_a_run_writes_about_ten_previews() -> None:
    """The first and the last iteration, and every tenth part of a run; every iteration of a short run."""
    assert [k for k in range(1, 8) if is_preview_due(k, 7)] == [1, 2, 3, 4, 5, 6, 7]
    assert [k for k in range(1, 65) if is_preview_due(k, 64)] == sorted({1, 64, *range(6, 64, 6)})
    assert sum(is_preview_due(k, 5000) for k in range(1, 5001)) == 11


# -- Readable figures --------------------------------------------------------------------------------------------------


def labelled() -> Figure:
    figure = Figure(figsize=(3, 2), layout="constrained")
    figure.subplots().set(title="A title", xlabel="x [length]")
    return figure


def test_a_figure_with_a_title_and_a_label_is_readable() -> None:
    assert find_unreadable(labelled()) == []


@pytest.mark.parametrize(
    ("spoil", "fault"),
    [
        (lambda figure: figure.axes[0].set(title="", xlabel=""), "axes 0 have neither a title nor a label"),
        (lambda figure: figure.axes[0].title.set_fontsize(4), "'A title' has 4 pt"),
        (lambda figure: figure.text(0.9, 0.5, "A long note"), "'A long note' leaves the figure"),
        (lambda figure: figure.text(0.5, 0.93, "Another title"), "'Another title' lies on 'A title'"),
    ],
)
def test_a_fault_of_a_figure_is_found(spoil: Callable[[Figure], object], fault: str) -> None:
    figure = labelled()
    spoil(figure)
    (found,) = find_unreadable(figure)
    assert found.startswith(fault)
