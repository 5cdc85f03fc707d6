"""HDF5 through h5py: opening, links, storage, and volumes by dataset name; arrays of MATLAB.

Soft and external links, virtual datasets and compressed chunks are followed. What cannot be followed is refused, because HDF5
would read zeros from a missing part. h5py is imported at the first use.

A ``.mat`` of version 7.3 is HDF5; versions 5 to 7 are read by SciPy. An array of MATLAB is (rows, columns, slices, channels),
that is (y, x, z, c). HDF5 holds its axes in the reverse order. A file stores no placement, so an array fills the unit cube.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from mivol.errors import MivolError
from mivol.files.source import check_file, refusal, select_dataset
from mivol.files.volume import VolumeData, to_values

MAGIC = b"\x89HDF\r\n\x1a\n"


def read_hdf5(path: Path, dataset: str | None = None) -> VolumeData:
    """Read a dataset (Z, Y, X) or (Z, Y, X, C), on the unit cube because HDF5 stores no placement."""
    with open_hdf5(path) as file:
        grids = list_grids(file)
        name = select_dataset(path, dataset.strip("/") if dataset else None, list(grids))
        check_storage(path, file[grids[name]])
        array = np.asarray(file[grids[name]])
    meta = {"path": str(path), "format": "hdf5", "dtype": str(array.dtype), "space": None, "dataset": name}
    return VolumeData(to_values(array, path), np.eye(4), meta)


def is_hdf5(path: Path) -> bool:
    """Whether a file begins as HDF5 does; a block of the user's may come first."""
    with suppress(OSError), path.open("rb") as file:
        for offset in (0, 512, 1024, 2048, 4096):
            file.seek(offset)
            if file.read(len(MAGIC)) == MAGIC:
                return True
    return False


# -- Opening -----------------------------------------------------------------------------------------------------------------


def import_h5py(path: Path) -> ModuleType:
    """Import h5py.

    Raises:
        MivolError: h5py is not installed.
    """
    try:
        import h5py
    except ImportError as error:
        raise refusal(path, "an HDF5 file but no h5py", "an installed h5py", "install it: pip install h5py") from error
    return h5py


@contextmanager
def open_hdf5(path: Path) -> Iterator[Any]:
    """Open a file to read.

    Raises:
        MivolError: no HDF5, a truncated file, or no h5py.
    """
    h5py = import_h5py(path)
    try:
        with h5py.File(path, "r") as file:
            yield file
    except MivolError:
        raise
    except (OSError, RuntimeError, KeyError, ValueError, TypeError) as error:
        # A damaged type of numbers is a ValueError, a damaged group a TypeError.
        raise damaged_file_error(path, error) from error


def damaged_file_error(path: Path, error: Exception) -> MivolError:
    """Return the error that refuses a file that h5py cannot read."""
    reason = " ".join(str(error).split())
    return refusal(path, f"a damaged or foreign file ({reason})", "HDF5", "the file may be truncated: copy it again")


def list_grids(file: Any) -> dict[str, str | bytes]:
    """The arrays of 3 or 4 dimensions: names as text -> names in the file (bytes if not UTF-8)."""
    names: list[str | bytes] = []
    file.visititems(lambda name, item: names.append(name) if getattr(item, "ndim", 0) in (3, 4) else None)
    return {to_text(name): name for name in names}


# -- Links -------------------------------------------------------------------------------------------------------------------


def has_link(holder: Any, name: str) -> bool:
    """Whether a name stands in a file, even as a link whose target is missing."""
    *steps, last = name.split("/")
    for step in steps:
        if not is_group(holder, step):
            return False
        holder = holder[step]
    return holder.get(last, getlink=True) is not None


def is_group(holder: Any, name: str) -> bool:
    """Whether a name is a group, or a link to one."""
    try:
        return hasattr(holder[name], "keys")
    except (KeyError, OSError):
        return False


