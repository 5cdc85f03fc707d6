"""What the benches share: fields, cameras and scenes, contestants that run in turns, and how an answer is said.

Conventions. A contestant takes the number of a round, from which it makes its seed. Contestants of one question run in turns
within rounds, each round in another order, so that what else the machine does falls on all of them. Fields fill [-1, 1]^3.
Progress and figures that have a bar go to standard error, the JSON to standard output.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import mivol  # noqa: F401  (registers the plugins)
from mivol.fields.procedural import make_procedural
from mivol.files import read_volume, write_whole_text
from mivol.report.record import describe_machine, versions

import drjit as dr
import matplotlib as mpl
import mitsuba as mi
import msgspec
import numpy as np
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

ROOT = Path(__file__).resolve().parents[1]
DATA = Path(os.environ.get("MIVOL_DATA", ROOT.parent / "shared" / "data"))

TO_WORLD = np.array([[2, 0, 0, -1], [0, 2, 0, -1], [0, 0, 2, -1], [0, 0, 0, 1]], np.float64)
"""Every grid fills [-1, 1]^3, as in the tutorial."""

TUTORIAL_SCALE = 40.0
"""By which the tutorial multiplies its smoke: optical depths up to 65."""


MOST_SAMPLES = 4096
"""Per pixel, of one render."""


# -- Clocks ----------------------------------------------------------------------------------------------------------------


@dataclass
class Timing:
    """Seconds of the warm calls of one contestant, what its first call was, and what the calls returned.

    ``processor`` counts the seconds of all threads: what else a machine does moves it less than the clock on the wall.
    """

    first: dict[str, float]
    seconds: list[float] = field(default_factory=list)
    processor: list[float] = field(default_factory=list)
    results: list = field(default_factory=list)

    @property
    def median(self) -> float:
        """The figure that is quoted [s]."""
        return float(np.median(self.seconds))

    def report(self, units: float, name: str) -> dict[str, float]:
        """Median and fastest time, the rate of ``units`` they mean, and the first call."""
        fastest = min(self.seconds)
        return {
            "seconds_median": self.median,
            "seconds_min": fastest,
            "processor_seconds_median": float(np.median(self.processor)),
            f"{name}_per_second_median": units / self.median,
            f"{name}_per_second_best": units / fastest,
            "first_call": self.first,
        }


Contestant = Callable[[int], object]
"""Takes the number of the round (a seed), returns Dr.Jit arrays that are still to be evaluated."""


def race(contestants: dict[str, Contestant], rounds: int, keep: bool = False) -> dict[str, Timing]:
    """Time contestants in turns.

    Args:
        contestants: by name.
        rounds: calls of each, after a first one that is not counted.
        keep: keep what each call returned, as NumPy arrays.
    """
    timings = {name: Timing(first_call(call)) for name, call in contestants.items()}
    names = list(contestants)
    for number in range(1, rounds + 1):
        for name in names[number % len(names) :] + names[: number % len(names)]:
            before = time.process_time()
            result, seconds = clock(contestants[name], number)
            timings[name].processor.append(time.process_time() - before)
            timings[name].seconds.append(seconds)
            if keep:
                timings[name].results.append(np.array(result))
            del result
    return timings


def clock(call: Contestant, number: int = 0) -> tuple[object, float]:
    """A call, evaluated to its end, and its seconds."""
    start = time.perf_counter()
    result = call(number)
    dr.eval(result)
    dr.sync_thread()
    return result, time.perf_counter() - start


def first_call(call: Contestant) -> dict[str, float]:
    """Make the first call: seconds in all and in the compiler, kernels compiled, kernels found on disk."""
    dr.kernel_history_clear()
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        _, seconds = clock(call)
        kernels = [k for k in dr.kernel_history() if k["type"] == dr.KernelType.JIT]
    return {
        "seconds": seconds,
        "compile_seconds": sum(k["codegen_time"] + k["backend_time"] for k in kernels) / 1e3,
        "kernels_compiled": sum(not k["cache_hit"] for k in kernels),
        "kernels_from_disk": sum(k["cache_disk"] for k in kernels),
    }


def ratio_of(slow: Timing, fast: Timing, clock: str = "seconds") -> float:
    """How many times longer one takes than the other: median over the rounds, by ``seconds`` or by ``processor``."""
    return float(np.median(np.array(getattr(slow, clock)) / np.array(getattr(fast, clock))))


# -- Fields, cameras, scenes ------------------------------------------------------------------------------------------------


class Field(NamedTuple):
    """An extinction (Z, Y, X) float32 [1/length] and where it is from."""

    values: np.ndarray
    origin: str


def smoke() -> Field:
    """The tutorial's smoke at the tutorial's density, or a made-up one of its size."""
    path = DATA / "volumes_vol" / "tutorials_volume.vol"
    if path.is_file():
        return Field(np.float32(TUTORIAL_SCALE) * read_volume(path, frame="unit").values[..., 0], "Mitsuba tutorial, x 40")
    return made_up((53, 45, 44), peak=1.85 * TUTORIAL_SCALE)


def made_up(shape: tuple[int, int, int], peak: float, why: str = "no data folder") -> Field:
    """Soft blobs and filaments, from the seed 0."""
    return Field(make_procedural("tangle", shape, 0, peak)[..., 0], f"procedural ({why})")


def ct_scan(res: int) -> Field:
    """The CT of a bonsai, 0 to 2 [1/length], or a made-up field of another size."""
    path = DATA / "ct_mri" / "bonsai.vti"
    if res == 256 and path.is_file():
        values = read_volume(path, frame="unit").values[..., 0]
        return Field(values * np.float32(2 / values.max()), "bonsai CT")
    return made_up((res,) * 3, 2.0, "no data folder" if res == 256 else "quick")


def threads_in_space(res: int, share: float = 0.01) -> Field:
    """Thin curved threads that fill ``share`` of the voxels, the rest exactly 0."""
    rng = np.random.default_rng(0)
    values = np.zeros((res,) * 3, np.float32)
    offsets = np.stack(np.meshgrid(*[np.arange(-3, 4)] * 3, indexing="ij"), -1).reshape(-1, 3)
    stamp = np.maximum(0, 1 - np.sum(offsets**2, axis=1) / 10).astype(np.float32)
    offsets, stamp = offsets[stamp > 0], stamp[stamp > 0]
    s = np.linspace(0, 2 * np.pi, 2 * res)[:, None]
    while np.count_nonzero(values) < share * values.size:
        a, b, c = rng.uniform(-0.3, 0.3, (3, 3))
        curve = 0.5 + a * np.cos(s) + b * np.sin(s) + c * np.cos(2 * s) / 2
        nodes = np.clip(np.rint(curve * res).astype(int)[:, None] + offsets, 0, res - 1)
        np.maximum.at(values, tuple(nodes.reshape(-1, 3).T), np.tile(stamp, len(curve)))
    return Field(20 * values, f"made-up threads, {np.count_nonzero(values) / values.size:.1%} of the voxels not 0")


def describe(found: Field) -> str:
    """A field in one line, its resolution as X x Y x Z."""
    return f"{'x'.join(map(str, found.values.shape[::-1]))}, {found.origin}"


def perspective(side: int) -> dict:
    """One of the tutorial's cameras: 4 away, 45 degrees wide, turned by 18 degrees; the smoke's own z is up."""
    angle = math.radians(18)
    origin = [4 * math.sin(angle), -4 * math.cos(angle), 0]
    return {
        "type": "perspective",
        "fov": 45,
        "to_world": mi.ScalarTransform4f().look_at(origin=origin, target=[0, 0, 0], up=[0, 0, 1]),
        "film": {
            "type": "hdrfilm",
            "width": side,
            "height": side,
            "component_format": "float32",
            "rfilter": {"type": "box"},
            "sample_border": False,
        },
        "sampler": {"type": "independent"},
    }


def box_of(values: np.ndarray, side: int, albedo: float = 0.0, **more: dict) -> dict:
    """A scene of stock plugins: a box [-1, 1]^3 that holds an extinction, one of the tutorial's cameras.

    Args:
        values: (Z, Y, X) [1/length].
        side: of the picture [pixels].
        albedo: of the medium.
        more: ``phase`` of the medium; all else are parts of the scene. Without lamps, a sky of radiance 1.
    """
    to_world = mi.ScalarTransform4f(np.float32(TO_WORLD))
    grid = {"type": "gridvolume", "grid": mi.VolumeGrid(values[..., None]), "raw": True, "to_world": to_world}
    medium = {"type": "heterogeneous", "sigma_t": grid, "albedo": albedo}
    if "phase" in more:
        medium["phase"] = more.pop("phase")
    return {
        "type": "scene",
        "box": {"type": "cube", "bsdf": {"type": "null"}, "interior": medium},
        "sensor": perspective(side),
        **(more or {"sky": {"type": "constant", "radiance": {"type": "uniform", "value": 1.0}}}),
    }


def point(position: tuple[float, float, float]) -> dict:
    """A point light, and a phase function that knows no direction."""
    lamp = {"type": "point", "position": list(position), "intensity": {"type": "rgb", "value": [3.0, 2.5, 2.0]}}
    return {"lamp": lamp, "phase": {"type": "isotropic"}}


def sun_and_sky(height: int = 128) -> dict:
    """An environment map: a sky that brightens upwards, and a sun of 2 degrees' radius that gives a third of the light."""
    theta, phi = np.meshgrid((np.arange(height) + 0.5) / height * np.pi, np.arange(2 * height) / height * np.pi, indexing="ij")
    up = np.cos(theta)
    d = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), up], axis=-1)
    sky = (0.25 + 0.15 * up)[..., None] * np.array([0.8, 1.0, 1.3])
    sun = d @ np.array([0.6, 0.48, 0.64]) > math.cos(math.radians(2.0))
    picture = np.where(sun[..., None], np.array([420.0, 390.0, 330.0]), sky).astype(np.float32)
    # Mitsuba's maps have y up, the benches z.
    turned = mi.ScalarTransform4f().rotate([1, 0, 0], 90)
    lamp = {"type": "envmap", "bitmap": mi.Bitmap(picture), "to_world": turned}
    return {"lamp": lamp, "phase": {"type": "hg", "g": 0.8}}


