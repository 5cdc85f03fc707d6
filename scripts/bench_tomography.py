#!/usr/bin/env python3
"""How near to the truth are CG and ordered subsets after 5, 10 and 20 iterations, and what does an iteration cost?

    scripts/bench_tomography.py                         128^3, 100 cone-beam views of 128^2 pixels
    scripts/bench_tomography.py --size 256              the size of TIGRE's own tests
    scripts/bench_tomography.py --volume tooth.nrrd     a measured volume as truth besides

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
from pathlib import Path

import mivol
from mivol.files import read_volume, whole_file, write_whole_text
from mivol.optim.solvers import SOLVERS, LeastSquares, SmoothedTV
from mivol.tomography.geometry import ConeBeam, VoxelGrid, cone_beam_of_tigre
from mivol.tomography.phantoms import SHEPP_LOGAN, shepp_logan
from mivol.tomography.projector import Projector

import drjit as dr
import mitsuba as mi
import numpy as np

REPORTED = (5, 10, 20)
BAR = 0.2


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


def run(a: Projector, y: np.ndarray, truth: np.ndarray, iterations: int) -> tuple[dict, dict]:
    """Curves of error and time by method, and the last volumes."""
    curves, volumes = {}, {}
    scale = float(np.linalg.norm(truth))
    for label, (solver, problem, options) in methods(a, y).items():
        errors, seconds, start = [], [], time.perf_counter()
        judged = 0.0
        for state in itertools.islice(SOLVERS[solver].run(problem, **options), iterations):
            before = time.perf_counter()
            errors.append(float(np.linalg.norm(state.x - truth.reshape(-1)) / scale))
            judged += time.perf_counter() - before
            seconds.append(time.perf_counter() - start - judged)
            print(f"{label:16s} {state.iteration:3d}  nRMSE {errors[-1]:.4f}  {seconds[-1]:7.1f} s", file=sys.stderr)
        curves[label] = {"nrmse": errors, "seconds": seconds}
        volumes[label] = state.x.reshape(truth.shape)
    return curves, volumes


def costs(a: Projector) -> dict:
    """Seconds of warm A and A^T, and how well the pair matches on random numbers."""
    rng = np.random.default_rng(0)
    x, y = (rng.normal(size=n).astype(np.float32) for n in a.shape[::-1])
    times = {"A": [], "AT": []}
    for _ in range(3):
        start = time.perf_counter()
        ax = a @ x
        middle = time.perf_counter()
        aty = a.T @ y
        times["A"].append(middle - start)
        times["AT"].append(time.perf_counter() - middle)
    ax, aty = ax.astype(float), aty.astype(float)
    mismatch = abs(ax @ y - x @ aty) / (np.linalg.norm(ax) * np.linalg.norm(y))
    best = {name: min(t) for name, t in times.items()}
    return {
        "seconds_A": best["A"],
        "seconds_AT": best["AT"],
        "rays_per_second_A": a.shape[0] / best["A"],
        "AT_over_A": best["AT"] / best["A"],
        "adjoint_mismatch": float(mismatch),
    }


def bench_head(variant: str, size: int, n_views: int, iterations: int) -> tuple[dict, dict, np.ndarray]:
    """Shepp-Logan with projections on paper."""
    beam, grid = cone_beam_of_tigre(size, n_views)
    head = shepp_logan(variant, 128.0)
    truth, y = head.voxelise(grid, 4), head.project(beam)
    a = Projector(beam, grid)
    measured = costs(a)
    measured["voxels_own_error"] = float(np.linalg.norm((a @ truth) - y) / np.linalg.norm(y))
    curves, volumes = run(a, y, truth, iterations)
    return {"object": f"Shepp-Logan ({variant})", "costs": measured, "curves": curves}, volumes, truth


def bench_volume(path: Path, n_views: int, iterations: int) -> tuple[dict, dict, np.ndarray]:
    """A measured volume in a simulated cone beam, in the file's unit of length."""
    data = read_volume(path)
    fine = data.values[..., 0] / data.values.max()
    fine = fine[tuple(slice(0, n // 2 * 2) for n in fine.shape)]
    truth = fine.reshape([m for n in fine.shape for m in (n // 2, 2)]).mean((1, 3, 5))
    spacing = tuple(map(float, data.spacing))
    grid_fine = VoxelGrid(fine.shape, spacing)
    grid = VoxelGrid(truth.shape, tuple(2 * s for s in spacing))
    reach, pitch = 2 * grid.radius, 2 * min(spacing) * 1.5
    rows = int(np.ceil(1.5 * 1.2 * grid.extent[2] / pitch))
    columns = int(np.ceil(1.5 * 1.2 * np.hypot(*grid.extent[:2]) / pitch))
    beam = ConeBeam(np.arange(n_views) * 2 * np.pi / n_views, (rows, columns), 2 * reach, 3 * reach, pitch)
    y = Projector(beam, grid_fine) @ fine
    curves, volumes = run(Projector(beam, grid), y, truth, iterations)
    return {"object": path.name, "grid": truth.shape, "detector": (rows, columns), "curves": curves}, volumes, truth


def draw(result: dict, volumes: dict, truth: np.ndarray, path: Path) -> None:
    """Error against iterations and time, and the middle slice of each."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    fig, axes = plt.subplots(2, max(3, len(volumes)), figsize=(18, 8), layout="constrained")
    for label, curve in result["curves"].items():
        axes[0, 0].plot(range(1, len(curve["nrmse"]) + 1), curve["nrmse"], "o-", ms=3, label=label)
        axes[0, 1].plot(curve["seconds"], curve["nrmse"], "o-", ms=3, label=label)
    for ax, what in zip(axes[0], ("iteration", "seconds"), strict=False):
        ax.axhline(BAR, color="gray", ls=":", label="accepted in TIGRE's tests")
        ax.set(xlabel=what, ylabel="nRMSE", yscale="log")
        ax.grid(alpha=0.3, which="both")
    axes[0, 0].legend()
    k, top = truth.shape[0] * 3 // 8, float(np.percentile(truth, 99.9)) * 0.6
    shown = {"truth": truth} | volumes
    flat = [*axes[0, 2:], *axes[1]]
    for ax, (label, volume) in itertools.zip_longest(flat, list(shown.items())[: len(flat)], fillvalue=("", None)):
        ax.axis("off")
        if volume is not None:
            ax.imshow(volume[k], cmap="gray", vmin=0, vmax=top, origin="lower")
            ax.set_title(label)
    fig.suptitle(f"{result['object']}, {'x'.join(map(str, truth.shape))}")
    with whole_file(path) as temporary:
        fig.savefig(temporary, dpi=90, format="png")
    plt.close(fig)


def table(curves: dict) -> dict:
    """The reported iterations only."""
    return {
        label: {str(n): round(c["nrmse"][n - 1], 4) for n in REPORTED if n <= len(c["nrmse"])}
        | {"seconds_per_iteration": round(c["seconds"][-1] / len(c["seconds"]), 3)}
        for label, c in curves.items()
    }


def main() -> None:
    """Read the command line, run, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", type=int, default=128, help="voxels along an edge, pixels along a detector's (128)")
    parser.add_argument("--views", type=int, default=100)
    parser.add_argument("--iterations", type=int, default=20)
    parser.add_argument("--phantom", choices=list(SHEPP_LOGAN), default="yu-ye-wang")
    parser.add_argument("--volume", type=Path, help="a volume file to use as truth besides")
    parser.add_argument("--variant", default="llvm_ad_rgb")
    parser.add_argument("--out", type=Path, default=Path("runs/bench_tomography"))
    args = parser.parse_args()
    mi.set_variant(args.variant)
    args.out.mkdir(parents=True, exist_ok=True)

    result, volumes, truth = bench_head(args.phantom, args.size, args.views, args.iterations)
    draw(result, volumes, truth, args.out / "tomography.png")
    report = {
        "question": "nRMSE against the truth after 5, 10, 20 iterations, projections by ellipsoid chords",
        "grid": [args.size] * 3,
        "projections": [args.views, args.size, args.size],
        "published_bar": {"TIGRE tests, 20 iterations": BAR},
        "nrmse": table(result["curves"]),
        **result["costs"],
        "machine": {"system": platform.platform(), "cores": os.cpu_count(), "variant": args.variant},
        "versions": {"mivol": mivol.__version__, "mitsuba": mi.__version__, "drjit": dr.__version__},
    }
    curves = {result["object"]: result["curves"]}
    if args.volume:
        other, volumes, truth = bench_volume(args.volume, args.views, args.iterations)
        draw(other, volumes, truth, args.out / "volume.png")
        report["volume"] = {"object": other["object"], "grid": truth.shape, "nrmse": table(other["curves"])}
        curves[other["object"]] = other["curves"]
    write_whole_text(args.out / "tomography.json", json.dumps(report | {"curves": curves}, indent=2) + "\n")
    print(json.dumps(report, indent=2))


if __name__ == "__main__":
    main()
