"""Test and time mivol on a GPU: one JSON file and one table, within a number of minutes.

    scripts/on_a_gpu                          12 minutes at most on cuda_ad_rgb
    scripts/on_a_gpu --only tests steps       some of the parts
    scripts/on_a_gpu --only samples chair_hash chair_nerf      hash grids and NeRFs, within 16 minutes more
    scripts/on_a_gpu --variant llvm_ad_rgb    the same parts on the processor
    scripts/on_a_gpu --variant llvm_ad_rgb --quick    a rehearsal in small sizes, in minutes (tests take 4)

Each part is a process of its own with a limit of time, so that a part that fails, waits or kills its process costs the others
nothing. What was printed lies in the folder as PART.log. Fits need public data (``mivol fetch chair``); without it they are
left out, and the table says so.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path

from mivol.machine import list_gpus

ROOT = Path(__file__).resolve().parents[1]


@dataclass(frozen=True)
class Part:
    """A command of the report.

    Attributes:
        name: name of the part.
        limit: longest time [s].
        command: arguments of Python, from the variant and the folder of results.
        needs: data set without which the part is left out, a folder below ``MIVOL_DATA``; empty for none.
        is_more: whether the part runs only if it is named.
        amounts: options of the command, or the effort of a fit, that a rehearsal leaves out.
    """

    name: str
    limit: float
    command: Callable[[str, Path], list[str]]
    needs: str = ""
    is_more: bool = False
    amounts: tuple[str, ...] = ()


def bench(study: str, *more: str) -> Callable[[str, Path], list[str]]:
    """The command of a study of the bench."""
    folder = "_".join([study, *more[1:2]]) if more[:1] == ("--only",) else study
    return lambda variant, out: ["-m", "mivol", "bench", study, "--variant", variant, "--out", str(out / folder), *more]


RECORDING = (
    "import sys; from mivol.scene import scene_state; from mivol.cli import main;"
    "scene_state.RECORDED_BACK_ENDS += ('cuda',); sys.exit(main(sys.argv[1:]))"
)
"""Program of mivol that records renders on a GPU too, where Dr.Jit 1.5 may end the process."""


def record(variant: str, out: Path) -> list[str]:
    """The command of steps with recordings on a GPU."""
    given = "--variant", variant, "--out", str(out / "steps_recorded"), "--only", "images,gradients", "--scenes", "tutorial"
    return ["-c", RECORDING, "bench", "steps", *given]


def fit(kind: str) -> Callable[[str, Path], list[str]]:
    """The command of a fit of the chair's photographs, judged by its test views."""
    chair = str(data_folder() / "multiview" / "chair")
    return lambda variant, out: [
        *("-m", "mivol", "optimize", chair, "--as", kind, "--set", f"variant={variant}", "--set", "photos.judged=test"),
        *("-o", str(out / f"chair_{kind}")),
    ]


def data_folder() -> Path:
    """The folder of public data."""
    return Path(os.environ.get("MIVOL_DATA", ROOT.parent / "shared" / "data"))


CHAIR = "multiview/chair"
PARTS = (
    Part("doctor", 20, lambda variant, out: ["-m", "mivol", "doctor"]),
    Part(
        "tests",
        240,
        lambda variant, out: [
            "-m",
            "pytest",
            "-q",
            "-n",
            "4",
            "-m",
            "gpu and not slow",
            "--variant",
            variant,
            str(ROOT / "tests"),
        ],
    ),
    Part(
        "steps",
        40,
        bench("steps"),
        amounts=("--scenes", "tutorial", "jade_null_sun", "--sides", "16", "256", "--spp", "1", "16"),
    ),
    Part("recordings", 40, record, amounts=("--sides", "16", "256")),
    Part("loops", 50, bench("steps", "--only", "loops"), amounts=("--loop-scenes", "tutorial", "smoke_on_floor")),
    Part(
        "gradients",
        40,
        bench("steps", "--only", "gradients", "--scenes", "tutorial", "tutorial_sun"),
        amounts=("--sides", "64", "--spp", "512"),
    ),
    Part(
        "images", 40, bench("multiple_scattering", "--only", "smoke"), amounts=("--side", "256", "--spp", "64", "--levels", "1")
    ),
    Part("gaussians", 30, bench("points", "--only", "clouds")),
    # An eighth of the published steps.
    Part("chair_gaussians", 120, fit("gaussians"), CHAIR, amounts=("--preset", "gpu", "--set", "gaussians.effort=0.125")),
    Part("chair_grid", 100, fit("grid"), CHAIR, amounts=("--preset", "gpu")),
    Part("samples", 60, bench("gpu", "--only", "samples"), is_more=True),
    Part("chair_hash", 300, bench("gpu", "--only", "hash"), CHAIR, is_more=True),
    Part("chair_nerf", 600, bench("gpu", "--only", "nerf"), CHAIR, is_more=True),
)
"""The parts in their order. The limits of those that run without being named sum to 12 minutes, of the others to 16."""


