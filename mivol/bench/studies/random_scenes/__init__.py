"""Do images of random scenes agree with Mitsuba's, and is the radiance of every path of hard scenes finite and not negative?

    mivol bench random_scenes                    # 20 minutes on 2 idle cores
    mivol bench random_scenes --quick            # a minute: a dozen scenes
    mivol bench random_scenes --only hard
    mivol bench random_scenes --only built
    mivol bench random_scenes --cluster local:4  # a scene is a piece of work

trials: random scenes (:mod:`mivol.bench.studies.random_scenes.generate`) with homogeneous media and grids, grey and rgb, in
boxes and balls, one, two side by side, or one inside the other, behind boundaries that transmit, refract or blur light; with
phase functions, emitters and surfaces; ``max_depth`` from 2 to unlimited. Each is rendered 16 times by mivol and by volpath (an
rgb extinction one channel at a time), 12 x 12 pixels, 64 samples per pixel. The means of each quarter of the image and each
colour are compared by Student's t. If all means are equal, any of all comparisons fails with a probability of 1 in 1000.
Refusals are counted by their message.

built: as trials, with 40 random scenes as people build them: bodies, more of them homogeneous, in rooms, over floors and in
glass, and fogs without a boundary, with one to sixteen lamps inside and beside the media.

hard: an optical depth of 64, voxels of 2000, vacuum, extinctions of three colours at ratios of 10,000, nearly straight phase
functions, glass, an emitter inside: more than 1e8 paths of unlimited depth, one in each pixel. No radiance may be negative,
infinite or NaN.
"""

from __future__ import annotations

import gc
import re
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
from matplotlib.ticker import MaxNLocator

from mivol.bench.harness.contests import compare_means, mean_of_rounds
from mivol.bench.harness.figures import new_figure
from mivol.bench.harness.study import AT_MOST, Bar, Size, Study, SweptQuestion, amount, judge, judge_agreement, say, say_row
from mivol.bench.scenes import (
    as_dense_as_smoke,
    box_scene,
    constant_light,
    emitter_inside,
    make_integrator,
    milky_glass,
    smoke,
    sun_and_sky,
    threads_in_space,
)
from mivol.bench.studies.random_scenes.generate import RandomScene, draw_built_scene, draw_scene
from mivol.errors import MivolError
from mivol.report.figures import SERIES

MEANS = 12
"""Compared means of a scene: of each quarter of the image, in each colour."""

DrawScene = Callable[[int, int | None], RandomScene]
"""Seed, channel of rgb extinctions or None -> scene."""

HARD_SIDE = 1024
"""Edge of an image of a hard scene [pixels], with one path in each pixel."""


@dataclass(frozen=True)
class RandomSize(Size):
    """Amount of work."""

    scenes: int = amount(300, 12, "number of random scenes")
    built_scenes: int = amount(40, 4, "number of random scenes as people build them")
    first: int = amount(0, doc="seed of the first scene")
    rounds: int = amount(16, doc="images of each scene")
    spp: int = amount(64, doc="samples per pixel of an image by mivol")
    stock_spp: int = amount(64, doc="samples per pixel of an image by volpath")
    hard_pictures: int = amount(16, 1, "images of 1024 x 1024 paths of each hard scene")


# -- Random scenes ----------------------------------------------------------------------------------------------------------


def make_trials(text: str, draw: DrawScene, resize: Callable[[RandomSize], RandomSize]) -> SweptQuestion:
    """A question about random scenes; a scene is a piece.

    Args:
        text: the question.
        draw: makes a scene.
        resize: puts the number of scenes into ``scenes``.
    """

    def split(size: RandomSize) -> list[int]:
        return list(range(size.first, size.first + resize(size).scenes))

    def compute(seed: int, size: RandomSize) -> dict:
        trial = try_scene(seed, resize(size), draw)
        outcome = trial.get("refused", [f"z {trial.get('z')} of {trial.get('z_bound')}"])[0]
        say(f"  scene {seed}: {outcome}: {', '.join(trial['features'])}")
        gc.collect()
        dr.flush_malloc_cache()
        return trial

    def join(size: RandomSize, trials: dict[int, dict]) -> dict:
        refused = Counter(reason for trial in trials.values() for reason in trial.get("refused", []))
        return {"scenes": resize(size).scenes, "refusals": dict(refused), "trials": trials}

    return SweptQuestion(text, split, compute, join)