def constant() -> dict:
    """Light of radiance 1 from everywhere."""
    return {"lamp": {"type": "constant"}, "phase": {"type": "isotropic"}}


def scatters_once(name: str) -> mi.Integrator:
    """An integrator that scatters once, made anew for each scene: ``prbvolpath`` keeps flags of the first scene it sees."""
    return mi.load_dict({"type": name, "max_depth": 2, "rr_depth": 64})


def samples_for(render: Callable[[int, int], object], seconds: float) -> int:
    """Samples per pixel, a power of two, that take so long or less.

    Args:
        render: seed, samples per pixel -> Dr.Jit arrays.
        seconds: of all threads together.
    """

    def taken(spp: int) -> float:
        before = time.process_time()
        clock(lambda seed: render(seed, spp), spp)
        return time.process_time() - before

    spp = 4
    taken(spp)
    while True:
        # The smaller of two: the other may have compiled a kernel, or made what is kept for a scene.
        least = min(taken(spp), taken(spp))
        if least > seconds / 8 or spp >= MOST_SAMPLES:
            return int(np.clip(2.0 ** np.floor(np.log2(spp * seconds / least)), 4, MOST_SAMPLES))
        spp *= 8


# -- Saying it --------------------------------------------------------------------------------------------------------------

AT_LEAST, AT_MOST = "at least", "at most"


