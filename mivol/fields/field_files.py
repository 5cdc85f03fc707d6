"""A radiance field as a file for other programs: :data:`EXPORTS` says which, by suffix.

Conventions. Volumes hold what is shown at the nodes: the extinction [1/length], and beside it (``NAME-colour``) the colour of
degree 0, offset included, which is the mean over all directions; values are those of the photographs that the field was fitted
to, code values where they were of 8 bits. Where a signed density is cut at 0 after interpolation, a volume of its nodes is cut
before, so its surfaces lie up to half a voxel elsewhere. Of a nested field there is a pair for each level (``NAME-level-1``, of
twice the extent); the box of the level before is not of its own, and holds only what its cells at the side need. Meshes are in
world coordinates (:mod:`mivol.fields.surfaces`).
"""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.errors import MivolError
from mivol.fields.field_archives import load_field, save_field, save_svox2
from mivol.fields.sky import Sky
from mivol.fields.spherical_grid import SphericalGrid
from mivol.fields.surfaces import extract_surface
from mivol.files import write_exr, write_volume, write_whole
from mivol.files.mesh import write_mesh
from mivol.files.source import refusal
from mivol.photos.photo_file import decode_srgb

__all__ = ["EXPORTS", "Export", "export_field", "write_scene", "field_from_props"]

Y00 = 0.28209479177387814
"""The harmonic of degree 0, 1 / (2 sqrt(pi))."""

CUBE = np.array([[0.5, 0, 0, 0.5], [0, 0.5, 0, 0.5], [0, 0, 0.5, 0.5], [0, 0, 0, 1]])
"""Mitsuba's cube is [-1, 1]^3, the place of a field that of the unit cube."""


EYE = 0.5, -0.7, 0.8
"""Where the camera stands, as a place in the unit cube of the innermost box: before it, a little above its middle."""


SCENE = """<scene version="3.0.0">
    <!-- The field that mivol wrote to {field}. Put surfaces and lights into it, and move the camera. -->
    <integrator type="mivol">
        <integer name="max_depth" value="2"/>
    </integrator>
    <sensor type="perspective">
        <float name="fov" value="60"/>
        <transform name="to_world">
            <lookat origin="{eye}" target="{middle}" up="{up}"/>
        </transform>
        <film type="hdrfilm">
            <integer name="width" value="480"/>
            <integer name="height" value="360"/>
        </film>
        <sampler type="independent">
            <integer name="sample_count" value="16"/>
        </sampler>
    </sensor>
    <shape type="cube" id="field">
        <transform name="to_world">
            <matrix value="{place}"/>
        </transform>
        <bsdf type="null"/>
        <medium name="interior" type="mivol_medium">
            <volume name="emission" type="mivol_sh">
                <string name="filename" value="{field}"/>
            </volume>
        </medium>
    </shape>
{sky}</scene>
"""


ENVIRONMENT = """    <emitter type="envmap">
        <string name="filename" value="{name}"/>
    </emitter>
"""


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
        level: extinction of a mesh's surface [1/length]; None: :func:`mivol.fields.surfaces.default_level`.
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


def _write_scene_files(path: Path, wish: _Wish) -> list[Path]:
    return write_scene(path, wish.field, wish.sky)


def _volumes(path: Path, wish: _Wish) -> list[Path]:
    if wish.field.levels == 1:
        return _pair(path, wish.field)
    names = (path.with_name(f"{path.stem}{f'-level-{k}' if k else ''}{path.suffix}") for k in range(wish.field.levels))
    return [file for k, name in enumerate(names) for file in _pair(name, wish.field.extract_level(k))]


def _pair(path: Path, field: SphericalGrid) -> list[Path]:
    """Extinction and colour of one grid."""
    density, sh = field.to_dense()
    sigma, _ = field.activation_function.value_and_slope(mi.Float(density.reshape(-1)))
    colour = np.maximum(field.offset + Y00 * sh[..., 0, :], 0 if field.clamp else -np.inf)
    beside = path.with_name(f"{path.stem}-colour{path.suffix}")
    write_volume(path, np.array(sigma).reshape(field.res), field.to_world)
    write_volume(beside, colour, field.to_world)
    return [path, beside]


