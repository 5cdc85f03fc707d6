"""Public data sets by name: download, SHA-256 check and cache.

Conventions. A data set is a file of a public repository at a fixed commit, so it never changes. A set is searched below
``MIVOL_DATA`` and then in the cache (``MIVOL_CACHE``, or the cache folder of the system). Paths in experiments may be
``data:NAME``. Only :func:`fetch_data` uses the network, and it resumes interrupted downloads.
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
from http.client import HTTPException
from pathlib import Path

from mivol.errors import MivolError

PREFIX = "data:"
"""Prefix of a path that names a data set."""

SECONDS = 30.0
"""Timeout of the server [s]."""

CHUNK = 1 << 16
GITHUB = "https://raw.githubusercontent.com"


@dataclass(frozen=True)
class DataSet:
    """A public file.

    Attributes:
        name: name in mivol.
        content: content of the file.
        url: public address.
        path: path below ``MIVOL_DATA`` and the cache.
        size: size of the file [byte].
        sha256: hash of the file, in hexadecimal.
        licence: licence of the repository.
    """

    name: str
    content: str
    url: str
    path: str
    size: int
    sha256: str
    licence: str

    def describe(self) -> str:
        """Describe the data set in a line."""
        return f"{self.name}: {self.content}, {self.size / 2**20:.2f} MiB; licence: {self.licence}; {self.url}"


def _github_url(repository: str, path: str) -> str:
    return f"{GITHUB}/{repository}/{path}"


SETS = (
    DataSet(
        "smoke",
        "the smoke of Mitsuba's tutorials, 44 x 45 x 53",
        _github_url("mitsuba-renderer/mitsuba-tutorials/a8dbee7e81b1039a983770ce1042f2d78688d0ae", "scenes/volume.vol"),
        "volumes_vol/tutorials_volume.vol",
        419808,
        "85732786c722b91f4dcf8a7509bba286912d93ac03c23e781e1535d1609d9291",
        "none stated (Mitsuba's own repository)",
    ),
    DataSet(
        "cloud",
        "a cumulus of a large-eddy simulation, 32 x 37 x 26 (Matheou and Chung 2014)",
        _github_url(
            "CloudTomography/AT3D/ffd8994f91b42f390dbf31369447c2136749b93a",
            "at3d/data/synthetic_cloud_fields/jpl_les/rico32x37x26.txt",
        ),
        "clouds_les/rico32x37x26.txt",
        99634,
        "bca65313a095ce96f9a92d4af764c7fcfc453112abcf5921bd98e89c0b139c49",
        "GPL-3 (of the repository)",
    ),
    DataSet(
        "tooth",
        "a CT scan of a tooth, 103 x 94 x 161",
        _github_url("Kitware/vtk-js-datasets/cbdbd91c8b9f161d41fc1ddbb9369e17e20e6344", "data/nrrd/tooth.nrrd"),
        "ct_mri/tooth.nrrd",
        1559102,
        "5ad2e1c52929fde75becd7ba1654c5ef9f4fef40c3032cf36d72ef7bcca0dc64",
        "BSD-3-Clause (Kitware)",
    ),
    DataSet(
        "bonsai",
        "a CT scan of a bonsai, 256 x 256 x 256",
        _github_url("Kitware/vtk-js-datasets/cbdbd91c8b9f161d41fc1ddbb9369e17e20e6344", "data/vti/bonsai.vti"),
        "ct_mri/bonsai.vti",
        3376795,
        "7129989b41b2197a73b68f66b3b889d9dc7ab6ef08dbdcfb61ca9cdf9f0981dc",
        "BSD-3-Clause (Kitware)",
    ),
    DataSet(
        "tooth_projections",
        "181 synchrotron projections of a tooth, with flat and dark fields",
        _github_url("tomopy/tomopy/2c94ed18a06f7908b018c6f8e43d320f8a8488f2", "source/tomopy/data/tooth.h5"),
        "ct_projections/tooth.h5",
        1043312,
        "ab1d9bd073b7fb1beae4defa991c2a2626605c5cf1f4be0d0203656bc47b6489",
        "BSD-3-Clause (UChicago Argonne)",
    ),
)
DATA: dict[str, DataSet] = {data.name: data for data in SETS}


def cache_folder() -> Path:
    """Return the folder of fetched data: ``MIVOL_CACHE``, or the cache folder of the system."""
    if named := os.environ.get("MIVOL_CACHE"):
        return Path(named)
    home = Path.home()
    if os.name == "nt":
        return Path(os.environ.get("LOCALAPPDATA", home / "AppData" / "Local")) / "mivol"
    if sys.platform == "darwin":
        return home / "Library" / "Caches" / "mivol"
    return Path(os.environ.get("XDG_CACHE_HOME") or home / ".cache") / "mivol"


def find_data_set(name: str) -> DataSet:
    """Return a data set by name.

    Raises:
        MivolError: an unknown name, with the most similar name.
    """
    if name not in DATA:
        near = get_close_matches(name, DATA, 1)
        way_out = f'did you mean "{near[0]}"?' if near else f"choose one of {', '.join(DATA)}."
        raise MivolError(f'there is no data set "{name}"; {way_out}')
    return DATA[name]


def find_local_file(name: str) -> Path | None:
    """Return the local file of a data set, or None before the download.

    Raises:
        MivolError: an unknown name.
    """
    data = find_data_set(name)
    folders = [Path(folder) for folder in (os.environ.get("MIVOL_DATA"), cache_folder()) if folder]
    return next((folder / data.path for folder in folders if (folder / data.path).is_file()), None)


def resolve_path(base: Path, named: str) -> Path:
    """Resolve a path of an experiment.

    Args:
        base: folder of the experiment.
        named: path relative to ``base``, or ``data:NAME``.

    Raises:
        MivolError: an unknown data set, or a data set before its download.
    """
    if not named.startswith(PREFIX):
        return base / named
    name = named.removeprefix(PREFIX)
    file = find_local_file(name)
    if file is None:
        raise MivolError(
            f'the data set "{name}" is not on this machine; download it with "mivol fetch {name}" '
            f"({find_data_set(name).size / 2**20:.2f} MiB), or name another file instead of {named}."
        )
    return file


# -- Fetching -----------------------------------------------------------------------------------------------------


def fetch_data(data: DataSet, folder: Path | None, watch: Callable[[int], None] = lambda done: None) -> Path:
    """Download a data set, unless a complete copy exists.

    Args:
        data: entry of ``DATA``.
        folder: destination folder, by default the cache.
        watch: function called with the number of downloaded bytes.

    Returns:
        The file.

    Raises:
        MivolError: an unreachable server, an interrupted download (the next call resumes it), or a wrong hash.
    """
    target = (folder or cache_folder()) / data.path
    if target.is_file() and hash_file(target) == data.sha256:
        return target
    target.parent.mkdir(parents=True, exist_ok=True)
    partial = target.with_name(f"{target.name}.partial")
    try:
        _download(data, partial, watch)
    except (OSError, HTTPException) as error:
        size = partial.stat().st_size if partial.is_file() else 0
        reason = getattr(error, "reason", None) or error
        raise MivolError(
            f"{data.url} could not be fetched ({reason}) after {size} of {data.size} bytes; call again to resume the download."
        ) from None
    sha256, size = hash_file(partial), partial.stat().st_size
    if size < data.size:
        raise MivolError(f"{data.url} broke off after {size} of {data.size} bytes; call again to resume the download.")
    if sha256 != data.sha256:
        partial.unlink()
        raise MivolError(
            f"{data.url} has the SHA-256 {sha256[:12]}..., expected {data.sha256[:12]}..., so the download was deleted; "
            "call again, or report the change."
        )
    partial.replace(target)
    return target


def _download(data: DataSet, partial: Path, watch: Callable[[int], None]) -> None:
    size = partial.stat().st_size if partial.is_file() else 0
    if size >= data.size:
        return
    request = urllib.request.Request(data.url, headers={"Range": f"bytes={size}-"} if size else {})
    with urllib.request.urlopen(request, timeout=SECONDS) as response:
        is_resumed = size > 0 and response.status == 206  # a server without ranges sends the whole file again
        done = size if is_resumed else 0
        with partial.open("ab" if is_resumed else "wb") as file:
            # One surplus byte reveals a larger file, so no server can fill the disk.
            while done <= data.size and (chunk := response.read1(CHUNK)):
                file.write(chunk)
                done += len(chunk)
                watch(done)


def hash_file(path: Path) -> str:
    """Return the SHA-256 of a file in hexadecimal."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
