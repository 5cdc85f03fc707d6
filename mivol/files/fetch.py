"""Public data by name: from its public address, checked by its SHA-256, kept in a cache; what broke off goes on.

Conventions. A set is one file at one commit of a public repository, so that it never changes. It is looked for below
``MIVOL_DATA`` where that is set, then in the cache (``MIVOL_CACHE``, or the system's own place for caches). Paths of
experiments may say ``data:NAME``. Nothing is fetched that was not asked for by name.
"""

from __future__ import annotations

import hashlib
import os
import sys
import urllib.error
import urllib.request
from collections.abc import Callable
from dataclasses import dataclass
from difflib import get_close_matches
from http.client import HTTPException, HTTPResponse
from pathlib import Path

from mivol.errors import MivolError

__all__ = ["DATA", "PREFIX", "DataSet", "cache_folder", "fetch_data", "find_local_file", "resolve_path"]

PREFIX = "data:"
"""With what a path begins that names a set."""

SECONDS = 30.0
"""How long a server may keep silent."""

CHUNK = 1 << 16
GITHUB = "https://raw.githubusercontent.com"


@dataclass(frozen=True)
class DataSet:
    """One public file.

    Attributes:
        name: what it is called here.
        says: what it is.
        url: its public address.
        path: where it lies below ``MIVOL_DATA`` and the cache.
        size: [byte].
        sha256: of its bytes, in hexadecimal.
        licence: as its repository states it.
    """

    name: str
    says: str
    url: str
    path: str
    size: int
    sha256: str
    licence: str

    def describe(self) -> str:
        """Describe the data set in a line."""
        return f"{self.name}: {self.says}, {self.size / 2**20:.2f} MiB; licence: {self.licence}; {self.url}"


def _at(repository: str, path: str) -> str:
    return f"{GITHUB}/{repository}/{path}"


SETS = (
    DataSet(
        "smoke",
        "the smoke of Mitsuba's tutorials, 44 x 45 x 53",
        _at("mitsuba-renderer/mitsuba-tutorials/a8dbee7e81b1039a983770ce1042f2d78688d0ae", "scenes/volume.vol"),
        "volumes_vol/tutorials_volume.vol",
        419808,
        "85732786c722b91f4dcf8a7509bba286912d93ac03c23e781e1535d1609d9291",
        "none stated (Mitsuba's own repository)",
    ),
    DataSet(
        "cloud",
        "a cumulus of a large-eddy simulation, 32 x 37 x 26 (Matheou and Chung 2014)",
        _at(
            "CloudTomography/AT3D/ffd8994f91b42f390dbf31369447c2136749b93a",
            "at3d/data/synthetic_cloud_fields/jpl_les/rico32x37x26.txt",
        ),
        "clouds_les/rico32x37x26.txt",
        99634,
        "bca65313a095ce96f9a92d4af764c7fcfc453112abcf5921bd98e89c0b139c49",
        "GPL-3 (that of its repository)",
    ),
    DataSet(
        "tooth",
        "a CT scan of a tooth, 103 x 94 x 161",
        _at("Kitware/vtk-js-datasets/cbdbd91c8b9f161d41fc1ddbb9369e17e20e6344", "data/nrrd/tooth.nrrd"),
        "ct_mri/tooth.nrrd",
        1559102,
        "5ad2e1c52929fde75becd7ba1654c5ef9f4fef40c3032cf36d72ef7bcca0dc64",
        "BSD-3-Clause (Kitware)",
    ),
    DataSet(
        "bonsai",
        "a CT scan of a bonsai, 256 x 256 x 256",
        _at("Kitware/vtk-js-datasets/cbdbd91c8b9f161d41fc1ddbb9369e17e20e6344", "data/vti/bonsai.vti"),
        "ct_mri/bonsai.vti",
        3376795,
        "7129989b41b2197a73b68f66b3b889d9dc7ab6ef08dbdcfb61ca9cdf9f0981dc",
        "BSD-3-Clause (Kitware)",
    ),
    DataSet(
        "tooth_projections",
        "181 synchrotron projections of a tooth, with flat and dark fields",
        _at("tomopy/tomopy/2c94ed18a06f7908b018c6f8e43d320f8a8488f2", "source/tomopy/data/tooth.h5"),
        "ct_projections/tooth.h5",
        1043312,
        "ab1d9bd073b7fb1beae4defa991c2a2626605c5cf1f4be0d0203656bc47b6489",
        "BSD-3-Clause (UChicago Argonne)",
    ),
)
DATA: dict[str, DataSet] = {data.name: data for data in SETS}


