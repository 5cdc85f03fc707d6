"""Figures are readable, and their rules hold: one scale for one quantity, no axis without a unit."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure
from photo_sets import ring
from PIL import Image
from readable_figures import assert_readable

from mivol.photos import Camera, PhotoSurvey
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
    plot_slices,
    save_figure,
)


def falling_curve() -> Figure:
    return plot_curve([{"iteration": k, "seconds": 0.5 * k, "loss": 4.0 / 2**k} for k in range(9)], "loss")


def long_curve() -> Figure:
    return plot_curve([{"iteration": k, "seconds": 0.5 * k, "psnr": 20.0 + k} for k in range(31)], "psnr", against="seconds")


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


def slices() -> Figure:
    found, truth = ramps()
    return plot_slices(found, truth, size=(5.0, 2.0, 3.0))


def slices_alone() -> Figure:
    return plot_slices(ramps()[0], quantity="albedo", unit="1")


def row() -> Figure:
    reference = ramps()[0][0]
    return plot_image_row(reference, reference[:, ::-1], (reference[:, ::-1] - reference) / 0.1, unit="W")


def row_in_colour() -> Figure:
    reference = np.stack([ramps()[0][k] for k in range(3)], axis=-1)
    return plot_image_row(reference, 0.9 * reference)


def cameras() -> Figure:
    views = [Camera(np.array([[20.0, 0, 6], [0, 20, 4], [0, 0, 1]]), (12, 8), pose) for pose in ring(5)]
    splits = ("train", "held_out", "val", "test", "train")
    frames = tuple(PhotoFrame(Path(f"{k}.png"), view, split) for k, (view, split) in enumerate(zip(views, splits, strict=True)))
    box = np.array([[-1.0, -1, -1], [1, 1, 1]])
    return plot_cameras(PhotoSurvey(Path("ring"), "COLMAP", frames, (), box, "points", (1.0, 9.0), np.zeros((1, 3))))


@pytest.mark.parametrize("ends", [(0.0574, 0.13), (0.0090, 0.0125), (1.01, 4.9), (2.01, 10.1), (3.0, 299.0)])
def test_a_log_axis_has_two_labels_at_least(ends: tuple[float, float]) -> None:
    rows = [{"iteration": k, "seconds": k, "loss": value} for k, value in enumerate(ends)]
    axes = plot_curve(rows, "loss").axes[0]
    low, high = axes.get_ylim()
    assert sum(low <= tick <= high for tick in axes.get_yticks()) >= 2


DRAWN = [cameras, falling_curve, long_curve, reaching_the_noise, profile, methods, slices, slices_alone, row, row_in_colour]


@pytest.mark.parametrize("draw", DRAWN, ids=lambda draw: draw.__name__)
def test_a_figure_is_readable(draw: Callable[[], Figure]) -> None:
    assert_readable(draw())


@pytest.mark.parametrize(
    ("draw", "title", "x", "scales"),
    [
        (falling_curve, "Loss", "iteration", ("linear", "log")),
        (long_curve, "PSNR of the fitted views [dB]", "time [s]", ("linear", "linear")),
        (reaching_the_noise, "RMS of residual over noise (noise level: 1)", "iteration", ("linear", "log")),
        (profile, "sigma_t [1/length]", "y [length]", ("linear", "linear")),
        (methods, "Which is sooner?", "time [s], warm", ("log", "log")),
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