def _mesh(path: Path, wish: _Wish) -> list[Path]:
    write_mesh(path, extract_surface(wish.field, wish.level))
    return [path]


#: suffix -> format; a longer suffix is tried first.
EXPORTS: dict[str, Export] = {
    ".npz": Export("field of mivol", _field),
    ".svox2.npz": Export("checkpoint of svox2", _svox2),
    ".vol": Export("pair of Mitsuba grids", _volumes),
    ".nrrd": Export("pair of NRRD volumes", _volumes),
    ".ply": Export("mesh with colours", _mesh),
    ".obj": Export("mesh with colours", _mesh),
    ".xml": Export("scene of Mitsuba", _write_scene_files),
}


def write_scene(path: Path, field: SphericalGrid, sky: Sky | None = None) -> list[Path]:
    """Write a scene, the field's own file, and an environment where there is a sky.

    Args:
        path: ends in .xml.
        field: what fills the cube, with all its levels.
        sky: what is behind it, in the space of the field's colours; None for black.

    Returns:
        The files that were written, the scene first.

    Raises:
        MivolError: disk full, or a folder that is not there.
    """
    own, behind = path.with_name(f"{path.stem}-field.npz"), path.with_name(f"{path.stem}-sky.exr")
    save_field(own, field)
    written = [path, own]
    if sky is not None:
        colours = np.maximum(sky.image(), 0)
        write_exr(behind, {"": colours if field.space == "linear" else decode_srgb(colours)})
        written.append(behind)
    place = field.to_world
    numbers = {
        "eye": place[:3, :3] @ EYE + place[:3, 3],
        "middle": field.middle,
        "up": place[:3, 2],
        "place": field.level_to_world(field.levels - 1) @ CUBE,
    }
    texts = {name: " ".join(f"{value:.9g}" for value in np.ravel(values)) for name, values in numbers.items()}
    commas = {name: text.replace(" ", ", ") for name, text in texts.items() if name != "place"}
    environment = "" if sky is None else ENVIRONMENT.format(name=behind.name)
    text = SCENE.format(field=own.name, sky=environment, place=texts["place"], **commas)
    write_whole(path, lambda file: file.write(text.encode()))
    return written


SHOWN = ("activation", "offset", "clamp", "space")
"""How values are shown: parameters of the plugin, kept in files. Tensors are radiance unless told otherwise."""


def field_from_props(props: mi.Properties) -> tuple[SphericalGrid, mi.TensorXf, mi.TensorXf]:
    """Read a field from plugin parameters: ``filename``, or ``density`` and ``sh``; ``to_world`` and how values are shown.

    Returns:
        The field and its two tensors; those that were given, where they were, with their gradients.

    Raises:
        MivolError: none or both of the sources, or values that no field can have.
    """
    tensors = [n for n in ("density", "sh") if n in props]
    if ("filename" in props) == bool(tensors) or len(tensors) == 1:
        found = " and ".join([*(["filename"] if "filename" in props else []), *tensors]) or "none of them"
        raise MivolError(f"mivol_sh was given {found}; give filename, or density and sh.")
    if tensors:
        density, sh = (props[n] for n in tensors)
        how = {"space": "linear"} | {n: props[n] for n in SHOWN if n in props}
        field = SphericalGrid.from_dense(np.array(dr.detach(density)), np.array(dr.detach(sh)), _place(props), **how)
        return field, density, sh
    field = load_field(str(mi.file_resolver().resolve(props["filename"])))
    how = {n: props.get(n, getattr(field, n)) for n in SHOWN}
    field = SphericalGrid.from_rows(field.res, field.to_world, *field.values(), field.nodes, levels=field.levels, **how)
    if "to_world" in props:
        field = replace(field, to_world=_place(props) @ field.to_world)
    values, coefficients = field.values()
    shape = field.shape if field.nodes is None else values.shape
    sh = np.ascontiguousarray(coefficients.reshape(*shape, *coefficients.shape[1:]))
    return field, mi.TensorXf(values.reshape(*shape, 1)), mi.TensorXf(sh)


def _place(props: mi.Properties) -> np.ndarray:
    return np.array(props.get("to_world", mi.ScalarTransform4f()).matrix, dtype=np.float64)
