"""Light that scatters many times: how much sooner does mivol reach an error than Mitsuba's ``volpath`` and ``prbvolpath``?

    scripts/bench_multiple_scattering.py                  # 25 minutes on 2 idle cores
    scripts/bench_multiple_scattering.py --quick          # a minute, small sizes: are the means the same?
    scripts/bench_multiple_scattering.py --only smoke     # one of the volumes

The volumes fill [-1, 1]^3: the smoke of the Mitsuba tutorial at its density (x 40) and at a twentieth of it, the smoke
upsampled to 256^3, threads in 512^3, a cloud of a large-eddy simulation with an albedo of 0.999, a white box of an
optical depth of 64, and milk in a glass. Albedo 0.75 unless said, ``max_depth`` 6 or unlimited. Everything else is as in
``scripts/bench_single_scattering.py``: samples of equal processor time, rounds in turns, variance x time. Bars are on the mean
over pixels, for unlimited depth on the median: the errors of long paths have heavy tails. There samples take ``LONGER`` times
as long, since the variance of a few samples misses the tails, and most of all those of the method that has the fewest: in the
cloud the median ratio to ``volpath`` is 21 with 8 of its samples a pixel, 39 with 32 and 50 with 128, the mean 65 to 67.

milk: skim milk (rgb, as measured) of 40 mm along an edge in a box of glass, both smooth and refracting, below a large lamp and
a faint sky, unlimited. Paths find the lamp by chance where they leave the glass, and the weights of ``volpath`` grow without
bound where extinctions differ between channels: the picture is small (16 x 16), so that each pixel has samples enough to show
some of that, and means are compared in diluted milk, of an optical depth of 1. ``volpathmis``, whose weights are bounded, takes
part without a bar.

Prints JSON; writes bench_multiple_scattering.json and bench_multiple_scattering.png.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from mivol.bench.extinctions import Extinction, as_dense_as_smoke, fine_smoke, les_cloud, smoke, threads_in_space
from mivol.bench.harness.bars import AT_LEAST, Bar, judge, judge_agreement, say
from mivol.bench.harness.figures import drawn
from mivol.bench.harness.study import Bench
from mivol.bench.scenes import constant_light, directional_light, milk_in_a_glass, sun_and_sky
from mivol.bench.studies.single_scattering import FULL, QUICK, STOCK, Light, Size, contend, draw_errors, said
from mivol.phase.measured import MeasuredMedium, named_medium

__all__ = ["BENCH", "CONTESTS", "LONGER", "VOLUMES", "long_enough", "main"]

THIN, WHITE_DEPTH = 0.05, 64.0
"""Factor on the density of the smoke; optical depth along an edge of the white box."""

LONGER = 16.0
"""Factor on the processor time of samples where errors have heavy tails."""

LIQUID, EDGE = "skim milk", 40.0
"""In the glass; edge of the box [mm]."""


def thin_smoke() -> Extinction:
    """The smoke at a twentieth of its density."""
    found = smoke()
    return found._replace(values=found.values * np.float32(THIN))


def white_box() -> Extinction:
    """A constant grid; the box has an edge of 2."""
    return Extinction(np.full((4, 4, 4), WHITE_DEPTH / 2, np.float32), "made up: constant")


def coefficients(liquid: MeasuredMedium) -> tuple[np.ndarray, np.ndarray]:
    """Extinction [1/length of the scene] and albedo of a liquid, rgb; the box has an edge of 2."""
    sigma_s, sigma_a = (np.array(x) * EDGE / 2 for x in (liquid.sigma_s, liquid.sigma_a))
    return sigma_s + sigma_a, sigma_s / (sigma_s + sigma_a)


def milk() -> Extinction:
    """The extinction (3,) of the liquid in the glass."""
    return Extinction(coefficients(named_medium(LIQUID))[0], f"{LIQUID}, {EDGE:g} mm")


VOLUMES: dict[str, Callable[[Size], Extinction]] = {
    "smoke": lambda _: smoke(),
    "thin smoke": lambda _: thin_smoke(),
    "cloud": lambda _: les_cloud(),
    "fine smoke": lambda size: fine_smoke(size.fine_res),
    "threads": lambda size: as_dense_as_smoke(threads_in_space(size.sparse_res)),
    "white box": lambda _: white_box(),
    "milk": lambda _: milk(),
}

CONSTANT, SUN, DIRECTIONAL = "constant light", "HG 0.8, sun in a sky", "HG 0.8, directional"
GLASS = "glass, lamp and sky"
PARTS = {CONSTANT: constant_light, SUN: sun_and_sky, DIRECTIONAL: directional_light}


def _light(name: str, bar: float, depth: int = 6, albedo: float = 0.75) -> Light:
    return Light(PARTS[name], bar, by_pixel=depth < 0, albedo=albedo, depth=depth, has_tails=depth < 0)


CONTESTS: dict[str, dict[str, Light]] = {
    "smoke": {CONSTANT: _light(CONSTANT, 40), SUN: _light(SUN, 50), DIRECTIONAL: _light(DIRECTIONAL, 80)},
    "thin smoke": {CONSTANT: _light(CONSTANT, 5), SUN: _light(SUN, 6), DIRECTIONAL: _light(DIRECTIONAL, 9)},
    "cloud": {f"{SUN}, depth 6": _light(SUN, 80, 6, 0.999), f"{SUN}, unlimited": _light(SUN, 30, -1, 0.999)},
    "fine smoke": {CONSTANT: _light(CONSTANT, 25), SUN: _light(SUN, 25)},
    "threads": {SUN: _light(SUN, 12)},
    "white box": {f"{CONSTANT}, unlimited": _light(CONSTANT, 300, -1, 0.999)},
    "milk": {
        f"{GLASS}, unlimited": Light(
            milk_in_a_glass,
            10,
            by_pixel=True,
            side=16,
            albedo=tuple(coefficients(named_medium(LIQUID))[1]),
            depth=-1,
            peers=(*STOCK, "volpathmis"),
            has_tails=True,
        )
    },
}
"""Lights of each volume; the bars are on the ratio to ``volpath``."""


def ask(volume: str) -> Callable[[Size], dict]:
    """The question about one volume."""

    def measure(size: Size) -> dict:
        found = VOLUMES[volume](size)
        answer = {"grid": str(found)}
        for name, light in CONTESTS[volume].items():
            levels = size.levels if volume == "smoke" else (1,)
            answer[name] = contend(found.values, light, long_enough(size, light), levels)
            say(f"  {name}: {said(answer[name])}")
        return answer

    measure.__doc__ = f"How much sooner has mivol the same error in the {volume}?"
    return measure


def long_enough(size: Size, light: Light) -> Size:
    """The size, with samples of more time where errors have heavy tails; a fixed number of samples stays."""
    if not light.has_tails:
        return size
    return replace(size, budget=size.budget._replace(seconds=LONGER * size.budget.seconds))


def compare(volume: str, answer: dict) -> list[Bar]:
    """Every ratio to volpath beside its bar, and every z beside its bound."""
    rows = []
    for name, light in CONTESTS[volume].items():
        for stock in light.peers:
            g = answer[name][f"mivol over {stock}"]
            what, ratio = f"{volume}, {name}, {stock}", g[f"variance_x_time_{light.average}_over_pixels"]
            if stock == "volpath":
                rows.append(judge(f"variance x time, {light.average}: {what}", ratio, AT_LEAST, light.bar))
            rows.append(judge_agreement(what, g["z"], g["z_bound"]))
    return rows


def draw(answers: dict, folder: Path) -> None:
    """Error against time for each light of the first volume asked about."""
    volume = next(iter(answers))
    lights = CONTESTS[volume]
    with drawn(folder / "bench_multiple_scattering.png", 4.4 * len(lights), 3.8) as figure:
        for axes, (name, light) in zip(np.atleast_1d(figure.subplots(1, len(lights))), lights.items(), strict=True):
            draw_errors(axes, answers[volume][name], light)
            axes.set_title(f"{volume}: {name}")
        axes.legend()


BENCH = Bench("bench_multiple_scattering", __doc__, {v: ask(v) for v in VOLUMES}, FULL, QUICK, compare, draw)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the bench with these arguments (by default the process's own); its exit code."""
    return BENCH.run(argv)
