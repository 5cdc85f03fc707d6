"""A laboratory's cone-beam scan of a known object: readings of a detector, written as files, and what was found judged.

    python scenes/bonsai/scan.py [--object data:bonsai] [--views 72] [-o runs/bonsai/scan]
    mivol optimize scenes/bonsai/fit.toml
    python scenes/bonsai/scan.py --judge runs/bonsai/fit    # nRMSE against the object
    python scenes/bonsai/scan.py --slice                    # its middle layer, by mivol and by astra-toolbox on the processor

No operator of mivol takes part in the data: they are Joseph's sums (1982, IEEE Trans. Med. Imaging 1, 192) in float64, through
voxels of half the edge of those that are reconstructed. Readings are counts of quanta on a dark level, with flat and dark
frames. The object is a CT scan: ``data:bonsai`` (``mivol fetch bonsai``, or MIVOL_DATA), or a file; without it a procedural
volume stands in. It stands upright on the table, and what lies outside its cylinder is air.

Conventions. Lengths are edges of its voxels; volumes are (Z, Y, X), z is the axis of rotation.
"""

from __future__ import annotations

import argparse
import importlib.util
from pathlib import Path
from typing import NamedTuple

import mivol
from mivol.fields.procedural import make_procedural
from mivol.files import read_volume, write_volume
from mivol.files.fetch import PREFIX, find_local_file, resolve_path
from mivol.optim.projections.inversion import SOLVERS
from mivol.optim.projections.linear_problems import LeastSquares
from mivol.validate.metrics import nrmse

import mitsuba as mi
import numpy as np
from scipy.ndimage import map_coordinates

DEPTH = 3.0
"""Optical depth of a thickness of a third of the object's edge at its greatest value."""

DARK, SPREAD = 100.0, 2.0
"""Mean of the readings without light, and their standard deviation."""


class Panel(NamedTuple):
    """Source and flat detector of one view: positions, and the steps to the next column and row."""

    source: np.ndarray
    middle: np.ndarray
    along_u: np.ndarray
    along_v: np.ndarray

    def pixels(self, shape: tuple[int, int]) -> np.ndarray:
        """(rows, columns, 3) centres of the pixels."""
        r, c = ((np.arange(n) - (n - 1) / 2)[:, None] for n in shape)
        return self.middle + (r * self.along_v)[:, None] + c * self.along_u


def joseph(volume: np.ndarray, panel: Panel, shape: tuple[int, int]) -> np.ndarray:
    """Line integrals of one view, (rows, columns): samples at the planes of the axis along which the light runs."""
    middle = (np.array(volume.shape[::-1]) - 1) / 2
    ray = panel.pixels(shape) - panel.source
    axis = int(np.abs(ray.mean((0, 1))[:2]).argmax())
    ray /= ray[..., axis : axis + 1]
    total = np.zeros(shape)
    for index, plane in enumerate(np.moveaxis(volume, 2 - axis, 0)):
        at = panel.source + (index - middle[axis] - panel.source[axis]) * ray + middle
        total += map_coordinates(plane, [at[..., 2], at[..., 1 - axis]], order=1, mode="grid-constant")
    return total * np.linalg.norm(ray, axis=-1)


def panels(edge: int, views: int, columns: int, off: float = 1.5) -> list[Panel]:
    """A circle of views; the detector is as wide as the shadow of the cylinder, and some columns off the middle."""
    far, reach = 4.0 * edge, 6.0 * edge
    pitch = 2 * 1.02 * reach * np.tan(np.arcsin(edge / 2 / far)) / columns
    turns = 2 * np.pi * np.arange(views) / views
    found = []
    for c, s in zip(np.cos(turns), np.sin(turns), strict=True):
        u, w = np.array([c, s, 0.0]), np.array([-s, c, 0.0])
        found.append(Panel(-far * w, (reach - far) * w + off * pitch * u, pitch * u, np.array([0.0, 0.0, pitch])))
    return found


