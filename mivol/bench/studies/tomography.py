"""How near to the truth are CG and ordered subsets after 5, 10 and 20 iterations, and what does an iteration cost?

    scripts/bench_tomography.py                         128^3, 100 cone-beam views of 128^2 pixels
    scripts/bench_tomography.py --size 256              the size of TIGRE's own tests
    scripts/bench_tomography.py --volume tooth.nrrd     a measured volume as truth besides
    scripts/bench_tomography.py --beside                slices beside astra-toolbox and scikit-image (tomography_peers)
    scripts/bench_tomography.py --beside tooth          a measured slice beside them (tomography_tooth)
    scripts/bench_tomography.py --only volume256        128 cone views through 256^3, time and memory (tomography_volume)
    scripts/bench_tomography.py --only parts            what each part of the default solver is worth (tomography_parts)

The geometry is TIGRE's test "configuration 1" (cone beam, 100 views on a full circle). The object is the Shepp-Logan head,
its projections are sums of ellipsoid chords (float64, no grid), so no operator sees data that it made itself. A measured
volume is projected at twice the resolution that it is reconstructed at. nRMSE is |x - truth| / |truth| with the truth
averaged over voxels. TIGRE's tests accept 0.2 after 20 iterations (0.3 for SIRT) of a head that the operator under test
projected itself. Prints JSON; writes tomography.json and tomography.png.
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
import platform
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np
from matplotlib.ticker import MaxNLocator

import mivol
from mivol.bench.harness.bars import say
from mivol.bench.harness.figures import drawn, plain_ticks
from mivol.bench.harness.study import Expected, called
from mivol.bench.harness.timing import Stopwatch, fastest
from mivol.bench.studies.tomography_parts import measure_parts, rows_of_parts
from mivol.bench.studies.tomography_peers import compare, ratios, rows, slices_of_the_head
from mivol.bench.studies.tomography_tooth import slice_of_the_tooth
from mivol.bench.studies.tomography_volume import measure_volume
from mivol.errors import MivolError
from mivol.files import read_volume, write_whole_text
from mivol.optim.projections.linear_problems import LeastSquares
from mivol.optim.projections.smoothed_tv import SmoothedTV
from mivol.optim.projections.solvers import SOLVERS
from mivol.tomography.geometry import ConeBeam, VoxelGrid, cone_beam_of_tigre
from mivol.tomography.phantoms import SHEPP_LOGAN, shepp_logan
from mivol.tomography.projector import Projector
from mivol.validate.metrics import nrmse

__all__ = [
    "Scan", "adjoint_mismatch", "costs", "expected", "main", "methods", "reconstruct", "scan_of_head", "scan_of_volume",
    "table",
]  # fmt: skip

REPORTED = (5, 10, 20)
BAR = 0.2
"""What TIGRE's own tests accept after 20 iterations, nRMSE."""


class Scan(NamedTuple):
    """Projections of an object that is known.

    Attributes:
        name: of the object.
        a: the projector of the grid that is reconstructed.
        y: projections, of a.shape[0] rays.
        truth: (Z, Y, X) averages over the voxels of that grid.
    """

    name: str
    a: Projector
    y: np.ndarray
    truth: np.ndarray


def scan_of_head(variant: str, size: int, n_views: int) -> Scan:
    """Shepp and Logan's head with projections in closed form: no operator sees data that it made itself."""
    beam, grid = cone_beam_of_tigre(size, n_views)
    head = shepp_logan(variant, 128.0)
    return Scan(f"Shepp-Logan ({variant})", Projector(beam, grid), head.project(beam), head.voxelise(grid, 4))


