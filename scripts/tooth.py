#!/usr/bin/env python3
"""Reconstruct a real tooth from synchrotron projections: can views that were held out be predicted to within the noise?

    scripts/tooth.py ../shared/data/ct_projections/tooth.h5 --out runs/tooth

Flat and dark correction with its noise, the rotation axis found, conjugate gradients on the weighted least squares with
x >= 0 and a little total variation, in turns with the drift of the light since the flats were taken. Every tenth view
takes no part and is predicted. Prints JSON; writes tooth.json, tooth.png and slice.png.
"""

from __future__ import annotations

import argparse
import itertools
import json
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import mivol
from mivol.files import ProjectionData, read_projections, whole_file, write_whole_text
from mivol.optim.projections.inversion import SOLVERS
from mivol.optim.projections.linear_problems import LeastSquares, SmoothedTV
from mivol.tomography.geometry import ParallelBeam, VoxelGrid
from mivol.tomography.preprocess import LightDrift, correct_transmission, fit_light_drift, normalise_air, to_line_integrals
from mivol.tomography.projector import Projector
from mivol.tomography.rotation_axis import Axis, find_axis

import mitsuba as mi
import numpy as np


@dataclass(frozen=True)
class Fit:
    """A reconstruction and what it was judged by; ``z`` are residuals in standard deviations of the flats' noise."""

    x: np.ndarray
    axis: Axis
    drift: LightDrift
    y: np.ndarray
    predicted: np.ndarray
    z: np.ndarray
    held_out: np.ndarray


