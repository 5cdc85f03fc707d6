"""Are pictures of random scenes those of Mitsuba, and is every path of hard ones a radiance?

    scripts/bench_random_scenes.py                    # 15 minutes on 2 idle cores
    scripts/bench_random_scenes.py --quick            # a minute: a dozen scenes
    scripts/bench_random_scenes.py --only hard

trials: scenes drawn by a seed (:mod:`mivol.bench.studies.random_scenes.generate`): homogeneous media and grids, grey and rgb,
in boxes and balls, one, two, or one inside the other, behind boundaries that let light pass, bend it or blur it; phase
functions, emitters, surfaces; ``max_depth`` from 2 to unlimited. Each is rendered 16 times by mivol and by volpath (an rgb
extinction one channel at a time), 12 x 12 pixels, 64 samples; the means of each quarter and colour are compared by Student's
t, with a chance of 1 in 1000 that any of all comparisons fails where the means are equal. Refusals are counted by sentence.

hard: a box of an optical depth of 64, voxels of 2000, vacuum, colours at ratios of 10,000, nearly straight phase functions,
glass, an emitter inside: 1e8 paths and more of unlimited depth, one a pixel, none of which may be negative, infinite or NaN.

Prints JSON; writes bench_random_scenes.json and bench_random_scenes.png.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.ticker import MaxNLocator

from mivol.bench.harness.bars import AT_MOST, Bar, judge, judge_agreement
from mivol.bench.harness.figures import drawn
from mivol.bench.harness.study import Bench
from mivol.bench.studies.random_scenes.hard import try_hard_scenes
from mivol.bench.studies.random_scenes.trials import Size, try_scenes
from mivol.report.figures import SERIES

__all__ = ["BENCH", "FULL", "QUICK", "Size", "main"]

FULL = Size()
QUICK = Size(name="quick", scenes=12, hard_pictures=1)


def compare(question: str, answer: dict) -> list[Bar]:
    """Every z beside its bound; no refusal, and no pixel that is no radiance."""
    if question == "hard":
        faults = {f"samples that are no radiance: {name}": f["not_finite"] + f["negative"] for name, f in answer.items()}
        return [judge(what, count, AT_MOST, 0, aloud=False) for what, count in faults.items()]
    tried = {seed: found for seed, found in answer["trials"].items() if "refused" not in found}
    rows = [judge("refused scenes", sum(answer["refusals"].values()), AT_MOST, 0)]
    rows.append(judge("pixels that are no radiance", sum(f["not_a_radiance"] for f in tried.values()), AT_MOST, 0))
    return rows + [judge_agreement(f"scene {seed}", found["z"], found["z_bound"]) for seed, found in tried.items()]


def draw(answers: dict, folder: Path) -> None:
    """The largest z of each scene over its bound."""
    trials = answers.get("trials", {}).get("trials", {})
    shares = [abs(f["z"]) / f["z_bound"] for f in trials.values() if f.get("z") is not None]
    with drawn(folder / "bench_random_scenes.png", 5, 4) as figure:
        axes = figure.subplots()
        axes.hist(shares, bins=np.linspace(0, 1.5, 31), color=SERIES[0])
        axes.axvline(1, color=SERIES[1], linestyle="--", label="the bound")
        axes.set(title="Random scenes against volpath", xlabel="largest |z| of 12 means, over its bound [1]", ylabel="scenes")
        axes.yaxis.set_major_locator(MaxNLocator(6, integer=True))
        axes.legend()


BENCH = Bench("bench_random_scenes", __doc__, {"trials": try_scenes, "hard": try_hard_scenes}, FULL, QUICK, compare, draw)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the bench with these arguments (by default the process's own); its exit code."""
    return BENCH.run(argv)