def scan_of_volume(path: Path, n_views: int) -> Scan:
    """A measured volume in a simulated cone beam, in the file's unit of length, projected at twice the resolution."""
    data = read_volume(path)
    fine = data.values[..., 0] / data.values.max()
    fine = fine[tuple(slice(0, n // 2 * 2) for n in fine.shape)]
    truth = fine.reshape([m for n in fine.shape for m in (n // 2, 2)]).mean((1, 3, 5))
    spacing = tuple(map(float, data.spacing))
    grid = VoxelGrid(truth.shape, tuple(2 * s for s in spacing))
    reach, pitch = 2 * grid.radius, 2 * min(spacing) * 1.5
    rows = int(np.ceil(1.5 * 1.2 * grid.extent[2] / pitch))
    columns = int(np.ceil(1.5 * 1.2 * np.hypot(*grid.extent[:2]) / pitch))
    beam = ConeBeam(np.arange(n_views) * 2 * np.pi / n_views, (rows, columns), 2 * reach, 3 * reach, pitch)
    return Scan(path.name, Projector(beam, grid), Projector(beam, VoxelGrid(fine.shape, spacing)) @ fine, truth)


def methods(a: Projector, y: np.ndarray) -> dict[str, tuple[str, LeastSquares, dict]]:
    """Label -> (solver, problem, options). Subsets of 20 views, as in TIGRE's configuration."""
    plain, bounded = LeastSquares(a, y), LeastSquares(a, y, nonnegative=True)
    # In the unit of the geometry (mm): enough to calm the misfit of voxels to edges, too little to blur them (3 to 10 tried).
    prior = SmoothedTV(a.grid.shape, strength=3.0, delta=3e-3, voxel_size=a.grid.voxel_size)
    subsets = {"n_subsets": max(1, a.n_views // 20)}
    return {
        "CG": ("cgls", plain, {}),
        "CG, x >= 0": ("pcg", bounded, {}),
        "CG, x >= 0, TV": ("pcg", LeastSquares(a, y, nonnegative=True, prior=prior), {}),
        "OS-SART, x >= 0": ("os-sart", bounded, subsets),
        "SIRT, x >= 0": ("sirt", bounded, {}),
    }


def reconstruct(scan: Scan, iterations: int) -> tuple[dict, dict]:
    """Curves of error and time by method, and the last volumes; judging is not timed."""
    curves, volumes = {}, {}
    for label, (solver, problem, options) in methods(scan.a, scan.y).items():
        errors, seconds, watch = [], [], Stopwatch()
        states = iter(SOLVERS[solver].run(problem, **options))
        for _ in range(iterations):
            with watch:
                state = next(states, None)
            if state is None:
                break
            errors.append(nrmse(state.x, scan.truth.reshape(-1)))
            seconds.append(watch.seconds)
            volumes[label] = state.x.reshape(scan.truth.shape)
            say(f"{label:16s} {state.iteration:3d}  nRMSE {errors[-1]:.4f}  {seconds[-1]:7.1f} s")
        curves[label] = {"nrmse": errors, "seconds": seconds}
    return curves, volumes


def costs(scan: Scan) -> dict:
    """Seconds of warm A and A^T, how well the pair matches, and how far A of the true voxels is from the true projections."""
    a, rng = scan.a, np.random.default_rng(0)
    x, y = (rng.normal(size=n).astype(np.float32) for n in a.shape[::-1])
    forward, back = (fastest(lambda operand=operand, v=v: operand @ v, time.perf_counter) for operand, v in ((a, x), (a.T, y)))
    return {
        "seconds_A": forward,
        "seconds_AT": back,
        "rays_per_second_A": a.shape[0] / forward,
        "AT_over_A": back / forward,
        "adjoint_mismatch": adjoint_mismatch(a, x, y),
        "voxels_own_error": float(np.linalg.norm((a @ scan.truth) - scan.y) / np.linalg.norm(scan.y)),
    }


def adjoint_mismatch(a: Projector, x: np.ndarray, y: np.ndarray) -> float:
    """|<Ax, y> - <x, A^T y>| over |Ax| |y|: rounding, where A^T is the transpose of A."""
    ax, aty = (a @ x).astype(float), (a.T @ y).astype(float)
    return float(abs(ax @ y - x @ aty) / (np.linalg.norm(ax) * np.linalg.norm(y)))


def draw(scan: Scan, curves: dict, volumes: dict, path: Path) -> None:
    """Error against iterations and time, and a slice of the truth and of each volume."""
    with drawn(path, 18, 8) as figure:
        axes = figure.subplots(2, max(3, len(volumes)))
        for label, curve in curves.items():
            axes[0, 0].plot(range(1, len(curve["nrmse"]) + 1), curve["nrmse"], "o-", ms=3, label=label)
            axes[0, 1].plot(curve["seconds"], curve["nrmse"], "o-", ms=3, label=label)
        for ax, what in zip(axes[0], ("iteration", "time [s]"), strict=False):
            ax.axhline(BAR, color="gray", ls=":", label="accepted in TIGRE's tests")
            ax.set(xlabel=what, ylabel="nRMSE [1]", yscale="log")
            plain_ticks(ax.yaxis, "")
            ax.xaxis.set_major_locator(MaxNLocator(6, integer=what == "iteration"))
        axes[0, 0].legend()
        k, top = scan.truth.shape[0] * 3 // 8, float(np.percentile(scan.truth, 99.9)) * 0.6
        shown = {"truth": scan.truth} | volumes
        flat = [*axes[0, 2:], *axes[1]]
        for ax, (label, volume) in itertools.zip_longest(flat, list(shown.items())[: len(flat)], fillvalue=("", None)):
            ax.axis("off")
            if volume is not None:
                ax.imshow(volume[k], cmap="gray", vmin=0, vmax=top, origin="lower")
                ax.set_title(label)
        shape = " x ".join(map(str, scan.truth.shape))
        title = f"{scan.name}, {shape}; slices: black is 0, white {top:.3g} [1/length]"
        figure.suptitle(title, x=0.01, ha="left", weight="bold")


def table(curves: dict) -> dict:
    """The reported iterations only, and seconds an iteration."""
    return {
        label: {str(n): round(c["nrmse"][n - 1], 4) for n in REPORTED if n <= len(c["nrmse"])}
        | {"seconds_per_iteration": round(c["seconds"][-1] / len(c["seconds"]), 3)}
        for label, c in curves.items()
    }


def parse(argv: Sequence[str] | None = None) -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(
        prog=called("bench_tomography"), description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--quick", action="store_true", help="32^3 from 24 views, for CI: its times mean nothing")
    parser.add_argument("--size", type=int, default=128, help="voxels along an edge, pixels along a detector's (128)")
    parser.add_argument("--views", type=int, default=100)
    parser.add_argument("--iterations", type=int, default=20)
    parser.add_argument("--phantom", choices=list(SHEPP_LOGAN), default="yu-ye-wang")
    parser.add_argument("--volume", type=Path, help="a volume file to use as truth besides")
    parser.add_argument(
        "--beside", nargs="?", const="head", choices=["head", "tooth"], help="slices beside other programs, and nothing else"
    )
    parser.add_argument("--only", choices=["volume256", "parts"], help="one question, and nothing else")
    parser.add_argument("--variant", default="llvm_ad_rgb")
    parser.add_argument("--out", type=Path, default=Path("runs/bench_tomography"))
    args = parser.parse_args(argv)
    if args.quick:
        args.size, args.views, args.iterations = 32, 24, 5
    return args


def expected(argv: Sequence[str]) -> Expected:
    """What the JSON of these arguments will hold.

    Raises:
        MivolError: they ask for what is printed only.
    """
    args = parse(argv)
    if args.beside or args.only:
        raise MivolError("--beside and --only print and write no JSON: leave --compare out, or these.")
    return Expected({"grid": [args.size] * 3, "projections": [args.views, *[args.size] * 2]}, ("nrmse",))


def measure(args: argparse.Namespace) -> tuple[dict, dict]:
    """Reconstruct the head, and the volume that was given; the report, and the curves of each object."""
    head = scan_of_head(args.phantom, args.size, args.views)
    cost = costs(head)
    curves, volumes = reconstruct(head, args.iterations)
    draw(head, curves, volumes, args.out / "tomography.png")
    report = {
        "question": "nRMSE against the truth after 5, 10, 20 iterations, projections by ellipsoid chords",
        "grid": [args.size] * 3,
        "projections": [args.views, args.size, args.size],
        "published_bar": {"TIGRE tests, 20 iterations": BAR},
        "nrmse": table(curves),
        **cost,
        "machine": {"system": platform.platform(), "cores": os.cpu_count(), "variant": args.variant},
        "versions": {"mivol": mivol.__version__, "mitsuba": mi.__version__, "drjit": dr.__version__},
    }
    by_object = {head.name: curves}
    if args.volume:
        other = scan_of_volume(args.volume, args.views)
        curves, volumes = reconstruct(other, args.iterations)
        draw(other, curves, volumes, args.out / "volume.png")
        report["volume"] = {"object": other.name, "grid": other.truth.shape, "nrmse": table(curves)}
        by_object[other.name] = curves
    return report, by_object


def main(argv: Sequence[str] | None = None) -> int:
    """Run the bench with these arguments (by default the process's own); its exit code."""
    args = parse(argv)
    try:
        mi.set_variant(args.variant)
        args.out.mkdir(parents=True, exist_ok=True)
        if args.beside:
            found = compare(slices_of_the_head() if args.beside == "head" else {"tooth": slice_of_the_tooth()})
            print("\n".join([*rows(found), "", *ratios(found)]))
            return 0
        if args.only == "parts":
            print("\n".join(rows_of_parts(measure_parts())))
            return 0
        if args.only:
            print(json.dumps(measure_volume(), indent=2))
            return 0
        report, curves = measure(args)
        write_whole_text(args.out / "tomography.json", json.dumps(report | {"curves": curves}, indent=2) + "\n")
    except MivolError as error:
        print(f"{called('bench_tomography')}: {error}", file=sys.stderr)
        return 1
    print(json.dumps(report, indent=2))
    return 0