def binned(scan: ProjectionData, n: int) -> ProjectionData:
    """Sum ``n`` neighbouring columns of everything that the detector read."""
    stacks = (
        a[..., : a.shape[-1] // n * n].reshape(*a.shape[:-1], -1, n).sum(-1) for a in (scan.projections, scan.flats, scan.darks)
    )
    return ProjectionData(*stacks, scan.angles, scan.meta)


def reconstruct(
    scan: ProjectionData, air: int, size: int, strength: float, rounds: tuple[int, ...] = (15, 10, 15), every: int = 10
) -> Fit:
    """Find the axis, then fit the slice and the light's drift to all views but every ``every``-th.

    Args:
        scan: parallel-beam readings.
        air: columns at either edge that see no object.
        size: voxels along an edge of the slice; a voxel is as large as a pixel.
        strength: of the total variation.
        rounds: iterations of the solver between two fits of the drift.
    """
    y, weights = to_line_integrals(normalise_air(correct_transmission(scan.projections, scan.flats, scan.darks), air))
    axis = find_axis(y, weights, scan.angles)
    say(f"axis at column {axis.column:.2f} +- {axis.uncertainty:.2f} ({axis.method})")
    views = np.arange(len(y))
    held_out = views % every == every // 2
    times = np.linspace(-1.0, 1.0, len(y))

    grid = VoxelGrid((y.shape[1], size, size))
    a = Projector(ParallelBeam(scan.angles, y.shape[1:], axis_offset=axis.offset(y.shape[2])), grid)
    a_known = a.subset(views[~held_out])
    prior = SmoothedTV(grid.shape, strength, delta=1e-4)
    x, drift = np.zeros(grid.shape, np.float32), LightDrift(*np.zeros((2, *y.shape[1:])))
    for iterations in rounds:
        target = (y - drift.eval(times))[~held_out]
        problem = LeastSquares(a_known, target, weights[~held_out], x0=x, nonnegative=True, prior=prior)
        for state in itertools.islice(SOLVERS["pcg"].run(problem), iterations):
            say(f"  iteration {state.iteration}: weighted residual {state.residual_norm / a_known.shape[0] ** 0.5:.3f}")
        x = state.x.reshape(grid.shape)
        line = a @ x
        drift = fit_light_drift((y - line)[~held_out], weights[~held_out], times[~held_out])
    predicted = line + drift.eval(times)
    return Fit(x, axis, drift, y, predicted, (y - predicted) * np.sqrt(weights), held_out)


def figures_of(fit: Fit, seconds: float) -> dict:
    """What is printed: root mean squares of residuals over the flats' noise."""

    def rms(z: np.ndarray) -> float:
        return float(np.sqrt(np.mean(z**2)))

    air = fit.y.shape[2] // 8
    return {
        "axis_column": fit.axis.column,
        "axis_uncertainty": fit.axis.uncertainty,
        "held_out_views": int(fit.held_out.sum()),
        "held_out_residual_over_noise": rms(fit.z[fit.held_out]),
        "held_out_median_residual_over_noise": float(np.median(np.abs(fit.z[fit.held_out])) / 0.6745),
        "held_out_air_residual_over_noise": rms(fit.z[fit.held_out][..., :air]),
        "fitted_residual_over_noise": rms(fit.z[~fit.held_out]),
        "seconds": round(seconds, 1),
        "variant": mi.variant(),
        "mivol": mivol.__version__,
    }


def draw(fit: Fit, path: Path) -> None:
    """Slice, held-out views beside their prediction, and the residuals of all views."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    fig, axes = plt.subplots(2, 2, figsize=(13, 11), layout="constrained")
    top = np.percentile(fit.x, 99.8)
    shown = axes[0, 0].imshow(fit.x[0], cmap="gray", vmin=0, vmax=top, origin="lower")
    axes[0, 0].set(title="reconstructed slice", xlabel="x [pixels]", ylabel="y [pixels]")
    fig.colorbar(shown, ax=axes[0, 0], label="absorption [1/pixel]")
    view = int(np.flatnonzero(fit.held_out)[fit.held_out.sum() // 2])
    axes[0, 1].plot(fit.y[view, 0], lw=0.8, label="measured")
    axes[0, 1].plot(fit.predicted[view, 0], lw=0.8, label="predicted")
    axes[0, 1].axvline(fit.axis.column, color="gray", ls=":", label=f"axis {fit.axis.column:.2f}")
    axes[0, 1].set(title=f"view {view}, held out", xlabel="column", ylabel="line integral")
    axes[0, 1].legend()
    shown = axes[1, 0].imshow(fit.z[:, 0], cmap="RdBu_r", vmin=-5, vmax=5, aspect="auto")
    axes[1, 0].set(title="residual / noise of the flats, all views", xlabel="column", ylabel="view")
    fig.colorbar(shown, ax=axes[1, 0])
    bins = np.linspace(-8, 8, 161)
    axes[1, 1].hist(fit.z[fit.held_out].ravel(), bins, density=True, label="held-out views")
    axes[1, 1].plot(bins, np.exp(-(bins**2) / 2) / np.sqrt(2 * np.pi), label="noise alone")
    axes[1, 1].set(title="residual / noise", xlabel="standard deviations", yscale="log", ylim=(1e-4, 1))
    axes[1, 1].legend()
    with whole_file(path) as temporary:
        fig.savefig(temporary, dpi=100, format="png")
    plt.close(fig)
    with whole_file(path.with_name("slice.png")) as temporary:
        plt.imsave(temporary, fit.x[0], cmap="gray", vmin=0, vmax=top, origin="lower", format="png")


def say(text: str) -> None:
    """To standard error: standard output is for the JSON."""
    print(text, file=sys.stderr, flush=True)


def main() -> None:
    """Read the command line, do it, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path, help="HDF5 in the Data Exchange layout")
    parser.add_argument("--out", type=Path, default=Path("runs/tooth"))
    parser.add_argument("--bin", type=int, default=1, help="sum this many columns (default 1)")
    parser.add_argument("--air", type=int, default=100, help="columns at either edge that see no object (default 100)")
    parser.add_argument("--size", type=int, default=380, help="voxels along an edge of the slice (default 380)")
    parser.add_argument("--tv", type=float, default=3000.0, help="strength of the total variation (default 3000)")
    parser.add_argument("--variant", default="llvm_ad_rgb")
    args = parser.parse_args()
    mi.set_variant(args.variant)
    start = time.perf_counter()
    fit = reconstruct(binned(read_projections(args.data), args.bin), args.air // args.bin, args.size // args.bin, args.tv)
    figures = figures_of(fit, time.perf_counter() - start)
    args.out.mkdir(parents=True, exist_ok=True)
    draw(fit, args.out / "tooth.png")
    write_whole_text(args.out / "tooth.json", json.dumps(figures, indent=2) + "\n")
    print(json.dumps(figures, indent=2))


if __name__ == "__main__":
    main()
