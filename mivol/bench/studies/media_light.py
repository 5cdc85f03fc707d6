"""Light of media that emit: how much sooner does mivol reach an error where it may draw it than where it meets it by chance?

    scripts/bench_media_light.py             # a minute on 2 idle cores
    scripts/bench_media_light.py --quick     # small sizes: are the means the same?

Two blobs of fire over a diffuse floor before a glossy wall (``max_depth`` 3), the same in fog, and a room that glows evenly, in
which draws would add noise. ``media_light`` is left to the plan, beside ``met``: samples of equal processor time, rounds in
turns, variance x time as in ``scripts/bench_single_scattering.py``, over the pixels that do not see the medium itself (in the
room, which is seen everywhere, over all). Prints JSON; writes bench_media_light.json and bench_media_light.png.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mivol.bench.harness.bars import AT_LEAST, Bar, judge, judge_agreement, say
from mivol.bench.harness.figures import drawn
from mivol.bench.harness.study import Bench
from mivol.bench.harness.timing import race
from mivol.bench.scenes import perspective
from mivol.bench.studies.single_scattering import FULL, QUICK, Size, difference, gain
from mivol.report.figures import FAINT

__all__ = ["BENCH", "BARS", "main", "media_scene", "unseen"]

DEPTH = 3
BARS = {"fire": 10, "fog": 10, "room": 0.8}
"""How many times sooner the plan has to be, in the median over the pixels that count."""

FIRE = ((-0.3, -0.3, 0.0), 0.6)
ROOM = ((-2.0, -2.0, -0.01), 4.0)
"""Low corner and edge of the cube that emits."""


def blobs(count: int = 32) -> NDArray[np.float32]:
    """Two Gaussian blobs (Z, Y, X), one a third as wide as the other."""
    at = (np.arange(count) + 0.5) / count * 2 - 1
    z, y, x = np.meshgrid(at, at, at, indexing="ij")
    wide = np.exp(-8 * ((x - 0.2) ** 2 + y**2 + (z + 0.1) ** 2))
    found = wide + 0.7 * np.exp(-20 * ((x + 0.4) ** 2 + (y - 0.3) ** 2 + (z - 0.3) ** 2))
    return np.float32(np.where(found > 0.05, found, 0))


def media_scene(name: str, side: int) -> mi.Scene:
    """The scene of a question, seen by a camera of ``side`` x ``side`` pixels."""
    shape = mi.ScalarTransform4f
    low, edge = ROOM if name == "room" else FIRE
    place = shape().translate(list(low)).scale(edge)
    values = np.ones((4, 4, 4), np.float32) if name == "room" else blobs()
    colour = np.stack([values, 0.6 * values, 0.3 * values], axis=-1) * 4
    grids = {"sigma_t": values[..., None] * (0.3 if name == "room" else 6.0), "emission": colour}
    volumes = {k: {"type": "mivol_voxels", "data": mi.TensorXf(v), "to_world": place} for k, v in grids.items()}
    interior = {"type": "mivol_medium", "albedo": 0.0, **volumes}
    fire = {"type": "cube", "to_world": place @ shape().scale(0.5).translate(1), "bsdf": {"type": "null"}, "interior": interior}
    glossy = {"type": "roughconductor", "alpha": 0.2}
    parts = {
        "floor": {"type": "rectangle", "to_world": shape().translate([0, 0, -0.02]).scale(2), "bsdf": {"type": "diffuse"}},
        "wall": {
            "type": "rectangle",
            "to_world": shape().translate([0, 1.2, 0]).rotate([1, 0, 0], 90).scale(2),
            "bsdf": glossy,
        },
    }
    if name == "fog":
        haze, inside = {"type": "homogeneous", "id": "haze", "sigma_t": 0.5, "albedo": 0.95}, {"type": "ref", "id": "haze"}
        around = shape().translate([0, 0, 1]).scale([1.5, 1.1, 1.01])
        bank = {"type": "cube", "to_world": around, "bsdf": {"type": "null"}, "interior": inside}
        parts, fire = {"haze": haze, "bank": bank, **parts}, fire | {"exterior": inside}
    view = shape().look_at(origin=[1.2, -2.8, 1.5], target=[0, 0, 0.3], up=[0, 0, 1])
    return mi.load_dict({"type": "scene", **parts, "fire": fire, "sensor": perspective(side) | {"to_world": view}})


def unseen(scene: mi.Scene) -> NDArray[np.bool_]:
    """Pixels (H, W) that do not see the medium that emits; all of them where each one does."""
    seen = np.array(mi.render(scene, integrator=mi.load_dict({"type": "mivol", "max_depth": 1}), spp=64, seed=1))
    dark = seen[..., :3].max(axis=-1) == 0
    return dark if dark.any() else np.full(dark.shape, True)


def ask(name: str) -> Callable[[Size], dict]:
    """The question about one scene."""

    def measure(size: Size) -> dict:
        scene, calls = media_scene(name, size.most_pixels), {}
        for place, how in enumerate(("auto", "met")):
            integrator = mi.load_dict({"type": "mivol", "max_depth": DEPTH, "rr_depth": 64, "media_light": how})

            def render(seed: int, n: int, integrator: mi.Integrator = integrator, place: int = place) -> mi.TensorXf:
                return mi.render(scene, integrator=integrator, spp=n, seed=10_000 * size.seed + 1000 * place + seed)

            n = size.budget.samples(render)
            calls[how] = lambda seed, render=render, n=n: render(seed, n)
        timings, counts = race(calls, size.rounds, keep=True), unseen(scene)
        answer = gain(timings["met"], timings["auto"], counts) | difference(timings["met"], timings["auto"], counts)
        say(f"  {name}: {answer['variance_x_time_mean_over_pixels']:.3g}x mean, z {answer['z']}")
        return {"pixels_that_count": int(counts.sum()), **answer}

    measure.__doc__ = f"How much sooner has mivol the same error by its own choice than by chance: {name}?"
    return measure


def compare(name: str, answer: dict) -> list[Bar]:
    """The ratio beside its bar, and z beside its bound."""
    ratio = answer["variance_x_time_median_over_pixels"]
    bar = judge(f"variance x time, median: {name}", ratio, AT_LEAST, BARS[name])
    return [bar, judge_agreement(name, answer["z"], answer["z_bound"])]


def draw(answers: dict, folder: Path) -> None:
    """The ratios of all scenes asked about; a ratio of 0, of pixels that chance has never lit, has no bar but its number."""
    ratios = [a["variance_x_time_median_over_pixels"] for a in answers.values()]
    with drawn(folder / "bench_media_light.png", 4.4, 3.2) as figure:
        axes = figure.subplots()
        axes.set_yscale("log")
        bars = axes.bar(list(answers), [max(ratio, LEAST) - LEAST for ratio in ratios], bottom=LEAST, width=0.6)
        axes.bar_label(bars, [f"{ratio:.3g}" for ratio in ratios], padding=2)
        axes.axhline(1, color=FAINT, linestyle=(0, (4, 3)))
        axes.set_ylim(LEAST, 3 * max(1.0, *ratios))
        axes.set_title("How much sooner than by chance?")
        axes.set_ylabel("ratio of variance x time, median [1]")


LEAST = 0.1
"""Where bars begin in the figure."""

BENCH = Bench("bench_media_light", __doc__, {name: ask(name) for name in BARS}, FULL, QUICK, compare, draw)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the bench with these arguments (by default the process's own); its exit code."""
    return BENCH.run(argv)