def load_object(name: str) -> np.ndarray:
    """The object as extinction [1/length], float64, even numbers of voxels, in the order (Z, Y, X)."""
    if name.startswith(PREFIX) and find_local_file(name.removeprefix(PREFIX)) is None:
        known = name.removeprefix(PREFIX)
        print(
            f'the data set "{known}" is not on this machine: a procedural volume stands in (mivol fetch {known}, or MIVOL_DATA)'
        )
        values = make_procedural("tangle", (64, 64, 64), 2, 1.0)[..., 0]
    else:
        values = np.moveaxis(read_volume(resolve_path(Path(), name)).values[..., 0], 1, 0)  # y is up in the file
    values = values[tuple(slice(0, n // 2 * 2) for n in values.shape)].astype(float)
    at = [np.arange(n) - (n - 1) / 2 for n in values.shape]
    air = np.hypot(at[1][:, None], at[2]) > min(values.shape[1:]) / 2 - 1
    values[:, air] = 0
    return values * (DEPTH / (values.max() * max(values.shape) / 3))


def halved(values: np.ndarray) -> np.ndarray:
    """Means of 2 x 2 x 2 voxels."""
    return values.reshape([m for n in values.shape for m in (n // 2, 2)]).mean((1, 3, 5))


def simulate(values: np.ndarray, given: argparse.Namespace) -> None:
    """Write readings, flats, darks, the table of panels and the truth."""
    edge, columns = min(values.shape[1:]), given.columns
    views = panels(edge, given.views, columns)
    pitch = float(views[0].along_v[2])
    rows = int(np.ceil(6 * values.shape[0] / 2 / 3.5 / pitch * 2 * 1.02))
    rng = np.random.default_rng(given.seed)

    def counted(light: np.ndarray) -> np.ndarray:
        return (rng.poisson(given.photons * light) + rng.normal(DARK, SPREAD, light.shape)).astype(np.float32)

    readings = np.stack([counted(np.exp(-joseph(values, view, (rows, columns)))) for view in views])
    given.output.mkdir(parents=True, exist_ok=True)
    frames = np.ones((10, rows, columns))
    for name, array in {"readings": readings, "flats": counted(frames), "darks": counted(0 * frames)}.items():
        np.save(given.output / f"{name}.npy", array)
    header = "source x y z, detector's middle x y z, step to the next column x y z, to the next row x y z"
    np.savetxt(given.output / "panels.txt", [np.concatenate(view) for view in views], header=header)
    truth = halved(values)
    write_volume(given.output / "truth.npz", truth[..., None].astype(np.float32))
    shape = list(truth.shape)
    print(f"{len(views)} views of {rows} x {columns} pixels in {given.output}; grid.shape={shape}, grid.voxel_size=2")


def judge(run: Path, scan: Path) -> None:
    """Say how far a run's volume is from the truth."""
    found, truth = (read_volume(path).values[..., 0] for path in (run / "volumes" / "reconstruction.npz", scan / "truth.npz"))
    print(f"nRMSE {nrmse(found, truth):.4f}")


# -- One layer, beside another program ------------------------------------------------------------------------------------


def judge_slice(values: np.ndarray, given: argparse.Namespace) -> None:
    """A fan of rays through the middle layer: the error of each method after 20 iterations."""
    middle = len(values) // 2
    layer = values[middle - 1 : middle + 1].mean(0, keepdims=True).repeat(3, axis=0)
    views = panels(layer.shape[1], given.views, given.columns, 0.0)
    y = np.stack([joseph(layer, view, (1, given.columns)) for view in views])
    rng = np.random.default_rng(given.seed)
    counts = np.maximum(rng.poisson(given.photons * np.exp(-y)), 1)
    y, truth = -np.log(counts / given.photons), halved(layer[:2])[0]
    for name, x in {**by_mivol(views, y, counts, truth), **by_astra(views, y, truth)}.items():
        print(f"{name}: nRMSE {nrmse(x.reshape(truth.shape), truth):.4f}")


def by_mivol(views: list[Panel], y: np.ndarray, counts: np.ndarray, truth: np.ndarray) -> dict[str, np.ndarray]:
    """Two solvers after 20 iterations."""
    mi.set_variant("llvm_ad_rgb")
    far, reach = np.linalg.norm(views[0].source), np.linalg.norm(views[0].middle - views[0].source)
    beam = mivol.ConeBeam(2 * np.pi * np.arange(len(y)) / len(y), y.shape[1:], far, reach, float(views[0].along_v[2]))
    a = mivol.Projector(beam, mivol.VoxelGrid((1, *truth.shape), 2.0))

    def last(name: str, **options: bool) -> np.ndarray:
        states = SOLVERS[name].run(LeastSquares(a, y, counts, **options))
        return [state.x for state, _ in zip(states, range(20), strict=False)][-1]

    return {"mivol cgls": last("cgls"), "mivol pcg, x >= 0": last("pcg", nonnegative=True)}


def by_astra(views: list[Panel], y: np.ndarray, truth: np.ndarray) -> dict[str, np.ndarray]:
    """CGLS and SIRT of astra-toolbox on the processor, which has fans there but no cones; said where it is not installed."""
    if importlib.util.find_spec("astra") is None:
        print("astra-toolbox is not installed: left out (pip install astra-toolbox)")
        return {}
    import astra

    far, reach = np.linalg.norm(views[0].source) / 2, np.linalg.norm(views[0].middle - views[0].source) / 2
    turns, pitch = 2 * np.pi * np.arange(len(y)) / len(y), float(views[0].along_v[2]) / 2
    fan = astra.create_proj_geom("fanflat", pitch, y.shape[2], turns, far, reach - far)
    volume = astra.create_vol_geom(*truth.shape)
    projector = astra.create_projector("line_fanflat", fan, volume)
    data = astra.data2d.create("-sino", fan, y[:, 0] / 2)
    found = {}
    for name in ("CGLS", "SIRT"):
        target = astra.data2d.create("-vol", volume, 0.0)
        settings = astra.astra_dict(name)
        settings |= {"ProjectorId": projector, "ProjectionDataId": data, "ReconstructionDataId": target}
        settings["option"] = {"MinConstraint": 0.0} if name == "SIRT" else {}
        astra.algorithm.run(astra.algorithm.create(settings), 20)
        found[f"astra-toolbox {'SIRT, x >= 0' if name == 'SIRT' else name}"] = astra.data2d.get(target)[::-1]
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--object", default="data:bonsai", help="a volume file, or data:NAME")
    parser.add_argument("--views", type=int, default=72)
    parser.add_argument("--columns", type=int, default=112, help="of the detector")
    parser.add_argument("--photons", type=float, default=3e4, help="a pixel, without an object")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--judge", type=Path, help="a run's folder")
    parser.add_argument("--slice", action="store_true", help="the middle layer, beside astra-toolbox")
    parser.add_argument("-o", "--output", type=Path, default=Path("runs/bonsai/scan"))
    given = parser.parse_args()
    if given.judge:
        judge(given.judge, given.output)
    else:
        (judge_slice if given.slice else simulate)(load_object(given.object), given)


if __name__ == "__main__":
    main()
