"""What a reconstruction from projections leaves in its folder: volumes, a sinogram, views held out, curves, results."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from mivol.experiments.camera_pictures import pictures_of_scan
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
    """Write volume, sinogram, held-out views and curves, and put them and the results on record.

    Args:
        run: where it is written; its results have the iterations already.
        projector: of all views.
        grid: the voxels that were asked for; the projector's may divide them.
        data: what was measured.
        held_out: numbers of the views that were not fitted.
        x: (Z, Y, X) of the projector's grid, what was found.
    """
    run.make("views", "volumes")
    predicted, record = projector @ x, run.record
    volume = voxel_means(x, grid.shape)
    record.volumes += write_grids(run.path, grid, volume, data.truth)
    record.images += film_of_volume(run, volume[..., None], tuple(float(edge) for edge in grid.extent), "z", "sigma_t")
    middle = data.y.shape[1] // 2
    noise = noise_of(data)
    said = f"row {middle + 1} of {data.y.shape[1]}"
    record.images += write_pair(run.path, SINOGRAM, Pair(data.y[:, middle], predicted[:, middle], noise[:, middle]), said)
    if data.y.shape[1] > 1:
        for view in held_out[:4]:
            pair = Pair(*(part[view, ::-1] for part in (data.y, predicted, noise)))
            record.images += write_pair(run.path, f"view {view}", pair, held_out=True)
    record.images += pictures_of_scan(run.path, data.geometry, grid, held_out)
    run.write_curves()
    record.results["views"] = float(projector.n_views - len(held_out))
    if data.truth is not None:
        record.results["nrmse"] = nrmse(volume, data.truth)
    if len(held_out):
        z = (data.y - predicted)[held_out] * np.sqrt(data.weights[held_out])
        record.results["held_out_rms_of_residual_over_noise"] = float(np.sqrt(np.mean(z**2)))


def write_best(run: RunFolder, grid: VoxelGrid, best: BestIterate) -> None:
    """Write the best iterate beside the last one, if they differ."""
    if not best.is_newest:
        write_volume(run.path / "volumes/reconstruction_best.npz", best.read()["volume"].reshape(grid.shape), grid.to_world)


class Pair(NamedTuple):
    """Line integrals of one shape: measured, of the reconstruction, and their standard deviation; NaN where it is not known."""

    measured: np.ndarray
    predicted: np.ndarray
    noise: np.ndarray


def noise_of(data: Projections) -> np.ndarray:
    """Standard deviations of line integrals: inf where a pixel is not used, NaN where only their ratios are known."""
    if not data.is_noise_known:
        return np.full(data.y.shape, np.nan)
    with np.errstate(divide="ignore"):
        return 1 / np.sqrt(data.weights)


def write_pair(folder: Path, name: str, pair: Pair, caption: str = "", held_out: bool = False) -> list[Image]:
    """Measured line integrals beside those of the reconstruction, and their noise, as layers of one file."""
    path = f"views/{name.replace(' ', '_')}.exr"
    layers = {"Y": pair.predicted, "reference.Y": pair.measured}
    roles = {"render": "Y", "reference": "reference.Y"}
    if not np.isnan(pair.noise).any():
        layers["noise.Y"], roles["standard error"] = pair.noise, "noise.Y"
    write_exr(folder / path, {layer: values.astype(np.float32) for layer, values in layers.items()})
    common = {"path": path, "view": name, "held_out": held_out, "quantity": LINES, "unit": "1", "caption": caption}
    return [Image(role=role, layer=layer, **common) for role, layer in roles.items()]


def write_grids(folder: Path, grid: VoxelGrid, x: np.ndarray, truth: np.ndarray | None) -> list[Volume]:
    """The reconstruction as .vol and .npz; the truth beside it."""
    found, size = [], tuple(float(edge) for edge in grid.extent)
    for role, values in {"reconstruction": x, **({"truth": truth} if truth is not None else {})}.items():
        write_volume(folder / f"volumes/{role}.vol", values, grid.to_world)
        write_volume(folder / f"volumes/{role}.npz", values, grid.to_world)
        found.append(Volume(path=f"volumes/{role}.npz", role=role, size=size, profiles=True))
    return found
