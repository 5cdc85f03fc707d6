"""A radiance field as a file for other programs: :data:`EXPORTS` says which, by suffix.

Conventions. Volumes hold what is shown at the nodes: the extinction [1/length], and beside it (``NAME-colour``) the colour of
degree 0, offset included, which is the mean over all directions; values are those of the photographs that the field was fitted
to, code values where they were of 8 bits. Where a signed density is cut at 0 after interpolation, a volume of its nodes is cut
before, so its surfaces lie up to half a voxel elsewhere. Of a nested field there is a pair for each level (``NAME-level-1``, of
twice the extent); the box of the level before is not of its own, and holds only what its cells at the side need. Meshes are in
world coordinates (:mod:`mivol.fields.surface`).
"""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import mitsuba as mi
import numpy as np

from mivol.fields.scene_file import write_scene
from mivol.fields.sky import Sky
from mivol.fields.spherical import SphericalGrid
from mivol.fields.spherical_files import save_field
from mivol.fields.spherical_svox2 import save_svox2
from mivol.fields.surface import surface_of
from mivol.files import write_volume
from mivol.files.mesh import write_mesh
from mivol.files.source import refusal

__all__ = ["EXPORTS", "Export", "export_field"]

Y00 = 0.28209479177387814
"""The harmonic of degree 0, 1 / (2 sqrt(pi))."""

FOREIGN = {".vdb": "a name for OpenVDB, for which no package can be installed"}
"""Formats that people ask for and that cannot be written."""


@dataclass(frozen=True)
class Export:
    """A kind of file: its name for people, and its writer (path, what to write), which returns the files that it wrote."""

    name: str
    write: Callable[[Path, _Wish], list[Path]]


@dataclass(frozen=True)
class _Wish:
    """What is to be written, as :func:`export_field` was asked."""

    field: SphericalGrid
    level: float | None
    sky: Sky | None


def export_field(
    path: str | os.PathLike, field: SphericalGrid, level: float | None = None, sky: Sky | None = None
) -> list[Path]:
    """Write a field in the format of the suffix (:data:`EXPORTS`), whole or not at all.

    Args:
        path: destination.
        field: what to write.
        level: extinction of a mesh's surface [1/length]; None: :func:`mivol.fields.surface.level_of`.
        sky: what is behind the field, which a scene shows too; the other formats have no place for it.

    Returns:
        The files that were written.

    Raises:
        MivolError: a suffix that is not known, a level for what is no mesh, a field that the format cannot hold, disk full.
    """
    path = Path(path)
    suffix = next((s for s in sorted(EXPORTS, key=len, reverse=True) if path.name.lower().endswith(s)), None)
    if suffix is None:
        known = ", ".join(f"{s} ({kind.name})" for s, kind in EXPORTS.items())
        found = FOREIGN.get(path.suffix.lower(), f"the suffix {path.suffix!r}")
        raise refusal(path, found, f"one of {known}", "choose one of those")
    if level is not None and EXPORTS[suffix].write is not _mesh:
        raise refusal(path, f"a level for a {EXPORTS[suffix].name}", "none", "levels are for meshes: write .ply or .obj")
    return EXPORTS[suffix].write(path, _Wish(field, level, sky))


def _field(path: Path, wish: _Wish) -> list[Path]:
    save_field(path, wish.field)
    return [path]


def _svox2(path: Path, wish: _Wish) -> list[Path]:
    save_svox2(path, wish.field)
    return [path]


def _scene(path: Path, wish: _Wish) -> list[Path]:
    return write_scene(path, wish.field, wish.sky)


def _volumes(path: Path, wish: _Wish) -> list[Path]:
    if wish.field.levels == 1:
        return _pair(path, wish.field)
    names = (path.with_name(f"{path.stem}{f'-level-{k}' if k else ''}{path.suffix}") for k in range(wish.field.levels))
    return [file for k, name in enumerate(names) for file in _pair(name, wish.field.level(k))]


def _pair(path: Path, field: SphericalGrid) -> list[Path]:
    """Extinction and colour of one grid."""
    density, sh = field.to_dense()
    sigma, _ = field.act.value_and_slope(mi.Float(density.reshape(-1)))
    colour = np.maximum(field.offset + Y00 * sh[..., 0, :], 0 if field.clamp else -np.inf)
    beside = path.with_name(f"{path.stem}-colour{path.suffix}")
    write_volume(path, np.array(sigma).reshape(field.res), field.to_world)
    write_volume(beside, colour, field.to_world)
    return [path, beside]


def _mesh(path: Path, wish: _Wish) -> list[Path]:
    write_mesh(path, surface_of(wish.field, wish.level))
    return [path]


#: suffix -> format; a longer suffix is tried first.
EXPORTS: dict[str, Export] = {
    ".npz": Export("field of mivol", _field),
    ".svox2.npz": Export("checkpoint of svox2", _svox2),
    ".vol": Export("pair of Mitsuba grids", _volumes),
    ".nrrd": Export("pair of NRRD volumes", _volumes),
    ".ply": Export("mesh with colours", _mesh),
    ".obj": Export("mesh with colours", _mesh),
    ".xml": Export("scene of Mitsuba", _scene),
}
