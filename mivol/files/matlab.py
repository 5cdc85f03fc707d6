"""Arrays of MATLAB (``.mat``): version 7.3 is HDF5, versions 5 to 7 are read by SciPy.

Conventions. An array of MATLAB is (rows, columns, slices, channels), that is (y, x, z, c). HDF5 holds its axes in the reverse
order. A file stores no placement, so an array fills the unit cube.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from mivol.errors import MivolError
from mivol.files.hdf5 import check_storage, is_hdf5, list_grids, opened
from mivol.files.source import refusal, select_dataset
from mivol.files.volume import VolumeData, to_values

MAGIC = b"MATLAB"

NUMBERS = ("double", "single", "logical", *(f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64)))
"""Classes of arrays that are read."""


def read_matlab(path: Path, dataset: str | None = None) -> VolumeData:
    """Read an array of three or four dimensions: ``dataset``, or the only array of the file.

    Raises:
        MivolError: a damaged file, several arrays and no name, or numbers that are not real.
    """
    if is_hdf5(path):
        with opened(path) as file:
            names = {name: held for name, held in list_grids(file).items() if not name.startswith("#")}
            name = select_dataset(path, dataset, list(names))
            check_storage(path, file[names[name]])
            array = np.asarray(file[names[name]]).T
    else:
        name, array = _read_old(path, dataset)
    meta = {"path": str(path), "format": "matlab", "dtype": str(array.dtype), "space": None, "dataset": name}
    return VolumeData(to_values(array.transpose(2, 0, 1, *range(3, array.ndim)), path), np.eye(4), meta)


def _read_old(path: Path, dataset: str | None) -> tuple[str, np.ndarray]:
    from scipy.io import loadmat, whosmat

    try:
        names = [name for name, shape, kind in whosmat(path) if len(shape) in (3, 4) and kind in NUMBERS]
        name = select_dataset(path, dataset, names)
        return name, np.asarray(loadmat(path, variable_names=[name])[name])
    except (MivolError, MemoryError):
        raise
    except Exception as error:  # SciPy's parser raises errors of many classes for foreign bytes
        reason = " ".join(str(error).split()).rstrip(".") or type(error).__name__
        raise refusal(path, f"a damaged MATLAB file ({reason})", "a whole .mat file", "write or copy it again") from error