def find_item(file: Any, path: Path, name: str) -> Any:
    """The dataset of a name.

    Raises:
        MivolError: a link to nothing, no such name, or a group.
    """
    holder, steps = file, [step for step in name.split("/") if step]
    for depth, step in enumerate(steps):
        link = holder.get(step, getlink=True) if hasattr(holder, "keys") else None
        here = "/".join(steps[: depth + 1])
        if link is None:
            present = ", ".join(sorted(map(to_text, holder))) if hasattr(holder, "keys") else "a dataset"
            raise refusal(path, f"no dataset {name} (present: {present})", "the dataset", "name another")
        try:
            holder = holder[step]
        except (KeyError, OSError):
            raise _broken_link(path, here, link) from None
    if not hasattr(holder, "shape"):
        raise refusal(path, f"a group {name} ({', '.join(sorted(map(to_text, holder)))})", "a dataset", "name one in it")
    return holder


def _broken_link(path: Path, name: str, link: Any) -> MivolError:
    target = getattr(link, "path", "")
    where = f"{link.filename}:{target}" if hasattr(link, "filename") else target
    way_out = "copy that file to the place that the link names, or name another dataset"
    return refusal(path, f"a link from {name} to {where or 'nothing'}, which cannot be read", "its target", way_out)


def broken_links(file: Any, path: Path) -> Iterator[MivolError]:
    """Yield an error for each link at the top of a file whose target is missing."""
    for name in map(to_text, file):
        try:
            file[name]
        except (KeyError, OSError):
            yield _broken_link(path, name, file.get(name, getlink=True))


def read_name(file: Any, path: Path, name: str) -> Any:
    """The dataset of a name given by the user: ``name``, or ``other.h5:name`` for a dataset of another file."""
    other, colon, inner = name.rpartition(":")
    if not colon or has_link(file, name):
        return find_item(file, path, name)
    beside = check_file(path.parent / other)
    try:
        return find_item(import_h5py(beside).File(beside, "r"), beside, inner)
    except OSError as error:
        raise damaged_file_error(beside, error) from error


def check_storage(path: Path, dataset: Any) -> None:
    """Refuse a dataset of which h5py cannot read all: a compression without its filter, or a virtual one without a source."""
    h5py = import_h5py(path)
    plist = dataset.id.get_create_plist()
    for number in range(plist.get_nfilters()):
        code, _, _, label = plist.get_filter(number)
        if not h5py.h5z.filter_avail(code):
            with suppress(ImportError):
                import hdf5plugin  # noqa: F401
        if not h5py.h5z.filter_avail(code):
            raise refusal(
                path,
                f"{dataset.name} compressed by filter {code} ({to_text(label) or 'no name'})",
                "an installed filter",
                'install hdf5plugin: pip install "mivol[lab]"',
            )
    if not dataset.is_virtual:
        return
    folder = Path(dataset.file.filename).parent
    for source in dataset.virtual_sources():
        if source.file_name != "." and "%" not in source.file_name and not (folder / source.file_name).is_file():
            found = f"a virtual dataset {dataset.name} with a part in {source.file_name}, which is not there"
            raise refusal(path, found, "all its parts", "copy that file to the place that the dataset names")


def to_text(value: Any) -> str:
    """Decode a text of HDF5; invalid bytes are replaced."""
    return value.decode("utf-8", "replace") if isinstance(value, bytes) else str(value)


# -- Arrays of MATLAB --------------------------------------------------------------------------------------------------------


MATLAB_MAGIC = b"MATLAB"

MATLAB_CLASSES = ("double", "single", "logical", *(f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64)))
"""Classes of arrays that are read."""


def read_matlab(path: Path, dataset: str | None = None) -> VolumeData:
    """Read an array of three or four dimensions: ``dataset``, or the only array of the file.

    Raises:
        MivolError: a damaged file, several arrays and no name, or numbers that are not real.
    """
    if is_hdf5(path):
        with open_hdf5(path) as file:
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
        names = [name for name, shape, kind in whosmat(path) if len(shape) in (3, 4) and kind in MATLAB_CLASSES]
        name = select_dataset(path, dataset, names)
        return name, np.asarray(loadmat(path, variable_names=[name])[name])
    except (MivolError, MemoryError):
        raise
    except Exception as error:  # SciPy's parser raises errors of many classes for foreign bytes
        reason = " ".join(str(error).split()).rstrip(".") or type(error).__name__
        raise refusal(path, f"a damaged MATLAB file ({reason})", "a whole .mat file", "write or copy it again") from error