measure_trials = make_trials(
    "Do the means of random scenes agree with volpath's, and is every pixel finite and not negative?",
    draw_scene,
    lambda size: size,
)
measure_built = make_trials(
    "The same for random scenes as people build them: rooms, floors, glass, fog, and lamps inside.",
    draw_built_scene,
    lambda size: replace(size, scenes=size.built_scenes),
)


def try_scene(seed: int, size: RandomSize, draw: DrawScene) -> dict:
    """Compare one scene: the largest z over the bound and the pixels without a valid radiance, or the reason of a refusal."""
    scene = draw(seed, None)
    answer: dict = {"features": scene.features}
    try:
        images = render_rounds(scene, "mivol", size.rounds, size.spp)
    except MivolError as error:
        return answer | {"refused": [re.sub(r"[\d.]+", "#", str(error))]}
    answer["not_a_radiance"] = int(np.sum(~(np.isfinite(images) & (images >= 0))))
    if scene.is_rgb:
        channels = [render_rounds(draw(seed, c), "volpath", size.rounds, size.stock_spp)[..., c] for c in range(3)]
        expected = np.stack(channels, axis=-1)
    else:
        expected = render_rounds(scene, "volpath", size.rounds, size.stock_spp)
    agreements = [
        compare_means(mean_of_rounds(a), mean_of_rounds(b), MEANS * size.scenes)
        for a, b in zip(quarter_means(images), quarter_means(expected), strict=True)
    ]
    worst = max(agreements, key=lambda f: np.inf if f["z"] is None else abs(f["z"]) / f["z_bound"])
    return answer | {"mean": float(expected.mean()), **worst}