QUICK = "; a rehearsal in small sizes, whose figures mean nothing"

LAST_LINES = 9
"""Lines kept of a part without a table."""


@dataclass
class Result:
    """What became of a part.

    Attributes:
        name: name of the part.
        state: ``ok``, ``failed``, ``out of time`` or ``left out``.
        seconds: time of the part [s].
        lines: the last lines that it printed, or its tables.
    """

    name: str
    state: str
    seconds: float = 0.0
    lines: list[str] = field(default_factory=list)


def run_part(part: Part, variant: str, out: Path, quick: bool = False) -> Result:
    """Run a part, and keep what it prints in a file; ``quick``: studies and fits in the small sizes of a rehearsal."""
    if part.needs and not (data_folder() / part.needs).is_dir():
        return Result(part.name, "left out", lines=[f"{part.needs} was not found in {data_folder()}: set MIVOL_DATA"])
    log, start, command = out / f"{part.name}.log", time.perf_counter(), part.command(variant, out)
    if not quick:
        command += part.amounts
    elif "bench" in command:
        command += ["--quick"]
    elif "optimize" in command:
        command += ["--preset", "tiny"]
    with log.open("w") as file:
        child = subprocess.Popen(
            [sys.executable, *command],
            stdout=file,
            stderr=subprocess.STDOUT,
            cwd=ROOT,
            start_new_session=True,
        )
        try:
            state = "ok" if child.wait(part.limit) == 0 else "failed"
        except subprocess.TimeoutExpired:
            # Tests have workers, which end with their group.
            os.killpg(child.pid, 9)
            child.wait()
            state = "out of time"
    printed = [line for line in log.read_text(errors="replace").splitlines() if line.strip()]
    tables = [line for line in printed if line.startswith("|")]
    # A study prints its figures, then all that it measured as JSON.
    said = printed[: printed.index("{")] if "{" in printed else printed
    return Result(part.name, state, time.perf_counter() - start, tables or [line.strip() for line in said[-LAST_LINES:]])


def write_report(results: Sequence[Result], variant: str, out: Path, quick: bool = False) -> str:
    """Write ``report.json`` and ``report.md``; return the text of the latter."""
    gpus = [asdict(gpu) for gpu in list_gpus()]
    date = time.strftime("%Y-%m-%d")
    told = {"variant": variant, "date": date, "gpus": gpus, "parts": [asdict(result) for result in results]}
    (out / "report.json").write_text(json.dumps(told, indent=1))
    lines = [
        f"{variant}: {', '.join(gpu['name'] for gpu in gpus) or 'no GPU'}, {date}{QUICK if quick else ''}",
        "",
        "| part | state | time [s] |",
        "|---|---|---|",
    ]
    lines += [f"| {result.name} | {result.state} | {result.seconds:.0f} |" for result in results]
    for result in results:
        lines += ["", f"{result.name}:", "", *result.lines]
    text = "\n".join(lines) + "\n"
    (out / "report.md").write_text(text)
    return text


def main(argv: Sequence[str] | None = None) -> int:
    """Run the parts, and print the table; 0 if no part failed or ran out of time."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--variant", default="cuda_ad_rgb", help="variant of Mitsuba (cuda_ad_rgb)")
    parser.add_argument("--only", nargs="+", choices=[part.name for part in PARTS], metavar="PART", help="run these parts only")
    parser.add_argument("--out", type=Path, default=ROOT / "runs" / "on_a_gpu", help="folder of results (runs/on_a_gpu)")
    parser.add_argument("--quick", action="store_true", help="a rehearsal: studies in small sizes, whose figures mean nothing")
    args = parser.parse_args(argv)
    if args.variant.startswith("cuda") and not list_gpus():
        parser.error("nvidia-smi finds no NVIDIA GPU here: install its driver, or give --variant llvm_ad_rgb.")
    args.out.mkdir(parents=True, exist_ok=True)
    results = []
    for part in PARTS:
        if part.name in args.only if args.only else not part.is_more:
            results.append(run_part(part, args.variant, args.out, args.quick))
            print(f"{part.name}: {results[-1].state} in {results[-1].seconds:.0f} s", flush=True)
            # Also after a part, in case the machine goes away.
            text = write_report(results, args.variant, args.out, args.quick)
    print(f"\n{text}\n{args.out / 'report.json'}")
    return int(any(result.state in ("failed", "out of time") for result in results))


if __name__ == "__main__":
    sys.exit(main())