def say(text: str) -> None:
    """To standard error: standard output is for the JSON."""
    print(text, file=sys.stderr, flush=True)


def judge(figure: str, value: float, sense: str, bar: float, aloud: bool = True) -> dict:
    """A figure beside its bar; said, or only if it misses."""
    met = value >= bar if sense == AT_LEAST else value <= bar
    if aloud or not met:
        say(f"  {figure}: {value:.3g}, bar {sense} {bar:g}{'' if met else ': MISSED'}")
    return {"figure": figure, "value": value, "sense": sense, "bar": bar, "met": bool(met)}


class Bench(NamedTuple):
    """A bench: its questions, and what is made of the answers.

    Attributes:
        name: of the script, and of the files it writes.
        doc: its docstring.
        questions: name -> function of a size; the first line of its docstring is what is asked.
        sizes: the full one, and the quick one.
        compare: name of a question, its answer -> rows of :func:`judge`.
        draw: answers and folder -> pictures.
        unasked: questions that are asked by name only.
    """

    name: str
    doc: str
    questions: dict[str, Callable[[object], dict]]
    sizes: tuple[object, object]
    compare: Callable[[str, dict], list[dict]]
    draw: Callable[[dict, Path], None]
    unasked: tuple[str, ...] = ()

    def main(self) -> list[dict]:
        """Read the command line, ask the questions, print; the figures that have a bar."""
        args = self._arguments()
        mi.set_variant(args.variant)
        full, quick = self.sizes
        size = quick if args.quick else full
        start, load = time.perf_counter(), os.getloadavg()[0]
        answers, bars = {}, []
        for name in args.only.split(","):
            say(f"{name}: {(self.questions[name].__doc__ or '').splitlines()[0]}")
            answers[name] = self.questions[name](size)
            bars += self.compare(name, answers[name])
        figures = {
            "size": size.name,
            "machine": msgspec.to_builtins(describe_machine()),
            "versions": versions(),
            "variant": args.variant,
            "threads": dr.thread_count(),
            "load_before_and_after": [load, os.getloadavg()[0]],
            "seconds": round(time.perf_counter() - start, 1),
            "bars": bars,
            **answers,
        }
        args.out.mkdir(parents=True, exist_ok=True)
        self.draw(answers, args.out)
        text = json.dumps(figures, indent=2, allow_nan=False) + "\n"
        write_whole_text(args.out / f"{self.name}.json", text)
        sys.stdout.write(text)
        return bars

    def _arguments(self) -> argparse.Namespace:
        default = [q for q in self.questions if q not in self.unasked]
        parser = argparse.ArgumentParser(description=self.doc, formatter_class=argparse.RawDescriptionHelpFormatter)
        parser.add_argument("--quick", action="store_true", help="small sizes, for CI: its times mean nothing")
        parser.add_argument("--only", default=",".join(default), help=f"questions to ask, of {','.join(self.questions)}")
        parser.add_argument("--out", type=Path, default=Path("runs") / self.name)
        parser.add_argument("--variant", default="llvm_ad_rgb")
        args = parser.parse_args()
        if unknown := set(args.only.split(",")) - set(self.questions):
            parser.error(f"--only: {', '.join(sorted(unknown))} is not a question; known are {', '.join(self.questions)}")
        return args


def plain_ticks(axis: mpl.axis.Axis, unit: str) -> None:
    """Few labels, as numbers."""
    axis.set_major_locator(LogLocator(subs=(1.0, 3.0)))
    axis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:g}{unit}"))
    axis.set_minor_formatter(NullFormatter())