def cache_folder() -> Path:
    """Where fetched data is kept: ``MIVOL_CACHE``, or the system's own place for caches."""
    if named := os.environ.get("MIVOL_CACHE"):
        return Path(named)
    home = Path.home()
    if os.name == "nt":
        return Path(os.environ.get("LOCALAPPDATA", home / "AppData" / "Local")) / "mivol"
    if sys.platform == "darwin":
        return home / "Library" / "Caches" / "mivol"
    return Path(os.environ.get("XDG_CACHE_HOME") or home / ".cache") / "mivol"


def find_data_set(name: str) -> DataSet:
    """The set of that name.

    Raises:
        MivolError: there is none; the nearest is offered.
    """
    if name not in DATA:
        near = get_close_matches(name, DATA, 1)
        meant = f'did you mean "{near[0]}"?' if near else f"known are {', '.join(DATA)}."
        raise MivolError(f'there is no data set "{name}": {meant}')
    return DATA[name]


def find_local_file(name: str) -> Path | None:
    """The file of a set, where it is on this machine; None where it is not.

    Raises:
        MivolError: there is no set of that name.
    """
    data = find_data_set(name)
    folders = [Path(folder) for folder in (os.environ.get("MIVOL_DATA"), cache_folder()) if folder]
    return next((folder / data.path for folder in folders if (folder / data.path).is_file()), None)


def resolve_path(base: Path, named: str) -> Path:
    """What an experiment names: a path relative to its file, or ``data:NAME``.

    Raises:
        MivolError: no such set, or it has not been fetched.
    """
    if not named.startswith(PREFIX):
        return base / named
    name = named.removeprefix(PREFIX)
    found = find_local_file(name)
    if found is None:
        raise MivolError(
            f'the data set "{name}" is not on this machine: mivol fetch {name} brings it '
            f"({find_data_set(name).size / 2**20:.2f} MiB), or name a file of your own in place of {named}."
        )
    return found


# -- Fetching -----------------------------------------------------------------------------------------------------


def fetch_data(data: DataSet, folder: Path | None = None, watch: Callable[[int], None] = lambda done: None) -> Path:
    """Bring a set to this machine; what is there and whole is not fetched again.

    Args:
        data: one of ``DATA``.
        folder: where it is kept; by default the cache.
        watch: told how many bytes are there.

    Returns:
        The file.

    Raises:
        MivolError: the server cannot be reached or breaks off (what has come is kept, and the next call goes on from there), or
            the bytes are not those that the set had.
    """
    target = (folder or cache_folder()) / data.path
    if target.is_file() and hash_file(target) == data.sha256:
        return target
    target.parent.mkdir(parents=True, exist_ok=True)
    partial = target.with_name(f"{target.name}.partial")
    try:
        _download(data, partial, watch)
    except (OSError, HTTPException) as error:
        there = partial.stat().st_size if partial.is_file() else 0
        reason = getattr(error, "reason", None) or error
        raise MivolError(
            f"{data.url} could not be fetched ({reason}) after {there} of {data.size} bytes: call again, and it goes on from "
            "there."
        ) from None
    found, size = hash_file(partial), partial.stat().st_size
    if size < data.size:
        raise MivolError(
            f"{data.url} broke off after {size} of {data.size} bytes: call again, and it goes on from there."
        )
    if found != data.sha256:
        partial.unlink()
        raise MivolError(
            f"{data.url} has the SHA-256 {found[:12]}..., expected {data.sha256[:12]}...: it has changed or was damaged on its "
            "way, and was not kept; call again, or report it."
        )
    partial.replace(target)
    return target


def _download(data: DataSet, partial: Path, watch: Callable[[int], None]) -> None:
    there = partial.stat().st_size if partial.is_file() else 0
    if there >= data.size:
        return
    request = urllib.request.Request(data.url, headers={"Range": f"bytes={there}-"} if there else {})
    with urllib.request.urlopen(request, timeout=SECONDS) as answer:
        goes_on = there > 0 and answer.status == 206  # a server that knows no ranges sends all of it again
        done = there if goes_on else 0
        with partial.open("ab" if goes_on else "wb") as file:
            # One byte more than expected shows a file that has grown; no server fills the disk.
            while done <= data.size and (chunk := _read(answer)):
                file.write(chunk)
                done += len(chunk)
                watch(done)


def _read(answer: HTTPResponse) -> bytes:
    return answer.read1(CHUNK)


def hash_file(path: Path) -> str:
    """SHA-256 of a file."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
