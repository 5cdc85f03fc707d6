"""HDF5 through h5py: volumes by dataset name, and projections in the Data Exchange layout.

Conventions. Projections are counts (views, rows, columns). Flat fields (beam without sample) and dark fields (no beam) are
stacks of the same rows and columns. ``theta`` is in degrees unless its ``units`` say radians; angles are returned in radians.
h5py is imported at the first use.

Reference: De Carlo et al. 2014, "Scientific data exchange: a schema for HDF5-based storage of raw and analyzed data".
"""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from mivol.display import with_short_repr
from mivol.errors import MivolError
from mivol.files.source import check_file, refusal, select_dataset
from mivol.files.volume import VolumeData, to_values

MAGIC = b"\x89HDF\r\n\x1a\n"

#: units of theta -> factor to radians.
ANGLES: dict[str, float] = {
    "degrees": np.pi / 180,
    "degree": np.pi / 180,
    "deg": np.pi / 180,
    "radians": 1.0,
    "radian": 1.0,
    "rad": 1.0,
}


@with_short_repr
@dataclasses.dataclass(frozen=True)
class ProjectionData:
    """The counts of a tomographic scan.

    Attributes:
        projections: counts with sample, float32 (views, rows, columns).
        flats: counts of the beam without sample, float32 (n, rows, columns).
        darks: counts without beam, float32 (m, rows, columns).
        angles: rotation of the sample, float64 (views,) [rad].
        meta: ``path``, ``format``, ``group``, ``dtype`` and ``unit`` of the counts.
    """

    projections: np.ndarray
    flats: np.ndarray
    darks: np.ndarray
    angles: np.ndarray
    meta: dict[str, Any] = dataclasses.field(default_factory=dict)


def read_hdf5(path: Path, dataset: str | None = None) -> VolumeData:
    """Read a dataset (Z, Y, X) or (Z, Y, X, C), on the unit cube because HDF5 stores no placement."""
    with _opened(path) as file:
        grids = _grids(file)
        name = select_dataset(path, dataset.strip("/") if dataset else None, list(grids))
        array = np.asarray(file[grids[name]])
    meta = {"path": str(path), "format": "hdf5", "dtype": str(array.dtype), "space": None, "dataset": name}
    return VolumeData(to_values(array, path), np.eye(4), meta)


def read_projections(path: str | os.PathLike, group: str = "exchange") -> ProjectionData:
    """Read a Data Exchange file: ``data``, ``data_white``, ``data_dark`` and ``theta`` of a group.

    Args:
        path: HDF5 file.
        group: group of the four datasets.

    Raises:
        MivolError: no HDF5 file, a missing h5py or dataset, inconsistent shapes, or angles or counts that are not finite.
    """
    path = check_file(path)
    with _opened(path) as file:
        data = _dataset(file, path, group, "data")
        projections, flats, darks = (
            to_values(np.asarray(_dataset(file, path, group, name)), f"{path}:{group}/{name}")[..., 0]
            for name in ("data", "data_white", "data_dark")
        )
        theta = _dataset(file, path, group, "theta")
        angles = np.asarray(theta, np.float64).ravel()
        unit = _text(theta.attrs.get("units", "degrees"))
        meta = {
            "path": str(path),
            "format": "data-exchange",
            "group": group,
            "dtype": str(data.dtype),
            "unit": _text(data.attrs.get("units", "")),
        }
    if unit.lower() not in ANGLES:
        raise refusal(path, f"theta in {unit!r}", "degrees or radians", "correct the attribute 'units' of theta")
    _check_projections(path, projections, flats, darks, angles)
    return ProjectionData(projections, flats, darks, angles * ANGLES[unit.lower()], meta)


def _check_projections(path: Path, projections: np.ndarray, flats: np.ndarray, darks: np.ndarray, angles: np.ndarray) -> None:
    for name, stack in (("data_white", flats), ("data_dark", darks)):
        if stack.shape[1:] != projections.shape[1:]:
            raise refusal(
                path,
                f"{name} of {stack.shape[1]} x {stack.shape[2]} pixels",
                f"{projections.shape[1]} x {projections.shape[2]} as in data",
                "crop both to the same pixels",
            )
    if len(angles) != len(projections):
        raise refusal(path, f"{len(angles)} angles", f"{len(projections)}, one per view", "correct theta")
    for name, numbers in (("theta", angles), ("data", projections), ("data_white", flats), ("data_dark", darks)):
        bad = ~np.isfinite(numbers)
        if bad.any():
            index = tuple(int(i) for i in np.argwhere(bad)[0])
            raise refusal(path, f"{numbers[index]} in {name} at {index}", "finite numbers", "repair the file")


def _h5py(path: Path) -> ModuleType:
    try:
        import h5py
    except ImportError as error:
        raise refusal(path, "an HDF5 file but no h5py", "an installed h5py", "install it: pip install h5py") from error
    return h5py


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    h5py = _h5py(path)
    try:
        with h5py.File(path, "r") as file:
            yield file
    except MivolError:
        raise
    except (OSError, RuntimeError, KeyError) as error:
        reason = " ".join(str(error).split())
        raise refusal(
            path, f"a damaged or foreign file ({reason})", "HDF5", "the file may be truncated: copy it again"
        ) from error


def _grids(file: Any) -> dict[str, str | bytes]:
    """The arrays of 3 or 4 dimensions: names as text -> names in the file (bytes if not UTF-8)."""
    names: list[str | bytes] = []
    file.visititems(lambda name, item: names.append(name) if getattr(item, "ndim", 0) in (3, 4) else None)
    return {_text(name): name for name in names}


def _dataset(file: Any, path: Path, group: str, name: str) -> Any:
    full = f"{group}/{name}"
    if full not in file or not hasattr(file[full], "shape"):
        holder = file[group] if group in file and hasattr(file[group], "keys") else file
        present = ", ".join(sorted(map(_text, holder.keys())))
        raise refusal(path, f"no dataset {full} (present: {present})", "the dataset", "name another group or add the dataset")
    return file[full]


def _text(value: Any) -> str:
    return value.decode("utf-8", "replace") if isinstance(value, bytes) else str(value)