def quarter_means(images: np.ndarray) -> np.ndarray:
    """Means (12, rounds) of the quarters of images (rounds, height, width, 3), by quarter and colour."""
    h, w = (n // 2 for n in images.shape[1:3])
    quarters = [images[:, y : y + h, x : x + w].mean(axis=(1, 2)) for y in (0, h) for x in (0, w)]
    return np.concatenate([q.T for q in quarters])


def render_rounds(drawn: RandomScene, name: str, rounds: int, spp: int) -> np.ndarray:
    """Images (rounds, height, width, 3) by one integrator, with separate seeds."""
    scene = mi.load_dict(drawn.parts)
    integrator = mi.load_dict({"type": name, **drawn.settings})
    first = 1000 if name == "mivol" else 5000
    images = (mi.render(scene, integrator=integrator, spp=spp, seed=first + k) for k in range(rounds))
    return np.array([np.array(image, np.float64) for image in images])


# -- Hard scenes ------------------------------------------------------------------------------------------------------------


def _constant_box(sigma_t: float, albedo: float, light: dict, res: int = 4) -> dict:
    return box_scene(np.full((res,) * 3, sigma_t, np.float32), HARD_SIDE, albedo, **light)


def _rgb_box() -> dict:
    """Extinctions of three colours at ratios of 10,000; red is 0 in half of the box."""
    values = np.random.default_rng(1).uniform(0, 1, (8, 8, 8, 3)) * np.array([4.0, 4e-4, 40.0])
    values[:4, ..., 0] = 0
    scene = box_scene(np.zeros((2, 2, 2), np.float32), HARD_SIDE, 0.99, **emitter_inside())
    scene["box"]["interior"]["sigma_t"]["grid"] = mi.VolumeGrid(values.astype(np.float32))
    return scene


def _smoke_box(albedo: float, light: dict) -> dict:
    return box_scene(smoke().values, HARD_SIDE, albedo, **light)


def _peaked(g: float) -> dict:
    """A sun in a sky, with a phase function that nearly follows a line."""
    return sun_and_sky() | {"phase": {"type": "hg", "g": g}}


HARD: dict[str, Callable[[], dict]] = {
    "white box of optical depth 64": lambda: _constant_box(32, 0.999, constant_light()),
    "one voxel of optical depth 2000": lambda: _constant_box(1e3, 0.9, sun_and_sky(), 1),
    "empty box": lambda: _constant_box(0, 0.9, sun_and_sky()),
    "thin as 1e-12": lambda: _constant_box(1e-12, 0.9, sun_and_sky()),
    "colours at ratios of 10,000": _rgb_box,
    "HG 0.99": lambda: _smoke_box(0.99, _peaked(0.99)),
    "HG -0.99": lambda: _smoke_box(0.99, _peaked(-0.99)),
    "emitter inside": lambda: _smoke_box(1.0, emitter_inside()),
    "glass": lambda: _smoke_box(1.0, milky_glass()),
    "threads": lambda: box_scene(as_dense_as_smoke(threads_in_space(128)).values, HARD_SIDE, 0.75, **sun_and_sky()),
}
"""Hard scenes, rendered with unlimited depth."""


def try_hard(name: str, size: RandomSize) -> dict:
    """Count the radiances of a hard scene that are not finite or negative."""
    scene, integrator = mi.load_dict(HARD[name]()), make_integrator("mivol", -1)
    counts = {"paths": 0, "not_finite": 0, "negative": 0, "brightest": 0.0}
    for k in range(size.hard_pictures):
        image = np.array(mi.render(scene, integrator=integrator, spp=1, seed=k))
        counts["paths"] += image.shape[0] * image.shape[1]
        counts["not_finite"] += int(np.sum(~np.isfinite(image)))
        counts["negative"] += int(np.sum(image < 0))
        counts["brightest"] = max(counts["brightest"], float(np.nanmax(image)))
    dr.flush_malloc_cache()
    say_row(name, **counts)
    return counts


measure_hard = SweptQuestion(
    "Is the radiance of every path of hard scenes finite and not negative?",
    lambda size: list(HARD),
    try_hard,
)


# -- Bars and figure --------------------------------------------------------------------------------------------------------


def compare(question: str, answer: dict) -> list[Bar]:
    """Judge refusals, pixels without a valid radiance, and every z."""
    if question == "hard":
        faults = {f"samples that are no radiance: {name}": f["not_finite"] + f["negative"] for name, f in answer.items()}
        return [judge(label, count, AT_MOST, 0, quiet=True) for label, count in faults.items()]
    rendered = {seed: trial for seed, trial in answer["trials"].items() if "refused" not in trial}
    rows = [judge("refused scenes", sum(answer["refusals"].values()), AT_MOST, 0)]
    rows.append(judge("pixels that are no radiance", sum(t["not_a_radiance"] for t in rendered.values()), AT_MOST, 0))
    return rows + [
        judge_agreement(f"{question}, scene {seed}", trial["z"], trial["z_bound"]) for seed, trial in rendered.items()
    ]


def draw(answers: dict, path: Path) -> None:
    """Draw a histogram of the largest z of each scene over its bound."""
    trials = [trial for answer in answers.values() for trial in answer.get("trials", {}).values()]
    shares = [abs(f["z"]) / f["z_bound"] for f in trials if f.get("z") is not None]
    with new_figure(path, 5, 4) as figure:
        axes = figure.subplots()
        axes.hist(shares, bins=np.linspace(0, 1.5, 31), color=SERIES[0])
        axes.axvline(1, color=SERIES[1], linestyle="--", label="the bound")
        axes.set(title="Random scenes against volpath", xlabel="largest |z| of 12 means, over its bound [1]", ylabel="scenes")
        axes.yaxis.set_major_locator(MaxNLocator(6, integer=True))
        axes.legend()


STUDY = Study(
    __name__, __doc__, RandomSize, {"trials": measure_trials, "built": measure_built, "hard": measure_hard}, compare, draw
)
