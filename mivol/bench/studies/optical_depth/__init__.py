"""What does an exact optical depth cost, and how exact is it, beside what else could be used?

    scripts/bench_optical_depth.py                        # under 10 minutes on 2 cores
    scripts/bench_optical_depth.py --quick                # under a minute, small sizes: are the errors within their bars?
    scripts/bench_optical_depth.py --only walk,grids      # parts of it

Contestants trace the same rays through the same grid in the same run, in turns: rounds go through all of them, each round
in another order. A time is the median over the rounds, the fastest one beside it; a ratio of times is the median of the
ratios within a round. What the first call pays is reported apart: seconds in the compiler, or kernels that were found on
disk (HOME=$(mktemp -d) hides those). Errors are against a twin in float64 NumPy. Prints JSON; writes
bench_optical_depth.json and bench_optical_depth.png. Each figure that has a bar is printed beside it.

The smoke of the Mitsuba tutorial and a CT scan are read from MIVOL_DATA (default ../shared/data); where they are missing,
made-up fields of the same sizes take their place, and the JSON says so.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

from mivol.bench.harness.bars import AT_LEAST, AT_MOST, Bar, judge
from mivol.bench.harness.study import Bench
from mivol.bench.studies.optical_depth.accuracy import measure_accuracy, measure_image
from mivol.bench.studies.optical_depth.cost import measure_grids, measure_memory, measure_reverse, measure_walk
from mivol.bench.studies.optical_depth.peers import measure_peers
from mivol.bench.studies.optical_depth.size import FULL, QUICK, Size
from mivol.report.figures import Series, plot_error_against_time

__all__ = ["BENCH", "FULL", "QUICK", "Size", "main"]

QUESTIONS = {
    "walk": measure_walk,
    "image": measure_image,
    "accuracy": measure_accuracy,
    "reverse": measure_reverse,
    "memory": measure_memory,
    "grids": measure_grids,
    "peers": measure_peers,
}


class Promise(NamedTuple):
    """What the project promises of an answer: a figure, and where it has to lie. ``find`` gives None where it is not there."""

    question: str
    figure: str
    sense: str
    bar: float
    find: Callable[[dict], float | None]


def _largest_error(res: int) -> Callable[[dict], float | None]:
    return lambda a: max((f["largest_error"] for name, f in a.items() if name.startswith(f"{res}^3")), default=None)


ERROR = "error of tau over int (sigma + h |grad sigma|)"
PROMISES = (
    Promise("walk", "walk [M rays/s]", AT_LEAST, 15, lambda a: a["camera order"]["rays_per_second_median"] / 1e6),
    Promise("image", "mi.render, rate over volpath's", AT_LEAST, 20, lambda a: a["volpath, max_depth 1"]["mivol_is_faster"]),
    Promise("accuracy", f"{ERROR}, 64^3", AT_MOST, 2e-6, _largest_error(64)),
    Promise("accuracy", f"{ERROR}, 256^3", AT_MOST, 2e-6, _largest_error(256)),
    Promise("reverse", "reverse pass over forward pass", AT_MOST, 4, lambda a: a["smoke"]["reverse over forward"]),
    # A ray's own state: o and d, its optical depth, and the derivative of that: 8 float32.
    Promise("memory", "gradient step [bytes/ray]", AT_MOST, 32, lambda a: max(f["bytes_per_ray"] for f in a.values())),
)


def compare(question: str, answer: dict) -> list[Bar]:
    """The figures of an answer that have a bar, beside it, and said."""
    found = [(b, b.find(answer)) for b in PROMISES if b.question == question]
    return [judge(b.figure, value, b.sense, b.bar) for b, value in found if value is not None]


def draw(answers: dict, folder: Path) -> None:
    """Error against time."""
    if (peers := answers.get("peers")) is None:
        return
    rows = {name: points for name, points in peers.items() if isinstance(points, list)}
    series = [
        Series(name, [p["seconds_median"] for p in points], [p["rms_error"] for p in points]) for name, points in rows.items()
    ]
    title = f"Transmittance of {peers['rays']:,} rays through the smoke {peers['grid'].split(',')[0]}: error against time"
    plot_error_against_time(series, folder / "bench_optical_depth.png", error="RMS error of T against float64", title=title)


BENCH = Bench("bench_optical_depth", __doc__, QUESTIONS, FULL, QUICK, compare, draw)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the bench with these arguments (by default the process's own); its exit code."""
    return BENCH.run(argv)
