"""Light of emitting media: how much sooner does mivol reach an error by sampling this light than by hitting it by chance?

    mivol bench media_light             # a minute on 2 idle cores
    mivol bench media_light --quick     # small sizes: are the means the same?

Three scenes with ``max_depth`` 3: two blobs of fire over a diffuse floor before a glossy wall; the same in fog; and a room that
glows evenly, in which sampling would add noise. ``media_light`` is chosen by the plan ("auto") and compared with "met".
Samples, rounds and variance x time are as in ``mivol bench single_scattering``, over the pixels that do not see the medium
itself (in the room, which fills the image, over all pixels).
"""

from __future__ import annotations

from pathlib import Path

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mivol.bench.harness.contests import agreement_figures, contest_images, gain_figures
from mivol.bench.harness.figures import new_figure
from mivol.bench.harness.study import AT_LEAST, Bar, Promise, Study, ask, judge_agreement, say_row
from mivol.bench.scenes import perspective
from mivol.bench.studies.single_scattering import ContestSize
from mivol.report.figures import FAINT

DEPTH = 3
BARS = {"fire": 10, "fog": 10, "room": 0.8}
"""Smallest ratio of variance x time, median over the counted pixels."""

FIRE, ROOM = ((-0.3, -0.3, 0.0), 0.6), ((-2.0, -2.0, -0.01), 4.0)
"""Low corner and edge of the cube that emits."""

AXIS_START = 0.1
"""Lower end of the bars in the figure."""


def make_blobs() -> NDArray[np.float32]:
    """Two Gaussian blobs (32, 32, 32)."""
    at = (np.arange(32) + 0.5) / 16 - 1
    z, y, x = np.meshgrid(at, at, at, indexing="ij")
    wide = np.exp(-8 * ((x - 0.2) ** 2 + y**2 + (z + 0.1) ** 2))
    blobs = wide + 0.7 * np.exp(-20 * ((x + 0.4) ** 2 + (y - 0.3) ** 2 + (z - 0.3) ** 2))
    return np.float32(np.where(blobs > 0.05, blobs, 0))


def make_scene(name: str, side: int) -> mi.Scene:
    """The scene of a question, seen by a camera with ``side`` x ``side`` pixels."""
    transform = mi.ScalarTransform4f
    low, edge = ROOM if name == "room" else FIRE
    to_world = transform().translate(list(low)).scale(edge)
    values = np.ones((4, 4, 4), np.float32) if name == "room" else make_blobs()
    colour = np.stack([values, 0.6 * values, 0.3 * values], axis=-1) * 4
    grids = {"sigma_t": values[..., None] * (0.3 if name == "room" else 6.0), "emission": colour}
    volumes = {k: {"type": "mivol_voxels", "data": mi.TensorXf(v), "to_world": to_world} for k, v in grids.items()}
    fire = {
        "type": "cube",
        "to_world": to_world @ transform().scale(0.5).translate(1),
        "bsdf": {"type": "null"},
        "interior": {"type": "mivol_medium", "albedo": 0.0, **volumes},
    }
    wall = transform().translate([0, 1.2, 0]).rotate([1, 0, 0], 90).scale(2)
    parts = {
        "floor": {"type": "rectangle", "to_world": transform().translate([0, 0, -0.02]).scale(2), "bsdf": {"type": "diffuse"}},
        "wall": {"type": "rectangle", "to_world": wall, "bsdf": {"type": "roughconductor", "alpha": 0.2}},
    }
    if name == "fog":
        haze, inside = {"type": "homogeneous", "id": "haze", "sigma_t": 0.5, "albedo": 0.95}, {"type": "ref", "id": "haze"}
        around = transform().translate([0, 0, 1]).scale([1.5, 1.1, 1.01])
        bank = {"type": "cube", "to_world": around, "bsdf": {"type": "null"}, "interior": inside}
        parts, fire = {"haze": haze, "bank": bank, **parts}, fire | {"exterior": inside}
    view = transform().look_at(origin=[1.2, -2.8, 1.5], target=[0, 0, 0.3], up=[0, 0, 1])
    return mi.load_dict({"type": "scene", **parts, "fire": fire, "sensor": perspective(side) | {"to_world": view}})


def find_dark_pixels(scene: mi.Scene) -> NDArray[np.bool_]:
    """Pixels (H, W) that do not see the emitting medium; all pixels if each pixel sees the medium."""
    image = np.array(mi.render(scene, integrator=mi.load_dict({"type": "mivol", "max_depth": 1}), spp=64, seed=1))
    dark = image[..., :3].max(axis=-1) == 0
    return dark if dark.any() else np.full(dark.shape, True)


def measure(name: str, size: ContestSize) -> dict:
    """Compare the choice of the plan with light that is found by chance."""
    scene = make_scene(name, size.side or size.max_pixels)
    settings = {"type": "mivol", "max_depth": DEPTH, "rr_depth": 64}
    integrators = {choice: mi.load_dict(settings | {"media_light": choice}) for choice in ("auto", "met")}
    contest, counts = contest_images(scene, integrators, size), find_dark_pixels(scene)
    answer = gain_figures(contest, "met", "auto", counts) | agreement_figures(contest, "met", "auto", counts, len(BARS))
    say_row(name, variance_x_time=answer["variance_x_time_mean_over_pixels"], z=answer["z"])
    return {"pixels_that_count": int(counts.sum()), **answer}


def compare(name: str, answer: dict) -> list[Bar]:
    """Judge the agreement of the means."""
    return [judge_agreement(name, answer["z"], answer["z_bound"])]


def draw(answers: dict, path: Path) -> None:
    """Draw the ratios of all scenes. A ratio of 0 (chance never lights a pixel) has a number, but no bar."""
    ratios = [a["variance_x_time_median_over_pixels"] for a in answers.values()]
    with new_figure(path, 4.4, 3.2) as figure:
        axes = figure.subplots()
        axes.set_yscale("log")
        heights = [max(ratio, AXIS_START) - AXIS_START for ratio in ratios]
        axes.bar_label(
            axes.bar(list(answers), heights, bottom=AXIS_START, width=0.6), [f"{ratio:.3g}" for ratio in ratios], padding=2
        )
        axes.axhline(1, color=FAINT, linestyle=(0, (4, 3)))
        axes.set_ylim(AXIS_START, 3 * max(1.0, *ratios))
        axes.set_title("How much sooner than by chance?")
        axes.set_ylabel("ratio of variance x time, median [1]")


TEXT = "How much sooner has mivol the same error by its own choice than by chance"
QUESTIONS = {name: ask(f"{TEXT}: {name}?", measure, name) for name in BARS}
PROMISES = {
    name: [Promise(f"variance x time, median: {name}", ("variance_x_time_median_over_pixels",), AT_LEAST, bar)]
    for name, bar in BARS.items()
}
STUDY = Study(__name__, __doc__, ContestSize, QUESTIONS, compare, draw, promises=PROMISES)
