"""NetCDF files as models write them, of both families: classic by SciPy, NetCDF-4 by h5py."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import h5py
import numpy as np
from scipy.io import netcdf_file

Attributes = Mapping[str, object]
Arrays = Mapping[str, tuple[Sequence[str], np.ndarray, Attributes]]
"""Arrays by name: dimensions, numbers, attributes. An array along a dimension of its own name is a coordinate."""


def write_classic(path: Path, arrays: Arrays) -> None:
    """The classic format; the dimension ``time`` may grow."""
    with netcdf_file(path, "w") as file:
        lengths = {dim: n for dims, numbers, _ in arrays.values() for dim, n in zip(dims, numbers.shape, strict=True)}
        # A dimension that may grow has to be the first of the file.
        for dim in sorted(lengths, key=lambda dim: dim != "time"):
            file.createDimension(dim, None if dim == "time" else lengths[dim])
        for name, (dims, numbers, attributes) in arrays.items():
            held = file.createVariable(name, numbers.dtype, tuple(dims))
            held[:] = numbers
            for key, value in attributes.items():
                setattr(held, key, value)


def write_hdf5(path: Path, arrays: Arrays) -> None:
    """NetCDF-4: HDF5 with dimension scales; a dimension without a coordinate is a scale that says so."""
    with h5py.File(path, "w") as file:
        for dims, numbers, _ in arrays.values():
            for dim, length in zip(dims, numbers.shape, strict=True):
                if dim not in file:
                    file[dim] = arrays[dim][1] if dim in arrays else np.zeros(length, "f4")
                    bare = f"This is a netCDF dimension but not a netCDF variable. {length:9d}"
                    file[dim].make_scale(dim if dim in arrays else bare)
        for name, (dims, numbers, attributes) in arrays.items():
            if name not in file:
                file[name] = numbers
                for number, dim in enumerate(dims):
                    file[name].dims[number].attach_scale(file[dim])
            for key, value in attributes.items():
                file[name].attrs[key] = value


WRITERS = {"classic": write_classic, "netcdf-4": write_hdf5}
"""Writer by family."""
