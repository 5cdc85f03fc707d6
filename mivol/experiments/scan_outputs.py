"""The outputs of a reconstruction from projections: volumes, sinogram, held-out views, curves and results."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from mivol.experiments.camera_pictures import draw_scanner
from mivol.experiments.film import film_of_volume
from mivol.experiments.projections import Projections
from mivol.experiments.run_folder import BestIterate, RunFolder
from mivol.files import write_exr, write_volume
from mivol.report.record import LINES, SINOGRAM, Image, Volume
from mivol.tomography.geometry import VoxelGrid, voxel_means
from mivol.tomography.projector import Projector
from mivol.validate.metrics import nrmse


def write_outputs(
    run: RunFolder, projector: Projector, grid: VoxelGrid, data: Projections, held_out: np.ndarray, x: np.ndarray
) -> None:
    """Write volume, sinogram, held-out views and curves, and record the files and the results.

    Args:
        run: run folder, with the iterations on record.
        projector: projector of fitted and held-out views.
        grid: requested voxels; the projector's grid may be finer.
        data: projections.
        held_out: indices of the held-out views.
        x: reconstruction (Z, Y, X) on the projector's grid.
    """
    run.make("views", "volumes")
    predicted, record = projector @ x, run.record
    volume = voxel_means(x, grid.shape)
    record.volumes += write_grids(run.path, grid, volume, data.truth)
    record.images += film_of_volume(run, volume[..., None], tuple(float(edge) for edge in grid.extent), "z", "sigma_t")
    middle = data.y.shape[1] // 2
    noise = line_noise(data)
    caption = f"row {middle + 1} of {data.y.shape[1]}"
    record.images += write_pair(run.path, SINOGRAM, Pair(data.y[:, middle], predicted[:, middle], noise[:, middle]), caption)
    if data.y.shape[1] > 1:
        for view in held_out[:4]:
            pair = Pair(*(part[view, ::-1] for part in (data.y, predicted, noise)))
            record.images += write_pair(run.path, f"view {view}", pair, held_out=True)
    record.images += draw_scanner(run.path, data.geometry, grid, held_out)
    run.write_curves()
    record.results["views"] = float(projector.n_views - len(held_out))
    if data.truth is not None:
        record.results["nrmse"] = nrmse(volume, data.truth)
    if len(held_out):
        z = (data.y - predicted)[held_out] * np.sqrt(data.weights[held_out])
        record.results["held_out_rms_of_residual_over_noise"] = float(np.sqrt(np.mean(z**2)))


def write_best(run: RunFolder, grid: VoxelGrid, best: BestIterate) -> None:
    """Write the best iterate beside the last iterate, if the iterates differ."""
    if not best.is_newest:
        write_volume(run.path / "volumes/reconstruction_best.npz", best.read()["volume"].reshape(grid.shape), grid.to_world)


class Pair(NamedTuple):
    """Line integrals of equal shape: measured, predicted, and the standard deviation; NaN if unknown."""

    measured: np.ndarray
    predicted: np.ndarray
    noise: np.ndarray


def line_noise(data: Projections) -> np.ndarray:
    """Standard deviations of the line integrals: inf for unused pixels, NaN if only ratios of weights are known."""
    if not data.is_noise_known:
        return np.full(data.y.shape, np.nan)
    with np.errstate(divide="ignore"):
        return 1 / np.sqrt(data.weights)


def write_pair(folder: Path, name: str, pair: Pair, caption: str = "", held_out: bool = False) -> list[Image]:
    """Write measured and predicted line integrals and the noise as layers of a file."""
    path = f"views/{name.replace(' ', '_')}.exr"
    layers = {"Y": pair.predicted, "reference.Y": pair.measured}
    roles = {"render": "Y", "reference": "reference.Y"}
    if not np.isnan(pair.noise).any():
        layers["noise.Y"], roles["standard error"] = pair.noise, "noise.Y"
    write_exr(folder / path, {layer: values.astype(np.float32) for layer, values in layers.items()})
    common = {"path": path, "view": name, "held_out": held_out, "quantity": LINES, "unit": "1", "caption": caption}
    return [Image(role=role, layer=layer, **common) for role, layer in roles.items()]


def write_grids(folder: Path, grid: VoxelGrid, x: np.ndarray, truth: np.ndarray | None) -> list[Volume]:
    """Write the reconstruction as .vol and .npz, and the truth if known."""
    volumes, size = [], tuple(float(edge) for edge in grid.extent)
    for role, values in {"reconstruction": x, **({"truth": truth} if truth is not None else {})}.items():
        write_volume(folder / f"volumes/{role}.vol", values, grid.to_world)
        write_volume(folder / f"volumes/{role}.npz", values, grid.to_world)
        volumes.append(Volume(path=f"volumes/{role}.npz", role=role, size=size, profiles=True))
    return volumes
